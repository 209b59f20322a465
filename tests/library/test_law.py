"""The table of P(y | ν): against plain sums over every outcome, closed forms, and the quadrature of the bounds."""

import numpy as np
import pytest
from scipy.stats import norm, poisson

from spotcheck.estimate.fisher import read_noise_information
from spotcheck.estimate.scoring import LIKELIHOOD, law_of, one_pass
from spotcheck.model.law import CLIP_REACH, FAINT_E, LARGEST_TABLE_E, FaintLaw, faint_law
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel
from tests.reference.exact_law import moments, reading_law

SENSORS = {
    "counts": SensorModel(1.0, 0.0, full_scale_dn=4095.0),
    "the paper's, clipped at black": SensorModel(0.11, 13.0, 70.0, full_scale_dn=1023.0),
    "the paper's with a black level": SensorModel(0.11, 13.0, 70.0, black_level_dn=40.0, full_scale_dn=1023.0),
    "quiet": SensorModel(2.0, 1.5, black_level_dn=20.0, full_scale_dn=4095.0),
    "coarse steps": SensorModel(0.02, 13.0, black_level_dn=5.3, full_scale_dn=255.0),
    "coarse steps without noise": SensorModel(0.04, 0.0, black_level_dn=5.24, full_scale_dn=255.0),
    "every second count is half way": SensorModel(0.5, 0.0, full_scale_dn=255.0),
    "full well": SensorModel(2.0, 0.7, full_well_e=20.0, black_level_dn=3.5, full_scale_dn=4095.0),
    "full scale": SensorModel(10.0, 0.4, black_level_dn=5.0, full_scale_dn=255.0),
    "black below zero": SensorModel(0.8, 2.0, black_level_dn=-6.4, full_scale_dn=255.0),
    "no full scale": SensorModel(0.25, 3.0, black_level_dn=60.0),
}
every_sensor = pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
every_step = pytest.mark.parametrize("step", [None, 1 / 16], ids=["own step", "sixteenths"])


def some_levels(table: FaintLaw, count: int = 25) -> np.ndarray:
    """Numbers of levels from the first to the last, with level 0 and its neighbours."""
    zero = int(np.argmin(np.abs(table.levels)))
    spread = np.linspace(0, len(table.levels) - 1, count).astype(int)
    return np.unique(np.concatenate([spread, zero + np.arange(3), [max(zero - 1, 0)]]))


def cut(probability: np.ndarray, readings: int) -> np.ndarray:
    """The last reading stands for all above it."""
    return np.append(probability[: readings - 1], probability[readings - 1 :].sum())


@every_step
@every_sensor
def test_every_row_against_the_plain_sum(sensor, step):
    """P(y | ν) of Poisson, well, read noise, black level, rounding and clips; its sum, mean and variance."""
    table = faint_law(sensor, step)
    # Counts above nine standard deviations are left out: 1e-12 of them all.
    np.testing.assert_allclose(table.probability.sum(axis=1), 1.0, atol=1e-12)
    assert table.probability.min() >= 0
    for i in some_levels(table):
        want = reading_law(table.levels[i], sensor)
        mean, variance, _ = moments(want)
        np.testing.assert_allclose(table.probability[i], cut(want, table.probability.shape[1]), rtol=0, atol=1e-12)
        # Readings of a hundred DN: 1e-12 of them all moves a second moment by 1e-8.
        assert table.mean[i] == pytest.approx(mean, abs=1e-9)
        assert table.variance[i] == pytest.approx(variance, abs=1e-8)


def test_small_probabilities_keep_their_digits():
    """A fit divides by them: at no light, where they are intervals of the normal law, from either tail."""
    sensor = SENSORS["quiet"]
    table = faint_law(sensor)
    row = table.probability[np.argmin(np.abs(table.levels))]
    upper = np.arange(row.size) > sensor.black_level_dn
    low, high = ((np.arange(row.size) + side - sensor.black_level_dn) / 3.0 for side in (-0.5, 0.5))
    want = np.where(upper, norm.sf(low) - norm.sf(high), norm.cdf(high) - norm.cdf(low))
    seen = (np.arange(row.size) > 0) & (want > 1e-250)
    assert want[seen].min() < 1e-240
    # Exponents of 600 carry 6e-14.
    np.testing.assert_allclose(row[seen], want[seen], rtol=1e-12)


@every_step
@every_sensor
def test_slope_is_the_derivative(sensor, step):
    """∂P/∂ν against differences of the plain sum at five points, on one side of 0.

    Their error is at most h⁴/5 of a fifth derivative, itself below 1.2/0.4⁵ for the quietest read noise: 6e-9.
    """
    table = faint_law(sensor, step)
    for i in some_levels(table):
        nu, h = table.levels[i], 4e-3
        # Read noise alone moves a reading below 0 and Poisson counts above: differences stay on one side.
        nodes = np.arange(-2, 3) if abs(nu) > 2.5 * h else np.arange(5) if nu >= -h / 2 else np.arange(-4, 1)
        at = np.where(nodes == 0, nu, nu + h * nodes)
        weights = np.linalg.solve(np.vander(nodes, increasing=True).T.astype(float), np.eye(5)[1]) / h
        want = weights @ np.array([cut(reading_law(v, sensor), table.probability.shape[1]) for v in at])
        np.testing.assert_allclose(table.slope[i], want, rtol=0, atol=2e-8)


@every_step
@every_sensor
def test_the_score_has_mean_0(sensor, step):
    """E[∂ ln P/∂ν] = Σ ∂P/∂ν = 0 at every level; below 0 slopes are differences, with rounding of 1e-16 over 1e-4 σ."""
    slope = faint_law(sensor, step).slope
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(slope.sum(axis=1), 0.0, atol=1e-11)


def information(table: FaintLaw) -> np.ndarray:
    """Σ (∂P/∂ν)²/P [1/e-²] of each level."""
    seen = table.probability > 1e-250
    return np.sum(np.where(seen, table.slope**2 / np.where(seen, table.probability, 1.0), 0.0), axis=1)


def test_counts_have_the_poisson_law():
    """No read noise, 1 DN an electron: each row is the Poisson law, its mean and variance ν, its information 1/ν."""
    table = faint_law(SENSORS["counts"], 1 / 16)
    nu = table.levels
    assert (nu[0], nu[-1]) == (0, FAINT_E)
    y = np.arange(table.probability.shape[1])
    np.testing.assert_allclose(table.probability, poisson.pmf(y, nu[:, None]), rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(table.mean, nu, rtol=1e-12, atol=1e-15)
    # A difference of squares of a thousand.
    np.testing.assert_allclose(table.variance, nu, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(information(table)[1:], 1 / nu[1:], rtol=1e-10)
    np.testing.assert_allclose(table.slope[1:], table.probability[1:] * (y / nu[1:, None] - 1), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("noise", [0.5, 1.5, 13.0])
def test_information_with_read_noise(noise):
    """Where steps are fine and no clip acts it is that of the bounds' quadrature, at nodes of its interpolation.

    Rounding to σ/20 adds 2e-4 of σ².
    """
    sensor = SensorModel(20 / noise, noise, black_level_dn=180.0)
    table = faint_law(sensor, 0.25)
    at = np.searchsorted(table.levels, [1.0, 10.0])
    want = [float(read_noise_information(v, noise)) for v in (1.0, 10.0)]
    np.testing.assert_allclose(information(table)[at], want, rtol=4e-4)


@every_sensor
def test_levels_reach_where_readings_are_plain(sensor):
    """At the last level a reading has the mean and variance of the plain law, unless a clip acts above as well; the
    first reads nothing but black or lies six read noises below 0."""
    table = faint_law(sensor)
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    assert table.levels[0] == table.lowest_e and table.levels[-1] == pytest.approx(table.highest_e, rel=1e-12)
    np.testing.assert_allclose(np.diff(table.levels), table.step_e, rtol=1e-9)
    assert FAINT_E <= table.highest_e <= LARGEST_TABLE_E
    assert table.lowest_e == 0 if noise == 0 else table.lowest_e <= -CLIP_REACH * noise
    plain = gain**2 * (table.highest_e + noise**2) + ROUNDING_VARIANCE
    if min(sensor.full_scale_dn, black + gain * sensor.full_well_e) > black + gain * 40:
        # Rounding of a noise of 0.6 DN moves a mean by up to exp(−2π² 0.6²)/π = 3e-4 DN, a variance by 1.3e-3 DN².
        # Counts at 1 DN and 1/2 DN an electron are not rounded, or all by 1/2: 1/12 of 32 DN² less, 1/24 of 8 DN² more.
        assert table.mean[-1] == pytest.approx(gain * table.highest_e + black, abs=1e-3 * np.sqrt(plain))
        assert table.variance[-1] == pytest.approx(plain, rel=6e-3)


def test_a_table_has_an_end():
    """A converter whose step is hundreds of electrons never becomes plain within its table."""
    table = faint_law(SensorModel(0.005, 20.0, full_scale_dn=255.0))
    assert LARGEST_TABLE_E <= table.highest_e < LARGEST_TABLE_E + table.step_e


@pytest.mark.parametrize("name", list(SENSORS))
def test_half_way_between_levels(name):
    """Score and information of a pixel as the fit takes them from the table, against the plain sum half way between.

    A mean score that is not 0 shifts an estimate by its ratio to the information's root, times the root of the number
    of such pixels, in standard errors: with 4e-3 by one standard error of 240 × 240 px of the same light.
    """
    sensor = SENSORS[name]
    gain, law, table = sensor.gain_dn_per_e, law_of(sensor), faint_law(sensor)
    fine, y = 1e-3, np.arange(table.probability.shape[1])
    for i in some_levels(table)[:-1]:
        nu = (table.levels[i] + table.levels[i + 1]) / 2
        # Read noise alone moves a reading below 0 and a whole electron above. What joins the two is no law of its own.
        if nu >= law.highest or (sensor.read_noise_e < 1 and -table.step_e < nu < 0):
            continue
        at, below, above = (cut(reading_law(v, sensor), y.size) for v in (nu, nu - fine, nu + fine))
        likely = at > 1e-12
        at, slope = at[likely], ((above - below) / (2 * fine))[likely]
        theta = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.0, gain * nu + sensor.black_level_dn])
        passes = [one_pass(np.array([[float(v)]]), theta, LIKELIHOOD, law, False) for v in y[likely]]
        score = gain * np.array([p[0][6] for p in passes])
        own, exact = gain**2 * passes[0][1][6, 6], float(np.sum(slope**2 / at))
        plain = max(nu, 0) + sensor.read_noise_e**2 + ROUNDING_VARIANCE / gain**2
        # The table's levels are 1/8 of the larger of read noise and one electron apart. The law bends most next to 0.
        assert abs(float(at @ score)) < 4e-3 / np.sqrt(plain)
        jump = 0.45 / sensor.read_noise_e if -table.step_e < nu < 0 else 0.0
        # 1/I bends where single electrons can just be told apart and hardly any comes, by up to 16 %; it sets steps and
        # stated errors, not the estimate.
        assert own == pytest.approx(exact, rel=0.2 if sensor.read_noise_e < 1 else 0.01, abs=(6e-3 + jump) / plain)
