"""Numbers of netCDF results: what can be asked for, and the value of what was asked."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.emva_quantities import QUANTITIES
from spotcheck.errors import InputError
from spotcheck.report.origin.number import Entry

# Attributes that say which label of a dimension the chain itself uses.
USED = {"estimator": "used", "fit": "preferred"}
# What `fits.preferred` takes of both crops.
CENTRING = "light"
# A typed coordinate may miss the one of the grid by this part: conditions that are one condition differ by less.
NEAR = 1e-3


class Cell(NamedTuple):
    """One number of a file, before it is said where the file comes from."""

    value: float
    stderr: float | None
    unit: str
    words: str
    variable: str
    method: str
    chosen: dict[str, object]


def entries(name: str, ds: xr.Dataset) -> Iterator[Entry]:
    """All numeric variables of a file but standard errors, which belong to what they are the error of."""
    used = settled(ds)
    # Without their folder the measured frames are meant, not those of a simulation.
    behind = "/" in name
    for variable in map(str, ds.data_vars):
        own = ds[variable]
        if own.dtype.kind not in "fiu" or is_error(variable):
            continue
        dims = tuple(str(dim) for dim in own.dims)
        free = tuple(dim for dim in dims if dim not in used and own.sizes[dim] > 1)
        if long_form(ds, variable):
            yield from (Entry((name, str(own)), short_of(ds, str(own), str(unit))) for own, unit in rows(ds))
        else:
            short = short_of(ds, variable, str(own.attrs["units"]))
            yield Entry((name, variable), short, dims=dims, free=free, behind=behind)


def settled(ds: xr.Dataset) -> dict[str, str]:
    """The label of each dimension that is meant where a question names none."""
    used = {dim: str(ds.attrs[attribute]) for dim, attribute in USED.items() if attribute in ds.attrs}
    return used | {"centring": CENTRING}


def is_error(variable: str) -> bool:
    """Whether a variable is the standard error of another."""
    return variable.endswith(("_error", "_stderr")) or "_stderr_" in variable or variable == "stderr"


def short_of(ds: xr.Dataset, name: str, unit: str) -> frozenset[str]:
    """What a person calls a variable: without the unit at its end, and a mean by the name of what it is the mean of."""
    suffix = "_" + unit.lower().replace("/", "_per_").replace("-", "")
    averaged = name.removesuffix("_mean")
    return frozenset({name.removesuffix(suffix), averaged if averaged in ds else name} - {name})


def long_form(ds: xr.Dataset, variable: str) -> bool:
    """Whether a variable holds one number for each name of a quantity, each in a unit of its own."""
    return variable == "value" and "quantity" in ds[variable].dims and "unit" in ds


def rows(ds: xr.Dataset) -> Iterator[tuple[str, str]]:
    """Name and unit of the quantities of such a file."""
    return zip(ds["quantity"].values, ds["unit"].values, strict=True)


def cell(ds: xr.Dataset, entry: Entry, asked: Mapping[str, str | int]) -> Cell:
    """The number of an entry at what was asked of its dimensions: labels as text, or indices.

    Raises `InputError` where a label is not there.
    """
    if entry.path[-1] not in ds:
        return _of_quantity(ds, entry.path[-1])
    variable, used = entry.path[-1], settled(ds)
    own = ds.variables[variable]
    at: dict[str, int] = {}
    for dim in map(str, own.dims):
        told = asked.get(dim, used.get(dim, 0))
        at[dim] = told if isinstance(told, int) else place(ds, dim, told, f"{entry.key}[{dim}={told}]")
    labels = {dim: labels_of(ds, dim)[k] for dim, k in at.items()}
    error = error_of(ds, variable)
    value = float(own[tuple(at.values())])
    how = [str(own.attrs["source"])] if "source" in own.attrs else []
    how += [f"infinite: {own.attrs['infinite']}"] if np.isinf(value) and "infinite" in own.attrs else []
    how += [str(ds.attrs[f"{dim}_{text}"]) for dim, text in labels.items() if f"{dim}_{text}" in ds.attrs]
    inside = ", ".join(f"{dim}={text}" for dim, text in labels.items() if ds.sizes[dim] > 1)
    return Cell(
        value,
        None if error is None else float(ds.variables[error][tuple(at.values())]),
        str(own.attrs["units"]),
        str(own.attrs["long_name"]),
        f"{variable}[{inside}]" if inside else variable,
        "; ".join(how),
        {d: text for d, text in labels.items() if ds.sizes[d] > 1 and text != used.get(d)},
    )


def _of_quantity(ds: xr.Dataset, name: str) -> Cell:
    own = ds.isel(quantity=[str(text) for text in ds["quantity"].values].index(name))
    value, stderr, unit, symbol, why = (own[key].item() for key in ("value", "stderr", "unit", "symbol", "why"))
    words = f"{QUANTITIES[name][2]} ({symbol} of EMVA 1288)"
    return Cell(float(value), float(stderr), str(unit), words, f"value[quantity={name}]", str(why), {})


def error_of(ds: xr.Dataset, variable: str) -> str | None:
    """The variable that holds the standard error of another: of the same name and dimensions."""
    for name in (variable, variable.removesuffix("_mean")):
        for own in map(str, ds.data_vars):
            bare = own.replace("_stderr", "").replace("_error", "")
            if own != variable and is_error(own) and bare == name and ds[own].dims == ds[variable].dims:
                return own
    return None


def labels_of(ds: xr.Dataset, dim: str) -> list[str]:
    """What the places on a dimension are called: by their coordinate, else by number."""
    if dim not in ds.coords:
        return [str(k) for k in range(ds.sizes[dim])]
    return [f"{own:g}" if isinstance(own, float) else str(own) for own in ds.variables[dim].values.tolist()]


def place(ds: xr.Dataset, dim: str, told: str, question: str) -> int:
    """Index of a label on a dimension. Raises `InputError`."""
    labels = labels_of(ds, dim)
    if told in labels:
        return labels.index(told)
    try:
        number, values = float(told), ds[dim].values.astype(float)
        nearest = int(np.argmin(np.abs(values - number)))
        if np.isclose(values[nearest], number, rtol=NEAR, atol=0):
            return nearest
    except (ValueError, KeyError):
        pass
    shown = ", ".join(labels[:12]) + (", …" if len(labels) > 12 else "")
    raise InputError(f"{question}: no such {dim}; there are {shown}")
