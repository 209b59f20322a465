"""A case, drawn, cropped and judged in memory with the library's own functions: all that the suite knows of them."""

import fcntl
import json
import math
import signal
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rig import hidden
from spotcheck.discrepancy.calibration import Kind, calibrate, canonical, digest_of, stored
from spotcheck.discrepancy.detect import Null
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.verdict import Judgement, discovery_design, judge, verdict_json
from tests.blind.advised import followed
from tests.blind.by_command import differences
from tests.blind.crops import set_of
from tests.blind.limit import limit_of
from tests.blind.plan import Job
from tests.blind.told import told_truth

NullOf = Callable[[Design, Kind], Null]
# As in config/config.yaml, so that the command line finds the same null laws.
NULL_SEED, NULL_COUNT = 20210, 1500
# A null set takes at most this long [s]; a verdict that takes more time of its process has failed [s].
NULL_SECONDS, PATIENCE = 0.8, 400.0
TOLERANCE = Tolerance()
# One job in so many also goes through folder, TIFF and command line; one in so many by the workflow.
BY_COMMAND, WHOLE = 15, 180


class Busy(Exception):
    """Another process is at the null law that this job needs."""


def record_of(
    job: Job, null_of: NullOf, tolerance: Tolerance = TOLERANCE, patience: float = PATIENCE
) -> dict[str, Any]:
    """Draw and judge one case. An exception is an outcome like others; only `Busy` passes."""
    out: dict[str, Any] = {"job": job._asdict(), "outcome": "judged", "truth": None, "verdict": None, "told": None}
    start = time.perf_counter()
    try:
        case = hidden.draw_case(job.seed, job.kind, job.design)
        out["truth"] = case.truth
        if passed_over(job, case):
            return out | {"outcome": "passed over"}
        seen = set_of(case, job.budget)
        drawn = time.perf_counter()
        null = null_of(discovery_design(seen.shots)[0], seen.kind)
        ready = time.perf_counter()
        with _within(patience):
            judgement = judge(seen.shots, seen.setting, seen.kind, lambda design, kind: null, tolerance)
            verdict = verdict_json(judgement, f"{job.seed}", tolerance)
        done = time.perf_counter()
        out["seconds"] = {"draw": drawn - start, "null": ready - drawn, "judge": done - ready}
        # Whatever was judged must be fit for a file.
        out["verdict"] = json.loads(json.dumps(verdict, allow_nan=False))
        out["told"], out["told_error"] = _told(judgement, case, seen.shots, tolerance)
        out["seconds"]["told"] = time.perf_counter() - done
        if job.kind.startswith("one") and verdict["status"] == "ambiguous":
            out["advised"] = _advised(judgement, case, tolerance)
    except Busy:
        raise
    except Exception as error:
        out |= {"outcome": "error", "error": _said(error)}
    return out


def compared(record: dict[str, Any], nulls: "Nulls") -> dict[str, Any]:
    """The record with what the command line says otherwise; as it is where that is not asked for."""
    job = Job(**record["job"])
    if nulls.keep or job.budget or job.number % BY_COMMAND or record["outcome"] != "judged":
        return record
    start = time.perf_counter()
    whole = job.number % WHOLE == 0
    try:
        apart = differences(job, record["verdict"], nulls.folder, nulls.count, nulls.seed, whole)
    except Exception as error:
        apart = [_said(error)]
    return record | {"command": {"whole": whole, "differences": apart, "seconds": time.perf_counter() - start}}


def _told(
    judgement: Judgement, case: hidden.Case, shots: list[Shot], tolerance: Tolerance
) -> tuple[dict[str, Any] | None, str]:
    """What a model told the truth does; where that fails it is the suite's failure, not the verdict's."""
    try:
        with _within(PATIENCE):
            own = told_truth(judgement, case.truth, shots)
            if own is not None and len(case.truth["effects"]) == 1:
                own["limit"] = limit_of(case, tolerance)
            return json.loads(json.dumps(own, allow_nan=False)), ""
    except Exception as error:
        return None, _said(error)


def _advised(judgement: Judgement, case: hidden.Case, tolerance: Tolerance) -> dict[str, Any]:
    """What comes of the advice; where that fails, why."""
    try:
        with _within(PATIENCE):
            return followed(judgement, case, tolerance)
    except Exception as error:
        return {"error": _said(error)}


def _said(error: Exception) -> str:
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno} in {where.name})"


def passed_over(job: Job, case: hidden.Case) -> bool:
    """Sensors of 12 bit are judged in the default design alone: elsewhere they would double the null laws to be made.

    The data sheet decides this, which an analysis may see.
    """
    return job.design != "default" and case.instrument["sensor"]["bit_depth"] != 10


class Nulls:
    """Null laws by design and kind, each made once and kept in a folder; two processes never make the same one."""

    def __init__(self, folder: Path, count: int, keep: bool = False, deadline: float = math.inf) -> None:
        """With `keep`, for tuning, laws outlive changes of the code and serve both photon budgets. None is
        begun that would pass the deadline."""
        self.folder, self.count, self.seed, self.keep, self.deadline = folder, count, NULL_SEED, keep, deadline
        self._known: dict[str, Null] = {}

    def null_for(self, design: Design, kind: Kind) -> Null:
        """The null law; raises `Busy` while another process makes it, or where too little time is left to make it."""
        design = canonical(design)
        if self.keep:
            kind = kind._replace(photon_budget="free" if kind.photon_budget == "free" else "linear")
        key = f"{zlib.crc32(repr((_grid(design), kind)).encode()):08x}"
        if key not in self._known:
            self.folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / f"{key}.lock").open("w") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise Busy from None
                self._known[key] = self._kept(key, design, kind) if self.keep else self._fresh(design, kind)
        return self._known[key]

    def _fresh(self, design: Design, kind: Kind) -> Null:
        """By the code as it is now."""
        if not (self.folder / digest_of(design, kind, self.count, self.seed)).exists():
            self._in_time()
        return stored(self.folder, design, kind, self.count, self.seed)

    def _kept(self, key: str, design: Design, kind: Kind) -> Null:
        """By whatever code first made it."""
        path = self.folder / f"{key}-{self.count}.json"
        if not path.exists():
            self._in_time()
            null = calibrate(design, kind, self.count, self.seed)
            path.write_text(json.dumps([null.names, *(v.tolist() for v in null[1:])]), encoding="utf-8")
        names, *numbers = json.loads(path.read_text(encoding="utf-8"))
        return Null(tuple(names), *(np.array(v) for v in numbers))

    def _in_time(self) -> None:
        if time.time() + NULL_SECONDS * self.count > self.deadline:
            raise Busy


def _grid(design: Design) -> tuple:
    conditions = [
        (float(design.angle_deg[c]), float(design.exposure_s[c]), int(r))
        for c, r in zip(design.condition, design.repeat, strict=True)
    ]
    return tuple(conditions)


@contextmanager
def _within(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in what takes more time of this process."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
