"""Tables of readings under faint light: against plain sums over every outcome and the quadrature of the bounds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import poisson

from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.sensor.faint import (
    CLIP_REACH,
    FAINT_E,
    LARGEST_TABLE_E,
    PARTS,
    FaintTable,
    tabulate_between_codes,
    tabulate_faint_light,
)
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


def some_levels(table: FaintTable, count: int = 25) -> np.ndarray:
    """Numbers of levels from the first to the last, with level 0 and its neighbours."""
    zero = int(np.argmin(np.abs(table.levels)))
    spread = np.linspace(0, len(table.levels) - 1, count).astype(int)
    return np.unique(np.concatenate([spread, zero + np.arange(3), [max(zero - 1, 0)]]))


def cut(probability: np.ndarray, readings: int) -> np.ndarray:
    """Of a table with so many readings; they include all that occur."""
    return np.pad(probability, (0, max(readings - probability.size, 0)))[:readings]


@every_sensor
def test_every_row_against_the_plain_sum(sensor):
    """P(y | ν) of Poisson, well, read noise, black level, rounding and clips; its sum, mean and variance."""
    table = tabulate_faint_light(sensor)
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


@every_sensor
def test_the_score_has_mean_0(sensor):
    """E[∂ ln P/∂ν] = Σ ∂P/∂ν = 0 at every level; below 0 slopes are differences, with rounding of 1e-16 over 1e-4 σ."""
    slope = tabulate_faint_light(sensor).slope
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(slope.sum(axis=1), 0.0, atol=1e-11)


def information(table: FaintTable) -> np.ndarray:
    """Σ (∂P/∂ν)²/P [1/e-²] of each level."""
    seen = table.probability > 1e-250
    return np.sum(np.where(seen, table.slope**2 / np.where(seen, table.probability, 1.0), 0.0), axis=1)


def test_counts_have_the_poisson_law():
    """No read noise, 1 DN an electron: each row is the Poisson law, its mean and variance ν, its information 1/ν."""
    table = tabulate_faint_light(SENSORS["counts"])
    nu = table.levels
    assert (nu[0], nu[-1]) == (0, FAINT_E)
    y = np.arange(table.probability.shape[1])
    np.testing.assert_allclose(table.probability, poisson.pmf(y, nu[:, None]), rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(table.mean, nu, rtol=1e-12, atol=1e-15)
    # A difference of squares of a thousand.
    np.testing.assert_allclose(table.variance, nu, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(information(table)[1:], 1 / nu[1:], rtol=1e-10)
    np.testing.assert_allclose(table.slope[1:], table.probability[1:] * (y / nu[1:, None] - 1), rtol=1e-9, atol=1e-14)


@every_sensor
def test_levels_reach_where_readings_are_plain(sensor):
    """At the last level a reading has the mean and variance of the plain law, unless a clip acts above as well; the
    first reads nothing but black or lies six read noises below 0."""
    table = tabulate_faint_light(sensor)
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    assert table.levels[0] == table.lowest_e
    np.testing.assert_allclose(np.diff(table.levels), table.step_e, rtol=1e-9)
    assert FAINT_E <= table.levels[-1] <= LARGEST_TABLE_E
    assert table.lowest_e == 0 if noise == 0 else table.lowest_e <= -CLIP_REACH * noise
    plain = gain**2 * (table.levels[-1] + noise**2) + ROUNDING_VARIANCE
    if min(sensor.full_scale_dn, black + gain * sensor.full_well_e) > black + gain * 40:
        # Rounding of a noise of 0.6 DN moves a mean by up to exp(−2π² 0.6²)/π = 3e-4 DN, a variance by 1.3e-3 DN².
        # Counts at 1 DN and 1/2 DN an electron are not rounded, or all by 1/2: 1/12 of 32 DN² less, 1/24 of 8 DN² more.
        assert table.mean[-1] == pytest.approx(gain * table.levels[-1] + black, abs=1e-3 * np.sqrt(plain))
        assert table.variance[-1] == pytest.approx(plain, rel=6e-3)


def test_a_table_has_an_end():
    """A converter whose step is hundreds of electrons never becomes plain within its table."""
    table = tabulate_faint_light(SensorModel(0.005, 20.0, full_scale_dn=255.0))
    assert LARGEST_TABLE_E <= table.levels[-1] < LARGEST_TABLE_E + table.step_e


@pytest.mark.parametrize("name", ["counts", "the paper's with a black level", "quiet", "coarse steps", "full well"])
def test_readings_less_an_offset(name):
    """A pixel whose black level is m/8 DN higher reads y as often as 8 times the entry 8 y − m of the finer table."""
    sensor, extra_e2 = SENSORS[name], 9.0
    fine, table = tabulate_between_codes(sensor, extra_e2)
    noise_e = float(np.sqrt(sensor.read_noise_e**2 + extra_e2))
    assert fine.gain_dn_per_e == PARTS * sensor.gain_dn_per_e and fine.read_noise_e == pytest.approx(noise_e, rel=1e-15)
    # The last readings of a part may lack those of other parts, which are as improbable as what is left out.
    np.testing.assert_allclose(table.probability.sum(axis=1), 1.0, atol=1e-12)
    entries = table.probability.shape[1]
    # The first entry is the first reading that is not 0, at the highest of the eight black levels.
    black = (fine.black_level_dn + 1) / PARTS
    for level in np.linspace(0, len(table.levels) - 1, 4).astype(int):
        for m in range(PARTS):
            shifted = replace(sensor, read_noise_e=noise_e, black_level_dn=black + m / PARTS, full_scale_dn=np.inf)
            y = np.arange(1, (entries + m) // PARTS + 1)
            want = reading_law(table.levels[level], shifted)[y]
            np.testing.assert_allclose(PARTS * table.probability[level, PARTS * y - m - 1], want, rtol=0, atol=1e-12)
