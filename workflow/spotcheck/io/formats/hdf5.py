"""HDF5, netCDF-4 and NeXus, read by a process of its own: the library behind them crashes on some broken files."""

import atexit
import json
import os
import subprocess
import sys
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from spotcheck.io.formats.arrays import pages_of
from spotcheck.io.formats.page import Page, Refused

SIGNATURE = b"\x89HDF\r\n\x1a\n"
BROKEN = "cannot be read as HDF5: the library that reads it crashes or takes too long; copy the file again"
_lock = Lock()
# By the process that started it: one that was forked must not read the answers to the other.
_processes: dict[int, subprocess.Popen] = {}


def pages(path: Path, inside: str = "") -> list[Page]:
    """Every page of the dataset at the path `inside` a file. Raises `Refused`."""
    (shape, dtype), _ = _ask({"what": "pages", "path": str(path.absolute()), "inside": inside})
    return pages_of(tuple(shape), np.dtype(dtype))


def read(path: Path, page: int, inside: str = "") -> np.ndarray:
    """Pixels of a page, [rows, columns] or [rows, columns, colours]. Raises `Refused`."""
    (shape, dtype), content = _ask({"what": "read", "path": str(path.absolute()), "inside": inside, "page": page})
    return np.frombuffer(content, dtype).reshape(shape)


def stacks(path: Path) -> list[str]:
    """Paths inside a file at which frames lie. Raises `Refused`."""
    return list(_ask({"what": "stacks", "path": str(path.absolute())})[0])


def texts(path: Path, inside: str) -> list[tuple[str, str, int | None]]:
    """Names and values around the dataset at the path `inside` a file, each with its page. Raises `Refused`."""
    return [tuple(own) for own in _ask({"what": "texts", "path": str(path.absolute()), "inside": inside})[0]]


def _ask(question: dict[str, Any]) -> tuple[Any, bytes]:
    """The answer of the reading process, which is started for the first question and after each crash."""
    with _lock:
        if os.getpid() not in _processes:
            command = [sys.executable, "-P", "-c", "from spotcheck.io.formats import hdf5; hdf5.serve()"]
            pipe, null = subprocess.PIPE, subprocess.DEVNULL
            # It finds the modules where this process does, and none that happen to lie in the working folder (-P).
            where = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
            _processes[os.getpid()] = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=null, env=where)
        process = _processes[os.getpid()]
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(question).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
            said = json.loads(line) if line else {}
            content = process.stdout.read(said.get("bytes", 0))
        except BrokenPipeError:
            said = {}
        except BaseException:
            close()
            raise
        if not said:
            close()
    if not said or len(content) < said["bytes"]:
        raise Refused(BROKEN)
    if "memory" in said:
        raise MemoryError
    if "refused" in said:
        raise Refused(said["refused"])
    if "error" in said:
        raise OSError(said["error"])
    return said["found"], content


def serve() -> None:
    """What the reading process does."""
    from spotcheck.io.formats import hdf5_file

    hdf5_file.serve()


@atexit.register
def close() -> None:
    """End the reading process."""
    if process := _processes.pop(os.getpid(), None):
        process.kill()
        process.communicate()
