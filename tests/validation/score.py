"""From records to figures: each a number with its 95 % interval, what it must and should be, and whether it is."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from rig import hidden
from tests.validation import outcome
from tests.validation.figure import Figure, Range, at_least, at_most, share
from tests.validation.intervals import bootstrap, clopper_pearson, weakest
from tests.validation.outcome import of
from tests.validation.protocol import Record

# Least number of null sets, of designs they come from, of sets of the worst effect, and of outside mechanisms.
LEAST_NULLS, LEAST_DESIGNS, LEAST_WORST, LEAST_OUTSIDE = 2000, 4, 50, 8


def figures(records: Sequence[Record]) -> list[Figure]:
    """All figures of the table, in its order."""
    nulls, ones = of(records, "none"), of(records, "one")
    strong = [r for r in of(records, "one", "strong") if outcome.snr(r) >= 0.9 * outcome.STRONG or not r["truth"]]
    alone = [r for r in strong if not outcome.tied(r)]
    tied = list(filter(outcome.tied, strong))
    seen = [r for r in ones if outcome.detected(r)]
    outside = of(records, "outside", "strong")
    mechanisms = len({r["job"]["kind"] for r in outside})
    several = {number: of(records, number) for number in ("two", "three", "four")}
    return [
        *false_alarms(nulls),
        share(
            "strong, not tied in its design: named, that one name", alone, outcome.named_exactly, at_least(0.95, 0.99)
        ),
        share(
            "strong, tied in its design: ambiguous, truth in the set", tied, outcome.ambiguous_with_truth,
            at_least(0.95, 0.99),
        ),
        share("all detected: right name first", seen, outcome.right_first, at_least(0.97, 0.99)),
        share("all detected: truth among the candidates", seen, outcome.among_candidates, at_least(0.95, 0.97)),
        worst_effect(seen),
        mean_size([r for r in alone if outcome.candidates(r)]),
        share(
            "outside the vocabulary, strong: no wrong name", outside, outcome.no_wrong_name,
            at_least(0.90, 0.97), short_of="" if mechanisms >= LEAST_OUTSIDE else f"{mechanisms} mechanisms",
        ),
        share("two effects: both named, nothing else", several["two"], outcome.named_exactly, at_least(0.80, 0.90)),
        share("two effects: both named, or tied with what the data cannot tell from them", several["two"],
              outcome.holds_truth),
        *(share(f"{n} effects: all named, nothing else", several[n], outcome.named_exactly) for n in ("three", "four")),
        gap_closed([*strong, *several["two"]]),
        strength(strong),
        weakest_found(ones),
        share("a verdict at all: no exception", list(filter(outcome.scored, records)), outcome.judged),
    ]  # fmt: skip


def false_alarms(nulls: Sequence[Record]) -> list[Figure]:
    """The rate of alarms over null sets: overall, the worst design, the worst tenth of amplitude and of width.

    A part passes unless its interval (widened for the number of parts) keeps clear of what is allowed.
    """
    must, aim = Range(0.005, 0.015, "0.5–1.5 %"), Range(0.007, 0.013, "0.7–1.3 %")
    designs = {r["job"]["design"] for r in nulls}
    few = [f"{len(nulls)} of {LEAST_NULLS} null sets"] if len(nulls) < LEAST_NULLS else []
    few += [f"{len(designs)} of {LEAST_DESIGNS} designs"] if len(designs) < LEAST_DESIGNS else []
    overall = share("false alarms at α = 1 %", nulls, outcome.alarm, (must, aim), ", ".join(few))
    told = [r for r in nulls if r["truth"]]
    parts = {
        "worst design": by(nulls, lambda r: r["job"]["design"]),
        "worst photon budget and top hat": by(told, _baseline),
        "worst tenth of amplitude": tenths(told, outcome.brightness),
        "worst tenth of width": tenths(told, outcome.width),
    }
    return [overall, *(_worst_part(f"false alarms, {name}", own, must) for name, own in parts.items())]


def _worst_part(name: str, parts: dict[str, list[Record]], must: Range) -> Figure:
    confidence = 1 - 0.05 / max(len(parts), 1)
    rows = []
    for label, own in parts.items():
        hits = sum(map(outcome.alarm, own))
        rows.append((hits / len(own), clopper_pearson(hits, len(own), confidence), len(own), label))
    if not rows:
        return Figure(name, np.nan, (0.0, 1.0), 0, "%", must)
    # How far from what is allowed an interval stays; the middle of the range where it does not.
    value, interval, count, label = max(rows, key=lambda row: (max(row[1][0] - 0.015, 0.005 - row[1][1]), row[0]))
    clear = interval[0] > must.high or interval[1] < must.low
    return Figure(name, value, interval, count, "%", must, judged=value if clear else 0.01, note=label)


def worst_effect(seen: Sequence[Record]) -> Figure:
    """The effect whose truth is least often among the candidates; judged by its upper limit."""
    parts = by(seen, lambda r: next(iter(outcome.truth(r)), "?"))
    rows = []
    for name, own in parts.items():
        hits = sum(map(outcome.among_candidates, own))
        rows.append((hits / len(own), clopper_pearson(hits, len(own)), len(own), name))
    few = [f"{name} {count}" for _, _, count, name in rows if count < LEAST_WORST]
    missing = len(hidden.EFFECTS) - len(rows)
    short = f"{len(few) + missing} effects below {LEAST_WORST}" if few or missing else ""
    if not rows:
        return Figure("the same, worst effect", np.nan, (0.0, 1.0), 0, "%", *at_least(0.90, 0.95))
    value, interval, count, name = min(rows, key=lambda row: (row[1][1], row[0]))
    wanted = at_least(0.90, 0.95)
    return Figure("the same, worst effect", value, interval, count, "%", *wanted, interval[1], short, name)


def mean_size(records: Sequence[Record]) -> Figure:
    """Mean number of candidates of the first effect."""
    sizes = [len(r["verdict"]["effects"][0]["candidates"]) for r in records]
    value = float(np.mean(sizes)) if sizes else np.nan
    return Figure(
        "mean size of the candidate set, not tied", value, bootstrap(sizes, np.mean), len(sizes), "", *at_most(1.3, 1.1)
    )


def gap_closed(records: Sequence[Record]) -> Figure:
    """Median over sets of the gap closed; the note says what the worst tenth falls below."""
    values = [v for r in records if r["truth"] and (v := outcome.closed_share(r)) is not None]
    name, wanted = (
        "gap closed, median",
        (Range(0.98, np.inf, "≥ 0.98"), Range(0.995, np.inf, "≥ 0.995")),
    )
    if not values:
        return Figure(name, np.nan, (0.0, 0.0), 0, "", *wanted)
    low = f"a tenth below {np.quantile(values, 0.1):.3f}, mean {np.mean(values):.3f}"
    return Figure(name, float(np.median(values)), bootstrap(values, np.median), len(values), "", *wanted, note=low)


def strength(records: Sequence[Record]) -> Figure:
    """Rms error of the strengths in their standard errors."""
    errors = strength_errors(records)
    values = [v for own in errors.values() for v in own]
    name = "error of the strength in standard errors, rms"
    if not values:
        return Figure(name, np.nan, (0.0, 0.0), 0, "", *at_most(1.3, 1.1))
    worst = max(errors, key=lambda own: _rms(errors[own]))
    note = f"by the median {np.median(np.abs(values)) / 0.6745:.2f}; worst {worst} {_rms(errors[worst]):.1f}"
    return Figure(name, _rms(values), bootstrap(values, _rms), len(values), "", *at_most(1.3, 1.1), note=note)


def strength_errors(records: Sequence[Record]) -> dict[str, list[float]]:
    """Errors by effect."""
    out: dict[str, list[float]] = defaultdict(list)
    for r in records:
        if r["truth"] and (error := outcome.strength_error(r)) is not None:
            out[next(iter(outcome.truth(r)))].append(error)
    return dict(out)


def weakest_found(ones: Sequence[Record]) -> Figure:
    """Signal-to-noise over its limit at which 90 of 100 are found."""
    rows = [
        (outcome.snr(r) / r["truth"]["limit"], float(outcome.detected(r)))
        for r in ones
        if (r["truth"] or {}).get("limit") and outcome.snr(r) > 0
    ]
    name = "weakest effect found at 90 % power over its limit"
    value, interval = weakest(rows)
    return Figure(name, value, interval, len(rows), "", *at_most(1.5, 1.25))


def by(records: Iterable[Record], key: Callable[[Record], str]) -> dict[str, list[Record]]:
    """Records in groups."""
    out: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        out[key(record)].append(record)
    return dict(out)


def tenths(records: Sequence[Record], key: Callable[[Record], float]) -> dict[str, list[Record]]:
    """Ten groups of ascending values, as equal in number as they can be."""
    ordered = sorted(records, key=key)
    parts = [[ordered[k] for k in own] for own in np.array_split(np.arange(len(ordered)), 10) if len(own)]
    return {f"{key(own[0]):.3g}–{key(own[-1]):.3g}": own for own in parts}


def confusion(records: Sequence[Record]) -> dict[str, Counter]:
    """Truth → how often each first name was given: null sets, strong single effects, strong outside mechanisms."""
    out: dict[str, Counter] = {
        name: Counter() for name in ("none", *hidden.EFFECTS, *(f"({n})" for n in hidden.OUTSIDE))
    }
    for r in records:
        if not outcome.scored(r) or outcome.count_of(r) not in ("none", "one", "outside"):
            continue
        kind = r["job"]["kind"].split(":")
        if kind[0] != "none" and kind[2] != "strong":
            continue
        row = "none" if kind[0] == "none" else kind[1] if kind[0] == "one" else f"({kind[1]})"
        out[row][outcome.first_name(r)] += 1
    return out


def _baseline(record: Record) -> str:
    base = record["truth"]["base"]
    return f"{record['job']['budget'] or base['photon_budget']}{', top hat' if base['top_hat'] else ''}"


def _rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
