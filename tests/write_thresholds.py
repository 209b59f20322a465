"""Write the table of thresholds into workflow/docs/verdict.md: `python -m tests.write_thresholds`.

The values are those of `spotcheck.discrepancy.criteria`; units and reasons are its comments.
tests/report/test_verdict_page.py makes the table again.
"""

import re
from pathlib import Path
from typing import NamedTuple

from spotcheck.discrepancy import criteria
from tests.draw_architecture import replace_between

PAGE = Path(__file__).parents[1] / "workflow" / "docs" / "verdict.md"
# Comments around the table in the page.
START, END = "<!-- thresholds: written by tests/write_thresholds.py -->\n\n", "\n<!-- end of the thresholds -->\n"
# A comment of one or more lines that starts with a unit in brackets, and the constant below it.
COMMENTED = re.compile(r"^# \[(?P<unit>.+?)\] (?P<text>.+(?:\n# .+)*)\n(?P<name>[A-Z_]+) = ", re.MULTILINE)


class Threshold(NamedTuple):
    """One constant of `criteria`."""

    name: str
    value: float | tuple[float, ...]
    unit: str
    reason: str  # what it decides, and why it has this value


def list_thresholds() -> list[Threshold]:
    """Return the thresholds in the order of the file."""
    text = Path(criteria.__file__).read_text(encoding="utf-8")
    return [
        Threshold(name, getattr(criteria, name), unit, comment.replace("\n# ", " "))
        for unit, comment, name in COMMENTED.findall(text)
    ]


def threshold_table() -> str:
    """Return the table in Markdown."""
    rows = []
    for name, value, unit, reason in list_thresholds():
        values = ", ".join(f"{number:g}" for number in (value if isinstance(value, tuple) else (value,)))
        rows.append(f"| `{name}` | {values} | {unit} | {reason} |\n")
    return "| threshold | value | unit | what it decides, and why |\n|---|---|---|---|\n" + "".join(rows)


def with_threshold_table(page: str) -> str:
    """Return the page with its table of thresholds written anew."""
    return replace_between(page, START, END, threshold_table())


if __name__ == "__main__":
    PAGE.write_text(with_threshold_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
