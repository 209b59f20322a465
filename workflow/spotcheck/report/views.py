"""The views stage: the mean reading of each measured crop by each model, and the rms of the residual.

The declared model is that of the instrument file; its part without the sensor is the baseline. The extended model also
has the effects and learned light shapes that the verdict added. Both are fitted to each frame with free brightness,
width and centre. A law gives brightness and width by the exposure (parameters p1, p2 and peak); the deviations of each
frame from it are stored as well. The simulated baseline follows the law alone, at the fitted centre.

A crop is the square part of a frame around its spot. The peak and the width σ_g are those of the Gaussian spot. A site
is the place of a spot: one angle, repeat and set of declared conditions. A light is a learned shape; each pose
(orientation of the sample) may have its own. An effect is a physical cause of a difference between model and frames.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.evaluation import evaluate
from spotcheck.discrepancy.frames import FrameParameters, FrameSet
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.laws import predict_spots, spot_conditions
from spotcheck.discrepancy.residuals import select_all_pixels
from spotcheck.discrepancy.starting_spots import acts_on_mean, fit_spots
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.spot_states import list_spot_states
from spotcheck.io import progress, store
from spotcheck.model.baseline import Baseline, build_baseline
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from spotcheck.model.model_file import ExtendedModel, Site, site_of
from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.model import NoiseLine, noise_line

# Largest number of steps up to full scale; readings are stored as 16-bit multiples of a step, the last code being NaN.
MAX_STEPS = 65_000
# Meaning of each model by its name, which begins the names of its variables; the meaning completes their long names.
MODELS = {
    "simulated": "the baseline simulated at p1, p2 and peak",
    "declared": "the declared model with the frame's own brightness, width and centre",
    "extended": "the extended model with the frame's own brightness, width and centre",
}
# Deviations of a frame from the law of all frames and from its site: (unit, meaning) by name of the variable.
DEVIATIONS = {
    "brighter": ("1", "brightness of the frame over that of the law of all frames, less 1"),
    "wider": ("1", "width of the frame over that of the law of all frames, less 1"),
    "right": ("pixel", "centre of the spot to the right of its site's"),
    "down": ("pixel", "centre of the spot below its site's"),
}

# Index of a frame on the grid of the dataset, in the order of `Dataset.axes`.
Index = tuple[int, ...]
# For each frame, its index and the values of variables of views.nc by name: images [y, x] in DN, and numbers.
FrameViews = Iterator[tuple[Index, dict[str, Any]]]


@dataclass(frozen=True)
class ViewedFrames:
    """The usable frames of a dataset, with the camera and the declared light."""

    frames: FrameSet  # F frames
    cells: Sequence[tuple[Index, Frame]]  # (index on the grid, row of the manifest) of each frame [F]
    start: FrameParameters  # spot of each frame, from which fits start
    baseline: Baseline  # declared light
    sensor: SensorModel  # sensor of sensor.nc


@dataclass(frozen=True)
class ModelledFrames:
    """A model fitted to each of F frames; frames may have different lights."""

    lights: tuple[ForwardModel, ...]  # model with each light, without a law, with the effects on the mean reading only
    light_index: np.ndarray  # index in `lights` of the light of each frame [frame]
    spots: FrameParameters  # spots of the frames
    covariance: np.ndarray  # of ln peak, ln σ_g, x and y of each fitted spot [frame, 4, 4]

    def predict_mean(self, frames: FrameSet, k: int) -> np.ndarray:
        """Return the mean reading [row, column] in DN of the crop of frame `k` of `frames`."""
        index = np.array([k])
        frame = frames.select(index)
        model = JointModel(self.lights[self.light_index[k]], self.spots.select(index), frame.design)
        return evaluate(model, select_all_pixels(frame), slice(0, 1), with_slopes=False).moments.mean[0]

    def compute_log_spots(self, frames: FrameSet) -> np.ndarray:
        """Return ln peak [DN] and ln σ_g [px] of the fitted spots after the effects act on them, [2, frame]."""
        # All lights give the same spots: they only differ in the learned shape.
        return compute_log_spots(self.lights[0], frames, self.spots)

    def remove_effect(self, name: str, spots: FrameParameters) -> "ModelledFrames":
        """Return the model without the effect `name`, with `spots` in place of the fitted ones."""
        lights = tuple(
            replace(light, effects=tuple(applied for applied in light.effects if applied.effect.name != name))
            for light in self.lights
        )
        return replace(self, lights=lights, spots=spots)


@dataclass(frozen=True)
class ExtendedViews:
    """The extended model on F frames."""

    model: ModelledFrames  # model with all effects
    without: tuple[ModelledFrames, ...]  # model without each of its effects, in their order
    deviations: dict[str, np.ndarray]  # deviations by name of `DEVIATIONS` [frame]; NaN if unknown
    stderr: dict[str, np.ndarray]  # their standard errors


def compute_log_spots(forward: ForwardModel, frames: FrameSet, spots: FrameParameters | None = None) -> np.ndarray:
    """Return ln peak [DN] and ln σ_g [px] of the spots of frames, [2, frame], including what effects change in them.

    Parameters
    ----------
    forward : ForwardModel
        Model with a law; without one `spots` must be given.
    frames : FrameSet
        The frames.
    spots : FrameParameters, optional
        Brightness and width of each frame, on which the effects of a model without law act.
    """
    conditions = spot_conditions(frames.design)
    if spots is not None:
        peak, sigma = (np.exp(values)[:, None, None] for values in (spots.log_peak, spots.log_sigma))
        conditions = replace(conditions, peak_dn=peak, sigma_px=sigma)
    return predict_spots(forward, conditions)


def fit_declared(viewed: ViewedFrames) -> ModelledFrames:
    """Return the declared model fitted to each frame, with free brightness, width and centre."""
    # With a "free" photon budget no law ties the brightness to the exposure.
    forward = ForwardModel(replace(viewed.baseline, photon_budget="free"), viewed.sensor)
    fitted = fit_spots(forward, viewed.frames, viewed.start)
    return ModelledFrames((forward,), np.zeros(len(viewed.frames), int), fitted.spots, fitted.covariance)


def fit_extended(viewed: ViewedFrames, extended: ExtendedModel, sites: Sequence[Site]) -> ExtendedViews:
    """Return the extended model fitted to each frame, and without each of its effects.

    Parameters
    ----------
    viewed : ViewedFrames
        The frames; their `start` should be the fitted spots of the declared model.
    extended : ExtendedModel
        The extended model of model.yaml.
    sites : sequence of Site
        Site of each frame.
    """
    # A frame has the first light if the model does not know its site or has no light for it.
    light_index = np.array([(spot and spot.light) or 0 for spot in map(extended.spots.get, sites)], int)
    baseline = replace(viewed.baseline, photon_budget="free")
    # Without a learned light, the shape is that of the baseline.
    shapes = extended.lights or (baseline.learned,)
    effects = tuple(filter(acts_on_mean, extended.effects))
    lights = tuple(ForwardModel(replace(baseline, learned=shape), viewed.sensor, None, effects) for shape in shapes)
    model = ModelledFrames(lights, light_index, *_fit_each_light(lights, light_index, viewed))
    without = []
    for applied in progress.track(extended.effects, "models without each effect"):
        reduced = model.remove_effect(applied.effect.name, _predict_spots_without(viewed, extended, model, applied))
        # An effect without stages is the learned light; without it the declared light remains.
        if not applied.effect.stages:
            reduced = replace(reduced, lights=tuple(replace(light, baseline=baseline) for light in reduced.lights))
        without.append(reduced)
    return ExtendedViews(model, tuple(without), *_measure_deviations(viewed, extended, model, sites))


def _fit_each_light(
    lights: Sequence[ForwardModel], light_index: np.ndarray, viewed: ViewedFrames
) -> tuple[FrameParameters, np.ndarray]:
    """Return the spot of each frame and its covariance, fitted with the model of its light.

    This model is `lights[light_index[frame]]`.
    """
    rows = np.empty_like(viewed.start.as_rows())
    covariance = np.empty((len(viewed.frames), len(rows), len(rows)))
    for k, forward in enumerate(lights):
        indices = np.flatnonzero(light_index == k)
        fitted = fit_spots(forward, viewed.frames.select(indices), viewed.start.select(indices))
        rows[:, indices], covariance[indices] = fitted.spots.as_rows(), fitted.covariance
    return FrameParameters(*rows), covariance


def _predict_spots_without(
    viewed: ViewedFrames, extended: ExtendedModel, model: ModelledFrames, removed: AppliedEffect
) -> FrameParameters:
    """Return the fitted spots, corrected by the change of the law's brightness and width when an effect is removed.

    The fitted spots are returned unchanged if the effect does not change the law, or if there is no law.
    """
    spots = model.spots
    if extended.law is None:
        return spots
    remaining = [applied for applied in extended.effects if applied is not removed]
    law_without, law_with = (
        compute_log_spots(ForwardModel(viewed.baseline, viewed.sensor, extended.law, tuple(effects)), viewed.frames)
        for effects in (remaining, extended.effects)
    )
    # `remove_effect` already removes the effect's change of the fitted brightness and width; it must not count twice.
    fit_without = compute_log_spots(model.remove_effect(removed.effect.name, spots).lights[0], viewed.frames, spots)
    change = law_without - law_with - (fit_without - model.compute_log_spots(viewed.frames))
    change = np.where(np.isfinite(change), change, 0.0)
    return replace(spots, log_peak=spots.log_peak + change[0], log_sigma=spots.log_sigma + change[1])


def _measure_deviations(
    viewed: ViewedFrames, extended: ExtendedModel, model: ModelledFrames, sites: Sequence[Site]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the deviations of frames from law and site, and their standard errors, by name of `DEVIATIONS` [frame].

    Brightness and width are NaN without a law. The centre is NaN for a frame whose site is unknown to the model.
    """
    # Rows in the order of `DEVIATIONS`: relative brightness and width, column and row.
    value = np.full((len(DEVIATIONS), len(viewed.frames)), np.nan)
    spots = model.spots
    if extended.law is not None:
        law_model = ForwardModel(viewed.baseline, viewed.sensor, extended.law, tuple(extended.effects))
        log_spots_by_law = compute_log_spots(law_model, viewed.frames)
        value[:2] = np.expm1(model.compute_log_spots(viewed.frames) - log_spots_by_law)
    for k, site in enumerate(sites):
        if (spot := extended.spots.get(site)) is not None:
            value[2:, k] = spots.x[k] - spot.x_px, spots.y[k] - spot.y_px
    # Rounding may make a variance slightly negative.
    stderr = np.sqrt(np.maximum(np.diagonal(model.covariance, axis1=1, axis2=2).T, 0.0))
    # The fit gives errors of ln peak and ln σ_g; d(ratio) = ratio · d(ln ratio). Errors of law and site are excluded.
    stderr[:2] *= 1 + value[:2]
    stderr = np.where(np.isfinite(value), stderr, np.nan)
    return dict(zip(DEVIATIONS, value, strict=True)), dict(zip(DEVIATIONS, stderr, strict=True))


def list_variables(step: float, models: Sequence[str], has_effects: bool) -> dict[str, store.Variable]:
    """Return the definitions of the variables of views.nc by name.

    Parameters
    ----------
    step : float
        Step of stored readings [DN].
    models : sequence of str
        Keys of `MODELS` that the file has.
    has_effects : bool
        Whether the extended model has any effect.
    """
    variables = {}
    for name in models:
        meaning = MODELS[name]
        variables[name] = store.Variable(("y", "x"), "u2", "DN", f"mean reading by {meaning}", step)
        variables[f"{name}_rms"] = store.Variable((), "f8", "DN", f"rms of measured less mean reading by {meaning}")
        variables[f"{name}_left"] = store.Variable((), "f8", "1", f"the same over the sensor's noise, by {meaning}")
    if "extended" in models:
        for name, (unit, meaning) in DEVIATIONS.items():
            variables[name] = store.Variable((), "f8", unit, meaning)
            variables[f"{name}_stderr"] = store.Variable((), "f8", unit, f"standard error of {meaning}")
    if has_effects:
        text = "mean reading by the extended model without one of its effects"
        variables["extended_without"] = store.Variable(("without", "y", "x"), "u2", "DN", text, step)
    return variables


def choose_step(full_scale: float) -> float:
    """Return the step of stored readings [DN]: the smallest power of two that needs at most `MAX_STEPS` steps."""
    return float(2.0 ** np.ceil(np.log2(full_scale / MAX_STEPS)))


def rms_residual(measured: np.ndarray, mean: np.ndarray, line: NoiseLine) -> tuple[float, float]:
    """Return (rms of the residuals [DN], rms of the residuals divided by the standard deviation of the noise [1]).

    The residuals are `measured` − `mean`, both readings [row, column] in DN. `line` gives the variance of the noise at
    a mean reading. NaN pixels are ignored; both results are NaN if no pixel is finite.
    """
    square = (measured - mean) ** 2
    if not np.isfinite(square).any():
        return np.nan, np.nan
    return float(np.sqrt(np.nanmean(square))), float(np.sqrt(np.nanmean(square / line.variance(mean))))


def write_views(
    dataset: Dataset,
    files: Mapping[str, xr.Dataset],
    viewed: ViewedFrames | None,
    model: ExtendedModel | None,
    path: Path,
    *,
    reason: str,
    code: str,
    inputs: Sequence[str | Path],
) -> None:
    """Write views.nc, frame by frame.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    files : mapping of str to Dataset
        Content of crops.nc, fits.nc, calibration.nc and sensor.nc by name without suffix.
    viewed : ViewedFrames or None
        Frames that a verdict can use; None if there are none.
    model : ExtendedModel or None
        The extended model; None if there is none, as without `viewed`.
    path : Path
        File to write.
    reason : str
        Why there is no extended model; "" if there is one.
    code : str
        Digest of the code that computes the file.
    inputs : sequence of str or Path
        Files that the result depends on.
    """
    full_scale = float(files["sensor"]["full_scale_dn"])
    sensor = None if viewed is None else viewed.sensor
    line = noise_line(sensor)
    effect_names = [] if model is None else [applied.effect.name for applied in model.effects]
    models = [name for name in MODELS if name == "simulated" or (viewed and (name == "declared" or model is not None))]
    variables = list_variables(choose_step(full_scale), models, bool(effect_names))
    measured, dims = files["crops"]["image"].sel(centring="light"), store.grid_dims(files["crops"])
    extra = _list_coordinates(dataset, line, effect_names).assign_attrs(extended=reason or "model.yaml")
    with store.frame_writer(path, dataset, extra, variables, code=code, inputs=inputs) as writer:
        sources = [simulate_views(dataset, files, sensor)]
        if viewed is not None:
            sources.append(model_views(dataset, viewed, model))
        for views in sources:
            for index, values in progress.track(views, "views of frames", len(dataset.spots)):
                image = measured.isel(dict(zip(dims, index, strict=True))).values.astype(float)
                for name in [name for name in MODELS if name in values]:
                    rms, over_noise = rms_residual(image, values[name], line)
                    values |= {f"{name}_rms": rms, f"{name}_left": over_noise}
                # Only images have a step; the codes of their integers end at full scale.
                clipped = {k: np.clip(v, 0.0, full_scale) if variables[k].step else v for k, v in values.items()}
                writer.put(index, clipped)


def _list_coordinates(dataset: Dataset, line: NoiseLine, effect_names: Sequence[str]) -> xr.Dataset:
    """Return the coordinates of views.nc other than those of the grid, and the parameters of the sensor's noise.

    The variance of a reading [DN²] is noise_at_zero + noise_slope · mean reading [DN].
    """
    pixels, ds = np.arange(dataset.instrument.crop_px, dtype="i4"), xr.Dataset()
    for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
        ds[name] = (name, pixels, {"units": "pixel", "long_name": text})
    if effect_names:
        attributes = {"units": "1", "long_name": "effect that is left out"}
        ds["without"] = ("without", np.array(effect_names, dtype=object), attributes)
    ds["noise_at_zero"] = ((), line.at_zero, {"units": "DN2", "long_name": "variance of a reading of 0 DN"})
    ds["noise_slope"] = ((), line.slope, {"units": "DN", "long_name": "rise of that variance for each DN of mean"})
    return ds


def simulate_views(dataset: Dataset, files: Mapping[str, xr.Dataset], sensor: SensorModel | None) -> FrameViews:
    """Yield the mean reading of the simulated baseline at the fitted centre of each spot frame.

    Each image is the value of the key "simulated", [y, x] in DN. The spot is in the middle of the crop if the fit is
    not trusted. A frame without a usable spot has no light. The mean light, in DN above the black level, is yielded in
    place of the reading if `sensor` is None (unknown). `files` is as in `write_views`.
    """
    crops, fits = files["crops"].sel(centring="light"), select_preferred_fits(files["fits"])
    states = list_spot_states(dataset, files["calibration"], files["fits"])
    baseline = build_baseline(dataset.instrument, dataset.exposures)
    dims, pixel = store.grid_dims(files["crops"]), np.arange(dataset.instrument.crop_px, dtype=float)
    for index, row in dataset.cells():
        selection = dict(zip(dims, index, strict=True))
        crop, fit, state = crops.isel(selection), fits.isel(selection), states[index]
        x0, y0 = float(fit["x_centre"] - crop["left"]), float(fit["y_centre"] - crop["top"])
        if int(fit["status"]) & store.UNTRUSTED or not np.isfinite([x0, y0]).all():
            x0 = y0 = float(len(pixel) // 2)
        light = np.zeros((len(pixel), len(pixel)))
        if np.isfinite(state.peak_dn):
            light = baseline.declared_light(pixel[None, :], pixel[:, None], state.peak_dn, x0, y0, state.sigma_px)
        if sensor is not None:
            distribution = ReadingDistribution(sensor, exposure_s=row.exposure_s or 0.0)
            light = distribution.tabulate(float(light.max())).mean(light)
        yield index, {"simulated": light}


def model_views(dataset: Dataset, viewed: ViewedFrames, model: ExtendedModel | None) -> FrameViews:
    """Yield mean readings of the declared and the extended model, and deviations, of each frame of `viewed`.

    The keys of the values are those of `list_variables` without the rms. `model` is the extended model; None if there
    is none.
    """
    declared = fit_declared(viewed)
    extended = None
    if model is not None:
        # Without a law over the exposure, frames of different exposures count as different sites.
        has_law = model.law is not None
        sites = [site_of(row, dataset.instrument.conditions, has_law) for _, row in viewed.cells]
        extended = fit_extended(replace(viewed, start=declared.spots), model, sites)
    for k, (index, _) in enumerate(viewed.cells):
        values: dict[str, Any] = {"declared": declared.predict_mean(viewed.frames, k)}
        if extended is not None:
            values["extended"] = extended.model.predict_mean(viewed.frames, k)
            values |= {name: deviation[k] for name, deviation in extended.deviations.items()}
            values |= {f"{name}_stderr": stderr[k] for name, stderr in extended.stderr.items()}
            if extended.without:
                readings = [reduced.predict_mean(viewed.frames, k) for reduced in extended.without]
                values["extended_without"] = np.array(readings)
        yield index, values
