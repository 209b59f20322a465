"""Readings behind a coarse granular field: averages over its law against random fields, through whatever bends."""

import numpy as np
import pytest

from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, View, grain_law, granular_variance, moments
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import SensorModel

SENSOR = SensorModel(0.11, 13.0, 0.0, np.inf, 40.0, 4095.0)
BASELINE = Baseline(0.0, "linear", False, 1e-3)
LEVEL = 700.0
SITES = 400_000


def present(name: str, *values: float) -> Present:
    """An effect of the vocabulary with values, in its first form."""
    effect = vocabulary()[name]
    return Present(effect, effect.forms[0], values)


def at_peak(peaks) -> tuple[View, Free]:
    """Views that see only the middle of a spot, with these peaks [DN]."""
    one = np.ones((len(peaks), 1, 1))
    view = View(0 * one[:1], 0 * one[:1], 0 * one, 0 * one, 1e-3 * one, 0 * one, 0 * one, 0 * one, 0 * one, 1e-3, 1e-3,
                0.0, 0.0, 100.0, 1.0)  # fmt: skip
    return view, Free(np.reshape(peaks, (-1, 1, 1)).astype(float), 9.0 * one)


@pytest.mark.parametrize("contrast", [0.2, 0.6, 0.71, 1.0])
def test_law_has_its_mean_and_contrast(contrast):
    factors, weights = grain_law(contrast)
    assert (factors >= 0).all() and weights.sum() == pytest.approx(1)
    assert weights @ factors == pytest.approx(1, rel=1e-4)
    assert weights @ (factors - 1) ** 2 == pytest.approx(contrast**2, rel=1e-3)


@pytest.mark.parametrize("contrast", [0.3, 0.61, 0.71])
def test_moments_through_a_clip_are_those_of_random_grain(contrast):
    """Mean within 0.5 % of the level, scatter from grain to grain within 1.5 % of it, noise within 6 % (and 0.3 DN²):
    the law stands in 16 bins."""
    peaks = np.array([30.0, 200.0, 600.0, 1000.0, 3000.0, 15000.0])
    effects = [present("saturation", LEVEL, 0.03), present("speckle", contrast, 1.5)]
    got = moments(*_arguments(peaks), effects, SENSOR)
    granular = granular_variance(*_arguments(peaks), effects, SENSOR).ravel()
    rng = np.random.default_rng(1)
    shape = contrast**-2
    for k, peak in enumerate(peaks):
        light = peak * rng.gamma(shape, 1 / shape, SITES)
        electrons = np.minimum(rng.poisson(light / 0.11), LEVEL / 0.11)
        reading = np.rint(0.11 * (electrons + rng.normal(0, 13.0, SITES)) + 40.0)
        assert got.mean.ravel()[k] == pytest.approx(reading.mean(), abs=0.005 * LEVEL)
        # What a pixel reads on average at its own grain: shot noise is small beside the clip.
        own = 0.11 * np.minimum(light / 0.11, LEVEL / 0.11)
        assert np.sqrt(granular[k]) == pytest.approx(own.std(), abs=0.015 * LEVEL)
        noise = reading.var() - own.var()
        if peak < 0.5 * LEVEL:
            assert got.variance.ravel()[k] == pytest.approx(noise, rel=0.06, abs=0.3 + 0.02 * own.var())


def test_grain_without_a_bend_leaves_the_mean_and_scatters_with_the_light():
    peaks = np.array([50.0, 400.0])
    effects = [present("speckle", 0.5, 1.5)]
    plain, grainy = moments(*_arguments(peaks), [], SENSOR), moments(*_arguments(peaks), effects, SENSOR)
    assert np.allclose(grainy.mean, plain.mean, rtol=2e-4)
    assert np.allclose(grainy.variance, plain.variance, rtol=2e-3)
    assert np.allclose(granular_variance(*_arguments(peaks), effects, SENSOR).ravel(), (0.5 * peaks) ** 2, rtol=5e-3)


def test_fine_grain_changes_nothing():
    """Below a contrast of 0.1 readings are the very ones without grain."""
    effects = [present("saturation", LEVEL, 0.03)]
    weak = [*effects, present("speckle", 0.09, 1.5)]
    assert np.array_equal(moments(*_arguments([650.0]), weak, SENSOR), moments(*_arguments([650.0]), effects, SENSOR))
    assert not granular_variance(*_arguments([650.0]), weak, SENSOR).any()


@pytest.mark.parametrize("name, values", [("dark_offset", (6.0,)), ("background_gradient", (6.0, 4.0, 0.0))])
def test_pedestals_add_up_with_grain(name, values):
    """Even or not, where nothing bends."""
    beside = present(name, *values)
    plain = moments(*_arguments([100.0]), [beside], SENSOR)
    grainy = moments(*_arguments([100.0]), [present("speckle", 0.5, 1.5), beside], SENSOR)
    assert plain.mean.item() > 140.5 and grainy.mean.item() == pytest.approx(plain.mean.item(), abs=0.02)
    assert grainy.variance.item() == pytest.approx(plain.variance.item(), rel=0.01)


def _arguments(peaks):
    view, base = at_peak(peaks)
    return view, BASELINE, base
