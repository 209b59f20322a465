"""Control of workflow runs: one run per results folder, the end of its jobs, and removal of what killed runs leave.

A run holds a lock (flock) on a file in the results folder. The kernel releases it however the run ends, so the next run
that gets the lock knows that no other run is alive. The jobs of a run are the processes that it starts, directly or
not. They have its token in their environment, by which they are found when the run is stopped, or by the next run if it
was killed.
"""

import fcntl
import os
import platform
import re
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn, TextIO

import psutil

from spotcheck.errors import InputError

# Environment variable that holds the token of a run in its jobs.
TOKEN_VARIABLE = "SPOTCHECK_RUN"
# Time between SIGTERM and SIGKILL, and time after SIGKILL that a job has to end [s]. A job needs less to remove its
# scratch file; together with what Snakemake does afterwards, a stopped run ends within 10 s.
GRACE_S, KILL_S = 4.0, 1.0
# Interval at which a run that is being stopped looks for jobs that have just started [s].
SEARCH_INTERVAL_S = 0.2
# Names of scratch files: `.NAME.PID.part` (`atomic_files`, the rig), and those of notebooks and their pages.
SCRATCH_NAME = re.compile(r"\..+\.(\d+)\.part|.+\.part\.(?:ipynb|html)")


def make_token() -> str:
    """Return a token that no other run has: host, process number and time."""
    return f"{platform.node()}.{os.getpid()}.{time.time_ns()}"


def get_lock_path(results: Path) -> Path:
    """Return the lock file of a results folder; it holds the token of the last run."""
    return results / ".runs" / "run"


def lock_results(results: Path, token: str) -> TextIO | None:
    """Lock a results folder for a run, and end the jobs that a killed run left behind there.

    Parameters
    ----------
    results : results folder, which is created if needed.
    token : token of the run.

    Returns
    -------
    TextIO or None
        Open lock file; the folder is locked until it is closed. None on a file system without locks.

    Raises
    ------
    InputError
        If another run holds the lock.
    """
    path = get_lock_path(results)
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = path.open("a+", encoding="utf-8")
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
    if last_token := stream.read():
        end_jobs(last_token)
    stream.truncate(0)
    stream.write(token)
    stream.flush()
    return stream


def find_jobs(token: str) -> list[psutil.Process]:
    """Return the processes on this machine that a run has started, directly or not, without this process."""
    # The environment of processes of other users is None.
    return [
        process
        for process in psutil.process_iter(["environ"])
        if process.pid != os.getpid() and (process.info["environ"] or {}).get(TOKEN_VARIABLE) == token
    ]


def end_jobs(token: str) -> None:
    """End the jobs of a run by SIGTERM, and by SIGKILL those that have not ended after `GRACE_S`."""
    jobs = find_jobs(token)
    for end_signal, timeout_s in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, KILL_S)):
        for job in jobs:
            with suppress(psutil.NoSuchProcess):
                job.send_signal(end_signal)
        _, jobs = psutil.wait_procs(jobs, timeout=timeout_s)


def remove_scratch_files(folder: Path) -> None:
    """Remove the scratch files below a folder whose writers have ended, and those whose names give no process."""
    for path in folder.rglob("*.part*"):
        match = SCRATCH_NAME.fullmatch(path.name)
        if match and not (match[1] and psutil.pid_exists(int(match[1]))):
            path.unlink(missing_ok=True)


def end_jobs_on_signal(token: str) -> None:
    """Install handlers by which SIGTERM and SIGINT end the jobs of this run, and then the run itself.

    The run ends as by Ctrl-C. A second signal ends it at once.
    """

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        """Handle a signal: restore the default handlers, end the jobs in a thread, and raise `KeyboardInterrupt`.

        Python passes the number of the signal and the interrupted stack frame, which is not used.
        """
        for stop_signal in (signal.SIGTERM, signal.SIGINT):
            signal.signal(stop_signal, signal.SIG_DFL)
        # The signal may have interrupted a `print`, which cannot be entered twice.
        name = signal.Signals(number).name
        os.write(2, f"spotcheck: stopped by {name}; the same command continues from here\n".encode())
        # The exception takes time to end this run, and jobs may start meanwhile: a thread ends them, too.
        threading.Thread(target=_keep_ending_jobs, args=(token,), daemon=True).start()
        raise KeyboardInterrupt

    for stop_signal in (signal.SIGTERM, signal.SIGINT):
        signal.signal(stop_signal, stop)


def _keep_ending_jobs(token: str) -> NoReturn:
    """End the jobs of a run again and again until this process ends: another job may be starting."""
    while True:
        end_jobs(token)
        time.sleep(SEARCH_INTERVAL_S)
