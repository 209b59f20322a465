"""What one record says: the truth, the answer, and whether they agree. Pure functions of plain records."""

from collections import Counter
from collections.abc import Sequence
from itertools import product

import numpy as np

from tests.validation.protocol import Record

# What becomes of a data set, in a word: `tied` where the truth is one of several answers, `unseen` where nothing was
# seen. `error` is an exception, `passed over` was not judged; of a real frame as it is nobody knows (`open`).
COUNTED = ("right", "tied", "unseen", "unknown", "wrong", "error")
WORDS = (*COUNTED, "passed over", "open")
STRONG = 100.0
# What a shape that no effect draws is called: of what lies outside the vocabulary it is no wrong name.
SHAPE = frozenset({"beam_profile"})
# Where what an effect has beyond a simpler one is fainter than this, the simpler one is a right answer.
UNSEEN = 5.0
# Ties of the dataset contract: pairs, and where they are tied.
SHAPES = ({"motion_blur", "beam_ellipticity"}, {"motion_blur", "fibre_anisotropy"})
# Statuses in which every listed effect stands alone.
NAMED = ("named", "named_more_remains")


def word_for(record: Record) -> str:
    """One of `WORDS` for a record with a verdict."""
    number, said = count_of(record), status(record)
    names = frozenset(effect["name"] for effect in record["verdict"]["effects"])
    if number == "none":
        return {"consistent": "right", "unknown": "unknown"}.get(said, "wrong")
    if number == "outside":
        right = names <= SHAPE and said in (*NAMED, "unknown")
        return "right" if right else "unseen" if said == "consistent" else "wrong"
    if not truth(record):
        return "open"
    if not names:
        return "unseen" if said == "consistent" else "unknown"
    if said in NAMED:
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
    """Sets of effects that the verdict holds possible: the one it lists, then those with a rival in an effect's
    place."""
    effects = record["verdict"]["effects"] if judged(record) else []
    every = [frozenset(own) for own in product(*(effect["candidates"] for effect in effects))] if effects else []
    return list(dict.fromkeys(every))


def alarm(record: Record, alpha: float = 0.01) -> bool:
    """Whether a disagreement was found that chance explains with less than alpha; a failure counts as one."""
    if not judged(record):
        return True
    p = record["verdict"]["detection"]["p_value"]
    return p is None or p < alpha


def detected(record: Record) -> bool:
    """Whether the verdict says that something is missing."""
    return status(record) in (*NAMED, "ambiguous", "unknown")


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
    """The true effects are named, each alone, and nothing else."""
    return status(record) in NAMED and explanations(record) == [truth(record)]


def holds_truth(record: Record) -> bool:
    """The true effects, and nothing else, are one of the explanations that the verdict holds possible."""
    return truth(record) in explanations(record)


def ambiguous_with_truth(record: Record) -> bool:
    """Status `ambiguous` with the truth among the explanations; or a simpler effect that it cannot be told from."""
    found = explanations(record)
    if status(record) in NAMED:
        return right_names(record) != truth(record) and found[0] <= right_names(record) - truth(record)
    return status(record) == "ambiguous" and holds_truth(record)


def right_first(record: Record) -> bool:
    """The first name is right."""
    return first_name(record) in right_names(record)


def among_candidates(record: Record) -> bool:
    """The truth is among the candidates."""
    return bool(right_names(record) & set(candidates(record)))


def no_wrong_name(record: Record) -> bool:
    """Nothing is named but, where there is one, a shape that no effect draws."""
    return judged(record) and not {effect["name"] for effect in record["verdict"]["effects"]} - SHAPE


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
    """Part of the gap that the verdict closed; 0 where nothing was named."""
    if not judged(record) or not record["verdict"]["effects"]:
        return 0.0
    return record["verdict"]["gap"]["closed"]


def strength_error(record: Record) -> float | None:
    """Error of the first parameter of a single effect that was rightly named first, in its standard errors; None where
    the form is not the contract's or there is no such error."""
    (name,) = truth(record)
    if first_name(record) != name:
        return None
    key = next(iter(record["truth"]["effects"][0]["parameters"]))
    own = record["verdict"]["effects"][0]["parameters"].get(key)
    if not own or not own["stderr"] or not of_contract(record["truth"]["effects"][0]):
        return None
    return (own["value"] - record["truth"]["effects"][0]["parameters"][key]) / own["stderr"]


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


def timing(records: Sequence[Record]) -> list[str]:
    """Median seconds of a verdict, where they were taken."""
    taken = [r for r in records if r.get("seconds")]
    if not taken:
        return []
    own = [r["seconds"] for r in taken]
    quiet = [r["seconds"] for r in taken if status(r) == "consistent"]
    said = f"A verdict took {np.median(own):.1f} s in the median ({np.quantile(own, 0.9):.1f} s for one in ten)"
    return [said + (f", a `consistent` one {np.median(quiet):.1f} s." if quiet else "."), ""]
