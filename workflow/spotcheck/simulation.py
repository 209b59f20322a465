"""The simulate stage: a model as mean images and as a dataset folder of its own. The paper's model runs at the
calibrated parameters, the extended one as its model.yaml says.

The folder keeps the dataset contract, so that simulated frames pass the same stages as measured ones.
"""

import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr
import yaml

from spotcheck import progress, spotfinding, store
from spotcheck.dataset import Dataset
from spotcheck.errors import InputError
from spotcheck.estimate.calibration import USED
from spotcheck.estimate.fits import preferred
from spotcheck.manifest import Frame
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.model.conditions import FrameConditions, crop_grid
from spotcheck.model.forward import ForwardModel, RandomStreams
from spotcheck.model.light import SpotState
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import ExtendedModel, Site, check_bounds, scales_of, site_of
from spotcheck.sensor import SensorModel

# All simulated frames, one page each, in the order of the manifest.
STACK = "frames/simulated.tif"
# Frames are larger than the crop by this factor, so that a crop at a maximum anywhere on the plateau stays inside.
CANVAS = 2

VARIABLES = {
    "mean_light": store.Variable(("y", "x"), "f4", "DN", "mean light of the simulated spot"),
    "amplitude": store.Variable((), "f8", "DN", "peak of the Gaussian before the top hat"),
    "sigma": store.Variable((), "f8", "pixel", "sigma_g, standard deviation of the Gaussian"),
}


EXTENDED_VARIABLES = VARIABLES | {
    "mean_light": store.Variable(("y", "x"), "f4", "DN", "mean light of the extended model; NaN beyond the frame"),
    "mean_reading": store.Variable(("y", "x"), "f4", "DN", "mean reading of the extended model; NaN beyond the frame"),
    "left": store.Variable((), "i4", "pixel", "column of the sensor under column 0 of the crop"),
    "top": store.Variable((), "i4", "pixel", "row of the sensor under row 0 of the crop"),
}


@dataclass(frozen=True)
class SimulatedFrame:
    """A simulated frame."""

    place: tuple[int, ...]  # place on the grid of the dataset
    readings: np.ndarray  # [row, column, DN]
    values: dict[str, Any]  # what the file of means holds of it, by variable


@dataclass(frozen=True)
class Destination:
    """Files of a simulation, and how they are made."""

    folder: Path  # dataset folder of the simulated frames
    path: Path  # file of mean images
    seed: int  # seed of all random numbers
    code: str  # digest of the code
    inputs: Sequence[str | Path]  # files that the simulation depends on


def has_law(calibration: xr.Dataset) -> bool:
    """Return whether p1, p2 and the peak were found; else every frame is simulated at its own fit."""
    return "skipped" not in calibration.attrs and bool(np.isfinite(calibration["peak"].sel(estimator=USED)))


def spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> dict[tuple[int, ...], SpotState]:
    """Return peak and width of every frame of the grid: by the baseline's law, or by its own fit where none was found.

    A frame without a usable spot has the peak NaN.
    """
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    states = {}
    fit = preferred(fits)
    for index, row in dataset.cells():
        if not has_law(calibration):
            at = fit.isel(dict(zip(store.grid_dims(fits), index, strict=True)))
            peak = float(at["amplitude"])
            is_usable = peak > 0 and not int(at["status"]) & store.UNTRUSTED
            states[index] = SpotState(peak if is_usable else np.nan, float(at["sigma_mean"]))
        else:
            p1, p2, peak = (float(calibration[n].sel(estimator=USED)) for n in ("p1_mean", "p2_mean", "peak"))
            peak = peak * baseline.relative_peak(row.exposure_s, p1, p2)
            states[index] = SpotState(peak, baseline.sigma(row.exposure_s, p1, p2))
    return states


def simulate(
    dataset: Dataset,
    states: dict[tuple[int, ...], SpotState],
    sensor: SensorModel | None,
    full_scale: int,
    destination: Destination,
    attributes: Mapping[str, str],
) -> None:
    """Write the simulated dataset folder, and the mean images [grid, y, x] around the spot, frame by frame.

    Without a sensor model the frames are the rounded mean image and the attribute `noise` says so.
    """
    noise = "drawn" if sensor else "none: gain or read noise of the sensor is unknown"
    frames = _baseline_frames(dataset, states, sensor, full_scale, destination.seed)
    _write(dataset, frames, VARIABLES, destination, {"noise": noise} | dict(attributes))
    write_contract(dataset, destination.folder, {"sensor": {"bit_depth": full_scale.bit_length()}})


def _baseline_frames(
    dataset: Dataset,
    states: dict[tuple[int, ...], SpotState],
    sensor: SensorModel | None,
    full_scale: int,
    seed: int,
) -> Iterator[SimulatedFrame]:
    # The paper's model, without what is known of the light's shape beyond it.
    baseline = replace(of_instrument(dataset.instrument, dataset.exposures), learned=None)
    side = dataset.instrument.crop_px
    canvas = CANVAS * side
    inner = slice(canvas // 2 - side // 2, canvas // 2 - side // 2 + side)
    grid = crop_grid(range(canvas), range(canvas), canvas, canvas)
    model = ForwardModel(baseline, sensor or SensorModel(1.0, 0.0, full_scale_dn=full_scale))
    for number, (index, row) in enumerate(dataset.cells()):
        peak, sigma = states[index].peak_dn, states[index].sigma_px
        # A frame without a usable spot is simulated as one without light.
        spot = (peak, sigma) if np.isfinite(peak) else (0.0, 1.0)
        exposure_s = row.exposure_s or 0.0
        frame = FrameConditions(grid, canvas // 2, canvas // 2, exposure_s, 1.0, 1.0, 0.0, 0.5, *spot)
        light = model.light(frame).total
        if sensor is None:
            readings = np.clip(np.rint(light), 0, full_scale).astype(np.uint16)
        else:
            readings = model.sample(frame, RandomStreams(seed, number, number))
        yield SimulatedFrame(index, readings, {"mean_light": light[inner, inner], "amplitude": peak, "sigma": sigma})


def simulate_extended(
    dataset: Dataset,
    model: ExtendedModel,
    sensor: SensorModel,
    destination: Destination,
    name: str,
) -> None:
    """Write the dataset folder that the extended model gives for the design of `dataset`, and what it expects of the
    crop around each spot [grid, y, x]: means over everything that is random.

    Frames are a window of the sensor that holds all spots with a crop to every side, or the whole frame. `name` is the
    model file's; raises `InputError` for a model that does not fit the instrument or the design.
    """
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    if not dataset.exposures:
        # As in the verdict: without exposures nobody knows what a dark current per second brings.
        sensor = replace(sensor, dark_current_e_per_s=0.0)
    side = dataset.instrument.crop_px
    check_model(dataset, model, baseline, sensor, name)
    centres = _centres(dataset, model)
    # Positions stay the sensor's own: pedestals, fringes and smear refer to its whole frame.
    columns, rows = (_window(centres[:, k], side, size) for k, size in enumerate((model.columns, model.rows)))
    frames = _extended_frames(dataset, model, baseline, sensor, centres, (columns, rows), name, destination.seed)
    effects = " ".join(applied.effect.name for applied in model.effects) or "none"
    window = {"window_left_px": columns.start, "window_top_px": rows.start}
    _write(dataset, frames, EXTENDED_VARIABLES, destination, {"noise": "drawn", "effects": effects} | window)
    profile = dataset.instrument.light.profile
    if profile is not None:
        shutil.copyfile(profile, destination.folder / LIGHT)
    write_contract(dataset, destination.folder, _simulated_instrument(dataset, sensor))


def check_model(dataset: Dataset, model: ExtendedModel, baseline: Baseline, sensor: SensorModel, name: str) -> None:
    """Raise `InputError` for a model, of a file of that name, that does not fit the instrument or the design."""
    budget, crop = baseline.photon_budget, dataset.instrument.crop_px
    if not dataset.spots:
        raise InputError("manifest.csv: has no frame of kind spot; there is nothing to simulate")
    if model.law is not None and budget == "free":
        raise InputError(f"{name}: has a law, which the photon budget free of this dataset cannot take")
    if crop > min(model.rows, model.columns):
        raise InputError(f"{name}: the frame has {model.columns} × {model.rows} px, but crop_px is {crop}")
    check_bounds(model, scales_of(model, baseline, sensor, crop, dataset.exposures), name)


def _centres(dataset: Dataset, model: ExtendedModel) -> np.ndarray:
    """Return the centre of every frame's spot [frame, (x, y)] in px of the sensor.

    A site that the model does not know lies where the others lie on average.
    """
    known = [(spot.x_px, spot.y_px) for spot in model.spots.values()]
    middle = np.mean(known, axis=0) if known else ((model.columns - 1) / 2, (model.rows - 1) / 2)
    spots = [model.spots.get(_site(dataset, row, model)) for row in dataset.spots]
    return np.array([middle if spot is None else (spot.x_px, spot.y_px) for spot in spots], float)


def _site(dataset: Dataset, row: Frame, model: ExtendedModel) -> Site:
    return site_of(row, dataset.instrument.conditions, model.law is not None)


def _window(centre: np.ndarray, side: int, pixels: int) -> range:
    """Return the pixels of a window along one axis."""
    low = int(np.clip(np.floor(centre.min()) - side, 0, pixels - side))
    return range(low, int(np.clip(np.ceil(centre.max()) + side + 1, low + side, pixels)))


def _extended_frames(
    dataset: Dataset,
    extended: ExtendedModel,
    baseline: Baseline,
    sensor: SensorModel,
    centres: np.ndarray,
    window: tuple[range, range],
    name: str,
    seed: int,
) -> Iterator[SimulatedFrame]:
    side, count = dataset.instrument.crop_px, len(dataset.spots)
    grid = crop_grid(*window, extended.columns, extended.rows)
    has_order = dataset.instrument.order_known and count > 1
    sites: dict[Site, int] = {}
    for k, (index, row) in enumerate(dataset.cells()):
        spot = extended.spots.get(_site(dataset, row, extended))
        # Without a law, a frame without a usable spot is simulated as one without light.
        peak, width = (0.0, 1.0) if spot is None or spot.peak_dn is None else (spot.peak_dn, spot.sigma_px)
        frame = FrameConditions(
            pixels=grid,
            x0=float(centres[k, 0]),
            y0=float(centres[k, 1]),
            # Exposures that were not recorded count as one second, and an unknown order as its middle, as in the
            # verdict.
            exposure_s=1.0 if row.exposure_s is None else row.exposure_s,
            longest_s=extended.longest_s,
            reference_s=extended.reference_s,
            angle=float(np.deg2rad(row.angle_deg or 0.0)),
            order=k / (count - 1) if has_order else 0.5,
            peak_dn=float(peak),
            sigma_px=float(width or 1.0),
        )
        learned = extended.light_of(spot) if extended.lights else baseline.learned
        model = ForwardModel(replace(baseline, learned=learned), sensor, extended.law, extended.effects)
        state = model.spot(frame)
        if not (
            np.isfinite(state.peak_dn) and state.peak_dn >= 0 and np.isfinite(state.sigma_px) and state.sigma_px > 0
        ):
            raise InputError(
                f"{name}: gives {row.label} a spot of {state.peak_dn:g} DN and width {state.sigma_px:g} px; both must"
                " be above 0"
            )
        # A site is the same at all its exposures.
        site = sites.setdefault(site_of(row, dataset.instrument.conditions, True), len(sites))
        readings = model.sample(frame, RandomStreams(seed, k, site))
        left, top = (pixels.start for pixels in window)
        at = spotfinding.Spot(round(frame.y0) - top, round(frame.x0) - left, True)
        values = {
            "mean_light": spotfinding.cut(np.broadcast_to(model.light(frame).total, readings.shape), at, side),
            "mean_reading": spotfinding.cut(model.expected(frame).mean, at, side),
            "amplitude": float(state.peak_dn),
            "sigma": float(state.sigma_px),
            "left": at.column - side // 2 + left,
            "top": at.row - side // 2 + top,
        }
        yield SimulatedFrame(index, readings, values)


def _simulated_instrument(dataset: Dataset, sensor: SensorModel) -> dict[str, Any]:
    """Return the sections of instrument.yaml that the extended model ran with, so that its frames can be judged."""
    instrument = dataset.instrument
    pitch, depth = instrument.sensor.pixel_pitch_m, int(sensor.full_scale_dn).bit_length()
    keys: dict[str, Any] = {} if pitch is None else {"pixel_pitch_m": pitch}
    keys |= {"bit_depth": depth} | asdict(sensor)
    if sensor.full_scale_dn < 2**depth - 1:
        keys["full_scale_dn"] = int(sensor.full_scale_dn)
    else:
        del keys["full_scale_dn"]
    if not np.isfinite(sensor.full_well_e):
        del keys["full_well_e"]
    sections = {"sensor": keys}
    for name in ("optics", "laser", "material", "model"):
        sections[name] = {key: value for key, value in asdict(getattr(instrument, name)).items() if value is not None}
    if instrument.light.profile is not None:
        sections["light"] = {"profile": LIGHT}
    return {"order_known": instrument.order_known} | {name: section for name, section in sections.items() if section}


def _write(
    dataset: Dataset,
    frames: Iterator[SimulatedFrame],
    variables: Mapping[str, store.Variable],
    destination: Destination,
    attributes: Mapping[str, Any],
) -> None:
    """Write the stack of a simulated folder, and what is kept of each frame."""
    extra = xr.Dataset(attrs={"seed": destination.seed} | dict(attributes))
    for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
        pixel = np.arange(dataset.instrument.crop_px, dtype="i4")
        extra[name] = (name, pixel, {"units": "pixel", "long_name": text})
    with (
        store.frame_writer(
            destination.path, dataset, extra, variables, code=destination.code, inputs=destination.inputs
        ) as writer,
        _stack(destination.folder / STACK) as stack,
    ):
        for frame in progress.over(frames, "simulating frames", len(dataset.spots)):
            stack.write(frame.readings, compression="zlib", contiguous=False, metadata=None, software="")
            writer.put(frame.place, frame.values)


@contextmanager
def _stack(path: Path) -> Iterator[tifffile.TiffWriter]:
    """A multi-page TIFF that appears whole or not at all, and equal for equal pages."""
    with store.appearing_whole(path) as scratch, tifffile.TiffWriter(scratch) as stack:
        yield stack


def write_contract(dataset: Dataset, folder: Path, simulated: Mapping[str, Any]) -> None:
    """Write manifest.csv and instrument.yaml of the simulated folder: the measured design, and the keys of
    instrument.yaml that were `simulated`."""
    conditions = dataset.instrument.conditions
    header = ["file", "page", "kind", "angle_deg", "exposure_s", "repeat", *conditions]
    table = folder / "manifest.csv"
    with store.appearing_whole(table) as scratch, scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for page, (_, row) in enumerate(dataset.cells()):
            numbers = ("" if v is None else v for v in (row.angle_deg, row.exposure_s, row.repeat))
            writer.writerow([STACK, page, "spot", *numbers, *(row.extra[c] for c in conditions)])
    content: dict = {"name": f"{dataset.title} (simulated)", "crop_px": dataset.instrument.crop_px}
    if conditions:
        content["conditions"] = list(conditions)
    store.write_text(folder / "instrument.yaml", yaml.safe_dump(content | dict(simulated), sort_keys=False))
