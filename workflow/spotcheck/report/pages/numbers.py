"""The page that compares the paper's numbers with ours."""

from pathlib import Path

from spotcheck.paper.verdicts import Verdict, shares
from spotcheck.report.pages import write_page


def write_numbers_page(path: Path, verdicts: list[Verdict]) -> None:
    """Write the page of the paper's numbers, grouped by their kind."""
    groups: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        groups.setdefault(verdict.entry["kind"], []).append(verdict)
    content = {"groups": groups, "shares": shares(verdicts), "format_interval": _format_interval}
    write_page(path, "numbers.html", title="The paper's numbers", **content)


def _format_interval(verdict: Verdict) -> str:
    """Return the interval in which a number holds."""
    if verdict.low == -float("inf"):
        return f"≤ {verdict.high:.5g}"
    if verdict.high == float("inf"):
        return f"≥ {verdict.low:.5g}"
    return f"{verdict.low:.5g} … {verdict.high:.5g}"
