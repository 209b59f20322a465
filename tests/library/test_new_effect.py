"""Mechanisms outside the vocabulary: `unknown` until one file, outside the repository, says what it is; then named."""

import numpy as np
import pytest

from rig import hidden
from spotcheck.discrepancy.calibration import Kind, calibrate, canonical
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.verdict import discovery_design, judge, verdict_json
from spotcheck.pages.effects import SCATTER
from tests.blind.crops import set_of
from tests.blind.judge_case import Nulls
from tests.library import small_verdict as small
from tests.library.effect_cases import knowing, written

COMA = '''"""Coma: the flanks reach further on one side."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Place


def tail(view, half, *, c, direction):
    """Exponent of the shape with ρ over 1 + c ρ² cos(θ − direction)/(1 + ρ²)."""
    theta = np.arctan2(view.y - view.y0, view.x - view.x0) - np.deg2rad(direction)
    return half / (1 + c * 2 * half * np.cos(theta) / (1 + 2 * half)) ** 2


EFFECT = Effect(
    name="coma",
    sentence="the spot's flanks reach further on one side",
    place=Place.PROFILE,
    parameters=(Parameter("c", "1", 0.0, 0.9), Parameter("direction", "deg", -np.inf, np.inf)),
    starts=lambda c: [(0.02, angle) for angle in range(0, 360, 45)],
    function=tail,
)
'''


@pytest.mark.slow
def test_what_was_unknown_is_named_by_one_new_file(tmp_path):
    """Frames of the rig: by name, with the strength that it drew within 4 standard errors (false alarm 6e-5)."""
    case = hidden.draw_case(8, "outside:coma:strong", "one_site")
    seen = set_of(case)

    def verdict():
        # Each vocabulary has a null law of its own.
        null_for = Nulls(tmp_path, 110).null_for
        return verdict_json(judge(seen.shots, seen.setting, seen.kind, null_for, Tolerance()), "8", Tolerance())

    before = verdict()
    assert before["status"] == "unknown" and not before["effects"]
    with knowing(written(tmp_path, "coma", COMA)):
        after = verdict()
    assert after["status"] == "named" and [own["name"] for own in after["effects"]] == ["coma"]
    found, drawn = after["effects"][0]["parameters"]["c"], case.truth["outside"]["settings"]["c"]
    assert abs(found["value"] - drawn) < 4 * found["stderr"]
    assert after["gap"]["closed"] > 0.98


# Brightness of the two modes about their mean.
HOP = 0.04


@pytest.mark.slow
def test_a_scatter_of_ones_own_is_named_by_one_new_file(tmp_path):
    """The page's example. A laser whose power meter rules out that it scatters without order hops between two modes,
    as a coin has it, drawn here: `unknown` without the file, named with it, and its rms within 4 standard errors. These
    are a normal law's; two levels scatter less, so that a false alarm is rarer than 6e-5.

    Where free brightness is not ruled out the two leave the same trace, and both are answers.
    """
    coin = np.random.default_rng(5)

    def hopping(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + HOP * coin.choice((-1, 1)))

    shots, _, setting = small.frames(hopping, repeats=8)
    kind = Kind(small.SIDE, 10, "linear", False)
    # What only scatters enters no statistic: one law serves all vocabularies.
    null = calibrate(canonical(discovery_design(shots)[0]), kind, 110, 1)
    file = written(tmp_path, "mode_hopping", SCATTER)

    def verdict():
        return verdict_json(judge(shots, setting, kind, lambda design, kind: null, Tolerance()), "hops", Tolerance())

    with knowing(without=["power_fluctuation"]):
        before = verdict()
    assert before["status"] == "unknown" and not before["effects"]
    with knowing(file, without=["power_fluctuation"]):
        after = verdict()
    assert after["status"] == "named" and after["explanations"] == [["mode_hopping"]]
    found = after["effects"][0]["parameters"]["rms"]
    assert found["unit"] == "1" and abs(found["value"] - HOP) < 4 * found["stderr"]
    assert after["gap"]["closed"] > 0.98
    with knowing(file):
        both = verdict()
    assert both["status"] == "ambiguous"
    assert {frozenset(own) for own in both["explanations"]} == {
        frozenset(["power_fluctuation"]),
        frozenset(["mode_hopping"]),
    }
