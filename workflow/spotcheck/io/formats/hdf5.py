"""HDF5, netCDF-4 and NeXus files, read in a worker process: the HDF5 library crashes on some broken files.

A dataset is an HDF5 dataset here: an array in the file, with a path. Datasets of frames are the stacks of a file.
"""

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
# Held while a request is answered, because threads share the worker of their process.
_lock = Lock()
# Worker of each process by its id: a forked process must not read the replies to its parent.
_workers: dict[int, subprocess.Popen] = {}


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a dataset, whose path inside the file follows behind #. Raises `ImageError`."""
    file, inner_path = split_inner_path(path.as_posix())
    return make_pages(*_request("layout", Path(file), inner_path))


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return the pixels of a page [row, column] or [row, column, channel] of a dataset. Raises `ImageError`.

    `path` is as in `list_pages`.
    """
    file, inner_path = split_inner_path(path.as_posix())
    return _request("pixels", Path(file), inner_path, page)


def list_stacks(path: Path) -> list[str]:
    """Return the paths of all datasets of frames inside a file. Raises `ImageError`."""
    return _request("stacks", path)


def read_metadata(path: Path, inner_path: str) -> list[tuple[str, str, int | None]]:
    """Return the metadata of a dataset in a file; `inner_path` is "" for the only one of frames. Raises `ImageError`.

    Returns
    -------
    list of (name, value, page)
        Attributes of the dataset, and values beside it; `page` is None for a value that holds for all pages.
    """
    return _request("metadata", path, inner_path)


def _request(request: str, path: Path, inner_path: str = "", page: int = 0) -> Any:
    """Return the reply of the worker to a request: "stacks", "metadata", "layout" (shape and type) or "pixels".

    Raises the exception that the worker replies, or `ImageError` if the worker crashes.
    """
    with _lock:
        try:
            worker = _start_worker()
            assert worker.stdin is not None and worker.stdout is not None
            pickle.dump((request, str(path.absolute()), inner_path, page), worker.stdin)
            worker.stdin.flush()
            reply = pickle.load(worker.stdout)
        except BaseException as error:
            # Even an interrupt leaves a reply unread, so the worker is never used again.
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
    """Run the worker: the function that the worker process calls.

    The import is here so that `provenance.code_digest` of this module includes the code of the worker, although only
    the worker imports h5py.
    """
    from spotcheck.io.formats import hdf5_worker

    hdf5_worker.serve()


@atexit.register
def close() -> None:
    """End the worker of this process, if there is one."""
    if worker := _workers.pop(os.getpid(), None):
        worker.kill()
        worker.communicate()
