"""Variables of result files with their CF attributes."""

from collections.abc import Hashable, Iterable

import xarray as xr
from numpy.typing import ArrayLike


def add_variable(
    ds: xr.Dataset, name: str, dims: str | Iterable[Hashable], values: ArrayLike, units: str, long_name: str
) -> None:
    """Add a variable with units and long name to a dataset, in place.

    `dims` names the dimensions of `values`; () for a single number.
    """
    ds[name] = (dims, values, {"units": units, "long_name": long_name})
