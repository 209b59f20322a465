"""Check each published number and statement of the paper against our value, which is computed from the results.

An entry is one number or statement in published.yaml: a dict with `id`, `printed`, `section`, `unit`, an accepted
interval, and `because`, the reason for this interval. Its `role` says where the number comes from: "derived" from the
inputs, "simulated", "measured", or a "statement" without a number. `tuned` says that the settings of the virtual rig,
the simulator that made the default dataset, were searched to meet it.
"""

import csv
import io
from pathlib import Path
from typing import NamedTuple

from spotcheck.paper import bright_pixel, derived, measured, simulated, statements
from spotcheck.paper.results import Results

# Columns of paper_numbers.csv; `ours` is our value. The column `holds` says whether the entry is met now, the column
# `expected` whether it was met at the last review. The latter is the key `holds` of an entry.
COLUMNS = tuple("id role group section printed low high ours unit holds expected because remark".split())
# Groups of entries that are counted separately → words of the summary.
GROUPS = {
    "derived": "that follow from its inputs",
    "tuned": "that the settings of the virtual rig were searched to meet",
    "held_out": "held out of that search",
}
# Modules whose functions, named by the `id` of an entry, compute our values.
MODULES = (derived, simulated, measured, statements, bright_pixel)


class NumberCheck(NamedTuple):
    """Comparison of one entry with our value."""

    entry: dict  # entry of published.yaml
    value: float  # our value, in the unit of the entry
    low: float  # smallest accepted value
    high: float  # largest accepted value

    @property
    def is_met(self) -> bool:
        """Whether the value is in the accepted interval, ends included; False for NaN."""
        return self.low <= self.value <= self.high

    @property
    def group(self) -> str:
        """Group of the entry, a key of `GROUPS`."""
        if self.entry["role"] == "derived":
            return "derived"
        return "tuned" if self.entry.get("tuned", False) else "held_out"

    @property
    def is_expected(self) -> bool:
        """Whether the number was met when published.yaml was last reviewed."""
        return self.entry.get("holds", True)


def accepted_interval(entry: dict) -> tuple[float, float]:
    """Return the smallest and the largest accepted value of an entry, in its unit.

    They are `value` ± `tolerance` around the printed value, or else `at_least` and `at_most`, infinite if not given.
    """
    if "value" in entry:
        return entry["value"] - entry["tolerance"], entry["value"] + entry["tolerance"]
    return entry.get("at_least", -float("inf")), entry.get("at_most", float("inf"))


def check_numbers(entries: list[dict], results: Results) -> list[NumberCheck]:
    """Return the check of each entry; its `id` names the function of `MODULES` that computes our value."""
    functions = {name: value for module in MODULES for name, value in vars(module).items()}
    return [NumberCheck(entry, float(functions[entry["id"]](results)), *accepted_interval(entry)) for entry in entries]


def read_other_seeds(path: Path) -> list[dict[str, int]]:
    """Return for each seed of the virtual rig in published_seeds.csv: group → number of entries that are met."""
    with path.open(encoding="utf-8", newline="") as stream:
        return [{group: int(row[group]) for group in GROUPS} for row in csv.DictReader(stream)]


def count_met(checks: list[NumberCheck]) -> dict[str, tuple[int, int]]:
    """Return group → (number of entries that are met, number of entries), for all of `GROUPS`."""
    groups = {group: [check for check in checks if check.group == group] for group in GROUPS}
    return {group: (sum(check.is_met for check in members), len(members)) for group, members in groups.items()}


def summarise_checks(checks: list[NumberCheck], other_seeds: list[dict[str, int]]) -> str:
    """Return Markdown paragraphs: the counts of `count_met`, those of other seeds, and the entries that are not met.

    Parameters
    ----------
    checks : checks of all entries.
    other_seeds : for each other seed of the rig, group → number of entries that are met; may be empty.
    """
    counts = count_met(checks)
    phrases = [f"{met} of {total} {GROUPS[group]}" for group, (met, total) in counts.items()]
    text = f"Of the numbers and statements that the paper prints, {', '.join(phrases[:-1])} and {phrases[-1]} hold."
    if other_seeds:
        ranges = [_mean_and_range([seed[group] for seed in other_seeds]) for group in ("tuned", "held_out")]
        text += (
            f" With {len(other_seeds)} other seeds of the rig, which nothing was searched for, {ranges[0]} of the"
            f" {counts['tuned'][1]} tuned and {ranges[1]} of the {counts['held_out'][1]} held-out ones hold."
        )
    failures = [
        f"- {_format_id(check)} ({check.entry['section']}): printed {check.entry['printed']}; ours {check.value:.3g}"
        + (", tuned" if check.group == "tuned" else "")
        for check in checks
        if not check.is_met
    ]
    return f"{text}\n\nNot met:\n\n" + ("\n".join(failures) or "Nothing.") + "\n"


def _mean_and_range(counts: list[int]) -> str:
    """Return the mean of counts and their range, such as `24.3 (21 to 27)`."""
    return f"{sum(counts) / len(counts):.1f} ({min(counts)} to {max(counts)})"


def _format_id(check: NumberCheck) -> str:
    """Return the id of an entry in words, without underscores."""
    return check.entry["id"].replace("_", " ")


def find_regressions(checks: list[NumberCheck]) -> list[NumberCheck]:
    """Return the checks of entries that were met at the last review and no longer are."""
    return [check for check in checks if check.is_expected and not check.is_met]


def format_csv(checks: list[NumberCheck]) -> str:
    """Return all checks as CSV with the columns `COLUMNS`, one row per entry; missing keys of an entry are empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for check in checks:
        numbers = {"low": f"{check.low:.7g}", "high": f"{check.high:.7g}", "ours": f"{check.value:.6g}"}
        flags = {"holds": check.is_met, "expected": check.is_expected, "group": check.group}
        # The flag `holds` replaces the key of the entry.
        writer.writerow(check.entry | numbers | flags)
    return stream.getvalue()
