"""Whether frames that a verdict asks for tell apart what it could not: they are made, and all is judged once more."""

from typing import Any

from rig import hidden
from spotcheck.discrepancy.advise import conditions_for
from spotcheck.discrepancy.calibration import calibrate
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.verdict import Judgement, judge
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
    more = hidden.with_more(case, advice.condition.angle_deg, advice.condition.exposure_s, advice.frames)
    seen = set_of(more)
    again = judge(seen.shots, seen.setting, seen.kind, lambda *of: calibrate(*of, NULLS, SEED), tolerance).findings
    left = [frozenset(own.names) for own in again.explanations] if again else []
    return {
        "condition": advice.condition._asdict(),
        "frames": advice.frames,
        "pair": [list(first.names), list(rival.names)],
        "status": again.status if again else "not_assessed",
        "left": [sorted(own) for own in left],
        # What chance would have cost: frames of every feasible condition.
        "any": [frames if frames < float("inf") else None for _, frames, _ in conditions_for(found.look, first, rival)],
    }
