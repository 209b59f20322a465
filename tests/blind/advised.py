"""Whether frames that a verdict asks for tell apart what it could not: they are made, and all is judged once more."""

from typing import Any

import numpy as np

from rig import hidden
from spotcheck.discrepancy.advise import APART, Advice, conditions_for, pedestal_of
from spotcheck.discrepancy.calibration import calibrate
from spotcheck.discrepancy.explain import Account
from spotcheck.discrepancy.extend import Findings, Tolerance
from spotcheck.discrepancy.verdict import Judgement, judge
from spotcheck.model.sensor import reading
from tests.blind.crops import set_of

# Null sets for the larger design: enough for p below 1 %, as what is asked is which names are left.
NULLS, SEED = 110, 4242


def followed(judgement: Judgement, case: hidden.Case, tolerance: Tolerance) -> dict[str, Any]:
    """What the first piece of advice leads to; without advice nothing but that."""
    found = judgement.findings
    assert found is not None  # something is tied
    if not judgement.advice:
        return {"frames": None}
    advice = judgement.advice[0]
    first, rival = (found.explanations[k] for k in advice.pair)
    left = _dark(found, case, advice) if advice.condition.blocked else _judged(case, advice, tolerance)
    needed = {condition: frames for condition, frames, _ in conditions_for(found.look, first, rival)}
    return {
        "condition": advice.condition._asdict(),
        "frames": advice.frames,
        "pair": [list(first.names), list(rival.names)],
        "left": [sorted(own.names) for own in left],
        "needed": needed[advice.condition],
        # What chance would have cost: frames of every feasible condition.
        "any": [frames if frames < float("inf") else None for frames in needed.values()],
    }


def _judged(case: hidden.Case, advice: Advice, tolerance: Tolerance) -> list[Account]:
    """Explanations of the whole data set with the frames that were asked for."""
    seen = set_of(hidden.with_more(case, advice.condition.angle_deg, advice.condition.exposure_s, advice.frames))
    again = judge(seen.shots, seen.setting, seen.kind, lambda *of: calibrate(*of, NULLS, SEED), tolerance).findings
    return list(again.explanations) if again else []


def _dark(found: Findings, case: hidden.Case, advice: Advice) -> list[Account]:
    """Explanations whose pedestal the frames with the beam blocked show: a person reads their mean."""
    frames = np.array(hidden.blocked(case, advice.condition.exposure_s, advice.frames), float)
    error = frames.std() / np.sqrt(frames.size)
    t, sensor = advice.condition.exposure_s, found.look.setting.sensor
    expected = [float(reading(pedestal_of(own), t, sensor).mean) for own in found.explanations]
    off = [((frames.mean() - mean) / error) ** 2 for mean in expected]
    return [own for own, value in zip(found.explanations, off, strict=True) if value < min(off) + APART]
