"""The scores as text: Markdown for the pages, one line for the end of a run."""

from collections.abc import Callable, Sequence

import numpy as np

from rig import hidden
from tests.validation import outcome, score
from tests.validation.figure import Figure
from tests.validation.outcome import of
from tests.validation.protocol import Record
from tests.validation.table import markdown

# Why a rate outside its range may pass.
PARTS = (
    "A worst part of the null sets fails only if its interval, widened for the number of parts, keeps clear of the "
    "range; the worst effect, if its upper limit does."
)
COLUMNS = ("figure", "measured (95 %)", "sets", "must", "aim", "verdict")


def as_markdown(figures: Sequence[Figure], records: Sequence[Record], commit: str, first: int) -> str:
    """The table, the same by effect and by outside mechanism, and what went wrong."""
    counted = [r for r in records if outcome.scored(r)]
    out = [
        "# Scores on hidden effects", "",
        f"{len(counted)} sets of seeds from {first:,} on, at commit `{commit}`, by `make validate`.", "",
        *markdown(COLUMNS, [row(figure) for figure in figures]), "",
        f"{count(figures)}. {PARTS}", "",
        "## By effect", "",
        *markdown(BY_EFFECT, [by_effect(name, records) for name in hidden.EFFECTS]), "",
        "Strong sets; alone: not tied in its design, as the contract lists ties. In the set: the truth is among the "
        "candidates, of what was detected at any strength. Error: rms of the strength in its standard errors.", "",
        "## Outside the vocabulary", "",
        *markdown(OUTSIDE, [by_mechanism(name, records) for name in hidden.OUTSIDE]), "",
    ]  # fmt: skip
    errors = [r for r in counted if r["outcome"] == "error"]
    if errors:
        out += [
            "## Exceptions",
            "",
            *(f"- {r['job']['seed']} {r['job']['kind']}: {r['error']}" for r in errors[:20]),
            "",
        ]
    return "\n".join([*out, *outcome.timing(counted)])


def row(figure: Figure) -> tuple[str, ...]:
    """One line of the table."""
    name = figure.name + (f" ({figure.note})" if figure.note else "")
    shown = "—" if np.isnan(figure.value) else f"{_number(figure.value, figure.unit)} ({_between(figure)})"
    wanted = [own.text if own else "" for own in (figure.must, figure.aim)]
    return name, shown, f"{figure.sets}", *wanted, figure.verdict()


BY_EFFECT = ("effect", "strong", "alone", "named when alone", "first when detected", "in the set", "error")


def by_effect(name: str, records: Sequence[Record]) -> tuple[str, ...]:
    """One effect's line."""
    own = [r for r in of(records, "one") if r["job"]["kind"].split(":")[1] == name]
    strong = [r for r in own if outcome.level(r) == "strong"]
    alone = [r for r in strong if not outcome.tied(r)]
    seen = [r for r in own if outcome.detected(r)]
    errors = score.strength_errors(strong).get(name)
    shown = f"{np.sqrt(np.mean(np.square(errors))):.1f}" if errors else "—"
    return (
        f"`{name}`", str(len(strong)), str(len(alone)), _part(alone, outcome.named_exactly),
        _part(seen, outcome.right_first), _part(seen, outcome.among_candidates), shown,
    )  # fmt: skip


OUTSIDE = ("mechanism", "sets", "no wrong name", "else")


def by_mechanism(name: str, records: Sequence[Record]) -> tuple[str, ...]:
    """One mechanism's line, with what was named wrongly."""
    own = [r for r in of(records, "outside") if r["job"]["kind"].split(":")[1] == name]
    other: dict[str, int] = {}
    for r in own:
        if not outcome.no_wrong_name(r):
            names = [own["name"] for own in r["verdict"]["effects"]] if outcome.judged(r) else []
            said = f"{outcome.status(r)} {' + '.join(names)}".strip()
            other[said] = other.get(said, 0) + 1
    most = ", ".join(f"{said} {n}" for said, n in sorted(other.items(), key=lambda item: -item[1])[:3])
    return f"`{name}`", str(len(own)), _part(own, outcome.no_wrong_name), most


def count(figures: Sequence[Figure]) -> str:
    """How many musts are reached."""
    words = [figure.verdict() for figure in figures if figure.must]
    reached, short, no = (sum(w.startswith(own) for w in words) for own in ("ok", "short", "not measured"))
    few = sum(w.startswith("ok") and "too few" in w for w in words)
    said = f"{reached} of {len(words)} musts reached{f' ({few} on too few sets)' if few else ''}, {short} short"
    return said + (f", {no} not measured" if no else "")


def summary(figures: Sequence[Figure], records: Sequence[Record]) -> str:
    """The last line of a run."""
    short = [figure.name for figure in figures if figure.verdict().startswith("short")]
    return f"{sum(map(outcome.scored, records))} sets, {count(figures)}" + (
        f" (short: {'; '.join(short)})" if short else ""
    )


def _part(records: Sequence[Record], test: Callable[[Record], bool]) -> str:
    return f"{sum(map(test, records))}/{len(records)}" if records else "—"


def _number(value: float, unit: str) -> str:
    if unit == "s":
        return f"{value:.0f} s"
    return f"{100 * value:.3g} %" if unit == "%" else f"{value:.3f}"


def _between(figure: Figure) -> str:
    low, high = (_number(v, figure.unit).removesuffix(f" {figure.unit}") for v in figure.interval)
    return f"{low}–{high}"
