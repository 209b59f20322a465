"""The simulate stage: the paper's model at the calibrated parameters, as mean images and as a dataset folder of its
own.

The folder keeps the dataset contract, so that simulated frames pass the very stages that measured ones do.
"""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
import xarray as xr
import yaml

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.estimate.calibration import USED
from spotcheck.model.baseline import of_instrument
from spotcheck.model.sensor import SensorModel
from spotcheck.model.simulate import frame, frame_generators

# Frames are larger than the crop by this factor, so that a crop at a maximum anywhere on the plateau stays inside.
CANVAS = 2


class SpotState(NamedTuple):
    """Peak [DN] and σ_g [px] of the Gaussian of one frame, before the top hat."""

    amplitude: float
    sigma: float


def spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> dict[tuple[int, ...], SpotState]:
    """Peak and width of every frame of the grid: by the law of the baseline, or each frame's own fit where no law was
    found."""
    baseline = of_instrument(dataset.instrument, _exposures(dataset))
    states = {}
    own = fits.sel(centring="light")
    for index, row in dataset.cells():
        if "skipped" in calibration.attrs or not np.isfinite(calibration["peak"].sel(estimator=USED)):
            at = own.isel(dict(zip(store.grid_dims(fits), index, strict=True)))
            states[index] = SpotState(float(at["amplitude"]), float(at["sigma_mean"]))
        else:
            p1, p2, peak = (float(calibration[n].sel(estimator=USED)) for n in ("p1_mean", "p2_mean", "peak"))
            amplitude = peak * baseline.relative_peak(row.exposure_s, p1, p2)
            states[index] = SpotState(amplitude, baseline.sigma(row.exposure_s, p1, p2))
    return states


def _exposures(dataset: Dataset) -> tuple[float, ...]:
    return next(axis for axis in dataset.axes if axis.name == "exposure").values or ()


def frame_name(index: tuple[int, ...]) -> str:
    """File of a simulated frame, from its place on the grid."""
    return "frames/" + "_".join(str(k) for k in index) + ".tif"


def simulate(
    dataset: Dataset,
    calibration: xr.Dataset,
    fits: xr.Dataset,
    sensor: SensorModel | None,
    folder: Path,
    seed: int,
) -> xr.Dataset:
    """Write the simulated dataset folder; return mean images [grid, y, x] in DN around the spot.

    Without a sensor model the frames are the rounded mean image and the attribute `noise` says so.
    """
    baseline = of_instrument(dataset.instrument, _exposures(dataset))
    side = dataset.instrument.crop_px
    canvas = CANVAS * side
    pixel = np.arange(canvas, dtype=float)
    states = spot_states(dataset, calibration, fits)
    cells = dict(dataset.cells())
    generators = frame_generators(seed, len(cells))
    means = np.full((*dataset.shape, side, side), np.nan, np.float32)
    dims = tuple(axis.name for axis in dataset.axes)
    amplitude, sigma = np.full(dataset.shape, np.nan), np.full(dataset.shape, np.nan)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    inner = slice(canvas // 2 - side // 2, canvas // 2 - side // 2 + side)
    for (index, row), rng in zip(cells.items(), generators, strict=True):
        amplitude[index], sigma[index] = states[index]
        if np.isfinite(amplitude[index]):
            light = baseline.shape(
                pixel[None, :], pixel[:, None], amplitude[index], canvas // 2, canvas // 2, sigma[index]
            )
        else:  # a frame without a usable spot is simulated as one without light
            light = np.zeros((canvas, canvas))
        means[index] = light[inner, inner]
        if sensor is None:
            readings = np.clip(np.rint(light), 0, 65535).astype(np.uint16)
        else:
            readings = frame(light, row.exposure_s or 0.0, sensor, rng)
        _write_tiff(folder / frame_name(index), readings)
    write_contract(dataset, sensor, folder)
    ds = store.grid(dataset)
    for name in ("y", "x"):
        long_name = f"{'row' if name == 'y' else 'column'} of the crop"
        ds[name] = (name, np.arange(side, dtype="i4"), {"units": "pixel", "long_name": long_name})
    ds["mean_light"] = (
        (*dims, "y", "x"),
        means,
        {"units": "DN", "long_name": "mean light of the simulated spot"},
    )
    ds["amplitude"] = (
        dims,
        amplitude,
        {"units": "DN", "long_name": "peak of the Gaussian before the top hat"},
    )
    ds["sigma"] = (
        dims,
        sigma,
        {"units": "pixel", "long_name": "sigma_g, standard deviation of the Gaussian"},
    )
    noise = "drawn" if sensor else "none: gain or read noise of the sensor is unknown"
    law = calibration.attrs.get("used", "none: each frame's own fit")
    return ds.assign_attrs(noise=noise, calibration=law, seed=seed)


def _write_tiff(path: Path, pixels: np.ndarray) -> None:
    scratch = path.with_suffix(".part")
    tifffile.imwrite(scratch, pixels, compression="zlib", software="", metadata=None)
    scratch.replace(path)


def write_contract(dataset: Dataset, sensor: SensorModel | None, folder: Path) -> None:
    """manifest.csv and instrument.yaml of the simulated folder: the measured design, the sensor that was simulated."""
    conditions = dataset.instrument.conditions
    header = ["file", "kind", "angle_deg", "exposure_s", "repeat", *conditions]
    scratch = folder / ".manifest.part"
    with scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for index, row in dataset.cells():
            numbers = ("" if v is None else v for v in (row.angle_deg, row.exposure_s, row.repeat))
            writer.writerow([frame_name(index), "spot", *numbers, *(row.extra[c] for c in conditions)])
    scratch.replace(folder / "manifest.csv")
    given = dataset.instrument
    content: dict = {"name": f"{dataset.title} (simulated)", "crop_px": given.crop_px}
    if conditions:
        content["conditions"] = list(conditions)
    if given.sensor.bit_depth:
        content["sensor"] = {"bit_depth": given.sensor.bit_depth}
    store.write_text(folder / "instrument.yaml", yaml.safe_dump(content, sort_keys=False))
