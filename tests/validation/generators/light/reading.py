"""What one record says: the truth, the answer, and whether they agree. Pure functions of plain records."""

from typing import Any

import numpy as np

from tests.validation.generators.light import plan
from tests.validation.generators.light.strength import LAWS
from tests.validation.protocol import Record

# Names of the light's static shape. On real beams none of them is false.
SHAPES = frozenset({"beam_profile", *plan.SHAPES})
# A mechanism outside the vocabulary for which the vocabulary has a right name: width that scatters between sites.
RIGHT_OUTSIDE = {"outside:focus_scatter": "site_variation"}
# A shape that no effect draws is no wrong name for a mechanism outside the vocabulary.
NO_NAME = frozenset({"beam_profile"})
# A verdict that takes longer is wrong [CPU s].
LIMIT_SECONDS = 200.0
# Relative error of the clip level that is allowed on the default dataset.
CLIP_TOLERANCE = 0.01
# Directions repeat after so many degrees.
PERIOD = {"direction": 180.0, "gamma0": 180.0}
FULL_TURN = {("background_gradient", "direction"): 360.0}


def entries(record: Record) -> list[dict[str, Any]]:
    """The verdict's effects; none without a converged verdict."""
    verdict = record["verdict"]
    return verdict["effects"] if verdict and verdict["status"] != "not_converged" else []


def effect_names(record: Record) -> list[str]:
    """Names of the verdict's effects."""
    return [entry["name"] for entry in entries(record)]


def names_put_in(record: Record) -> frozenset[str]:
    """Names of all effects that were put in."""
    return frozenset(effect["name"] for effect in record["truth"]["effects"]) if record["truth"] else frozenset()


def is_gaussian(record: Record) -> bool:
    """Whether the light was a Gaussian."""
    return bool(record["truth"]) and record["truth"]["light"]["kind"] == "gauss"


def named_alone(record: Record) -> frozenset[str]:
    """Effects with one candidate. On real beams a shape is no rival of an effect that is none."""
    out = set()
    for entry in entries(record):
        rivals = set(entry["candidates"]) - {entry["name"]}
        if not is_gaussian(record) and entry["name"] not in SHAPES:
            rivals -= SHAPES
        if not rivals:
            out.add(entry["name"])
    return frozenset(out)


def false_names(record: Record) -> frozenset[str]:
    """Return the effects in the verdict that were not put in and that the unaltered light or frame does not get."""
    truth = names_put_in(record)
    there = truth | {RIGHT_OUTSIDE[name] for name in truth & set(RIGHT_OUTSIDE)}
    there |= frozenset(record["truth"].get("allowed", ())) if record["truth"] else frozenset()
    there |= set(record.get("unaltered", ()))
    if not is_gaussian(record) or hidden_in_shape(record):
        there |= SHAPES
    if record["job"]["kind"].startswith("outside"):
        there |= NO_NAME
    return frozenset(name for name in effect_names(record) if name not in there)


def names_nothing_false(record: Record) -> bool:
    """Whether a converged verdict came in time and names nothing that was not put in."""
    if not record["verdict"] or record["verdict"]["status"] == "not_converged":
        return False
    return record["cpu_seconds"] <= LIMIT_SECONDS and not false_names(record)


def is_right(record: Record) -> bool:
    """Whether every effect is named as its only candidate and nothing else is, by a converged verdict in time."""
    if not names_nothing_false(record):
        return False
    wanted = names_put_in(record)
    if hidden_in_shape(record):
        wanted -= {effect["name"] for effect in record["truth"]["effects"] if effect.get("tied")}
        return wanted <= named_alone(record) and bool(set(effect_names(record)) & (SHAPES | names_put_in(record)))
    return wanted <= named_alone(record) and clip_level_holds(record)


def clip_level_holds(record: Record) -> bool:
    """Whether the clip level of the default dataset is within what is allowed; True for other sets."""
    if record["truth"]["light"]["kind"] != "rig":
        return True
    (true,) = (own["parameters"]["level"] for own in record["truth"]["effects"] if own["name"] == "saturation")
    (found,) = (own["parameters"]["level"]["value"] for own in entries(record) if own["name"] == "saturation")
    return bool(abs(found / true - 1) <= CLIP_TOLERANCE)


def hidden_in_shape(record: Record) -> bool:
    """Whether a free shape of the beam takes an effect (on real beams: the design does not tell them apart)."""
    return bool(record["truth"]) and not is_gaussian(record) and any(
        effect.get("tied") for effect in record["truth"]["effects"])  # fmt: skip


def reached(record: Record) -> bool:
    """Whether all effects reached the strength that the row states; True where drawing failed."""
    return not record["truth"] or all(effect.get("met", True) for effect in record["truth"]["effects"])


def reports_unconverged(record: Record) -> bool:
    """Whether a verdict that did not converge reports effects with values."""
    verdict = record["verdict"]
    return bool(verdict) and verdict["status"] == "not_converged" and bool(verdict["effects"])


def is_traceback(record: Record) -> bool:
    """Whether the verdict ended in an exception other than running out of time."""
    said = record.get("error", "")
    return record["outcome"] == "error" and not said.startswith(("TimeoutError", "RuntimeError: spotcheck "))


def law_gap_closed(record: Record) -> float | None:
    """Part of the gap on held-out frames that is closed, for sets with a law; None for others."""
    if names_put_in(record).isdisjoint(LAWS) or record["job"]["kind"].startswith("outside") or not record["verdict"]:
        return None
    return record["verdict"]["gap"]["closed"]


def pulls(record: Record) -> dict[str, float]:
    """Errors of the parameters of rightly named effects over their standard errors, by <effect>.<parameter>: those
    whose meaning the dataset contract fixes, of simulated sets."""
    out: dict[str, float] = {}
    if not record["truth"] or record["truth"]["light"]["kind"] not in ("gauss", "real"):
        return out
    for effect in record["truth"]["effects"]:
        if depends_on_width(record, effect["name"]):
            continue
        for entry in entries(record):
            if entry["name"] == effect["name"] and entry["name"] in named_alone(record):
                out |= _pulls_of(effect, entry)
    return out


def _pulls_of(effect: dict[str, Any], entry: dict[str, Any]) -> dict[str, float]:
    out = {}
    for key, found in entry["parameters"].items():
        true, value, error = effect["parameters"].get(key), found["value"], found["stderr"]
        if true is None or value is None or not error or not is_fixed(effect, key):
            continue
        off = value - true
        if key in PERIOD:
            period = FULL_TURN.get((effect["name"], key), PERIOD[key])
            off = (off + period / 2) % period - period / 2
        out[f"{effect['name']}.{key}"] = float(off / error) if np.isfinite(off) else np.inf
    return out


def depends_on_width(record: Record, name: str) -> bool:
    """Whether an effect's value depends on what is called the width of a light that is no Gaussian: the budget by the
    spot's area compares brightness with it."""
    budget = record["truth"].get("base", {}).get("photon_budget")
    return name == "photon_budget" and budget == "spot_area" and not is_gaussian(record)


def is_fixed(effect: dict[str, Any], key: str) -> bool:
    """Whether a parameter means the same to all: not a soft clip's level, nor a grain, whose measure is free."""
    name, form = effect["name"], effect["form"]
    if key in ("grain", "hot_pixels"):
        return False
    return not (
        (name == "saturation" and form.get("knee") == "soft")
        or (name == "scatter_halo" and form.get("profile") == "power_law")
        or (name == "laser_drift" and form.get("law") == "geometric")
    )
