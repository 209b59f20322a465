"""The score table: from records to shares with their Wilson intervals, each held against what is required.

A row is met unless its 95 % interval excludes the required value. All that is read of one verdict is read in `reading`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tests.validation.generators.light.plan import FRAMES
from tests.validation.generators.light.reading import (
    LIMIT_SECONDS,
    effect_names,
    is_right,
    is_traceback,
    law_gap_closed,
    names_nothing_false,
    names_put_in,
    pulls,
    reached,
    reports_unconverged,
)
from tests.validation.intervals import bootstrap, wilson
from tests.validation.protocol import Record

# Half the width of a 95 % interval in standard errors.
COVER = 1.96
SPOTS = 96


@dataclass(frozen=True)
class Row:
    """One row of the table.

    name: what was measured.
    shown: the measured value with its interval, as text.
    sets: number of sets or values behind it.
    required: what is required, as text.
    met: whether it is met; None where nothing was measured or is required.
    """

    name: str
    shown: str
    sets: int
    required: str
    met: bool | None


def tabulate(records: Sequence[Record]) -> list[Row]:
    """All rows of the table."""
    scored = [record for record in records if record["outcome"] != "passed over"]
    of = {row: [record for record in scored if record["job"]["kind"].split(":")[0] == row]
          for row in {record["job"]["kind"].split(":")[0] for record in scored}}  # fmt: skip

    def right(row: str, words: str, required: float) -> Row:
        return share_row(words, [is_right(record) for record in of.get(row, []) if reached(record)], required)

    def wrong(row: str, words: str, allowed: float) -> Row:
        found = [not names_nothing_false(record) for record in of.get(row, [])]
        return share_row(words, found, allowed, at_most=True)

    frames = of.get("frame", [])
    return [
        right("strong gauss", "Gaussian light, one effect at 50 times its bound", 0.97),
        right("weak gauss", "Gaussian light, one effect at 10 times its bound", 0.90),
        right("strong real", "real beams, one effect at 50 times its bound", 0.95),
        right("weak real", "real beams, one effect at 10 times its bound", 0.90),
        right("one exposure", "one exposure", 0.90),
        right("single frame", "single frame", 0.80),
        right("two", "two effects", 0.85),
        wrong("nothing", "nothing put in: a name other than the shape's", 0.02),
        wrong("outside", "outside the vocabulary: a wrong name", 0.08),
        right("default dataset", "the default dataset", 1.0),
        right("shape", "static shape on Gaussian light", 0.95),
        *(frame_row(frames, what, least) for what, least in (("clip", 8), ("stripes", 8), ("rise", 8), ("bend", 4))),
        *wide_rows(of.get("frames at 600 px", [])),
        coverage_row(scored),
        gap_row(scored),
        count_row("verdicts with values that did not converge", map(reports_unconverged, scored)),
        count_row("tracebacks", map(is_traceback, scored)),
        *cost_rows([record for record in scored if frames_of(record) == SPOTS]),
    ]


def measured_row(name: str, sets: int, required: str, shown: str, met: bool) -> Row:
    """A row that states nothing where there is no set."""
    return Row(name, shown, sets, required, met) if sets else Row(name, "—", 0, required, None)


def say_share(hits: Sequence[bool]) -> str:
    """A share in words, with its interval."""
    low, high = wilson(sum(hits), len(hits))
    share = 100 * sum(hits) / max(len(hits), 1)
    return f"{sum(hits)} of {len(hits)}: {share:.1f} % ({100 * low:.1f}–{100 * high:.1f})"


def share_row(name: str, found: Iterable[bool], required: float, at_most: bool = False) -> Row:
    """A share that must be at least, or at most, so large."""
    hits = list(found)
    low, high = wilson(sum(hits), len(hits))
    met = low <= required if at_most else high >= required
    return measured_row(name, len(hits), f"{'≤' if at_most else '≥'} {100 * required:g} %", say_share(hits), met)


def frame_row(frames: Sequence[Record], what: str, least: int) -> Row:
    """Of the nine real frames with `what` put in, how many are right. Names that a frame has as it is are not false."""
    made = [record for record in frames if record["truth"]]
    plain = {record["truth"]["frame"]: effect_names(record) for record in made if not names_put_in(record)}
    put = [record for record in frames if record["job"]["kind"].split(":")[1].startswith(what)]
    known = [record | {"unaltered": plain.get(record["truth"]["frame"], [])} for record in put if record["truth"]]
    right = sum(map(is_right, known))
    words, met = f"real frames, {what} put in", right >= least if len(put) == FRAMES else None
    return Row(words, f"{right} of {len(put)}", len(put), f"{least} of {FRAMES}", met)


def wide_rows(records: Sequence[Record]) -> list[Row]:
    """Time and memory of the nine frames at a crop of 600 px."""
    out = []
    for record in records:
        seconds, memory = record["cpu_seconds"], record["memory_mb"]
        out.append(limit_row("nine HeNe frames at 600 px: CPU seconds", seconds, 1, 60.0))
        out.append(limit_row("nine HeNe frames at 600 px: memory [MB]", memory, 1, 1000.0))
    return out


def limit_row(name: str, value: float | None, sets: int, limit: float) -> Row:
    """A number that must be at most so large."""
    number = np.nan if value is None else value
    return measured_row(name, 0 if np.isnan(number) else sets, f"≤ {limit:g}", f"{number:.0f}", number <= limit)


def coverage_row(records: Sequence[Record]) -> Row:
    """How many 95 % intervals hold the truth."""
    inside = [abs(pull) <= COVER for record in records for pull in pulls(record).values()]
    low, high = wilson(sum(inside), len(inside))
    met = high >= 0.92 and low <= 0.98
    return measured_row("95 % intervals that hold the truth", len(inside), "92–98 %", say_share(inside), met)


def gap_row(records: Sequence[Record]) -> Row:
    """The median part of the gap that sets with a law close on held-out frames."""
    closed = [part for record in records if (part := law_gap_closed(record)) is not None]
    low, high = bootstrap(closed, np.median)
    shown = f"{np.median(closed or [np.nan]):.3f} ({low:.3f}–{high:.3f})"
    name = "sets with a law: gap closed on held-out frames, median"
    return measured_row(name, len(closed), "≥ 0.95", shown, high >= 0.95)


def count_row(name: str, found: Iterable[bool]) -> Row:
    """A count that must be zero."""
    hits = list(found)
    return measured_row(name, len(hits), "0", str(sum(hits)), not sum(hits))


def cost_rows(records: Sequence[Record]) -> list[Row]:
    """Seconds and memory of verdicts of 96 frames; a verdict that ran out of time took the limit."""
    rows = []
    for words, part, key, default, limit in (
        ("CPU seconds, median", 0.5, "cpu_seconds", LIMIT_SECONDS, 25.0),
        ("CPU seconds, 90th percentile", 0.9, "cpu_seconds", LIMIT_SECONDS, 50.0),
        ("memory, 90th percentile [MB]", 0.9, "memory_mb", np.nan, 700.0),
    ):
        values = np.array([record.get(key) or default for record in records], float)
        value = float(np.nanquantile(values, part)) if records else None
        rows.append(limit_row(f"verdict of 96 frames: {words}", value, len(records), limit))
    return rows


def frames_of(record: Record) -> int:
    """Number of frames of a simulated set, 0 of others."""
    return int(record["truth"].get("base", {}).get("frames", 0)) if record["truth"] else 0
