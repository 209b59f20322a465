"""HDF5, netCDF-4 and NeXus files, read in a worker process: the HDF5 library crashes on some broken files."""

import atexit
import json
import os
import subprocess
import sys
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from spotcheck.io.formats.arrays import make_pages
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.formats.page import ImageError, Page

SIGNATURE = b"\x89HDF\r\n\x1a\n"
CRASHED = "cannot be read as HDF5: the library that reads it crashes or takes too long; copy the file again"
_lock = Lock()
# Worker of each process by its id: a forked process must not read the replies to its parent.
_workers: dict[int, subprocess.Popen] = {}


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a dataset, whose path inside the file follows behind #. Raises `ImageError`."""
    file, inside = split_inner_path(path.as_posix())
    (shape, dtype), _ = _request("shape", Path(file), inside)
    return make_pages(tuple(shape), np.dtype(dtype))


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return a page [row, column] or [row, column, channel] of a dataset. Raises `ImageError`."""
    file, inside = split_inner_path(path.as_posix())
    (shape, dtype), content = _request("pixels", Path(file), inside, page)
    return np.frombuffer(content, dtype).reshape(shape)


def list_stacks(path: Path) -> list[str]:
    """Return the paths of all datasets of frames inside a file. Raises `ImageError`."""
    return list(_request("stacks", path)[0])


def read_metadata(path: Path, inside: str) -> list[tuple[str, str, int | None]]:
    """Return the metadata of the dataset at the path `inside` a file. Raises `ImageError`.

    Returns
    -------
    list of (name, value, page)
        Attributes and neighbouring values of the dataset; `page` is None for a value that holds for all pages.
    """
    return [tuple(entry) for entry in _request("metadata", path, inside)[0]]


def _request(what: str, path: Path, inside: str = "", page: int = 0) -> tuple[Any, bytes]:
    """Return the reply of the worker: its JSON content and its bytes. It is started if it does not run."""
    with _lock:
        try:
            reply, content = _send(
                _start_worker(), {"what": what, "path": str(path.absolute()), "inside": inside, "page": page}
            )
        except BrokenPipeError:
            reply, content = {}, b""
        except BaseException:
            close()
            raise
        if not reply:
            close()
    if not reply or len(content) < reply["bytes"]:
        raise ImageError(CRASHED)
    if "memory" in reply:
        raise MemoryError
    if "refused" in reply:
        raise ImageError(reply["refused"])
    if "error" in reply:
        raise OSError(reply["error"])
    return reply["result"], content


def _start_worker() -> subprocess.Popen:
    """Return the worker of this process, which is started for the first request and after each crash."""
    if os.getpid() not in _workers:
        # With -P, and the search path of this process, no module in the working folder shadows a real one.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        _workers[os.getpid()] = subprocess.Popen(
            [sys.executable, "-P", "-c", "from spotcheck.io.formats import hdf5; hdf5.serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
    return _workers[os.getpid()]


def _send(worker: subprocess.Popen, request: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """Send a request and return the reply, which is empty if the worker has crashed."""
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write(json.dumps(request).encode() + b"\n")
    worker.stdin.flush()
    line = worker.stdout.readline()
    reply = json.loads(line) if line else {}
    return reply, worker.stdout.read(reply.get("bytes", 0))


def serve() -> None:
    """Run the worker. The import stands here so that the digest of this module covers the worker's code."""
    from spotcheck.io.formats import hdf5_worker

    hdf5_worker.serve()


@atexit.register
def close() -> None:
    """End the worker of this process."""
    if worker := _workers.pop(os.getpid(), None):
        worker.kill()
        worker.communicate()
