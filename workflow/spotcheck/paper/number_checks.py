"""Check each number that the paper prints against our value, which is computed from the results.

An entry is one number in paper_numbers.yaml: a dict with `id`, `printed`, `kind`, `unit`, an accepted interval, and
`because`, the reason for this interval.
"""

import csv
import io
from typing import NamedTuple

from spotcheck.paper import derived, measured, simulated
from spotcheck.paper.results import Results

# Columns of paper_numbers.csv. `holds` says whether the number is met now. In an entry `holds` says whether it was met
# at the last review, which is the column `expected`.
COLUMNS = tuple("id kind section printed low high ours unit holds expected counted because remark".split())
# Kinds of numbers that are counted → words of the summary.
KINDS = {"derived": "that follow from its inputs", "simulated": "of its simulation", "measured": "of its frames"}


class NumberCheck(NamedTuple):
    """Comparison of one number of the paper with our value."""

    entry: dict  # entry of paper_numbers.yaml
    value: float  # our value, in the unit of the entry
    low: float  # smallest accepted value
    high: float  # largest accepted value

    @property
    def is_met(self) -> bool:
        """Whether the value is in the accepted interval, ends included; False for NaN."""
        return self.low <= self.value <= self.high

    @property
    def is_counted(self) -> bool:
        """Whether the number counts in the share of met numbers; others are only shown."""
        return self.entry["kind"] in KINDS and self.entry.get("counted", True)

    @property
    def is_expected(self) -> bool:
        """Whether the number was met when paper_numbers.yaml was last reviewed."""
        return self.entry.get("holds", True)


def accepted_interval(entry: dict) -> tuple[float, float]:
    """Return the smallest and the largest accepted value of an entry, in its unit; infinite where it sets no limit."""
    if "value" in entry:
        return entry["value"] - entry["tolerance"], entry["value"] + entry["tolerance"]
    return entry.get("at_least", -float("inf")), entry.get("at_most", float("inf"))


def check_numbers(entries: list[dict], results: Results) -> list[NumberCheck]:
    """Return the check of each entry; its `id` names the function of this package that computes our value."""
    functions = vars(derived) | vars(simulated) | vars(measured)
    return [NumberCheck(entry, float(functions[entry["id"]](results)), *accepted_interval(entry)) for entry in entries]


def count_met(checks: list[NumberCheck]) -> dict[str, tuple[int, int]]:
    """Return for each kind in `KINDS` how many of the counted numbers are met, and how many are counted."""
    groups = {kind: [check for check in checks if check.is_counted and check.entry["kind"] == kind] for kind in KINDS}
    return {kind: (sum(check.is_met for check in group), len(group)) for kind, group in groups.items()}


def summarise_checks(checks: list[NumberCheck]) -> str:
    """Return Markdown paragraphs: the counts of `count_met`, the numbers that are not met, and the rule."""
    counts = [f"{met} of {counted} {KINDS[kind]}" for kind, (met, counted) in count_met(checks).items()]
    failures = [
        f"{_format_id(check)} (printed: {check.entry['printed']}; ours: {check.value:.3g})"
        for check in checks
        if check.is_counted and not check.is_met
    ]
    uncounted_failures = [_format_id(check) for check in checks if not check.is_counted and not check.is_met]
    return (
        f"Of the numbers that the paper prints, {', '.join(counts[:-1])} and {counts[-1]} hold.\n\n"
        f"What does not hold: {'; '.join(failures) or 'nothing'}. Shown but not counted, and not holding either:"
        f" {', '.join(uncounted_failures) or 'nothing'}.\n\n"
        "A printed range counts as two numbers, each met within half the range's width; other numbers count as met"
        " within the printed ±.\n"
    )


def _format_id(check: NumberCheck) -> str:
    """Return the id of a number in words, without underscores."""
    return check.entry["id"].replace("_", " ")


def find_regressions(checks: list[NumberCheck]) -> list[NumberCheck]:
    """Return the numbers that were met at the last review and no longer are."""
    return [check for check in checks if check.is_expected and not check.is_met]


def format_csv(checks: list[NumberCheck]) -> str:
    """Return all checks as CSV with the columns `COLUMNS`, one row per number; missing keys of an entry are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for check in checks:
        numbers = {"low": f"{check.low:.7g}", "high": f"{check.high:.7g}", "ours": f"{check.value:.6g}"}
        flags = {"holds": check.is_met, "expected": check.is_expected, "counted": check.is_counted}
        writer.writerow(check.entry | numbers | flags)
    return stream.getvalue()
