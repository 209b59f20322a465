"""The results of a dataset, opened when a figure first asks for them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset.folder import Dataset, load
from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.caustic import CONDITION as CAUSTIC_AXIS
from spotcheck.io import store
from spotcheck.sensor import ReadingDistribution, SensorModel

# Exposures [s] and fibre orientations [degree] of the paper: beside these its printed numbers can be set.
PAPER_EXPOSURES, PAPER_ANGLES = (1e-4, 5e-4, 9e-4), (0.0, 45.0, 90.0, 135.0)


class Unavailable(Exception):
    """A figure cannot be drawn from these results; the text is the reason, for a reader."""


class Results:
    """The netCDF files below `folder`, by name without suffix ("metrics", "simulated/crops"), and their dataset.

    Use as a context manager, or call `close`.
    """

    def __init__(self, folder: str | Path, dataset: str | Path | Dataset):
        self.folder = Path(folder)
        self.dataset = dataset if isinstance(dataset, Dataset) else load(dataset)
        self._open: dict[str, xr.Dataset] = {}

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close every file that was opened."""
        for ds in self._open.values():
            ds.close()
        self._open.clear()

    @property
    def instrument(self) -> Instrument:
        """The instrument of the dataset."""
        return self.dataset.instrument

    def get(self, name: str) -> xr.Dataset:
        """A result, opened lazily; `Unavailable` when it is not there or its stage was skipped."""
        if name not in self._open:
            path = self.folder / f"{name}.nc"
            if not path.is_file():
                raise Unavailable(self._absent(name))
            self._open[name] = store.read(path)
        ds = self._open[name]
        if "skipped" in ds.attrs:
            raise Unavailable(str(ds.attrs["skipped"]))
        return ds

    def verdict(self) -> dict[str, Any]:
        """verdict.json; `Unavailable` when it is not there."""
        path = self.folder / "verdict.json"
        if not path.is_file():
            raise Unavailable("verdict.json is not among the results")
        return json.loads(path.read_text(encoding="utf-8"))

    def _absent(self, name: str) -> str:
        if name == "transfer":
            return "the manifest names no frame of kind flat or dark"
        if not self.dataset.spots:
            return "the manifest names no frame of kind spot"
        if name == "caustic" and CAUSTIC_AXIS not in self.instrument.conditions:
            return f"the distance is no axis of this dataset: no column {CAUSTIC_AXIS} among the conditions"
        return f"{name}.nc is not among the results"

    def sensor_model(self) -> SensorModel | None:
        """The sensor that the chain ran on; None where gain or read noise is unknown or sensor.nc is missing."""
        try:
            return read_sensor_model(self.get("sensor"))
        except Unavailable:
            return None

    def exposures(self) -> np.ndarray:
        """Exposure times of the spots [s], ascending; empty when they were not recorded."""
        return np.array(self.dataset.exposures, float)

    def like_paper(self) -> bool:
        """Whether the design is the paper's, so that its printed numbers can be named beside a figure."""
        angles = next(axis.values for axis in self.dataset.axes if axis.name == "angle") or ()
        return _equal(self.exposures(), PAPER_EXPOSURES) and _equal(np.array(angles), PAPER_ANGLES)

    def beside_paper(self, clause: str) -> str:
        """The clause that names what the paper prints, with a space before it; empty for another design."""
        return f" {clause}" if self.like_paper() else ""

    def mean_reading(self, light_dn: np.ndarray, exposure_s: float | None) -> np.ndarray:
        """Mean reading [DN] of simulated light [DN]: dark signal, black level and clipping where the sensor is
        known."""
        sensor = self.sensor_model()
        if sensor is None:
            return light_dn
        distribution = ReadingDistribution(sensor, exposure_s=exposure_s or 0.0)
        return distribution.tabulate(float(np.max(light_dn))).mean(light_dn)


def _equal(own: np.ndarray, other: tuple[float, ...]) -> bool:
    return own.shape == (len(other),) and bool(np.allclose(own, other))
