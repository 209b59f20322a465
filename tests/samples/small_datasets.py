"""Small datasets and frames that several files of library tests make."""

from pathlib import Path

import numpy as np
import tifffile
import xarray as xr

from spotcheck.crops.cropping import crop_spots
from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.io import store
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.example_datasets import HEADER

ROOT = Path(__file__).parents[2]
# The sensor of Table 3 with a black level, so that the converter's zero clips nothing.
SENSOR = SensorModel(0.11, 13.0, 70.0, np.inf, 40.0, 1023.0, 0.38)


def folder(base: Path, rows: list[str], instrument: str | None = None, header: str = HEADER) -> Path:
    """A dataset folder with a manifest and, when given, an instrument file; no images."""
    (base / "frames").mkdir(parents=True, exist_ok=True)
    (base / "manifest.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    if instrument is not None:
        (base / "instrument.yaml").write_text(instrument, encoding="utf-8")
    return base


def loaded(base: Path, frames: list[np.ndarray], instrument: str = "", exposures=None) -> dataset.Dataset:
    """A loaded dataset with one TIFF a row: angle 0, repeats counting up, or one repeat at the given exposures."""
    times = exposures or [1e-4] * len(frames)
    rows = [
        f"frames/f{k}.tif,spot,0,{t},{0 if exposures else k}"
        for k, (t, _) in enumerate(zip(times, frames, strict=True))
    ]
    folder(base, rows, instrument)
    for k, pixels in enumerate(frames):
        tifffile.imwrite(base / f"frames/f{k}.tif", pixels)
    return dataset.load(base)


def crops_of(data: dataset.Dataset) -> xr.Dataset:
    """Content of crops.nc of a dataset; the file is written into its folder."""
    crop_spots(data, ingest_frames(data), data.folder / "crops.nc", code="", inputs=[])
    return store.read_whole(data.folder / "crops.nc")


def gaussian(side: int, amplitude: float, x: float, y: float, sigma: float) -> np.ndarray:
    """Light [DN] of a circular Gaussian at pixel centres, written out once more."""
    column, row = np.meshgrid(np.arange(side), np.arange(side))
    return amplitude * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))


def noisy(light: np.ndarray, seed: int, sensor: SensorModel = SENSOR, exposure_s: float = 1e-4) -> np.ndarray:
    """One random frame of the sensor."""
    return draw(light, exposure_s, sensor, np.random.default_rng(seed))
