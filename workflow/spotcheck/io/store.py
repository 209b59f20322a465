"""The netCDF contract of every intermediate result, checked by one function on write and on read.

Every variable and coordinate carries `units` and `long_name`; dimensions bear the names of the dataset contract; a file
appears whole or not at all; equal inputs and equal code give equal files.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import netCDF4
import numpy as np
import xarray as xr
from xarray.backends import NetCDF4DataStore

from spotcheck.errors import InputError
from spotcheck.io import provenance, writing

STATUS = {
    1: ("missing", "no frame in this cell of the grid"),
    2: ("black", "no light above the noise"),
    4: ("saturated", "hardly a pixel of the crop reads below full scale"),
    8: ("masked", "the crop reaches beyond the frame"),
    16: ("clipped", "some pixels read full scale, or many exactly the highest reading of the frame"),
    32: ("not_converged", "the fit stopped before its minimum"),
    64: ("at_limit", "the fit left the range in which a width can be trusted"),
    128: ("no_noise", "gain or read noise is unknown: no likelihood"),
    256: ("copy", "the pixels are those of another frame"),
    512: ("left_out", "pixels whose readings no light explains were left out of the fit"),
    1024: ("misfit", "chi-square is far from what the stated noise lets expect"),
    2048: ("no_error", "a standard error is 0, which no measurement has"),
    4096: ("blocked", "light is missing that its siblings have"),
    8192: ("moved", "the spot is not where its siblings have theirs"),
    16384: ("double", "exposed twice, or two spots in one frame"),
    32768: ("dropped", "left out by hand (keep = no in manifest.csv)"),
}
# What `keep` in manifest.csv overrules, and with what it says itself all that sets a frame aside.
TAKEN_BACK = 2 | 4 | 4096 | 8192 | 16384
SET_ASIDE = 32768 | TAKEN_BACK
UNUSABLE = 1 | 256 | SET_ASIDE

# HDF5 keeps chunks that were touched, and frames are touched once: a cache of some frames, so that memory does not grow
# with their number.
netCDF4.set_chunk_cache(2**21)


class GridAxis(Protocol):
    """What a file says of an axis of the grid of spots."""

    @property
    def name(self) -> str:
        """Name of the dimension."""

    @property
    def values(self) -> tuple[float, ...] | None:
        """Coordinates, ascending; None where they were not recorded and the axis has length 1."""

    @property
    def units(self) -> str:
        """Unit of the coordinates."""

    @property
    def long_name(self) -> str:
        """Label of the axis."""


class Gridded(Protocol):
    """What a file says of the dataset whose spots span its grid."""

    @property
    def name(self) -> str:
        """Name of the folder."""

    @property
    def title(self) -> str:
        """Title for figures and pages."""

    @property
    def axes(self) -> Sequence[GridAxis]:
        """Axes of the grid, in the order of its dimensions."""


class ContractError(ValueError):
    """A result breaks the netCDF contract: a defect of the program, not of the user's input."""


class Variable(NamedTuple):
    """A variable to be filled frame by frame: dimensions beyond the grid, type, unit, meaning; the step of a float that
    is kept as an unsigned integer (None: kept as it is), whose largest number stands for NaN."""

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str
    step: float | None = None


def status_attributes() -> dict[str, Any]:
    """CF attributes of a `status` variable, from the one table of flags."""
    return {
        "units": "1",
        "long_name": "status flags; 0 is usable without remark",
        "flag_masks": np.array(list(STATUS), dtype="i4"),
        "flag_meanings": " ".join(name for name, _ in STATUS.values()),
    }


def flag(name: str) -> int:
    """Bit of a status flag."""
    return next(bit for bit, (own, _) in STATUS.items() if own == name)


def status_names(flags: Any) -> np.ndarray:
    """Names of the flags that are set, of any array of flags: "ok" where none is, several apart by a blank."""
    flags = np.asarray(flags)
    known = {own: " ".join(name for bit, (name, _) in STATUS.items() if own & bit) or "ok" for own in np.unique(flags)}
    return np.array([known[own] for own in flags.ravel()], dtype=str).reshape(flags.shape)[()]


def reasons(flags: int) -> str:
    """What flags say, in words."""
    return "; ".join(text for bit, (_, text) in STATUS.items() if flags & bit)


def check(ds: xr.Dataset, what: str) -> xr.Dataset:
    """Raise `ContractError` unless every variable has units and long_name, and the file says what it is of."""
    for name, variable in ds.variables.items():
        for attribute in ("units", "long_name"):
            if not str(variable.attrs.get(attribute, "")).strip():
                raise ContractError(f"{what}: variable {name} has no {attribute}")
    for attribute in ("title", "dataset"):
        if attribute not in ds.attrs:
            raise ContractError(f"{what}: attribute {attribute} is missing")
    return ds


def with_remarks(ds: xr.Dataset, remarks: Sequence[str]) -> xr.Dataset:
    """The result with sentences on what is odd about it, each of them once."""
    return ds.assign_attrs(remarks="\n".join(dict.fromkeys(remarks)))


def remarks_of(ds: xr.Dataset) -> list[str]:
    """Sentences on what is odd about a result."""
    return [text for text in str(ds.attrs.get("remarks", "")).split("\n") if text]


def _exact(ds: xr.Dataset) -> Iterator[str]:
    """Sentences on numbers that no measurement gives: standard errors of exactly 0, and infinities that their variable
    does not explain (attribute `infinite`)."""
    for name, variable in ds.variables.items():
        if variable.dtype.kind != "f":
            continue
        infinite = int(np.isinf(variable.values).sum())
        if infinite and "infinite" not in variable.attrs:
            yield f"{name} is infinite in {infinite} of {variable.size} places"
        if str(name).endswith(("stderr", "_error")) and (none := int((variable.values == 0).sum())):
            yield (
                f"{name} is exactly 0 in {none} of {variable.size} places: what it is the error of was not measured,"
                " or from copies of one frame"
            )


def grid(dataset: Gridded) -> xr.Dataset:
    """Empty dataset over the grid of spots: coordinates of the recorded axes, attribute for the others."""
    coords = {
        axis.name: (axis.name, np.array(axis.values), {"units": axis.units, "long_name": axis.long_name})
        for axis in dataset.axes
        if axis.values is not None
    }
    unrecorded = [axis.name for axis in dataset.axes if axis.values is None]
    attrs = {"title": dataset.title, "dataset": dataset.name, "not_recorded": " ".join(unrecorded)}
    return xr.Dataset(coords=coords, attrs=attrs)


def grid_dims(ds: xr.Dataset) -> tuple[str, ...]:
    """The dimensions of the grid of spots in a file that has a `status` on it."""
    return tuple(str(d) for d in ds["status"].dims if d not in ("centring", "fit", "source"))


# A fit with any of these flags is not to be believed.
UNTRUSTED = UNUSABLE | flag("not_converged") | flag("at_limit") | flag("no_noise")


def recorded(ds: xr.Dataset, axis: str) -> bool:
    """Whether an axis of the grid has values."""
    return axis in ds.coords


def write(ds: xr.Dataset, path: str | Path, *, code: str, inputs: Sequence[str | Path] = ()) -> None:
    """Write a result with its provenance. `code` is a digest (see `provenance`), `inputs` the files it was made
    from."""
    path = Path(path)
    ds = with_remarks(ds, [*remarks_of(ds), *_exact(ds)]).assign_attrs(provenance.attributes(code, inputs))
    check(ds, path.name)
    encoding: dict[str, dict] = {}
    for name, variable in ds.variables.items():
        numeric = variable.dtype.kind in "fiu"
        encoding[str(name)] = {"zlib": True, "complevel": 1} if numeric and variable.ndim else {}
        if variable.dtype.kind == "f":
            encoding[str(name)]["_FillValue"] = np.nan
    with appearing_whole(path) as scratch, netCDF4.Dataset(scratch, "w") as nc:
        ds.dump_to_store(NetCDF4DataStore(nc), encoding=encoding)


@contextmanager
def frame_writer(
    path: str | Path,
    dataset: Gridded,
    extra: xr.Dataset,
    variables: Mapping[str, Variable],
    *,
    code: str,
    inputs: Sequence[str | Path] = (),
) -> Iterator["FrameWriter"]:
    """A file over the grid of spots whose `variables` are filled frame by frame, so that no stack is ever held.

    `extra` holds the coordinates of the dimensions beyond the grid.
    """
    path = Path(path)
    template = xr.merge([grid(dataset), extra], combine_attrs="drop_conflicts")
    template = check(template.assign_attrs(provenance.attributes(code, inputs)), path.name)
    with appearing_whole(path) as scratch, netCDF4.Dataset(scratch, "w") as nc:
        template.dump_to_store(NetCDF4DataStore(nc))
        for axis in dataset.axes:
            if axis.values is None:
                nc.createDimension(axis.name, 1)
        yield FrameWriter(nc, tuple(axis.name for axis in dataset.axes), variables)


class FrameWriter:
    """Fills the cells of a grid one by one; cells that are never written stay NaN with status `missing`."""

    def __init__(self, nc: netCDF4.Dataset, grid_dims: tuple[str, ...], variables: Mapping[str, Variable]):
        self._nc = nc
        for name, spec in variables.items():
            if not spec.units.strip() or not spec.long_name.strip():
                raise ContractError(f"variable {name} has no units or no long_name")
            dims = (*grid_dims, *spec.dims)
            shape = tuple(nc.dimensions[d].size for d in dims)
            chunks = (1,) * len(grid_dims) + shape[len(grid_dims) :]
            # Integers get no fill value: xarray would turn them into floats on reading.
            fill = np.nan if spec.dtype.startswith("f") else None if spec.step is None else np.iinfo(spec.dtype).max
            variable = nc.createVariable(
                name, spec.dtype, dims, zlib=True, complevel=1, chunksizes=chunks, fill_value=fill
            )
            variable.setncatts({"units": spec.units, "long_name": spec.long_name})
            if spec.step is not None:
                variable.scale_factor = spec.step
            if name == "status":
                variable.setncatts(status_attributes())
            if fill is None:
                variable[:] = np.full(shape, flag("missing") if name == "status" else -1, spec.dtype)

    def remark(self, remarks: Sequence[str]) -> None:
        """Set the file's sentences on what is odd about it."""
        self._nc.remarks = "\n".join(remarks)

    def put(self, index: tuple[int, ...], values: Mapping[str, Any]) -> None:
        """Write the values of one frame at `index` on the grid."""
        for name, value in values.items():
            variable = self._nc.variables[name]
            variable[index] = np.ma.masked_invalid(value) if "scale_factor" in variable.ncattrs() else value


def read(path: str | Path) -> xr.Dataset:
    """Open a result lazily and check the contract. The caller closes it or uses `with`."""
    return check(xr.open_dataset(path, engine="netcdf4", decode_timedelta=False), Path(path).name)


@contextmanager
def appearing_whole(path: Path) -> Iterator[Path]:
    """A result that takes its name only when all was written (`writing.whole`), and its note."""
    with writing.whole(path) as scratch:
        yield scratch
    provenance.write_sidecar(path, {})


def write_text(path: str | Path, text: str, *, code: str = "", inputs: Sequence[str | Path] = ()) -> None:
    """Write a text file whole or not at all; of a result its note holds what `write` puts into the attributes."""
    writing.text(Path(path), text)
    provenance.write_sidecar(Path(path), provenance.attributes(code, inputs) if code else {})


def owner_of(results: Path) -> str:
    """Folder of the dataset whose results a folder holds, by its note; "" where it has none. Raises `InputError`."""
    note = results / ".dataset"
    try:
        return note.read_text(encoding="utf-8").strip() if note.exists() else ""
    except OSError as error:
        raise InputError(f"{results}: cannot be read ({error.strerror}); name another folder in `results`") from None


def check_claim(results: Path, folder: Path) -> None:
    """Raise `InputError` where a results folder holds those of another dataset, or where nothing can be written there.
    Writes nothing."""
    owner = owner_of(results)
    # Where the owner is gone, the dataset was moved, and its results with it.
    if owner and owner != str(folder) and Path(owner).exists():
        raise InputError(
            f"{results}: holds the results of {owner}, another folder of the same name;"
            f" name another folder in `results`"
        )
    there = next(path for path in (results, *results.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InputError(f"{results}: cannot be written ({there} is in the way); name another folder in `results`")


def claim(results: Path, folder: Path) -> None:
    """Note in a results folder whose results it holds. Raises `InputError` as `check_claim` does."""
    check_claim(results, folder)
    write_text(results / ".dataset", f"{folder}\n")
