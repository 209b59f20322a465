"""Findings of an analysis of spot frames: which effects are named, how large they are, and how far the gap closes."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from spotcheck.discrepancy.advice import PresentFits, advise
from spotcheck.discrepancy.analysis import Analysis, measure_scatter
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.discrepancy.detection import deviate_test, measure_rms, measure_unexplained, test_residuals
from spotcheck.discrepancy.findings import (
    Consistency,
    Findings,
    Gap,
    LawShift,
    LearnedLight,
    NamedEffect,
    ParameterValue,
    ResidualTest,
    SensorPull,
    Unexplained,
)
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.laws import LawFit, NamedLaw
from spotcheck.discrepancy.learned_light import describe_light
from spotcheck.discrepancy.limits import find_limits, list_not_assessed
from spotcheck.discrepancy.metric_changes import compare_metrics
from spotcheck.discrepancy.named_scatter import NamedScatter, white_noise
from spotcheck.discrepancy.nested_models import LIGHT_SHAPE
from spotcheck.discrepancy.places import KnownScatter, find_places
from spotcheck.discrepancy.residual_sums import sum_residuals
from spotcheck.discrepancy.validation import has_field
from spotcheck.discrepancy.verdict import LEARNED_SHAPE
from spotcheck.io import progress
from spotcheck.model.effect import AppliedEffect, Effect, RandomStep, Scope
from spotcheck.model.stage import Stage

HELD_OUT = "held-out repeats"
# Units of the numbers of a data sheet.
SENSOR_UNITS = {"gain_dn_per_e": "DN/e-", "black_level_dn": "DN"}


def conclude(analysis: Analysis, effects: Sequence[Effect], remarks: Sequence[str] = ()) -> Findings:
    """Return what an analysis of spot frames found.

    Parameters
    ----------
    analysis : Analysis
        The analysis.
    effects : sequence of Effect
        Effects that were looked for.
    remarks : sequence of str
        What a reader should know of the data.
    """
    progress.begin_step("measuring what is left and its limits", 0.85, 1.0)
    prepared, fit = analysis.prepared, analysis.selected.fit
    black_dn = prepared.setting.sensor.black_level_dn
    sums = sum_residuals(prepared.images)
    detection = test_residuals(prepared.images, black_dn, others=_further_tests(analysis), sums=sums)
    light = _learned_light(analysis)
    named = name_effects(analysis, effects)
    names = {effect.name for effect in named}
    laws = None if analysis.laws is None else analysis.laws.fit
    present = PresentFits(fit, prepared.scales, analysis.search, laws)
    baseline = prepared.setting.baseline
    return Findings(
        has_converged=has_converged(analysis),
        detection=detection,
        rms_of_peak=measure_rms(prepared.images),
        places=find_places(prepared.images, black_dn, sums=sums),
        effects=named,
        light=light,
        sensor=_pulls(analysis),
        limits=find_limits(
            fit, names, effects, prepared.scales, baseline, analysis.search, analysis.named_scatter, analysis.withdrawn
        ),
        law=measure_law_shift(analysis),
        unexplained=_unexplained(analysis, names, black_dn),
        gap=measure_gap(analysis),
        metrics=compare_metrics(analysis.validated, prepared.unseen, analysis.named_scatter)
        if analysis.validated
        else (),
        advice=advise(named, effects, present),
        not_assessed=list_not_assessed(effects, prepared.frames.design, baseline),
        remarks=tuple(remarks),
    )


def _further_tests(analysis: Analysis) -> list[ResidualTest]:
    """Return the tests of what the declared fit was free to take up: the read noise, and laws of the spots."""
    tests = []
    prepared, setting = analysis.prepared, analysis.prepared.setting
    declared = measure_scatter(prepared.images, prepared.declared, 0)
    if declared.dark is not None:
        stderr = setting.stderr.get("read_noise_e", 0.0)
        fitted = prepared.declared.model.forward.sensor
        noise = white_noise(declared.dark, fitted, setting.sensor, stderr)
        tests.append(deviate_test("read noise", "dark pixels", noise.z))
    for law in analysis.laws.laws if analysis.laws else ():
        tests.append(deviate_test("laws of the spots", f"{law.applied.effect.law_of} of the spots", law.z))
    for scattered in analysis.named_scatter:
        if not scattered.reasons:
            tests.append(deviate_test("scatter of frames", "frames and sites", scattered.z))
    return tests


def _learned_light(analysis: Analysis) -> LearnedLight | None:
    """Return the learned shape if it stands for itself; None beside the declared shape or named static ones."""
    fit = analysis.selected.fit
    if fit.model.grid is None or (analysis.shape is not None and analysis.shape.effects):
        return None
    light = describe_light(fit, analysis.prepared.setting.baseline)
    least = LEARNED_SHAPE.parameters[0].negligible
    least = least(analysis.prepared.scales) if callable(least) else least
    is_clear = light.power > CLEAR_ERRORS * light.stderr and light.power > least
    return replace(light, gap_closed=_share(analysis, LIGHT_SHAPE)) if is_clear else None


def _pulls(analysis: Analysis) -> tuple[SensorPull, ...]:
    """Return the fitted numbers of the data sheet."""
    fit = analysis.selected.fit
    errors = _errors_of(fit, analysis.selected.covariance)
    return tuple(
        SensorPull(
            name=free.name,
            unit=SENSOR_UNITS[free.name],
            stated=free.stated,
            stated_stderr=free.stated_stderr,
            fitted=fit.model.value_of(free),
            stderr=errors[free.effect, free.name],
        )
        for free in fit.model.free
        if np.isfinite(free.stated_stderr)
    )


def _unexplained(analysis: Analysis, names: Collection[str], black_dn: float) -> Unexplained:
    """Return what is left beside all that is named."""
    scatter = analysis.scatter
    steps = [step for scattered in analysis.named_scatter if scattered.applied.effect.name in names
             for step in scattered.applied.effect.variants[scattered.applied.variant]]  # fmt: skip
    stages = {step.stage for step in steps if isinstance(step, RandomStep)}
    is_in_model = has_field(analysis.selected.fit.model)
    fields = [scatter.grains] if Stage.SPECKLE_FIELD in stages and not is_in_model else []
    fields += [scatter.gains] if Stage.PIXEL_GAIN in stages else []
    rows = scatter.dark.row.value if scatter.dark and Stage.ROW_NOISE_AND_HOT_PIXELS in stages else 0.0
    known = KnownScatter(tuple(fields), max(rows, 0.0))
    closed = analysis.validated.closed if analysis.validated else np.nan
    return replace(
        measure_unexplained(analysis.images, known),
        share=float(np.clip(1 - closed, 0.0, 1.0)),
        p_value=test_residuals(analysis.images, black_dn, known).p_value,
    )


def name_effects(analysis: Analysis, effects: Sequence[Effect]) -> tuple[NamedEffect, ...]:
    """Return all effects that are named, the one that closes most of the gap first."""
    named = [*_effects_of_mean(analysis), *_static_shapes(analysis), *_laws(analysis)]
    names = {effect.name for effect in named}
    named += [_scatter(scattered, analysis, effects) for scattered in analysis.named_scatter
              if not scattered.reasons and scattered.applied.effect.name not in names]  # fmt: skip
    return tuple(sorted(named, key=lambda effect: -np.nan_to_num(effect.gap_closed, nan=-np.inf)))


def measure_gap(analysis: Analysis) -> Gap | None:
    """Return the gap on held-out frames; None if there are none."""
    validated = analysis.validated
    if validated is None:
        return None
    before, after = validated.predictions[0], validated.predictions[-1]
    return Gap(
        before=before.gap,
        after=after.gap,
        noise_floor=after.floor,
        closed=validated.closed,
        rms_dn_before=before.rms_dn,
        rms_dn_after=after.rms_dn,
        gain=before.score - after.score,
        on=HELD_OUT,
    )


def measure_law_shift(analysis: Analysis) -> LawShift:
    """Return p1 and p2 under the declared and under the extended model; one exposure determines neither."""
    if analysis.search is None or analysis.laws is None or analysis.search.factors["exposure"].shape[1] < 2:
        return LawShift()
    numbers = replace(analysis.search.numbers, spots=analysis.prepared.declared.model.spots)
    declared = analysis.search.with_numbers(numbers).fit([])
    final = analysis.laws.fit
    return LawShift(_law_values(declared), _law_values(final), _law_errors(final))


def has_converged(analysis: Analysis) -> bool:
    """Return whether all fits have converged whose values are reported."""
    fits = analysis.selected.fit.has_converged
    return fits and (analysis.laws is None or analysis.laws.fit.has_converged)


def _law_values(fit: LawFit) -> tuple[float, float]:
    return (fit.law.p1 if ("", "p1") in fit.names else np.nan, fit.law.p2 if ("", "p2") in fit.names else np.nan)


def _law_errors(fit: LawFit) -> tuple[float, float]:
    errors: dict[tuple[str, str], float] = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    return (float(errors.get(("", "p1"), np.nan)), float(errors.get(("", "p2"), np.nan)))


def _effects_of_mean(analysis: Analysis) -> Iterator[NamedEffect]:
    """Yield the effects of the joint fit."""
    fit, selected = analysis.selected.fit, analysis.selected
    errors = _errors_of(fit, selected.covariance)
    scattered = {named.applied.effect.name: named for named in analysis.named_scatter}
    for applied in fit.model.forward.effects:
        name = applied.effect.name
        test = selected.tests[name]
        values = _values(
            applied, {parameter: errors.get((name, parameter), np.nan) for parameter in applied.parameters}
        )
        # The fit of the mean image knows nothing of the correlation of a field.
        of_field = scattered[name].intervals if name in scattered else {}
        for parameter in values.keys() & of_field.keys():
            if (name, parameter) not in errors:
                values[parameter] = ParameterValue(
                    of_field[parameter].value, of_field[parameter].stderr, values[parameter].unit
                )
        yield NamedEffect(
            applied=applied,
            values=values,
            gain=test.gain,
            z=float(np.sqrt(test.wald)),
            consistency=Consistency(test.heterogeneity, test.cells, test.limit, test.passes),
            rivals=selected.rivals.get(name, {}),
            gap_closed=_share(analysis, name),
        )


def _static_shapes(analysis: Analysis) -> Iterator[NamedEffect]:
    """Yield the static shapes that a learned light shape is explained by."""
    shape = analysis.shape
    if shape is None:
        return
    errors = dict(zip(shape.names, np.sqrt(np.diag(shape.covariance)), strict=True))
    for number, applied in enumerate(shape.effects):
        name, strength = applied.effect.name, applied.effect.parameters[0].name
        stderr = errors.get((name, strength), np.nan)
        distance = abs(applied.values[0] - applied.effect.vanishes_at)
        of_effect = {parameter: errors.get((name, parameter), np.nan) for parameter in applied.parameters}
        yield NamedEffect(
            applied=applied,
            values=_values(applied, of_effect),
            gain=shape.drops[number],
            z=float(distance / stderr),
            # What the shape closes is told of the first.
            gap_closed=_share(analysis, LIGHT_SHAPE) if number == 0 else np.nan,
        )


def _laws(analysis: Analysis) -> Iterator[NamedEffect]:
    """Yield the laws of brightness and width."""
    if analysis.laws is None:
        return
    laws = [law for law in analysis.laws.laws if not law.reasons]
    for law in laws:
        name = law.applied.effect.name
        yield NamedEffect(
            applied=law.applied,
            values=_values(law.applied, {key: interval.stderr for key, interval in law.intervals.items()}),
            gain=law.gain,
            z=law.z,
            rivals=_rival_laws(law, laws, analysis.laws.rivals),
            gap_closed=_share(analysis, name),
        )


def _rival_laws(law: NamedLaw, laws: Sequence[NamedLaw], rivals: Mapping[tuple[str, ...], float]) -> dict[str, float]:
    """Return the laws that may stand in place of one: those of a rival set that lacks it."""
    names = {other.applied.effect.name for other in laws}
    found: dict[str, float] = {}
    for others, behind in rivals.items():
        if law.applied.effect.name not in others:
            for name in set(others) - names:
                found[name] = min(behind, found.get(name, np.inf))
    return found


def _scatter(scattered: NamedScatter, analysis: Analysis, effects: Sequence[Effect]) -> NamedEffect:
    """Return an effect that scatters. Where each site has one frame, scatter of frames is scatter of sites."""
    applied = scattered.applied
    design = analysis.prepared.frames.design
    rivals = dict.fromkeys(scattered.rivals, 0.0)
    if design.sites == len(design.site):
        rivals |= {effect.name: 0.0 for effect in effects if effect is not applied.effect
                  and _scatters_alike(applied, effect)}  # fmt: skip
    return NamedEffect(
        applied=applied,
        values=_values(applied, {name: interval.stderr for name, interval in scattered.intervals.items()}),
        gain=float(scattered.z**2),
        z=scattered.z,
        rivals=rivals,
        gap_closed=_share(analysis, applied.effect.name),
    )


def _scatters_alike(applied: AppliedEffect, other: Effect) -> bool:
    """Return whether another effect draws for sites what an effect draws for frames, at a stage of both."""
    stages = {step.stage for step in applied.effect.variants[applied.variant]
              if isinstance(step, RandomStep) and step.scope is Scope.FRAME}  # fmt: skip
    steps = [step for steps in other.variants.values() for step in steps]
    return any(isinstance(step, RandomStep) and step.scope is Scope.SITE and step.stage in stages for step in steps)


def _share(analysis: Analysis, name: str) -> float:
    return np.nan if analysis.validated is None else analysis.validated.share_of(name)


def _errors_of(fit: JointFit, covariance: np.ndarray) -> dict[tuple[str, str], float]:
    """Return the standard errors of the fitted parameters by (effect, parameter)."""
    errors = np.sqrt(np.diag(covariance)) if covariance.size else np.zeros(0)
    return {(free.effect, free.name): float(error) for free, error in zip(fit.model.free, errors, strict=True)}


def _values(applied: AppliedEffect, errors: Mapping[str, float]) -> dict[str, ParameterValue]:
    """Return the reported parameters of an effect: all but the constants of its variant."""
    values = applied.parameters
    return {
        parameter.name: ParameterValue(
            float(values[parameter.name] % 360 if parameter.unit == "deg" else values[parameter.name]),
            float(errors.get(parameter.name, np.nan)),
            parameter.unit,
        )
        for parameter in applied.effect.parameters_of(applied.variant)
        if not parameter.is_variant_specific
    }
