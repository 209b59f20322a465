"""Worker process that reads HDF5 (also netCDF-4 and NeXus) through h5py; `hdf5.py` starts it and sends requests.

Requests come pickled on standard input, and replies go pickled to standard output; an exception is a reply as well. The
C library may crash or hang on a broken file, which then ends this process alone. A dataset is an HDF5 dataset here: an
array in the file, with a path. A dataset of frames is a stack.
"""

import math
import os
import pickle
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from spotcheck.io.formats.arrays import find_page_index, is_reading_type, make_pages
from spotcheck.io.formats.page import DEFLATE_RATIO, ImageError, check_length, check_size

# Processor time that a request may take [s]; the largest frame is unpacked in 3 s.
MAX_REQUEST_S = 8
# Limits of a search: groups and datasets, levels of groups, attributes or members of a group, characters of a text.
MAX_OBJECTS, MAX_DEPTH, MAX_MEMBERS, MAX_TEXT = 10_000, 30, 100, 1000
# Most stacks that a message names, and most characters of a name of the file in it.
MAX_LISTED, MAX_NAME = 5, 80
# Lossless filters, and the largest ratio of unpacked to packed bytes of each.
FILTER_RATIOS = {
    h5py.h5z.FILTER_DEFLATE: DEFLATE_RATIO,
    h5py.h5z.FILTER_SHUFFLE: 1,
    h5py.h5z.FILTER_FLETCHER32: 1,
    32000: 100,  # LZF
}
# Attributes that rescale stored numbers (netCDF conventions), and the values that change nothing.
SCALING_ATTRIBUTES = {"scale_factor": 1, "add_offset": 0}
# Shortest side of a frame [px]: 8-bit flags and tables that lie beside frames are narrower.
MIN_SIDE_PX = 8

# Name, value and page of an entry of metadata; the page is None for an entry that holds for all pages.
Entry = tuple[str, str, int | None]


def list_stacks(file: h5py.File) -> list[str]:
    """Return the paths of all datasets in a file that may hold frames, by their type and size."""
    return [
        dataset.name
        for dataset in _iterate_datasets(file)
        if is_reading_type(dataset.dtype) and dataset.ndim >= 2 and min(dataset.shape[-2:]) >= MIN_SIDE_PX
    ]


def _iterate_datasets(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Yield the datasets of a file, level by level. Links are not followed.

    Raises `ImageError` if the file holds more than `MAX_OBJECTS`.
    """
    groups, object_count = [file["/"]], 0
    while groups:
        group = groups.pop(0)
        for name in group:
            object_count += 1
            if object_count > MAX_OBJECTS:
                raise ImageError(f"holds more than {MAX_OBJECTS} objects; name the dataset behind #")
            member = group[name] if _is_stored_in(group, name) else None
            if isinstance(member, h5py.Dataset):
                yield member
            elif isinstance(member, h5py.Group) and member.name.count("/") < MAX_DEPTH:
                groups.append(member)


def _is_stored_in(group: h5py.Group, name: str) -> bool:
    """Return whether a member of a group is an object of this file, not a link to another place."""
    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def find_dataset(file: h5py.File, inner_path: str) -> h5py.Dataset:
    """Return the dataset at a path, or the only one of frames if the path is "". Raises `ImageError`."""
    if not inner_path:
        stacks = list_stacks(file)
        if not stacks:
            raise ImageError("holds no frames of 8 or 16 bits")
        if len(stacks) > 1:
            listed = ", ".join(stacks[:MAX_LISTED])
            raise ImageError(f"holds frames in {listed}; name one, such as {stacks[0]} behind # in the manifest")
        inner_path = stacks[0]
    # Each step of the path is checked, because a group above the dataset may be a link too.
    path = ""
    for name in filter(None, inner_path.split("/")):
        path += f"/{name}"
        link = file.get(path, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise ImageError(
                f"{path} is a link into another file, {link.filename[:MAX_NAME]!r}; name that file in the manifest"
            )
        if link is None:
            listed = ", ".join(list_stacks(file)[:MAX_LISTED])
            raise ImageError(f"has nothing at {path[:MAX_NAME]}; it holds frames in {listed or 'no dataset'}")
    dataset = file[path or "/"]
    if not isinstance(dataset, h5py.Dataset):
        raise ImageError(f"{path or '/'} is a group; name one of {', '.join(list_stacks(file)[:MAX_LISTED])}")
    return dataset


def check_dataset(dataset: h5py.Dataset, length: int) -> None:
    """Raise `ImageError` unless a file of `length` bytes holds all pixels of a dataset, unscaled and unpackable."""
    make_pages(dataset.shape, dataset.dtype)
    if dataset.is_virtual or dataset.external:
        raise ImageError(f"{dataset.name} lies in other files; name those in the manifest")
    for name, neutral_value in SCALING_ATTRIBUTES.items():
        if name in dataset.attrs and not np.all(dataset.attrs[name] == neutral_value):
            raise ImageError(f"{dataset.name} has the attribute {name}: its numbers are no readings; save them without")
    stored_bytes, pixel_bytes = dataset.id.get_storage_size(), dataset.size * dataset.dtype.itemsize
    if dataset.chunks is None:
        check_length(pixel_bytes, min(stored_bytes, length))
        return
    # A chunk is unpacked as a whole and may be larger than the dataset.
    check_size(1, math.prod(dataset.chunks))
    ratio = math.prod(_iterate_filter_ratios(dataset))
    chunk_counts = (math.ceil(size / chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if dataset.id.get_num_chunks() < math.prod(chunk_counts):
        raise ImageError(f"{dataset.name} has parts that were never written; cut it to the frames that are there")
    if stored_bytes > length:
        raise ImageError("is cut short; copy the file again")
    check_length(math.ceil(pixel_bytes / ratio), stored_bytes)


def _iterate_filter_ratios(dataset: h5py.Dataset) -> Iterator[int]:
    """Yield the largest ratio of unpacked to packed bytes of each filter of a dataset.

    Raises `ImageError` for a filter that is not in `FILTER_RATIOS`.
    """
    properties = dataset.id.get_create_plist()
    for index in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(index)
        if code not in FILTER_RATIOS:
            raise ImageError(
                f"{dataset.name} is packed by {name.decode(errors='replace')[:40]!r}, which is not read; use gzip"
            )
        yield FILTER_RATIOS[code]


def read_page(dataset: h5py.Dataset, page: int) -> np.ndarray:
    """Return the pixels of a page [row, column] or [row, column, channel], in native byte order.

    Raises `ImageError` if a pixel has the value that marks missing ones (netCDF conventions).
    """
    pixels = dataset[find_page_index(page, dataset.shape)]
    for name in ("_FillValue", "missing_value"):
        if name in dataset.attrs and np.any(pixels == dataset.attrs[name]):
            raise ImageError(f"{dataset.name} holds pixels that are missing ({name}); leave out that page")
    return np.ascontiguousarray(pixels, dataset.dtype.newbyteorder("="))


def list_metadata(dataset: h5py.Dataset) -> list[Entry]:
    """Return the metadata of a dataset: its attributes, those of the groups above it, and values in these groups.

    Values that are neither a number nor a text are dropped.
    """
    page_count = len(make_pages(dataset.shape, dataset.dtype))
    entries = _list_attributes(dataset)
    group = dataset
    while group.name != "/":
        group = group.parent
        entries += _list_attributes(group)
        for name in list(group)[:MAX_MEMBERS]:
            member = group.get(name) if _is_stored_in(group, name) else None
            if isinstance(member, h5py.Dataset) and member.size is not None and member != dataset:
                entries += _list_values(name, member, page_count)
    return [entry for entry in entries if entry[1]]


def _list_attributes(source: h5py.Dataset | h5py.Group) -> list[Entry]:
    """Return the first `MAX_MEMBERS` attributes of a dataset or group; values are "" unless they are single ones."""
    return [(name, _format_value(value), None) for name, value in list(source.attrs.items())[:MAX_MEMBERS]]


def _list_values(name: str, dataset: h5py.Dataset, page_count: int) -> list[Entry]:
    """Return the value of a dataset with a single one, or the values of a dataset with one number per page.

    Each has its unit behind it. The list is empty for other datasets. `page_count` is that of the frames.
    """
    units = _format_value(dataset.attrs.get("units", ""))
    if dataset.size == 1:
        return [(name, f"{_format_value(dataset[()])} {units}".strip(), None)]
    if dataset.shape == (page_count,) and dataset.dtype.kind in "iuf":
        return [(name, f"{_format_value(value)} {units}".strip(), page) for page, value in enumerate(dataset[()])]
    return []


def _format_value(value: Any) -> str:
    """Return a single number or text as text of at most `MAX_TEXT` characters; "" for any other value."""
    values = np.asarray(value).ravel()
    if values.size != 1 or not isinstance(values[0], str | bytes | np.number):
        return ""
    text = values[0].decode(errors="replace") if isinstance(values[0], bytes) else str(values[0])
    return text[:MAX_TEXT]


def answer_request(request: str, path: str, inner_path: str, page: int) -> Any:
    """Return the reply to a request: "stacks", "metadata", "layout" (shape and type) or "pixels".

    `inner_path` is "" for the only dataset of frames; only "pixels" uses `page`. Raises `ImageError`.
    """
    with h5py.File(path, "r", locking=False) as file:
        if request == "stacks":
            return list_stacks(file)
        dataset = find_dataset(file, inner_path)
        if request == "metadata":
            return list_metadata(dataset)
        check_dataset(dataset, Path(path).stat().st_size)
        return read_page(dataset, page) if request == "pixels" else (dataset.shape, dataset.dtype)


def serve() -> None:
    """Answer requests on standard input until it ends."""
    output = os.fdopen(os.dup(1), "wb")
    # The HDF5 library prints to standard output, which becomes standard error so that replies stay intact.
    os.dup2(2, 1)
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        # The system kills this process if a request exceeds its processor time: user and system time count.
        used_s = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        hard_limit = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(used_s) + 1 + MAX_REQUEST_S, hard_limit))
        try:
            reply = answer_request(*request)
        except (ImageError, MemoryError) as error:
            reply = error
        except Exception as error:
            # h5py raises any class for a broken file; the text alone is sent.
            reply = OSError(f"{type(error).__name__}: {error}")
        # Protocol 5 sends pixels without a copy.
        pickle.dump(reply, output, protocol=5)
        output.flush()
