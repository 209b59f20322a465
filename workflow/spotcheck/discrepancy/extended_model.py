"""The extended model of a verdict: law, effects, learned light and spots, as model.yaml holds them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.analysis import Analysis, Setting
from spotcheck.discrepancy.findings import Findings, LearnedLight, NamedEffect
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import LawSearch, is_law
from spotcheck.discrepancy.spot_numbers import SpotNumbers
from spotcheck.discrepancy.starting_spots import fit_spots
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.model_file import ExtendedModel, Site, Spot, scales_of, site_of

# Smallest peak [DN] and width [px] of a spot without a law: a spot has some of both, however badly it was fitted.
LEAST = 1e-3
# A turn [deg], to which directions are brought back.
TURN = 360.0
# Residual of ln peak or ln σ of a spot that a law does not allow, and the least scale of parameters in a fit of laws.
OUT_OF_DOMAIN, LEAST_SCALE = 1e3, 0.1


@dataclass(frozen=True)
class FinalModel:
    """What a verdict makes of the mean images of all F frames."""

    forward: ForwardModel  # effects of the mean image, light and sensor as fitted; without a law
    spots: FrameParameters  # spot of each frame, of held-out ones too
    law: ExposureLaw | None  # law of the exposure beside all named laws; None if there is none

    def of_frames(self, selection: np.ndarray, design: Design) -> JointModel:
        """Return the model of some frames; `selection` are their numbers among all, `design` their conditions."""
        return JointModel(self.forward, self.spots.select(selection), design)

    def with_its_sensor(self, model: JointModel) -> JointModel:
        """Return another model with the sensor of this one, so that both are measured by the same noise."""
        return replace(model, forward=replace(model.forward, sensor=self.forward.sensor))


def fit_final_model(analysis: Analysis, findings: Findings, frames: FrameSet) -> FinalModel:
    """Return the model with all that is named, and only that; fits that the analysis has not made are made here.

    Parameters
    ----------
    analysis : Analysis
        Analysis of the frames.
    findings : Findings
        What is concluded of it.
    frames : FrameSet
        All frames, as the analysis got them.
    """
    fit, prepared = analysis.selected.fit, analysis.prepared
    explained = () if analysis.shape is None else analysis.shape.effects
    in_image = {*fit.model.effect_names, *(applied.effect.name for applied in explained)}
    effects = tuple(with_reported_values(named) for named in findings.effects if named.name in in_image)
    has_learned_light = fit.model.grid is not None and findings.light is not None
    stated = prepared.setting.baseline
    learned = fit.model.forward.baseline.learned if has_learned_light else stated.learned
    baseline = replace(stated, photon_budget="free", learned=learned)
    forward = replace(fit.model.forward, baseline=baseline, law=None, effects=effects)
    has_same_effects = {applied.effect.name for applied in effects} == set(fit.model.effect_names)
    search, spots = analysis.search, fit.model.spots
    if not has_same_effects or (fit.model.grid is not None and not has_learned_light):
        refitted = fit_spots(forward, prepared.frames, spots)
        spots = refitted.spots
        numbers = SpotNumbers(prepared.frames.design, spots, refitted.joint_covariance)
        search = search and search.with_numbers(numbers)
    is_held_out = frames.held_out()
    rows = np.empty((4, len(frames)))
    rows[:, ~is_held_out] = spots.as_rows()
    if is_held_out.any():
        rows[:, is_held_out] = fit_spots(forward, prepared.unseen, prepared.unseen_spots).spots.as_rows()
    laws = tuple(with_reported_values(named) for named in findings.effects if is_law(named.applied.effect))
    law = None if search is None else fit_exposure_law(search, laws)
    return FinalModel(forward, FrameParameters(*rows), law)


def with_reported_values(named: NamedEffect) -> AppliedEffect:
    """Return an effect with the values that a verdict reports; some may come from other fits than the effect."""
    applied = named.applied
    for name, reported in named.values.items():
        if np.isfinite(reported.value):
            applied = applied.with_value(name, reported.value)
    return applied


def fit_exposure_law(search: LawSearch, laws: tuple[AppliedEffect, ...]) -> ExposureLaw:
    """Return the law of the exposure that fits the spots best beside laws whose values are fixed.

    The rise with the exposure stays 0 if there is one exposure or if a law replaces it.
    """
    spots, laser_px = search.numbers.spots, search.forward.baseline.laser_px
    is_replaced = "p1" in {name for applied in laws for name in applied.effect.replaces}
    start = search.fit([]).law
    if is_replaced:
        start = ExposureLaw(0.0, float(np.exp(np.mean(spots.log_sigma))) - laser_px, start.peak_dn)
    has_rise = len(np.unique(search.design.exposure_s)) > 1 and not is_replaced

    def law_of(values: np.ndarray) -> ExposureLaw:
        return ExposureLaw(float(values[2]) if has_rise else start.p1, float(values[1]), float(np.exp(values[0])))

    def residual(values: np.ndarray) -> np.ndarray:
        difference = search.observations - search.mean_of(replace(search.forward, law=law_of(values), effects=laws))
        # Outside the domain of the law every value is as bad.
        return search.whitening @ np.where(np.isfinite(difference), difference, OUT_OF_DOMAIN)

    values = np.array([np.log(start.peak_dn), start.p2, *([start.p1] if has_rise else [])])
    return law_of(optimize.least_squares(residual, values, x_scale=np.maximum(np.abs(values), LEAST_SCALE)).x)


def build_extended_model(
    final: FinalModel,
    findings: Findings,
    frames: FrameSet,
    rows: Sequence[Frame],
    setting: Setting,
    dataset: Dataset,
) -> ExtendedModel:
    """Return the model of model.yaml.

    Parameters
    ----------
    final : FinalModel
        As `fit_final_model` returns it.
    findings : Findings
        What is concluded of the frames.
    frames : FrameSet
        All frames.
    rows : sequence of Frame
        Row of the manifest of each frame.
    setting : Setting
        The instrument's model.
    dataset : Dataset
        The dataset, for its conditions and exposures.
    """
    learned = final.forward.baseline.learned
    lights = () if learned is None or findings.light is None else (learned,)
    effects = [with_reported_values(named) for named in findings.effects if named.applied.effect.stages]
    if lights and findings.light is not None:
        shape = _effect_of_light(findings.light)
        effects += [] if shape is None else [shape]
        lights = () if shape is None else lights
    has_law = final.law is not None
    sites = [site_of(row, dataset.instrument.conditions, has_law) for row in rows]
    plain = ExtendedModel(
        law=final.law,
        longest_s=frames.design.longest_s,
        reference_s=frames.design.reference_s,
        rows=frames.sensor_rows,
        columns=frames.sensor_columns,
        effects=(),
        spots=_spots_of_sites(final.spots, sites, has_law),
        lights=lights,
    )
    scales = scales_of(plain, setting.baseline, setting.sensor, dataset.instrument.crop_px, dataset.exposures)
    return replace(plain, effects=tuple(_complete(applied, scales) for applied in effects))


def _effect_of_light(light: LearnedLight) -> AppliedEffect | None:
    """Return the effect that stands for a learned light, the one without steps; None if the vocabulary has none."""
    effect = next((effect for effect in vocabulary().values() if not effect.stages), None)
    if effect is None:
        return None
    # Its strength is the share of the light, its second parameter the azimuthal order that has most of it.
    order = float(np.argmax(light.orders)) if len(light.orders) else 0.0
    return AppliedEffect(effect, next(iter(effect.variants)), (float(np.clip(light.power, 0.0, 1.0)), order))


def _complete(applied: AppliedEffect, scales: EffectScales) -> AppliedEffect:
    """Return an effect as a file takes it: directions within one turn, values within bounds, none missing.

    A verdict's values may lie outside by a little: bounds of its fit came from its first look at the frames.
    """
    effect = applied.effect
    start = next(iter(effect.starts(scales)), applied.values)
    values = []
    for parameter, value, other, (low, high) in zip(
        effect.parameters, applied.values, start, effect.bounds(scales), strict=True
    ):
        if parameter not in effect.parameters_of(applied.variant):
            values.append(np.nan)
            continue
        value = value if np.isfinite(value) else other
        value = value % TURN if parameter.unit == "deg" else value
        values.append(float(np.clip(value, low, high)))
    return replace(applied, values=tuple(values))


def _spots_of_sites(spots: FrameParameters, sites: Sequence[Site], has_law: bool) -> Mapping[Site, Spot]:
    """Return the mean centre of the frames of each site, and without a law peak and width too."""
    members: dict[Site, list[int]] = {}
    for number, site in enumerate(sites):
        members.setdefault(site, []).append(number)
    out = {}
    for site, frames in members.items():
        log_peak, log_sigma, x, y = spots.as_rows()[:, frames].mean(axis=1)
        spot = Spot(float(x), float(y))
        if not has_law:
            peak, sigma = (max(float(np.exp(value)), LEAST) for value in (log_peak, log_sigma))
            spot = replace(spot, peak_dn=peak, sigma_px=sigma)
        out[site] = spot
    return out
