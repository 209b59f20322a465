"""Order of work for the spot frames of a dataset: from crops to the results of all fits and tests.

1. Mask hot pixels and fit the declared model. 2. Measure the scatter of pixels, which enters the variance of readings.
3. Select effects of the mean image. 4. Measure the scatter again, about the fit with the effects. 5. Find laws of
brightness and width. 6. Predict held-out repeats.

The declared model is that of the instrument, without effects. The spot parameters of a frame are ln peak, ln σ, x and
y. A site is the set of frames of the same angle, settings and repeat. Granular light is a random field in the light
that frames of a site share and that neighbouring pixels share ("grains"). Its dispersion is the factor by which it
increases the variance of sums of residuals. A law is an effect that changes only brightness and width, from frame to
frame. A free shape is a light shape whose values at nodes are fitted. A clip is a sensor stage that limits readings to
a level. A `FieldEstimate` has the relative `variance` of a random field, its `stderr`, and `reasons` against the field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from spotcheck.discrepancy import fields
from spotcheck.discrepancy.candidates import changes_mean_image
from spotcheck.discrepancy.criteria import MIN_Z, PARAMETER_PRICE
from spotcheck.discrepancy.field_noise import covariance_by_field
from spotcheck.discrepancy.fluctuations import Fluctuation, measure_components, measure_jitter
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, LightField, add_field, select_pixels
from spotcheck.discrepancy.hot_pixels import mask_hot_pixels
from spotcheck.discrepancy.joint_fit import READ_NOISE_RANGE, FreeParameter, JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import FoundLaws, LawSearch, find_laws, is_law
from spotcheck.discrepancy.light_shape import ShapeExplanation, count_coefficients, explain_shape, fit_thinned_shape
from spotcheck.discrepancy.mixed_model import Interval
from spotcheck.discrepancy.named_scatter import (
    Deviation,
    NamedScatter,
    deviation_of_field,
    deviation_of_fluctuation,
    deviation_of_rows,
    name_read_noise,
    name_scatter,
    white_noise,
)
from spotcheck.discrepancy.nested_models import LIGHT_SHAPE, FittedParts, ValidatedChain, build_chain, validate_chain
from spotcheck.discrepancy.residual_peaks import find_peaks
from spotcheck.discrepancy.residuals import ResidualImages, measure_residuals
from spotcheck.discrepancy.saturated_start import FIRST_ITERATIONS, fit_saturated
from spotcheck.discrepancy.scatter import DarkNoise, measure_dark_noise, measure_dark_slopes, propagate_to_noise
from spotcheck.discrepancy.selection import SelectedEffects, select_again, select_effects, withdraw_effects
from spotcheck.discrepancy.spot_measurements import measure_spots
from spotcheck.discrepancy.validation import has_field
from spotcheck.io import progress
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import Effect, EffectScales, Scope
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# The 40th largest reading of a frame counts as its brightest, so that hot pixels do not.
BRIGHT_RANK = 40
# Factor by which a fitted gain may differ from the stated one.
GAIN_FACTOR = 2.0
# Largest reading [DN] of a camera whose full scale is unknown (infinite).
LARGEST_READING_DN = 65535.0
# Least difference of a spot's width from the laser's [px] in the start of the exponent of the width.
LEAST_BROADENING_PX = 0.1

# Stage and scope of the random step of effects that stand for a variance component of the spots, by the component.
COMPONENTS = {
    "frame brightness": (Stage.BRIGHTNESS, Scope.FRAME),
    "site brightness": (Stage.BRIGHTNESS, Scope.SITE),
    "site width": (Stage.WIDTH, Scope.SITE),
}


@dataclass(frozen=True)
class Setting:
    """Properties that the instrument fixes."""

    baseline: Baseline  # declared model of the light
    sensor: SensorModel  # sensor as in the data sheet, or as measured
    crop_px: float  # side of the crops [px]
    stderr: Mapping[str, float] = field(default_factory=dict)  # stated standard errors, by field of `sensor`
    # Source of a value (one of `sensor_choice.SOURCES`), by field of `sensor`; the data sheet for fields left out.
    sources: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Scatter:
    """Scatter of pixels about a fit."""

    dark: DarkNoise | None  # noise of dark pixels; None if there are too few
    grains: fields.FieldEstimate  # granular light, new at each site
    gains: fields.FieldEstimate  # gains of pixels


@dataclass(frozen=True)
class Prepared:
    """Frames of a dataset with the fit of the declared model."""

    frames: FrameSet  # frames to which models are fitted
    unseen: FrameSet  # held-out repeats; may be empty
    unseen_spots: FrameParameters  # spot parameters from which fits of the held-out repeats start
    hot_pixels: int  # number of hot pixels, which are masked
    setting: Setting  # properties of the instrument
    declared: JointFit  # fit of the declared model
    images: ResidualImages  # residuals of this fit
    scales: EffectScales  # sizes of the dataset, from which effects derive bounds and starting values


@dataclass(frozen=True)
class Analysis:
    """Results of all fits and tests of a set of spot frames."""

    prepared: Prepared  # frames and the declared fit
    selected: SelectedEffects  # final fit of the mean image with its effects
    shape: ShapeExplanation | None  # static shapes that explain the free shape; None without such
    images: ResidualImages  # residuals of the final fit
    scatter: Scatter  # scatter of pixels about the final fit
    named_scatter: tuple[NamedScatter, ...]  # random effects that were assessed, with reasons against those not named
    search: LawSearch | None  # search for laws of brightness and width; None without a law of the exposure
    laws: FoundLaws | None  # laws of brightness and width; None without a law of the exposure
    validated: ValidatedChain | None  # predictions of held-out frames; None without these or without laws
    withdrawn: tuple[str, ...] = ()  # effects that were removed, since they worsen the prediction of held-out frames


def analyse_frames(frames: FrameSet, spots: FrameParameters, setting: Setting, effects: Sequence[Effect]) -> Analysis:
    """Search spot frames for effects that the declared model lacks.

    Parameters
    ----------
    frames : FrameSet
        All frames; held-out repeats take part in the validation alone.
    spots : FrameParameters
        Spot parameters of each frame, from which the fits start.
    setting : Setting
        Properties of the instrument.
    effects : sequence of Effect
        Effects to search for.
    """
    progress.begin_step("fitting the declared model", 0.0, 0.1)
    prepared = prepare_frames(frames, spots, setting)
    progress.begin_step("looking for effects", 0.1, 0.7)
    first = fit_with_clip(prepared, effects)
    mean_effects = [effect for effect in effects if changes_mean_image(effect)]
    update = partial(update_dispersion, frames=prepared.frames)
    selected = select_effects(first, mean_effects, prepared.scales, update)
    with_field = add_white_field(prepared, first)
    if with_field is not None:
        pixels = add_field(selected.fit.pixels, with_field.frames)
        selected_again = select_again(selected, pixels, mean_effects, prepared.scales, update)
        if penalized_deviance(selected_again.fit) < penalized_deviance(selected.fit):
            prepared, selected = with_field, selected_again
    progress.begin_step("predicting held-out frames", 0.7, 0.85)
    withdrawn: tuple[str, ...] = ()
    while True:
        analysis = examine(prepared, selected, [e for e in effects if e.name not in withdrawn])
        refuted = analysis.validated.refuted() if analysis.validated else ()
        refuted_effects = tuple(name for name in refuted if name != LIGHT_SHAPE)  # A refuted shape stays in the fit.
        if not refuted_effects:
            return replace(analysis, withdrawn=withdrawn)
        withdrawn = (*withdrawn, *refuted_effects)
        selected = withdraw_effects(selected, withdrawn, prepared.scales)


def fit_with_clip(prepared: Prepared, effects: Sequence[Effect]) -> JointFit:
    """Return the fit with a clip if readings pile up at a level, else the declared fit."""
    fit = fit_saturated(prepared.declared, replace(prepared.frames, light_field=None), effects, prepared.scales)
    return fit if fit is prepared.declared else fit_with_field(fit, prepared.frames)


def add_white_field(prepared: Prepared, first: JointFit) -> Prepared | None:
    """Add the random field of single pixels that residuals of the first fit show; return None if they show none.

    Gains of pixels are such a field. An effect that changes the noise of photons, such as a curved response, looks like
    one. Effects are therefore selected both without and with the field.
    """
    if prepared.frames.light_field is not None:
        return None
    images = prepared.images if first is prepared.declared else measure_residuals(first.model, prepared.frames)
    white_field = fields.estimate_white_field(images)
    if not white_field.variance > MIN_Z * white_field.stderr:
        return None
    variance = white_field.variance * images.spot**2
    light_field = LightField(variance, dispersion=1.0, share=np.zeros_like(variance), mean_share=0.0)
    frames = replace(prepared.frames, light_field=light_field)
    declared = fit_declared(frames, prepared.declared.model.spots, prepared.setting)
    return replace(prepared, frames=frames, declared=declared, images=measure_residuals(declared.model, frames))


def penalized_deviance(fit: JointFit) -> float:
    """Return −2 ln L with the price of the fitted parameters, by which fits with and without a field are compared."""
    shape_price = 0.0 if fit.model.grid is None else count_coefficients(fit.model)
    return fit.deviance + (PARAMETER_PRICE * len(fit.model.free) + shape_price)


def prepare_frames(frames: FrameSet, spots: FrameParameters, setting: Setting) -> Prepared:
    """Mask hot pixels, separate the held-out repeats, and fit the declared model.

    If the residuals show granular light, its variance is added to the readings and the fit is repeated.

    Parameters
    ----------
    frames : FrameSet
        Usable frames of the dataset, including held-out repeats.
    spots : FrameParameters
        Spot of each frame, from which the fit starts.
    setting : Setting
        Properties that the instrument fixes.
    """
    frames, hot_pixels = mask_hot_pixels(frames, setting.sensor)
    is_held_out = frames.held_out()
    searched = frames.select(~is_held_out)
    declared = fit_declared(searched, spots.select(~is_held_out), setting)
    images = measure_residuals(declared.model, searched)
    light_field = find_light_field(images, declared)
    if light_field is not None:
        # Structure of the light that moves with the spot looks like grains unless a free shape absorbs it.
        _, with_shape = fit_thinned_shape(declared)
        light_field = find_light_field(measure_residuals(with_shape.model, searched), with_shape)
    if light_field is not None:
        searched = replace(searched, light_field=light_field)
        declared = fit_declared(searched, declared.model.spots, setting)
        images = measure_residuals(declared.model, searched)
    scales = scales_of(searched, declared.model, setting, images)
    unseen, unseen_spots = frames.select(is_held_out), spots.select(is_held_out)
    return Prepared(searched, unseen, unseen_spots, hot_pixels, setting, declared, images, scales)


def examine(prepared: Prepared, selected: SelectedEffects, effects: Sequence[Effect]) -> Analysis:
    """Measure scatter, find laws and predict held-out frames, all with the selected effects of the mean image."""
    fit, setting, scales = selected.fit, prepared.setting, prepared.scales
    mean_effects = [effect for effect in effects if changes_mean_image(effect)]
    shape = explain_shape(fit, mean_effects, scales) if fit.model.grid is not None else None
    images = prepared.images if fit is prepared.declared else measure_residuals(fit.model, prepared.frames)
    scatter = measure_scatter(images, fit)
    search = None
    if setting.baseline.photon_budget != "free":
        sensor = replace(fit.model.forward.sensor, read_noise_e=setting.sensor.read_noise_e)
        by_field = covariance_by_field(fit, prepared.frames, scatter.grains) if shows_grains(scatter.grains) else None
        search = LawSearch(measure_spots(fit, by_field), ForwardModel(setting.baseline, sensor), scales)
    named = name_all_scatter(effects, scatter, selected, prepared, search)
    analysis = Analysis(prepared, selected, shape, images, scatter, named, search, None, None)
    if search is None:
        return analysis
    laws = find_laws(search, [effect for effect in effects if is_law(effect)])
    analysis = replace(analysis, laws=laws)
    if len(prepared.unseen) == 0:
        return analysis
    parts = FittedParts(
        declared=prepared.declared,
        with_shape=selected.with_shape,
        final=fit,
        search=search,
        laws=tuple(law for law in laws.laws if not law.reasons),
        scatter=tuple(scattered for scattered in named if not scattered.reasons),
        images=images,
    )
    return replace(analysis, validated=validate_chain(build_chain(parts), prepared.unseen, prepared.unseen_spots))


def fit_declared(frames: FrameSet, spots: FrameParameters, setting: Setting) -> JointFit:
    """Fit the declared model to frames, from starting values of their spots.

    Beside the spot parameters, the read noise is fitted, and gain and black level if their errors are known.
    """
    baseline = replace(setting.baseline, photon_budget="free")
    model = JointModel(ForwardModel(baseline, setting.sensor), spots, frames.design, free_sensor_parameters(setting))
    return fit_jointly(model, select_pixels(frames, spots))


def free_sensor_parameters(setting: Setting) -> tuple[FreeParameter, ...]:
    """Return the fitted parameters of the sensor: the read noise, and gain and black level if their errors are known.

    The effect of a parameter of the sensor is named "".
    """
    low_noise, high_noise = (factor * setting.sensor.read_noise_e for factor in READ_NOISE_RANGE)
    free = [FreeParameter("", "read_noise_e", low_noise, high_noise)]
    for name in ("gain_dn_per_e", "black_level_dn"):
        stated, stderr = getattr(setting.sensor, name), setting.stderr.get(name, 0.0)
        if stderr > 0:
            low = stated / GAIN_FACTOR if name == "gain_dn_per_e" else -np.inf
            high = stated * GAIN_FACTOR if name == "gain_dn_per_e" else np.inf
            free.append(FreeParameter("", name, low, high, stated, stderr))
    return tuple(free)


def find_light_field(images: ResidualImages, fit: JointFit) -> LightField | None:
    """Return the granular light that the residuals of a fit show; None if they show none.

    The granular light has a part φ of the variance of a reading. Its correlation covers a pixels, and n frames of a
    site share it. The dispersion of sums of residuals is then 1 + (n a − 1) φ. φ is a mean over pixels, weighted with
    their information on the light. A model that contains granular light has its variance already, so that none is
    added.
    """
    grains = fields.estimate_granular_light(fields.measure_fields(images))
    if not shows_grains(grains):
        return None
    is_in_model = has_field(fit.model)
    variance = grains.variance * images.spot**2
    total = 1 / np.where(images.weight > 0, images.weight, np.inf) + (0.0 if is_in_model else variance)
    information = np.divide(images.spot**2, total, out=np.zeros_like(variance), where=total > 0)
    share = np.divide(variance, total, out=np.zeros_like(variance), where=total > 0)
    mean_share = min(float(np.sum(share * information) / np.sum(information)), 1.0)
    dispersion = 1 + (grains.frames * fields.correlated_area(grains.grain_px) - 1) * mean_share
    variance = np.zeros_like(variance) if is_in_model else variance
    return LightField(variance, dispersion, share.astype(np.float32), mean_share)


def shows_grains(grains: fields.FieldEstimate) -> bool:
    """Return whether granular light is significant, and nothing speaks against it."""
    return not grains.reasons and grains.variance > MIN_Z * grains.stderr


def update_dispersion(fit: JointFit, frames: FrameSet) -> JointFit:
    """Return a fit with the dispersion that its residuals show; as it is if its model has no granular light."""
    if not has_field(fit.model):
        return fit
    light_field = find_light_field(measure_residuals(fit.model, frames), fit)
    if light_field is None:
        return fit
    return replace(fit, pixels=replace(fit.pixels, dispersion=light_field.dispersion))


def fit_with_field(saturated: JointFit, frames: FrameSet) -> JointFit:
    """Refit a model with a clip, together with the granular light that its residuals show; as it is if there is none.

    The fit is rough: effects are selected from it.
    """
    light_field = find_light_field(measure_residuals(saturated.model, frames), saturated)
    if light_field is None:
        return saturated
    pixels = select_pixels(replace(frames, light_field=light_field), saturated.model.spots)
    return fit_jointly(saturated.model, pixels, tolerance=1.0, iterations=FIRST_ITERATIONS)


def measure_scatter(images: ResidualImages, fit: JointFit) -> Scatter:
    """Return the scatter of pixels about a fit.

    At a single site, gains of pixels cannot be distinguished from grains by the frames of other sites. If there are no
    significant grains, the field that neighbouring pixels do not share is then taken for the gains.
    """
    covariances = fields.measure_fields(images)
    grains = fields.estimate_granular_light(covariances)
    is_without_grains = images.design.sites == 1 and not grains.variance > MIN_Z * grains.stderr
    gains = fields.estimate_white_field(images) if is_without_grains else fields.estimate_pixel_gains(covariances)
    dark = measure_dark_noise(images, measure_dark_slopes(fit.model.forward))
    return Scatter(dark, grains, gains)


def scales_of(frames: FrameSet, model: JointModel, setting: Setting, images: ResidualImages) -> EffectScales:
    """Return the scales of a dataset, from which effects derive bounds and starting values.

    `model` and `images` are the declared model and its residuals.
    """
    design, sensor = frames.design, setting.sensor
    is_longest = design.exposure_s == design.longest_s
    readings = np.where(np.isfinite(frames.readings), frames.readings, -np.inf).reshape(len(frames), -1)
    brightest_dn = np.partition(readings, -BRIGHT_RANK, axis=1)[:, -BRIGHT_RANK]
    brightest_quarter_dn = np.sort(brightest_dn)[-max(len(frames) // 4, 1) :]
    broadening_px = np.exp(model.spots.log_sigma) - setting.baseline.laser_px
    # Slope of ln(σ − laser width) over ln t.
    exponent = 0.0
    if design.has_exposures and len(np.unique(design.exposure_s)) > 1:
        log_broadening = np.log(np.maximum(broadening_px, LEAST_BROADENING_PX))
        exponent = float(np.polyfit(np.log(design.exposure_s), log_broadening, 1)[0])
    waves, copies = find_peaks(images)
    return EffectScales(
        sigma_px=float(np.exp(np.median(model.spots.log_sigma[is_longest]))),
        peak_dn=float(np.median(brightest_quarter_dn) - sensor.black_level_dn),
        full_scale_dn=min(sensor.full_scale_dn, LARGEST_READING_DN),
        crop_px=setting.crop_px,
        shortest_s=float(design.exposure_s.min()),
        read_noise_e=sensor.read_noise_e,
        gain_dn_per_e=sensor.gain_dn_per_e,
        width_exponent=exponent,
        longest_s=design.longest_s,
        waves=waves,
        copies=copies,
    )


def name_all_scatter(
    effects: Sequence[Effect],
    scatter: Scatter,
    selected: SelectedEffects,
    prepared: Prepared,
    search: LawSearch | None,
) -> tuple[NamedScatter, ...]:
    """Return the random effects that explain the scatter of pixels and, with a search for laws, that of the spots.

    Effects that are assessed but not named are among them, with reasons.
    """
    setting, scales = prepared.setting, prepared.scales
    # Standard deviation of the draw of each kind of random step, by its stage and scope.
    deviations: dict[tuple[Stage, Scope], Deviation] = {
        (Stage.SPECKLE_FIELD, Scope.SITE): deviation_of_field(scatter.grains),
        (Stage.PIXEL_GAIN, Scope.SENSOR): deviation_of_field(scatter.gains),
    }
    read_noise = []
    if scatter.dark is not None:
        deviations[Stage.ROW_NOISE_AND_HOT_PIXELS, Scope.FRAME] = deviation_of_rows(scatter.dark)
        stderr = setting.stderr.get("read_noise_e", 0.0)
        model = selected.fit.model
        by_parameters = propagate_to_noise(model, selected.covariance)
        noise = white_noise(scatter.dark, model.forward.sensor, setting.sensor, stderr, by_parameters)
        read_noise = name_read_noise(effects, noise, setting.sensor, scales)
    if search is not None:
        components, jitter = measure_components(search), measure_jitter(search)
        absent = Fluctuation(Interval.around(0.0, 0.0), 0.0, ("no such component is needed",))
        for name, key in COMPONENTS.items():
            deviations[key] = deviation_of_fluctuation(components.get(name, absent))
        if jitter is not None:
            deviations[Stage.COORDINATES, Scope.FRAME] = deviation_of_fluctuation(jitter)
    return (*read_noise, *name_scatter(effects, deviations, prepared.hot_pixels, scales))
