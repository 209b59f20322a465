"""From light to readings: mean signal, order of the chain, and the expected maximum."""

import math
from dataclasses import replace

import numpy as np
import pytest

from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, SensorModel
from spotcheck.sensor.model import dark_signal, mean_signal, photo_electrons
from tests.reference.exact_law import moments, reading_law
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import gaussian

TABLE3 = SensorModel(0.11, 13.0, 70.0, np.inf, 0.0, 1023.0, 0.38)
DRAWS = 400_000


def drawn(light: float, exposure: float, s: SensorModel, seed: int, count: int = DRAWS) -> np.ndarray:
    """Readings of so many pixels under even light."""
    return ReadingDistribution(s, exposure_s=exposure).sample(np.full(count, light), np.random.default_rng(seed))


def test_electrons_of_photons():
    """Eq. 15: electrons over photons is the quantum efficiency."""
    assert photo_electrons(1000.0, 0.38) / 1000.0 == pytest.approx(0.38, rel=1e-14)


def test_mean_signal_of_the_linear_sensor():
    """Eqs. 16, 24, 25 and 29: 5000 photons, 7 dark electrons; and the average of a large frame gives the same."""
    got = mean_signal(5000.0, 7.0, 0.11, 0.38)
    assert dark_signal(7.0, 0.11) == pytest.approx(0.77, rel=1e-12)
    assert got == pytest.approx(0.11 * (0.38 * 5000 + 7), rel=1e-12)
    sensor = replace(TABLE3, dark_current_e_per_s=7e4)
    values = drawn(0.11 * 0.38 * 5000.0, 1e-4, sensor, 3).astype(float)
    # Five standard errors of the mean: false alarm 6e-7.
    assert values.mean() == pytest.approx(got, abs=5 * math.sqrt((0.11**2 * (1907 + 169) + 1 / 12) / DRAWS))


def test_rounding_adds_a_twelfth():
    """σ_q² = 1/12 DN²: what whole readings add to the variance of the chain before them.

    At a noise of 4.8 DN the sum of a smooth density at whole numbers is its integral.
    """
    own = replace(TABLE3, black_level_dn=100.0)
    got = ReadingDistribution(own, exposure_s=1e-4).variance(200.0)
    electrons = 200 / 0.11 + 70e-4
    assert got - 0.11**2 * (electrons + 169) == pytest.approx(1 / 12, abs=1e-9)
    assert ROUNDING_VARIANCE == 1 / 12


@pytest.mark.parametrize("light", [0.0, 2.0, 400.0, 760.0, 1023.0])
def test_frames_are_signal_offset_and_noise(light):
    """Eq. 23, H = S + B + W with the converter behind it: readings have mean and variance of the sum over all outcomes.

    Five standard errors each; false alarm 6e-7 a number.
    """
    s = replace(TABLE3, full_well_e=7270.0, black_level_dn=12.0)
    mean, variance, kurtosis = moments(reading_law(light / 0.11 + 70e-4, s))
    values = drawn(light, 1e-4, s, 11).astype(float)
    assert values.mean() == pytest.approx(mean, abs=5 * math.sqrt(variance / DRAWS))
    assert values.var() == pytest.approx(variance, abs=5 * variance * math.sqrt((kurtosis - 1) / DRAWS))


ORDER = {
    "the well stops electrons before the offset": (SensorModel(0.5, 0, 0, 100.0, 30.0, 1023.0), 500.0, 0.5 * 100 + 30),
    "the converter stops after the offset": (SensorModel(0.5, 0, 0, np.inf, 30.0, 255.0), 500.0, 255),
    "no light reads the black level": (SensorModel(0.5, 0, 0, np.inf, 30.0, 255.0), 0.0, 30),
    "rounded once, to nearest": (SensorModel(0.11, 0, 0, 70.0, 0.2, 1023.0), 500.0, 8),  # 7.7 + 0.2
    "a 16 bit container ends at 65535": (SensorModel(100.0, 0, 0, np.inf, 0.0, 1e9), 1e7, 65535),
}


@pytest.mark.parametrize(("s", "light", "value"), ORDER.values(), ids=ORDER)
def test_order_of_the_chain(s, light, value):
    """Without noise, and with light that fills the well or none, every reading is one known number."""
    got = drawn(light, 0.0, s, 0, 500)
    assert got.dtype == np.uint16 and set(got.tolist()) == {value}


def test_read_noise_may_lift_a_full_well():
    """Read noise comes after the well: readings scatter about its level by K σ_d, both ways."""
    s = SensorModel(0.11, 13.0, 0.0, 7270.0, 40.0, 1023.0)
    values = drawn(5000.0, 0.0, s, 1).astype(float)
    variance = (0.11 * 13) ** 2 + 1 / 12
    # Five standard errors of mean and variance (a normal law: kurtosis 3).
    assert values.mean() == pytest.approx(0.11 * 7270 + 40, abs=5 * math.sqrt(variance / DRAWS))
    assert values.var() == pytest.approx(variance, abs=5 * variance * math.sqrt(2 / DRAWS))


@pytest.mark.parametrize("case", ["plateau", "gaussian", "one pixel", "faint"])
def test_expected_maximum(case):
    """Eq. 18's mean of maxima: against the average over 2000 frames of the plain chain, five standard errors (6e-7)."""
    light = {
        "plateau": np.full((30, 30), 800.0),
        "gaussian": gaussian(60, 700.0, 30, 30, 9.0),
        "one pixel": np.full((1, 1), 500.0),
        "faint": gaussian(40, 60.0, 20, 20, 6.0),
    }[case]
    s, rng = replace(TABLE3, black_level_dn=20.0), np.random.default_rng(4)
    maxima = np.array([draw(light, 1e-4, s, rng).max() for _ in range(2000)], float)
    want = ReadingDistribution(s, exposure_s=1e-4).expected_maximum(light)
    assert want == pytest.approx(maxima.mean(), abs=5 * maxima.std() / math.sqrt(2000))
