"""Files that appear whole or not at all; what keeps one from being written is told in a sentence."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spotcheck.errors import InputError

# Why a file cannot be written though the program is right, and what mends it.
CAUSES = {
    errno.ENOSPC: "make room on the disk and run again",
    errno.EDQUOT: "make room within your quota and run again",
    errno.EFBIG: "raise the limit on the size of files (`ulimit -f`) and run again",
    errno.EROFS: "name a folder on a disk that can be written",
    errno.EACCES: "mend the permissions of its folder, or name another one",
    errno.EPERM: "mend the permissions of its folder, or name another one",
}
# Room that a disk must have beyond what was written before another cause is looked for [byte]: HDF5 writes in blocks of
# at most this size.
PROBE_BYTES = 2**20


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A scratch name in the same folder that takes the final name only when all was written.

    Raises `InputError` where the disk is full or the folder cannot be written; an earlier file stays as it was then.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        scratch.replace(path)
    except (OSError, RuntimeError) as error:
        if cause := _cause(error, scratch):
            raise InputError(f"{path}: cannot be written ({os.strerror(cause)}); {CAUSES[cause]}") from None
        raise
    finally:
        scratch.unlink(missing_ok=True)


def text(path: Path, content: str) -> None:
    """Write a text file whole or not at all."""
    with whole(path) as scratch:
        scratch.write_text(content, encoding="utf-8")


def _cause(error: OSError | RuntimeError, scratch: Path) -> int | None:
    """The error number, where it is one of `CAUSES`, of what stopped the writing of a scratch file."""
    if isinstance(error, OSError):
        # What is read meanwhile has a name of its own.
        named = Path(error.filename or scratch)
        ours = scratch.is_relative_to(named) or named.suffix == scratch.suffix
        return error.errno if ours and error.errno in CAUSES else None
    if not str(error).startswith("NetCDF: "):
        return None
    # netCDF does not say why it could not write: the disk does, when as much is asked of it once more.
    try:
        with tempfile.TemporaryFile(dir=scratch.parent) as probe:
            os.posix_fallocate(probe.fileno(), 0, PROBE_BYTES + (scratch.stat().st_size if scratch.exists() else 0))
    except OSError as found:
        return found.errno if found.errno in CAUSES else None
    return None
