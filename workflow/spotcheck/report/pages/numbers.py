"""The page of the paper's numbers."""

from pathlib import Path
from typing import Any

from spotcheck.paper.verdicts import Verdict, shares
from spotcheck.report.pages import write_page


def content(verdicts: list[Verdict]) -> dict[str, Any]:
    """What the template of the numbers' table asks for."""
    groups: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        groups.setdefault(verdict.entry["kind"], []).append(verdict)
    return {"groups": groups, "shares": shares(verdicts), "bounds": _bounds}


def _bounds(verdict: Verdict) -> str:
    if verdict.low == -float("inf"):
        return f"≤ {verdict.high:.5g}"
    if verdict.high == float("inf"):
        return f"≥ {verdict.low:.5g}"
    return f"{verdict.low:.5g} … {verdict.high:.5g}"


def write(path: Path, verdicts: list[Verdict]) -> None:
    """Write the page."""
    write_page(path, "numbers.html", title="The paper's numbers", **content(verdicts))
