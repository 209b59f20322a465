"""A mechanism outside the vocabulary, made by the rig: `unknown` until one file says what it is, then named."""

import pytest

from rig import hidden
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.verdict import discovery_design, judge, verdict_json
from tests.library.effect_cases import one_file_more
from tests.library.hidden_set import set_of
from tests.library.null_laws import null_law

COMA = '''"""Coma: the flanks reach further on one side."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Place


def tail(view, half, *, c, direction):
    """Exponent of the shape with ρ over 1 + c ρ² cos(θ − direction)/(1 + ρ²)."""
    theta = np.arctan2(view.y - view.y0, view.x - view.x0) - np.deg2rad(direction)
    return half / (1 + c * 2 * half * np.cos(theta) / (1 + 2 * half)) ** 2


EFFECT = Effect(
    number=25,
    name="coma",
    sentence="the spot's flanks reach further on one side",
    place=Place.PROFILE,
    parameters=(Parameter("c", "1", 0.0, 0.9), Parameter("direction", "deg", -np.inf, np.inf)),
    starts=lambda c: [(0.02, angle) for angle in range(0, 360, 45)],
    function=tail,
)
'''


@pytest.mark.slow
def test_what_was_unknown_is_named_by_one_new_file(tmp_path, laws):
    """By name, with the strength that the rig drew within 4 standard errors (false alarm 6e-5)."""
    case = hidden.draw_case(8, "outside:coma:strong", "one_site")
    seen = set_of(case)
    null = null_law(laws, discovery_design(seen.shots)[0], seen.kind)

    def verdict():
        return verdict_json(judge(seen.shots, seen.setting, seen.kind, lambda *_: null, Tolerance()), "8", Tolerance())

    before = verdict()
    assert before["status"] == "unknown" and not before["effects"]
    with one_file_more(tmp_path, "coma", COMA):
        after = verdict()
    assert after["status"] == "named" and [own["name"] for own in after["effects"]] == ["coma"]
    found, drawn = after["effects"][0]["parameters"]["c"], case.truth["outside"]["settings"]["c"]
    assert abs(found["value"] - drawn) < 4 * found["stderr"]
    assert after["gap"]["closed"] > 0.98
