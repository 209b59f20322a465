"""The page that compares the paper's numbers with ours."""

from pathlib import Path

from spotcheck.paper.number_checks import NumberCheck, count_met
from spotcheck.report.pages import write_page


def write_numbers_page(path: Path, checks: list[NumberCheck]) -> None:
    """Write the page of the paper's numbers, grouped by their kind."""
    groups: dict[str, list[NumberCheck]] = {}
    for check in checks:
        groups.setdefault(check.entry["kind"], []).append(check)
    content = {"groups": groups, "shares": count_met(checks), "format_interval": _format_interval}
    write_page(path, "numbers.html", title="The paper's numbers", **content)


def _format_interval(check: NumberCheck) -> str:
    """Return the interval in which a number holds."""
    if check.low == -float("inf"):
        return f"≤ {check.high:.5g}"
    if check.high == float("inf"):
        return f"≥ {check.low:.5g}"
    return f"{check.low:.5g} … {check.high:.5g}"
