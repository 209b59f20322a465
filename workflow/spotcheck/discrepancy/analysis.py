"""Order of work for the spot frames of a dataset: from crops to all that is concluded.

1. Hot pixels and the declared fit. 2. Scatter of pixels, which enters the variance of readings. 3. Effects of the mean
image. 4. Scatter again, beside them. 5. Laws of brightness and width. 6. Held-out repeats.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import changes_mean_image
from spotcheck.discrepancy.evidence import invert_information
from spotcheck.discrepancy.fields import FieldEstimate, estimate_granular_light, estimate_pixel_gains, measure_fields
from spotcheck.discrepancy.fluctuations import Fluctuation, measure_components, measure_jitter
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, select_pixels
from spotcheck.discrepancy.hot_pixels import mask_hot_pixels
from spotcheck.discrepancy.joint_fit import READ_NOISE_RANGE, FreeParameter, JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawFit, LawSearch, NamedLaw, SpotNumbers, find_laws, is_law
from spotcheck.discrepancy.light_shape import ShapeExplanation, explain_shape, fit_free_shape
from spotcheck.discrepancy.mixed_model import Interval
from spotcheck.discrepancy.named_scatter import (
    Deviation,
    NamedScatter,
    deviation_of_field,
    deviation_of_fluctuation,
    deviation_of_rows,
    name_read_noise,
    name_scatter,
)
from spotcheck.discrepancy.residual_peaks import find_peaks
from spotcheck.discrepancy.residuals import ResidualImages, measure_residuals
from spotcheck.discrepancy.saturated_start import fit_saturated
from spotcheck.discrepancy.scatter import DarkNoise, measure_dark_noise
from spotcheck.discrepancy.selection import SelectedEffects, select_effects
from spotcheck.discrepancy.validation import Prediction, predict_frames
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import Effect, EffectScales, Scope
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Rank of the reading of a frame that counts as its brightest: hot pixels do not.
BRIGHT_RANK = 40
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


@dataclass(frozen=True)
class Scatter:
    """Scatter of pixels about a fit."""

    dark: DarkNoise | None  # noise of dark pixels; None if there are too few
    grains: FieldEstimate  # granular light, new at each site
    gains: FieldEstimate  # gains of pixels
    hot_pixels: int  # number of hot pixels


@dataclass(frozen=True)
class Analysis:
    """All that is concluded of a set of spot frames."""

    declared: JointFit  # fit without effects
    selected: SelectedEffects  # effects of the mean image
    shape: ShapeExplanation | None  # what stands for a free light shape; None beside the declared one
    scatter: Scatter  # scatter of pixels beside them
    named_scatter: tuple[NamedScatter, ...]  # effects that scatter
    laws: tuple[NamedLaw, ...]  # laws of brightness and width
    rivals: tuple[tuple[str, ...], ...]  # sets of laws that the frames cannot tell from these
    law_fit: LawFit | None  # fit of the laws; None without a law of the exposure
    predictions: tuple[Prediction, ...]  # of held-out frames: declared, with the effects, with the laws; maybe none


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
    frames, hot_pixels = mask_hot_pixels(frames, setting.sensor)
    is_held_out = frames.held_out()
    searched, start = frames.select(np.flatnonzero(~is_held_out)), spots.select(np.flatnonzero(~is_held_out))
    declared = fit_declared(searched, start, setting)
    images = measure_residuals(declared.model, searched)
    scatter = measure_scatter(images, declared, hot_pixels)
    scales = scales_of(searched, declared.model, setting, images)
    mean_effects = [effect for effect in effects if changes_mean_image(effect)]
    baseline = fit_saturated(declared, searched, effects, scales)
    log(f"first fit: {', '.join(baseline.model.effect_names) or 'no effect'}, converged {baseline.has_converged}")
    free = fit_free_shape(baseline)
    selected = select_effects(baseline, free, mean_effects, scales, log)
    shape = None
    if selected.fit.model.grid is not None:
        shape = explain_shape(selected.fit, mean_effects, scales, log)
    if selected.fit is not declared:
        images = measure_residuals(selected.fit.model, searched)
        scatter = measure_scatter(images, selected.fit, hot_pixels)
    if setting.baseline.photon_budget == "free":
        named = name_all_scatter(effects, scatter, selected.fit, setting, scales, None)
        return Analysis(declared, selected, shape, scatter, named, (), (), None, ())
    search = law_search(selected.fit, setting, scales)
    named = name_all_scatter(effects, scatter, selected.fit, setting, scales, search)
    laws, rivals, law_fit = find_laws(search, [effect for effect in effects if is_law(effect)])
    before = search.fit([]) if selected.fit is declared else law_search(declared, setting, scales).fit([])
    extended = replace(setting.baseline, learned=selected.fit.model.forward.baseline.learned)
    models = (
        ForwardModel(setting.baseline, setting.sensor, before.law),
        ForwardModel(extended, setting.sensor, search.fit([]).law, selected.fit.model.forward.effects),
        ForwardModel(extended, setting.sensor, law_fit.law, (*selected.fit.model.forward.effects, *law_fit.effects)),
    )
    unseen, at = frames.select(np.flatnonzero(is_held_out)), spots.select(np.flatnonzero(is_held_out))
    predictions = tuple(predict_frames(model, unseen, at) for model in models) if is_held_out.any() else ()
    return Analysis(declared, selected, shape, scatter, named, tuple(laws), tuple(rivals), law_fit, predictions)


def fit_declared(frames: FrameSet, spots: FrameParameters, setting: Setting) -> JointFit:
    """Return the fit of the declared model; the read noise is a nuisance parameter."""
    noise = setting.sensor.read_noise_e
    free = FreeParameter("", "read_noise_e", READ_NOISE_RANGE[0] * noise, READ_NOISE_RANGE[1] * noise)
    baseline = replace(setting.baseline, photon_budget="free")
    model = JointModel(ForwardModel(baseline, setting.sensor), spots, frames.design, (free,))
    return fit_jointly(model, select_pixels(frames, spots))


def measure_scatter(images: ResidualImages, fit: JointFit, hot_pixels: int) -> Scatter:
    """Return the scatter of pixels about a fit."""
    covariances = measure_fields(images)
    return Scatter(
        dark=measure_dark_noise(images, dark_variance_slope(fit.model.forward)),
        grains=estimate_granular_light(covariances),
        gains=estimate_pixel_gains(covariances),
        hot_pixels=hot_pixels,
    )


def dark_variance_slope(forward: ForwardModel) -> float:
    """Return the change of the variance of a dark reading for each DN² of read noise."""
    sensor = forward.sensor
    noises = [sensor.read_noise_e * (1 + shift) for shift in (-NOISE_STEP, NOISE_STEP)]
    low, high = (
        float(replace(forward, sensor=replace(sensor, read_noise_e=noise)).distribution().variance(0.0))
        for noise in noises
    )
    return (high - low) / (sensor.gain_dn_per_e**2 * (noises[1] ** 2 - noises[0] ** 2))


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


def law_search(fit: JointFit, setting: Setting, scales: EffectScales) -> LawSearch:
    """Return the search for laws on the spots of a fit."""
    spots = 4 * fit.equations.frames
    covariance = invert_information(fit.equations.information)[:spots, :spots]
    numbers = SpotNumbers(fit.model.design, fit.model.spots, covariance)
    return LawSearch(numbers, ForwardModel(setting.baseline, setting.sensor), scales)


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
        found += name_read_noise(effects, scatter.dark, fit.model.forward.sensor, setting.sensor, scales)
    if search is not None:
        components, jitter = measure_components(search), measure_jitter(search)
        for name, key in COMPONENTS.items():
            none = Fluctuation(Interval.around(0.0, 0.0), 0.0, ("no such component is needed",))
            deviations[key] = deviation_of_fluctuation(components.get(name, none))
        if jitter is not None:
            deviations[Stage.COORDINATES, Scope.FRAME] = deviation_of_fluctuation(jitter)
    return (*found, *name_scatter(effects, deviations, scatter.hot_pixels, scales))
