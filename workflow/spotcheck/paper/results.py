"""What the counterparts are computed from."""

from functools import cached_property
from pathlib import Path

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, of_instrument

# The paper crops at the maximum; so do its numbers here.
CENTRING = "maximum"


def known(value: float | None) -> float:
    """A key of instrument.yaml that the paper's set-up gives."""
    if value is None:
        raise InputError("instrument.yaml: a key of Table 3 is missing; the paper's numbers need all of them")
    return value


class Results:
    """The results folder of a dataset, opened as it is asked for; `opened` are the files that were."""

    def __init__(self, dataset: Dataset, folder: Path):
        self.dataset = dataset
        self.folder = folder
        self.opened: set[Path] = set()

    def file(self, name: str) -> xr.Dataset:
        """A result by its name without suffix."""
        path = self.folder / f"{name}.nc"
        self.opened.add(path)
        return store.read(path)

    @cached_property
    def metrics(self) -> xr.Dataset:
        """Metrics of both sources, from the crops at the maximum."""
        return self.file("metrics").sel(centring=CENTRING, fit="least_squares").load()

    @cached_property
    def measured(self) -> xr.Dataset:
        """Measured side of `metrics`."""
        return self.metrics.sel(source="measured")

    @cached_property
    def simulated(self) -> xr.Dataset:
        """Simulated side of `metrics`, averaged over angles: the model knows none."""
        return self.metrics.sel(source="simulated").mean("angle")

    @cached_property
    def baseline(self) -> Baseline:
        """The baseline that the simulation used."""
        return of_instrument(self.dataset.instrument, self.metrics["exposure"].values)
