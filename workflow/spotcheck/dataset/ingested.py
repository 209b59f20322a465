"""What files held when they were last looked at, without reading them all again: a digest counts as long as the file's
size, times and number are those of then.

A file whose content differs has another time of change (ctime), which no `cp -p`, `rsync -t` or `mv` can set.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.errors import InputError
from spotcheck.io import atomic_files, provenance

# A file must have been left alone for so long before it was read, or else a later change may bear the same time [ns]:
# disks count time in steps of 4 ms, some network disks in seconds.
SETTLED_NS = 2_000_000_000


class Look(NamedTuple):
    """Size [byte], times of modification and of change [ns], number (inode) and SHA-256 of a file; `settled` is whether
    a file with these stamps surely has this content."""

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    sha256: str
    settled: bool


def look(path: str | Path, before: Look | None = None) -> Look:
    """Look at a file; it is read where it does not bear the stamps of an earlier look."""
    # Stamps first: what changes while the file is read then differs from them.
    now, status = time.time_ns(), Path(path).stat()
    stamps = status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino
    if before is not None and before.settled and before[:4] == stamps:
        return before
    settled = max(status.st_mtime_ns, status.st_ctime_ns) < now - SETTLED_NS
    return Look(*stamps, provenance.file_digest(path), settled)


def memory_of(results: Path) -> Path:
    """The file in a results folder that remembers looks."""
    return results / ".runs" / "seen.json"


def recall(memory: Path) -> dict[str, Look]:
    """The looks that were remembered, by path; none where there is no such file, or one that cannot be read."""
    try:
        return {path: Look(*own) for path, own in json.loads(memory.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def looks(paths: Iterable[str | Path], before: Mapping[str, Look]) -> dict[str, Look]:
    """Looks at files that are there, by path, with the help of earlier ones."""
    return {str(path): look(path, before.get(str(path))) for path in paths if Path(path).is_file()}


def remember(found: dict[str, Look], memory: Path) -> None:
    """Write looks down, where they differ from what is remembered."""
    if found != recall(memory):
        atomic_files.write_text(memory, json.dumps(found))


@contextmanager
def as_ingested(dataset: Dataset, table: xr.Dataset) -> Iterator[None]:
    """While the frames of a dataset are read again: raises `InputError` where one is not, or no more, what frames.nc
    says of it."""
    ingested = dict(zip(map(str, table["file"].values), map(str, table["sha256"].values), strict=True))
    # A table that was never written has no place to remember anything in.
    found = recall(memory_of(Path(table.encoding.get("source", "nowhere")).parent))
    files = {str(dataset.folder / frame.path): frame.file for frame in dataset.frames}

    def check(before: Mapping[str, Look]) -> dict[str, Look]:
        found = looks(files, before)
        for path, file in files.items():
            if file not in ingested:
                raise InputError(f"{file}: not in frames.nc; run again, which ingests it")
            if path not in found or found[path].sha256 != ingested[file]:
                raise InputError(f"{file}: has changed since it was ingested; run again when nothing writes to it")
        return found

    found = check(found)
    yield
    check(found)
