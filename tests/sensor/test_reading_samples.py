"""Random readings against the exact distribution: histograms, single pixels' values, and independence.

Seeds are fixed, so that a test passes or fails for good. The false-alarm rate of a statistical test says how often
another seed would fail it.
"""

import math

import numpy as np
import pytest
from scipy.stats import chi2, norm

from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.sampling import CODE_SHIFT, LEAST_NOISE_E, NODES_PER_SD, WORD_SHIFT, AliasTables, tabulate_aliases
from tests.samples.reading_distributions import LEVELS, dead_zone, sensor, upper_end

SAMPLES = 1_000_000
LIGHTS = 20
# False-alarm rate of one test over all its p-values (Bonferroni).
FALSE_ALARM = 1e-4
# Smallest expected number of readings in a bin: there the tail of χ² holds down to probabilities of 1e-6.
LEAST_EXPECTED = 100.0


def soft_full_well(x):
    """A charge that fills softly towards 150 DN."""
    return x / np.sqrt(1 + (x / 150.0) ** 2)


def clip_at_90(x):
    """A charge that stops at 90 DN."""
    return np.minimum(x, 90.0)


SENSORS = {
    "12 bit, 2 e-, full well": sensor(0.11, 2.0, 12, 12.0, 15000.0),
    "10 bit, 13 e-": sensor(0.11, 13.0, 10),
    "10 bit, 13 e-, black level 12": sensor(0.11, 13.0, 10, 12.0),
    "no read noise": sensor(0.7, 0.0, 8, 3.3),
    "0.3 e-": sensor(0.11, 0.3, 10, 3.3),
    "0.3 e-, two codes per electron": sensor(2.0, 0.3, 10, 12.0),
    "curvature": sensor(0.25, 3.0, 10, 12.0, bend=0.2),
    "curvature below 0": sensor(0.25, 3.0, 10, 12.0, bend=-0.3),
    "dark current": sensor(0.5, 4.0, 8, 5.0, dark_e=20.0),
    "all stages": sensor(0.5, 2.0, 8, 3.3, 600.0, smear_e=7.0, charge=(soft_full_well,), digital=(dead_zone,)),
    "charge clip": sensor(0.5, 6.0, 8, 3.3, charge=(clip_at_90,)),
}


def lights_between_nodes(reading: ReadingDistribution) -> np.ndarray:
    """Return lights [DN] from near black through the upper end, each in the middle between two nodes of the sampler.

    Readings come from one of both nodes there, so that the sampled variance is largest against the true one.
    """
    gain, end = reading.sensor.gain_dn_per_e, upper_end(reading)
    spread = math.sqrt(reading.noise_dn**2 + gain * end)
    near_black = np.array([0.02, 0.3, 1.1, 2.9, 7.0, 19.0]) * gain
    near_end = end + spread * np.array([-3.0, -1.5, -0.6, 0.1, 0.9, 2.2, 3.7])
    light = np.concatenate([near_black, end * np.array([0.03, 0.1, 0.23, 0.41, 0.6, 0.8]), near_end, [1.5 * end]])
    assert light.size == LIGHTS
    noise_e = max(reading.sensor.read_noise_e, LEAST_NOISE_E)
    node = np.floor((np.sqrt(light / gain + noise_e**2) - noise_e) * 2 * NODES_PER_SD) + 0.5
    return gain * ((noise_e + node / (2 * NODES_PER_SD)) ** 2 - noise_e**2)


def p_value(readings: np.ndarray, probability: np.ndarray) -> float:
    """Return the p-value of Pearson's χ² of readings against the probability of the codes 0, 1, 2 …

    Codes that are expected less than `LEAST_EXPECTED` times join the next one. NaN if a single bin is left.
    """
    count = np.bincount(readings, minlength=probability.size).astype(float)
    assert count.size == probability.size, "a reading above full scale"
    expected = probability * readings.size
    # A code that cannot occur must not occur.
    assert not np.any(count[probability < 1e-14])
    bins, filled = np.zeros(expected.size, int), 0.0
    for k in range(1, expected.size):
        filled += expected[k - 1]
        bins[k] = bins[k - 1] + (filled >= LEAST_EXPECTED)
        filled = 0.0 if filled >= LEAST_EXPECTED else filled
    if filled + expected[-1] < LEAST_EXPECTED and bins[-1] > 0:
        bins[bins == bins[-1]] -= 1
    observed, expected = np.bincount(bins, count), np.bincount(bins, expected)
    if observed.size == 1:
        return math.nan
    return float(chi2.sf(np.sum((observed - expected) ** 2 / expected), observed.size - 1))


def assert_p_values(values: list[float]) -> None:
    """Fail if the smallest of p-values is too small for their number, at a false-alarm rate of 1e-4."""
    tested = [value for value in values if not math.isnan(value)]
    assert len(tested) >= len(values) // 2
    assert min(tested) > FALSE_ALARM / len(tested), values


@pytest.mark.parametrize("reading", SENSORS.values(), ids=SENSORS)
def test_histograms(reading):
    """A million readings at each of 20 lights follow the exact probabilities; false-alarm rate 1e-4 per sensor."""
    rng = np.random.default_rng(11)
    codes = np.arange(int(reading.sensor.full_scale_dn) + 1)
    values = []
    for light in lights_between_nodes(reading):
        readings = reading.sample(np.full(SAMPLES, light), rng)
        assert readings.dtype == np.uint16
        values.append(p_value(readings, reading.pmf(codes, light)))
    assert_p_values(values)


def probability_of_node(tables: AliasTables, node: int, top: int) -> np.ndarray:
    """Return the probability of the codes 0 … `top` at a node, from its alias table."""
    packed = tables.nodes[node]
    start, first_code = int(packed >> WORD_SHIFT), int(packed >> CODE_SHIFT) & 0xFFFF
    width = int(packed) & ((1 << int(CODE_SHIFT)) - 1)
    words = tables.words[start : start + width]
    other, own = words & tables.mask, np.arange(width)
    share = (words - other) / 2.0**32
    probability = (np.bincount(own, share, width) + np.bincount(other, 1 - share, width)) / width
    return np.pad(probability, (first_code, top + 1 - first_code - width))


@pytest.mark.parametrize("reading", SENSORS.values(), ids=SENSORS)
def test_tables_hold_the_exact_distribution(reading):
    """The alias tables give each code its probability, and the mixture of two nodes is as close as promised.

    An alias table rounds the probability in a word to 2^(b−32), if b bits number a code, and leaves out what is less
    probable than 1e-13 at either end. Halfway between two nodes, a probability is off by 1.3e-4 |z² − 1| of itself, z
    standard deviations from the mean, where light is bright enough for a nearly normal distribution and no clip is
    near; terms of higher order are below 1.3e-4.
    """
    tables, top = tabulate_aliases(reading), int(reading.sensor.full_scale_dn)
    spread = math.sqrt(reading.noise_dn**2 + reading.sensor.gain_dn_per_e * upper_end(reading))
    compared = 0
    noise_e = tables.first_root
    codes = np.arange(top + 1)
    gain = reading.sensor.gain_dn_per_e
    dark_dn = gain * reading.sensor.dark_current_e_per_s
    for light in lights_between_nodes(reading):
        node = round((math.sqrt((light + dark_dn) / gain + noise_e**2) - noise_e) / tables.step - 0.5)
        if node + 1 >= tables.nodes.size:
            assert tables.is_complete and light > upper_end(reading) - 5 * spread
            continue
        at_nodes = gain * ((noise_e + tables.step * np.array([node, node + 1])) ** 2 - noise_e**2) - dark_dn
        pair = np.array([probability_of_node(tables, node, top), probability_of_node(tables, node + 1, top)])
        exact = reading.pmf(codes, np.maximum(at_nodes, -dark_dn)[:, None])
        np.testing.assert_allclose(pair, exact, rtol=1e-6, atol=(int(tables.mask) + 1) / 2.0**32)
        if 20 * gain < light < upper_end(reading) - 5 * spread:
            middle = reading.pmf(codes, at_nodes.mean())
            z = (codes - reading.mean(at_nodes.mean())) / math.sqrt(reading.variance(at_nodes.mean()))
            near = (np.abs(z) < 4) & (middle > 1e-6)
            error = np.abs(pair.mean(axis=0) - middle)
            assert np.all((error < 1.3e-4 * (z**2 + 1) * middle)[near])
            compared += 1
    assert compared >= 3


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("light", [0.0, 40.0, 300.0, 1014.0])
def test_values_of_single_pixels(light):
    """Readings with their own smear, clip level and offset follow the exact distribution of such a sensor.

    A third of the pixels has each of three sets of values, mixed within one call; false-alarm rate 1e-4 per light.
    """
    reading = sensor(0.5, 3.0, 10, 3.3)
    sets = [(0.0, np.inf, 0.0), (6.5, 250.0, 0.4), (20.0, 30.0, -2.25)]
    which = np.random.default_rng(2).integers(3, size=SAMPLES)
    smear_e, level, offset = (np.array(column)[which] for column in zip(*sets, strict=True))
    readings = reading.sample(
        np.full(SAMPLES, light), np.random.default_rng(3), smear_e=smear_e, charge_level=level, offset_dn=offset
    )
    assert readings.dtype == np.uint16
    values = []
    for k, (own_smear, own_level, own_offset) in enumerate(sets):
        model = SensorModel(0.5, 3.0, black_level_dn=3.3 + own_offset, full_scale_dn=1023.0)
        alike = ReadingDistribution(model, smear_e=own_smear, charge_levels=((1.0, own_level),))
        values.append(p_value(readings[which == k], alike.pmf(np.arange(1024), light)))
    assert_p_values(values)


@pytest.mark.parametrize("noise_e", [0.0, 5.0])
def test_shares_of_pixels_with_their_own_clip_level(noise_e):
    """Readings of pixels whose charge stops at one of three levels follow the mixture; false-alarm rate 1e-4."""
    reading = sensor(0.5, noise_e, 8, 3.3, smear_e=2.0, charge_levels=LEVELS)
    rng, codes = np.random.default_rng(4), np.arange(256)
    lights = (1.0, 15.0, 24.0, 35.0, 60.0, 200.0)
    assert_p_values([p_value(reading.sample(np.full(SAMPLES, at), rng), reading.pmf(codes, at)) for at in lights])


def test_steps_and_tables_agree_for_unequal_light():
    """Drawn step by step or from tables, readings of an image have the same distribution in each pixel.

    Every pixel's readings are turned into uniform numbers by its cumulative probability and a random number, and these
    are compared with the uniform distribution in 200 bins; false-alarm rate 1e-4.
    """
    reading = sensor(0.11, 13.0, 10, 12.0)
    # Few different lights, so that the exact distribution is summed only a few thousand times.
    light = np.resize(np.linspace(0.0, 1100.0, 2003), 1_000_000)
    values = []
    for draw in (reading.sample, reading.sample_steps):
        readings = draw(light, np.random.default_rng(5)).astype(int)
        above = reading.cdf(readings, light)
        below = np.where(readings > 0, above - reading.pmf(readings, light), 0.0)
        uniform = below + (above - below) * np.random.default_rng(6).random(light.size)
        count = np.histogram(uniform, 200, (0.0, 1.0))[0]
        expected = light.size / 200
        values.append(float(chi2.sf(np.sum((count - expected) ** 2) / expected, 199)))
    assert_p_values(values)


def test_beyond_the_tables():
    """A 16-bit sensor's tables end before full scale; brighter readings follow the exact distribution as well.

    Lights lie below, around and beyond the last node, alone and mixed in one call; false-alarm rate 1e-4.
    """
    reading = sensor(0.11, 2.0, 16, 100.0)
    tables = tabulate_aliases(reading)
    last = 0.11 * ((tables.first_root + tables.step * (tables.nodes.size - 2)) ** 2 - tables.first_root**2)
    assert not tables.is_complete
    assert last < 60_000
    rng, codes = np.random.default_rng(7), np.arange(65536)
    lights = np.array([0.5 * last, 0.999 * last, last, last + 0.01, 1.2 * last, 65_400.0])
    which = rng.integers(lights.size, size=SAMPLES)
    readings = reading.sample(lights[which], rng)
    values = [p_value(readings[which == k], reading.pmf(codes, light)) for k, light in enumerate(lights)]
    assert_p_values(values)
    assert np.all(reading.sample(np.full(100, 1e9), rng) == 65535)
    assert np.all(reading.sample(np.full(100, np.inf), rng) == 65535)


def test_without_full_scale():
    """Without a full scale, codes above the largest 16-bit integer are stored as that; false-alarm rate 1e-4."""
    reading = ReadingDistribution(SensorModel(300.0, 2.0))
    light, rng, codes = 65_100.0, np.random.default_rng(16), np.arange(65_535)
    probability = np.append(reading.pmf(codes, light), 1 - reading.cdf(65_534, light))
    readings = reading.sample(np.full(SAMPLES, light), rng)
    assert 0.2 < probability[-1] < 0.8
    assert_p_values(
        [p_value(readings, probability), p_value(reading.sample_steps(np.full(SAMPLES, light), rng), probability)]
    )
    assert np.all(reading.sample(np.full(5000, 1e6), rng) == 65535)


def test_independence_of_pixels():
    """Readings of one call are uncorrelated at lags 1 … 2048, and with those of the next call of the generator.

    The correlation of N independent pairs is normal with a variance of 1/N; squares are tested as well. Lags are powers
    of two with their neighbours, as the compiler takes pixels together, and the pixels that share a buffer (2048).
    False-alarm rate 1e-4 over all 28 correlations.
    """
    reading, size = sensor(0.11, 13.0, 10, 40.0), 4_000_000
    rng = np.random.default_rng(8)
    first, second = (reading.sample(np.full(size, 300.0), rng).astype(float) for _ in range(2))
    correlations = []
    for power in (1, 2):
        a, b = (np.abs(x - x.mean()) ** power * np.sign(x - x.mean()) ** power for x in (first, second))
        a, b = ((x - x.mean()) / x.std() for x in (a, b))
        for lag in (1, 2, 8, 15, 16, 17, 32, 64, 2047, 2048, 2049, 4096):
            correlations.append(np.mean(a[lag:] * a[:-lag]))
        correlations += [np.mean(a * b), np.mean(a[1:] * b[:-1])]
    limit = norm.isf(FALSE_ALARM / len(correlations) / 2) / math.sqrt(size)
    assert len(correlations) == 28
    assert np.max(np.abs(correlations)) < limit


def test_equal_seeds_give_equal_readings():
    """Equal seeds give equal readings, whichever way they are drawn; another seed or a second call gives others."""
    reading, light = sensor(0.11, 13.0, 10, 12.0), np.linspace(0, 1100, 5000)
    for options in ({}, {"offset_dn": 0.5}, {"smear_e": np.linspace(0, 9, 5000)}):
        one, other = np.random.default_rng(9), np.random.default_rng(9)
        first = reading.sample(light, one, **options)
        assert np.array_equal(first, reading.sample(light, other, **options))
        assert not np.array_equal(first, reading.sample(light, one, **options))
        assert not np.array_equal(first, reading.sample(light, np.random.default_rng(10), **options))


def test_shapes():
    """Readings are uint16 in the shape of the light, for scalars, lists, empty, strided and broadcast arrays."""
    reading, rng = sensor(0.11, 13.0, 10, 12.0), np.random.default_rng(12)
    for options in ({}, {"offset_dn": 0.5}):
        for light in (100.0, [1, 2, 3], np.ones((3, 0)), np.ones((4, 5))[:, ::2], np.broadcast_to(7.0, (2, 3, 4))):
            readings = reading.sample(light, rng, **options)
            assert readings.dtype == np.uint16
            assert np.shape(readings) == np.shape(light)
    # The order of pixels is kept: light rises along the last axis and the columns follow.
    light = np.asfortranarray(np.broadcast_to([0.0, 300.0, 900.0], (1000, 3)))
    assert reading.sample(light, rng).mean(axis=0) == pytest.approx([12.0, 312.0, 912.0], abs=3.0)


def test_light_below_zero_counts_as_none():
    """Light below 0 gives the readings of no light, dark current included, however they are drawn.

    The mean of 100 000 readings is off by less than 5 of its standard deviations; false-alarm rate 1e-6.
    """
    reading = sensor(1.0, 2.0, 8, 3.0, dark_e=20.0)
    expected, error = reading.mean(0.0), 5 * math.sqrt(reading.variance(0.0) / 1e5)
    for options in ({}, {"offset_dn": np.zeros(100_000) + 1e-12}):
        readings = reading.sample(np.full(100_000, -10.0), np.random.default_rng(13), **options)
        assert abs(readings.mean() - expected) < error


def test_full_scale_between_two_codes():
    """A full scale that is no whole number, as a linearized sensor has, ends at the same code in every way."""
    reading = ReadingDistribution(SensorModel(1.0, 2.0, full_scale_dn=255.6))
    light, rng = np.full(10, 400.0), np.random.default_rng(14)
    assert np.all(reading.sample(light, rng) == 256)
    assert np.all(reading.sample(light, rng, offset_dn=1e-12) == 256)
    assert reading.mean(400.0) == pytest.approx(256.0, rel=1e-12)


def test_light_that_is_no_number():
    """NaN light is an error rather than a reading."""
    with pytest.raises(ValueError, match="NaN"):
        sensor(0.11, 13.0, 10).sample(np.array([1.0, np.nan]), np.random.default_rng(15))
