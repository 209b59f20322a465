"""Order of work for the spot frames of a dataset: from crops to all that is concluded.

1. Hot pixels and the declared fit. 2. Scatter of pixels, which enters the variance of readings. 3. Effects of the mean
image. 4. Scatter again, beside them. 5. Laws of brightness and width. 6. Held-out repeats.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from spotcheck.discrepancy.candidates import changes_mean_image
from spotcheck.discrepancy.criteria import MIN_Z, PARAMETER_PRICE
from spotcheck.discrepancy.evaluation import LEAST_VARIANCE
from spotcheck.discrepancy.field_noise import covariance_by_field
from spotcheck.discrepancy.fields import (
    FieldEstimate,
    correlated_area,
    estimate_granular_light,
    estimate_pixel_gains,
    estimate_white_field,
    measure_fields,
)
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
from spotcheck.discrepancy.scatter import DarkNoise, DarkSlopes, measure_dark_noise
from spotcheck.discrepancy.selection import SelectedEffects, select_again, select_effects, withdraw_effects
from spotcheck.discrepancy.spot_numbers import numbers_of_fit
from spotcheck.discrepancy.validation import has_field
from spotcheck.io import progress
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import Effect, EffectScales, Scope
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Rank of the reading of a frame that counts as its brightest: hot pixels do not.
BRIGHT_RANK = 40
# Factor by which a fitted gain may differ from the stated one.
GAIN_FACTOR = 2.0
# Relative step of the read noise in the slope of the variance of dark readings.
NOISE_STEP = 0.01

# Random steps of effects that stand for variance components of the spots.
COMPONENTS = {
    "frame brightness": (Stage.BRIGHTNESS, Scope.FRAME),
    "site brightness": (Stage.BRIGHTNESS, Scope.SITE),
    "site width": (Stage.WIDTH, Scope.SITE),
}

Log = Callable[[str], None]


@dataclass(frozen=True)
class Setting:
    """What the instrument fixes."""

    baseline: Baseline  # declared model of the light
    sensor: SensorModel  # stated sensor
    crop_px: float  # side of the crops [px]
    stderr: Mapping[str, float] = field(default_factory=dict)  # standard errors of fields of the sensor, if stated


@dataclass(frozen=True)
class Scatter:
    """Scatter of pixels about a fit."""

    dark: DarkNoise | None  # noise of dark pixels; None if there are too few
    grains: FieldEstimate  # granular light, new at each site
    gains: FieldEstimate  # gains of pixels
    hot_pixels: int  # number of hot pixels


@dataclass(frozen=True)
class Prepared:
    """Frames of a dataset with the fit of the declared model."""

    frames: FrameSet  # that are searched
    unseen: FrameSet  # held-out repeats, maybe none
    unseen_spots: FrameParameters  # spots of these, from which fits start
    hot_pixels: int  # number of hot pixels, which are masked
    setting: Setting
    declared: JointFit  # fit without effects
    images: ResidualImages  # its residuals
    scales: EffectScales


@dataclass(frozen=True)
class Analysis:
    """All that is concluded of a set of spot frames."""

    prepared: Prepared
    selected: SelectedEffects  # effects of the mean image
    shape: ShapeExplanation | None  # what stands for the learned light shape
    images: ResidualImages  # residuals of the final fit
    scatter: Scatter  # scatter of pixels beside the effects
    named_scatter: tuple[NamedScatter, ...]  # effects that scatter
    search: LawSearch | None  # of laws of brightness and width; None without a law of the exposure
    laws: FoundLaws | None  # laws of brightness and width; None without a law of the exposure
    validated: ValidatedChain | None  # predictions of held-out frames; None if there are none
    withdrawn: tuple[str, ...] = ()  # effects with which held-out frames are predicted worse


def analyse_frames(
    frames: FrameSet, spots: FrameParameters, setting: Setting, effects: Sequence[Effect], log: Log = lambda text: None
) -> Analysis:
    """Find what the declared model misses in spot frames.

    Parameters
    ----------
    frames : FrameSet
        All frames; held-out repeats take part in the validation alone.
    spots : FrameParameters
        Spot of each frame, from which the fits start.
    setting : Setting
        The instrument's model.
    effects : sequence of Effect
        Effects to look for.
    log : callable
        Receives lines of text on the progress.
    """
    progress.begin_step("fitting the declared model", 0.0, 0.1)
    prepared = prepare_frames(frames, spots, setting)
    progress.begin_step("looking for effects", 0.1, 0.7)
    first = fit_with_clip(prepared, effects)
    log(f"first fit: {', '.join(first.model.effect_names) or 'no effect'}, converged {first.has_converged}")
    mean_effects = [effect for effect in effects if changes_mean_image(effect)]
    update = partial(update_dispersion, frames=prepared.frames)
    selected = select_effects(first, mean_effects, prepared.scales, log, update)
    scattered = add_white_field(prepared, first)
    if scattered is not None:
        log("single pixels scatter: searched again with a field")
        pixels = add_field(selected.fit.pixels, scattered.frames)
        other = select_again(selected, pixels, mean_effects, prepared.scales, log, update)
        if other.fit.deviance + price_of_fit(other.fit) < selected.fit.deviance + price_of_fit(selected.fit):
            prepared, selected = scattered, other
    progress.begin_step("predicting held-out frames", 0.7, 0.85)
    withdrawn: tuple[str, ...] = ()
    while True:
        analysis = examine(prepared, selected, [e for e in effects if e.name not in withdrawn], log)
        refuted = analysis.validated.refuted() if analysis.validated else ()
        log(f"refuted by held-out frames: {', '.join(refuted) or 'nothing'}")
        if not set(refuted) - {LIGHT_SHAPE}:
            return replace(analysis, withdrawn=withdrawn)
        withdrawn = (*withdrawn, *(name for name in refuted if name != LIGHT_SHAPE))
        selected = withdraw_effects(selected, withdrawn, prepared.scales, log)


def fit_with_clip(prepared: Prepared, effects: Sequence[Effect]) -> JointFit:
    """Return the fit with a clip where readings pile up, else the declared fit."""
    fit = fit_saturated(prepared.declared, replace(prepared.frames, light_field=None), effects, prepared.scales)
    return fit if fit is prepared.declared else fit_with_field(fit, prepared.frames)


def add_white_field(prepared: Prepared, first: JointFit) -> Prepared | None:
    """Return the frames with the field of single pixels that residuals of the first fit show; None without one.

    Gains of pixels are such a field. An effect that changes the noise of photons, such as a curved response, looks like
    one, so that effects are selected without and with it.
    """
    if prepared.frames.light_field is not None:
        return None
    images = prepared.images if first is prepared.declared else measure_residuals(first.model, prepared.frames)
    white = estimate_white_field(images)
    if not white.variance > MIN_Z * white.stderr:
        return None
    variance = white.variance * images.spot**2
    light_field = LightField(variance, dispersion=1.0, share=np.zeros_like(variance), mean_share=0.0)
    frames = replace(prepared.frames, light_field=light_field)
    declared = fit_declared(frames, prepared.declared.model.spots, prepared.setting)
    return replace(prepared, frames=frames, declared=declared, images=measure_residuals(declared.model, frames))


def price_of_fit(fit: JointFit) -> float:
    """Return what a fit pays in −2 ln L for its parameters."""
    of_shape = 0.0 if fit.model.grid is None else count_coefficients(fit.model)
    return PARAMETER_PRICE * len(fit.model.free) + of_shape


def prepare_frames(frames: FrameSet, spots: FrameParameters, setting: Setting) -> Prepared:
    """Mask hot pixels, part held-out repeats, and fit the declared model."""
    frames, hot_pixels = mask_hot_pixels(frames, setting.sensor)
    is_unseen = frames.held_out()
    searched_index, unseen = np.flatnonzero(~is_unseen), np.flatnonzero(is_unseen)
    searched = frames.select(searched_index)
    declared = fit_declared(searched, spots.select(searched_index), setting)
    images = measure_residuals(declared.model, searched)
    light_field = find_light_field(images, declared)
    if light_field is not None:
        # Structure of the light that moves with the spot looks like grains unless a free shape takes it.
        with_shape = fit_thinned_shape(declared)[1]
        light_field = find_light_field(measure_residuals(with_shape.model, searched), with_shape)
    if light_field is not None:
        searched = replace(searched, light_field=light_field)
        declared = fit_declared(searched, declared.model.spots, setting)
        images = measure_residuals(declared.model, searched)
    scales = scales_of(searched, declared.model, setting, images)
    parts = (searched, frames.select(unseen), spots.select(unseen))
    return Prepared(*parts, hot_pixels, setting, declared, images, scales)


def examine(prepared: Prepared, selected: SelectedEffects, effects: Sequence[Effect], log: Log) -> Analysis:
    """Return scatter, laws and validation beside the effects of the mean image."""
    fit, setting, scales = selected.fit, prepared.setting, prepared.scales
    static = [effect for effect in effects if changes_mean_image(effect)]
    shape = explain_shape(fit, static, scales, log) if fit.model.grid is not None else None
    images = prepared.images if fit is prepared.declared else measure_residuals(fit.model, prepared.frames)
    scatter = measure_scatter(images, fit, prepared.hot_pixels)
    search = None
    if setting.baseline.photon_budget != "free":
        sensor = replace(fit.model.forward.sensor, read_noise_e=setting.sensor.read_noise_e)
        by_field = covariance_by_field(fit, prepared.frames, scatter.grains) if shows_grains(scatter.grains) else None
        search = LawSearch(numbers_of_fit(fit, by_field), ForwardModel(setting.baseline, sensor), scales)
    named = name_all_scatter(effects, scatter, fit, setting, scales, search)
    analysis = Analysis(prepared, selected, shape, images, scatter, named, search, None, None)
    if search is None:
        return analysis
    found = find_laws(search, [effect for effect in effects if is_law(effect)])
    analysis = replace(analysis, laws=found)
    if len(prepared.unseen) == 0:
        return analysis
    parts = FittedParts(
        declared=prepared.declared,
        with_shape=selected.with_shape,
        final=fit,
        search=search,
        laws=tuple(law for law in found.laws if not law.reasons),
        scatter=tuple(scattered for scattered in named if not scattered.reasons),
        images=images,
    )
    return replace(analysis, validated=validate_chain(build_chain(parts), prepared.unseen, prepared.unseen_spots))


def fit_declared(frames: FrameSet, spots: FrameParameters, setting: Setting) -> JointFit:
    """Return the fit of the declared model; the read noise is a nuisance parameter."""
    baseline = replace(setting.baseline, photon_budget="free")
    model = JointModel(ForwardModel(baseline, setting.sensor), spots, frames.design, free_sensor_parameters(setting))
    return fit_jointly(model, select_pixels(frames, spots))


def free_sensor_parameters(setting: Setting) -> tuple[FreeParameter, ...]:
    """Return the fitted numbers of the sensor: the read noise, and gain and black level if they have stated errors."""
    noise = setting.sensor.read_noise_e
    free = [FreeParameter("", "read_noise_e", READ_NOISE_RANGE[0] * noise, READ_NOISE_RANGE[1] * noise)]
    for name in ("gain_dn_per_e", "black_level_dn"):
        stated, stderr = getattr(setting.sensor, name), setting.stderr.get(name, 0.0)
        if stderr > 0:
            low = stated / GAIN_FACTOR if name == "gain_dn_per_e" else -np.inf
            high = stated * GAIN_FACTOR if name == "gain_dn_per_e" else np.inf
            free.append(FreeParameter("", name, low, high, stated, stderr))
    return tuple(free)


def find_light_field(images: ResidualImages, fit: JointFit) -> LightField | None:
    """Return the granular light that the residuals of a fit show; None if they show none.

    With its part φ of the variance of a reading, the area a of its correlation [px] and n frames of a site that share
    it, sums of residuals have 1 + (n a − 1) φ times the variance of independent ones; φ is its mean over the
    information on the light. A field that is in the distribution of a reading adds no further variance.
    """
    grains = estimate_granular_light(measure_fields(images))
    if not shows_grains(grains):
        return None
    is_in_model = has_field(fit.model)
    variance = grains.variance * images.spot**2
    total = 1 / np.where(images.weight > 0, images.weight, np.inf) + (0.0 if is_in_model else variance)
    information = np.divide(images.spot**2, total, out=np.zeros_like(variance), where=total > 0)
    share = np.divide(variance, total, out=np.zeros_like(variance), where=total > 0)
    mean_share = min(float(np.sum(share * information) / np.sum(information)), 1.0)
    dispersion = 1 + (grains.frames * correlated_area(grains.grain_px) - 1) * mean_share
    variance = np.zeros_like(variance) if is_in_model else variance
    return LightField(variance, dispersion, share.astype(np.float32), mean_share)


def shows_grains(grains: FieldEstimate) -> bool:
    """Whether an estimate shows granular light."""
    return not grains.reasons and grains.variance > MIN_Z * grains.stderr


def update_dispersion(fit: JointFit, frames: FrameSet) -> JointFit:
    """Return a fit with the dispersion that its residuals show, if granular light is in its model."""
    if not has_field(fit.model):
        return fit
    light_field = find_light_field(measure_residuals(fit.model, frames), fit)
    if light_field is None:
        return fit
    return replace(fit, pixels=replace(fit.pixels, dispersion=light_field.dispersion))


def fit_with_field(saturated: JointFit, frames: FrameSet) -> JointFit:
    """Return the fit of a clip with the granular light that its residuals show."""
    light_field = find_light_field(measure_residuals(saturated.model, frames), saturated)
    if light_field is None:
        return saturated
    pixels = select_pixels(replace(frames, light_field=light_field), saturated.model.spots)
    return fit_jointly(saturated.model, pixels, tolerance=1.0, iterations=FIRST_ITERATIONS)


def measure_scatter(images: ResidualImages, fit: JointFit, hot_pixels: int) -> Scatter:
    """Return the scatter of pixels about a fit.

    At a single site gains of pixels are what neighbours do not share, unless there are grains.
    """
    covariances = measure_fields(images)
    grains = estimate_granular_light(covariances)
    is_alone = images.design.sites == 1 and not grains.variance > MIN_Z * grains.stderr
    gains = estimate_white_field(images) if is_alone else estimate_pixel_gains(covariances)
    dark = measure_dark_noise(images, measure_dark_slopes(fit.model.forward))
    return Scatter(dark, grains, gains, hot_pixels)


def measure_dark_slopes(forward: ForwardModel) -> DarkSlopes:
    """Return the slopes of dark readings; all are 0 where the variance is at the floor of the fit."""
    sensor, distribution = forward.sensor, forward.distribution()
    if distribution.variance(0.0) < LEAST_VARIANCE:
        return DarkSlopes(0.0, 0.0, 0.0, 0.0)
    noises = [sensor.read_noise_e * (1 + shift) for shift in (-NOISE_STEP, NOISE_STEP)]
    low, high = (replace(forward, sensor=replace(sensor, read_noise_e=noise)).distribution() for noise in noises)
    by_noise = sensor.gain_dn_per_e**2 * (noises[1] ** 2 - noises[0] ** 2)
    light = NOISE_STEP * distribution.noise_dn
    variance, mean = (
        float(high(0.0) - low(0.0)) / by_noise for low, high in ((low.variance, high.variance), (low.mean, high.mean))
    )
    variance_by_light, mean_by_light = (
        float(at(light) - at(0.0)) / light for at in (distribution.variance, distribution.mean)
    )
    return DarkSlopes(variance, mean, variance_by_light, mean_by_light)


def scales_of(frames: FrameSet, model: JointModel, setting: Setting, images: ResidualImages) -> EffectScales:
    """Return the scales from which effects derive bounds and starting values."""
    design, sensor = frames.design, setting.sensor
    is_longest = design.exposure_s == design.longest_s
    readings = np.where(np.isfinite(frames.readings), frames.readings, -np.inf).reshape(len(frames), -1)
    brightest = np.partition(readings, -BRIGHT_RANK, axis=1)[:, -BRIGHT_RANK]
    broadening = np.exp(model.spots.log_sigma) - setting.baseline.laser_px
    exponent = 0.0
    if design.has_exposures and len(np.unique(design.exposure_s)) > 1:
        exponent = float(np.polyfit(np.log(design.exposure_s), np.log(np.maximum(broadening, 0.1)), 1)[0])
    waves, copies = find_peaks(images)
    return EffectScales(
        sigma_px=float(np.exp(np.median(model.spots.log_sigma[is_longest]))),
        peak_dn=float(np.median(np.sort(brightest)[-max(len(frames) // 4, 1) :]) - sensor.black_level_dn),
        full_scale_dn=min(sensor.full_scale_dn, 65535.0),
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
    fit: JointFit,
    setting: Setting,
    scales: EffectScales,
    search: LawSearch | None,
) -> tuple[NamedScatter, ...]:
    """Return the effects of the scatter of pixels, and with a law of the exposure of that of the spots."""
    deviations: dict[tuple[Stage, Scope], Deviation] = {
        (Stage.SPECKLE_FIELD, Scope.SITE): deviation_of_field(scatter.grains),
        (Stage.PIXEL_GAIN, Scope.SENSOR): deviation_of_field(scatter.gains),
    }
    found = []
    if scatter.dark is not None:
        deviations[Stage.ROW_NOISE_AND_HOT_PIXELS, Scope.FRAME] = deviation_of_rows(scatter.dark)
        stderr = setting.stderr.get("read_noise_e", 0.0)
        noise = white_noise(scatter.dark, fit.model.forward.sensor, setting.sensor, stderr)
        found += name_read_noise(effects, noise, setting.sensor, scales)
    if search is not None:
        components, jitter = measure_components(search), measure_jitter(search)
        for name, key in COMPONENTS.items():
            none = Fluctuation(Interval.around(0.0, 0.0), 0.0, ("no such component is needed",))
            deviations[key] = deviation_of_fluctuation(components.get(name, none))
        if jitter is not None:
            deviations[Stage.COORDINATES, Scope.FRAME] = deviation_of_fluctuation(jitter)
    return (*found, *name_scatter(effects, deviations, scatter.hot_pixels, scales))
