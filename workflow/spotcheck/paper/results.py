"""Results of a dataset from which the paper's numbers are computed."""

from functools import cached_property
from pathlib import Path

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, of_instrument

# The paper crops around the maximum.
CENTRING = "maximum"


def require_key(instrument: Instrument, key: str) -> float:
    """Return a number of instrument.yaml, such as "optics.f_number". Raises `InputError` if it is missing."""
    section, _, name = key.partition(".")
    value = getattr(getattr(instrument, section), name)
    if value is None:
        raise InputError(f"instrument.yaml: key {key} is missing; add it, as the paper's numbers need all of Table 3")
    return value


class Results:
    """Results folder of a dataset; files are opened when they are first needed.

    Attributes
    ----------
    dataset : Dataset
    folder : Path
        Results folder of the dataset.
    opened : set of Path
        Files that have been opened.
    """

    def __init__(self, dataset: Dataset, folder: Path):
        self.dataset = dataset
        self.folder = folder
        self.opened: set[Path] = set()

    def open_file(self, name: str) -> xr.Dataset:
        """Open a netCDF file of the folder by its name without suffix."""
        path = self.folder / f"{name}.nc"
        self.opened.add(path)
        return store.read(path)

    def require_key(self, key: str) -> float:
        """Return a number of instrument.yaml. Raises `InputError` if it is missing."""
        return require_key(self.dataset.instrument, key)

    @cached_property
    def metrics(self) -> xr.Dataset:
        """Metrics of measured and simulated crops around the maximum."""
        return self.open_file("metrics").sel(centring=CENTRING, fit="least_squares").load()

    @cached_property
    def measured(self) -> xr.Dataset:
        """Metrics of the measured crops."""
        return self.metrics.sel(source="measured")

    @cached_property
    def simulated(self) -> xr.Dataset:
        """Metrics of the simulated crops, averaged over angles, which the model does not depend on."""
        return self.metrics.sel(source="simulated").mean("angle")

    @cached_property
    def baseline(self) -> Baseline:
        """Baseline model that the simulation used."""
        return of_instrument(self.dataset.instrument, self.metrics["exposure"].values)
