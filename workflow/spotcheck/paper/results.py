"""Results of a dataset from which the paper's numbers are computed.

Metrics are variables of metrics.nc; NAME_mean and NAME_sd are mean and standard deviation over repeats. The paper uses
fits by least squares and crops around the maximum.
"""

from contextlib import ExitStack
from functools import cached_property
from pathlib import Path

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, build_baseline

# Kind of crop that the paper uses: centred on the maximum of the frame, not on the centroid of the light.
CENTRING = "maximum"


def require_key(instrument: Instrument, key: str) -> float:
    """Return the number of a key "section.name" of instrument.yaml, such as "optics.f_number", in the unit of the file.

    Raises `InputError` if the key has no value.
    """
    section, _, name = key.partition(".")
    value = getattr(getattr(instrument, section), name)
    if value is None:
        raise InputError(f"instrument.yaml: key {key} is missing; add it, as the paper's numbers need all of Table 3")
    return value


class Results:
    """Results folder of a dataset, whose files are opened on demand; as a context manager it closes them at the end.

    Attributes
    ----------
    dataset : Dataset
        The dataset, with its instrument file.
    folder : Path
        Results folder of the dataset.
    opened : set of Path
        Files that have been opened, which are the inputs of the paper's numbers.
    """

    def __init__(self, dataset: Dataset, folder: Path):
        self.dataset = dataset
        self.folder = folder
        self.opened: set[Path] = set()
        self._files = ExitStack()  # closes what `open_file` opened

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def open_file(self, name: str) -> xr.Dataset:
        """Return the content of folder/`name`.nc, and add its path to `opened`. Each call opens the file again."""
        path = self.folder / f"{name}.nc"
        self.opened.add(path)
        return self._files.enter_context(store.read(path))

    def require_key(self, key: str) -> float:
        """Return the number of a key of the dataset's instrument.yaml; see the function `require_key`."""
        return require_key(self.dataset.instrument, key)

    @cached_property
    def metrics(self) -> xr.Dataset:
        """Metrics of both sources [source, angle, exposure, repeat], with the paper's choice of crops and fits."""
        return self.open_file("metrics").sel(centring=CENTRING, fit="least_squares").load()

    @cached_property
    def measured(self) -> xr.Dataset:
        """Metrics of the measured crops [angle, exposure, repeat]; averages over repeats [angle, exposure]."""
        return self.metrics.sel(source="measured")

    @cached_property
    def simulated(self) -> xr.Dataset:
        """Metrics of the simulated crops, averaged over angles, as the model ignores them [exposure, repeat]."""
        return self.metrics.sel(source="simulated").mean("angle")

    @cached_property
    def baseline(self) -> Baseline:
        """Baseline of the dataset: the paper's model without effects."""
        return build_baseline(self.dataset.instrument, self.metrics["exposure"].values)
