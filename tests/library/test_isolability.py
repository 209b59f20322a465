"""What a design can tell apart: strengths that are reached, rivals that are and are not."""

import numpy as np
import pytest

from spotcheck.discrepancy.asimov import APART, asimov
from spotcheck.discrepancy.calibration import Kind, null_look
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.isolability import _as_deep, _at_strength, isolability
from spotcheck.discrepancy.shots import Shot, design_of
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary

GRID = [(a, t, r) for a in (0.0, 45.0, 90.0) for t in (1e-4, 3e-4, 9e-4) for r in range(4)]


def noise_of(budget: str):
    """Noise of a design of three angles, three exposures and four repeats."""
    shots = [Shot(a, t, r, k, (), 0, 0, lambda: np.zeros((1, 1))) for k, (a, t, r) in enumerate(GRID)]
    return null_look(design_of(shots), Kind(96, 10, budget, False), 1, 0)


@pytest.fixture(scope="module")
def look():
    """Light that grows with exposure."""
    return noise_of("linear")


@pytest.mark.parametrize(
    ("name", "rival"),
    [
        ("super_gaussian", "nonlinearity"),
        ("smear", "dark_offset"),
        ("laser_drift", "power_fluctuation"),
        ("row_noise", "excess_read_noise"),
        ("power_fluctuation", "laser_drift"),
        ("pointing_jitter", "speckle"),
        ("speckle", "fixed_pattern"),
        ("fixed_pattern", "speckle"),
    ],
)
def test_strength_is_reached(look, name, rival):
    """Effects of the mean and of the noise come to the signal-to-noise asked for: within 10 % on the way there, and
    some more by the last fit."""
    effects = [vocabulary()[own] for own in (name, rival, "photon_budget")]
    found = isolability(look, effects[0], effects, 50.0)
    assert found.effect == name
    assert found.snr == pytest.approx(50.0, rel=0.2)
    assert 0 <= found.apart <= 1.2 * found.snr


def test_what_contains_an_effect_is_no_rival(look):
    """Free gains explain a drift, and a gradient a pedestal; neither is a rival of it."""
    known = vocabulary()
    for name, whole in (("laser_drift", "power_fluctuation"), ("dark_offset", "background_gradient")):
        found = isolability(look, known[name], [known[own] for own in (name, whole, "spread_law")], 50.0)
        assert found.rival == "spread_law"
        assert found.apart > 5


def test_excess_noise_is_seen(look):
    """The total that is found lies on a flat minimum, which moves the signal-to-noise by half at most."""
    effects = [vocabulary()[own] for own in ("excess_read_noise", "row_noise")]
    assert isolability(look, effects[0], effects, 50.0).snr == pytest.approx(50.0, rel=0.5)


def test_widths_of_three_exposures_hardly_tell_power_from_delay():
    """A known tie where brightness follows the width alone: a power of t, and the exposure plus a constant."""
    known = vocabulary()
    tie = isolability(
        noise_of("spot_area"), known["spread_law"], [known["shutter_offset"], known["photon_budget"]], 50.0
    )
    assert tie.rival == "shutter_offset"
    assert tie.apart < 0.5 * tie.snr


def test_stripes_as_long_as_blocks_are_wide_stand_in_for_no_brightness(look):
    """Sampled once a block they change each site's brightness and nothing else of its means: only their own
    power in the spectrum tells."""
    own = _at_strength(look, vocabulary()["angle_reflectance"], 100.0)
    ideal = asimov(look, own.refit.model, own.component, own.grain)
    truth = account(ideal, own.refit.model.present, own.refit.model)
    as_wide = (1e-4, float(look.measured.side), 0.0, 0.0)
    stripes = account(ideal, [Present(vocabulary()["interference_fringes"], "site", as_wide)])
    assert stripes.score - truth.score < APART**2
    assert _as_deep(ideal, stripes).score - truth.score > 4 * APART**2
