"""Result files: the contract of every netCDF file, checked on write and on read, and the owner of a results folder.

A result is an `xarray.Dataset`. Every variable and coordinate has `units` and `long_name`. Dimensions have the names of
the dataset contract. Files are written atomically. Equal inputs and equal code give equal files. Many results have the
axes of the grid of spots (angle, exposure, repeat and declared conditions) as dimensions, and a variable `status` of
bits per cell of the grid. The owner of a results folder is the dataset from which its results were made.
"""

import os
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import netCDF4
import numpy as np
import xarray as xr
from xarray.backends import NetCDF4DataStore

from spotcheck.errors import InputError
from spotcheck.io import atomic_files, provenance

# Name and meaning of each bit (flag) of `status`.
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
    65536: ("cut_off", "faint light was cut off at a threshold: widths are uncertain"),
}
# Flags of automatic exclusion, which `keep = yes` in manifest.csv clears: black, saturated, blocked, moved, double.
CLEARED_BY_KEEP = 2 | 4 | 4096 | 8192 | 16384
# Flags by which a frame is excluded, automatically or by `keep = no` (dropped).
EXCLUDED = 32768 | CLEARED_BY_KEEP
# Flags of frames without a usable spot: missing, copy, and excluded ones.
UNUSABLE = 1 | 256 | EXCLUDED
# Flags of fits whose results must not be used: not_converged, at_limit, no_noise, and those of unusable frames.
UNTRUSTED = UNUSABLE | 32 | 64 | 128

# Dimensions of a `status` beside those of the grid: the two centrings of a crop, kinds of fits, measured or simulated.
NOT_GRID_DIMS = ("centring", "fit", "source")
# Lossless compression of variables. Higher levels take longer and gain little.
COMPRESSION: dict[str, Any] = {"zlib": True, "complevel": 1}
# Cache of chunks that HDF5 keeps per variable [byte]. Frames are accessed once: a larger cache would only grow with
# their number.
netCDF4.set_chunk_cache(2**21)


@dataclass(frozen=True)
class Axis:
    """An axis of the grid of spots: one of the quantities that the spot frames vary."""

    name: str  # name of the dimension
    values: tuple[float, ...] | None  # distinct values, ascending; None if not recorded
    units: str  # unit of the values
    long_name: str  # description for tables and plots

    @property
    def size(self) -> int:
        """Number of positions on the axis; 1 if its values were not recorded."""
        return 1 if self.values is None else len(self.values)

    def index(self, value: float | None) -> int:
        """Return the position of a value on the axis, from 0.

        None has position 0, because a value is missing in all spots or in none.
        """
        return 0 if self.values is None or value is None else bisect_left(self.values, value)


class GridDataset(Protocol):
    """Dataset whose spots span a grid."""

    @property
    def name(self) -> str:
        """Name of the dataset's folder."""

    @property
    def title(self) -> str:
        """Title for figures and pages."""

    @property
    def axes(self) -> Sequence[Axis]:
        """Axes of the grid, in the order of its dimensions."""


class ContractError(ValueError):
    """A result breaks the netCDF contract: a defect of the program, not of the input."""


@dataclass(frozen=True)
class Variable:
    """Definition of a variable that a `FrameWriter` fills frame by frame."""

    dims: tuple[str, ...]  # dimensions behind those of the grid
    dtype: str  # type in the file, such as "f4"
    units: str  # attribute `units`
    long_name: str  # attribute `long_name`
    step: float | None = None  # quantization step of floats stored as unsigned integers [units]; None: stored unchanged


def status_attributes() -> dict[str, Any]:
    """Return the attributes of a `status` variable after the CF conventions for flags."""
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
    """Return the names of the flags that are set in each status value, separated by blanks, or "ok".

    The result has the shape of `flags`, a number or an array of status values.
    """
    flags = np.asarray(flags)
    names_of = {
        value: " ".join(name for bit, (name, _) in STATUS.items() if value & bit) or "ok" for value in np.unique(flags)
    }
    return np.array([names_of[value] for value in flags.ravel()], dtype=str).reshape(flags.shape)[()]


def describe_flags(flags: int) -> str:
    """Return the meanings of the flags that are set in a status value, separated by semicolons; "" if none is."""
    return "; ".join(meaning for bit, (_, meaning) in STATUS.items() if flags & bit)


def check(ds: xr.Dataset, file: str) -> xr.Dataset:
    """Return a result unchanged if it keeps the netCDF contract; `file` is its name in messages.

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
    """Return a result with `remarks` for the user instead of those it had; repeated remarks are dropped."""
    return ds.assign_attrs(remarks="\n".join(dict.fromkeys(remarks)))


def remarks_of(ds: xr.Dataset) -> list[str]:
    """Return the remarks for the user in a result, an attribute with a line per remark."""
    return [remark for remark in str(ds.attrs.get("remarks", "")).split("\n") if remark]


def _remark_on_values(ds: xr.Dataset) -> Iterator[str]:
    """Yield a remark on each floating-point variable with infinities, and on standard errors of exactly 0.

    A variable with the attribute `infinite`, which explains its infinities, gets no remark on them.
    """
    for name, variable in ds.variables.items():
        if variable.dtype.kind != "f":
            continue
        infinity_count = int(np.isinf(variable.values).sum())
        if infinity_count and "infinite" not in variable.attrs:
            yield f"{name} is infinite in {infinity_count} of {variable.size} places"
        zero_count = int((variable.values == 0).sum())
        if zero_count and str(name).endswith(("stderr", "_error")):
            yield (
                f"{name} is exactly 0 in {zero_count} of {variable.size} places: its quantity was not measured, or only"
                " in copies of one frame"
            )


def make_grid(dataset: GridDataset) -> xr.Dataset:
    """Return an empty result over the grid of spots of a dataset.

    Axes with recorded values are coordinates; the attribute `not_recorded` names the others, separated by blanks.
    """
    coords = {
        axis.name: (axis.name, np.array(axis.values), {"units": axis.units, "long_name": axis.long_name})
        for axis in dataset.axes
        if axis.values is not None
    }
    unrecorded_axes = [axis.name for axis in dataset.axes if axis.values is None]
    attrs = {"title": dataset.title, "dataset": dataset.name, "not_recorded": " ".join(unrecorded_axes)}
    return xr.Dataset(coords=coords, attrs=attrs)


def grid_dims(ds: xr.Dataset) -> tuple[str, ...]:
    """Return the dimensions of the grid of spots in a result: those of its `status` without `NOT_GRID_DIMS`."""
    return tuple(str(dim) for dim in ds["status"].dims if dim not in NOT_GRID_DIMS)


def write(ds: xr.Dataset, path: str | Path, *, code: str, inputs: Sequence[str | Path] = ()) -> None:
    """Write a result with its provenance, and with remarks on infinities and on standard errors of 0.

    Parameters
    ----------
    ds : xr.Dataset
        Result that keeps the netCDF contract.
    path : str or Path
        File to write.
    code : str
        Digest of the code (`provenance.code_digest`).
    inputs : sequence of str or Path
        Files from which the result was made.

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
    encoding = {}
    for name, variable in ds.variables.items():
        is_number_array = variable.dtype.kind in "fiu" and variable.ndim > 0
        fill = {"_FillValue": np.nan} if variable.dtype.kind == "f" else {}
        encoding[str(name)] = (COMPRESSION if is_number_array else {}) | fill
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

    The file appears when the `with` block ends without an exception.

    Parameters
    ----------
    path : str or Path
        File to write.
    dataset : GridDataset
        Dataset whose axes are the first dimensions of each variable.
    extra : xr.Dataset
        Coordinates of the other dimensions, and further attributes.
    variables : Mapping
        Definition of each variable by its name.
    code, inputs
        Provenance as for `write`.

    Yields
    ------
    FrameWriter
        Writer of the cells of the grid.

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
        # Axes without values have no coordinate, and thus no dimension yet.
        for axis in dataset.axes:
            if axis.values is None:
                nc.createDimension(axis.name, 1)
        yield FrameWriter(nc, tuple(axis.name for axis in dataset.axes), variables)


class FrameWriter:
    """Writer of the cells of a grid; cells that are not written stay NaN (integers −1) with the status `missing`."""

    def __init__(self, nc: netCDF4.Dataset, axis_names: tuple[str, ...], variables: Mapping[str, Variable]):
        """Create `variables` over the axes of the grid in an open file, which has all dimensions already.

        Raises `ContractError` for a variable without units or long_name.
        """
        self._nc = nc
        for name, definition in variables.items():
            if not definition.units.strip() or not definition.long_name.strip():
                raise ContractError(f"variable {name} has no units or no long_name")
            self._create(name, definition, axis_names)

    def _create(self, name: str, definition: Variable, axis_names: tuple[str, ...]) -> None:
        """Create a variable over the axes of the grid with one chunk per frame, that is, per cell of the grid."""
        dtype, dims = definition.dtype, (*axis_names, *definition.dims)
        shape = tuple(self._nc.dimensions[dim].size for dim in dims)
        chunks = (1,) * len(axis_names) + shape[len(axis_names) :]
        fill: float | None = None
        if dtype.startswith("f"):
            fill = np.nan
        elif definition.step is not None:
            # Floats that are stored as integers have no NaN; the largest integer stands for it.
            fill = np.iinfo(dtype).max
        variable = self._nc.createVariable(name, dtype, dims, **COMPRESSION, chunksizes=chunks, fill_value=fill)
        variable.setncatts({"units": definition.units, "long_name": definition.long_name})
        if definition.step is not None:
            variable.scale_factor = definition.step
        if name == "status":
            variable.setncatts(status_attributes())
        # Plain integers have no fill value, with which xarray would read them as floats.
        if fill is None:
            variable[:] = np.full(shape, flag("missing") if name == "status" else -1, dtype)

    def remark(self, remarks: Sequence[str]) -> None:
        """Set the remarks for the user, which replace earlier ones."""
        self._nc.remarks = "\n".join(remarks)

    def put(self, index: tuple[int, ...], values: Mapping[str, Any]) -> None:
        """Write the values of one frame, by variable, into the cell of the grid with this index.

        NaN and infinity of a quantized variable become missing values.
        """
        for name, value in values.items():
            variable = self._nc.variables[name]
            variable[index] = np.ma.masked_invalid(value) if "scale_factor" in variable.ncattrs() else value


def read(path: str | Path) -> xr.Dataset:
    """Return a result that is opened lazily, after a check of the contract; the caller closes it, or uses `with`.

    Raises
    ------
    ContractError
        If the file breaks the contract.
    """
    return check(xr.open_dataset(path, engine="netcdf4", decode_timedelta=False), Path(path).name)


@contextmanager
def read_files(paths: Mapping[str, str | Path]) -> Iterator[dict[str, xr.Dataset]]:
    """Yield results by name, opened lazily as by `read`, and close their files at the end of the block."""
    with ExitStack() as files:
        yield {name: files.enter_context(read(path)) for name, path in paths.items()}


def read_whole(path: str | Path) -> xr.Dataset:
    """Return a result in memory, after a check of the contract (`ContractError`); its file is closed."""
    with read(path) as ds:
        return ds.load()


@contextmanager
def write_with_sidecar(path: Path) -> Iterator[Path]:
    """Yield the scratch file of a result, which is renamed to `path` at the end of the block; then write its sidecar.

    The sidecar file is that of `provenance.write_sidecar`. Raises `InputError` as `write_atomically` does.
    """
    with atomic_files.write_atomically(path) as scratch:
        yield scratch
    provenance.write_sidecar(path, {})


def write_text(path: str | Path, text: str, *, code: str = "", inputs: Sequence[str | Path] = ()) -> None:
    """Write a text file atomically, and its sidecar file (`provenance.write_sidecar`).

    Parameters
    ----------
    path : str or Path
        File to write.
    text : str
        Content.
    code, inputs
        Provenance as for `write`, which goes into the sidecar file; if `code` is "", none is written there.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    atomic_files.write_text(Path(path), text)
    provenance.write_sidecar(Path(path), provenance.make_attributes(code, inputs) if code else {})


def read_owner(results: Path) -> str:
    """Return the folder of the dataset that owns a results folder; "" if the folder has no file `.dataset`.

    Raises `InputError` if that file cannot be read.
    """
    owner_file = results / ".dataset"
    try:
        return owner_file.read_text(encoding="utf-8").strip() if owner_file.exists() else ""
    except OSError as error:
        raise InputError(f"{results}: cannot be read ({error.strerror}); name another folder in `results`") from None


def check_claim(results: Path, dataset_folder: Path) -> None:
    """Check that the results of a dataset may be written to a folder; nothing is written.

    Parameters
    ----------
    results : Path
        Results folder, which need not exist.
    dataset_folder : Path
        Absolute path of the dataset's folder.

    Raises
    ------
    InputError
        If `results` belongs to another dataset, or cannot be written.
    """
    owner = read_owner(results)
    # If the folder of the owner no longer exists, the dataset was moved and keeps its results.
    if owner and owner != str(dataset_folder) and Path(owner).exists():
        raise InputError(
            f"{results}: holds the results of {owner}, another folder of the same name;"
            f" name another folder in `results`"
        )
    nearest = next(path for path in (results, *results.absolute().parents) if path.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise InputError(f"{results}: cannot be written ({nearest} is in the way); name another folder in `results`")


def claim(results: Path, dataset_folder: Path) -> None:
    """Write into a results folder, which is created if needed, that it belongs to a dataset (file `.dataset`).

    `dataset_folder` is the absolute path of the dataset's folder. Raises `InputError` as `check_claim` does.
    """
    check_claim(results, dataset_folder)
    write_text(results / ".dataset", f"{dataset_folder}\n")
