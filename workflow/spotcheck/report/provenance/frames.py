"""Frames that numbers of the results belong to.

The spot frames of a dataset lie on a grid, whose axes are angle, exposure, repeat and declared conditions. A number in
a table over all these dimensions belongs to one frame. A number in a table over some of them belongs to several frames.
"""

import difflib
from pathlib import Path

import xarray as xr

from spotcheck.dataset.folder import Dataset, load
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.report.provenance import netcdf
from spotcheck.report.provenance.catalog import load_catalog, parse_question
from spotcheck.report.provenance.records import Number

# Similarity above which a frame is proposed for a misspelt name [ratio of difflib, 0 to 1].
MIN_SIMILARITY = 0.3
# Most frames that an error message proposes.
MAX_PROPOSED = 3


def load_dataset_of(results: Path, file: str) -> Dataset:
    """Return the dataset that a result file is about: the simulated frames in its folder, or the measured frames.

    Raises `InputError` if the results do not name their dataset, or if it cannot be read.
    """
    folder = results / Path(file).parent
    if not (folder / "manifest.csv").is_file():
        dataset = store.read_owner(results)
        if not dataset:
            raise InputError(f"{results}: does not say of which dataset it is; name the frame by its conditions")
        folder = Path(dataset)
    return load(folder)


def find_frame(results: Path, number: Number) -> tuple[str, str] | None:
    """Return the name and the SHA-256 of the only frame that a number belongs to.

    Returns None if the number belongs to several frames or to none, or if the dataset cannot be read.
    """
    labels, path, tables = parse_question(number.key)[1], Path(number.source.file), load_catalog(results).tables
    # frames.nc in the folder of the file, and the file itself.
    frames, table = (tables.get(name.as_posix()) for name in (path.with_name("frames"), path.with_suffix("")))
    if frames is None or table is None or not labels:
        return None
    dims = [dim for dim in labels if dim in table.dims]
    index = {dim: netcdf.find_label(table, dim, str(labels[dim]), number.key) for dim in dims}
    try:
        dataset = load_dataset_of(results, number.source.file)
    except InputError:
        return None
    if any(axis.size > 1 and axis.name not in index for axis in dataset.axes):
        return None
    grid_index = tuple(index.get(axis.name, 0) for axis in dataset.axes)
    frame = next((frame for cell, frame in dataset.cells() if cell == grid_index), None)
    digests = dict(zip(frames["file"].values.tolist(), frames["sha256"].values.tolist(), strict=True))
    return (frame.label, digests[frame.file]) if frame is not None and frame.file in digests else None


def find_frame_row(table: xr.Dataset, name: str) -> int | str:
    """Return the row of the frame `name` in frames.nc, whose content is `table`.

    The name of a frame is its file, followed by ", page 2" on the second page of a file and so on. If no frame has the
    name, it is returned unchanged, since it may be a row number as text.
    """
    pages = zip(table["file"].values.tolist(), table["page"].values.tolist(), strict=True)
    labels = [f"{file}, page {int(page)}" if page else file for file, page in pages]
    return labels.index(name) if name in labels else name


def find_frame_index(results: Path, file: str, name: str) -> dict[str, int]:
    """Return the index of a spot frame on each axis of the grid, by the name of the axis.

    Parameters
    ----------
    results : Path
        Results folder.
    file : str
        Path of the result file in that folder. Frames in its folder are meant if it is a dataset (simulated frames),
        else the measured ones.
    name : str
        Label of the frame as messages give it, or the name of its file with or without suffix.

    Raises
    ------
    InputError
        If no frame, or more than one, has the name.
    """
    dataset = load_dataset_of(results, file)
    matches = [
        index for index, frame in dataset.cells() if name in (frame.label, Path(frame.file).name, Path(frame.file).stem)
    ]
    if len(matches) != 1:
        labels = [frame.label for frame in dataset.spots]
        proposed = difflib.get_close_matches(name, labels, MAX_PROPOSED, MIN_SIMILARITY) or labels[:MAX_PROPOSED]
        fault = "several frames have" if matches else "no frame of a spot has"
        examples = " or ".join(f"frame={label}" for label in proposed)
        raise InputError(f"frame={name}: {fault} this name; write e.g. {examples}")
    return dict(zip((axis.name for axis in dataset.axes), matches[0], strict=True))
