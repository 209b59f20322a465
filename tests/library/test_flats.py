"""Flats without spots: a linear sensor is one, and what bends the response is named on levels that were kept unseen."""

import numpy as np
import pytest

from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.flats import ASTRAY, explanations, fitted, series_of
from spotcheck.discrepancy.flats_verdict import verdict_of
from spotcheck.discrepancy.written import breach_of_verdict, rounded
from spotcheck.estimate.levels import Level, Spatial
from spotcheck.estimate.photon_transfer import transfer_of
from spotcheck.model.effects import vocabulary

FULL, GAIN, BLACK, NOISE = 4095.0, 0.3, 30.0, 9.0
SHAPE = (480, 640)


def levels(rng, bend=0.0, late=0.0, power=0.0, count=30, top=3600.0):
    """Levels of a sensor whose means and variances are drawn at their standard errors. `bend`: y − q y²/full scale;
    `late` [s]: the shutter opens longer; `power`: light grows with a power of the exposure."""
    exposures = np.linspace(2e-4, 6e-3, count)
    pixels = SHAPE[0] * SHAPE[1]
    none = Spatial(0.0, 0.0, 0.0, 0.0)
    dark_variance = (GAIN * NOISE) ** 2 + 1 / 12
    out = []
    for t in exposures:
        light = top * ((t + late) / exposures[-1]) ** (1 + power)
        slope = 1 - 2 * bend * light / FULL
        mean, variance = light - bend * light**2 / FULL, slope**2 * (GAIN * light + dark_variance - 1 / 12) + 1 / 12
        for kind, signal, own in (("dark", 0.0, dark_variance), ("flat", mean, variance)):
            error, spread = np.sqrt(own / pixels / 2 + (3e-4 * signal) ** 2), own * np.sqrt(2 / pixels)
            out.append(
                Level(kind, float(t), float(t * 1e6) if kind == "flat" else 0.0, 2,
                      BLACK + signal + error * rng.standard_normal(), float(error),
                      own + spread * rng.standard_normal(), float(spread), 0.0, 0.0, none, SHAPE)
            )  # fmt: skip
    # One level at the converter's end says where saturation is.
    return [*out, out[-1]._replace(exposure_s=8e-3, photons=8000.0, mean=FULL, variance=0.0, at_full=1.0)]


def judged(own):
    found = transfer_of(own, FULL)
    series = series_of(found, FULL)
    assert series is not None
    return verdict_of(series, "flats", Tolerance(), found.quantities["gain"], 200, 3)


def test_a_linear_sensor_is_consistent():
    """In ten draws of ten, at p below 1 % or by less than the tolerance; K in the sentence."""
    for seed in range(10):
        verdict = judged(levels(np.random.default_rng(seed)))
        assert verdict["status"] == "consistent" and verdict["effects"] == [] == verdict["explanations"]
        assert "agree with a linear sensor" in verdict["sentence"] and "K = 0." in verdict["sentence"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "name", "key", "true"),
    [
        ({"bend": 0.05}, "nonlinearity", "q", 0.05),
        ({"bend": -0.05}, "nonlinearity", "q", -0.05),
        ({"power": 0.05}, "photon_budget", "delta", 0.05),
    ],
)
def test_one_effect_is_named(changes, name, key, true):
    """The name alone, its strength within four standard errors or 5 %, and K within 1 %."""
    verdict = judged(levels(np.random.default_rng(21), **changes))
    assert verdict["explanations"][0] == [name] and verdict["status"] in ("named", "ambiguous")
    parameters = verdict["effects"][0]["parameters"]
    own = parameters.get(key) or next(iter(parameters.values()))
    assert own["value"] == pytest.approx(true, rel=0.05, abs=4 * own["stderr"])
    assert verdict["gap"]["closed"] > 0.98


def test_a_late_shutter_is_tied_with_a_pedestal():
    """A constant more of exposure at one lamp is a constant more of light: both are candidates."""
    verdict = judged(levels(np.random.default_rng(22), late=4e-5))
    assert verdict["status"] == "ambiguous"
    assert {"shutter_offset", "dark_offset"} <= set(verdict["effects"][0]["candidates"])
    assert "They cannot tell this from" in verdict["sentence"]


@pytest.mark.slow
def test_two_effects():
    """A response that bends, and a late shutter: the set is found, the pedestal tied; the file keeps the schema."""
    verdict = judged(levels(np.random.default_rng(23), bend=0.03, late=4e-5))
    assert {frozenset(own) for own in verdict["explanations"]} >= {
        frozenset(("nonlinearity", "shutter_offset")), frozenset(("nonlinearity", "dark_offset"))
    }  # fmt: skip
    assert breach_of_verdict(rounded(verdict)) is None
    assert {own["effect"] for own in verdict["not_assessed"]} == {
        name for name, effect in vocabulary().items() if effect.flats
    }


def test_light_without_noise():
    """Where noise does not grow with the light, as where readings stop below full scale, K comes to an end."""
    own = levels(np.random.default_rng(5))
    series = series_of(transfer_of(own, FULL), FULL)
    assert series is not None
    fit = fitted(series._replace(excess=0 * series.excess), ())
    assert fit.gain == pytest.approx(series.sensor.gain_dn_per_e / ASTRAY, rel=1e-3) and np.isfinite(fit.chi2)


def test_too_few_levels():
    own = levels(np.random.default_rng(24), count=3)
    assert series_of(transfer_of(own, FULL), FULL) is None


@pytest.mark.slow
def test_lamps_that_change_hide_the_shutter():
    """Light that does not go with the exposure: no error of the exposure can be told."""
    own = [level._replace(photons=level.photons * (1 + 0.3 * np.sin(k))) if level.kind == "flat" else level
           for k, level in enumerate(levels(np.random.default_rng(25)))]  # fmt: skip
    series = series_of(transfer_of(own, FULL), FULL)
    assert series is not None and not series.timed
    assert all("shutter_offset" not in fit.names for fit in explanations(series))
