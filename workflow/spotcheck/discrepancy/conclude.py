"""Findings of an analysis of spot frames: which effects are named, how large they are, and how far the gap closes.

A named effect is one that the verdict reports as present. The gap is the squared residual on held-out frames beyond
noise; the share of an effect is the part of the gap that it closes. A law is an effect that changes only brightness and
width of the spots, from frame to frame. p1 and p2 [px] are the parameters of the exposure law of the width,
σ = laser width + p1 ln t + p2. A free light shape has fitted values at nodes, in place of the declared shape of the
instrument. A static shape is an effect that changes the light in the same way in every frame, so that it may explain a
free shape. Scatter is the random variation of pixels, frames or sites that a random effect may explain.

An `Analysis` has the frames with the fit of the declared model (`prepared`) and the final fit with tests of its effects
(`selected`). The residuals of the declared fit are `prepared.images`, those of the final fit `images`. It also has the
scatter, the laws, and the predictions of held-out frames (`validated`).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from spotcheck.characterization.sensor_choice import SHEET
from spotcheck.discrepancy import findings
from spotcheck.discrepancy.advice import PresentFits, advise
from spotcheck.discrepancy.analysis import Analysis
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.discrepancy.detection import deviate_test, measure_unexplained, test_residuals
from spotcheck.discrepancy.evidence import is_negligible
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.laws import LawFit, LawParameter, NamedLaw
from spotcheck.discrepancy.learned_light import describe_light
from spotcheck.discrepancy.limits import find_limits, list_not_assessed
from spotcheck.discrepancy.metric_changes import compare_metrics
from spotcheck.discrepancy.named_scatter import NamedScatter, white_noise
from spotcheck.discrepancy.nested_models import LIGHT_SHAPE
from spotcheck.discrepancy.places import KnownScatter, find_places
from spotcheck.discrepancy.residual_sums import sum_residuals
from spotcheck.discrepancy.scatter import measure_dark_noise, measure_dark_slopes
from spotcheck.discrepancy.validation import has_field
from spotcheck.discrepancy.verdict import effect_of_light
from spotcheck.io import progress
from spotcheck.model.effect import AppliedEffect, Effect, RandomStep, Scope
from spotcheck.model.stage import Stage

# Data on which the gap is measured, in words.
HELD_OUT = "held-out repeats"
# Units of the fitted sensor parameters, by field of `SensorModel`.
SENSOR_UNITS = {"gain_dn_per_e": "DN/e-", "black_level_dn": "DN"}


def conclude(analysis: Analysis, effects: Sequence[Effect], remarks: Sequence[str] = ()) -> findings.Findings:
    """Return the findings of an analysis of spot frames, with upper limits and advice, which are computed here.

    Parameters
    ----------
    analysis : Analysis
        Result of `analyse_frames`.
    effects : sequence of Effect
        Effects that were searched for.
    remarks : sequence of str
        Sentences on the data that the verdict repeats.
    """
    progress.begin_step("measuring what is left and its limits", 0.85, 1.0)
    prepared, fit, validated = analysis.prepared, analysis.selected.fit, analysis.validated
    black_dn = prepared.setting.sensor.black_level_dn
    sums = sum_residuals(prepared.images)
    detection = test_residuals(prepared.images, black_dn, others=_further_tests(analysis), sums=sums)
    light = _learned_light(analysis)
    named = name_effects(analysis, effects)
    names = {effect.name for effect in named}
    laws = None if analysis.laws is None else analysis.laws.fit
    present = PresentFits(fit, prepared.scales, analysis.search, laws)
    return findings.Findings(
        has_converged=fit.has_converged and (laws is None or laws.has_converged),
        detection=detection,
        rms_of_peak=measure_unexplained(prepared.images).size,
        places=find_places(prepared.images, black_dn, sums=sums),
        effects=named,
        light=light,
        sensor=_pulls(analysis),
        limits=find_limits(analysis, names, effects),
        law=measure_law_shift(analysis),
        unexplained=_unexplained(analysis, names, black_dn),
        gap=measure_gap(analysis),
        metrics=compare_metrics(validated, prepared.unseen, analysis.named_scatter) if validated else (),
        advice=advise(named, effects, present),
        not_assessed=list_not_assessed(effects, prepared.frames.design, prepared.setting.baseline),
        remarks=tuple(remarks),
    )


def _further_tests(analysis: Analysis) -> list[findings.ResidualTest]:
    """Return tests of properties that residuals do not show, since the declared fit adapts to them.

    These are the read noise, the laws of the spots, and the scatter of frames and sites.
    """
    tests = []
    prepared, setting = analysis.prepared, analysis.prepared.setting
    dark = measure_dark_noise(prepared.images, measure_dark_slopes(prepared.declared.model.forward))
    if dark is not None:
        stderr = setting.stderr.get("read_noise_e", 0.0)
        noise = white_noise(dark, prepared.declared.model.forward.sensor, setting.sensor, stderr)
        tests.append(deviate_test("read noise", "dark pixels", noise.z))
    for law in analysis.laws.laws if analysis.laws else ():
        tests.append(deviate_test("laws of the spots", f"{law.applied.effect.law_of} of the spots", law.z))
    for scatter in analysis.named_scatter:
        if not scatter.reasons:
            tests.append(deviate_test("scatter of frames", "frames and sites", scatter.z))
    return tests


def _learned_light(analysis: Analysis) -> findings.LearnedLight | None:
    """Return the fitted free shape if it is significant and not negligible.

    None if the fit has the declared shape, or if named static shapes explain the free one.
    """
    fit = analysis.selected.fit
    if fit.model.grid is None or analysis.shape is not None:
        return None
    light = describe_light(fit, analysis.prepared.setting.baseline)
    is_small = is_negligible(effect_of_light(light).applied, analysis.prepared.scales)
    is_clear = light.power > CLEAR_ERRORS * light.stderr and not is_small
    return replace(light, gap_closed=_share(analysis, LIGHT_SHAPE)) if is_clear else None


def _pulls(analysis: Analysis) -> tuple[findings.SensorPull, ...]:
    """Return the parameters of the sensor that were fitted with the stated or measured value as a prior."""
    fit, sources = analysis.selected.fit, analysis.prepared.setting.sources
    errors = _errors_of(fit, analysis.selected.covariance)
    pulls = []
    for free in fit.model.free:
        if not np.isfinite(free.stated_stderr):
            continue
        pull = findings.SensorPull(
            name=free.name,
            unit=SENSOR_UNITS[free.name],
            stated=free.stated,
            stated_stderr=free.stated_stderr,
            fitted=fit.model.value_of(free),
            stderr=errors[free.effect, free.name],
            source=sources.get(free.name, SHEET),
        )
        stderr = pull.stderr if pull.is_independent else error_without_prior(pull.stderr, pull.stated_stderr)
        if free.name == "gain_dn_per_e":
            stderr = float(np.hypot(stderr, pull.fitted * absorbed_noise(fit)))
        pulls.append(replace(pull, stderr=stderr))
    return tuple(pulls)


def error_without_prior(stderr: float, prior_stderr: float) -> float:
    """Return the standard error that the frames alone give; at most that of the prior, measured in the same frames.

    `stderr` is that of the fit with the prior.
    """
    information = 1 / stderr**2 - 1 / prior_stderr**2
    return min(float(information**-0.5), prior_stderr) if information > 0 else prior_stderr


def absorbed_noise(fit: JointFit) -> float:
    """Return the part of the variance of the spot that the free light shape of a fit absorbs; 0 without a free shape.

    It is the number of coefficients of the shape over that of the fitted readings in the same area. The maximum of the
    likelihood lowers the gain by up to this part: in Gaussian spots by 4 % of 12 %, and by 9 % of 15 %.
    """
    if fit.model.grid is None:
        return 0.0
    pixels = (fit.model.grid.step * np.exp(fit.model.spots.log_sigma)) ** 2 * fit.pixels.share
    return min(1 / float(pixels.sum()), 1.0)


def _unexplained(analysis: Analysis, names: Collection[str], black_dn: float) -> findings.Unexplained:
    """Return the residual of the mean image about the final fit, beyond noise and named scatter.

    Its size is in parts of the peak. `names` are the named effects, `black_dn` is the black level [DN].
    """
    scatter = analysis.scatter
    steps = [step for random_effect in analysis.named_scatter if random_effect.applied.effect.name in names
             for step in random_effect.applied.effect.variants[random_effect.applied.variant]]  # fmt: skip
    stages = {step.stage for step in steps if isinstance(step, RandomStep)}
    # The weights of the residuals contain granular light already if it is an effect of the fitted model.
    is_in_model = has_field(analysis.selected.fit.model)
    fields = [scatter.grains] if Stage.SPECKLE_FIELD in stages and not is_in_model else []
    fields += [scatter.gains] if Stage.PIXEL_GAIN in stages else []
    row_variance = scatter.dark.row.value if scatter.dark and Stage.ROW_NOISE_AND_HOT_PIXELS in stages else 0.0
    known_scatter = KnownScatter(tuple(fields), max(row_variance, 0.0))
    closed_share = analysis.validated.closed if analysis.validated else np.nan
    return replace(
        measure_unexplained(analysis.images, known_scatter),
        share=float(np.clip(1 - closed_share, 0.0, 1.0)),
        p_value=test_residuals(analysis.images, black_dn, known_scatter).p_value,
    )


def name_effects(analysis: Analysis, effects: Sequence[Effect]) -> tuple[findings.NamedEffect, ...]:
    """Return all effects that the frames show, the one that closes most of the gap first.

    Effects with an unknown share of the gap come last. `effects` are those that were searched for.
    """
    named = [*_effects_of_mean(analysis), *_static_shapes(analysis), *_laws(analysis)]
    names = {effect.name for effect in named}
    named += [_scatter_effect(scatter, analysis, effects) for scatter in analysis.named_scatter
              if not scatter.reasons and scatter.applied.effect.name not in names]  # fmt: skip
    return tuple(sorted(named, key=lambda effect: -np.nan_to_num(effect.gap_closed, nan=-np.inf)))


def measure_gap(analysis: Analysis) -> findings.Gap | None:
    """Return the gap on held-out frames under the declared and the extended model; None without held-out frames."""
    validated = analysis.validated
    if validated is None:
        return None
    before, after = validated.predictions[0], validated.predictions[-1]
    return findings.Gap(
        before=before.gap,
        after=after.gap,
        noise_floor=after.floor,
        closed=validated.closed,
        rms_dn_before=before.rms_dn,
        rms_dn_after=after.rms_dn,
        gain=before.score - after.score,
        on=HELD_OUT,
    )


def measure_law_shift(analysis: Analysis) -> findings.LawShift:
    """Return p1 and p2 [px] under the declared and under the extended model.

    All values are NaN without a search for laws, or with fewer than two exposures, which determine neither parameter.
    """
    # The columns of the factor "exposure" are its distinct exposures.
    if analysis.search is None or analysis.laws is None or analysis.search.factors["exposure"].shape[1] < 2:
        return findings.LawShift()
    measurements = replace(analysis.search.measurements, spots=analysis.prepared.declared.model.spots)
    declared, extended = analysis.search.with_measurements(measurements).fit([]), analysis.laws.fit
    errors = dict(zip(extended.names, np.sqrt(np.diag(extended.covariance)), strict=True))
    p1, p2 = LawParameter("", "p1"), LawParameter("", "p2")

    def values_of(fit: LawFit) -> tuple[float, float]:
        """Return p1 and p2; NaN if they were not fitted."""
        return (fit.law.p1 if p1 in fit.names else np.nan, fit.law.p2 if p2 in fit.names else np.nan)

    return findings.LawShift(values_of(declared), values_of(extended), (errors.get(p1, np.nan), errors.get(p2, np.nan)))


def _effects_of_mean(analysis: Analysis) -> Iterator[findings.NamedEffect]:
    """Yield the effects of the mean image: those of the final joint fit."""
    fit, selected = analysis.selected.fit, analysis.selected
    errors = _errors_of(fit, selected.covariance)
    scatter_by_name = {scatter.applied.effect.name: scatter for scatter in analysis.named_scatter}
    for applied in fit.model.forward.effects:
        name = applied.effect.name
        test = selected.tests[name]
        effect_errors = {parameter: errors.get((name, parameter), np.nan) for parameter in applied.parameters}
        values = _values(applied, effect_errors)
        # Parameters that the mean image does not determine, such as the grain of a field, come from its scatter.
        intervals = scatter_by_name[name].intervals if name in scatter_by_name else {}
        for parameter in values.keys() & intervals.keys():
            if (name, parameter) not in errors:
                interval = intervals[parameter]
                values[parameter] = findings.ParameterValue(interval.value, interval.stderr, values[parameter].unit)
        yield findings.NamedEffect(
            applied=applied,
            values=values,
            gain=test.gain,
            z=float(np.sqrt(test.wald)),
            consistency=findings.Consistency(test.heterogeneity, test.cells, test.limit, test.passes),
            rivals=selected.rivals.get(name, {}),
            gap_closed=_share(analysis, name),
        )


def _static_shapes(analysis: Analysis) -> Iterator[findings.NamedEffect]:
    """Yield the static shapes that together explain the free light shape; none if the fit has the declared shape."""
    shape = analysis.shape
    if shape is None:
        return
    for k, applied in enumerate(shape.effects):
        name, strength = applied.effect.name, applied.effect.parameters[0].name
        stderr = shape.errors.get((name, strength), np.nan)
        distance = abs(applied.values[0] - applied.effect.vanishes_at)
        effect_errors = {parameter: shape.errors.get((name, parameter), np.nan) for parameter in applied.parameters}
        yield findings.NamedEffect(
            applied=applied,
            values=_values(applied, effect_errors),
            gain=shape.drops[k],
            z=float(distance / stderr),
            # The share of the gap is known of the whole shape only; the first effect carries it.
            gap_closed=_share(analysis, LIGHT_SHAPE) if k == 0 else np.nan,
        )


def _laws(analysis: Analysis) -> Iterator[findings.NamedEffect]:
    """Yield the named laws of brightness and width."""
    if analysis.laws is None:
        return
    laws = [law for law in analysis.laws.laws if not law.reasons]
    for law in laws:
        yield findings.NamedEffect(
            applied=law.applied,
            values=_values(law.applied, {name: interval.stderr for name, interval in law.intervals.items()}),
            gain=law.gain,
            z=law.z,
            rivals=_rival_laws(law, laws, analysis.laws.rivals),
            gap_closed=_share(analysis, law.applied.effect.name),
        )


def _rival_laws(law: NamedLaw, laws: Sequence[NamedLaw], rivals: Mapping[tuple[str, ...], float]) -> dict[str, float]:
    """Return the laws that may replace a law: those of a rival set that lacks it, less the named laws.

    `rivals` has sets of laws by their names, with the excess of χ² over the best set. The result is the least such
    excess of each law.
    """
    names = {other.applied.effect.name for other in laws}
    excess_of: dict[str, float] = {}
    for rival_names, excess in rivals.items():
        if law.applied.effect.name not in rival_names:
            for name in set(rival_names) - names:
                excess_of[name] = min(excess, excess_of.get(name, np.inf))
    return excess_of


def _scatter_effect(scatter: NamedScatter, analysis: Analysis, effects: Sequence[Effect]) -> findings.NamedEffect:
    """Return the named effect of a scatter.

    If each site has one frame, scatter of frames cannot be distinguished from scatter of sites: effects of the latter
    are rivals then.
    """
    applied = scatter.applied
    design = analysis.prepared.frames.design
    rivals = dict.fromkeys(scatter.rivals, 0.0)
    if design.sites == len(design.site):
        rivals |= {effect.name: 0.0 for effect in effects if effect is not applied.effect
                  and _scatters_alike(applied, effect)}  # fmt: skip
    return findings.NamedEffect(
        applied=applied,
        values=_values(applied, {name: interval.stderr for name, interval in scatter.intervals.items()}),
        # z is the root of the gain, or the variance in standard errors, which approximates it (Wald).
        gain=float(scatter.z**2),
        z=scatter.z,
        rivals=rivals,
        gap_closed=_share(analysis, applied.effect.name),
    )


def _scatters_alike(applied: AppliedEffect, other: Effect) -> bool:
    """Return whether an effect draws per frame, and another one per site, at the same stage of the model."""
    stages = {step.stage for step in applied.effect.variants[applied.variant]
              if isinstance(step, RandomStep) and step.scope is Scope.FRAME}  # fmt: skip
    steps = [step for steps in other.variants.values() for step in steps]
    return any(isinstance(step, RandomStep) and step.scope is Scope.SITE and step.stage in stages for step in steps)


def _share(analysis: Analysis, name: str) -> float:
    """Return the part of the gap that an effect closes; NaN without held-out frames."""
    return np.nan if analysis.validated is None else analysis.validated.share_of(name)


def _errors_of(fit: JointFit, covariance: np.ndarray) -> dict[tuple[str, str], float]:
    """Return the standard errors of the fitted parameters by (effect, parameter); the effect is "" for the sensor.

    `covariance` [parameter, parameter] is that of the parameters `fit.model.free` of sensor and effects.
    """
    errors = np.sqrt(np.diag(covariance)) if covariance.size else np.zeros(0)
    return {(free.effect, free.name): float(error) for free, error in zip(fit.model.free, errors, strict=True)}


def _values(applied: AppliedEffect, errors: Mapping[str, float]) -> dict[str, findings.ParameterValue]:
    """Return the reported parameters of an effect with their standard errors: all but the constants of its variant.

    Parameters without an error have NaN.
    """
    values, parameters = applied.parameters, applied.effect.parameters_of(applied.variant)
    return {
        parameter.name: findings.ParameterValue(
            values[parameter.name], errors.get(parameter.name, np.nan), parameter.unit
        )
        for parameter in parameters
        if not parameter.is_variant_specific
    }
