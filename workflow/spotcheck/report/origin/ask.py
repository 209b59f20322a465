"""Questions for a number by its name, long or short, and answers."""

import difflib
import re
import shlex
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset, load
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.report.origin import documents
from spotcheck.report.origin import tables as netcdf
from spotcheck.report.origin.number import Entry, Number, Source
from spotcheck.report.origin.rules import source_of

# A name, and labels of its dimensions: "fits.sigma_mean[angle=90, exposure=0.0009, repeat=3]".
QUESTION = re.compile(r"\s*([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?\s*")
# Between two labels; a frame of a stack has a comma in its own: "frames/stack.tif, page 2".
LABELS = re.compile(r",(?=[^,=]+=)")
# Names that a refusal lists.
MOST_NAMED = 6
# How alike a name must be to one that was not found to be offered [1, as difflib counts].
LIKE = 0.6
# Variables above this size are images, not numbers [byte]: those of 10,000 frames are smaller, one image is not.
LARGEST = 2**20
SHEET = "instrument.yaml"
TEXTS = {"verdict.json": documents.of_verdict, "paper_numbers.csv": documents.of_paper, SHEET: documents.of_sheet}


class Shelf(NamedTuple):
    """All that a results folder can be asked for: entries by key and by every name; netCDF files by name; numbers of
    text files by key; and how the files came about, by their names."""

    entries: dict[str, Entry]
    names: dict[str, list[Entry]]
    files: dict[str, xr.Dataset]
    told: dict[str, netcdf.Cell]
    sources: dict[str, Source]


def of(results: str | Path, key: str) -> Number:
    """The number that a key stands for, and where it comes from.

    `key` is a name of `keys`, or its end: `p1`, `gap.closed`, `fits.sigma_mean[frame=a000_r0_t100us]`. Raises
    `InputError` where nothing, or more than one thing, has this name.
    """
    results = Path(results)
    shelf = shelf_of(results)
    name, asked = question(key)
    entry = found(shelf, name, asked)
    file = entry.path[0]
    if entry.key in shelf.told:
        own = shelf.told[entry.key]
    else:
        if "frame" in asked and "frame" in entry.dims:
            asked["frame"] = row_of(shelf.files[file], str(asked["frame"]))
        elif "frame" in asked:
            asked.update((dim, k) for dim, k in cell_of(results, file, asked).items() if dim in entry.dims)
        if missing := [dim for dim in entry.free if dim not in asked]:
            labels = {dim: netcdf.labels_of(shelf.files[file], dim)[0] for dim in missing}
            example = with_labels(entry.key, entry, labels | {dim: str(told) for dim, told in asked.items()})
            raise InputError(f"{key}: is one number for each {' and '.join(missing)}; write e.g. {example}")
        own = netcdf.cell(shelf.files[file], entry, asked)
    source = shelf.sources[file]
    short = with_labels(short_name(shelf, entry), entry, own.chosen)
    return Number(
        with_labels(entry.key, entry, own.chosen), _known(own.value), _known(own.stderr), own.unit, own.words,
        source.file, own.variable, source.rule, source.inputs, source, short, own.method,
    )  # fmt: skip


def keys(results: str | Path) -> list[str]:
    """Names of all numbers of a results folder that need no more to be told."""
    return [key for key, own in shelf_of(Path(results)).entries.items() if not own.free]


def tables(results: str | Path) -> list[str]:
    """Names of all that is one number for each frame, exposure, … with the dimensions that a question must name."""
    return [f"{key}[{', '.join(own.free)}]" for key, own in shelf_of(Path(results)).entries.items() if own.free]


def hover(number: Number) -> str:
    """Where a number comes from, in one line."""
    return _hover(number.source, number.variable, number.short)


def hover_of_frame(results: str | Path, table: str, frame: str) -> str:
    """The same of a number of one frame, by its table such as `fits.sigma_mean`, without a look at its value. Raises
    `InputError` where there is no such table."""
    shelf = shelf_of(Path(results))
    entry = found(shelf, table, {"frame": frame})
    return _hover(shelf.sources[entry.path[0]], entry.path[-1], f"{table}[frame={frame}]")


def _hover(source: Source, variable: str, name: str) -> str:
    made = ", ".join(dict.fromkeys(own.name for own in source.inputs))
    by = f"by rule {source.rule}{f' from {made}' if made else ''}" if source.rule else "as given"
    # A file that was given lies elsewhere, and its folder may say whose machine this is.
    file = source.file if source.rule else Path(source.file).name
    return f"{file}: {shown(variable)}, {by}; explain: spotcheck explain {shlex.quote(name)}"


def shown(variable: str) -> str:
    """A variable and what is selected of it, apart."""
    return variable.replace("[", " [", 1)


def related(results: Path, asked: str, number: Number) -> list[Number]:
    """Other numbers of which the name that was asked for is part: after `p1` those that the verdict says of p1."""
    shelf, (name, labels) = shelf_of(results), question(asked)
    if labels or "." in name:
        return []
    others = [
        own
        for own in shelf.entries.values()
        if not own.free and own.key != number.key and (name in own.path[1:-1] or name in own.names())
    ]
    return [of(results, own.key) for own in others]


def short_name(shelf: Shelf, entry: Entry) -> str:
    """The first of an entry's names that means nothing else."""
    return next(name for name in (*entry.names(), entry.key) if _means(shelf, name, entry))


def _means(shelf: Shelf, name: str, entry: Entry) -> bool:
    try:
        return found(shelf, name, {}) is entry
    except InputError:
        return False


def question(text: str) -> tuple[str, dict[str, str | int]]:
    """Name and labels in a question. Raises `InputError`."""
    match = QUESTION.fullmatch(text)
    pairs = [own.split("=", 1) for own in LABELS.split(match[2] or "") if own.strip()] if match else []
    if match is None or any(len(pair) != 2 for pair in pairs):
        raise InputError(f"{text}: is no name of a number; write e.g. p1 or fits.sigma_mean[angle=0, repeat=1]")
    return match[1], {dim.strip(): label.strip() for dim, label in pairs}


def found(shelf: Shelf, name: str, asked: dict[str, str | int]) -> Entry:
    """The entry that a name means. Raises `InputError`."""
    if name in shelf.entries:
        return shelf.entries[name]
    able = shelf.names.get(name, [])
    able = [own for own in able if not own.behind] or able
    labels = set(asked) - {"frame"}
    fitting = [own for own in able if labels <= set(own.dims) and ("frame" in asked or set(own.free) <= labels)]
    fitting = fitting or [own for own in able if labels <= set(own.dims)]
    if able and not fitting:
        raise InputError(f"{name}: has no {' and '.join(sorted(labels))}; {_dims_in_words(able[0])}")
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(
            f"{name}: is the name of several numbers; write one of {_listed([own.key for own in fitting])}"
        )
    near = difflib.get_close_matches(name, shelf.names, MOST_NAMED, LIKE)
    hint = f"; nearest are {_listed(near)}" if near else ""
    raise InputError(f"{name}: no number of these results has this name{hint}; `spotcheck explain` lists all")


def _dims_in_words(entry: Entry) -> str:
    return f"its dimensions are {', '.join(entry.dims)}" if entry.dims else "it is one number"


def _listed(names: list[str]) -> str:
    rest = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def with_labels(name: str, entry: Entry, labels: Mapping[str, object]) -> str:
    """A name of an entry with labels of its dimensions."""
    inside = ",".join(f"{dim}={labels[dim]}" for dim in entry.dims if dim in labels)
    return f"{name}[{inside}]" if inside else name


def _known(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else value


def shelf_of(results: Path) -> Shelf:
    """What a results folder can be asked for; read anew when one of its files has changed. Raises `InputError`."""
    if not results.is_dir():
        raise InputError(f"{results}: no such folder; name the results of a dataset, such as results/virtual-rig")
    files = [*sorted(results.glob("*.nc")), *sorted(results.glob("*/*.nc")), *(results / name for name in TEXTS)]
    files += [Path(noted, SHEET)] if (noted := store.read_owner(results)) else []
    state = tuple((str(path), path.stat().st_mtime_ns) for path in files if path.is_file())
    return _shelf(results, state)


@lru_cache(maxsize=4)
def _shelf(results: Path, state: tuple[tuple[str, int], ...]) -> Shelf:
    shelf = Shelf({}, {}, {}, {}, {})
    for path in (Path(name) for name, _ in state):
        given = path.name == SHEET
        file = str(path) if given else path.relative_to(results).as_posix()
        name = path.stem if given else file.removesuffix(path.suffix)
        if path.suffix == ".nc":
            with store.read(path) as ds:
                small = [own for own, variable in ds.variables.items() if variable.nbytes <= LARGEST]
                shelf.files[name] = ds[small].load()
        attributes = shelf.files[name].attrs if name in shelf.files else {}
        # A file that nothing writes was left behind by another version.
        if source := Source(file, "", "") if given else source_of(results, file, attributes):
            shelf.sources[name] = source
            _put(shelf, path, name)
    if not any(shelf.sources[entry.path[0]].rule for entry in shelf.entries.values()):
        raise InputError(f"{results}: holds no results; name the results of a dataset, such as results/virtual-rig")
    return shelf


def _put(shelf: Shelf, path: Path, name: str) -> None:
    """Add the numbers of a file."""
    if path.name in TEXTS:
        for entry, own in _told(path):
            shelf.told[entry.key] = own
            _name(shelf, entry)
    elif "skipped" not in shelf.files[name].attrs:
        for entry in netcdf.entries(name, shelf.files[name]):
            _name(shelf, entry)


def _told(path: Path) -> list[tuple[Entry, netcdf.Cell]]:
    try:
        return list(TEXTS[path.name](path))
    except InputError:
        # A data sheet that was spoilt since says nothing; results are still there.
        return []


def _name(shelf: Shelf, entry: Entry) -> None:
    shelf.entries[entry.key] = entry
    for name in entry.names():
        shelf.names.setdefault(name, []).append(entry)


def frame_of(results: str | Path, number: Number) -> tuple[str, str] | None:
    """Name and SHA-256 of the frame that a number is of, by its dataset; None where it is of more, or the dataset is
    gone."""
    shelf, (_, asked), folder = shelf_of(Path(results)), question(number.key), Path(number.file).parent.as_posix()
    table, ds = (shelf.files.get(own) for own in (f"{folder}/frames".removeprefix("./"), number.file[:-3]))
    if table is None or ds is None or not asked:
        return None
    at = {dim: netcdf.place(ds, dim, str(label), number.key) for dim, label in asked.items() if dim in ds.dims}
    try:
        given = dataset_of(Path(results), number.file)
    except InputError:
        return None
    names = [axis.name for axis in given.axes]
    if any(axis.size > 1 and axis.name not in at for axis in given.axes):
        return None
    index = tuple(at.get(name, 0) for name in names)
    frame = next((own for cell, own in given.cells() if cell == index), None)
    digests = dict(zip(table["file"].values.tolist(), table["sha256"].values.tolist(), strict=True))
    return (frame.label, digests[frame.file]) if frame is not None and frame.file in digests else None


def dataset_of(results: Path, file: str) -> Dataset:
    """The dataset whose frames a file of results is of: the simulated one in its folder, else the measured one. Raises
    `InputError`."""
    folder = results / Path(file).parent
    if not (folder / "manifest.csv").is_file():
        noted = store.read_owner(results)
        if not noted:
            raise InputError(f"{results}: does not say of which dataset it is; name the frame by its conditions")
        folder = Path(noted)
    return load(folder)


def row_of(ds: xr.Dataset, name: str) -> int | str:
    """Row of a table of frames, such as frames.nc, of the file that messages name so; the name itself where there is no
    such file, for it may be a number."""
    pages = zip(ds["file"].values.tolist(), ds["page"].values.tolist(), strict=True)
    labels = [f"{file}, page {int(page)}" if page else file for file, page in pages]
    return labels.index(name) if name in labels else name


def cell_of(results: Path, file: str, asked: dict[str, str | int]) -> dict[str, int]:
    """Index on the grid of the frame that a question names as messages do, or by the name of its file. Raises
    `InputError`."""
    name, given = str(asked["frame"]), dataset_of(results, file)
    near = [
        (index, frame)
        for index, frame in given.cells()
        if name in (frame.label, Path(frame.file).name, Path(frame.file).stem)
    ]
    if len(near) != 1:
        labels = [frame.label for frame in given.spots]
        nearest = difflib.get_close_matches(name, labels, 3, 0.3) or labels[:3]
        what = "several frames have" if near else "no frame of a spot has"
        raise InputError(f"frame={name}: {what} this name; write e.g. {' or '.join(f'frame={own}' for own in nearest)}")
    return dict(zip((axis.name for axis in given.axes), near[0][0], strict=True))
