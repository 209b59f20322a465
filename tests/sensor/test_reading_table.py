"""The table of reading moments against the exact distribution and against brute force."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.table import grain_quadrature, saturating_electrons
from tests.reference.reading_brute_force import PlainSensor, gain_scatter, granular_light
from tests.samples.reading_distributions import LEVELS, dead_zone, sensor, subtraction, upper_end

# Promise of `spotcheck.sensor.table`: largest error of the mean, in standard deviations.
MEAN_ERROR = 1e-4
# Standard deviation [DN] below which a pixel counts as saturated: errors of the mean are then below 1e-6 DN.
LEAST_SD = 0.01
# Largest error of the variance: relative, or in DN² where the variance is below 1 DN²; or of the largest variance, as a
# 16-bit sensor goes from 7000 DN² to 0 within the few nodes of its clip.
VARIANCE_ERROR, CLIPPED_VARIANCE_ERROR = 1e-4, 1e-7
LIGHTS = 300
# Light that tables reach at least, in terms of the upper end of the sensor.
FARTHEST = 3.5


def knee(x):
    """A response with a slope of 0.3 from 600 DN on."""
    return np.minimum(x, 600 + 0.3 * (x - 600))


def clip_at_20(x):
    """A charge that stops at 20 DN."""
    return np.minimum(x, 20.0)


def clip_at_100(x):
    """A digital stage that stops at 100 DN."""
    return np.minimum(x, 100.0)


SENSORS = {
    "10 bit, 13 e-": sensor(0.11, 13.0, 10, 40.0),
    "10 bit, black clip": sensor(0.11, 13.0, 10, 0.0),
    "12 bit, full well": sensor(0.11, 2.0, 12, 12.0, 15000.0),
    "14 bit": sensor(0.4, 3.0, 14, 64.0),
    "16 bit": sensor(0.11, 2.0, 16, 100.0),
    "16 bit, full well": sensor(1.2, 5.0, 16, 300.0, 30000.0),
    "noise 0.05 DN": sensor(0.05, 1.0, 8, 3.3),
    "noise 0.05 DN of 0.1 e-": sensor(0.5, 0.1, 8),
    "noise 0.1 DN": sensor(0.1, 1.0, 10, 3.5),
    "noise 0.3 DN": sensor(0.1, 3.0, 10, 3.0),
    "noise 0.7 DN": sensor(0.5, 1.4, 8, 3.3),
    "no read noise, several electrons per code": sensor(0.11, 0.0, 10),
    "no read noise, one electron per code": sensor(1.0, 0.0, 8, 3.3),
    "no read noise, two codes per electron": sensor(2.0, 0.0, 8),
    "full well of 5 e- under 13 e-": sensor(1.0, 13.0, 8, 12.0, 5.0),
    "full well of 20 e- under 13 e-": sensor(1.0, 13.0, 8, 12.0, 20.0),
    "full well of 150 e- under 13 e-": sensor(0.5, 13.0, 8, 12.0, 150.0),
    "curvature above 0": sensor(0.11, 2.0, 12, 12.0, bend=0.15),
    "curvature below 0": sensor(0.11, 2.0, 12, 12.0, bend=-0.2),
    "curvature with its maximum in range": sensor(0.11, 2.0, 10, 12.0, bend=0.6),
    "knee": sensor(0.11, 2.0, 12, 12.0, response=(knee,)),
    "digital stages": sensor(0.5, 2.0, 8, 3.3, digital=(dead_zone, subtraction)),
    "digital stages, 0.05 DN": sensor(0.5, 0.1, 8, 3.3, digital=(dead_zone, subtraction)),
    "digital clip": sensor(0.5, 2.0, 8, 3.0, digital=(clip_at_100,)),
    "charge clip under 13 e-": sensor(0.5, 13.0, 8, 3.3, charge=(clip_at_20,)),
    "charge levels under 13 e-": sensor(0.5, 13.0, 8, 3.3, charge_levels=LEVELS),
    "charge levels": sensor(0.5, 2.0, 8, 3.3, charge_levels=LEVELS),
    "dark current": sensor(0.11, 13.0, 10, 3.0, dark_e=500.0),
    "smear into the full well": sensor(0.5, 13.0, 8, 3.0, 100.0, smear_e=40.0),
}
each_sensor = pytest.mark.parametrize("reading", SENSORS.values(), ids=SENSORS)


def lights_between_nodes(reading: ReadingDistribution, light_max: float) -> np.ndarray:
    """Return lights [DN]: random ones from none to beyond the upper end, and dense ones near black and the ends."""
    rng, end = np.random.default_rng(5), upper_end(reading)
    dark_e = reading.sensor.gain_dn_per_e * rng.uniform(0, 12, LIGHTS // 6)
    near_black = rng.uniform(0, 12, LIGHTS // 6)
    spread = 3 * math.sqrt(reading.noise_dn**2 + reading.sensor.gain_dn_per_e * end)
    near_end = end + spread * rng.uniform(-1, 1, LIGHTS // 3)
    anywhere = 1.6 * end * rng.uniform(0, 1, LIGHTS - 2 * (LIGHTS // 6) - LIGHTS // 3) ** 2
    light = np.concatenate([dark_e, near_black, near_end, anywhere])
    return np.sort(np.clip(light, 0.0, light_max))


@cache
def exact_and_table(reading: ReadingDistribution):
    """Return lights [DN], the exact cumulants there, and the table."""
    saturated = reading.sensor.gain_dn_per_e * saturating_electrons(reading)
    light_max = max(FARTHEST * upper_end(reading), saturated)
    table = reading.tabulate(light_max)
    light = lights_between_nodes(reading, light_max)
    return light, reading.cumulants(light), table


@each_sensor
def test_mean_and_variance_between_nodes(reading):
    """The interpolated mean is off by less than 1e-4 standard deviations, the variance by less than 1e-4.

    Slopes are off by less than 1e-3 of the largest slope. The error of a cubic of width h rises and falls once between
    two nodes, so that its slope is off by some 10 e/h where the cubic itself is off by e. A mean off by 1e-5 standard
    deviations with nodes a sixth of one apart gives 6e-4, and a variance off by 1e-5 of itself as much.
    """
    light, exact, table = exact_and_table(reading)
    moments = table.moments(light)
    for got, expected in ((moments.mean_slope, exact.mean_slope), (moments.variance_slope, exact.variance_slope)):
        assert np.max(np.abs(got - expected)) < 1e-3 * max(np.max(np.abs(expected)), 1.0)
    tolerance = VARIANCE_ERROR * np.maximum(exact.variance, 1.0) + CLIPPED_VARIANCE_ERROR * np.max(exact.variance)
    sd = np.sqrt(np.maximum(exact.variance, LEAST_SD**2))
    assert np.max(np.abs(moments.mean - exact.mean) / sd) < MEAN_ERROR
    assert np.all(np.abs(moments.variance - exact.variance) < tolerance)
    assert np.array_equal(table.mean(light), moments.mean)
    assert np.array_equal(table.variance(light), moments.variance)


@each_sensor
def test_slopes_are_those_of_the_interpolated_values(reading):
    """Slopes agree with difference quotients of the table itself, also below no light and in saturation.

    The step of 1e-5 DN loses 1e-16 · 65535 DN/1e-5 DN = 1e-6 to rounding, and as much of the variance relative to it.
    """
    light, _, table = exact_and_table(reading)
    inside = np.concatenate([light[light > 1e-4], [-3.0, -0.5, 3 * upper_end(reading)]])
    nodes = table.light
    inside = inside[np.min(np.abs(inside[:, None] - nodes), axis=1) > 1e-4]
    moments = table.moments(inside)
    low, high = table.moments(inside - 1e-5), table.moments(inside + 1e-5)
    assert (high.mean - low.mean) / 2e-5 == pytest.approx(moments.mean_slope, abs=1e-5)
    scale = max(1.0, float(np.max(moments.variance)))
    assert (high.variance - low.variance) / 2e-5 == pytest.approx(moments.variance_slope, abs=1e-5 * scale)


@each_sensor
def test_nodes_are_exact(reading):
    """At the nodes the table holds the exact mean and variance."""
    _, _, table = exact_and_table(reading)
    picked = np.linspace(0, table.light.size - 1, 25).astype(int)
    exact = reading.cumulants(table.light[picked])
    moments = table.moments(table.light[picked])
    # A node is found again from its light to rounding: 1e-16 of the light, times slopes of up to 1 and K.
    assert moments.mean == pytest.approx(exact.mean, rel=1e-12, abs=1e-9)
    assert moments.variance == pytest.approx(exact.variance, rel=1e-9, abs=1e-8)


@each_sensor
def test_below_no_light(reading):
    """Below no light the table goes on smoothly, with a positive variance and a straight mean."""
    _, _, table = exact_and_table(reading)
    at_zero, before = table.moments(0.0), table.moments(-1e-9)
    # A step of 1e-9 DN, and slopes and curvatures of up to 1e3 per DN.
    assert before.mean == pytest.approx(at_zero.mean, abs=1e-6)
    assert before.variance == pytest.approx(at_zero.variance, abs=1e-6)
    assert before.mean_slope == pytest.approx(at_zero.mean_slope, rel=1e-12)
    if at_zero.variance > 1e-6:
        # A reading without noise has no variance to lose below no light: its slope is then 0 at once.
        assert before.variance_slope == pytest.approx(at_zero.variance_slope, abs=1e-5)
    light = -np.geomspace(1e-3, 1e4, 50)
    moments = table.moments(light)
    assert np.all(np.isfinite(moments.mean)) and np.all(np.isfinite(moments.variance_slope))
    assert np.all(moments.variance >= 0)
    if at_zero.variance > 0:
        assert np.all(moments.variance >= math.exp(-3.0) * at_zero.variance * (1 - 1e-12))
    assert moments.mean == pytest.approx(at_zero.mean + at_zero.mean_slope * light, rel=1e-12)


@each_sensor
def test_constant_in_saturation(reading):
    """Beyond the light that saturates, mean and variance stay constant and equal the exact ones.

    `saturating_electrons` finds the saturation by full well, full scale, and every clip of charge, response and digital
    stages, so that tables end there. It leaves 10 standard deviations.
    """
    saturated = reading.sensor.gain_dn_per_e * saturating_electrons(reading)
    assert saturated < 4 * upper_end(reading) + 120 * reading.sensor.gain_dn_per_e
    _, _, table = exact_and_table(reading)
    last = max(saturated, float(table.light[-1]))
    far = np.array([1.0, 4.0, 70.0, 2e3]) * last
    moments = table.moments(far)
    assert np.all(moments.mean == moments.mean[0])
    assert np.all(moments.variance == moments.variance[0])
    assert np.array_equal(moments.mean_slope[1:], np.zeros(3))
    assert np.array_equal(moments.variance_slope[1:], np.zeros(3))
    exact = reading.cumulants(np.array([1.0, 3.0]) * last)
    # Clips within 10 standard deviations leave 1e-23 of the full range; sums of probabilities are rounded to 1e-16.
    assert moments.mean[0] == pytest.approx(exact.mean, rel=1e-12)
    assert moments.variance[0] == pytest.approx(exact.variance, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("smear_e", [1.0, 5.0])
@pytest.mark.parametrize("name", ["10 bit, 13 e-", "noise 0.7 DN", "full well of 150 e- under 13 e-"])
def test_smear_of_few_electrons(name, smear_e):
    """Smear of a few electrons is taken into account to first order, where noise is above 0.7 DN.

    The exact sensor adds the same electrons without shot noise. The next order is (s/σ²)²/8 of the ripple and of a
    clip, with a smear s and a variance σ² of 8 e-² and more: the mean is off by less than 1e-3 standard deviations and
    the variance by less than 2e-3. Treated as light, 5 e- would have up to 100 % more variance.
    """
    reading = SENSORS[name]
    light, _, table = exact_and_table(reading)
    light = light[light > 10 * reading.sensor.gain_dn_per_e]
    exact, moments = replace(reading, smear_e=smear_e).cumulants(light), table.moments(light, smear_e)
    sd = np.sqrt(np.maximum(exact.variance, LEAST_SD**2))
    assert np.max(np.abs(moments.mean - exact.mean) / sd) < 1e-3
    assert np.max(np.abs(moments.variance - exact.variance) / np.maximum(exact.variance, 1.0)) < 2e-3
    assert np.array_equal(table.moments(light, np.full(light.shape, smear_e)).mean, moments.mean)


def test_one_table_for_similar_light():
    """A table is made once for a distribution, and reaches at least the light that was asked for."""
    reading = sensor(0.5, 2.0, 12, 3.3)
    assert reading.tabulate(300.0) is sensor(0.5, 2.0, 12, 3.3).tabulate(400.0)
    assert reading.tabulate(300.0).light[-1] >= 300.0
    assert reading.tabulate(0.0).light[-1] >= 0.5


def test_shapes():
    """Results have the shape of the light; scalars and empty arrays are possible."""
    table = sensor(0.5, 2.0, 8, 3.3).tabulate(255.0)
    light = np.linspace(-1, 300, 24).reshape(2, 3, 4)
    moments = table.moments(light)
    assert {part.shape for part in moments} == {(2, 3, 4)}
    assert np.array_equal(table.moments(light[..., ::2]).variance, moments.variance[..., ::2])
    assert table.mean(100.0).shape == () and table.mean(np.empty((0, 3))).shape == (0, 3)


# Sensors of the mixtures, small enough for brute force.
MIXED = {
    "full scale": PlainSensor(0.5, 2.0, 63, black=3.3),
    "full well": PlainSensor(0.5, 2.0, 63, black=3.3, well_e=90.0),
    "13 e-": PlainSensor(1.0, 13.0, 127, black=12.0),
    "no read noise": PlainSensor(1.0, 0.0, 63, black=3.0),
}
each_mixed = pytest.mark.parametrize("plain", MIXED.values(), ids=MIXED)
PEDESTAL_DN = 1.5
# Light that the tables of the mixtures reach [DN].
BRIGHTEST = 1024.0


def base_table(plain: PlainSensor):
    """Return the table of a plain sensor without mixtures."""
    well = plain.well_e
    model = SensorModel(plain.gain, plain.noise_e, 0.0, well, plain.black, plain.full_scale)
    return ReadingDistribution(model).tabulate(BRIGHTEST)


def assert_mixture(table, light: float, law) -> None:
    """Compare mean, variance and their slopes with a brute-force law.

    The mixture is as exact as the table it comes from.
    """
    moments = table.moments(light)
    sd = math.sqrt(max(law.variance, LEAST_SD**2))
    assert abs(moments.mean - law.mean) < MEAN_ERROR * sd
    assert abs(moments.variance - law.variance) < VARIANCE_ERROR * max(law.variance, 1.0)
    assert abs(moments.mean_slope - law.mean_slope) < 5e-4
    assert abs(moments.variance_slope - law.variance_slope) < 5e-4 * max(1.0, law.variance)


@each_mixed
@pytest.mark.parametrize("contrast", [0.15, 1.0])
def test_granular_light(plain, contrast):
    """Granular light with a pedestal gives the mixture over the gamma distribution of grains, also in saturation."""
    table = base_table(plain).with_random_factor(*grain_quadrature(contrast=contrast), PEDESTAL_DN)
    for light in (0.7, 37.0, 70.0, 250.0):
        assert_mixture(table, light, granular_light(plain, contrast, light, PEDESTAL_DN))


def test_granular_light_on_a_linear_sensor():
    """Without clips grains add (C L)² to the variance and change no mean.

    The quadrature leaves out 1e-9 of the grains at either end.
    """
    gain, contrast, noise_e = 0.5, 0.2, 8.0
    reading = ReadingDistribution(SensorModel(gain, noise_e, black_level_dn=50.0))
    table = reading.tabulate(2000.0).with_random_factor(*grain_quadrature(contrast=contrast), PEDESTAL_DN)
    light = np.array([0.0, 10.0, 133.0, 500.0])
    assert table.mean(light) == pytest.approx(50.0 + light + PEDESTAL_DN, rel=1e-8)
    single = gain * (light + PEDESTAL_DN) + (gain * noise_e) ** 2 + 1 / 12
    assert table.variance(light) == pytest.approx((contrast * light) ** 2 + single, rel=1e-6)


@each_mixed
@pytest.mark.parametrize("rms", [0.02, 0.07])
def test_random_factor(plain, rms):
    """A normal factor on the light, given at nine Gauss–Hermite nodes, gives the mixture over that factor.

    Nine nodes are exact for polynomials up to the 17th power. They miss a clip where the factor spreads the light much
    more than noise does, by 1e-5 standard deviations at 10 % here and 7e-3 at 20 %.
    """
    nodes, weight = np.polynomial.hermite_e.hermegauss(9)
    table = base_table(plain).with_random_factor(1 + rms * nodes, weight / weight.sum())
    for light in (5.0, 37.0, 57.0, 63.0, 75.0):
        assert_mixture(table, light, gain_scatter(plain, rms, light))
