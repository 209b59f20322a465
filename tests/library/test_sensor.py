"""From light to readings: moments against sums over every outcome, and random frames against the same sums."""

import math
from itertools import repeat

import numpy as np
import pytest
from scipy.special import log_ndtr
from scipy.stats import norm

from spotcheck.model import sensor as chain
from spotcheck.model.sensor import SensorModel, reading
from spotcheck.model.simulate import expected_maximum, frames
from tests.library.conftest import gaussian
from tests.reference.exact_law import moments, reading_law

TABLE3 = SensorModel(0.11, 13.0, 70.0, np.inf, 0.0, 1023.0, 0.38)
DRAWS = 400_000


def outcomes(light: float, exposure: float, s: SensorModel) -> np.ndarray:
    """Probability of every reading 0 … full scale: the chain written as a sum over electrons."""
    return reading_law(light / s.gain_dn_per_e + s.dark_current_e_per_s * exposure, s)


def drawn(light: float, exposure: float, s: SensorModel, seed: int, count: int = DRAWS) -> np.ndarray:
    """Readings of one random frame of even light, in a row."""
    (readings,) = frames([np.full((count // 500, 500), light)], exposure, s, [np.random.default_rng(seed)])
    return readings.ravel()


CASES = {
    "black level 0, no light": (0.0, TABLE3),
    "black level 0, faint": (2.0, TABLE3),
    "black level 40, no light": (0.0, TABLE3._replace(black_level_dn=40.0)),
    "middle": (400.0, TABLE3),
    "below full scale": (1005.0, TABLE3),
    "at full scale": (1023.0, TABLE3),
    "above full scale": (1100.0, TABLE3),
    "below the well": (760.0, TABLE3._replace(full_well_e=7270.0)),
    "at the well": (800.0, TABLE3._replace(full_well_e=7270.0)),
    "above the well": (900.0, TABLE3._replace(full_well_e=7270.0)),
    "coarse steps": (40.0, SensorModel(0.02, 13.0, 0.0, np.inf, 5.0, 255.0)),
    "high gain": (300.0, SensorModel(2.0, 3.0, 1e5, np.inf, 20.0, 4095.0)),
    "many dark electrons": (50.0, TABLE3._replace(dark_current_e_per_s=1e7, black_level_dn=10.0)),
}


@pytest.mark.parametrize(("light", "s"), CASES.values(), ids=CASES)
def test_moments_of_a_reading(light, s):
    """Mean and variance with both clips and the rounding, against the sum over all outcomes.

    The normal law for electrons and read noise leaves out the skewness of 1/√ν of its electrons: where a clip cuts it
    in half, a mean shifts by up to skewness · sd/6 · φ(0) and a variance by some 0.4 · skewness of itself.
    """
    mean, variance, _ = moments(outcomes(light, 1e-4, s))
    got = reading(np.array([light]), 1e-4, s)
    electrons = light / s.gain_dn_per_e + s.dark_current_e_per_s * 1e-4
    noise_e = math.sqrt(electrons + s.read_noise_e**2)
    skewness = electrons / noise_e**3
    clipped = s.full_well_e < 1.2 * electrons or not 5 < (light + s.black_level_dn) / s.gain_dn_per_e / noise_e
    clipped = clipped or s.full_scale_dn - light - s.black_level_dn < 5 * s.gain_dn_per_e * noise_e
    sd = s.gain_dn_per_e * noise_e
    # Unclipped, sampling by whole DN is the midpoint rule: exp(−2π² sd²) off, 1e-2 DN at the sd of 0.47 DN.
    slack = 2 * math.exp(-2 * math.pi**2 * sd**2) / math.pi
    assert got.mean[0] == pytest.approx(mean, abs=slack + 1e-6 + clipped * (skewness * sd / 6 + 0.02))
    assert got.variance[0] == pytest.approx(variance, abs=2 * slack + 1e-5 + clipped * (0.4 * skewness + 0.02) * sd**2)


@pytest.mark.parametrize(("light", "s"), CASES.values(), ids=CASES)
def test_frames_follow_the_chain(light, s):
    """Eq. 23, H = S + B + W with the converter behind it: mean and variance of a large frame against the exact sums.

    Five standard errors each; false alarm 6e-7 a number.
    """
    mean, variance, kurtosis = moments(outcomes(light, 1e-4, s))
    values = drawn(light, 1e-4, s, 11).astype(float)
    assert values.mean() == pytest.approx(mean, abs=5 * math.sqrt(variance / DRAWS) + 1e-9)
    # A reading that is nearly always full scale has few effective draws: the kurtosis carries that.
    assert values.var() == pytest.approx(variance, abs=5 * variance * math.sqrt((kurtosis - 1) / DRAWS) + 1e-9)


@pytest.mark.parametrize(("light", "s"), CASES.values(), ids=CASES)
def test_response_is_the_derivative_of_the_mean(light, s):
    """Against a central difference of the mean itself."""
    step = 1e-3 * max(light, 1.0)
    light = max(light, 2 * step)
    low, mid, high = (reading(np.array([v]), 1e-4, s) for v in (light - step, light, light + step))
    numeric = (high.mean[0] - low.mean[0]) / (2 * step)
    # The part of the variance that the well takes away near its level is left out of the slope (see `reading`).
    slack = 0.02 if np.isfinite(s.full_well_e) else 2e-3
    assert mid.response[0] == pytest.approx(numeric, abs=slack)


def test_electrons_of_photons():
    """Eq. 15: electrons over photons is the quantum efficiency."""
    assert chain.photo_electrons(1000.0, 0.38) / 1000.0 == pytest.approx(0.38, rel=1e-14)


def test_mean_signal_of_the_linear_sensor():
    """Eqs. 16, 24, 25 and 29: 5000 photons, 7 dark electrons; and the average of a large frame gives the same."""
    got = chain.mean_signal(5000.0, 7.0, 0.11, 0.38)
    assert chain.dark_signal(7.0, 0.11) == pytest.approx(0.77, rel=1e-12)
    assert got == pytest.approx(0.11 * (0.38 * 5000 + 7), rel=1e-12)
    sensor = TABLE3._replace(dark_current_e_per_s=7e4)
    values = drawn(0.11 * 0.38 * 5000.0, 1e-4, sensor, 3).astype(float)
    # Five standard errors of the mean: false alarm 6e-7.
    assert values.mean() == pytest.approx(got, abs=5 * math.sqrt((0.11**2 * (1907 + 169) + 1 / 12) / DRAWS))


def test_rounding_adds_a_twelfth():
    """σ_q² = 1/12 DN²: what whole readings add to the variance of the chain before them."""
    own = TABLE3._replace(black_level_dn=100.0)
    got = reading(np.array([200.0]), 1e-4, own).variance[0]
    electrons = 200 / 0.11 + 70e-4
    assert got - 0.11**2 * (electrons + 169) == pytest.approx(1 / 12, abs=1e-9)
    assert chain.ROUNDING_VARIANCE == 1 / 12


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
    """Eq. 18's mean of maxima: against the average over 2000 drawn frames, five standard errors and 0.1 DN.

    0.1 DN for the normal law of a pixel: its skewness of 1/√ν shifts a maximum 3 sd up by some sd · 3²/6/√7000.
    """
    light = {
        "plateau": np.full((30, 30), 800.0),
        "gaussian": gaussian(60, 700.0, 30, 30, 9.0),
        "one pixel": np.full((1, 1), 500.0),
        "faint": gaussian(40, 60.0, 20, 20, 6.0),
    }[case]
    s = TABLE3._replace(black_level_dn=20.0)
    images = frames(repeat(light, 2000), 1e-4, s, repeat(np.random.default_rng(4)))
    maxima = np.array([image.max() for image in images], float)
    sd = float(np.sqrt(0.11 * light.max() + (0.11 * 13) ** 2))
    skew = 1.5 * sd / math.sqrt(light.max() / 0.11)
    want = expected_maximum(light, 1e-4, s)
    assert want == pytest.approx(maxima.mean(), abs=5 * maxima.std() / math.sqrt(2000) + skew + 0.02)


def test_expected_maximum_of_equal_normal_pixels():
    """Against the integral of z dF^n for n equal pixels, by quadrature."""
    n, s = 900, TABLE3._replace(black_level_dn=20.0)
    variance = 0.11 * 800 + 0.11**2 * (70e-4 + 169) + 1 / 12
    z = np.linspace(-9, 9, 40001)
    mean = (
        820
        + 0.11 * 70e-4
        + math.sqrt(variance) * np.trapezoid(z * n * np.exp(norm.logpdf(z) + (n - 1) * log_ndtr(z)), z)
    )
    # 400 nodes over 16 sd, trapezoids of a smooth step: below 1e-4 sd.
    assert expected_maximum(np.full((30, 30), 800.0), 1e-4, s) == pytest.approx(mean, abs=1e-3)


def test_expected_maximum_counts_every_pixel_that_may_win():
    """A Gaussian's pixels, all of them, in the integral of z d(Π F): those a few sd below the peak matter."""
    s = TABLE3._replace(black_level_dn=20.0)
    light = gaussian(60, 700.0, 30, 30, 9.0)
    own = reading(light.ravel(), 1e-4, s)
    z = np.linspace(640, 860, 4001)
    whole = np.exp(log_ndtr((z[:, None] - own.mean) / np.sqrt(own.variance)).sum(axis=1))
    mean = z[-1] - np.trapezoid(whole, z)
    # 400 nodes against 4001 of the same smooth step.
    assert expected_maximum(light, 1e-4, s) == pytest.approx(mean, abs=1e-3)
