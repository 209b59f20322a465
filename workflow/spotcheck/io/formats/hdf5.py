"""HDF5, netCDF-4 and NeXus files, read in a worker process: the HDF5 library crashes on some broken files."""

import atexit
import os
import pickle
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
    return make_pages(*_request("layout", Path(file), inside))


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return a page [row, column] or [row, column, channel] of a dataset. Raises `ImageError`."""
    file, inside = split_inner_path(path.as_posix())
    return _request("pixels", Path(file), inside, page)


def list_stacks(path: Path) -> list[str]:
    """Return the paths of all datasets of frames inside a file. Raises `ImageError`."""
    return _request("stacks", path)


def read_metadata(path: Path, inside: str) -> list[tuple[str, str, int | None]]:
    """Return the metadata of the dataset at the path `inside` a file. Raises `ImageError`.

    Returns
    -------
    list of (name, value, page)
        Attributes and neighbouring values of the dataset; `page` is None for a value that holds for all pages.
    """
    return _request("metadata", path, inside)


def _request(what: str, path: Path, inside: str = "", page: int = 0) -> Any:
    """Return the reply of the worker to a request. Raises the exception that it replies, or `ImageError` if it ends."""
    with _lock:
        try:
            worker = _start_worker()
            assert worker.stdin is not None and worker.stdout is not None
            pickle.dump((what, str(path.absolute()), inside, page), worker.stdin)
            worker.stdin.flush()
            reply = pickle.load(worker.stdout)
        except BaseException as error:
            close()
            if isinstance(error, BrokenPipeError | EOFError | pickle.UnpicklingError):
                raise ImageError(CRASHED) from None
            raise
    if isinstance(reply, Exception):
        raise reply
    return reply


def _start_worker() -> subprocess.Popen:
    """Return the worker of this process, which is started for the first request and after each crash."""
    if os.getpid() not in _workers:
        command = [sys.executable, "-P", "-c", "from spotcheck.io.formats import hdf5; hdf5.serve()"]
        # With -P, and the search path of this process, no module in the working folder shadows a real one.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        pipe, null = subprocess.PIPE, subprocess.DEVNULL
        _workers[os.getpid()] = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=null, env=environment)
    return _workers[os.getpid()]


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
