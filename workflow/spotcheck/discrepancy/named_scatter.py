"""Random effects: names from the vocabulary for the measured scatter of dark pixels, fields and spots.

A random step of an effect draws a number or a field at a stage of the image chain, anew for each frame, for each site
or once for the sensor (its scope). An effect explains a measured scatter if its random steps have the same stages and
scopes. The `quadrature` of a step gives nodes and weights for means over its draw in a pixel; its first parameter is
the standard deviation of the draw. A further parameter of the draw is the standard deviation [px] of the correlation of
a field. A parameter that no step has is the number of hot pixels.

`DarkNoise` has variances and covariances [DN²] of dark pixels, each with `value` and `stderr`: `white` of single
pixels, `row` of what a row shares, `neighbour` of neighbours in a row, `next_row` of neighbouring rows, and `same_row`
of the same row in different frames. A `FieldEstimate` has the relative `variance` of a field with its `stderr`.
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

# Noise is not white, or not common to a row, if the covariance that should be the same (or 0) is off by more than
# MISFIT_SHARE of the variance plus MISFIT_SD standard errors.
MISFIT_SHARE, MISFIT_SD = 0.15, 4.0
# Least number of hot pixels that makes an effect of hot pixels named.
FEWEST_HOT = 3


@dataclass(frozen=True)
class NamedScatter:
    """A random effect that explains a measured scatter, and whether it is named."""

    applied: AppliedEffect  # the effect with its measured values
    intervals: dict[str, Interval]  # 95 % intervals of its parameters by name, in their units
    z: float  # variance in standard errors, or the root of the gain in −2 ln L
    reasons: tuple[str, ...]  # reasons against naming it; empty if it is named
    grain_px: float = np.nan  # standard deviation of the correlation of its field [px]; NaN without a field
    rivals: tuple[str, ...] = ()  # names of effects that explain the same scatter

    @property
    def drawn_at(self) -> frozenset[tuple[Stage, Scope]]:
        """Stage and scope of each random step of the effect."""
        steps = self.applied.effect.variants[self.applied.variant]
        return frozenset((step.stage, step.scope) for step in steps if isinstance(step, RandomStep))

    @staticmethod
    def parameter_of(step: RandomStep) -> str:
        """Return the name of the parameter that is the standard deviation of what a step draws."""
        return keyword_names_of(step.quadrature)[0]


@dataclass(frozen=True)
class Deviation:
    """Measured standard deviation of what a random step draws."""

    interval: Interval  # standard deviation with its 95 % interval
    z: float  # variance in standard errors, or the root of the gain in −2 ln L
    reasons: tuple[str, ...]  # reasons against it; empty if it is accepted
    grain_px: float = np.nan  # standard deviation of the correlation of a field [px]; NaN without a field


def name_scatter(
    effects: Sequence[Effect],
    deviations: Mapping[tuple[Stage, Scope], Deviation],
    hot_pixels: int,
    scales: EffectScales,
) -> list[NamedScatter]:
    """Return the effects all of whose steps are random and explain measured deviations, in the order of `effects`.

    Parameters
    ----------
    effects : sequence of Effect
        Effects of the vocabulary. The first variant of each that fits is taken.
    deviations : mapping
        Measured deviations by stage and scope.
    hot_pixels : int
        Number of hot pixels.
    scales : EffectScales
        Sizes of the dataset, from which the sizes that are negligible follow.
    """
    named_effects = []
    for effect in effects:
        for variant, steps in effect.variants.items():
            random_steps = [step for step in steps if isinstance(step, RandomStep)]
            measured = [deviations[key] for step in random_steps if (key := (step.stage, step.scope)) in deviations]
            if random_steps and len(steps) == len(random_steps) == len(measured):
                named = _name_steps(effect, variant, dict(zip(random_steps, measured, strict=True)), hot_pixels, scales)
                named_effects += [named] if named else []
                break
    return _mark_rivals(named_effects)


def _mark_rivals(effects: Sequence[NamedScatter]) -> list[NamedScatter]:
    """Return the effects; of several named ones that explain the same scatter, only the first stays named.

    It gets the others as rivals, and these get a reason.
    """
    marked = []
    for k, named in enumerate(effects):
        same = [j for j, other in enumerate(effects) if not other.reasons and other.drawn_at == named.drawn_at]
        names = [effects[j].applied.effect.name for j in same]
        if k not in same or len(same) == 1:
            marked.append(named)
        elif k == same[0]:
            marked.append(replace(named, rivals=tuple(names[1:])))
        else:
            marked.append(replace(named, reasons=(f"same scatter as {names[0]}",)))
    return marked


def _name_steps(
    effect: Effect, variant: Enum, measured: Mapping[RandomStep, Deviation], hot_pixels: int, scales: EffectScales
) -> NamedScatter | None:
    """Return an effect with the measured values of its random steps; None if a parameter has no finite value.

    `measured` has the steps of the variant; other arguments are those of `name_scatter`. The step with the largest z
    decides on its reasons.
    """
    intervals: dict[str, Interval] = {}
    for step, deviation in measured.items():
        name = NamedScatter.parameter_of(step)
        intervals[name] = deviation.interval
        for extra in set(keyword_names_of(step.draw)) - {name}:
            intervals[extra] = Interval.around(deviation.grain_px, np.nan)
    strongest = max(measured.values(), key=lambda deviation: deviation.z)
    # In this order a z of NaN counts as 0.
    z = max(0.0, *(deviation.z for deviation in measured.values()))
    reasons = list(strongest.reasons) + (["z below the least"] if not z >= MIN_Z else [])
    # A parameter that no step has is a number of hot pixels, with the error of a count.
    counts = [p.name for p in effect.parameters_of(variant) if p.name not in intervals]
    intervals |= {name: Interval.around(hot_pixels, np.sqrt(hot_pixels)) for name in counts}
    if not np.isfinite([interval.value for interval in intervals.values()]).all():
        return None
    values = tuple(intervals[p.name].value if p.name in intervals else np.nan for p in effect.parameters)
    applied = AppliedEffect(effect, variant, values)
    # Parameters without a negligible size do not count.
    sizes = _negligible_sizes(effect, scales)
    is_below = [value < size for value, size in zip(values, sizes, strict=True) if size > 0]
    if is_below and all(is_below):
        reasons.append("negligible")
    if counts and hot_pixels >= FEWEST_HOT:
        # Hot pixels were found one by one: their number alone is evidence.
        reasons = []
    return NamedScatter(applied, intervals, z, tuple(reasons), strongest.grain_px)


def _negligible_sizes(effect: Effect, scales: EffectScales) -> list[float]:
    """Return the size of each parameter below which a user would call it nothing, in its unit; 0 if there is none."""
    return [p.negligible(scales) if callable(p.negligible) else p.negligible for p in effect.parameters]


@dataclass(frozen=True)
class WhiteNoise:
    """Read noise that dark pixels show, without the part that is common to rows or columns."""

    total_e: float  # read noise [e- rms]
    stderr_e: float  # its standard error [e-]
    z: float  # excess of its variance over that of the stated read noise, in standard errors of both
    is_shared: bool  # whether neighbours in a row share more noise than whole rows do, so that it is not white


def white_noise(
    dark: DarkNoise, fitted: SensorModel, stated: SensorModel, stated_stderr: float, variance_by_parameters: float = 0.0
) -> WhiteNoise:
    """Return the read noise of dark pixels.

    Parameters
    ----------
    dark : DarkNoise
        Noise of dark pixels beyond that of the fitted sensor.
    fitted, stated : SensorModel
        Sensor of the fit, and that of the data sheet.
    stated_stderr : float
        Standard error of the stated read noise [e-].
    variance_by_parameters : float
        Result of `propagate_to_noise` [DN⁴]; 0 if no other parameters were fitted.
    """
    gain = stated.gain_dn_per_e
    white = (gain * fitted.read_noise_e) ** 2 + dark.white.value
    excess = white - (gain * stated.read_noise_e) ** 2
    # Error of the stated variance [DN²], by propagation.
    stated_error = 2 * gain**2 * stated.read_noise_e * stated_stderr
    total_e = float(np.sqrt(max(white, 0.0)) / gain)
    shared_excess = abs(dark.neighbour.value - dark.row.value)
    is_shared = shared_excess > MISFIT_SHARE * max(excess, 0.0) + MISFIT_SD * dark.neighbour.stderr
    stderr = float(np.hypot(dark.white.stderr, np.sqrt(variance_by_parameters)))
    stderr_e = stderr / (2 * gain**2 * max(total_e, 1e-9))
    return WhiteNoise(total_e, stderr_e, excess / float(np.hypot(stderr, stated_error)), is_shared)


def name_read_noise(
    effects: Sequence[Effect], noise: WhiteNoise, stated: SensorModel, scales: EffectScales
) -> list[NamedScatter]:
    """Return the effects that set the read noise, with the value that dark pixels show.

    They have one step, which is not random, at the stage of the read noise. `stated` is the sensor of the data sheet.
    """
    reasons = [] if noise.z >= MIN_Z else ["z below the least"]
    if noise.is_shared:
        reasons.append("neighbours share it: not white")
    interval = Interval.around(noise.total_e, noise.stderr_e)
    named_effects = []
    for effect in effects:
        for variant, steps in effect.variants.items():
            if [step.stage for step in steps] == [Stage.READ_NOISE] and isinstance(steps[0], Step):
                is_small = noise.total_e - stated.read_noise_e < _negligible_sizes(effect, scales)[0]
                reasons_against = (*reasons, "negligible") if is_small else tuple(reasons)
                applied = AppliedEffect(effect, variant, (noise.total_e,))
                intervals = {effect.parameters[0].name: interval}
                named_effects.append(NamedScatter(applied, intervals, noise.z, reasons_against))
    return named_effects


def deviation_of_field(field: FieldEstimate) -> Deviation:
    """Return the standard deviation of a relative field [1], such as granular light or gains of pixels."""
    interval = deviation_interval(field.variance, field.stderr**2)
    return Deviation(interval, field.variance / field.stderr, field.reasons, field.grain_px)


def deviation_of_rows(dark: DarkNoise) -> Deviation:
    """Return the standard deviation [DN] of the noise that is common to a row of a frame.

    It is not accepted if rows share it with their neighbours, if it varies along a row, or if it repeats in all frames.
    """
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
    """Return the standard deviation of a property of the spot; its z is the root of the gain."""
    return Deviation(fluctuation.deviation, float(np.sqrt(max(fluctuation.gain, 0.0))), fluctuation.reasons)
