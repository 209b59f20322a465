"""The whole judgement of one set of frames, and verdict.json as the dataset contract has it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.advise import Advice, advise
from spotcheck.discrepancy.base import Base, base_of, spots_of
from spotcheck.discrepancy.calibration import Kind
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import Null
from spotcheck.discrepancy.explain import Account, account
from spotcheck.discrepancy.extend import Findings, Tolerance, investigate
from spotcheck.discrepancy.freed_named import gap_of_freed
from spotcheck.discrepancy.name import present_of
from spotcheck.discrepancy.noise import hot_pixels
from spotcheck.discrepancy.saved import recalled, saved_of
from spotcheck.discrepancy.shots import Design, Shot, design_of, held_out, together
from spotcheck.discrepancy.stripes import beside_places, depth_error
from spotcheck.discrepancy.verify import Gap, verify
from spotcheck.model.effect import Place, Present
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel


class Judgement(NamedTuple):
    """Findings on the frames that chose the model, the gap on unseen data (None: nothing was added), advice; or why
    nothing could be tested."""

    findings: Findings | None
    gap: Gap | None
    advice: list[Advice]
    why_not: str


def discovery_design(shots: Sequence[Shot]) -> tuple[Design, np.ndarray]:
    """Design of the frames that may choose the model, and their indices."""
    design = design_of(shots)
    keep = np.flatnonzero(~held_out(design.repeat))
    return design.take(keep), keep


def judge(
    shots: Sequence[Shot],
    setting: Setting,
    kind: Kind,
    null_of: Callable[[Design, Kind], Null],
    tolerance: Tolerance,
) -> Judgement:
    """All steps; frames that are kept unseen are opened last."""
    shots, _ = together(shots, kind.crop_px)
    ready = prepared(shots, setting, kind)
    if isinstance(ready, str):
        return Judgement(None, None, [], ready)
    chosen, design, base = ready
    found = investigate(chosen, design, base, setting, null_of(design, kind), tolerance)
    if not found.explanations and found.freed is None:
        return Judgement(found, None, [], "")
    # As from the file that the loop writes: so every way to a verdict gives the same one.
    found = recalled(saved_of(found), chosen, design, base, setting)
    gap = gap_of(found, shots)
    advice = advise(found.look, found.explanations) if len(found.explanations) > 1 else []
    return Judgement(found, gap, advice, "")


def prepared(shots: Sequence[Shot], setting: Setting, kind: Kind) -> tuple[list[Shot], Design, Base] | str:
    """The frames that may choose the model, their design and base; or why there is none."""
    if not shots:
        return "there is no usable spot frame"
    design, keep = discovery_design(shots)
    chosen = [shots[k] for k in keep]
    spots = spots_of(chosen, setting.sensor, setting.baseline.top_hat)
    corners = np.array([(s.left, s.top) for s in chosen], float)
    base = base_of(spots, corners, design, setting.baseline, kind.crop_px)
    if base is not None:
        return chosen, design, base
    wide = bool((spots[:, 3] >= criteria.WIDEST.value * kind.crop_px).any())
    return "no spot could be fitted in any frame" + (": it is as wide as its crop" if wide else "")


def gap_of(found: Findings, shots: Sequence[Shot]) -> Gap | None:
    """The gap on frames that were kept unseen, or where there are none by the contract's other splits."""
    whole = design_of(shots)
    out = np.flatnonzero(held_out(whole.repeat))
    unseen = [shots[int(k)] for k in out]
    design = whole.take(out) if len(out) else None
    if found.freed is not None:
        return gap_of_freed(found.freed, found.base, found.look, unseen, design)
    exact = found.best[1] if found.best else None
    return verify(found.look, found.base, stages_of(found), unseen, design, exact)


def stages_of(found: Findings) -> list[Account]:
    """Accounts of the best explanation's first effect, first two, …, in the order in which they close most."""
    best = found.explanations[0]
    present = present_of(best)
    out: list[Account] = []
    order: list = []
    rest = list(present)
    while len(rest) > 1:
        tried = [account(found.look, (*order, own), best.refit.model) for own in rest]
        k = int(np.argmin([t.score for t in tried]))
        order.append(rest.pop(k))
        out.append(tried[k])
    return [*out, account(found.look, (*order, *rest), best.refit.model)]


def verdict_json(judgement: Judgement, name: str, tolerance: Tolerance) -> dict[str, Any]:
    """verdict.json without its sentence. What could not be computed is None."""
    found, gap = judgement.findings, judgement.gap
    if found is None:
        return _empty(name, tolerance, judgement.why_not)
    size = found.size
    stages = stages_of(found) if found.explanations else []
    names = [own.names for own in found.explanations]
    if found.freed is not None:
        names = [found.freed.names]
    ordered = list(found.freed.names if found.freed is not None else stages[-1].names if stages else ())
    effects = []
    for k, own in enumerate(ordered):
        effects.append(
            {
                "name": own,
                "candidates": _candidates(own, names),
                "parameters": parameters_of(found, own),
                "gap_closed": _number(gap.parts[k] if gap and k < len(gap.parts) else None),
            }
        )
    return {
        "schema": 1,
        "dataset": name,
        "status": found.status,
        "detection": {
            "p_value": found.detection.p_value,
            "n_simulations": found.detection.n_simulations,
            "alpha": tolerance.alpha,
            "rms_residual_percent_of_peak": _number(100 * size.of_peak),
            "excess_variance_fraction": _number(size.excess_variance),
        },
        "where": [],
        "effects": effects,
        "explanations": [ordered, *([list(n) for n in names[1:]])] if effects else [],
        "baseline_shift": shift_of(found),
        "unexplained": {
            "p_value": found.rest.p_value,
            "share": _number(_share(found)),
        },
        "gap": _gap(gap),
        "advice": _advice(judgement, names),
        "not_assessed": [{"effect": effect, "why": why} for effect, why in found.not_assessed.items()],
        "sentence": "",
    }


def _candidates(own: str, names: list[tuple[str, ...]]) -> list[str]:
    """An effect and those that stand in its place in other explanations."""
    best = set(names[0])
    out = [own]
    for other in map(set, names[1:]):
        if own not in other and len(best - other) == 1:
            out += sorted(other - best)
    return list(dict.fromkeys(out))


def parameters_of(found: Findings, name: str) -> dict[str, dict[str, Any]]:
    """Parameters of an effect of the best explanation, with standard errors and units; those of the form left out."""
    if found.freed is not None:
        return _freed_parameters(found, name)
    assert found.best is not None
    own = found.best[1]
    if name not in (fitted := _fitted(own)):
        return _scatter_parameters(found, own, name)
    present, errors = fitted[name]
    if present.effect.place is Place.NOISE:
        errors[0] = own.component_error["read"]
    if present.effect.spectral and present.form == "site":
        depth, period, direction = present.values[:3]
        errors[0] = depth_error(depth, beside_places(found.best[0].measured, period, direction)[1])
    if present.form in present.effect.rounded:
        # A closer look leaves out what repeats one number, and that may be what tells it.
        first = _fitted(found.explanations[0])[name]
        present, errors = first if first[1][0] < errors[0] else (present, errors)
    return _reported(present, errors, found.look.setting.sensor) | _scatter_parameters(found, own, name)


def _fitted(own: Account) -> dict[str, tuple[Present, list[float]]]:
    """Every effect of the joint fit by name, with the standard errors of its parameters; NaN for those that its form
    does not have."""
    at, out = 0, {}
    for present in own.refit.model.present:
        idle = present.effect.idle.get(present.form, ())
        errors = []
        for parameter in present.effect.parameters:
            moving = parameter.name not in idle
            errors.append(float(np.sqrt(max(own.refit.covariance[at, at], 0.0))) if moving else np.nan)
            at += moving
        out[present.effect.name] = present, errors
    return out


def _freed_parameters(found: Findings, name: str) -> dict[str, dict[str, Any]]:
    assert found.freed is not None
    pairs = zip(found.freed.present, found.freed.errors, strict=True)
    present, errors = next(own for own in pairs if own[0].effect.name == name)
    return _reported(present, errors, found.look.setting.sensor)


def _reported(present: Present, errors: Sequence[float | None], sensor: SensorModel) -> dict[str, dict[str, Any]]:
    """Values, standard errors and units of an effect's parameters. A strength that readings show as a whole number
    lies anywhere about that."""
    values, errors = list(present.values), list(errors)
    if present.form in present.effect.rounded:
        values[0] = round(values[0] + sensor.black_level_dn) - sensor.black_level_dn
        errors[0] = float(np.hypot(errors[0] or 0.0, np.sqrt(ROUNDING_VARIANCE)))
    # A fit may leave a direction some turns on.
    turned = [v % 360 if p.unit == "deg" else v for p, v in zip(present.effect.parameters, values, strict=True)]
    rows = zip(present.effect.parameters, turned, errors, strict=True)
    return {p.name: {"value": float(v), "stderr": _number(e), "unit": p.unit} for p, v, e in rows if not p.inner}


def _scatter_parameters(found: Findings, own: Account, name: str) -> dict[str, dict[str, Any]]:
    """What a variance component tells of an effect's parameters, in their order."""
    effect = next(effect for effect, _ in own.effects if effect.name == name)
    if not effect.component:
        return {}
    value, error = (part.get(effect.component, 0.0) for part in (own.component, own.component_error))
    root = float(np.sqrt(max(value, 0.0)))
    told: list[tuple[float, float | None]] = [(root, error / (2 * root) if root > 0 else None)]
    if effect.component == "grain":
        told.append((own.grain, own.component_error["size"]))
    if effect.component == "pixel":
        told.append((hot_pixels(found.look.measured, root), None))
    return {
        parameter.name: {"value": value, "stderr": _number(error), "unit": parameter.unit}
        for parameter, (value, error) in zip(effect.parameters, told, strict=True)
    }


def shift_of(found: Findings) -> dict[str, Any]:
    """p1 and p2 before and after the effects were added."""
    out: dict[str, dict[str, Any]] = {}
    before = found.base.refit
    after = found.best[1].refit if found.best else None
    for name in ("p1", "p2"):
        one = len(np.unique(found.look.cells.view.exposure_s)) == 1
        law = hasattr(before.model.base, name)
        if not law or (one and name == "p1"):
            out[name] = {"before": None, "after": None, "stderr": None, "unit": "px"}
            continue
        if found.freed is not None:
            value, error = getattr(found.freed, name) or (None, None)
            out[name] = {"before": float(getattr(before.model.base, name)), "after": value, "stderr": error,
                         "unit": "px"}  # fmt: skip
            continue
        own = after or before
        replaced = {r for p in own.model.present for r in p.effect.replaces}
        moving = [n for n in ("p1", "p2", "peak") if n not in replaced and not (n == "p1" and one)]
        count = sum(len(p.effect.parameters) - len(p.effect.idle.get(p.form, ())) for p in own.model.present)
        value = None if name in replaced or after is None else float(getattr(after.model.base, name))
        at = count + moving.index(name) if name in moving else None
        error = float(np.sqrt(max(own.covariance[at, at], 0.0))) if at is not None else None
        out[name] = {"before": float(getattr(before.model.base, name)), "after": value, "stderr": _number(error),
                     "unit": "px"}  # fmt: skip
    return out


def _share(found: Findings) -> float | None:
    """Part of the first excess χ² that is left."""
    used = float(found.look.problem.used.sum())
    excess = found.base.refit.chi2 - used
    if excess <= 0:
        return None
    after = found.best[1].refit if found.best else found.left.refit if found.left else found.base.refit
    left = after.chi2 - used
    return float(np.clip(left / excess, 0.0, 1.0))


def _gap(gap: Gap | None) -> dict[str, Any]:
    keys = ("before", "after", "noise_floor", "closed", "rms_dn_before", "rms_dn_after")
    if gap is None:
        return dict.fromkeys(keys) | {"on": None}
    return {key: _number(getattr(gap, key)) for key in keys} | {"on": gap.on}


def _advice(judgement: Judgement, names: list[tuple[str, ...]]) -> list[dict[str, Any]]:
    out = []
    for own in judgement.advice:
        first, second = (set(names[k]) for k in own.pair)
        exposure_s, angle_deg, blocked = own.condition
        condition = {"exposure_s": exposure_s} | ({"blocked": True} if blocked else {"angle_deg": angle_deg})
        pair = [" + ".join(sorted(first - second)) or "less", " + ".join(sorted(second - first)) or "less"]
        out.append({"condition": condition, "separates": pair, "frames": own.frames})
    return out


def _empty(name: str, tolerance: Tolerance, why: str) -> dict[str, Any]:
    nothing = {"before": None, "after": None, "stderr": None, "unit": "px"}
    return {
        "schema": 1,
        "dataset": name,
        "status": "not_assessed",
        "detection": {"p_value": None, "n_simulations": 0, "alpha": tolerance.alpha,
                      "rms_residual_percent_of_peak": None, "excess_variance_fraction": None},
        "where": [],
        "effects": [],
        "explanations": [],
        "baseline_shift": {"p1": nothing, "p2": dict(nothing)},
        "unexplained": {"p_value": None, "share": None},
        "gap": _gap(None),
        "advice": [],
        "not_assessed": [{"effect": "all", "why": why}],
        "sentence": "",
    }  # fmt: skip


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
