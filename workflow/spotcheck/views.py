"""The views stage: what each model expects of each measured crop, pixel by pixel, and what it leaves of the frame.

The declared and the extended model stand beside a frame as in the verdict: each with the brightness, width and centre
that fit this frame best. How far these lie from the law that all frames share is kept as well. The simulated baseline
is the law alone, on the fitted centre.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck import progress, simulation, store
from spotcheck.dataset import Dataset
from spotcheck.estimate.fits import preferred
from spotcheck.model.baseline import of_instrument
from spotcheck.old_engine.boundary import new_sensor
from spotcheck.old_engine.model import chain
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, View
from spotcheck.old_engine.model.effect import Place, Present
from spotcheck.old_engine.model.extended import Extended, Site
from spotcheck.old_engine.nuisance.numbers import Numbered, fit_numbers
from spotcheck.old_engine.observe.frames import Setting, whole
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Lights, Model, Numbers
from spotcheck.old_engine.observe.shots import Shot
from spotcheck.old_engine.verdict.extended import site_of_shot
from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.model import NoiseLine, noise_line

# Readings are kept in steps of a power of two [DN], of which full scale has no more than this: the last number of 16
# bits stands for NaN.
MOST_STEPS = 65_000
MODELS = {
    "simulated": "the baseline simulated at p1, p2 and peak",
    "declared": "the declared model with the frame's own brightness, width and centre",
    "extended": "the extended model with the frame's own brightness, width and centre",
}
# By how much a frame differs from what all frames share, with unit and meaning.
DEVIATIONS = {
    "brighter": ("1", "brightness of the frame over that of the law of all frames, less 1"),
    "wider": ("1", "width of the frame over that of the law of all frames, less 1"),
    "right": ("pixel", "centre of the spot to the right of its site's"),
    "down": ("pixel", "centre of the spot below its site's"),
}


def rms_left(measured: np.ndarray, mean: np.ndarray, line: NoiseLine) -> tuple[float, float]:
    """Rms of measured less mean readings [row, column], NaN where nothing was measured: in DN, and over the noise."""
    square = (measured - mean) ** 2
    if not np.isfinite(square).any():
        return np.nan, np.nan
    return float(np.sqrt(np.nanmean(square))), float(np.sqrt(np.nanmean(square / line.variance(mean))))


class Fitted(NamedTuple):
    """The extended model with the numbers of each frame [frame], the same without each effect, and by name of
    `DEVIATIONS` how far frames are from what all share, with standard errors."""

    model: Model
    without: tuple[Model, ...]
    deviations: dict[str, np.ndarray]
    stderr: dict[str, np.ndarray]


def fitted(frames: Sequence[Frame], start: Model, extended: Extended, sites: Sequence[Site]) -> Fitted:
    """The extended model on frames of some sites; `start` is the declared model with their numbers."""
    lights = _lights(extended, sites)
    own = fit_numbers(frames, start._replace(present=extended.present, lights=lights))
    others = []
    for left_out in progress.over(extended.present, "fitting without each effect"):
        present = tuple(one for one in extended.present if one is not left_out)
        numbers = _numbers_without(frames, own.model, present, extended)
        shape = None if left_out.effect.place is Place.SHAPE else lights
        others.append(own.model._replace(present=present, numbers=numbers, lights=shape))
    return Fitted(own.model, tuple(others), *_deviations(frames, own, extended, sites))


def _lights(extended: Extended, sites: Sequence[Site]) -> Lights | None:
    if not extended.lights:
        return None
    known = [extended.spots.get(site) for site in sites]
    which = np.array([(spot and spot.light) or 0 for spot in known])
    first = extended.lights[0]
    coefficients = np.array([own.coefficients for own in extended.lights])
    return Lights(first.step, coefficients, which, np.zeros(len(extended.lights)))


def _state(view: View, baseline: Baseline, base: chain.Law | Free, present: Sequence[Present]) -> np.ndarray:
    """Logs of peak and width."""
    return np.array([float(np.squeeze(np.log(own))) for own in chain.spot_state(view, baseline, base, present)])


def _numbers_without(frames: Sequence[Frame], model: Model, present: Sequence[Present], extended: Extended) -> Numbers:
    """Numbers of frames where an effect is gone: what it does to the law of brightness and width goes with it."""
    if extended.law is None:
        return model.numbers
    one = Free(np.ones((1, 1, 1)), np.ones((1, 1, 1)))
    log_peak, log_width = (own.copy() for own in model.numbers[:2])
    for k, frame in enumerate(frames):
        by_law, alone = (
            _state(frame.view, model.baseline, base, present) - _state(frame.view, model.baseline, base, model.present)
            for base in (extended.law, one)
        )
        # What acts on brightness alone the chain takes away by itself.
        log_peak[k] += by_law[0] - alone[0]
        log_width[k] += by_law[1] - alone[1]
    return model.numbers._replace(log_peak=log_peak, log_width=log_width)


def _deviations(
    frames: Sequence[Frame], own: Numbered, extended: Extended, sites: Sequence[Site]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    model, names = own.model, list(DEVIATIONS)
    value, stderr = np.full((4, len(frames)), np.nan), np.full((4, len(frames)), np.nan)
    ready = Expectation(frames, model)
    for k, (frame, site) in enumerate(zip(frames, sites, strict=True)):
        numbers, spot = [float(v[k]) for v in model.numbers], extended.spots.get(site)
        base = Free(*(np.full((1, 1, 1), np.exp(v)) for v in numbers[:2]))
        if extended.law is not None:
            here = _state(frame.view, model.baseline, base, model.present)
            value[:2, k] = np.expm1(here - _state(frame.view, model.baseline, extended.law, model.present))
        if spot is not None:
            value[2:, k] = numbers[2] - spot.x_px, numbers[3] - spot.y_px
        seen = ready.of(frame, k)
        # What the model does not tell widens the errors of what it does.
        rest = float(np.nanmean((frame.pixels - seen.mean) ** 2 / seen.variance))
        covariance = np.linalg.pinv(own.information[k], hermitian=True) * max(rest, 1.0)
        stderr[:, k] = np.sqrt(np.diag(covariance))
    stderr[:2] *= 1 + value[:2]
    return dict(zip(names, value, strict=True)), dict(zip(names, stderr, strict=True))


def variables(step: float, models: Sequence[str], effects: bool) -> dict[str, store.Variable]:
    """What the file holds of each frame; `effects`: whether the extended model has any."""
    out = {}
    for name in models:
        words = MODELS[name]
        out[name] = store.Variable(("y", "x"), "u2", "DN", f"mean reading by {words}", step)
        out[f"{name}_rms"] = store.Variable((), "f8", "DN", f"rms of measured less mean reading by {words}")
        out[f"{name}_left"] = store.Variable((), "f8", "1", f"the same over the sensor's noise, by {words}")
    if "extended" in models:
        for name, (unit, meaning) in DEVIATIONS.items():
            out[name] = store.Variable((), "f8", unit, meaning)
            out[f"{name}_stderr"] = store.Variable((), "f8", unit, f"standard error of {meaning}")
    if effects:
        text = "mean reading by the extended model without one of its effects"
        out["extended_without"] = store.Variable(("without", "y", "x"), "u2", "DN", text, step)
    return out


def step_of(full_scale: float) -> float:
    """The step in which readings are kept [DN]."""
    return float(2.0 ** np.ceil(np.log2(full_scale / MOST_STEPS)))


def write(
    dataset: Dataset,
    files: Mapping[str, xr.Dataset],
    frames: tuple[Sequence[Shot], Setting] | None,
    model: Extended | None,
    path: Path,
    *,
    why_not: str,
    code: str,
    inputs: Sequence[str | Path],
) -> None:
    """Write the views of every spot, frame by frame; `files` are crops, fits, calibration and sensor by name, `frames`
    those that a verdict can use; `why_not` says why there is no extended model."""
    side, full_scale = dataset.instrument.crop_px, float(files["sensor"]["full_scale_dn"])
    sensor = None if frames is None else new_sensor(frames[1].sensor)
    line = noise_line(sensor)
    extra = xr.Dataset(attrs={"extended": why_not or "model.yaml"})
    for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
        extra[name] = (name, np.arange(side, dtype="i4"), {"units": "pixel", "long_name": text})
    effects = [] if model is None else [own.effect.name for own in model.present]
    if effects:
        attributes = {"units": "1", "long_name": "effect that is left out"}
        extra["without"] = ("without", np.array(effects, dtype=object), attributes)
    extra["noise_at_zero"] = ((), line.at_zero, {"units": "DN2", "long_name": "variance of a reading of 0 DN"})
    extra["noise_slope"] = ((), line.slope, {"units": "DN", "long_name": "rise of that variance for each DN of mean"})
    models = [name for name in MODELS if name == "simulated" or (frames and (name == "declared" or model is not None))]
    held = variables(step_of(full_scale), models, bool(effects))
    measured = files["crops"]["image"].sel(centring="light")
    dims = store.grid_dims(files["crops"])
    with store.frame_writer(path, dataset, extra, held, code=code, inputs=inputs) as writer:
        for found in (
            _simulated(dataset, files, sensor),
            *([] if frames is None else [_judged(dataset, frames, model)]),
        ):
            for index, values in progress.over(found, "views of frames", len(dataset.spots)):
                image = measured.isel(dict(zip(dims, index, strict=True))).values.astype(float)
                for name in [name for name in MODELS if name in values]:
                    rms, over = rms_left(image, values[name], line)
                    values |= {f"{name}_rms": rms, f"{name}_left": over}
                writer.put(index, {k: np.clip(v, 0.0, full_scale) if held[k].step else v for k, v in values.items()})


def _simulated(
    dataset: Dataset, files: Mapping[str, xr.Dataset], sensor: SensorModel | None
) -> Iterator[tuple[tuple[int, ...], dict[str, Any]]]:
    """The simulated baseline on the fitted centre of every spot; without a usable spot there is no light."""
    crops, fits = files["crops"].sel(centring="light"), preferred(files["fits"])
    states = simulation.spot_states(dataset, files["calibration"], files["fits"])
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    dims, pixel = store.grid_dims(files["crops"]), np.arange(dataset.instrument.crop_px, dtype=float)
    for index, row in dataset.cells():
        at = dict(zip(dims, index, strict=True))
        crop, fit, state = crops.isel(at), fits.isel(at), states[index]
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


def _judged(
    dataset: Dataset, judged: tuple[Sequence[Shot], Setting], extended: Extended | None
) -> Iterator[tuple[tuple[int, ...], dict[str, Any]]]:
    """The declared and the extended model on every frame that a verdict can use."""
    shots, setting = judged
    ready = whole(shots, setting)
    if isinstance(ready, str):
        return
    frames, declared = ready.frames, Model(setting.baseline, setting.sensor, (), ready.numbers)
    declared = fit_numbers(frames, declared).model
    models, own = {"declared": Expectation(frames, declared)}, None
    if extended is not None:
        sites = [site_of_shot(shot, dataset.instrument, extended.law is not None) for shot in shots]
        own = fitted(frames, declared, extended, sites)
        models["extended"] = Expectation(frames, own.model)
    others = [] if own is None else [Expectation(frames, other) for other in own.without]
    for k, (shot, frame) in enumerate(zip(shots, frames, strict=True)):
        places = (shot.angle_deg, shot.exposure_s, shot.repeat, *shot.conditions)
        index = tuple(axis.index(value) for axis, value in zip(dataset.axes, places, strict=True))
        values: dict[str, Any] = {name: expected.of(frame, k).mean for name, expected in models.items()}
        if own is not None:
            values |= {name: own.deviations[name][k] for name in DEVIATIONS}
            values |= {f"{name}_stderr": own.stderr[name][k] for name in DEVIATIONS}
        if others:
            values["extended_without"] = np.array([other.of(frame, k).mean for other in others])
        yield index, values
