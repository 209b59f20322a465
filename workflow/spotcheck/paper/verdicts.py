"""Compare each of the paper's numbers with ours, and count."""

import csv
import io
from pathlib import Path
from typing import NamedTuple

from spotcheck.io.schema import read_yaml
from spotcheck.paper import derived, measured, simulated
from spotcheck.paper.results import Results

COLUMNS = (
    "id",
    "kind",
    "section",
    "printed",
    "low",
    "high",
    "ours",
    "unit",
    "holds",
    "expected",
    "counted",
    "because",
    "remark",
)


class Verdict(NamedTuple):
    """One number: the paper's entry, ours, the interval in which it holds, and whether it does."""

    entry: dict
    ours: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether ours lies in the interval."""
        return self.low <= self.ours <= self.high

    @property
    def counted(self) -> bool:
        """Whether it is part of the share that must hold."""
        return self.entry["kind"] != "inconsistent" and self.entry.get("counted", True)

    @property
    def expected(self) -> bool:
        """Whether it held when the file of numbers was last reviewed."""
        return self.entry.get("holds", True)


def interval(entry: dict) -> tuple[float, float]:
    """Lowest and highest value that holds."""
    if "value" in entry:
        return entry["value"] - entry["tolerance"], entry["value"] + entry["tolerance"]
    return entry.get("at_least", -float("inf")), entry.get("at_most", float("inf"))


def read_numbers(path: Path) -> list[dict]:
    """The entries of paper_numbers.yaml."""
    return read_yaml(path)


def judge(entries: list[dict], results: Results) -> list[Verdict]:
    """A verdict for every entry; its `id` names the function that computes ours."""
    functions = {
        name: f for module in (derived, simulated, measured) for name, f in vars(module).items() if callable(f)
    }
    return [Verdict(entry, float(functions[entry["id"]](results)), *interval(entry)) for entry in entries]


def shares(verdicts: list[Verdict]) -> dict[str, tuple[int, int]]:
    """Held and counted numbers of each kind."""
    kinds = ("derived", "simulated", "measured")
    counted = {kind: [v for v in verdicts if v.entry["kind"] == kind and v.counted] for kind in kinds}
    return {kind: (sum(v.holds for v in own), len(own)) for kind, own in counted.items()}


def summary(verdicts: list[Verdict]) -> str:
    """How many numbers hold, in a sentence, and which do not, as Markdown."""
    sides = {"derived": "that follow from its inputs", "simulated": "of its simulation", "measured": "of its frames"}
    parts = [f"{held} of {counted} {sides[kind]}" for kind, (held, counted) in shares(verdicts).items()]
    failed = [v for v in verdicts if v.counted and not v.holds]
    texts = [f"{v.entry['id'].replace('_', ' ')} (printed: {v.entry['printed']}; ours: {v.ours:.3g})" for v in failed]
    rest = [v.entry["id"].replace("_", " ") for v in verdicts if not v.counted and not v.holds]
    return "\n\n".join(
        [
            f"Of the numbers that the paper prints, {', '.join(parts[:-1])} and {parts[-1]} hold.",
            f"What does not hold: {'; '.join(texts) or 'nothing'}. Shown but not counted, and not holding either:"
            f" {', '.join(rest) or 'nothing'}.",
            "A printed range counts as two numbers, each met within half the range's width; other numbers count as met"
            " within the printed ±.\n",
        ]
    )


def lost(verdicts: list[Verdict]) -> list[Verdict]:
    """Numbers that held when the file was reviewed and no longer do."""
    return [v for v in verdicts if v.expected and not v.holds]


def table(verdicts: list[Verdict]) -> str:
    """All verdicts as CSV."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for verdict in verdicts:
        entry = verdict.entry
        row = {name: entry.get(name, "") for name in ("id", "kind", "section", "printed", "unit", "because", "remark")}
        row |= {"low": f"{verdict.low:.7g}", "high": f"{verdict.high:.7g}", "ours": f"{verdict.ours:.6g}"}
        row |= {"holds": verdict.holds, "expected": verdict.expected, "counted": verdict.counted}
        writer.writerow(row)
    return stream.getvalue()
