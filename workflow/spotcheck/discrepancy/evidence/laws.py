"""What the frames' brightness and width say of each effect: the laws of exposure, angle and order, beside scatter.

Brightness and width scatter from site to site and from frame to frame by variances that are fitted: they are nuisance,
and the scatter of a frame's brightness is itself an effect.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.evidence import components as mixed
from spotcheck.discrepancy.evidence.accounts import (
    COMMON_WIDTH,
    PLACES,
    Account,
    Problem,
    Start,
    account,
    apart,
    beginnings,
    first_account,
    mean_of,
    predicted,
    problem_of,
    settle,
    start_of,
)
from spotcheck.discrepancy.evidence.components import Component
from spotcheck.discrepancy.evidence.influence import FrameNumbers
from spotcheck.discrepancy.evidence.scatter import Scatter, scatters_of
from spotcheck.discrepancy.nuisance.fit import NUMBERS
from spotcheck.discrepancy.observe.design import Design, missing
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import Effect, Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import SensorModel

# Fewer frames than this leave nothing beside two numbers of a law and a scatter.
FEWEST = 4
# What a parameter of a form has to gain in −2 ln L against a form with fewer (Akaike's price).
PRICE = 2.0


class Trial(NamedTuple):
    """What the frames' numbers say of one effect, beside the effects that are present already.

    - `present`: the effect, its best form and values; `value` and `error` of its strength, in its unit.
    - `z`: of the strength against the neutral one, by Student's t with `freedom` degrees of freedom, where the sum of
      an effect's several parameters counts by Fisher's F.
    - `gain`: what it gains in −2 ln L, scatter of the frames being free with and without it; of a scatter, against none
      of it.
    - `alone`: −2 ln L of the model with it where no scatter that is itself an effect is there, but its own: for rivals.
    - `between_cells`: the part of error² that comes from cells of the spot that disagree.
    """

    present: Present
    value: float
    error: float
    z: float
    freedom: float
    gain: float
    alone: float
    between_cells: float


class Laws(NamedTuple):
    """Accounts by restricted and by full likelihood without any further effect, −2 ln L without scatter that is itself
    an effect, and what each effect brings; no account and no trial where the baseline has no law or frames are few. The
    scatter of frames, of their centres too, is there in any case."""

    base: Account | None
    full: Account | None
    alone: float
    trials: tuple[Trial, ...]
    scatters: tuple[Scatter, ...]


def laws_of(
    numbers: FrameNumbers,
    design: Design,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    present: Sequence[Present] = (),
    effects: Sequence[Effect] | None = None,
    common_width: float = COMMON_WIDTH,
) -> Laws:
    """What frames say of the baseline's laws and of every effect of brightness and width that their design can show.

    `present`: effects that are in the model already; those of brightness and width are fitted again with each trial.
    `effects`: those to try, by default the run's vocabulary. `common_width` as in `rows_of`.
    """
    law = baseline.photon_budget != "free" and len(design.site) >= FEWEST
    known = tuple(vocabulary().values()) if effects is None else tuple(effects)
    taken = {own.effect.name for own in present}
    tried = [e for e in known if e.name not in taken and not missing(e, design, law=law)]
    scatters = tuple(scatters_of(numbers, design, tried))
    if not law:
        return Laws(None, None, np.nan, (), scatters)
    problem = problem_of(numbers, design, baseline, sensor, crop_px, present, common_width)
    base = first_account(problem)
    full = account(mean_of(problem, base.present, base), problem.rows.components, restricted=False, start=base)
    held = {part_of(effect) for effect in known if effect.name not in taken}
    bare = tuple(own for own in problem.rows.components if (own.of, own.shared) not in held)
    alone = account(mean_of(problem, full.present, full), bare, restricted=False, start=full).deviance
    trials = [_law_trial(problem, e, base, full, bare) for e in tried if e.place in PLACES]
    trials += [_scatter_trial(problem, own, full, held) for own in scatters if part_of(own.effect)]
    return Laws(base, full, alone, tuple(trials), scatters)


def part_of(effect: Effect) -> tuple[str, str] | None:
    """Of what a component is and what shares it, where an effect is one of the rows' components."""
    return ("brightness", effect.scatter.shared) if effect.scatter and effect.component == "gain" else None


def _scatter_trial(problem: Problem, own: Scatter, full: Account, held: set[tuple[str, str] | None]) -> Trial:
    """A scatter of frames as a trial: the test is its own, −2 ln L for rivals that of an account that has it."""
    others = held - {part_of(own.effect)}
    with_it = tuple(c for c in problem.rows.components if (c.of, c.shared) not in others)
    alone = account(mean_of(problem, full.present, full), with_it, restricted=False, start=full)
    values = (own.value, *own.effect.starts(problem.context)[0][1:])
    present = Present(own.effect, own.effect.forms[0], values)
    return Trial(present, own.value, own.error, own.z, np.inf, own.gain, alone.deviance, 0.0)


def _law_trial(problem: Problem, effect: Effect, base: Account, full: Account, bare: tuple[Component, ...]) -> Trial:
    """An effect fitted from all its starts in all its forms, beside what is present."""
    best, lowest = None, np.inf
    for form in effect.forms:
        for start in _nearest(problem, effect, form, base):
            mean = mean_of(problem, (*base.present, Present(effect, form, effect.starts(problem.context)[0])), base)
            own = account(mean, problem.rows.components, restricted=False, start=start)
            price = own.deviance + PRICE * len(own.mean.free)
            if price < lowest:
                best, lowest = own, price
    assert best is not None
    sharp = account(mean_of(problem, best.present, best), problem.rows.components, restricted=True, start=best)
    alone = account(mean_of(problem, best.present, best), bare, restricted=False, start=best)
    return _judged(sharp, base, full.deviance - best.deviance, alone.deviance)


def _nearest(problem: Problem, effect: Effect, form: str, base: Account) -> list[Start]:
    """The best fits of a form at the components that are there without it, and at those from which fits begin."""
    rows, out = problem.rows, []
    means = [
        mean_of(problem, (*base.present, Present(effect, form, tuple(start))), base)
        for start in effect.starts(problem.context)
    ]
    for tau in (base.found.weights.tau, *beginnings(rows)):
        factor = mixed.weights_at(rows.known, rows.components, tau).factor
        fits = [settle(mean, start_of(mean), factor) for mean in means]
        out.append((min(fits, key=lambda fit: fit[1])[0], tau))
    return apart(means[0], out, base.found.weights.factor)


def _judged(own: Account, base: Account, gain: float, alone: float) -> Trial:
    """Strength, error and z of the effect that an account has beyond another."""
    present = own.present[-1]
    last = len(own.mean.model.present) - 1
    places = [k for k, free in enumerate(own.mean.free) if free.effect == last]
    strength = next((k for k in places if own.mean.free[k].parameter == 0), None)
    assert strength is not None
    row = len(own.mean.law_free) + strength
    value = present.values[0]
    variance, between, freedom = _error_of(own, own.slopes, row)
    error = float(np.sqrt(variance))
    if np.isfinite(present.effect.neutral):
        t = (value - present.effect.neutral) / error
    else:
        t, freedom = _against(own, base)
    z = mixed.z_of(t, freedom, len(places), len(present.effect.forms))
    return Trial(present, float(value), error, z, freedom, gain, alone, between)


def _error_of(own: Account, slopes: np.ndarray, row: int) -> tuple[float, float, float]:
    """Variance of a parameter, the part of it that comes from cells that disagree, and its degrees of freedom.

    Cells whose model is right differ by noise alone, which the known covariance holds; what goes beyond comes on top.
    """
    found = mixed.reckoned(own.found, own.components, slopes)
    rows, heavy = own.mean.problem.rows, found.rows[row]
    first, doubt, beyond = found.covariance[row, row], found.doubt[row], 0.0
    # Each frame's own numbers are fitted to its cells, which then scatter by less.
    cells, left = rows.influence.shape[1], rows.influence.shape[1] - NUMBERS
    if left > 0:
        scatter = cells * cells / left * float(np.var(heavy @ rows.influence))
        beyond = max(scatter - float(heavy @ rows.known @ heavy), 0.0)
        doubt += 2 * scatter**2 / left if beyond else 0.0
    total = first + beyond
    return float(total), beyond, float(2 * total**2 / doubt) if doubt > 0 else np.inf


def _against(own: Account, base: Account) -> tuple[float, float]:
    """t and degrees of freedom of a law that has no neutral strength: of the part α of the way from the base's rows to
    its own, beside the base's parameters (Davidson & MacKinnon 1981, doi:10.2307/1911522)."""
    way = predicted(own.mean, own.theta) - predicted(base.mean, base.theta)
    slopes = np.concatenate([base.slopes, way[:, None]], 1)
    row = slopes.shape[1] - 1
    found = mixed.estimate(
        base.mean.problem.rows.known, base.components, slopes, base.rest, base.found.weights.tau, restricted=True
    )
    part = base._replace(found=found, slopes=slopes)
    variance, _, freedom = _error_of(part, slopes, row)
    size = float(mixed.reckoned(found, base.components, slopes).rows[row] @ base.rest)
    return size / float(np.sqrt(variance)), freedom
