"""Times of the whole command on datasets of the default design, 96 frames, two cores.

`python -m tests.validation.times`: nothing else should run beside it.
"""

import json
import tempfile
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from rig import hidden
from tests.validation import records
from tests.validation.figure import Figure, Range
from tests.validation.judge import by_workflow

# Seeds from here on, which no published score has; of each kind the first whose base is like this one.
BASE, LIKE = 40_000_000, ("linear", False)
KINDS = ("none", "one:saturation:strong", "one:interference_fringes:strong", "two:strong", "outside:donut:strong")
# Longest times [s]: must, aim.
LIMITS = {"consistent": (60, 30), "any other": (60, 30)}
WORDS = {
    "consistent": "a `consistent` verdict, the whole command",
    "any other": "any other verdict, the slowest",
}


def main() -> None:
    """Measure, write, print."""
    with tempfile.TemporaryDirectory(prefix="spotcheck-times-") as base:
        seeds = count(BASE)
        taken = [(kind, *one(Path(base), kind, seeds)) for kind in KINDS]
    for line in taken:
        print(*line)
    out = {
        "consistent": [seconds for kind, _, seconds in taken if kind == "none"],
        "any other": [seconds for kind, _, seconds in taken if kind != "none"],
    }
    path = records.RESULTS / "rig" / records.commit("rig") / "times.json"
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
    verdict = by_workflow(folder, base / "results", 2)
    return verdict["status"], time.monotonic() - start


def read(folder: Path) -> dict[str, list[float]]:
    """What was measured for records in a folder [s]; nothing if nothing was."""
    path = folder / "times.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def figures(taken: dict[str, list[float]]) -> list[Figure]:
    """Lines of the table."""
    out = []
    for name, (must, aim) in LIMITS.items():
        own = taken.get(name, [])
        worst = max(own, default=float("nan"))
        ranges = (Range(0, limit, f"≤ {limit} s") for limit in (must, aim))
        out.append(Figure(f"time: {WORDS[name]}", worst, (min(own, default=0.0), worst), len(own), "s", *ranges))
    return out


if __name__ == "__main__":
    main()
