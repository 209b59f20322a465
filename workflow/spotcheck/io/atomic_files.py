"""Atomic writing: a file appears under its name only when it is complete, and the causes of failures are explained."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spotcheck.errors import InputError

# Errors of the file system that the user can correct, by error number, and what to do.
REMEDIES = {
    errno.ENOSPC: "make room on the disk and run again",
    errno.EDQUOT: "make room within your quota and run again",
    errno.EFBIG: "raise the limit on the size of files (`ulimit -f`) and run again",
    errno.EROFS: "name a folder on a disk that can be written",
    errno.EACCES: "correct the permissions of its folder, or name another one",
    errno.EPERM: "correct the permissions of its folder, or name another one",
}
# A disk counts as full if it has less space than the scratch file and this [byte], the largest block of HDF5.
PROBE_BYTES = 2**20


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield the path of a scratch file, which is renamed to `path` if the block ends without an exception.

    Parameters
    ----------
    path : Path
        File to write; its folder is created. An earlier file is unchanged until the new one is complete.

    Raises
    ------
    InputError
        If the disk is full or the folder cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        scratch.replace(path)
    except (OSError, RuntimeError) as error:
        if cause := _find_cause(error, scratch):
            raise InputError(f"{path}: cannot be written ({os.strerror(cause)}); {REMEDIES[cause]}") from None
        raise
    finally:
        scratch.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    """Write a UTF-8 text file atomically. Raises `InputError` as `write_atomically` does."""
    with write_atomically(path) as scratch:
        scratch.write_text(content, encoding="utf-8")


def _find_cause(error: OSError | RuntimeError, scratch: Path) -> int | None:
    """Return the error number, one of `REMEDIES`, why a scratch file could not be written; None for other errors."""
    if isinstance(error, OSError):
        # The error may be about another file that is read in the same block. Ours are about the scratch file, a folder
        # above it, or the scratch file of another write.
        failed_path = Path(error.filename or scratch)
        is_output = scratch.is_relative_to(failed_path) or failed_path.suffix == scratch.suffix
        return error.errno if is_output and error.errno in REMEDIES else None
    if not str(error).startswith("NetCDF: "):
        return None
    # netCDF does not report the error number; allocating the same space once more reveals it.
    try:
        with tempfile.TemporaryFile(dir=scratch.parent) as probe:
            os.posix_fallocate(probe.fileno(), 0, PROBE_BYTES + (scratch.stat().st_size if scratch.exists() else 0))
    except OSError as probe_error:
        return probe_error.errno if probe_error.errno in REMEDIES else None
    return None
