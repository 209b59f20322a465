"""Numbers in netCDF result files: catalogue entries and values.

A label is the value of a coordinate, or an index of a dimension without one. A long table has one row for each named
quantity, with its value, standard error and unit. An entry is a number, or a table of numbers, with its names.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr

from spotcheck.characterization.emva_quantities import QUANTITIES
from spotcheck.errors import InputError
from spotcheck.io.text import join_first
from spotcheck.report.provenance.records import CatalogEntry, StoredNumber

# Attribute of a file that names the default label of a dimension, which is the one that the workflow itself uses.
DEFAULT_ATTRIBUTES = {"estimator": "used", "fit": "preferred"}
# Label of the dimension `centring` for the crops that the workflow itself uses.
DEFAULT_CENTRING = "light"
# Relative tolerance of a coordinate in a question: values of one condition differ by less.
COORDINATE_TOLERANCE = 1e-3
# Most labels that an error message lists.
MAX_LABELS = 12


def list_entries(name: str, ds: xr.Dataset) -> Iterator[CatalogEntry]:
    """Yield an entry for each numeric variable of a file, except standard errors; `name` is that of the file.

    A long table has an entry for each of its quantities. A label is required for each dimension without a default.
    """
    defaults = default_labels(ds)
    for variable in map(str, ds.data_vars):
        values = ds[variable]
        if values.dtype.kind not in "fiu" or is_stderr(variable):
            continue
        if _is_long_table(ds, variable):
            for quantity, unit in zip(ds["quantity"].values, ds["unit"].values, strict=True):
                yield CatalogEntry((name, str(quantity)), _short_names(ds, str(quantity), str(unit)))
            continue
        dims = tuple(map(str, values.dims))
        yield CatalogEntry(
            (name, variable),
            _short_names(ds, variable, str(values.attrs["units"])),
            dims=dims,
            required_dims=tuple(dim for dim in dims if dim not in defaults and values.sizes[dim] > 1),
            # A name without folder means the results of measured frames, not those of simulated ones in a subfolder.
            is_secondary="/" in name,
        )


def default_labels(ds: xr.Dataset) -> dict[str, str]:
    """Return the label of each dimension that applies if a question does not give one."""
    defaults = {dim: str(ds.attrs[name]) for dim, name in DEFAULT_ATTRIBUTES.items() if name in ds.attrs}
    return defaults | {"centring": DEFAULT_CENTRING}


def is_stderr(variable: str) -> bool:
    """Return whether a variable is the standard error of another one."""
    return variable.endswith(("_error", "_stderr")) or "_stderr_" in variable or variable == "stderr"


def _short_names(ds: xr.Dataset, name: str, unit: str) -> frozenset[str]:
    """Return other names of a variable: without its unit, and without `_mean` if the averaged variable is in the file.

    The unit e-/s appears in a name as `_e_per_s`.
    """
    suffix = "_" + unit.lower().replace("/", "_per_").replace("-", "")
    averaged_variable = name.removesuffix("_mean")
    return frozenset({name.removesuffix(suffix), averaged_variable if averaged_variable in ds else name} - {name})


def _is_long_table(ds: xr.Dataset, variable: str) -> bool:
    """Return whether a variable is the column of values of a long table."""
    return variable == "value" and "quantity" in ds[variable].dims and "unit" in ds


def read_number(ds: xr.Dataset, entry: CatalogEntry, labels: Mapping[str, str | int]) -> StoredNumber:
    """Return the number of an entry.

    Parameters
    ----------
    ds : Dataset
        Content of the file.
    entry : CatalogEntry
        Entry of a variable, or of a quantity of a long table.
    labels : mapping of str to str or int
        Label (str) or index (int) by dimension; other dimensions have their default label or the index 0.

    Raises
    ------
    InputError
        If a dimension does not have the label.
    """
    variable = entry.path[-1]
    if variable not in ds:
        return _read_quantity(ds, variable)
    values, defaults = ds.variables[variable], default_labels(ds)
    index: dict[str, int] = {}
    for dim in map(str, values.dims):
        label = labels.get(dim, defaults.get(dim, 0))
        index[dim] = label if isinstance(label, int) else find_label(ds, dim, label, f"{entry.key}[{dim}={label}]")
    position = tuple(index.values())
    value, stderr_variable = float(values[position]), _find_stderr(ds, variable)
    # Only dimensions with several values are listed with the variable.
    all_labels = {dim: dim_labels(ds, dim)[k] for dim, k in index.items()}
    listed_labels = {dim: label for dim, label in all_labels.items() if ds.sizes[dim] > 1}
    # Attributes of the variable, and of the file for the selected labels, say how the number was obtained.
    remarks = [str(values.attrs["source"])] if "source" in values.attrs else []
    remarks += [f"infinite: {values.attrs['infinite']}"] if np.isinf(value) and "infinite" in values.attrs else []
    remarks += [str(ds.attrs[f"{dim}_{label}"]) for dim, label in all_labels.items() if f"{dim}_{label}" in ds.attrs]
    selection = ", ".join(f"{dim}={label}" for dim, label in listed_labels.items())
    return StoredNumber(
        value=value,
        stderr=None if stderr_variable is None else float(ds.variables[stderr_variable][position]),
        unit=str(values.attrs["units"]),
        description=str(values.attrs["long_name"]),
        variable=f"{variable}[{selection}]" if selection else variable,
        method="; ".join(remarks),
        labels={dim: label for dim, label in listed_labels.items() if label != defaults.get(dim)},
    )


def _read_quantity(ds: xr.Dataset, name: str) -> StoredNumber:
    """Return a quantity of EMVA 1288 from the long table of transfer.nc; `name` is its key in `QUANTITIES`."""
    row = ds.isel(quantity=ds["quantity"].values.tolist().index(name))
    _, _, meaning = QUANTITIES[name]
    return StoredNumber(
        value=float(row["value"]),
        stderr=float(row["stderr"]),
        unit=str(row["unit"].item()),
        description=f"{meaning} ({row['symbol'].item()} of EMVA 1288)",
        variable=f"value[quantity={name}]",
        method=str(row["why"].item()),  # why the value is unknown; "" if it is known
    )


def _find_stderr(ds: xr.Dataset, variable: str) -> str | None:
    """Return the name of the variable with the standard error of `variable`; None if there is none.

    It has the same dimensions. Its name without `_stderr` or `_error` is that of the variable, with or without `_mean`.
    """
    candidates = [name for name in map(str, ds.data_vars) if is_stderr(name) and ds[name].dims == ds[variable].dims]
    for name in (variable, variable.removesuffix("_mean")):
        for candidate in candidates:
            if candidate != variable and candidate.replace("_stderr", "").replace("_error", "") == name:
                return candidate
    return None


def dim_labels(ds: xr.Dataset, dim: str) -> list[str]:
    """Return the labels of a dimension as text: the values of its coordinate, or indices if it has none."""
    if dim not in ds.coords:
        return [str(k) for k in range(ds.sizes[dim])]
    return [f"{value:g}" if isinstance(value, float) else str(value) for value in ds.variables[dim].values.tolist()]


def find_label(ds: xr.Dataset, dim: str, label: str, question: str) -> int:
    """Return the index of a label on a dimension; a number may differ from the coordinate by `COORDINATE_TOLERANCE`.

    Raises `InputError`, which starts with the `question`, if there is no such label.
    """
    labels = dim_labels(ds, dim)
    if label in labels:
        return labels.index(label)
    try:
        number, values = float(label), ds[dim].values.astype(float)
        nearest = int(np.argmin(np.abs(values - number)))
        if np.isclose(values[nearest], number, rtol=COORDINATE_TOLERANCE, atol=0):
            return nearest
    except (ValueError, KeyError):
        # The label or the coordinate is no number, or there is no coordinate.
        pass
    known = join_first(labels, MAX_LABELS)
    raise InputError(f"{question}: no such {dim}; there are {known}")
