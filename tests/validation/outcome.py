"""What one record says: the truth, the answer, and whether they agree. Pure functions of plain records."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from tests.validation.protocol import Record

# What becomes of a data set, in a word: `tied` where the truth is one of several answers, `unseen` where nothing was
# seen. `error` is an exception, `passed over` was not judged; of a real frame as it is nobody knows (`open`).
COUNTED = ("right", "tied", "unseen", "unknown", "wrong", "error")
WORDS = (*COUNTED, "passed over", "open")
# −2 ln L by which the nearest rival must fall behind for an effect to be isolable: five standard deviations.
ISOLABLE = 25.0
STRONG = 100.0
# A rival that is this far behind in −2 ln L on the data is further than 25 behind without their noise, by ten standard
# deviations.
CLEAR = 400.0
# A model that is told the truth and closes less of the gap has missed it.
LEAST_CLOSED = 0.5
# Where what an effect has beyond a simpler one is fainter than this, the simpler one is a right answer.
UNSEEN = 5.0
# Ties of the dataset contract: pairs, and where they are tied.
SHAPES = ({"motion_blur", "beam_ellipticity"}, {"motion_blur", "fibre_anisotropy"})
# Effects that are one draw a frame.
OF_FRAMES = ("power_fluctuation", "pointing_jitter")


def word_for(record: Record) -> str:
    """One of `WORDS` for a record with a verdict."""
    number, said = count_of(record), status(record)
    names = frozenset(effect["name"] for effect in record["verdict"]["effects"])
    if number == "none":
        return {"consistent": "right", "unknown": "unknown"}.get(said, "wrong")
    if number == "outside":
        return "wrong" if names else {"unknown": "right", "consistent": "unseen"}.get(said, "wrong")
    if not truth(record):
        return "open"
    if not names:
        return "unseen" if said == "consistent" else "unknown"
    if said == "named":
        return "right" if names == truth(record) else "wrong"
    return "tied" if said == "ambiguous" and holds_truth(record) else "wrong"


def scored(record: Record) -> bool:
    """Whether a record counts: all but those that were passed over by their data sheet."""
    return record["outcome"] != "passed over"


def judged(record: Record) -> bool:
    """Whether there is a verdict."""
    return record["verdict"] is not None


def status(record: Record) -> str:
    """The verdict's status, or `error`."""
    return record["verdict"]["status"] if judged(record) else "error"


def count_of(record: Record) -> str:
    """`none`, `one`, `two`, `three`, `four`, `outside` or `real`."""
    return record["job"]["kind"].split(":")[0]


def level(record: Record) -> str:
    """`faint`, `mid` or `strong`."""
    return record["job"]["kind"].split(":")[-1]


def truth(record: Record) -> frozenset[str]:
    """Names of the effects that were put in; known from the kind where drawing failed."""
    if record["truth"] is not None:
        return frozenset(effect["name"] for effect in record["truth"]["effects"])
    parts = record["job"]["kind"].split(":")
    return frozenset(parts[1].split("+")) if parts[0] not in ("none", "outside") and len(parts) == 3 else frozenset()


def snr(record: Record) -> float:
    """Signal-to-noise of the truth, 0 where there is none."""
    return float(record["truth"]["snr"]) if record["truth"] else 0.0


def explanations(record: Record) -> list[frozenset[str]]:
    """Sets of effects that the verdict holds possible, best first."""
    return [frozenset(own) for own in record["verdict"]["explanations"]] if judged(record) else []


def alarm(record: Record, alpha: float = 0.01) -> bool:
    """Whether a disagreement was found that chance explains with less than alpha; a failure counts as one."""
    if not judged(record):
        return True
    p = record["verdict"]["detection"]["p_value"]
    return p is None or p < alpha


def detected(record: Record) -> bool:
    """Whether the verdict says that something is missing."""
    return status(record) in ("named", "ambiguous", "unknown")


def right_names(record: Record) -> frozenset[str]:
    """For one effect: its name, and that of a simpler one that it contains where the rest cannot be seen."""
    out = set(truth(record))
    for effect in record["truth"]["effects"]:
        out |= {name for name, beyond in effect.get("snr_beyond", {}).items() if beyond < UNSEEN}
    return frozenset(out)


def first_name(record: Record) -> str:
    """The first name of the answer, or its status where nothing is named."""
    effects = record["verdict"]["effects"] if judged(record) else []
    return effects[0]["name"] if effects else status(record)


def candidates(record: Record) -> list[str]:
    """All names that the verdict holds possible in place of any of its effects."""
    if not judged(record):
        return []
    return list(dict.fromkeys(name for effect in record["verdict"]["effects"] for name in effect["candidates"]))


def named_exactly(record: Record) -> bool:
    """Status `named`, with the true effects and nothing else."""
    return status(record) == "named" and explanations(record) == [truth(record)]


def holds_truth(record: Record) -> bool:
    """The true effects, and nothing else, are one of the explanations that the verdict holds possible."""
    return truth(record) in explanations(record)


def ambiguous_with_truth(record: Record) -> bool:
    """Status `ambiguous` with the truth among the explanations; or a simpler effect that it cannot be told from."""
    found = explanations(record)
    if status(record) == "named":
        return right_names(record) != truth(record) and found[0] <= right_names(record) - truth(record)
    return status(record) == "ambiguous" and holds_truth(record)


def right_first(record: Record) -> bool:
    """The first name is right."""
    return first_name(record) in right_names(record)


def among_candidates(record: Record) -> bool:
    """The truth is among the candidates."""
    return bool(right_names(record) & set(candidates(record)))


def unknown_and_empty(record: Record) -> bool:
    """Status `unknown`, nothing named."""
    return judged(record) and status(record) == "unknown" and not record["verdict"]["effects"]


def isolation_of(record: Record) -> float | None:
    """−2 ln L by which the nearest rival of a single effect falls behind, negative where it is ahead; None where it was
    not computed, or where what was told the truth did not find it: then no gap closes though some rival is near."""
    told = record.get("told") or {}
    nearest = told.get("isolation")
    return None if nearest is None or (_lost(told) and nearest < CLEAR) else nearest


def _lost(told: Record) -> bool:
    """Whether a model that was told the truth closes next to nothing of the gap."""
    closed = told.get("closed")
    return closed is not None and closed < LEAST_CLOSED


def isolable(record: Record) -> bool | None:
    """Whether a single effect can be told from every rival in its design; None where it is not known. The contract's
    ties are ambiguous where they occur: bounds, grain or many frames may part them."""
    apart = isolation_of(record)
    if apart is None:
        return False if tied(record) else None
    return apart >= ISOLABLE


def failed(record: Record) -> bool:
    """Whether nothing was found out: such a set counts against the suite's strictest figure."""
    return status(record) in ("error", "not_assessed")


def tied(record: Record) -> bool:
    """Whether the contract lists the effect as tied in this design. Hot pixels add, whatever the light: a pattern that
    follows it is not theirs."""
    manifest, name = record["job"]["design"], next(iter(truth(record)), "")
    budget = record["truth"]["base"]["photon_budget"] if record["truth"] else ""
    one_angle = one_site = manifest in ("one_site", "single_frame")
    one_exposure = manifest in ("one_exposure", "single_frame")
    hot = bool(record["truth"]) and record["truth"]["effects"][0]["form"].get("pattern") == "hot"
    return (
        (name in ("spread_law", "shutter_offset") and budget == "spot_area")
        or (name in ("fibre_anisotropy", "beam_ellipticity") and one_angle)
        or (name in ("motion_blur", "beam_ellipticity") and one_exposure)
        or (name in ("fixed_pattern", "speckle") and one_site and not hot)
    )


def closed_share(record: Record) -> float | None:
    """Part of the gap that the verdict closed, over that of a model told the truth; 0 where nothing was named."""
    told = record.get("told") or {}
    if not judged(record):
        return 0.0
    closed = record["verdict"]["gap"]["closed"]
    if not record["verdict"]["effects"]:
        return 0.0
    if told.get("closed") is None or _lost(told) or closed is None:
        return None
    return closed / told["closed"]


def strength_error(record: Record) -> float | None:
    """Error of the first parameter of a single effect that was rightly named first, over the standard error that a fit
    told the truth reports; None where the form is not the contract's or there is no such error."""
    told = (record.get("told") or {}).get("parameters") or {}
    (name,) = truth(record)
    if first_name(record) != name or name not in told or not of_contract(record["truth"]["effects"][0]):
        return None
    key = next(iter(record["truth"]["effects"][0]["parameters"]))
    own, bound = record["verdict"]["effects"][0]["parameters"].get(key), told[name].get(key)
    if not own or not bound or not bound["stderr"]:
        return None
    true, error = record["truth"]["effects"][0]["parameters"][key], bound["stderr"]
    if name in OF_FRAMES:
        # The bound is that at the truth, and a scatter of a few draws is known to a part of itself.
        error *= true / bound["value"]
    return (own["value"] - true) / error


def told_apart(record: Record) -> bool:
    """Whether the advised frames, made and judged with the others, left one explanation, the truth; and a condition at
    random needs twice as many at least, in more than half of all cases. Needs are counted in parts of a frame."""
    own = record["advised"]
    if own["frames"] is None:
        return False
    by_chance = np.median([np.inf if frames is None else frames for frames in own["any"]])
    return own["left"] == [sorted(truth(record))] and by_chance >= 2 * own["needed"]


def of_contract(effect: Record) -> bool:
    """Whether an effect has a form that the contract fixes, so that its strength means the same to all."""
    form, parameters = effect["form"], effect["parameters"]
    if effect["name"] == "saturation":
        return form["knee"] == "hard"
    if effect["name"] == "laser_drift":
        return form["law"] == "linear"
    if effect["name"] == "scatter_halo":
        return form["profile"] != "power_law"
    if effect["name"] == "fixed_pattern":
        return parameters["prnu"] > 0
    return True


def brightness(record: Record) -> float:
    """Brightest light as a part of full scale."""
    base = record["truth"]["base"]
    top = float(np.exp(-0.25)) if base["top_hat"] else 1.0
    return base["peak_dn"] * top / (2 ** base["bit_depth"] - 1)


def width(record: Record) -> float:
    """Widest σ_g [px]."""
    return max(record["truth"]["base"]["sigma_px"])


def of(records: Sequence[Record], number: str, *levels: str) -> list[Record]:
    """Scored records with a number of effects, and of given levels."""
    return [r for r in records if scored(r) and count_of(r) == number and (not levels or level(r) in levels)]


def line(record: Record) -> str:
    """A data set that is not right, in a line; "" for others, and for what is faint and was not seen."""
    faint = record["outcome"] == "unseen" and level(record) in ("faint", "mid")
    if faint or record["outcome"] in ("right", "passed over", "open"):
        return ""
    sets = "; ".join(" + ".join(sorted(own)) for own in explanations(record))
    said = record.get("error") or f"{status(record)} [{sets}]"
    where = " ".join(str(record["job"][key]) for key in ("seed", "kind", "design", "budget")).strip()
    return f"{where}: {record['outcome']}: {said}; truth: {' + '.join(sorted(truth(record))) or '—'}"


def by_kind(records: Sequence[Record]) -> list[tuple[str, ...]]:
    """Rows of a table: what was hidden, how many sets, and how many of each word that is `COUNTED`."""
    kinds: dict[str, Counter[str]] = {}
    for record in filter(scored, records):
        kinds.setdefault(count_of(record), Counter())[record["outcome"]] += 1
    return [(kind, str(own.total()), *(str(own[word]) for word in COUNTED)) for kind, own in kinds.items()]
