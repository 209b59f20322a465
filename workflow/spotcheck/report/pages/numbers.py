"""The page that compares the numbers and statements of the paper with those of the results.

A check compares one number or statement of the paper, an entry of published.yaml, with our value and an interval of
accepted values. Checks form groups: numbers that follow from the paper's inputs, numbers that the settings of the
virtual rig were searched to meet, and numbers held out of that search.
"""

from pathlib import Path

from spotcheck.paper.number_checks import GROUPS, NumberCheck, count_met
from spotcheck.report.pages import write_page


def write_numbers_page(path: Path, checks: list[NumberCheck]) -> None:
    """Write the page with a table of all checks, which has a part for each group.

    Parameters
    ----------
    path : Path
        Page to write.
    checks : list of NumberCheck
        Checks of all entries of published.yaml.
    """
    groups: dict[str, list[NumberCheck]] = {group: [] for group in GROUPS}
    for check in checks:
        groups[check.group].append(check)
    # `counts` has the number of checks that are met, and of all, by group.
    content = {"groups": groups, "names": GROUPS, "counts": count_met(checks), "format_interval": _format_interval}
    write_page(path, "numbers.html", title="The paper's numbers and statements", **content)


def _format_interval(check: NumberCheck) -> str:
    """Return the interval of accepted values, in the unit of the entry, as text: `1.2 … 1.4`, `≤ 3`, `≥ 0.5`, `7`."""
    if check.low == check.high:
        return f"{check.low:.5g}"
    if check.low == -float("inf"):
        return f"≤ {check.high:.5g}"
    if check.high == float("inf"):
        return f"≥ {check.low:.5g}"
    return f"{check.low:.5g} … {check.high:.5g}"
