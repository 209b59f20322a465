"""Cached digests of files, which are valid as long as size, times and inode of a file are unchanged.

A file with other content has another time of change (ctime), which no `cp -p`, `rsync -t` or `mv` can set.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.errors import InputError
from spotcheck.io import atomic_files, provenance

# A file must be unchanged for this long before it is read, or a later change may have the same time [ns]: disks count
# time in steps of 4 ms, some network disks in seconds.
MIN_AGE_NS = 2_000_000_000


@dataclass(frozen=True)
class FileRecord:
    """Status and digest of a file."""

    size: int  # [byte]
    mtime_ns: int  # time of modification [ns]
    ctime_ns: int  # time of change [ns]
    inode: int  # number of the file in its file system
    sha256: str  # digest of the content
    is_final: bool  # whether a file with this status certainly has this content


def record_file(path: str | Path, earlier: FileRecord | None = None) -> FileRecord:
    """Return the record of a file, which is read only if its status differs from an earlier record."""
    # The status comes first: a change while the file is read then leads to another status.
    now, status = time.time_ns(), Path(path).stat()
    stamps = status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino
    if earlier is not None and earlier.is_final and astuple(earlier)[:4] == stamps:
        return earlier
    is_final = max(status.st_mtime_ns, status.st_ctime_ns) < now - MIN_AGE_NS
    return FileRecord(*stamps, provenance.file_digest(path), is_final)


def record_files(paths: Iterable[str | Path], earlier: Mapping[str, FileRecord]) -> dict[str, FileRecord]:
    """Return the records of existing files by path, with the help of earlier ones."""
    return {str(path): record_file(path, earlier.get(str(path))) for path in paths if Path(path).is_file()}


def get_cache_path(results: Path) -> Path:
    """Return the path of the cache in a results folder."""
    return results / ".runs" / "seen.json"


def read_cache(path: Path) -> dict[str, FileRecord]:
    """Return the cached records by path; empty if the cache is missing or cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {file: FileRecord(*fields) for file, fields in content.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def write_cache(records: dict[str, FileRecord], path: Path) -> None:
    """Write records to the cache if they differ from its content."""
    if records != read_cache(path):
        atomic_files.write_text(path, json.dumps({file: astuple(record) for file, record in records.items()}))


@contextmanager
def verify_unchanged(dataset: Dataset, table: xr.Dataset) -> Iterator[None]:
    """Verify, before and after the frames of a dataset are read again, that their files are those in frames.nc.

    Parameters
    ----------
    dataset : the dataset.
    table : content of frames.nc, with the digest of each file.

    Raises
    ------
    InputError
        If a file is not in the table, or its content differs.
    """
    digests = dict(zip(map(str, table["file"].values), map(str, table["sha256"].values), strict=True))
    # A table in memory has no file, and so no cache beside it.
    cache = read_cache(get_cache_path(Path(table.encoding.get("source", "nowhere")).parent))
    files = {str(dataset.folder / frame.path): frame.file for frame in dataset.frames}

    def verify(earlier: Mapping[str, FileRecord]) -> dict[str, FileRecord]:
        records = record_files(files, earlier)
        for path, file in files.items():
            if file not in digests:
                raise InputError(f"{file}: not in frames.nc; run again, which ingests it")
            if path not in records or records[path].sha256 != digests[file]:
                raise InputError(f"{file}: has changed since it was ingested; run again when nothing writes to it")
        return records

    records = verify(cache)
    yield
    verify(records)
