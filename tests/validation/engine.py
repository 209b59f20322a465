"""What only the inside of the present verdict engine tells of a data set. ENGINE: all that validation knows of
`spotcheck.discrepancy` is here, and goes with it; records without it are scored on the rest.

How well a model does that is told which effects there are, how well they can be told apart, and what comes of advice.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rig import hidden
from spotcheck import dataset, store
from spotcheck.cli.judged import findings_of, open_set
from spotcheck.discrepancy.advise import APART, Condition, conditions_for, pedestal_of
from spotcheck.discrepancy.assess import assessable
from spotcheck.discrepancy.explain import Account, account, is_component
from spotcheck.discrepancy.extend import Findings, about, closer_account
from spotcheck.discrepancy.isolability import isolation
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.shots import Shot, design_of, held_out
from spotcheck.discrepancy.verdict import parameters_of
from spotcheck.discrepancy.verify import verify
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import reading
from tests.validation.judge import PATIENCE, said, within
from tests.validation.outcome import CLEAR
from tests.validation.protocol import Job, Judge, Record

# Where isolation is worth its time: signal-to-noise of the truth.
STRONG = 90.0
# Null sets for a larger design: enough for p below 1 %, as what is asked is which names are left.
NULLS = 110


def beside(job: Job, case: hidden.Case, folder: Path, results: Path, judge: Judge) -> Record:
    """`told` and `advised` of a judged data set of the rig. Where that fails it is validation's failure, not the
    verdict's: the record says why."""
    saved = json.loads((results / "findings.json").read_text(encoding="utf-8"))
    if "why" in saved:
        return {}
    with store.read(results / "crops.nc") as crops, store.read(results / "sensor.nc") as sensor:
        ready = open_set(dataset.load(str(folder)), crops, sensor)
        assert not isinstance(ready, str)  # or there would be no findings
        found = findings_of(saved, ready)
        out = {"told": _tried(told_truth, found, ready.shots, case.truth["effects"])}
        if job.kind.startswith("one") and found.status == "ambiguous":
            out["advised"] = _tried(followed, found, case, results, judge)
    return out


def _tried(measure: Callable[..., Any], *of: Any) -> Any:
    try:
        with within(PATIENCE):
            return json.loads(json.dumps(measure(*of), allow_nan=False))
    except Exception as error:
        return {"error": said(error)}


def told_truth(found: Findings, shots: Sequence[Shot], entries: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Gap closed, parameters with errors, and the nearest rival of a model that is told the true effects; None where
    there are none."""
    if not entries:
        return None
    own = account_of(found.look, entries)
    out: dict[str, Any] = {}
    near, exact = found.look, own
    if found.explanations:
        near = about(shots_of_discovery(shots), found.look, own)
        exact = closer_account(near, own)
        out["closed"] = closed_by(found, own, exact, shots)
        best = found._replace(best=(near, exact))
        out["parameters"] = {name: parameters_of(best, name) for name in own.names}
    if len(entries) == 1 and entries[0]["snr"] >= STRONG:
        rivals = isolation_of(found, own, near, exact)
        out["rival"] = min(rivals, key=rivals.__getitem__, default=None)
        out["isolation"] = rivals.get(out["rival"])
    return out


def followed(found: Findings, case: hidden.Case, results: Path, judge: Judge) -> dict[str, Any]:
    """What the first piece of advice leads to: the frames are made, and all is judged once more."""
    advice = json.loads((results / "advice.json").read_text(encoding="utf-8"))
    if not advice:
        return {"frames": None}
    condition, frames = Condition(**advice[0]["condition"]), advice[0]["frames"]
    first, rival = (found.explanations[k] for k in advice[0]["pair"])
    needed = {condition: frames for condition, frames, _ in conditions_for(found.look, first, rival)}
    if condition.blocked:
        left = _dark(found, case, condition, frames)
    else:
        folder = results / "more"
        more = hidden.with_more(case, condition.angle_deg, condition.exposure_s, frames)
        hidden.write(more, folder, results / "more.json")
        left = judge(folder, results / "again", null_sets=NULLS)["explanations"]
    return {
        "condition": condition._asdict(),
        "frames": frames,
        "pair": [list(first.names), list(rival.names)],
        "left": [sorted(names) for names in left],
        "needed": needed[condition],
        # What chance would have cost: frames of every feasible condition.
        "any": [frames if frames < float("inf") else None for frames in needed.values()],
    }


def _dark(found: Findings, case: hidden.Case, condition: Condition, number: int) -> list[tuple[str, ...]]:
    """Explanations whose pedestal the frames with the beam blocked show: a person reads their mean."""
    frames = np.array(hidden.blocked(case, condition.exposure_s, number), float)
    error = frames.std() / np.sqrt(frames.size)
    sensor = found.look.setting.sensor
    expected = [float(reading(pedestal_of(own), condition.exposure_s, sensor).mean) for own in found.explanations]
    off = [((frames.mean() - mean) / error) ** 2 for mean in expected]
    return [own.names for own, value in zip(found.explanations, off, strict=True) if value < min(off) + APART]


def account_of(look: Look, entries: Sequence[dict[str, Any]]) -> Account:
    """The best account of the true effects, from their true parameters, over the library's forms and, for constants
    that the truth does not hold, over its starts."""
    trials = [_presents(look, entry) for entry in entries]
    chosen = [own[0] for own in trials]
    best = account(look, chosen)
    for k, others in enumerate(trials):
        for other in others[1:]:
            trial = [*chosen[:k], other, *chosen[k + 1 :]]
            found = account(look, trial)
            if found.score < best.score:
                best, chosen = found, trial
    return best


def _presents(look: Look, entry: dict[str, Any]) -> list[Present]:
    effect, given = vocabulary()[entry["name"]], dict(entry["parameters"])
    if "order" in entry["form"] and effect.name == "saturation":
        # The rig's soft clip is our `power`.
        given["knee"] = 1 / entry["form"]["order"]
    starts = list(effect.starts(look.problem.context)) or [tuple(0.0 for _ in effect.parameters)]
    values = [
        tuple(float(given.get(p.name, value)) for p, value in zip(effect.parameters, start, strict=True))
        for start in starts
    ]
    forms = effect.forms[:1] if is_component(effect) else effect.forms
    if "clips" in entry["form"]:
        behind = entry["form"]["clips"] == "after read noise"
        forms = tuple(form for form in forms if form.endswith("with noise") == behind)
    return [Present(effect, form, own) for form in forms for own in dict.fromkeys(values)]


def closed_by(found: Findings, own: Account, exact: Account, shots: Sequence[Shot]) -> float | None:
    """Part of the gap on unseen data that the account closes, at a first and at a closer look."""
    whole = design_of(shots)
    out = np.flatnonzero(held_out(whole.repeat))
    unseen = [shots[int(k)] for k in out]
    gap = verify(found.look, found.base, [own], unseen, whole.take(out) if len(out) else None, exact)
    return float(gap.closed) if np.isfinite(gap.closed) else None


def shots_of_discovery(shots: Sequence[Shot]) -> list[Shot]:
    """The frames that may choose the model."""
    held = held_out(design_of(shots).repeat)
    return [shot for shot, out in zip(shots, held, strict=True) if not out]


def isolation_of(found: Findings, own: Account, near: Look, exact: Account) -> dict[str, float]:
    """−2 ln L by which every rival falls behind an account at a look, if that is the truth. Those that contain it do
    not count: the simplest wins. Where all fall far behind on the data themselves, that is told: it is much faster."""
    contains = {
        more.name for more in vocabulary().values() for single, _ in own.effects if more.has_as_special_case(single)
    }
    contains |= {"", *own.names}
    rivals = {name: score - (own.score - found.base.score) for name, (score, _) in found.evidence.items()}
    if not rivals or min((v for k, v in rivals.items() if k not in contains), default=0.0) < CLEAR:
        rivals = isolation(near, exact, assessable(found.look)[0])
    return {name: float(delta) for name, delta in rivals.items() if name not in contains}
