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
    account,
    mean_of,
    predicted,
    problem_of,
    settle,
    start_of,
)
from spotcheck.discrepancy.evidence.components import Component
from spotcheck.discrepancy.evidence.design import Design, missing
from spotcheck.discrepancy.evidence.influence import FrameNumbers
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
    an effect, and what each effect brings; all None or empty where the baseline has no law or frames are few."""

    base: Account | None
    full: Account | None
    alone: float
    trials: tuple[Trial, ...]


def laws_of(
    numbers: FrameNumbers,
    design: Design,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    present: Sequence[Present] = (),
    common_width: float = COMMON_WIDTH,
) -> Laws:
    """What frames say of the baseline's laws and of every effect of brightness and width that their design can show.

    `present`: effects that are in the model already; those of brightness and width are fitted again with each trial.
    """
    if baseline.photon_budget == "free" or len(design.site) < FEWEST:
        return Laws(None, None, np.nan, ())
    problem = problem_of(numbers, design, baseline, sensor, crop_px, present, common_width)
    base = account(mean_of(problem, problem.model.present), problem.rows.components, restricted=True)
    full = account(mean_of(problem, base.present, base), problem.rows.components, restricted=False, start=base)
    taken = {own.effect.name for own in present}
    tried = [e for e in vocabulary().values() if e.name not in taken and not missing(e, design, law=True)]
    scatter = [e for e in vocabulary().values() if component_of(e, problem.rows.components) is not None and e.name not in taken]
    held = [component_of(effect, problem.rows.components) for effect in scatter]
    bare = tuple(own for k, own in enumerate(problem.rows.components) if k not in held)
    alone = account(mean_of(problem, full.present, full), bare, restricted=False, start=full).deviance
    trials = []
    for effect in tried:
        if effect.place in PLACES:
            trials.append(_law_trial(problem, effect, base, full, bare))
        elif effect in scatter:
            trials.append(_scatter_trial(problem, effect, base, full, bare))
    return Laws(base, full, alone, tuple(trials))



def component_of(effect: Effect, components: Sequence[Component]) -> int | None:
    """Which component a scatter of the light is; None where it is none of them."""
    if effect.component != "gain" or effect.scatter is None:
        return None
    pairs = [(own.of, own.shared) for own in components]
    own = ("brightness", effect.scatter.shared)
    return pairs.index(own) if own in pairs else None


def _scatter_trial(problem: Problem, effect: Effect, base: Account, full: Account, bare: tuple[Component, ...]) -> Trial:
    """A component against none of it, by restricted likelihood."""
    # ASSUME: the scatter is small, so that of the brightness's logarithm is the same.
    every = problem.rows.components
    which = component_of(effect, every)
    assert which is not None
    without = tuple(own for k, own in enumerate(every) if k != which)
    null = account(mean_of(problem, base.present, base), without, restricted=True, start=base)
    own = tuple(c for c in every if c in bare or c is every[which])
    alone = account(mean_of(problem, full.present, full), own, restricted=False, start=full)
    tau, sure = base.found.weights.tau[which], mixed.spread(base.found)[which]
    value, error = mixed.root_of(tau, sure)
    gain = max(null.deviance - base.deviance, 0.0)
    present = Present(effect, effect.forms[0], _with_strength(effect, problem, value))
    return Trial(present, value, error, float(np.sqrt(gain)), np.inf, gain, alone.deviance, 0.0)


def _with_strength(effect: Effect, problem: Problem, value: float) -> tuple[float, ...]:
    """An effect's first start with another strength."""
    return (value, *effect.starts(problem.context)[0][1:])


def _law_trial(problem: Problem, effect: Effect, base: Account, full: Account, bare: tuple[Component, ...]) -> Trial:
    """An effect fitted from all its starts in all its forms, beside what is present."""
    best, lowest = None, np.inf
    for form in effect.forms:
        near = _nearest(problem, effect, form, base)
        if near is None:
            continue
        own = account(mean_of(problem, near.present, near), problem.rows.components, restricted=False, start=near)
        price = own.deviance + PRICE * len(own.mean.free)
        if price < lowest:
            best, lowest = own, price
    assert best is not None
    sharp = account(mean_of(problem, best.present, best), problem.rows.components, restricted=True, start=best)
    alone = account(mean_of(problem, best.present, best), bare, restricted=False, start=best)
    return _judged(sharp, base, full.deviance - best.deviance, alone.deviance)


def _nearest(problem: Problem, effect: Effect, form: str, base: Account) -> Account | None:
    """The best fit of a form at the components that are there without it."""
    best, lowest = None, np.inf
    for start in effect.starts(problem.context):
        mean = mean_of(problem, (*base.present, Present(effect, form, tuple(start))), base)
        theta, chi2 = settle(mean, start_of(mean), base.found.weights.factor)
        if chi2 < lowest:
            best, lowest = base._replace(mean=mean, theta=theta), chi2
    return best


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
    z = mixed.z_of(t, freedom, len(places))
    return Trial(present, float(value), error, z, freedom, gain, alone, between)


def _error_of(own: Account, slopes: np.ndarray, row: int) -> tuple[float, float, float]:
    """Variance of a parameter, the part of it that comes from cells that disagree, and its degrees of freedom.

    Cells whose model is right differ by noise alone, which the known covariance holds; what goes beyond comes on top.
    """
    found = mixed.reckoned(own.found, own.components, slopes)
    rows, heavy = own.mean.problem.rows, found.rows[row]
    first, doubt, beyond = found.covariance[row, row], found.doubt[row], 0.0
    cells = rows.influence.shape[1]
    if cells > 1:
        parts = heavy @ rows.influence
        scatter = cells * float(np.var(parts, ddof=1))
        beyond = max(scatter - float(heavy @ rows.known @ heavy), 0.0)
        doubt += 2 * scatter**2 / (cells - 1) if beyond else 0.0
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
