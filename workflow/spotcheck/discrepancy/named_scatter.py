"""Effects that scatter: what dark pixels, fields and fluctuations are called by the effects of the vocabulary.

An effect stands for a scatter by the stage and the scope of its random step. The parameter of the step's quadrature is
the standard deviation of what it draws; a further parameter of its draw is the standard deviation of the correlation
[px]; a parameter that no step takes is the number of hot pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from spotcheck.discrepancy.criteria import MIN_Z
from spotcheck.discrepancy.fields import FieldEstimate
from spotcheck.discrepancy.fluctuations import Fluctuation
from spotcheck.discrepancy.mixed_model import Interval, deviation_interval
from spotcheck.discrepancy.scatter import DarkNoise
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep, Scope, Step, keyword_names_of
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Part of a variance of lines or pixels that neighbours may have more or less of it, and the standard errors beyond.
MISFIT_SHARE, MISFIT_SD = 0.15, 4.0
# Hot pixels that make a pattern.
FEWEST_HOT = 3


@dataclass(frozen=True)
class NamedScatter:
    """An effect that scatters."""

    applied: AppliedEffect  # with its values
    intervals: dict[str, Interval]  # of its parameters
    z: float  # of its variance, or the root of its gain in −2 ln L
    reasons: tuple[str, ...]  # against naming it; empty: it is named
    grain_px: float = np.nan  # standard deviation of the correlation of a field [px]; NaN if there is none
    rivals: tuple[str, ...] = ()  # effects of the vocabulary that draw at the same stages for the same frames

    @property
    def drawn_at(self) -> frozenset[tuple[Stage, Scope]]:
        """Stage and scope of each random step."""
        steps = self.applied.effect.variants[self.applied.variant]
        return frozenset((step.stage, step.scope) for step in steps if isinstance(step, RandomStep))

    @staticmethod
    def parameter_of(step: RandomStep) -> str:
        """Return the parameter that is the standard deviation of what a step draws."""
        return keyword_names_of(step.quadrature)[0]


@dataclass(frozen=True)
class Deviation:
    """Standard deviation of what a random step draws."""

    interval: Interval
    z: float
    reasons: tuple[str, ...]  # against it
    grain_px: float = np.nan  # standard deviation of its correlation [px]


def name_scatter(
    effects: Sequence[Effect],
    deviations: Mapping[tuple[Stage, Scope], Deviation],
    hot_pixels: int,
    scales: EffectScales,
) -> list[NamedScatter]:
    """Return the effects that stand for the deviations of random steps, by stage and scope."""
    found = []
    for effect in effects:
        for variant, steps in effect.variants.items():
            random = [step for step in steps if isinstance(step, RandomStep)]
            is_measured = all((step.stage, step.scope) in deviations for step in random)
            if random and len(random) == len(steps) and is_measured:
                found.append(_name_steps(effect, variant, random, deviations, hot_pixels, scales))
                break
    return _mark_rivals([named for named in found if named is not None])


def _mark_rivals(found: Sequence[NamedScatter]) -> list[NamedScatter]:
    """Return the effects with the first of several that explain the same scatter as the only one that is named."""
    marked = []
    for k, named in enumerate(found):
        alike = [j for j, other in enumerate(found) if not other.reasons and other.drawn_at == named.drawn_at]
        names = [found[j].applied.effect.name for j in alike]
        if k not in alike or len(alike) == 1:
            marked.append(named)
        elif k == alike[0]:
            marked.append(replace(named, rivals=tuple(names[1:])))
        else:
            marked.append(replace(named, reasons=(f"same scatter as {names[0]}",)))
    return marked


def _name_steps(
    effect: Effect,
    variant: Enum,
    steps: Sequence[RandomStep],
    deviations: Mapping[tuple[Stage, Scope], Deviation],
    hot_pixels: int,
    scales: EffectScales,
) -> NamedScatter | None:
    """Return the effect of some random steps; None if a parameter has no value."""
    intervals: dict[str, Interval] = {}
    z = 0.0
    for step in steps:
        deviation = deviations[step.stage, step.scope]
        name = NamedScatter.parameter_of(step)
        intervals[name] = deviation.interval
        z = max(z, deviation.z)
        for extra in set(keyword_names_of(step.draw)) - {name}:
            intervals[extra] = Interval.around(deviation.grain_px, np.nan)
    strongest = max((deviations[step.stage, step.scope] for step in steps), key=lambda deviation: deviation.z)
    counts = [p.name for p in effect.parameters_of(variant) if p.name not in intervals]
    reasons = list(strongest.reasons) + (["z below the least"] if not z >= MIN_Z else [])
    for name in counts:
        intervals[name] = Interval.around(hot_pixels, np.sqrt(hot_pixels))
    values = {name: interval.value for name, interval in intervals.items()}
    if not np.isfinite(list(values.values())).all():
        return None
    applied = AppliedEffect(effect, variant, tuple(values.get(p.name, np.nan) for p in effect.parameters))
    if is_negligible_scatter(applied, scales):
        reasons.append("negligible")
    if counts and hot_pixels >= FEWEST_HOT:
        reasons = []
    return NamedScatter(applied, intervals, z, tuple(reasons), strongest.grain_px)


def is_negligible_scatter(applied: AppliedEffect, scales: EffectScales) -> bool:
    """Return whether a user would call all deviations of an effect nothing."""
    limits = [p.negligible(scales) if callable(p.negligible) else p.negligible for p in applied.effect.parameters]
    is_below = [value < limit for value, limit in zip(applied.values, limits, strict=True) if limit > 0]
    return bool(is_below) and all(is_below)


@dataclass(frozen=True)
class WhiteNoise:
    """Read noise that dark pixels give, without what rows and columns share."""

    total_e: float  # [e- rms]
    stderr_e: float  # [e-]
    z: float  # of its excess over the stated read noise
    is_shared: bool  # whether neighbours in a row share more of it than rows do, so that it is not white


def white_noise(dark: DarkNoise, fitted: SensorModel, stated: SensorModel, stated_stderr: float) -> WhiteNoise:
    """Return the read noise of dark pixels beside a fit; `stated_stderr` [e-] is that of the data sheet."""
    gain = stated.gain_dn_per_e
    white = (gain * fitted.read_noise_e) ** 2 + dark.white.value
    excess = white - (gain * stated.read_noise_e) ** 2
    of_sheet = 2 * gain**2 * stated.read_noise_e * stated_stderr
    total = float(np.sqrt(max(white, 0.0)) / gain)
    covariance = abs(dark.neighbour.value - dark.row.value)
    is_shared = covariance > MISFIT_SHARE * max(excess, 0.0) + MISFIT_SD * dark.neighbour.stderr
    stderr_e = dark.white.stderr / (2 * gain**2 * max(total, 1e-9))
    return WhiteNoise(total, stderr_e, excess / float(np.hypot(dark.white.stderr, of_sheet)), is_shared)


def name_read_noise(
    effects: Sequence[Effect], noise: WhiteNoise, stated: SensorModel, scales: EffectScales
) -> list[NamedScatter]:
    """Return the effects of the read noise whose value dark pixels give."""
    reasons = [] if noise.z >= MIN_Z else ["z below the least"]
    if noise.is_shared:
        reasons.append("neighbours share it: not white")
    interval = Interval.around(noise.total_e, noise.stderr_e)
    found = []
    for effect in effects:
        for variant, steps in effect.variants.items():
            if [step.stage for step in steps] == [Stage.READ_NOISE] and isinstance(steps[0], Step):
                applied = AppliedEffect(effect, variant, (noise.total_e,))
                least = effect.parameters[0].negligible
                is_small = noise.total_e - stated.read_noise_e < (least(scales) if callable(least) else least)
                against = (*reasons, "negligible") if is_small else tuple(reasons)
                found.append(NamedScatter(applied, {effect.parameters[0].name: interval}, noise.z, against))
    return found


def deviation_of_field(field: FieldEstimate) -> Deviation:
    """Return the standard deviation of a relative field."""
    interval = deviation_interval(field.variance, field.stderr**2)
    return Deviation(interval, field.variance / field.stderr, field.reasons, field.grain_px)


def deviation_of_rows(dark: DarkNoise) -> Deviation:
    """Return the standard deviation of rows."""
    row = dark.row
    reasons = []
    if abs(dark.next_row.value) > MISFIT_SHARE * row.value + MISFIT_SD * dark.next_row.stderr:
        reasons.append("rows share it with their neighbours")
    if abs(dark.neighbour.value - row.value) > MISFIT_SHARE * row.value + MISFIT_SD * dark.neighbour.stderr:
        reasons.append("not the same along a row")
    if abs(dark.same_row.value) > MISFIT_SHARE * row.value:
        reasons.append("the same in every frame")
    return Deviation(deviation_interval(row.value, row.stderr**2), row.value / row.stderr, tuple(reasons))


def deviation_of_fluctuation(fluctuation: Fluctuation) -> Deviation:
    """Return the standard deviation of a property of the spot."""
    return Deviation(fluctuation.deviation, float(np.sqrt(max(fluctuation.gain, 0.0))), fluctuation.reasons)
