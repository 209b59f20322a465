"""Results folder of a dataset, for figures: each file is opened when a figure first reads it.

A stage of the workflow writes one netCDF file. If the stage could not run, the attribute `skipped` of its file has the
reason.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset.folder import Dataset, load
from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.scan_caustic import CONDITION as CAUSTIC_AXIS
from spotcheck.io import store
from spotcheck.io.schema import read_yaml
from spotcheck.sensor import ReadingDistribution

# Notes on figures of the paper, by the name of the figure.
PAPER_NOTES = Path(__file__).with_name("paper_notes.yaml")
# Design of the paper: exposures [s] and fibre orientations [degree].
PAPER_EXPOSURES, PAPER_ANGLES = (1e-4, 5e-4, 9e-4), (0.0, 45.0, 90.0, 135.0)


class Unavailable(Exception):
    """Error: a figure cannot be drawn from these results. Its text is the reason, which the report shows."""


class Results:
    """Results folder of a dataset; as a context manager it closes the files at the end.

    Parameters
    ----------
    folder : str or Path
        Results folder, with a netCDF file for each stage.
    dataset : str, Path or Dataset
        The dataset, or its folder.
    """

    def __init__(self, folder: str | Path, dataset: str | Path | Dataset):
        self.folder = Path(folder)
        self.dataset = dataset if isinstance(dataset, Dataset) else load(dataset)
        self._opened: dict[str, xr.Dataset] = {}  # opened netCDF files by their names for `get`

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        for ds in self._opened.values():
            ds.close()
        self._opened.clear()

    @property
    def instrument(self) -> Instrument:
        """The instrument of the dataset."""
        return self.dataset.instrument

    def get(self, name: str) -> xr.Dataset:
        """Return the content of a netCDF file; `name` is its path in the folder without suffix: "simulated/crops".

        Raises `Unavailable` if the file does not exist or its stage was skipped.
        """
        if name not in self._opened:
            path = self.folder / f"{name}.nc"
            if not path.is_file():
                raise Unavailable(self._absence_reason(name))
            self._opened[name] = store.read(path)
        ds = self._opened[name]
        if "skipped" in ds.attrs:
            raise Unavailable(str(ds.attrs["skipped"]))
        return ds

    def find(self, name: str) -> xr.Dataset | None:
        """Return the content of a netCDF file as `get` does; None if it does not exist or its stage was skipped."""
        try:
            return self.get(name)
        except Unavailable:
            return None

    def verdict(self) -> dict[str, Any]:
        """Return the content of verdict.json by key. Raises `Unavailable` if the file does not exist."""
        path = self.folder / "verdict.json"
        if not path.is_file():
            raise Unavailable("verdict.json is not among the results")
        return json.loads(path.read_text(encoding="utf-8"))

    def _absence_reason(self, name: str) -> str:
        """Return the reason why a netCDF file does not exist; `name` is as for `get`."""
        if name == "transfer":
            return "the manifest names no frame of kind flat or dark"
        if not self.dataset.spots:
            return "the manifest names no frame of kind spot"
        if name == "caustic" and CAUSTIC_AXIS not in self.instrument.conditions:
            return f"the distance is no axis of this dataset: no column {CAUSTIC_AXIS} among the conditions"
        return f"{name}.nc is not among the results"

    def exposures(self) -> np.ndarray:
        """Return the exposure times of the spots [s], ascending; empty if they were not recorded."""
        return np.array(self.dataset.exposures, float)

    def has_paper_design(self) -> bool:
        """Return whether exposures and angles are those of the paper, so that its printed numbers are comparable."""
        angles = next(axis.values for axis in self.dataset.axes if axis.name == "angle") or ()
        pairs = ((self.exposures(), PAPER_EXPOSURES), (angles, PAPER_ANGLES))
        return all(len(values) == len(printed) and np.allclose(values, printed) for values, printed in pairs)

    def paper_note(self, figure: str) -> str:
        """Return what the paper states beside a figure, with a space before it; `figure` is the name of the figure.

        Returns "" if it states nothing, or if exposures and angles are not those of the paper.
        """
        note = read_yaml(PAPER_NOTES).get(figure)
        return f" {note}" if note and self.has_paper_design() else ""

    def mean_reading(self, light_dn: np.ndarray, exposure_s: float | None) -> np.ndarray:
        """Return the mean reading of pixels, with the rounding and clipping of the sensor.

        Parameters
        ----------
        light_dn : ndarray
            Mean signal of each pixel, in DN above the black level, of any shape.
        exposure_s : float or None
            Exposure time [s]; None (not recorded) counts as 0 s, without dark current.

        Returns
        -------
        ndarray
            Mean reading, including the black level [DN], of the shape of `light_dn`. If gain or read noise is unknown,
            `light_dn` is returned instead.
        """
        ds = self.find("sensor")
        if ds is None or (sensor := read_sensor_model(ds)) is None:
            return light_dn
        distribution = ReadingDistribution(sensor, exposure_s=exposure_s or 0.0)
        return distribution.tabulate(float(np.max(light_dn))).mean(light_dn)
