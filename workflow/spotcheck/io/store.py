"""Result files: the contract of every netCDF file, checked on write and on read, and the ownership of result folders.

Every variable and coordinate has `units` and `long_name`. Dimensions have the names of the dataset contract. Files are
written atomically. Equal inputs and equal code give equal files.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import netCDF4
import numpy as np
import xarray as xr
from xarray.backends import NetCDF4DataStore

from spotcheck.errors import InputError
from spotcheck.io import atomic_files, provenance

# Name and meaning of each bit of `status`.
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
# Flags of automatic exclusion, which `keep = yes` in manifest.csv clears.
CLEARED_BY_KEEP = 2 | 4 | 4096 | 8192 | 16384
# Flags by which a frame is excluded, automatically or by `keep = no`.
EXCLUDED = 32768 | CLEARED_BY_KEEP
# Flags of frames without a usable spot.
UNUSABLE = 1 | 256 | EXCLUDED
# Flags of fits whose results must not be used: UNUSABLE, not_converged, at_limit, no_noise.
UNTRUSTED = UNUSABLE | 32 | 64 | 128

# Cache of chunks that HDF5 keeps per variable [byte]. Frames are accessed once: a larger cache would only grow with
# their number.
netCDF4.set_chunk_cache(2**21)


class GridAxis(Protocol):
    """Axis of the grid of spots."""

    @property
    def name(self) -> str:
        """Name of the dimension."""

    @property
    def values(self) -> tuple[float, ...] | None:
        """Ascending coordinates; None if they were not recorded and the axis has length 1."""

    @property
    def units(self) -> str:
        """Unit of the coordinates."""

    @property
    def long_name(self) -> str:
        """Label of the axis."""


class GridDataset(Protocol):
    """Dataset whose spots span a grid."""

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
    """A result breaks the netCDF contract: a defect of the program, not of the input."""


@dataclass(frozen=True)
class Variable:
    """Definition of a variable that a `FrameWriter` fills frame by frame."""

    dims: tuple[str, ...]  # dimensions beyond those of the grid
    dtype: str  # type in the file, such as "f4"
    units: str  # unit
    long_name: str  # meaning
    step: float | None = None  # quantization step of a float stored as unsigned integer [units]; None: stored as it is


def status_attributes() -> dict[str, Any]:
    """Return the CF attributes of a `status` variable."""
    return {
        "units": "1",
        "long_name": "status flags; 0 is usable without remark",
        "flag_masks": np.array(list(STATUS), dtype="i4"),
        "flag_meanings": " ".join(name for name, _ in STATUS.values()),
    }


def flag(name: str) -> int:
    """Return the bit of a status flag, such as "missing"."""
    return next(bit for bit, (flag_name, _) in STATUS.items() if flag_name == name)


def status_names(flags: Any) -> np.ndarray:
    """Return the names of the flags that are set, separated by blanks, or "ok", for an array of status values."""
    flags = np.asarray(flags)
    names = {
        value: " ".join(name for bit, (name, _) in STATUS.items() if value & bit) or "ok" for value in np.unique(flags)
    }
    return np.array([names[value] for value in flags.ravel()], dtype=str).reshape(flags.shape)[()]


def describe_flags(flags: int) -> str:
    """Return the meanings of the flags that are set in a status value."""
    return "; ".join(meaning for bit, (_, meaning) in STATUS.items() if flags & bit)


def check(ds: xr.Dataset, file: str) -> xr.Dataset:
    """Return a result unchanged if it keeps the netCDF contract.

    Raises
    ------
    ContractError
        If a variable has no units or long_name, or the file no title or dataset; the text starts with `file`.
    """
    for name, variable in ds.variables.items():
        for attribute in ("units", "long_name"):
            if not str(variable.attrs.get(attribute, "")).strip():
                raise ContractError(f"{file}: variable {name} has no {attribute}")
    for attribute in ("title", "dataset"):
        if attribute not in ds.attrs:
            raise ContractError(f"{file}: attribute {attribute} is missing")
    return ds


def add_remarks(ds: xr.Dataset, remarks: Sequence[str]) -> xr.Dataset:
    """Return a result with remarks for the user, which replace earlier ones; repeated remarks are dropped."""
    return ds.assign_attrs(remarks="\n".join(dict.fromkeys(remarks)))


def remarks_of(ds: xr.Dataset) -> list[str]:
    """Return the remarks for the user in a result."""
    return [remark for remark in str(ds.attrs.get("remarks", "")).split("\n") if remark]


def _remark_on_values(ds: xr.Dataset) -> Iterator[str]:
    """Yield a remark on each variable with standard errors of exactly 0, or with infinities.

    The attribute `infinite` of a variable explains its infinities, which then need no remark.
    """
    for name, variable in ds.variables.items():
        if variable.dtype.kind != "f":
            continue
        infinite = int(np.isinf(variable.values).sum())
        if infinite and "infinite" not in variable.attrs:
            yield f"{name} is infinite in {infinite} of {variable.size} places"
        zeros = int((variable.values == 0).sum())
        if zeros and str(name).endswith(("stderr", "_error")):
            yield (
                f"{name} is exactly 0 in {zeros} of {variable.size} places: what it is the error of was not measured,"
                " or from copies of one frame"
            )


def make_grid(dataset: GridDataset) -> xr.Dataset:
    """Return an empty result over the grid of spots.

    Recorded axes are coordinates; the attribute `not_recorded` names the others.
    """
    coords = {
        axis.name: (axis.name, np.array(axis.values), {"units": axis.units, "long_name": axis.long_name})
        for axis in dataset.axes
        if axis.values is not None
    }
    unrecorded = [axis.name for axis in dataset.axes if axis.values is None]
    attrs = {"title": dataset.title, "dataset": dataset.name, "not_recorded": " ".join(unrecorded)}
    return xr.Dataset(coords=coords, attrs=attrs)


def grid_dims(ds: xr.Dataset) -> tuple[str, ...]:
    """Return the dimensions of the grid of spots in a result with a `status`."""
    return tuple(str(dim) for dim in ds["status"].dims if dim not in ("centring", "fit", "source"))


def write(ds: xr.Dataset, path: str | Path, *, code: str, inputs: Sequence[str | Path] = ()) -> None:
    """Write a result with its provenance, and remarks on values that no measurement gives.

    Parameters
    ----------
    ds : xr.Dataset
        Result that keeps the netCDF contract.
    path : str or Path
        File to write.
    code : str
        Digest of the code (`provenance.code_digest`).
    inputs : sequence of str or Path
        Files that the result was made from.

    Raises
    ------
    ContractError
        If the result breaks the contract.
    InputError
        If the file cannot be written.
    """
    path = Path(path)
    ds = add_remarks(ds, [*remarks_of(ds), *_remark_on_values(ds)])
    ds = check(ds.assign_attrs(provenance.make_attributes(code, inputs)), path.name)
    encoding: dict[str, dict] = {}
    for name, variable in ds.variables.items():
        is_number_array = variable.dtype.kind in "fiu" and variable.ndim > 0
        encoding[str(name)] = {"zlib": True, "complevel": 1} if is_number_array else {}
        if variable.dtype.kind == "f":
            encoding[str(name)]["_FillValue"] = np.nan
    with write_with_sidecar(path) as scratch, netCDF4.Dataset(scratch, "w") as nc:
        ds.dump_to_store(NetCDF4DataStore(nc), encoding=encoding)


@contextmanager
def frame_writer(
    path: str | Path,
    dataset: GridDataset,
    extra: xr.Dataset,
    variables: Mapping[str, Variable],
    *,
    code: str,
    inputs: Sequence[str | Path] = (),
) -> Iterator["FrameWriter"]:
    """Open a result over the grid of spots that is filled frame by frame, so that memory never holds a stack.

    Parameters
    ----------
    path : str or Path
        File to write.
    dataset : GridDataset
        Dataset whose axes are the first dimensions of each variable.
    extra : xr.Dataset
        Coordinates of the other dimensions.
    variables : Mapping
        Definition of each variable by its name.
    code, inputs
        Provenance as for `write`.

    Raises
    ------
    ContractError, InputError
        As `write` does.
    """
    path = Path(path)
    template = xr.merge([make_grid(dataset), extra], combine_attrs="drop_conflicts")
    template = check(template.assign_attrs(provenance.make_attributes(code, inputs)), path.name)
    with write_with_sidecar(path) as scratch, netCDF4.Dataset(scratch, "w") as nc:
        template.dump_to_store(NetCDF4DataStore(nc))
        for axis in dataset.axes:
            if axis.values is None:
                nc.createDimension(axis.name, 1)
        yield FrameWriter(nc, tuple(axis.name for axis in dataset.axes), variables)


class FrameWriter:
    """Writer of the cells of a grid; cells that are not written stay NaN (integers −1) with the status `missing`."""

    def __init__(self, nc: netCDF4.Dataset, grid_dims: tuple[str, ...], variables: Mapping[str, Variable]):
        self._nc = nc
        for name, definition in variables.items():
            if not definition.units.strip() or not definition.long_name.strip():
                raise ContractError(f"variable {name} has no units or no long_name")
            self._create(name, definition, grid_dims)

    def _create(self, name: str, definition: Variable, grid_dims: tuple[str, ...]) -> None:
        """Create a variable with one chunk per frame."""
        dtype, dims = definition.dtype, (*grid_dims, *definition.dims)
        shape = tuple(self._nc.dimensions[dim].size for dim in dims)
        chunks = (1,) * len(grid_dims) + shape[len(grid_dims) :]
        # NaN of quantized floats is the largest integer. Plain integers get no fill value, since xarray would read
        # them as floats.
        fill = np.nan if dtype.startswith("f") else None if definition.step is None else np.iinfo(dtype).max
        variable = self._nc.createVariable(
            name, dtype, dims, zlib=True, complevel=1, chunksizes=chunks, fill_value=fill
        )
        variable.setncatts({"units": definition.units, "long_name": definition.long_name})
        if definition.step is not None:
            variable.scale_factor = definition.step
        if name == "status":
            variable.setncatts(status_attributes())
        if fill is None:
            variable[:] = np.full(shape, flag("missing") if name == "status" else -1, dtype)

    def remark(self, remarks: Sequence[str]) -> None:
        """Set the remarks for the user."""
        self._nc.remarks = "\n".join(remarks)

    def put(self, index: tuple[int, ...], values: Mapping[str, Any]) -> None:
        """Write the values of one frame, by the names of the variables, at its index on the grid."""
        for name, value in values.items():
            variable = self._nc.variables[name]
            variable[index] = np.ma.masked_invalid(value) if "scale_factor" in variable.ncattrs() else value


def read(path: str | Path) -> xr.Dataset:
    """Open a result lazily and check the contract; the caller closes it, or uses `with`.

    Raises
    ------
    ContractError
        If the file breaks the contract.
    """
    return check(xr.open_dataset(path, engine="netcdf4", decode_timedelta=False), Path(path).name)


@contextmanager
def write_with_sidecar(path: Path) -> Iterator[Path]:
    """Yield the scratch file of a result that is written atomically (`write_atomically`), and add its sidecar file."""
    with atomic_files.write_atomically(path) as scratch:
        yield scratch
    provenance.write_sidecar(path, {})


def write_text(path: str | Path, text: str, *, code: str = "", inputs: Sequence[str | Path] = ()) -> None:
    """Write a text file atomically.

    Parameters
    ----------
    path : str or Path
        File to write.
    text : str
        Content.
    code, inputs
        Provenance as for `write`, which goes into the sidecar file; none without `code`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    atomic_files.write_text(Path(path), text)
    provenance.write_sidecar(Path(path), provenance.make_attributes(code, inputs) if code else {})


def read_owner(results: Path) -> str:
    """Return the folder of the dataset whose results a folder holds, or "" if none is noted. Raises `InputError`."""
    note = results / ".dataset"
    try:
        return note.read_text(encoding="utf-8").strip() if note.exists() else ""
    except OSError as error:
        raise InputError(f"{results}: cannot be read ({error.strerror}); name another folder in `results`") from None


def check_claim(results: Path, folder: Path) -> None:
    """Check that results of a dataset may be written to a folder; nothing is written.

    Parameters
    ----------
    results : Path
        Folder for results.
    folder : Path
        Folder of the dataset.

    Raises
    ------
    InputError
        If `results` holds those of another dataset, or cannot be written.
    """
    owner = read_owner(results)
    # If the owner no longer exists, the dataset was moved and its results belong to the new place.
    if owner and owner != str(folder) and Path(owner).exists():
        raise InputError(
            f"{results}: holds the results of {owner}, another folder of the same name;"
            f" name another folder in `results`"
        )
    existing = next(path for path in (results, *results.absolute().parents) if path.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"{results}: cannot be written ({existing} is in the way); name another folder in `results`")


def claim(results: Path, folder: Path) -> None:
    """Note in a folder for results that it belongs to a dataset. Raises `InputError` as `check_claim` does."""
    check_claim(results, folder)
    write_text(results / ".dataset", f"{folder}\n")
