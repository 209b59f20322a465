"""The exact distribution of a reading against brute force and closed forms."""

import doctest
import math
from functools import cache

import numpy as np
import pytest

from spotcheck.sensor import ReadingDistribution, SensorModel, distribution
from tests.reference.reading_brute_force import PlainSensor, ReadingLaw, mixed_charge_levels
from tests.samples.reading_distributions import LEVELS, dead_zone, subtraction

# Largest relative error of a probability: the brute force takes Poisson weights from scipy.stats, which computes
# exp(n ln µ − µ − ln n!). Terms of some 1e4 at 4000 e- are rounded to 1e-16 of themselves, which is 1e-12 to 1e-11.
RELATIVE = 2e-11
# Probability that the package leaves out: two normal tails and two Poisson tails of 1e-17 to 1e-16 each.
LEFT_OUT = 1e-15
EXPOSURE_S = 2.0


def soft_full_well(x):
    """A charge that fills softly towards 40 DN."""
    return x / np.sqrt(1 + (x / 40.0) ** 2)


def soft_compression(x):
    """A response that bends smoothly from 20 DN on."""
    return 20 * np.arcsinh(x / 20.0)


def knee(x):
    """A response with a slope of 0.4 from 25 DN on."""
    return np.minimum(x, 25 + 0.4 * (x - 25))


SENSORS = {
    "low gain, 13 e-": PlainSensor(0.05, 13.0, 63, black=3.3),
    "low gain, 0.3 e-": PlainSensor(0.05, 0.3, 63),
    "no read noise": PlainSensor(1.0, 0.0, 63, black=3.3),
    "no read noise, several electrons per code": PlainSensor(0.3, 0.0, 63),
    "high gain, 0.3 e-": PlainSensor(2.0, 0.3, 127, black=12.0),
    "high gain, 2 e-": PlainSensor(2.0, 2.0, 255),
    "high gain, 13 e-": PlainSensor(2.0, 13.0, 127, black=12.0),
    "full well below full scale": PlainSensor(0.5, 2.0, 63, black=3.3, well_e=80.0),
    "full well above full scale": PlainSensor(0.5, 2.0, 63, black=3.3, well_e=140.0),
    "full well, 13 e-": PlainSensor(0.3, 13.0, 63, black=12.0, well_e=150.5),
    "curvature above 0": PlainSensor(0.5, 2.0, 63, curvature=0.15 / 63),
    "curvature with its maximum in range": PlainSensor(0.5, 2.0, 63, black=3.3, curvature=0.9 / 63),
    "curvature without read noise": PlainSensor(0.5, 0.0, 63, black=3.3, curvature=0.9 / 63),
    "curvature below 0": PlainSensor(0.5, 2.0, 63, curvature=-0.2 / 63),
    "curvature with its minimum in range": PlainSensor(0.5, 13.0, 63, black=12.0, curvature=-2.0 / 63),
    "smear and dark current": PlainSensor(0.5, 2.0, 63, black=3.3, well_e=90.0, smear_e=5.3, dark_e=4.2),
    "soft full well": PlainSensor(0.5, 2.0, 63, black=3.3, charge=(soft_full_well,)),
    "knee in the response": PlainSensor(0.5, 2.0, 63, black=3.3, response=(knee,)),
    "soft response behind curvature": PlainSensor(0.5, 2.0, 63, curvature=0.1 / 63, response=(soft_compression, knee)),
    "digital stages": PlainSensor(0.5, 2.0, 63, black=3.3, digital=(dead_zone, subtraction)),
    "digital stages without read noise": PlainSensor(0.5, 0.0, 63, black=3.3, digital=(dead_zone, subtraction)),
}
each_sensor = pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)


def reading_distribution(sensor: PlainSensor) -> ReadingDistribution:
    """Return the package's form of a plain sensor."""
    model = SensorModel(
        gain_dn_per_e=sensor.gain,
        read_noise_e=sensor.noise_e,
        dark_current_e_per_s=sensor.dark_e / EXPOSURE_S,
        full_well_e=sensor.well_e,
        black_level_dn=sensor.black,
        full_scale_dn=sensor.full_scale,
        response_bend=sensor.curvature * sensor.full_scale,
    )
    return ReadingDistribution(
        model,
        exposure_s=EXPOSURE_S,
        smear_e=sensor.smear_e,
        charge=sensor.charge,
        response=sensor.response,
        digital=sensor.digital,
    )


def lights(sensor: PlainSensor) -> np.ndarray:
    """Return lights [DN] from none through the black clip, the middle and full scale to far beyond."""
    top = sensor.full_scale
    return np.array([0.0, 0.013, 0.4, 2.1, 0.25 * top, 0.63 * top, top - sensor.black - 1, top, 1.3 * top, 3.0 * top])


@cache
def brute_force(sensor: PlainSensor) -> tuple[ReadingLaw, ...]:
    """Return the brute-force distribution at each of `lights`."""
    return tuple(sensor.law(light) for light in lights(sensor))


def assert_moments(reading: ReadingDistribution, light: np.ndarray, laws, gain: float) -> None:
    """Compare cumulants, slopes and information of a distribution with those of brute-force laws."""

    def of_laws(name: str) -> np.ndarray:
        return np.array([getattr(law, name) for law in laws])

    top = laws[0].probability.size - 1
    sd = np.sqrt(of_laws("variance"))
    # A total probability that is off by a relative ε shifts the mean by ε of itself, and central moments through it.
    shift, got = RELATIVE * top, reading.cumulants(light)
    for power, name in enumerate(("mean", "variance"), start=1):
        tolerance = 3 * power * shift * sd ** (power - 1) + LEFT_OUT * float(top) ** power
        error = np.abs(got[power - 1] - of_laws(name))
        assert np.all(error <= tolerance), (name, light, error / tolerance)
    for name, tolerance in (("mean_slope", RELATIVE), ("variance_slope", 2 * shift)):
        slope = getattr(got, name)
        assert slope == pytest.approx(of_laws(name), rel=RELATIVE, abs=tolerance), name
    # Without light, codes of which one electron makes the probability rise from below 1e-17 dominate the information.
    lit = light > 0
    expected = of_laws("fisher_information")[lit]
    assert reading.fisher_information(light[lit]) == pytest.approx(expected, rel=1e-10, abs=1e-12 / gain**2)


@each_sensor
def test_probabilities_equal_the_brute_force(sensor):
    """P(y | L) and P(at most y | L) of all codes agree with sums over electrons and integrals over read noise."""
    reading, codes = reading_distribution(sensor), np.arange(sensor.full_scale + 1)
    laws = brute_force(sensor)
    probability = np.array([law.probability for law in laws])
    got = reading.pmf(codes, lights(sensor)[:, None])
    np.testing.assert_allclose(got, probability, rtol=RELATIVE, atol=LEFT_OUT)
    np.testing.assert_allclose(got.sum(axis=1), 1.0, rtol=1e-13)  # sums of some hundred rounded numbers
    below = np.array([law.cdf for law in laws])
    np.testing.assert_allclose(reading.cdf(codes, lights(sensor)[:, None]), below, rtol=RELATIVE, atol=LEFT_OUT)


@each_sensor
def test_moments_equal_the_brute_force(sensor):
    """Mean and variance, their slopes, and the Fisher information agree with the brute force."""
    assert_moments(reading_distribution(sensor), lights(sensor), brute_force(sensor), sensor.gain)


@pytest.mark.parametrize(
    "sensor",
    [
        PlainSensor(0.5, 2.0, 63, black=3.3),
        PlainSensor(0.5, 0.0, 63, black=3.3),
        PlainSensor(0.3, 13.0, 63, black=12.0, well_e=120.0),
        PlainSensor(0.5, 2.0, 63, curvature=0.15 / 63, charge=(soft_full_well,), response=(knee,)),
    ],
    ids=["2 e-", "no read noise", "full well below two levels", "all stages"],
)
def test_pixels_whose_charge_stops_at_different_levels(sensor):
    """Shares of pixels with their own clip level give the mixture of the distributions of these pixels.

    The levels are given in no order; the last of them lies above what some of the sensors reach.
    """
    reading = reading_distribution(sensor)
    reading = ReadingDistribution(
        reading.sensor, EXPOSURE_S, charge=sensor.charge, charge_levels=LEVELS[::-1], response=sensor.response
    )
    light = lights(sensor)
    laws = [mixed_charge_levels(sensor, LEVELS, at) for at in light]
    probability = reading.pmf(np.arange(64), light[:, None])
    np.testing.assert_allclose(probability, [law.probability for law in laws], rtol=RELATIVE, atol=LEFT_OUT)
    assert_moments(reading, light, laws, sensor.gain)


@pytest.mark.parametrize("name", ["high gain, 2 e-", "full well below full scale", "no read noise"])
def test_expected_maximum(name):
    """The mean of the largest reading of independent pixels is the sum over k of 1 − Π P(at most k) by brute force."""
    sensor = SENSORS[name]
    for light, repeats in (([0.0, 5.0, 20.0], [50, 7, 1]), ([30.0], [1]), ([40.0, 300.0], [5, 2]), ([0.0], [1000])):
        below = np.array([sensor.law(at).cdf for at in light])
        expected = math.fsum(1 - np.prod(below ** np.array(repeats)[:, None], axis=0))
        got = reading_distribution(sensor).expected_maximum(np.repeat(light, repeats))
        assert got == pytest.approx(expected, rel=1e-10, abs=1e-10)


def test_linear_sensor_without_clips():
    """Eq. 23, H = S + B + W: mean and variance are those of the sum of Poisson, normal and rounding error.

    With a read noise of 4 DN, rounding adds the variance 1/12 exactly (Sheppard): its dependence on the signal is of
    the size exp(−2π² 16) = 1e-137. A probability of 1e-17 is left out 8.5 standard deviations, up to
    1000 DN, from the mean; its share of a moment of order r is some 1e-17 (1000 DN)^r.
    """
    gain, noise_e, dark_e = 0.5, 8.0, 30.0
    reading = ReadingDistribution(SensorModel(gain, noise_e, dark_e, black_level_dn=200.0), exposure_s=1.0)
    light = np.array([0.0, 3.7, 100.0, 2e3, 3e4])
    signal = light + gain * dark_e
    assert reading.mean(light) == pytest.approx(200.0 + signal, rel=1e-12)
    assert reading.variance(light) == pytest.approx(gain * signal + (gain * noise_e) ** 2 + 1 / 12, rel=1e-12)
    cumulants = reading.cumulants(light)
    assert cumulants.mean_slope == pytest.approx(np.ones(5), rel=1e-12)
    assert cumulants.variance_slope == pytest.approx(np.full(5, gain), rel=1e-10)


def test_bright_light_reads_full_scale():
    """Far beyond full scale the reading is full scale without noise and tells nothing about the light."""
    reading = ReadingDistribution(SensorModel(0.11, 13.0, full_scale_dn=65535.0))
    light = np.array([1e5, 1e6])
    assert reading.mean(light) == pytest.approx([65535.0, 65535.0], rel=1e-15)
    assert np.all(reading.variance(light) < 1e-18)  # (65535 · 1e-16)², the rounding of the mean
    assert np.all(reading.fisher_information(light) < 1e-20)
    assert reading.pmf(65535, light) == pytest.approx([1.0, 1.0], rel=1e-15)


def test_probabilities_sum_to_one_for_millions_of_electrons():
    """At 1e7 e- the mean of a linear sensor is exact to the rounding of the sum, as the weights are normalized."""
    reading = ReadingDistribution(SensorModel(0.11, 2.0))
    assert reading.mean(1.1e6) == pytest.approx(1.1e6, rel=1e-14)


@pytest.mark.parametrize("sensor", [PlainSensor(0.5, 2.0, 63, black=3.3, dark_e=1.6), PlainSensor(1.0, 0.7, 63)])
def test_light_below_zero(sensor):
    """Light below none lowers the signal by itself, without shot noise.

    Slopes come from a central difference over 2e-4 of the read noise σ, whose error is (1e-4)²/6 of the third
    derivative, and from rounding of 1e-16/1e-4; both are below 1e-7 of 1/σ.
    """
    reading, codes = reading_distribution(sensor), np.arange(64)
    dark = sensor.gain * sensor.dark_e
    for light in (-dark - 3.1, -dark - 0.4, -dark - 1e-6):
        law = sensor.law(light)
        np.testing.assert_allclose(reading.pmf(codes, light), law.probability, rtol=RELATIVE, atol=LEFT_OUT)
        assert reading.mean(light) == pytest.approx(law.mean, rel=1e-10)
        assert reading.variance(light) == pytest.approx(law.variance, rel=1e-10)
        cumulants = reading.cumulants(light)
        assert cumulants.mean_slope == pytest.approx(law.mean_slope, abs=1e-7)
        assert cumulants.variance_slope == pytest.approx(law.variance_slope, abs=1e-6)
        assert reading.fisher_information(light) == pytest.approx(law.fisher_information, rel=1e-6)


def test_light_below_zero_without_read_noise():
    """Without read noise the reading of light below none is certain."""
    reading = ReadingDistribution(SensorModel(1.0, 0.0, black_level_dn=5.3, full_scale_dn=63.0))
    assert reading.mean([-1.0, -3.4, -20.0]) == pytest.approx([4.0, 2.0, 0.0], abs=1e-12)
    assert reading.variance([-1.0, -3.4, -20.0]) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


@each_sensor
def test_probabilities_are_continuous_at_no_light(sensor):
    """P(y | L) hardly changes from just below to just above the light without electrons."""
    reading, codes = reading_distribution(sensor), np.arange(sensor.full_scale + 1)
    none = -sensor.gain * sensor.dark_e
    before, after = (reading.pmf(codes, none + step) for step in (-1e-9, 1e-9))
    # A probability changes by at most 1/K for each DN of light with shot noise, and 0.4/(Kσ) for each DN without.
    steepest = max(1.0, 0.4 / sensor.noise_e if sensor.noise_e else 0.0) / sensor.gain
    assert np.max(np.abs(after - before)) < 2e-9 * steepest


def test_results_do_not_depend_on_the_other_lights():
    """Many lights in any order give what each of them gives alone: lights are summed in blocks of neighbours."""
    reading = reading_distribution(SENSORS["smear and dark current"])
    light = np.random.default_rng(1).permutation(np.concatenate([np.linspace(-5, 100, 150), np.zeros(3)]))
    np.testing.assert_allclose(reading.mean(light), [reading.mean(at) for at in light], rtol=1e-13)
    np.testing.assert_allclose(reading.variance(light), [reading.variance(at) for at in light], rtol=1e-12)
    codes = np.arange(light.size) % 64
    alone = [reading.pmf(code, at) for code, at in zip(codes, light, strict=True)]
    np.testing.assert_allclose(reading.pmf(codes, light), alone, rtol=1e-12, atol=LEFT_OUT)


def test_shapes():
    """Readings and light broadcast; scalars give scalars and empty arrays give empty arrays."""
    reading = reading_distribution(SENSORS["high gain, 13 e-"])
    light, codes = np.array([[1.0], [20.0], [300.0]]), np.arange(4)
    for method in (reading.pmf, reading.cdf):
        table = method(codes, light)
        assert table.shape == (3, 4)
        assert np.ndim(method(2, 20.0)) == 0
        assert method(2, 20.0) == table[1, 2]
        assert method(np.empty(0, int), 20.0).shape == (0,)
    for name in ("mean", "variance", "fisher_information"):
        method = getattr(reading, name)
        assert method(light).shape == (3, 1)
        assert np.ndim(method(20.0)) == 0
        assert method(20.0) == pytest.approx(method(light)[1, 0], rel=1e-12)
        assert method([]).shape == (0,)
    assert {part.shape for part in reading.cumulants(light)} == {(3, 1)}
    assert {np.ndim(part) for part in reading.cumulants(20.0)} == {0}


def test_readings_outside_the_range():
    """Codes below 0 and above full scale have probability 0, and the cumulative 0 and 1."""
    reading = reading_distribution(SENSORS["low gain, 13 e-"])
    for light in (0.0, 30.0, 300.0):
        assert np.array_equal(reading.pmf([-1, 64, 10**6], light), [0.0, 0.0, 0.0])
        assert np.array_equal(reading.cdf([-1, 64, 10**6], light), [0.0, 1.0, 1.0])


def test_example_in_the_docstring():
    """The example of `ReadingDistribution` prints what it says."""
    (example,) = doctest.DocTestFinder(recurse=False).find(ReadingDistribution, globs=vars(distribution))
    result = doctest.DocTestRunner().run(example)
    assert result.attempted > 0
    assert result.failed == 0
