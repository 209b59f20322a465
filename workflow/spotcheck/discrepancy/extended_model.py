"""The extended model of a verdict: law, effects, learned light and spots, in the form of model.yaml.

The extended model is the declared model of the instrument with the effects that the verdict names. The learned light is
a fitted light shape in place of the declared one. A law is an effect that changes only brightness and width of the
spots, from frame to frame. The exposure law is peak ∝ exposure and σ = laser width + p1 ln t + p2; p1 and p2 are in px.
The spot parameters of a frame are ln peak [ln DN], ln σ [ln px], x and y [px].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.analysis import Analysis
from spotcheck.discrepancy.findings import Findings, NamedEffect
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Design, FrameParameters, FrameSet
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import LawSearch, is_law
from spotcheck.discrepancy.ready_frames import ReadyFrames
from spotcheck.discrepancy.spot_measurements import SpotMeasurements
from spotcheck.discrepancy.starting_spots import fit_spots
from spotcheck.discrepancy.verdict import LEARNED_SHAPE, effect_of_light
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.light_shape import LightShape
from spotcheck.model.model_file import ExtendedModel, Site, Spot, scales_of, site_of

# Smallest peak [DN] and width [px] of a spot in the file: both must be positive, even if the spot was fitted badly.
LEAST = 1e-3
# A full turn [deg], modulo which directions are written.
TURN = 360.0
# Residual of ln peak or ln σ of a spot outside the domain of a law, and least scale of the parameters in a fit of laws.
OUT_OF_DOMAIN, LEAST_SCALE = 1e3, 0.1


@dataclass(frozen=True)
class FinalModel:
    """Model of the mean images of all frames with the named effects."""

    forward: ForwardModel  # effects of the mean image, light and sensor as fitted; without a law
    spots: FrameParameters  # spot parameters of each frame, including the held-out ones
    law: ExposureLaw | None  # exposure law with all named laws in place; None without a law of the exposure

    def of_frames(self, selection: np.ndarray, design: Design) -> JointModel:
        """Return the model of some frames: `selection` are their positions among all, `design` their conditions."""
        return JointModel(self.forward, self.spots.select(selection), design)

    def with_its_sensor(self, model: JointModel) -> JointModel:
        """Return another model with the sensor of this one, so that residuals of both are divided by the same noise."""
        return replace(model, forward=replace(model.forward, sensor=self.forward.sensor))


def fit_final_model(analysis: Analysis, findings: Findings, frames: FrameSet) -> FinalModel:
    """Return the model with exactly the named effects, at their reported values.

    If the effects or the light differ from those of the analysis, the spots are fitted again. Spots of held-out frames
    are always fitted here.

    Parameters
    ----------
    analysis : Analysis
        Analysis of the frames.
    findings : Findings
        Findings from this analysis.
    frames : FrameSet
        All frames, as they were given to the analysis.
    """
    fit, prepared = analysis.selected.fit, analysis.prepared
    static_shapes = () if analysis.shape is None else analysis.shape.effects
    image_effects = {*fit.model.effect_names, *(applied.effect.name for applied in static_shapes)}
    effects = tuple(with_reported_values(named) for named in findings.effects if named.name in image_effects)
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
        measurements = SpotMeasurements(prepared.frames.design, spots, refitted.joint_covariance)
        search = search and search.with_measurements(measurements)
    is_held_out = frames.held_out()
    spot_rows = np.empty((SPOT_PARAMETERS, len(frames)))
    spot_rows[:, ~is_held_out] = spots.as_rows()
    if is_held_out.any():
        spot_rows[:, is_held_out] = fit_spots(forward, prepared.unseen, prepared.unseen_spots).spots.as_rows()
    laws = tuple(with_reported_values(named) for named in findings.effects if is_law(named.applied.effect))
    law = None if search is None else fit_exposure_law(search, laws)
    return FinalModel(forward, FrameParameters(*spot_rows), law)


def with_reported_values(named: NamedEffect) -> AppliedEffect:
    """Return an effect with the values that a verdict reports; some may come from another fit than that of the effect.

    A value that is not finite in the verdict keeps the fitted one.
    """
    applied = named.applied
    for name, reported in named.values.items():
        if np.isfinite(reported.value):
            applied = applied.with_value(name, reported.value)
    return applied


def fit_exposure_law(search: LawSearch, laws: tuple[AppliedEffect, ...]) -> ExposureLaw:
    """Fit the exposure law to brightness and width of the spots, with other laws at fixed values.

    p1 is fitted only if there are several exposures and no law replaces it; it keeps its starting value otherwise.
    """
    spots, laser_px = search.measurements.spots, search.forward.baseline.laser_px
    is_replaced = "p1" in {name for applied in laws for name in applied.effect.replaces}
    start = search.fit([]).law
    if is_replaced:
        start = ExposureLaw(0.0, float(np.exp(np.mean(spots.log_sigma))) - laser_px, start.peak_dn)
    fits_p1 = len(np.unique(search.design.exposure_s)) > 1 and not is_replaced

    def law_of(values: np.ndarray) -> ExposureLaw:
        """Return the law of fitted values: ln peak, p2, and p1 if it is fitted."""
        return ExposureLaw(float(values[2]) if fits_p1 else start.p1, float(values[1]), float(np.exp(values[0])))

    def whitened_residual(values: np.ndarray) -> np.ndarray:
        """Return the residuals of ln peak and ln σ of all frames, transformed to unit covariance [2F]."""
        difference = search.observations - search.mean_of(replace(search.forward, law=law_of(values), effects=laws))
        return search.whitening @ np.where(np.isfinite(difference), difference, OUT_OF_DOMAIN)

    values = np.array([np.log(start.peak_dn), start.p2, *([start.p1] if fits_p1 else [])])
    return law_of(optimize.least_squares(whitened_residual, values, x_scale=np.maximum(np.abs(values), LEAST_SCALE)).x)


def build_extended_model(final: FinalModel, findings: Findings, ready: ReadyFrames, dataset: Dataset) -> ExtendedModel:
    """Return the content of model.yaml.

    Parameters
    ----------
    final : FinalModel
        Result of `fit_final_model`.
    findings : Findings
        Findings from the frames.
    ready : ReadyFrames
        All frames, their rows of the manifest, and the properties of the instrument.
    dataset : Dataset
        Dataset with the conditions and exposures of the frames.
    """
    learned, light = final.forward.baseline.learned, findings.light
    effects = [with_reported_values(named) for named in findings.effects if named.applied.effect.stages]
    lights: tuple[LightShape, ...] = ()
    # The light itself is stored in the file as an array, beside the effect that stands for it.
    if learned is not None and light is not None and LEARNED_SHAPE.name in vocabulary():
        lights, effects = (learned,), [*effects, effect_of_light(light).applied]
    frames, has_law = ready.frames, final.law is not None
    sites = [site_of(row, dataset.instrument.conditions, has_law) for row in ready.rows]
    without_effects = ExtendedModel(
        law=final.law,
        longest_s=frames.design.longest_s,
        reference_s=frames.design.reference_s,
        rows=frames.sensor_rows,
        columns=frames.sensor_columns,
        effects=(),
        spots=_spots_of_sites(final.spots, sites, has_law),
        lights=lights,
    )
    baseline, sensor = ready.setting.baseline, ready.setting.sensor
    scales = scales_of(without_effects, baseline, sensor, dataset.instrument.crop_px, dataset.exposures)
    return replace(without_effects, effects=tuple(_complete(applied, scales) for applied in effects))


def _complete(applied: AppliedEffect, scales: EffectScales) -> AppliedEffect:
    """Return an effect that meets the rules of the file: directions from 0 to 360°, values within bounds, none missing.

    Missing values are starting values. Reported values may lie slightly outside the bounds, since the bounds of the fit
    came from scales that were estimated earlier. Parameters that the variant does not have are NaN.
    """
    effect = applied.effect
    starts = next(iter(effect.starts(scales)), applied.values)
    values = []
    for parameter, value, start, (low, high) in zip(
        effect.parameters, applied.values, starts, effect.bounds(scales), strict=True
    ):
        if parameter not in effect.parameters_of(applied.variant):
            values.append(np.nan)
            continue
        value = value if np.isfinite(value) else start
        value = value % TURN if parameter.unit == "deg" else value
        values.append(float(np.clip(value, low, high)))
    return replace(applied, values=tuple(values))


def _spots_of_sites(spots: FrameParameters, sites: Sequence[Site], has_law: bool) -> Mapping[Site, Spot]:
    """Return the spot of each site: the mean centre of its frames and, without a law, their mean ln peak and ln σ.

    `sites` has the site of each frame. With a law, peak and width follow from the law and are left out.
    """
    members: dict[Site, list[int]] = {}
    for frame, site in enumerate(sites):
        members.setdefault(site, []).append(frame)
    spot_of_site = {}
    for site, frames in members.items():
        log_peak, log_sigma, x, y = spots.as_rows()[:, frames].mean(axis=1)
        spot = Spot(float(x), float(y))
        if not has_law:
            peak_dn, sigma_px = (max(float(np.exp(value)), LEAST) for value in (log_peak, log_sigma))
            spot = replace(spot, peak_dn=peak_dn, sigma_px=sigma_px)
        spot_of_site[site] = spot
    return spot_of_site
