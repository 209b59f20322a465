"""The table: from records to shares with their Wilson intervals, each held against what it must be.

All that is read of a verdict is read here, in `certain`, `wrong`, `says_tied` and `covered`. A row is met unless its
interval excludes what it must be.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from tests.validation.figure import Figure, Range
from tests.validation.generators.names import before
from tests.validation.intervals import bootstrap
from tests.validation.outcome import timing, word_for
from tests.validation.protocol import Record
from tests.validation.table import markdown

# What a light's static shape is called. On light that is no Gaussian none is false, nor a rival of what is none.
SHAPES = frozenset({"beam_profile", "super_gaussian", "beam_ellipticity", "scatter_halo", "ghost_reflection"})
# What every row must be, as a share, by the row's name; of effects at 50 times their bound by design.
STRONG = {"default": 0.90, "one_exposure": 0.85, "single_frame": 0.75}
MUST = {
    "ten": 0.80, "plain": 0.02, "outside": 0.05, "tied": 0.90, "two": 0.80, "clip": 8 / 9, "rise": 8 / 9,
    "stripes": 8 / 9, "bend": 4 / 9, "hene wrong": 0.0, "alarm": 0.01, "cover": 0.95, "sheet": 0.02,
    "sheet strong": 0.80, "loss": 0.01, "closed": 0.95,
}  # fmt: skip
# A Kolmogorov–Smirnov test that says less than this finds p-values not to be uniform.
UNIFORM = 0.01
# What lies below every real frame.
PEDESTAL = frozenset({"dark_offset", "background_gradient"})
# On which frames the gap of a design with repeats is measured, and what becomes of a set that is not lost.
UNSEEN, GOOD = "unseen repeats", ("right", "tied")
ALPHA = 0.01
# What `limits` says of an effect that the light's shape mimics; others have a limit because they are not there.
SHAPE_WORDS = "light's shape"
# Errors within which a rise is met, and a parameter is covered.
THREE, COVER = 3.0, 1.96
# Directions come again after so many degrees.
TURN = {"direction": 180.0, "gamma0": 180.0}
WHOLE = {("background_gradient", "direction"): 360.0}


# What one verdict says


def entries(record: Record) -> list[dict[str, Any]]:
    """The verdict's effects."""
    return record["verdict"]["effects"] if record["verdict"] else []


def gaussian(record: Record) -> bool:
    """Whether the light was a Gaussian."""
    return bool(record["truth"]) and record["truth"]["light"]["kind"] == "gauss"


def rivals(record: Record, entry: dict[str, Any]) -> set[str]:
    """Other candidates of an effect, less shapes where these do not count."""
    others = set(entry["candidates"]) - {entry["name"]}
    return others if gaussian(record) or entry["name"] in SHAPES else others - SHAPES


def certain(record: Record) -> set[str]:
    """Names that have no rival."""
    return {entry["name"] for entry in entries(record) if not rivals(record, entry)}


def hidden(record: Record) -> list[dict[str, Any]]:
    """What was put in, without speckle on top."""
    return [own for own in record["truth"]["effects"] if not own.get("on_top")] if record["truth"] else []


def wrong(record: Record) -> set[str]:
    """Names of effects of which no candidate is there; shapes where the light is no Gaussian are there."""
    there = {own["name"] for own in record["truth"]["effects"]} if record["truth"] else set()
    if not gaussian(record) or any(own.get("tied") for own in hidden(record)):
        there |= SHAPES
    return {entry["name"] for entry in entries(record) if not there & {entry["name"], *entry["candidates"]}}


def exact(record: Record) -> bool:
    """All that was put in is named, with certainty, and nothing false."""
    return {own["name"] for own in hidden(record)} <= certain(record) and not wrong(record)


def says_tied(record: Record) -> bool:
    """The verdict says that the first effect cannot be told from the light's shape: `limits` says so, or the shape is
    named, alone or as a rival."""
    if not record["verdict"]:
        return False
    name = hidden(record)[0]["name"]
    limits = record["verdict"].get("limits") or []
    if any(own.get("effect") == name and SHAPE_WORDS in own.get("why", "") for own in limits):
        return True
    return any(
        entry["name"] == "beam_profile" or ("beam_profile" in entry["candidates"] and name in entry["candidates"])
        for entry in entries(record)
    )


def pulls(record: Record) -> dict[str, float]:
    """Errors of parameters of what was rightly named, in standard errors, by <effect>.<parameter>: those that the
    contract fixes."""
    out = {}
    for own in hidden(record):
        for entry in entries(record):
            if entry["name"] != own["name"] or rivals(record, entry):
                continue
            for key, said in entry["parameters"].items():
                true, value, error = own["parameters"].get(key), said["value"], said["stderr"]
                if true is None or value is None or not error or not fixed(own, key):
                    continue
                off = value - true
                if key in TURN:
                    turn = WHOLE.get((own["name"], key), TURN[key])
                    off = (off + turn / 2) % turn - turn / 2
                out[f"{own['name']}.{key}"] = off / error
    return out


def fixed(effect: dict[str, Any], key: str) -> bool:
    """Whether a parameter means the same to all: not a soft clip's level, nor a grain, whose measure is free."""
    name, form = effect["name"], effect["form"]
    if key in ("grain", "hot_pixels"):
        return False
    return not (
        (name == "saturation" and form.get("knee") == "soft")
        or (name == "scatter_halo" and form.get("profile") == "power_law")
        or (name == "laser_drift" and form.get("law") == "geometric")
    )


# Figures


def wilson(hits: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a share (Wilson 1927, doi:10.1080/01621459.1927.10502953)."""
    if count == 0:
        return 0.0, 1.0
    z = float(stats.norm.isf((1 - confidence) / 2))
    share, more = hits / count, z * z / count
    middle, half = (share + more / 2) / (1 + more), z * np.sqrt(share * (1 - share) / count + more / (4 * count))
    half /= 1 + more
    return (float(middle - half) if hits else 0.0), (float(middle + half) if hits < count else 1.0)


def share(name: str, rows: Iterable[bool], must: float, most: bool = False, both: bool = False) -> Figure:
    """A share that must be at least so much, at most, or just that (`both`)."""
    found = list(rows)
    hits, count = sum(found), len(found)
    low, high = wilson(hits, count)
    value = hits / count if count else np.nan
    if both:
        wanted, held = Range(low, high, f"{100 * must:g} %"), must
    elif most:
        wanted, held = Range(-np.inf, must, f"≤ {100 * must:.3g} %"), low
    else:
        wanted, held = Range(must, np.inf, f"≥ {100 * must:.3g} %"), high
    return Figure(name, value, (low, high), count, "%", wanted, judged=held)


def uniform(name: str, p_values: Sequence[float]) -> Figure:
    """Whether p-values are uniform, by Kolmogorov and Smirnov."""
    p = float(stats.kstest(p_values, "uniform").pvalue) if len(p_values) else np.nan
    return Figure(name, p, (np.nan, np.nan), len(p_values), "", Range(UNIFORM, np.inf, f"≥ {UNIFORM:g}"))


def figures(records: Sequence[Record]) -> list[Figure]:
    """All rows of the table. A set without a verdict has named nothing."""
    scored = [own for own in records if own["outcome"] != "passed over" and own["truth"]]

    def of(*words: str, design: str = "") -> list[Record]:
        return [
            own
            for own in scored
            if {*words} <= {*own["job"]["kind"].split(":")} and design in ("", own["job"]["design"])
        ]

    out = []
    for level, words in (("50", "one effect at 50 times its bound"), ("10", "at 10 times")):
        for design, must in STRONG.items():
            rows = [own for own in of("one", level, design=design) if told(own)]
            must = must if level == "50" else MUST["ten"]
            out.append(share(f"{words}, {design}: named, nothing false", map(exact, rows), must))
        rows = [own for own in of("one", level) if told(own) and len(own["truth"]["effects"]) > 1]
        out.append(share(f"{words}, of these with speckle on top", map(exact, rows), MUST["ten"]))
    plain = of("light")
    out.append(share("none, light that is no Gaussian: a false name", _any(plain), MUST["plain"], most=True))
    for light in ("real", "drawn", "gauss"):
        rows = of("outside", light)
        out.append(share(f"outside, {light} light: a wrong name", _any(rows), MUST["outside"], most=True))
    tied = [own for own in scored if hidden(own) and own["job"]["kind"][:4] in ("one:", "tied") and _tied(own)]
    out.append(share("tied with the shape by design: said to be", map(says_tied, tied), MUST["tied"]))
    two = [own for own in of("two") if all(told(own, k) for k in range(2))]
    out.append(share("two effects: both named, nothing else", map(exact, two), MUST["two"]))
    out += of_frames(of_first(scored, "hene"))
    out += of_nulls(of("none"), plain)
    inside = [abs(pull) <= COVER for own in known_truths(scored) for pull in pulls(own).values()]
    out.append(share("95 % intervals of parameters that hold the truth", inside, MUST["cover"]))
    out += of_sheets(of_first(scored, "sheet"))
    out += [of_shapes(plain), of_before(of_first(scored, before.WORD))]
    return out


def of_shapes(rows: Sequence[Record]) -> Figure:
    """The part of the gap on unseen frames that a learned shape closes, over an oracle's: who knows the light closes
    all that is above noise."""
    closed = [own["verdict"]["gap"]["closed"] for own in rows if own["verdict"]
              and own["verdict"]["gap"]["on"] == UNSEEN and own["verdict"]["light"]]  # fmt: skip
    name, wanted = (
        "gap that a learned shape closes on unseen frames, over an oracle's",
        Range(MUST["closed"], np.inf, "≥ 0.95"),
    )
    if not closed:
        return Figure(name, np.nan, (np.nan, np.nan), 0, "", wanted)
    interval = bootstrap(closed, np.mean)
    return Figure(name, float(np.mean(closed)), interval, len(closed), "", wanted, judged=interval[1])


def of_before(rows: Sequence[Record]) -> Figure:
    """By how much fewer sets are right, or hold the truth among rivals, than with the engine before: with the error of
    a difference of paired shares (Agresti, Categorical Data Analysis, 11.1.3)."""
    then = np.array([own["truth"]["before"] in GOOD for own in rows], float)
    now = np.array([_now(own) in GOOD for own in rows], float)
    name, wanted = "sets of the suite before: net loss", Range(-np.inf, MUST["loss"], "≤ 1 %")
    if not len(rows):
        return Figure(name, np.nan, (np.nan, np.nan), 0, "%", wanted)
    loss, half = float(np.mean(then - now)), 1.96 * float(np.std(then - now)) / np.sqrt(len(rows))
    return Figure(name, loss, (loss - half, loss + half), len(rows), "%", wanted, judged=loss - half)


def _now(record: Record) -> str:
    """What becomes of a set of the rig now."""
    if record["verdict"] is None:
        return "error"
    kind = record["job"]["kind"].removeprefix(f"{before.WORD}:")
    return word_for(record | {"job": record["job"] | {"kind": kind}})


def of_frames(rows: Sequence[Record]) -> list[Figure]:
    """What was put into real frames, of which nobody knows what else they hold."""
    plain = {own["truth"]["frame"]: own for own in rows if not hidden(own)}
    put = [own for own in rows if hidden(own)]

    def of(word: str) -> list[Record]:
        return [own for own in put if own["truth"]["put_in"].startswith(word)]

    def named(own: Record) -> bool:
        return hidden(own)[0]["name"] in certain(own)

    def named_or_tied(own: Record) -> bool:
        return named(own) or says_tied(own)

    rises = [risen(own, plain[own["truth"]["frame"]]) for own in of("rise") if own["truth"]["frame"] in plain]
    known = {frame: {entry["name"] for entry in entries(own)} for frame, own in plain.items()}
    beside = [bool(wrong(own) - known.get(own["truth"]["frame"], set()) - PEDESTAL) for own in put]
    return [
        share("real frames, clip: named", map(named, of("clip")), MUST["clip"]),
        share("real frames, rise: found within three errors", rises, MUST["rise"]),
        share("real frames, stripes: named", map(named, of("stripes")), MUST["stripes"]),
        share("real frames, bend: named, or said to be tied", map(named_or_tied, of("bend")), MUST["bend"]),
        share("real frames: a name of what was not put in", beside, MUST["hene wrong"], most=True),
    ]


def risen(record: Record, plain: Record) -> bool:
    """The pedestal is higher by what was put in, within three errors, than in the frame as it is."""
    levels = [next((entry["parameters"].get("level") for entry in entries(own) if entry["name"] == "dark_offset"), None)
              for own in (record, plain)]  # fmt: skip
    after, before = levels
    if not after or after["value"] is None or not after["stderr"]:
        return False
    value, error = (before["value"], before["stderr"]) if before and before["stderr"] else (0.0, 0.0)
    off = after["value"] - value - hidden(record)[0]["parameters"]["rise"]
    return bool(abs(off) <= THREE * np.hypot(after["stderr"], error))


def of_nulls(nulls: Sequence[Record], plain: Sequence[Record]) -> list[Figure]:
    """p-values where nothing is wrong: of the baseline on Gaussian light, of what is left on other light."""
    out = []
    sources: tuple[tuple[str, Sequence[Record], str], ...] = (
        ("detection", nulls, "null sets"),
        ("unexplained", plain, "other light, what is left"),
    )
    for block, rows, said in sources:
        found = [own["verdict"][block]["p_value"] for own in rows if own["verdict"]]
        known = [p for p in found if p is not None]
        out.append(uniform(f"{said}: p-values are uniform (KS)", known))
        # Without a p-value nothing was tested: an alarm.
        alarms = [p is None or p < ALPHA for p in found] + [True] * (len(rows) - len(found))
        out.append(share(f"{said}: false alarms at 1 %", alarms, MUST["alarm"], both=True))
    return out


def of_sheets(rows: Sequence[Record]) -> list[Figure]:
    """Sheets that are off."""
    empty, strong = ([own for own in rows if bool(hidden(own)) == full] for full in (False, True))
    return [
        share("sheet off, nothing put in: a false name", _any(empty), MUST["sheet"], most=True),
        share("sheet off, one strong effect: named, nothing false", map(exact, strong), MUST["sheet strong"]),
    ]


def told(record: Record, k: int = 0) -> bool:
    """Whether an effect reached its level and is not tied with the shape."""
    own = hidden(record)[k]
    return bool(own["met"] and not own["tied"])


def of_first(records: Sequence[Record], word: str) -> list[Record]:
    """Records of kinds that begin with a word."""
    return [own for own in records if own["job"]["kind"].split(":")[0] == word]


def known_truths(records: Sequence[Record]) -> list[Record]:
    """Simulated sets of one or two effects, of which all parameters are known."""
    return [own for own in records if own["truth"] and own["job"]["kind"][:4] in ("one:", "two:")]


def _tied(record: Record) -> bool:
    own = hidden(record)[0]
    return bool(own["tied"] and own["known"] >= 0.8 * own["wanted"])


def _any(rows: Iterable[Record]) -> list[bool]:
    return [bool(wrong(own)) for own in rows]


# The page


def page(records: Sequence[Record], commit: str) -> str:
    """The table, pulls by parameter, and what is not right."""
    rows = [
        (own.name, _shown(own), str(own.sets), own.must.text if own.must else "", own.verdict())
        for own in figures(records)
    ]
    scored = [own for own in records if own["outcome"] != "passed over"]
    # What is known of a set of the suite before is its outcome, which is a row of the table.
    own_sets = [own for own in scored if own not in of_first(scored, before.WORD)]
    lines = [said for said in map(line, own_sets) if said] + lost(of_first(scored, before.WORD))
    return "\n".join([
        "# Names on real light", "",
        f"{len(scored)} sets at commit `{commit}`, by `make validate-light`, on seeds that the commit's hash gave, "
        "once. A row is met unless its 95 % interval excludes what it must be.", "",
        *markdown(("row", "measured (95 %)", "sets", "must", "verdict"), rows), "", *timing(scored),
        "## Errors of parameters, in standard errors", "",
        *markdown(("parameter", "sets", "median", "rms", "within 1.96"), pulls_table(scored)), "",
        "## Not right", "", *[f"- {said}" for said in lines], "",
    ])  # fmt: skip


def pulls_table(records: Sequence[Record]) -> list[tuple[str, ...]]:
    """Of every parameter."""
    found: dict[str, list[float]] = {}
    for own in known_truths(records):
        for name, pull in pulls(own).items():
            found.setdefault(name, []).append(pull)
    return [
        (f"`{name}`", str(len(own)), f"{np.median(own):.2f}", f"{np.sqrt(np.mean(np.square(own))):.2f}",
         f"{np.mean(np.abs(own) <= COVER):.2f}")
        for name, own in sorted(found.items())
    ]  # fmt: skip


def line(record: Record) -> str:
    """A set that is not right, in a line; "" for others."""
    job = record["job"]
    where = f"{job['seed']} {job['kind']} {job['design']}"
    if not record["verdict"]:
        return f"{where}: {record.get('error', 'no verdict')}"
    number, false = job["kind"].split(":")[0], wrong(record)
    if number == "hene":
        false -= PEDESTAL
    missed = {own["name"] for own in hidden(record) if told(record)} - certain(record)
    if number == "outside" or not hidden(record) or (number == "hene" and says_tied(record)):
        missed = set()
    if not missed and not false:
        return ""
    parts = [f"{word} {' + '.join(sorted(own))}" for word, own in (("missed", missed), ("false", false)) if own]
    return f"{where}: {', '.join(parts)}"


def lost(rows: Sequence[Record]) -> list[str]:
    """Sets of the suite before that were right, or held the truth among rivals, and do so no more."""
    return [
        f"{own['job']['seed']} {own['job']['kind']} {own['job']['design']}: {own['truth']['before']} before, "
        f"{_now(own)} now"
        for own in rows
        if own["truth"] and own["truth"]["before"] in GOOD and _now(own) not in GOOD
    ]


def _shown(figure: Figure) -> str:
    if np.isnan(figure.value):
        return "—"
    if figure.unit != "%":
        return f"{figure.value:.3f}"
    return f"{100 * figure.value:.3g} % ({100 * figure.interval[0]:.3g}–{100 * figure.interval[1]:.3g})"
