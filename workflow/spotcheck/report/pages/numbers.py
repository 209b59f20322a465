"""The page of the paper's numbers."""

from pathlib import Path
from typing import Any

from spotcheck.paper.number_checks import NumberCheck, count_met
from spotcheck.report.pages import write_page


def content(checks: list[NumberCheck]) -> dict[str, Any]:
    """What the template of the numbers' table asks for."""
    groups: dict[str, list[NumberCheck]] = {}
    for check in checks:
        groups.setdefault(check.entry["kind"], []).append(check)
    return {"groups": groups, "shares": count_met(checks), "bounds": _bounds}


def _bounds(check: NumberCheck) -> str:
    if check.low == -float("inf"):
        return f"≤ {check.high:.5g}"
    if check.high == float("inf"):
        return f"≥ {check.low:.5g}"
    return f"{check.low:.5g} … {check.high:.5g}"


def write(path: Path, checks: list[NumberCheck]) -> None:
    """Write the page."""
    write_page(path, "numbers.html", title="The paper's numbers", **content(checks))
