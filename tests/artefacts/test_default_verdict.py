"""The verdict on the default dataset, beside what its rig put in. As a scorer, this file may read that.

Runs where the default dataset was judged; nothing is made for it.
"""

import json

import numpy as np
import pytest

from spotcheck.dataset.instrument import read_instrument
from spotcheck.discrepancy.written import breach_of_verdict
from spotcheck.model.baseline import build_baseline
from tests.conftest import ROOT

DATASET, RESULTS = ROOT / "data" / "virtual-rig", ROOT / "results" / "virtual-rig"
# Effects that the verdict must name, by the contract's names.
REQUIRED = {"saturation", "fibre_anisotropy", "speckle", "photon_budget", "site_variation"}
# Effects that the rig put in, but that the verdict need not name; one pattern of speckle belongs to the sensor.
PERMITTED = {"angle_reflectance", "fixed_pattern"}
# Level of the clip [DN].
LEVEL_DN = 757.1
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


def test_verdict_names_what_the_rig_put_in(verdict):
    named = {effect["name"] for effect in verdict["effects"]}
    assert named >= REQUIRED and named <= REQUIRED | PERMITTED
    assert verdict["status"] in ("named", "named_more_remains", "ambiguous") and breach_of_verdict(verdict) is None


def test_parameters_are_near_the_truth(verdict, truth):
    """The level and the ratio must lie within 1 % of the truth; every seventh row clips 4.4 % higher."""
    values = {effect["name"]: effect["parameters"] for effect in verdict["effects"]}
    assert values["saturation"]["level"]["value"] == pytest.approx(LEVEL_DN, rel=0.01)
    sites = [site for site in truth["sites"] if site["kind"] == "spot"]
    ratio = np.mean([site["sigma_long_px"] / site["sigma_short_px"] for site in sites])
    assert values["fibre_anisotropy"]["ratio"]["value"] == pytest.approx(ratio, rel=0.01)
    assert CONTRAST[0] < values["speckle"]["contrast"]["value"] < CONTRAST[1]


def test_p1_and_p2_agree_with_the_truth_within_their_errors(verdict, truth):
    """The width does not depend on the exposure, and p2 is the mean width of the sites less that of the laser.

    The declared model alone is far off both. The frames are fixed: two normal estimates are beyond four standard errors
    with a probability of 1.3e-4.
    """
    instrument = read_instrument(DATASET / "instrument.yaml")
    sites = [site for site in truth["sites"] if site["kind"] == "spot"]
    widths = [np.sqrt(site["sigma_long_px"] * site["sigma_short_px"]) for site in sites]
    p2 = np.mean(widths) - build_baseline(instrument, (1e-4, 9e-4)).laser_px
    for name, true in (("p1", 0.0), ("p2", p2)):
        row = verdict["baseline_shift"][name]
        assert abs(row["after"] - true) < 4 * row["stderr"], name
        assert abs(row["before"] - true) > 10 * row["stderr"], name


def test_sentence_says_what_is_named(verdict):
    """A part of the gap stays open: brightness and width depend on angle and site as no effect describes."""
    lines = verdict["sentence"].splitlines()
    assert len(lines) <= 3 and "saturation" in verdict["sentence"]
    # p1 and p2 are quoted with the effects unless these have rivals.
    assert ("The fitted p1 changes from" in verdict["sentence"]) == (verdict["status"] != "ambiguous")
    assert verdict["gap"]["closed"] > 0.95
