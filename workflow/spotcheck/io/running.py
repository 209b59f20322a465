"""One run at a time in a folder of results, the end of its jobs with it, and what a killed run leaves behind.

A run holds a lock (flock) on a note in the results folder, which the kernel frees however the run ends: who gets it
knows that no other run is alive. Its jobs carry its token in their environment, by which they are found when it is
stopped, or when a killed run left them behind.
"""

import fcntl
import os
import platform
import re
import signal
import threading
import time
from pathlib import Path
from types import FrameType
from typing import NoReturn, TextIO

import psutil

from spotcheck.errors import InputError

# Environment variable that marks the jobs of a run.
TOKEN = "SPOTCHECK_RUN"
# Time that a job has to end by itself once it was asked to [s]: it removes what it was writing, which takes less; with
# what Snakemake does afterwards a run that is stopped ends within 10 s.
GRACE_S = 4.0
# How often new jobs are looked for while a run is being stopped [s]: one may be starting just then.
AGAIN_S = 0.2
# What is being written bears the name that it will have, its writer's number, and this ending (`writing`, the rig);
# notebooks need their own.
PART = re.compile(r"\..+\.(\d+)\.part|.+\.part\.ipynb")


def new_token() -> str:
    """A word that no other run has."""
    return f"{platform.node()}.{os.getpid()}.{time.time_ns()}"


def note_of(results: Path) -> Path:
    """The note that a run holds while it works in a results folder; it holds the token of the last one."""
    return results / ".runs" / "run"


def hold(results: Path, token: str) -> TextIO | None:
    """Hold a results folder for the run of a token, as long as the returned stream is open; ends the jobs that a killed
    run left behind there. None on a file system that has no locks.

    Raises `InputError` where another run holds it.
    """
    note = note_of(results)
    note.parent.mkdir(parents=True, exist_ok=True)
    stream = note.open("a+", encoding="utf-8")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise InputError(
            f"{results}: another run is working there; wait until it ends, or name another folder in `results`"
        ) from None
    except OSError:
        stream.close()
        return None
    stream.seek(0)
    if former := stream.read():
        end_jobs(former)
    stream.truncate(0)
    stream.write(token)
    stream.flush()
    return stream


def jobs_of(token: str) -> list[psutil.Process]:
    """Processes on this machine that a run started, directly or not."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and process.environ().get(TOKEN) == token:
                found.append(process)
        except psutil.Error:
            continue
    return found


def end_jobs(token: str) -> None:
    """End the jobs of a run: they are asked to, and after `GRACE_S` made to."""
    found = jobs_of(token)
    for own in found:
        _send(own, signal.SIGTERM)
    _, alive = psutil.wait_procs(found, timeout=GRACE_S)
    for own in alive:
        _send(own, signal.SIGKILL)
    psutil.wait_procs(alive, timeout=1.0)


def _send(process: psutil.Process, number: signal.Signals) -> None:
    try:
        process.send_signal(number)
    except psutil.NoSuchProcess:
        pass


def clear_parts(folder: Path) -> None:
    """Remove what writers below a folder left half written, where the writer is gone."""
    for path in folder.rglob("*.part*"):
        part = PART.fullmatch(path.name)
        if part and not (part[1] and psutil.pid_exists(int(part[1]))):
            path.unlink(missing_ok=True)


def end_with_jobs(token: str) -> None:
    """From now on SIGTERM and SIGINT end the jobs of this run first, then the run, as Ctrl-C does; a second one ends it
    at once."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        for own in (signal.SIGTERM, signal.SIGINT):
            signal.signal(own, signal.SIG_DFL)
        # Not by `print`: the signal may have come in the middle of one.
        os.write(2, f"spotcheck: stopped by {signal.Signals(number).name}; the same call goes on from here\n".encode())
        threading.Thread(target=_end_jobs_for_good, args=(token,), daemon=True).start()
        raise KeyboardInterrupt

    for own in (signal.SIGTERM, signal.SIGINT):
        signal.signal(own, stop)


def _end_jobs_for_good(token: str) -> NoReturn:
    while True:
        end_jobs(token)
        time.sleep(AGAIN_S)
