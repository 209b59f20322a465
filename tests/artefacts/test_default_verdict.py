"""The verdict on the default dataset, beside what its rig put in. As a scorer, this file may read that.

Runs where the default dataset was judged; nothing is made for it.
"""

import json

import numpy as np
import pytest

from spotcheck.instrument import read_instrument
from spotcheck.old_engine.model.baseline import of_instrument
from spotcheck.old_engine.verdict.written import breach_of_verdict
from tests.conftest import ROOT

DATASET, RESULTS = ROOT / "data" / "virtual-rig", ROOT / "results" / "virtual-rig"
# What the rig put in, by the contract's names. Brightness follows angle and site, and width the angle, as no effect of
# the vocabulary says.
PUT_IN = {"saturation", "fibre_anisotropy", "speckle", "angle_reflectance", "photon_budget"}
# Contrast of two added patterns, 1/√2, less what a pixel's area averages away.
CONTRAST = (0.57, 0.71)


@pytest.fixture(scope="module")
def truth():
    """What the rig put in."""
    return json.loads((DATASET / "truth.json").read_text())


@pytest.fixture(scope="module")
def verdict():
    """The verdict of the last run."""
    path = RESULTS / "verdict.json"
    if not path.exists():
        pytest.skip("the default dataset was not judged here")
    return json.loads(path.read_text())


def test_names_are_those_that_the_rig_put_in(verdict):
    """The two that a person sees come first; nothing is named that is not there."""
    named = [own["name"] for own in verdict["effects"]]
    assert set(named[:2]) == {"saturation", "fibre_anisotropy"} and set(named) <= PUT_IN
    assert verdict["status"] in ("named", "named_more_remains", "ambiguous") and breach_of_verdict(verdict) is None


def test_parameters_are_near_the_truth(verdict, truth):
    """Level within 1 % (every seventh row stops 4.4 % higher), ratio within 1 %, contrast at pixels within 5 %."""
    values = {own["name"]: own["parameters"] for own in verdict["effects"]}
    sensor = truth["settings"]["sensor"]
    level = truth["derived"]["clip_level_dn"] * (1 + sensor["clip_row_step"] / sensor["clip_row_period_px"])
    assert values["saturation"]["level"]["value"] == pytest.approx(level, rel=0.01)
    sites = [own for own in truth["sites"] if own["kind"] == "spot"]
    ratio = np.mean([own["sigma_long_px"] / own["sigma_short_px"] for own in sites])
    assert values["fibre_anisotropy"]["ratio"]["value"] == pytest.approx(ratio, rel=0.01)
    assert CONTRAST[0] < values["speckle"]["contrast"]["value"] < CONTRAST[1]


def test_p1_and_p2_agree_with_the_truth_within_their_errors(verdict, truth):
    """Width does not depend on exposure, and p2 is the sites' mean width less the laser's; both were far off."""
    instrument = read_instrument(DATASET / "instrument.yaml")
    sites = [own for own in truth["sites"] if own["kind"] == "spot"]
    widths = [np.sqrt(own["sigma_long_px"] * own["sigma_short_px"]) for own in sites]
    p2 = np.mean(widths) - of_instrument(instrument, (1e-4, 9e-4)).laser_px
    for name, true in (("p1", 0.0), ("p2", p2)):
        own = verdict["baseline_shift"][name]
        assert abs(own["after"] - true) < 2.5 * own["stderr"], name
        assert abs(own["before"] - true) > 10 * own["stderr"], name


def test_sentence_says_what_is_named_and_what_moved(verdict):
    """What stays open of the gap are brightness and width that follow angle and site as no effect says."""
    lines = verdict["sentence"].splitlines()
    assert len(lines) <= 3 and "saturation" in lines[1] and "p1 goes from" in verdict["sentence"]
    assert verdict["gap"]["closed"] > 0.95
