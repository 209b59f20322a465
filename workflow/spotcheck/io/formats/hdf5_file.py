"""HDF5 (also netCDF-4 and NeXus) through h5py: a process of its own, since the C library may crash or hang on a broken
file. `hdf5.py` starts it and asks.

A question is a line of JSON on standard input; the answer is a line of JSON on standard output, with the bytes of the
pixels behind it.
"""

import json
import math
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from spotcheck.io.formats.arrays import are_readings, pages_of, place_of
from spotcheck.io.formats.page import DEFLATE_RATIO, Refused, check_length, check_size

# Time of the processor that a question may take [s]: the largest frame is unpacked in three.
LONGEST_S = 8
# Groups and datasets that are looked at, and signs of a text.
MOST_OBJECTS, LONGEST_TEXT = 10_000, 1000
# Filters that give back what was stored, and how many bytes a byte makes at most: deflate, shuffle, checksum, LZF.
FILTERS = {
    h5py.h5z.FILTER_DEFLATE: DEFLATE_RATIO,
    h5py.h5z.FILTER_SHUFFLE: 1,
    h5py.h5z.FILTER_FLETCHER32: 1,
    32000: 100,
}
# Attributes by which a stored number is no reading (netCDF conventions), and their values that change nothing.
SCALED = {"scale_factor": 1, "add_offset": 0}
SMALLEST_SIDE = 8


def stacks(file: h5py.File) -> list[str]:
    """Paths of all datasets in a file that may be frames: unsigned numbers of 8 or 16 bits over rows and columns."""
    return [own.name for own in _datasets(file) if _is_stack(own)]


def _datasets(file: h5py.File) -> Iterator[h5py.Dataset]:
    """Datasets of a file in the order of their paths. Links into other files are not followed."""
    waiting, seen = [file["/"]], 0
    while waiting:
        group = waiting.pop(0)
        for name in group:
            if (seen := seen + 1) > MOST_OBJECTS:
                raise Refused(f"holds more than {MOST_OBJECTS} objects; name the dataset behind #")
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            own = group[name]
            if isinstance(own, h5py.Dataset):
                yield own
            elif isinstance(own, h5py.Group) and own.name.count("/") < 30:
                waiting.append(own)


def _is_stack(own: h5py.Dataset) -> bool:
    """Whether a dataset may hold frames: not the 8-bit flags and tables that lie beside them."""
    return are_readings(own.dtype) and own.ndim >= 2 and min(own.shape[-2:]) >= SMALLEST_SIDE


def dataset(file: h5py.File, inside: str) -> h5py.Dataset:
    """The dataset of a path; without one the only one that may hold frames. Raises `Refused`."""
    if not inside:
        found = stacks(file)
        if len(found) != 1:
            named = f" in {', '.join(found[:5])}; name one, such as {found[0]}" if found else ""
            raise Refused(
                f"holds frames{named} behind # in the manifest" if found else "holds no frames of 8 or 16 bits"
            )
        inside = found[0]
    path = ""
    for part in (part for part in inside.split("/") if part):
        path += f"/{part}"
        link = file.get(path, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise Refused(f"{path} is a link into another file, {link.filename[:80]!r}; name that file in the manifest")
        if link is None:
            raise Refused(
                f"has nothing at {path[:80]}; it holds frames in {', '.join(stacks(file)[:5]) or 'no dataset'}"
            )
    own = file[path or "/"]
    if not isinstance(own, h5py.Dataset):
        raise Refused(f"{path or '/'} is a group; name one of {', '.join(stacks(file)[:5])}")
    return own


def check(own: h5py.Dataset, length: int) -> None:
    """Raise `Refused` for a dataset whose pixels are not, or not as they were read, in this file of `length` bytes."""
    pages_of(own.shape, own.dtype)
    if own.is_virtual or own.external:
        raise Refused(f"{own.name} lies in other files; name those in the manifest")
    for name, plain in SCALED.items():
        if name in own.attrs and not np.all(own.attrs[name] == plain):
            raise Refused(f"{own.name} has the attribute {name}: its numbers are no readings; save them without")
    stored, needed = own.id.get_storage_size(), own.size * own.dtype.itemsize
    if own.chunks is None:
        check_length(needed, min(stored, length))
        return
    check_size(1, math.prod(own.chunks))
    plist = own.id.get_create_plist()
    growth = 1
    for k in range(plist.get_nfilters()):
        code, _, _, name = plist.get_filter(k)
        if code not in FILTERS:
            raise Refused(
                f"{own.name} is packed by {name.decode(errors='replace')[:40]!r}, which is not read; use gzip"
            )
        growth *= FILTERS[code]
    grid = (math.ceil(size / chunk) for size, chunk in zip(own.shape, own.chunks, strict=True))
    if own.id.get_num_chunks() < math.prod(grid):
        raise Refused(f"{own.name} has parts that were never written; cut it to the frames that are there")
    if stored > length:
        raise Refused("is cut short; copy the file again")
    check_length(math.ceil(needed / growth), stored)


def read(own: h5py.Dataset, page: int) -> np.ndarray:
    """Pixels of a page. Raises `Refused` where one of them is marked as missing."""
    pixels = own[place_of(page, own.shape)]
    for name in ("_FillValue", "missing_value"):
        if name in own.attrs and np.any(pixels == own.attrs[name]):
            raise Refused(f"{own.name} holds pixels that are missing ({name}); leave out that page")
    return np.ascontiguousarray(pixels, own.dtype.newbyteorder("="))


def texts(own: h5py.Dataset) -> list[tuple[str, str, int | None]]:
    """Names and values around a dataset, with the page that they are of, None for all: its attributes, and numbers and
    texts beside it and in the groups above."""
    found: list[tuple[str, str, int | None]] = []
    count = len(pages_of(own.shape, own.dtype))
    found += [(name, _text(value), None) for name, value in list(own.attrs.items())[:100]]
    group = own.parent
    while True:
        found += [(name, _text(value), None) for name, value in list(group.attrs.items())[:100]]
        for name in list(group)[:100]:
            beside = group.get(name) if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
            if not isinstance(beside, h5py.Dataset) or beside.size is None or beside == own:
                continue
            units = _text(beside.attrs.get("units", ""))
            if beside.size == 1:
                found.append((name, f"{_text(beside[()])} {units}".strip(), None))
            elif beside.shape == (count,) and beside.dtype.kind in "iuf":
                found += [(name, f"{_text(value)} {units}".strip(), k) for k, value in enumerate(beside[()])]
        if group.name == "/":
            return [own for own in found if own[1]]
        group = group.parent


def _text(value: Any) -> str:
    """A single number or text; "" for anything else."""
    value = np.asarray(value).ravel()
    if value.size != 1:
        return ""
    own = value[0]
    text = own.decode(errors="replace") if isinstance(own, bytes) else str(own)
    return text[:LONGEST_TEXT] if isinstance(own, str | bytes | np.number) else ""


def answer(question: dict[str, Any]) -> tuple[Any, bytes]:
    """The answer to a question, and the pixels that belong to it."""
    path = question["path"]
    length = Path(path).stat().st_size
    with h5py.File(path, "r", locking=False) as file:
        if question["what"] == "stacks":
            return stacks(file), b""
        own = dataset(file, question["inside"])
        if question["what"] == "texts":
            return texts(own), b""
        check(own, length)
        if question["what"] == "pages":
            return [own.shape, own.dtype.str], b""
        pixels = read(own, question["page"])
        return [pixels.shape, pixels.dtype.str], pixels.tobytes()


def serve() -> None:
    """Answer questions on standard input until there are no more."""
    answers = os.fdopen(os.dup(1), "wb")
    # What the library itself prints must not get between the answers.
    os.dup2(2, 1)
    for line in sys.stdin.buffer:
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        resource.setrlimit(resource.RLIMIT_CPU, (int(used) + 1 + LONGEST_S, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        pixels, said = b"", dict[str, Any]()
        try:
            said["found"], pixels = answer(json.loads(line))
        except Refused as error:
            said["refused"] = str(error)
        except MemoryError:
            said["memory"] = True
        except Exception as error:
            said["error"] = f"{type(error).__name__}: {error}"
        answers.write(json.dumps(said | {"bytes": len(pixels)}).encode() + b"\n" + pixels)
        answers.flush()
