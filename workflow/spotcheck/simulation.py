"""The simulate stage: a model as mean images and as a dataset folder of its own. The paper's model runs at the
calibrated parameters, the extended one as its model.yaml says.

The folder keeps the dataset contract, so that simulated frames pass the very stages that measured ones do.
"""

import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

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
from spotcheck.model import chain
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.exposed import Chance, expose
from spotcheck.model.extended import Extended, Site, check_bounds, context_of, site_of
from spotcheck.model.light_file import LIGHT
from spotcheck.model.sensor import SensorModel
from spotcheck.model.simulate import frame_generators, frames

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


class Drawn(NamedTuple):
    """A simulated frame: its place on the grid, readings [row, column] in DN, and what the file of means keeps."""

    place: tuple[int, ...]
    readings: np.ndarray
    values: dict[str, Any]


class SpotState(NamedTuple):
    """Peak [DN] and σ_g [px] of the Gaussian of one frame, before the top hat."""

    amplitude: float
    sigma: float


def has_law(calibration: xr.Dataset) -> bool:
    """Whether p1, p2 and the peak were found; else every frame is simulated at its own fit."""
    return "skipped" not in calibration.attrs and bool(np.isfinite(calibration["peak"].sel(estimator=USED)))


def spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> dict[tuple[int, ...], SpotState]:
    """Peak and width of every frame of the grid: by the law of the baseline, or each frame's own fit where no law was
    found."""
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    states = {}
    own = preferred(fits)
    for index, row in dataset.cells():
        if not has_law(calibration):
            at = own.isel(dict(zip(store.grid_dims(fits), index, strict=True)))
            amplitude = float(at["amplitude"])
            trusted = amplitude > 0 and not int(at["status"]) & store.UNTRUSTED
            states[index] = SpotState(amplitude if trusted else np.nan, float(at["sigma_mean"]))
        else:
            p1, p2, peak = (float(calibration[n].sel(estimator=USED)) for n in ("p1_mean", "p2_mean", "peak"))
            amplitude = peak * baseline.relative_peak(row.exposure_s, p1, p2)
            states[index] = SpotState(amplitude, baseline.sigma(row.exposure_s, p1, p2))
    return states


def simulate(
    dataset: Dataset,
    states: dict[tuple[int, ...], SpotState],
    sensor: SensorModel | None,
    full_scale: int,
    folder: Path,
    path: Path,
    *,
    seed: int,
    attributes: dict[str, str],
    code: str,
    inputs: Sequence[str | Path],
) -> None:
    """Write the simulated dataset folder, and the mean images [grid, y, x] around the spot to `path`, frame by frame.

    Without a sensor model the frames are the rounded mean image and the attribute `noise` says so.
    """
    noise = "drawn" if sensor else "none: gain or read noise of the sensor is unknown"
    given = {"noise": noise, "seed": seed} | attributes
    drawn = _baseline_frames(dataset, states, sensor, full_scale, seed)
    _write(dataset, drawn, VARIABLES, folder, path, given, code, inputs)
    write_contract(dataset, folder, {"sensor": {"bit_depth": full_scale.bit_length()}})


def _baseline_frames(
    dataset: Dataset,
    states: dict[tuple[int, ...], SpotState],
    sensor: SensorModel | None,
    full_scale: int,
    seed: int,
) -> Iterator[Drawn]:
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    side = dataset.instrument.crop_px
    canvas = CANVAS * side
    pixel = np.arange(canvas, dtype=float)
    inner = slice(canvas // 2 - side // 2, canvas // 2 - side // 2 + side)
    cells = dict(dataset.cells())
    for (index, row), rng in zip(cells.items(), frame_generators(seed, len(cells)), strict=True):
        amplitude, sigma = states[index]
        if np.isfinite(amplitude):
            light = baseline.shape(pixel[None, :], pixel[:, None], amplitude, canvas // 2, canvas // 2, sigma)
        else:  # a frame without a usable spot is simulated as one without light
            light = np.zeros((canvas, canvas))
        if sensor is None:
            readings = np.clip(np.rint(light), 0, full_scale).astype(np.uint16)
        else:
            (readings,) = frames([light], row.exposure_s or 0.0, sensor, [rng])
        yield Drawn(index, readings, {"mean_light": light[inner, inner], "amplitude": amplitude, "sigma": sigma})


def simulate_extended(
    dataset: Dataset,
    model: Extended,
    sensor: SensorModel,
    folder: Path,
    path: Path,
    *,
    name: str,
    seed: int,
    code: str,
    inputs: Sequence[str | Path],
) -> None:
    """Write the dataset folder that the extended model gives for the design of `dataset`, and to `path` what it expects
    of the crop around each spot [grid, y, x], random fields and scatter left out.

    Frames are a window of the sensor that holds all spots with a crop to every side, or the whole frame. `name` is the
    model file's; raises `InputError` for a model that does not fit the instrument or the design.
    """
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    if not dataset.exposures:
        # As in the verdict: without exposures nobody knows what a dark current per second brings.
        sensor = sensor._replace(dark_current_e_per_s=0.0)
    side = dataset.instrument.crop_px
    check_model(dataset, model, baseline, sensor, name)
    centres = _centres(dataset, model)
    # Positions stay the sensor's own: pedestals, fringes and smear refer to its whole frame.
    left, right = _window(centres[:, 0], side, model.columns)
    top, bottom = _window(centres[:, 1], side, model.rows)
    window = np.arange(left, right, dtype=float), np.arange(top, bottom, dtype=float)
    drawn = _extended_frames(dataset, model, baseline, sensor, centres, window, name, seed)
    effects = " ".join(own.effect.name for own in model.present) or "none"
    given = {"noise": "drawn", "seed": seed, "effects": effects, "window_left_px": left, "window_top_px": top}
    _write(dataset, drawn, EXTENDED_VARIABLES, folder, path, given, code, inputs)
    profile = dataset.instrument.light.profile
    if profile is not None:
        shutil.copyfile(profile, folder / LIGHT)
    write_contract(dataset, folder, _simulated_instrument(dataset, sensor))


def check_model(dataset: Dataset, model: Extended, baseline: Baseline, sensor: SensorModel, name: str) -> None:
    """Raise `InputError` for a model, of a file of that name, that does not fit the instrument or the design."""
    budget, crop = baseline.photon_budget, dataset.instrument.crop_px
    if not dataset.spots:
        raise InputError("manifest.csv: has no frame of kind spot; there is nothing to simulate")
    if model.law is not None and budget == "free":
        raise InputError(f"{name}: has a law, which the photon budget free of this dataset cannot take")
    if crop > min(model.rows, model.columns):
        raise InputError(f"{name}: the frame has {model.columns} × {model.rows} px, but crop_px is {crop}")
    check_bounds(model, context_of(model, baseline, sensor, crop, dataset.exposures), name)


def _centres(dataset: Dataset, model: Extended) -> np.ndarray:
    """Centre of every frame's spot [frame, (x, y)] in px of the sensor; a site that the model does not know lies where
    the others lie on average."""
    known = [(spot.x_px, spot.y_px) for spot in model.spots.values()]
    middle = np.mean(known, axis=0) if known else ((model.columns - 1) / 2, (model.rows - 1) / 2)
    spots = [model.spots.get(_site(dataset, row, model)) for row in dataset.spots]
    return np.array([middle if spot is None else (spot.x_px, spot.y_px) for spot in spots], float)


def _site(dataset: Dataset, row: Frame, model: Extended) -> Site:
    return site_of(row, dataset.instrument.conditions, model.law is not None)


def _window(centre: np.ndarray, side: int, pixels: int) -> tuple[int, int]:
    """First pixel, and that after the last, of a window along one axis."""
    low = int(np.clip(np.floor(centre.min()) - side, 0, pixels - side))
    return low, int(np.clip(np.ceil(centre.max()) + side + 1, low + side, pixels))


def _extended_frames(
    dataset: Dataset,
    model: Extended,
    declared: Baseline,
    sensor: SensorModel,
    centres: np.ndarray,
    window: tuple[np.ndarray, np.ndarray],
    name: str,
    seed: int,
) -> Iterator[Drawn]:
    side, (x, y) = dataset.instrument.crop_px, window
    sites: dict[Site, int] = {}
    for k, (index, row) in enumerate(dataset.cells()):
        view = _view(dataset, row, k, model, centres[k], window)
        base: Law | Free | None = model.law
        own = model.spots.get(_site(dataset, row, model))
        baseline = declared if not model.lights else declared._replace(learned=model.light_of(own))
        if base is None:
            # A frame without a usable spot is simulated as one without light.
            peak, width = (0.0, 1.0) if own is None else (own.peak_dn, own.sigma_px)
            base = Free(np.full((1, 1, 1), peak), np.full((1, 1, 1), width))
        amplitude, sigma = (float(np.squeeze(v)) for v in chain.spot_state(view, baseline, base, model.present))
        if not (np.isfinite(amplitude) and amplitude >= 0 and np.isfinite(sigma) and sigma > 0):
            raise InputError(
                f"{name}: gives {row.label} a spot of {amplitude:g} DN and width {sigma:g} px; both must be above 0"
            )
        # A site is the same at all its exposures.
        site = sites.setdefault(site_of(row, dataset.instrument.conditions, True), len(sites))
        readings = expose(view, baseline, base, model.present, sensor, Chance(seed, k, site))
        spot, beside = chain.light(view, baseline, base, model.present)
        expected = chain.moments(view, baseline, base, model.present, sensor).mean[0]
        at = spotfinding.Spot(round(float(centres[k, 1])) - int(y[0]), round(float(centres[k, 0])) - int(x[0]), True)
        values = {
            "mean_light": spotfinding.cut(np.broadcast_to(spot + beside, (1, *expected.shape))[0], at, side),
            "mean_reading": spotfinding.cut(expected, at, side),
            "amplitude": amplitude,
            "sigma": sigma,
            "left": at.column - side // 2 + int(x[0]),
            "top": at.row - side // 2 + int(y[0]),
        }
        yield Drawn(index, readings, values)


def _view(
    dataset: Dataset, row: Frame, place: int, model: Extended, centre: np.ndarray, window: tuple[np.ndarray, np.ndarray]
) -> View:
    """What one frame sees, a point a pixel; `place` counts the spots in the order of acquisition."""

    def single(value: float) -> np.ndarray:
        return np.full((1, 1, 1), float(value))

    count = len(dataset.spots)
    ordered = dataset.instrument.order_known and count > 1
    return View(
        x=window[0][None, None, :],
        y=window[1][None, :, None],
        x0=single(centre[0]),
        y0=single(centre[1]),
        # Exposures that were not recorded count as one second, and an unknown order as its middle, as in the verdict.
        exposure_s=single(1.0 if row.exposure_s is None else row.exposure_s),
        angle=single(np.deg2rad(row.angle_deg or 0.0)),
        order=single(place / (count - 1) if ordered else 0.5),
        wave_cos=single(0.0),
        wave_sin=single(0.0),
        longest_s=model.longest_s,
        reference_s=model.reference_s,
        frame_x=(model.columns - 1) / 2,
        frame_y=(model.rows - 1) / 2,
        frame_rows=float(model.rows),
        rows_each=1.0,
    )


def _simulated_instrument(dataset: Dataset, sensor: SensorModel) -> dict[str, Any]:
    """The sections of instrument.yaml that the extended model ran with, so that its frames can be judged in turn."""
    given = dataset.instrument
    pitch, depth = given.sensor.pixel_pitch_m, int(sensor.full_scale_dn).bit_length()
    own: dict[str, Any] = {} if pitch is None else {"pixel_pitch_m": pitch}
    stop = {"full_scale_dn": int(sensor.full_scale_dn)} if sensor.full_scale_dn < 2**depth - 1 else {}
    own |= (
        {"bit_depth": depth} | stop | {key: value for key, value in sensor._asdict().items() if key != "full_scale_dn"}
    )
    if not np.isfinite(sensor.full_well_e):
        del own["full_well_e"]
    sections = {"sensor": own}
    for name in ("optics", "laser", "material", "model"):
        sections[name] = {key: value for key, value in asdict(getattr(given, name)).items() if value is not None}
    if given.light.profile is not None:
        sections["light"] = {"profile": LIGHT}
    return {"order_known": given.order_known} | {name: section for name, section in sections.items() if section}


def _write(
    dataset: Dataset,
    drawn: Iterator[Drawn],
    variables: Mapping[str, store.Variable],
    folder: Path,
    path: Path,
    attributes: Mapping[str, Any],
    code: str,
    inputs: Sequence[str | Path],
) -> None:
    """The stack of a simulated folder, and what is kept of each frame."""
    extra = xr.Dataset(attrs=dict(attributes))
    for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
        pixel = np.arange(dataset.instrument.crop_px, dtype="i4")
        extra[name] = (name, pixel, {"units": "pixel", "long_name": text})
    with (
        store.frame_writer(path, dataset, extra, variables, code=code, inputs=inputs) as writer,
        _stack(folder / STACK) as stack,
    ):
        for own in progress.over(drawn, "simulating frames", len(dataset.spots)):
            stack.write(own.readings, compression="zlib", contiguous=False, metadata=None, software="")
            writer.put(own.place, own.values)


@contextmanager
def _stack(path: Path) -> Iterator[tifffile.TiffWriter]:
    """A multi-page TIFF that appears whole or not at all, and equal for equal pages."""
    with store.appearing_whole(path) as scratch, tifffile.TiffWriter(scratch) as stack:
        yield stack


def write_contract(dataset: Dataset, folder: Path, simulated: Mapping[str, Any]) -> None:
    """manifest.csv and instrument.yaml of the simulated folder: the measured design, and the keys of instrument.yaml
    that were `simulated`."""
    conditions = dataset.instrument.conditions
    header = ["file", "page", "kind", "angle_deg", "exposure_s", "repeat", *conditions]
    table = folder / "manifest.csv"
    with store.appearing_whole(table) as scratch, scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for page, (_, row) in enumerate(dataset.cells()):
            numbers = ("" if v is None else v for v in (row.angle_deg, row.exposure_s, row.repeat))
            writer.writerow([STACK, page, "spot", *numbers, *(row.extra[c] for c in conditions)])
    given = dataset.instrument
    content: dict = {"name": f"{dataset.title} (simulated)", "crop_px": given.crop_px}
    if conditions:
        content["conditions"] = list(conditions)
    store.write_text(folder / "instrument.yaml", yaml.safe_dump(content | dict(simulated), sort_keys=False))
