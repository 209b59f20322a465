"""The verdict in plain words: one paragraph that a person reads first."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from spotcheck.discrepancy.surround import LEFT
from spotcheck.model.effects import vocabulary

# Below this part over the noise floor there was no gap in the mean images to speak of.
NO_GAP = 0.02
UNITS = {"1": "", "deg": "°", "degree": "°"}
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: ""}
NUMBERS = {1: "One effect", 2: "Two effects", 3: "Three effects", 4: "Four effects"}
BLOCKS = {
    "mean": "the mean image",
    "variance": "the noise within blocks of pixels",
    "spectrum": "the fine structure",
    "frame": "the scatter from frame to frame",
    "line": "whole rows or columns",
    "surround": "the surroundings of the spot",
}
FOLDS = {1: "a one-sided pattern", 2: "a twofold pattern", 3: "a threefold pattern", 4: "a fourfold pattern"}
CAVEAT = (
    "A closed gap does not prove {what}: whatever else leaves the same trace in these frames would close it as well."
)


class Limits(Protocol):
    """What a disagreement may be without mattering, as parts of the peak and of a pixel's noise."""

    @property
    def of_peak(self) -> float:
        """Rms of the mean's residual as a part of the peak."""

    @property
    def of_noise(self) -> float:
        """The same as a part of a pixel's noise; twice this counts for the noise's variance."""


def sentence(verdict: dict[str, Any], tolerance: Limits | None = None) -> str:
    """The paragraph of a verdict; its own `sentence` is not read. With `tolerance` a disagreement that was let pass
    stands beside the limit."""
    tellers = {
        "consistent": _consistent,
        "named": _explained,
        "ambiguous": _explained,
        "unknown": _unknown,
        "not_assessed": _nothing_tested,
    }
    parts = tellers[verdict["status"]](verdict, tolerance)
    if verdict["status"] != "not_assessed":
        parts.append(_left_out(verdict))
    return " ".join(part for part in parts if part)


def value_text(value: float | None, stderr: float | None, unit: str) -> str:
    """Value ± standard error with two digits of the error, and the unit: `0.0240 ± 0.0011`, `−3.1 ± 0.4 µs`."""
    if value is None or not np.isfinite(value):
        return "no value"
    unit = UNITS.get(unit, unit)
    if unit == "s" and value:
        power = int(np.clip(3 * np.floor(np.log10(abs(value)) / 3), -9, 0))
        value, stderr = value / 10.0**power, None if stderr is None else stderr / 10.0**power
        unit = PREFIXES[power] + "s"
    tail = unit if unit in ("", "°") else f" {unit}"
    if stderr is None or not np.isfinite(stderr) or stderr <= 0:
        return f"{value:.4g}{tail}".replace("-", "−")
    digits = int(np.clip(1 - np.floor(np.log10(stderr)), 0, 9))
    text = f"{value:.{digits}f} ± {stderr:.{digits}f}"
    return f"{text}{tail}".replace("-", "−")


def condition_text(condition: dict[str, float]) -> str:
    """A measurement in words: `an exposure of 1.8 ms and 45°`."""
    words = []
    for name, value in condition.items():
        if name == "exposure_s":
            words.append(f"an exposure of {value_text(value, None, 's')}")
        elif name == "angle_deg":
            words.append(f"{value:.4g}°")
        elif name != "blocked":
            words.append(f"{name} {value:.4g}")
    return _list(words) + (" with the beam blocked and the room as it was" if condition.get("blocked") else "")


def place_text(row: dict[str, Any]) -> str:
    """A row of `where` in words, without its angle and exposure."""
    own = row["bin"]
    quantity, low, high = own["quantity"], own["low"], own["high"]
    unit = UNITS.get(own["unit"], own["unit"])
    if low is not None and high is not None:
        span = f"{low:.3g} to {high:.3g} {unit}" if low != high else f"{low:.3g} {unit}"
    else:
        span = f"over {low:.3g} {unit}" if low is not None else ""
    if quantity == "radius":
        return f"in the ring at {span} from the spot's centre"
    if quantity.startswith("radius, azimuthal order "):
        return f"as {FOLDS[int(quantity[-1])]} at {span} from the spot's centre"
    if quantity == "grey level":
        return f"where the spot gives {span}"
    if quantity == "level of light":
        return f"in the noise at {100 * (low or 0):.3g} to {100 * (high or 1):.3g} % of the peak's light"
    if quantity == "period":
        return f"in structure with periods of {span}"
    if quantity == "stripes":
        return f"in stripes with a period of {span}"
    if row["block"] == "line":
        return f"in the scatter of the {quantity}"
    if row["block"] == "frame" and quantity.startswith("scatter"):
        return f"in the {quantity} from frame to frame"
    return f"in the {quantity}" if not span else f"in the {quantity} ({span.strip()})"


def _consistent(verdict: dict[str, Any], tolerance: Limits | None) -> list[str]:
    detection = verdict["detection"]
    p, alpha = detection["p_value"], detection["alpha"]
    if p is None or p >= alpha:
        opening = f"Simulation and measurement agree: {_p_text(detection)}, not below alpha = {alpha:g}."
        return [opening, f"{_size(detection, None)}.", _stand(verdict), _not_shown(verdict)]
    limit = excess = ""
    if tolerance is not None:
        limit = f" (tolerance {100 * tolerance.of_peak:.2g} %)"
        excess = f" (tolerance {200 * tolerance.of_noise:.2g} %)"
    mean = _percent(detection["rms_residual_percent_of_peak"])
    noise = detection["excess_variance_fraction"]
    opening = f"Simulation and measurement differ by more than chance ({_p_value(p)}, alpha = {alpha:g}), but by"
    opening += f" too little to matter: where it is worst by {mean} of the spot's peak in the mean image{limit}"
    opening += f" and by {_percent(None if noise is None else 100 * noise)} of the noise's variance{excess}."
    return [opening, _where(verdict), _stand(verdict), _not_shown(verdict)]


def _explained(verdict: dict[str, Any], _: Limits | None) -> list[str]:
    effects = verdict["effects"]
    count = NUMBERS.get(len(effects), f"{len(effects)} effects")
    named = "is named" if len(effects) == 1 else "are named"
    if verdict["status"] == "ambiguous":
        named = "explains it best" if len(effects) == 1 else "explain it best together"
    listed = f"{count} of the vocabulary {named}: {_list([_effect(own) for own in effects], '; ')}."
    what = "the name" if len(effects) == 1 else "the names"
    return [
        *_disagreement(verdict),
        listed,
        *_rivals(verdict),
        _closed(verdict),
        _moved(verdict),
        _left(verdict),
        CAVEAT.format(what=what),
        _not_shown(verdict),
    ]


def _unknown(verdict: dict[str, Any], _: Limits | None) -> list[str]:
    effects, rest = verdict["effects"], verdict["unexplained"]
    out = _disagreement(verdict)
    if not effects:
        out.append(
            "No effect of the vocabulary, alone or with others, explains it, so nothing is named: something else is at"
            " work, and p1 and p2 may be off because of it."
        )
        return [*out, _stand(verdict), _not_shown(verdict)]
    beside = any(LEFT in why for why in _of_all(verdict))
    if beside:
        out.append("The crops are explained; what lies beside them on the frames is not.")
    else:
        out.append("No set of effects explains it all: brightness and width go from frame to frame as no law of the")
        out.append("model says. Why they do stays open; here each frame was given its own.")
    out.append(f"Part of it is explained by {_list([_effect(own) for own in effects], '; ')}.")
    out += [*_rivals(verdict), _closed(verdict), "" if beside else _freed(verdict), _moved(verdict)]
    share = "" if not rest["share"] else f", {_percent(100 * rest['share'])} of the first excess in the mean images"
    out.append(f"What remains ({_p_value(rest['p_value'])}{share}) is too much to pass, and no effect explains it.")
    return [*out, CAVEAT.format(what="a name"), _not_shown(verdict)]


def _nothing_tested(verdict: dict[str, Any], _: Limits | None) -> list[str]:
    whole = _of_all(verdict)
    return [f"Nothing could be tested: {_list(whole, '; ') or 'no test was possible'}.", _not_shown(verdict)]


def _of_all(verdict: dict[str, Any]) -> list[str]:
    """What keeps every effect alike from being assessed."""
    return [own["why"] for own in verdict["not_assessed"] if own["effect"] == "all"]


def _left_out(verdict: dict[str, Any]) -> str:
    """What the verdict does not rest on, although the dataset has it."""
    return f"Beware: {_list(_of_all(verdict), '; ')}." if _of_all(verdict) else ""


def _disagreement(verdict: dict[str, Any]) -> list[str]:
    """What disagrees, by how much of the peak and of the noise, and where."""
    detection, gap = verdict["detection"], verdict["gap"]
    out = [f"Simulation and measurement disagree: {_p_text(detection)}."]
    out.append(f"{_size(detection, gap)}.")
    out.append(_where(verdict))
    return out


def _size(detection: dict[str, Any], gap: dict[str, Any] | None) -> str:
    """How far mean and noise are off, in the worst condition; and on unseen data against the noise."""
    rms, noise = detection["rms_residual_percent_of_peak"], detection["excess_variance_fraction"]
    if rms:
        out = f"Where it is worst the mean image is off by {_percent(rms)} of the spot's peak (rms, noise taken off)"
    else:
        out = "What the mean images leave does not stand out of the noise in any condition"
    if gap and gap["before"] is not None and gap["noise_floor"]:
        ratio = gap["before"] / gap["noise_floor"]
        if ratio > 1 + NO_GAP:
            out += f"; on {gap['on']} the squared residual is {ratio:.3g} times what noise alone leaves"
    if noise is not None and abs(noise) >= 0.005:
        out += f"; the noise's variance is off by {100 * noise:+.2g} %".replace("-", "−")
    return out


def _where(verdict: dict[str, Any]) -> str:
    """The strongest bin, and which other kinds of trace there are."""
    rows = verdict["where"]
    if not rows:
        return ""
    top = rows[0]
    angle, exposure = top["angle_deg"], top["exposure_s"]
    at = [f"{angle:.4g}°"] if angle is not None else []
    at += [value_text(exposure, None, "s")] if exposure is not None else []
    frames = f"in the frames at {' and '.join(at)}" if at else "over all frames"
    out = f"It is strongest {place_text(top)}, {frames} (z = {top['z']:.3g})".replace("= -", "= −")
    others = list(dict.fromkeys(BLOCKS[row["block"]] for row in rows if row["block"] != top["block"]))
    return out + (f"; it also shows in {_list(others)}." if others else ".")


def _effect(own: dict[str, Any]) -> str:
    numbers = [f"{key} {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()]
    values = f", {', '.join(numbers)}" if numbers else ""
    return f"{own['name']} ({vocabulary()[own['name']].sentence}){values}"


def _rivals(verdict: dict[str, Any]) -> list[str]:
    """Explanations that cannot be told from the first, and the measurements that would."""
    sets = [set(own) for own in verdict["explanations"]]
    if len(sets) < 2:
        return []
    swaps = []
    for other in sets[1:]:
        instead, added = sorted(sets[0] - other), sorted(other - sets[0])
        text = _list([f"{name} ({vocabulary()[name].sentence})" for name in added]) or "less"
        swaps.append(f"{text} in place of {_list(instead)}" if instead else f"{text} besides")
    out = [f"The data cannot tell this from {_list(swaps, '; or ')}."]
    told = [
        f"{own['frames']} frame{'s' if own['frames'] > 1 else ''} at {condition_text(own['condition'])} would tell"
        f" {own['separates'][0]} from {own['separates'][1]}"
        for own in verdict["advice"]
    ]
    if told:
        text = _list(told, "; ")
        out.append(f"{text[0].upper()}{text[1:]}.")
    if len(told) < len(sets) - 1:
        which = "them" if not told else "the others"
        out.append(f"No next measurement was found that would tell {which} apart.")
    return out


def _closed(verdict: dict[str, Any]) -> str:
    gap = verdict["gap"]
    if gap["before"] is None or gap["after"] is None or gap["noise_floor"] is None:
        return ""
    on, floor = gap["on"], gap["noise_floor"]
    if gap["closed"] is None or gap["before"] < floor * (1 + NO_GAP):
        return (
            f"On {on} the mean images fitted already ({gap['before']:.3g}, where noise alone leaves {floor:.3g}): it"
            f" shows in the scatter, and closes no gap in the mean."
        )
    out = f"On {on} the mean squared residual falls from {gap['before']:.3g} to {gap['after']:.3g}, where noise alone"
    out += f" leaves {floor:.3g}: {_share(gap['closed'])} of the gap is closed"
    if gap["rms_dn_before"] is not None and gap["rms_dn_after"] is not None:
        after = f"{gap['rms_dn_after']:.2g} DN" if gap["rms_dn_after"] else "nothing that can be measured"
        out += f" (rms, noise taken off: from {gap['rms_dn_before']:.2g} DN to {after})"
    return out + "."


def _freed(verdict: dict[str, Any]) -> str:
    """What of the gap no effect closes, but that each frame has its own brightness and width."""
    parts = [own["gap_closed"] for own in verdict["effects"]]
    closed = verdict["gap"]["closed"]
    if closed is None or any(own is None for own in parts):
        return ""
    own = closed - sum(parts)
    return f"Of the gap {_share(own)} closes by the frames' own brightness and width alone." if own > 0 else ""


def _moved(verdict: dict[str, Any]) -> str:
    """How p1 and p2 moved when the effects were added."""
    moved, gone, largest = [], [], 0.0
    for name, own in verdict["baseline_shift"].items():
        if own["before"] is None:
            continue
        if own["after"] is None:
            gone.append(name)
            continue
        error = own["stderr"]
        digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 6)) if error else 3
        after = value_text(own["after"], error, own["unit"])
        moved.append(f"{name} from {own['before']:.{digits}f} to {after}".replace("-", "−"))
        largest = max(largest, abs(own["after"] - own["before"]) / error if error else 0.0)
    out = ""
    if moved:
        who, whom = ("the effect", "the effects")[len(verdict["effects"]) > 1], ("it", "them")[len(moved) > 1]
        errors = ("its error", "their errors")[len(moved) > 1]
        end = f": so far {who} had shifted {whom}" if largest > 2 else f", within {errors}"
        out = f"The fit moves {_list(moved)}{end}."
    if gone:
        out += (
            f"{' ' if out else ''}In the extended model {_list(gone)} {'have' if len(gone) > 1 else 'has'} no meaning."
        )
    return out


def _left(verdict: dict[str, Any]) -> str:
    rest, alpha = verdict["unexplained"], verdict["detection"]["alpha"]
    if rest["p_value"] is None:
        return ""
    if rest["p_value"] >= alpha:
        return f"What remains is no more than chance brings ({_p_value(rest['p_value'])})."
    share = "" if not rest["share"] else f", {_percent(100 * rest['share'])} of the first excess in the mean images"
    return f"What remains is more than chance ({_p_value(rest['p_value'])}{share}), but too little to matter."


def _stand(verdict: dict[str, Any]) -> str:
    """p1 and p2 where nothing was added."""
    values = [
        f"{name} = {value_text(own['before'], own['stderr'], own['unit'])}"
        for name, own in verdict["baseline_shift"].items()
        if own["before"] is not None
    ]
    return f"As fitted: {_list(values)}." if values else ""


def _not_shown(verdict: dict[str, Any]) -> str:
    """Effects that could not be assessed, by reason."""
    reasons: dict[str, list[str]] = {}
    for own in verdict["not_assessed"]:
        if own["effect"] != "all":
            reasons.setdefault(own["why"], []).append(own["effect"])
    if not reasons:
        return ""
    return f"Not assessed: {_list([f'{_list(names)} ({why})' for why, names in reasons.items()], '; ')}."


def _p_text(detection: dict[str, Any]) -> str:
    p, count = detection["p_value"], detection["n_simulations"]
    if p is None:
        return "no p-value could be had"
    if p * (1 + count) < 1.5:
        return f"none of {count} sets of frames simulated without any effect looks as odd (p = {p:.2g})"
    return f"p = {p:.2g} among {count} sets of frames simulated without any effect"


def _p_value(p: float | None) -> str:
    return "p unknown" if p is None else f"p = {p:.2g}"


def _percent(value: float | None) -> str:
    if value is None:
        return "an unknown part"
    return f"{value:.2g} %".replace("-", "−")


def _share(part: float) -> str:
    """A closed part in percent, without claiming the last thousandth."""
    percent = 100 * float(np.clip(part, 0.0, 1.0))
    return f"{percent:.3g} %"


def _list(words: Sequence[str], mark: str = "") -> str:
    """`a`, `a and b`, `a, b and c`; with a mark joined by it."""
    if mark or len(words) < 2:
        return mark.join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
