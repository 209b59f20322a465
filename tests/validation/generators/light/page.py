"""The page of the score table: rows, errors of parameters, and every set that is not right."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from tests.validation.generators.light.plan import COUNTS
from tests.validation.generators.light.reading import (
    effect_names,
    false_names,
    is_right,
    named_alone,
    names_nothing_false,
    names_put_in,
    pulls,
    reached,
)
from tests.validation.generators.light.score import COVER, tabulate
from tests.validation.protocol import Record
from tests.validation.table import markdown

WORDS = {True: "met", False: "**short**", None: "—"}


def as_markdown(records: Sequence[Record], commit: str) -> str:
    """The whole page."""
    scored = [record for record in records if record["outcome"] != "passed over"]
    rows = [(row.name, row.shown, str(row.sets), row.required, WORDS[row.met]) for row in tabulate(scored)]
    lines = [said for record in scored if (said := describe(record))]
    return "\n".join([
        "# How often the verdict is right", "",
        f"{len(scored)} data sets with hidden effects were judged at commit `{commit}` by `make validate`, on seeds "
        f"that follow from the commit's hash, once{so_far(records)}. Generator and library share no code.", "",
        "*Right*: every effect is named as its only candidate, nothing else is named, and the verdict converged within "
        "200 CPU seconds. On real beams names of static shapes do not count as false, nor do names that the same beam "
        "gets without what was put in, and an effect that the beam's shape hides by design is right where a shape is "
        "named. The *bound* of an effect is the strength of "
        "signal-to-noise 1 beside all that is fitted. A row is met unless its 95 % interval excludes what is required.",
        "", *markdown(("row", "measured (95 %)", "sets", "required", "result"), rows), "",
        "## Errors of parameters, in standard errors", "",
        *markdown(("parameter", "values", "median", "rms", "within 1.96"), tabulate_pulls(scored)), "",
        "## Sets that are not right", "", *[f"- {said}" for said in lines], "",
    ])  # fmt: skip


def so_far(records: Sequence[Record]) -> str:
    """What to say of a table of which sets are still to be judged; "" for a complete one."""
    total = sum(COUNTS.values())
    missing = total - len(records)
    return (
        f"; {missing} of the {total} sets are still to be judged, in an order that mixes all rows"
        if missing > 0
        else ""
    )


def tabulate_pulls(records: Sequence[Record]) -> list[tuple[str, ...]]:
    """Errors of each parameter over all sets."""
    found: dict[str, list[float]] = defaultdict(list)
    for record in records:
        for name, pull in pulls(record).items():
            found[name].append(pull)
    return [
        (f"`{name}`", str(len(own)), f"{np.median(own):.2f}", f"{np.sqrt(np.mean(np.square(own))):.2f}",
         f"{np.mean(np.abs(own) <= COVER):.2f}")
        for name, own in sorted(found.items())
    ]  # fmt: skip


def describe(record: Record) -> str:
    """A set that is not right, in a line; "" for others."""
    job = record["job"]
    row, *_ = job["kind"].split(":")
    where = f"{job['seed']} {job['kind']} {job['design']}"
    if record["outcome"] == "error":
        return f"{where}: {record.get('error', 'no verdict')}"
    if row in ("nothing", "outside", "frames at 600 px"):
        fine = names_nothing_false(record)
    else:
        fine = is_right(record) or not reached(record) or not names_put_in(record)
    if fine:
        return ""
    parts = [f"{record['verdict']['status']}: {' + '.join(effect_names(record)) or 'no name'}"]
    for word, names in (("missed", names_put_in(record) - named_alone(record)), ("false", false_names(record))):
        if names and not (word == "missed" and row in ("nothing", "outside")):
            parts.append(f"{word} {' + '.join(sorted(names))}")
    return f"{where}: {', '.join(parts)}, {record['cpu_seconds']:.0f} s"
