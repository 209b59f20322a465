"""The simulate stage: the paper's model at the calibrated parameters, as mean images and as a dataset folder of its
own.

The folder keeps the dataset contract, so that simulated frames pass the very stages that measured ones do.
"""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
import xarray as xr
import yaml

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.estimate.calibration import USED
from spotcheck.estimate.fits import preferred
from spotcheck.model.baseline import of_instrument
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
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    side = dataset.instrument.crop_px
    canvas = CANVAS * side
    pixel = np.arange(canvas, dtype=float)
    inner = slice(canvas // 2 - side // 2, canvas // 2 - side // 2 + side)
    noise = "drawn" if sensor else "none: gain or read noise of the sensor is unknown"
    extra = xr.Dataset(attrs={"noise": noise, "seed": seed} | attributes)
    for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
        extra[name] = (name, np.arange(side, dtype="i4"), {"units": "pixel", "long_name": text})
    cells = dict(dataset.cells())
    generators = frame_generators(seed, len(cells))
    with (
        store.frame_writer(path, dataset, extra, VARIABLES, code=code, inputs=inputs) as writer,
        _stack(folder / STACK) as stack,
    ):
        for (index, row), rng in zip(cells.items(), generators, strict=True):
            amplitude, sigma = states[index]
            if np.isfinite(amplitude):
                light = baseline.shape(pixel[None, :], pixel[:, None], amplitude, canvas // 2, canvas // 2, sigma)
            else:  # a frame without a usable spot is simulated as one without light
                light = np.zeros((canvas, canvas))
            if sensor is None:
                readings = np.clip(np.rint(light), 0, full_scale).astype(np.uint16)
            else:
                (readings,) = frames([light], row.exposure_s or 0.0, sensor, [rng])
            stack.write(readings, compression="zlib", contiguous=False, metadata=None, software="")
            writer.put(index, {"mean_light": light[inner, inner], "amplitude": amplitude, "sigma": sigma})
    write_contract(dataset, folder, full_scale)


@contextmanager
def _stack(path: Path) -> Iterator[tifffile.TiffWriter]:
    """A multi-page TIFF that appears whole or not at all, and equal for equal pages."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_suffix(".part")
    with tifffile.TiffWriter(scratch) as stack:
        yield stack
    scratch.replace(path)


def write_contract(dataset: Dataset, folder: Path, full_scale: int) -> None:
    """manifest.csv and instrument.yaml of the simulated folder: the measured design, the bits that were simulated."""
    conditions = dataset.instrument.conditions
    header = ["file", "page", "kind", "angle_deg", "exposure_s", "repeat", *conditions]
    scratch = folder / ".manifest.part"
    with scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for page, (_, row) in enumerate(dataset.cells()):
            numbers = ("" if v is None else v for v in (row.angle_deg, row.exposure_s, row.repeat))
            writer.writerow([STACK, page, "spot", *numbers, *(row.extra[c] for c in conditions)])
    scratch.replace(folder / "manifest.csv")
    given = dataset.instrument
    content: dict = {"name": f"{dataset.title} (simulated)", "crop_px": given.crop_px}
    if conditions:
        content["conditions"] = list(conditions)
    content["sensor"] = {"bit_depth": full_scale.bit_length()}
    store.write_text(folder / "instrument.yaml", yaml.safe_dump(content, sort_keys=False))
