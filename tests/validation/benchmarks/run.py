"""Run the benchmarks, all or those named, print their tables, and judge them.

`make bench`, or `python -m tests.validation.benchmarks.run [part …]`. Tables and a plot go to `results/benchmarks`.
Status 1 when a must was missed. Times are of this machine and moment; ratios are what compares.
"""

import platform
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from tests.validation.benchmarks import (
    accuracy,
    closed_form,
    convergence,
    estimator,
    gain,
    growth,
    plot,
    simulator,
    table,
)  # fmt: skip

RESULTS = Path(__file__).parents[3] / "results" / "benchmarks"
PARTS: dict[str, Callable[[], table.Part]] = {
    "estimator": estimator.measure,
    "simulator": simulator.measure,
    "accuracy": accuracy.measure,
    "convergence": convergence.measure,
    "closed-form": closed_form.measure,
    "gain": gain.measure,
    "growth": growth.measure,
}


def run(name: str) -> table.Part:
    """One part; one that breaks counts as a missed must, and the others are not lost."""
    try:
        return PARTS[name]()
    except Exception:
        traceback.print_exc()
        return table.Part(name, [table.Figure("ran to its end", 0, "no", table.Limit("≥", 1))])


def main() -> None:
    """Measure, write, print, judge."""
    names = sys.argv[1:] or list(PARTS)
    if unknown := set(names) - set(PARTS):
        sys.exit(f"{', '.join(sorted(unknown))}: none of {', '.join(PARTS)}")
    start = time.monotonic()
    parts = [run(name) for name in names]
    head = [
        f"Python {platform.python_version()}, {estimator.versions()}; times are of one core, {platform.machine()}; "
        f"{time.monotonic() - start:.0f} s for the parts {', '.join(names)}."
    ]
    RESULTS.mkdir(parents=True, exist_ok=True)
    plot.draw([point for part in parts for point in part.points], RESULTS)
    text = table.as_markdown(parts, head)
    (RESULTS / "peers.md").write_text(text, encoding="utf-8")
    # What workflow/docs/benchmarks.md quotes.
    (RESULTS / "summary.md").write_text(table.as_summary(parts), encoding="utf-8")
    print(text)
    sys.exit(not table.all_musts_reached(parts))


if __name__ == "__main__":
    main()
