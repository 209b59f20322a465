"""Cache of the digests of files; a digest is valid as long as size, times and inode of its file are unchanged.

A file whose content was changed has another time of change (ctime), which `cp -p`, `rsync -t` and `mv` cannot set.
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

# Age from which the times of a file identify its content [ns]. Disks count time in steps of 4 ms, some network disks in
# seconds, so a file that is changed twice within a step keeps its times.
MIN_AGE_NS = 2_000_000_000


@dataclass(frozen=True)
class FileRecord:
    """Status (of `os.stat`) and digest of a file."""

    size: int  # [byte]
    mtime_ns: int  # time of modification [ns]
    ctime_ns: int  # time of change [ns]
    inode: int  # number of the file in its file system
    sha256: str  # digest of the content
    is_final: bool  # whether a file with this status certainly has this content; False if it was changed just before


def record_file(path: str | Path, earlier: FileRecord | None = None) -> FileRecord:
    """Return the record of a file.

    If `earlier`, the cached record, is final and has the present status of the file, it is returned, and the file is
    not read.
    """
    # The status is taken before the file is read, so that a change while it is read leads to another status.
    now_ns, status = time.time_ns(), Path(path).stat()
    status_fields = status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino
    if earlier is not None and earlier.is_final and astuple(earlier)[: len(status_fields)] == status_fields:
        return earlier
    is_final = max(status.st_mtime_ns, status.st_ctime_ns) < now_ns - MIN_AGE_NS
    return FileRecord(*status_fields, provenance.file_digest(path), is_final)


def record_files(paths: Iterable[str | Path], earlier: Mapping[str, FileRecord]) -> dict[str, FileRecord]:
    """Return the record of each existing file by its path; `earlier` records save reading unchanged files."""
    return {str(path): record_file(path, earlier.get(str(path))) for path in paths if Path(path).is_file()}


def get_cache_path(results: Path) -> Path:
    """Return the path of the cache file in a results folder."""
    return results / ".runs" / "seen.json"


def read_cache(path: Path) -> dict[str, FileRecord]:
    """Return the cached records by path; empty if the cache is missing or cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {file: FileRecord(*fields) for file, fields in content.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def write_cache(records: dict[str, FileRecord], path: Path) -> None:
    """Write records by path to the cache file if they differ from its content."""
    if records != read_cache(path):
        atomic_files.write_text(path, json.dumps({file: astuple(record) for file, record in records.items()}))


@contextmanager
def verify_unchanged(dataset: Dataset, table: xr.Dataset) -> Iterator[None]:
    """Verify before and after a `with` block that the files of all frames are unchanged since they were ingested.

    Parameters
    ----------
    dataset : dataset whose frames are read in the block.
    table : content of frames.nc: the SHA-256 of each file when it was ingested.

    Raises
    ------
    InputError
        If a file is missing in the table or on the disk, or its content differs.
    """
    digests = dict(zip(map(str, table["file"].values), map(str, table["sha256"].values), strict=True))
    # frames.nc lies in the results folder; a table in memory has no file, and thus no cache.
    cache = read_cache(get_cache_path(Path(table.encoding.get("source", "nowhere")).parent))
    files = {str(dataset.folder / frame.path): frame.file for frame in dataset.frames}

    def verify(earlier: Mapping[str, FileRecord]) -> dict[str, FileRecord]:
        """Return the records of all files. Raises `InputError` for the first one that differs from the table."""
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
