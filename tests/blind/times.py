"""Times of the whole command on one dataset of the default design, two cores: a new design with its calibration, then
datasets whose design is known.

`python -m tests.blind.times`: nothing else should run beside it. The calibration is what the first takes longer than
another of its kind.
"""

import json
import tempfile
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from rig import hidden
from tests.blind import records
from tests.blind.by_command import workflow
from tests.blind.figure import Figure, Range

# Seeds from here on, which no published score has; of each kind the first whose base is like this one.
BASE, LIKE = 40_000_000, ("linear", False)
CONSISTENT = ("none", "none")
OTHER = ("one:saturation:strong", "one:interference_fringes:strong", "two:strong", "outside:donut:strong")
# Longest times [s]: must, aim.
LIMITS = {"calibration": (900, 480), "consistent": (60, 20), "any other": (180, 60)}
WORDS = {
    "calibration": "calibration of a new design, once",
    "consistent": "a `consistent` verdict, the whole command",
    "any other": "any other verdict, the slowest",
}


def main() -> None:
    """Measure, write, print."""
    with tempfile.TemporaryDirectory(prefix="spotcheck-times-") as base:
        seeds = count(BASE)
        taken = [(kind, *one(Path(base), kind, seeds)) for kind in (*CONSISTENT, *OTHER)]
    for line in taken:
        print(*line)
    first, *quiet = [seconds for kind, _, seconds in taken if kind == "none"]
    out = {
        "calibration": [first - min(quiet)],
        "consistent": quiet,
        "any other": [seconds for kind, _, seconds in taken if kind != "none"],
    }
    path = records.RESULTS / records.commit() / "times.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(out) + "\n", encoding="utf-8")


def one(base: Path, kind: str, seeds: Iterator[int]) -> tuple[str, float]:
    """Status of one dataset's verdict, and the seconds that the workflow's target took."""
    for seed in seeds:
        case = hidden.draw_case(seed, kind, "default")
        if (case.truth["base"]["photon_budget"], case.truth["base"]["top_hat"]) == LIKE:
            break
    folder = base / f"set{seed}"
    hidden.write(case, folder, base / f"truth{seed}.json")
    start = time.monotonic()
    workflow(folder, base / "results", 2)
    seconds = time.monotonic() - start
    verdict = json.loads((base / "results" / folder.name / "verdict.json").read_text(encoding="utf-8"))
    return verdict["status"], seconds


def figures(folder: Path) -> list[Figure]:
    """Lines of the table, of what was measured for records in a folder."""
    path = folder / "times.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    out = []
    for name, (must, aim) in LIMITS.items():
        own = found.get(name, [])
        worst = max(own, default=float("nan"))
        ranges = (Range(0, limit, f"≤ {limit} s") for limit in (must, aim))
        out.append(Figure(f"time: {WORDS[name]}", worst, (min(own, default=0.0), worst), len(own), "s", *ranges))
    return out


if __name__ == "__main__":
    main()
