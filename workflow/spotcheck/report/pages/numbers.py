"""The page that compares the numbers and statements of the paper with those of the results."""

from pathlib import Path

from spotcheck.paper.number_checks import GROUPS, NumberCheck, count_met
from spotcheck.report.pages import write_page


def write_numbers_page(path: Path, checks: list[NumberCheck]) -> None:
    """Write the page of the paper's numbers and statements, with a part of the table for each of `GROUPS`."""
    groups: dict[str, list[NumberCheck]] = {group: [] for group in GROUPS}
    for check in checks:
        groups[check.group].append(check)
    content = {"groups": groups, "names": GROUPS, "counts": count_met(checks), "format_interval": _format_interval}
    write_page(path, "numbers.html", title="The paper's numbers and statements", **content)


def _format_interval(check: NumberCheck) -> str:
    """Return the interval of accepted values as text, in the unit of the entry; one number if both ends are equal."""
    if check.low == check.high:
        return f"{check.low:.5g}"
    if check.low == -float("inf"):
        return f"≤ {check.high:.5g}"
    if check.high == float("inf"):
        return f"≥ {check.low:.5g}"
    return f"{check.low:.5g} … {check.high:.5g}"
