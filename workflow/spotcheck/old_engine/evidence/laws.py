"""What the frames' brightness and width say of each effect: the laws of exposure, angle and order, beside scatter.

Brightness and width scatter from site to site and from frame to frame by variances that are fitted: they are nuisance,
and the scatter of a frame's brightness is itself an effect.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence import components as mixed
from spotcheck.old_engine.evidence.accounts import (
    PLACES,
    Account,
    Problem,
    account,
    beginnings,
    first_account,
    mean_of,
    predicted,
    problem_of,
    start_of,
    starts_of,
)
from spotcheck.old_engine.evidence.components import Component
from spotcheck.old_engine.evidence.influence import FrameNumbers
from spotcheck.old_engine.evidence.scatter import FEWEST, Trial, scatters_of
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.effect import Effect, Present
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance.fit import NUMBERS
from spotcheck.old_engine.observe.design import Design, missing

# Frames that an effect changes alike within this part of its greatest change are of one group; groups at most.
ALIKE, GROUPS = 1e-3, 12
# Part of the largest singular value below which rows are as good as fitted.
SAME = 0.1


class Laws(NamedTuple):
    """The account without any further effect, by restricted likelihood, and what each effect brings; neither where the
    baseline has no law or frames are few. The scatter of frames, of their centres too, is there in any case."""

    base: Account | None
    trials: tuple[Trial, ...]
    scatters: tuple[Trial, ...]


def laws_of(
    numbers: FrameNumbers,
    design: Design,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    present: Sequence[Present] = (),
    effects: Sequence[Effect] = (),
) -> Laws:
    """What frames say of the baseline's laws, and of those of some effects that their design can show. Effects of
    brightness and width that are `present` already are fitted again with each."""
    law = baseline.photon_budget != "free" and len(design.site) >= FEWEST
    taken = {own.effect.name for own in present}
    tried = [e for e in effects if e.name not in taken and not missing(e, design, law=law)]
    scatters = tuple(scatters_of(numbers, design, tried))
    if not law:
        return Laws(None, (), scatters)
    problem = problem_of(numbers, design, baseline, sensor, crop_px, present)
    base = first_account(problem)
    full = again(base, problem.components)
    held = {part_of(effect) for effect in effects if effect.name not in taken}
    bare = tuple(own for own in problem.components if (own.of, own.shared) not in held)
    trials = [_law_trial(problem, e, base, full, bare) for e in tried if e.place in PLACES]
    trials += [_scatter_trial(problem, own, full, held) for own in scatters if part_of(own.present.effect)]
    return Laws(base, tuple(trials), scatters)


def again(own: Account, components: tuple[Component, ...], *, restricted: bool = False) -> Account:
    """An account of the same effects, with some components, from where it stands."""
    mean = mean_of(own.mean.problem, own.present, own)
    # Scoring leaves 0 as easily as any other value.
    left = {(one.of, one.shared): tau for one, tau in zip(own.found.components, own.found.tau, strict=True)}
    start = start_of(mean), np.array([left.get((one.of, one.shared), 0.0) for one in components])
    return account(mean, components, restricted=restricted, start=start)


def part_of(effect: Effect) -> tuple[str, str] | None:
    """Of what a component is and what shares it, where an effect is one of the rows' components."""
    return ("brightness", effect.scatter.shared) if effect.scatter and effect.component == "gain" else None


def _scatter_trial(problem: Problem, own: Trial, full: Account, held: set[tuple[str, str] | None]) -> Trial:
    """A scatter of frames beside its rivals, by −2 ln L of an account that has it."""
    others = held - {part_of(own.present.effect)}
    with_it = tuple(c for c in problem.components if (c.of, c.shared) not in others)
    values = (own.value, *own.present.effect.starts(problem.context)[0][1:])
    return own._replace(present=own.present._replace(values=values), alone=again(full, with_it).deviance)


def _law_trial(problem: Problem, effect: Effect, base: Account, full: Account, bare: tuple[Component, ...]) -> Trial:
    """An effect fitted from all its starts in all its forms, beside what is present, from the components that are there
    without it, and from those from which fits begin."""
    tried = []
    for form in effect.forms:
        every = [(*base.present, Present(effect, form, tuple(own))) for own in effect.starts(problem.context)]
        # A law that was made right for the brightness without this effect is no start for it.
        means = [mean_of(problem, own, start) for start in (None, base) for own in every]
        begun = starts_of(means, [base.found.tau, *beginnings(problem)])
        tried += [account(means[0], problem.components, restricted=False, start=own) for own in begun]
    best = min(tried, key=lambda own: own.deviance + criteria.PRICE.value * len(own.mean.free))
    sharp = again(best, problem.components, restricted=True)
    return _judged(sharp, base, full.deviance - best.deviance, again(best, bare).deviance)


def _judged(own: Account, base: Account, gain: float, alone: float) -> Trial:
    """Strength, error and z of the effect that an account has beyond another."""
    present = own.present[-1]
    places = _places(own, len(own.present) - 1)
    variance, freedom = _error_of(own, own.slopes, places[0])
    error = float(np.sqrt(variance))
    t = (present.values[0] - present.effect.neutral) / error
    if not np.isfinite(present.effect.neutral):
        t, freedom = _against(own, base)
    z = mixed.z_of(t, freedom, len(places), len(present.effect.forms))
    return Trial(present, error, z, freedom, gain, alone)


def _places(own: Account, effect: int) -> dict[int, int]:
    """Where an effect's parameters stand among an account's, by their number."""
    free, first = own.mean.free, len(own.mean.law_free)
    return {one.parameter: first + k for k, one in enumerate(free) if one.effect == effect}


def errors_of(own: Account) -> dict[str, tuple[float, ...]]:
    """Standard errors of the parameters of an account's effects, NaN where one is not fitted."""
    out = {}
    for k, present in enumerate(own.present):
        places = _places(own, k)
        out[present.effect.name] = tuple(
            float(np.sqrt(_error_of(own, own.slopes, places[p])[0])) if p in places else np.nan
            for p in range(len(present.values))
        )
    return out


def agreement(own: Account, effect: int) -> tuple[float, int]:
    """Q of what groups of frames say beyond all that is fitted, and its degrees of freedom, of brightness or width,
    whichever the effect of a number changes more; a group is of frames that it changes alike. Under a law that is right
    Q follows χ². No freedom is left where as many parameters are fitted as there are groups."""
    problem, places = own.mean.problem, _places(own, effect)
    frames = len(problem.design.site)
    change = (problem.lift.T @ own.slopes[:, [places[p] for p in sorted(places)]]).reshape(2, frames, -1)
    of = int(np.argmax(np.sum(change**2, axis=(1, 2))))
    size = np.abs(change[of]).max(axis=0)
    keys = np.rint(change[of] / np.where(size > 0, size, 1.0) / ALIKE)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    if group.max() >= GROUPS:
        order = np.argsort(np.argsort(keys @ np.linalg.svd(keys - keys.mean(axis=0), full_matrices=False)[2][0]))
        group = order * GROUPS // frames
    alike = (group.reshape(-1, 1) == np.unique(group)).astype(float)
    rows = problem.lift[:, of * frames : (of + 1) * frames] @ alike
    rest, slopes, rows = (
        linalg.solve_triangular(own.found.factor, one, lower=True) for one in (own.rest, own.slopes, rows)
    )
    base = linalg.orth(slopes) if slopes.size else slopes
    beyond = linalg.orth(rows - base @ (base.T @ rows), rcond=SAME)
    return float(np.sum((beyond.T @ (rest - base @ (base.T @ rest))) ** 2)), beyond.shape[1]


def _error_of(own: Account, slopes: np.ndarray, row: int) -> tuple[float, float]:
    """Variance of a parameter, and its degrees of freedom.

    Cells whose model is right differ by noise alone, which the known covariance holds; what goes beyond comes on top.
    """
    covariance, made, doubts = mixed.reckoned(own.found, slopes)
    problem, heavy = own.mean.problem, made[row]
    first, doubt, beyond = covariance[row, row], doubts[row], 0.0
    # Each frame's own numbers are fitted to its cells, which then scatter by less.
    cells, left = problem.influence.shape[1], problem.influence.shape[1] - NUMBERS
    if left > 0:
        scatter = cells * cells / left * float(np.var(heavy @ problem.influence))
        beyond = max(scatter - float(heavy @ problem.known @ heavy), 0.0)
        doubt += 2 * scatter**2 / left if beyond else 0.0
    total = first + beyond
    return float(total), float(2 * total**2 / doubt) if doubt > 0 else np.inf


def _against(own: Account, base: Account) -> tuple[float, float]:
    """t and degrees of freedom of a law that has no neutral strength: of the part α of the way from the base's rows to
    its own, beside the base's parameters (Davidson & MacKinnon 1981, doi:10.2307/1911522)."""
    way = predicted(own.mean, own.theta) - predicted(base.mean, base.theta)
    slopes = np.concatenate([base.slopes, way[:, None]], 1)
    known, began = base.mean.problem.known, base.found
    found = mixed.estimate(known, began.components, slopes, base.rest, began.tau, restricted=True)
    variance, freedom = _error_of(base._replace(found=found), slopes, slopes.shape[1] - 1)
    size = float(mixed.reckoned(found, slopes)[1][-1] @ base.rest)
    return size / float(np.sqrt(variance)), freedom
