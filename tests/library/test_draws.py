"""Random frames, compiled: their tables exactly, what they are drawn from, and the readings against the exact law.

Statistical tests have fixed seeds. Each states its false-alarm rate: that of all its cases together, with other seeds.
"""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import chi2, norm, poisson

from spotcheck.model import draws
from spotcheck.model.sensor import SensorModel
from spotcheck.model.simulate import frame_generators, frames
from tests.library.conftest import gaussian
from tests.reference.exact_law import moments, reading_law
from tests.reference.numpy_chain import draw

# False alarms of a test function, all its cases together.
ALARM = 1e-4
TABLE3 = SensorModel(0.11, 13.0, 70.0, np.inf, 0.0, 1023.0, 0.38)


def random_frame(light, sensor: SensorModel, seed, exposure_s: float = 0.0) -> np.ndarray:
    """One frame."""
    (readings,) = frames([light], exposure_s, sensor, [np.random.default_rng(seed)])
    return readings


def side_by_side(electrons: list[float], sensor: SensorModel, count: int, seed: int) -> np.ndarray:
    """Readings [`count`, mean] of frames in which the means alternate from pixel to pixel."""
    light = np.tile(np.array(electrons) * sensor.gain_dn_per_e, (50_000, 1))
    rng = np.random.default_rng(seed)
    return np.concatenate(list(frames([light] * (count // 50_000), 0.0, sensor, itertools.repeat(rng))))


def chi_square_p(values: np.ndarray, probability: np.ndarray) -> float:
    """P-value of readings against a law; neighbouring readings are pooled until 25 are expected, where χ² holds."""
    # Alias tables are exact to rounding, some 1e-16 an entry; 1e10 draws would show none of these.
    assert probability[values].min() > 1e-16
    expected, observed = probability * values.size, np.bincount(values, minlength=probability.size)
    pooled: list[list[float]] = [[0.0, 0.0]]
    for y in np.flatnonzero((expected > 0) | (observed > 0)):
        if pooled[-1][0] >= 25:
            pooled.append([0.0, 0.0])
        pooled[-1][0] += expected[y]
        pooled[-1][1] += observed[y]
    if len(pooled) > 1 and pooled[-1][0] < 25:
        last = pooled.pop()
        pooled[-1] = [a + b for a, b in zip(pooled[-1], last, strict=True)]
    if len(pooled) == 1:
        return 1.0
    want, got = np.array(pooled).T
    return float(chi2.sf(np.sum((got - want) ** 2 / want), len(want) - 1))


def z_scores(values: np.ndarray, probability: np.ndarray) -> tuple[float, float]:
    """Mean and variance of readings less those of a law, over their standard errors."""
    mean, variance, kurtosis = moments(probability)
    error = math.sqrt(variance / values.size)
    spread = variance * math.sqrt((kurtosis - 1) / values.size)
    return (values.mean() - mean) / error, (np.mean((values - mean) ** 2) - variance) / spread


# --- tables ---


def probabilities(tables: draws.Aliases, table: int) -> np.ndarray:
    """What a table of aliases stands for: each entry's own part, and what others leave to it."""
    part = slice(tables.start[table], tables.start[table] + tables.size[table])
    keep, other = np.minimum(tables.keep[part], 1.0), tables.other[part]
    assert keep.min() >= 0
    return (keep + np.bincount(other, 1.0 - keep, keep.size)) / keep.size


RNG = np.random.default_rng(1)
LAWS = {
    "certain": np.ones(1),
    "one of three": np.array([0.0, 1.0, 0.0]),
    "even": np.full(7, 1 / 7),
    "two": np.array([0.3, 0.7]),
    "many": RNG.dirichlet(np.ones(1000)),
    "of all sizes": RNG.dirichlet(np.full(300, 0.02)),
    "holes": np.where(np.arange(50) % 3 == 0, 1.0, 0.0) / 17,
    "Poisson": poisson.pmf(np.arange(80), 20.0) / poisson.pmf(np.arange(80), 20.0).sum(),
}


def test_alias_tables_are_exact():
    """Each law, from one set of tables, to rounding: an entry is 1/n of the whole and sums up 1e-16 of it at a time."""
    tables = draws.aliases(list(LAWS.values()), np.arange(len(LAWS)) * 10)
    np.testing.assert_array_equal(tables.size, [law.size for law in LAWS.values()])
    np.testing.assert_array_equal(tables.first, np.arange(len(LAWS)) * 10)
    for k, (name, law) in enumerate(LAWS.items()):
        np.testing.assert_allclose(probabilities(tables, k), law, rtol=0, atol=1e-15, err_msg=name)


def test_what_sums_to_1_but_for_rounding_is_made_to():
    """A law that lacks 1e-6 keeps its proportions."""
    law = np.array([0.2, 0.3, 0.5]) * (1 - 1e-6)
    np.testing.assert_allclose(probabilities(draws.aliases([law], [0]), 0), [0.2, 0.3, 0.5], rtol=0, atol=1e-15)


def test_tables_of_counts():
    """Poisson laws of 0, 1/16 … 511/16 and of v · 32 and v · 32², v = 0 … 31, but for 1e-15 of their tails; the larger
    set begins with the smaller, so that a bright pixel changes no other's reading."""
    tables = draws.count_tables(3)
    means = [*(np.arange(512) / 16), *(np.arange(32) * 32.0), *(np.arange(32) * 1024.0)]
    assert tables.start.size == len(means)
    for k, mean in enumerate(means):
        counts = tables.first[k] + np.arange(tables.size[k])
        assert poisson.cdf(counts[0] - 1, mean) + poisson.sf(counts[-1], mean) < 1e-15
        # The common error of scipy's function, 1e-13 for large counts, goes with the sum.
        want = poisson.pmf(counts, mean)
        np.testing.assert_allclose(probabilities(tables, k), want / want.sum(), rtol=0, atol=1e-15)
    small = draws.count_tables(2)
    for few, many in zip(small, tables, strict=True):
        np.testing.assert_array_equal(few, many[: few.size])


@pytest.mark.parametrize("sensor", [TABLE3, SensorModel(2.0, 1.5, 0.0, np.inf, 20.0, 4095.0)], ids=["black 0", "quiet"])
def test_tables_of_readings(sensor):
    """Of the law of one reading at 0, 1/16 … 32 e-, by the plain sum; its readings above the last one are 1e-12."""
    tables = draws.reading_tables(sensor)
    assert tables.start.size >= 512 and not tables.first.any() and np.ptp(tables.size) == 0
    for k in range(0, 512, 7):
        want = reading_law(k / 16, sensor)
        np.testing.assert_allclose(probabilities(tables, k), want[: tables.size[k]], rtol=0, atol=2e-12)


def test_split_into_level_and_rest():
    """A mean below 32 e-, and above it its part below 32, is a level of 1/16 e- and a rest; u e^rest to rounding."""
    rng = np.random.default_rng(5)
    low = np.concatenate([rng.uniform(0, 32, 5000), [0.0, 1 / 16, np.nextafter(1 / 16, 0), np.nextafter(32, 0), 31.5]])
    electrons = low + np.concatenate([rng.integers(0, 2000, 5000), np.zeros(5)]) * 32
    low = np.fmod(electrons, 32)
    u = rng.random(low.size)
    uniform, level, rest = u.copy(), np.empty(low.size, np.int32), np.empty(low.size)
    mean = np.empty(low.size)
    draws._split(electrons, 1.0, 0.0, np.inf, mean, uniform, level, rest)
    np.testing.assert_array_equal(mean, electrons)
    np.testing.assert_array_equal(level, np.floor(16 * low))
    np.testing.assert_array_equal(rest, low - level / 16)
    # Two roundings of numbers up to 1.07.
    np.testing.assert_allclose(uniform, u * np.exp(rest), rtol=0, atol=5e-16)


def test_light_to_electrons():
    """Light over K plus dark electrons; below 0 it counts as none, and beyond what any clip lets through as that."""
    light = np.array([-3.0, 0.0, 1.1, 1e9])
    mean, rest, level = np.empty(4), np.empty(4), np.empty(4, np.int32)
    draws._split(light, 1 / 0.11, 2.0, 5e4, mean, np.full(4, 0.5), level, rest)
    np.testing.assert_allclose(mean, [2.0, 2.0, 12.0, 5e4], rtol=1e-15)


def test_light_beyond_all_bounds_reads_full_scale():
    """Tables grow with the mean that is drawn; light that is clipped for certain must not ask for any."""
    (got,) = frames([np.full((2, 3), 1e15)], 0.0, SensorModel(0.11, 13.0, full_scale_dn=1023.0), frame_generators(1, 1))
    assert (got == 1023).all()


# --- distributions ---

SENSORS = {
    "counts": SensorModel(1.0, 0.0, full_scale_dn=4095.0),
    "the paper's, clipped at black": TABLE3._replace(dark_current_e_per_s=0.0),
    "quiet": SensorModel(2.0, 1.5, black_level_dn=20.0, full_scale_dn=4095.0),
    "coarse steps": SensorModel(0.02, 13.0, black_level_dn=5.3, full_scale_dn=255.0),
    "every second count is half way": SensorModel(0.5, 0.0, full_scale_dn=255.0),
    "full well": SensorModel(2.0, 0.7, full_well_e=20.0, black_level_dn=3.5, full_scale_dn=4095.0),
    "full well without noise": SensorModel(1.0, 0.0, full_well_e=40.0, black_level_dn=3.0, full_scale_dn=255.0),
    "full scale": SensorModel(10.0, 0.4, black_level_dn=5.0, full_scale_dn=255.0),
    "black below zero": SensorModel(0.8, 2.0, black_level_dn=-6.4, full_scale_dn=255.0),
    "no full scale": SensorModel(0.25, 3.0, black_level_dn=60.0),
}
# On levels of the tables and between, with rests up to 1/16, on both sides of 32.
FAINT = [0.0, 0.013, 0.0624, 0.49, 1.0, 3.0625, 7.03, 15.999, 31.97, 31.9999, 32.0, 33.3, 49.9]
FAINT_DRAWS = 1_000_000


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_whole_distribution_of_faint_light(sensor):
    """χ² of all readings of each mean below 50 e-, the means mixed in a frame.

    False alarm 1e-4 in all: 130 pairs of mean and sensor.
    """
    readings = side_by_side(FAINT, sensor, FAINT_DRAWS, 21)
    for k, nu in enumerate(FAINT):
        p = chi_square_p(readings[:, k], reading_law(nu, sensor))
        assert p > ALARM / (len(SENSORS) * len(FAINT)), (nu, p)


BRIGHT_SENSORS = {
    "counts": SensorModel(1.0, 0.0, full_scale_dn=65535.0),
    "the paper's noise": SensorModel(0.11, 13.0, black_level_dn=40.0, full_scale_dn=65535.0),
    "quiet": SensorModel(0.5, 1.5, black_level_dn=100.0, full_scale_dn=65535.0),
}
# On both sides of where a mean takes another digit to the base 32, and between.
BRIGHT = [32.0, 50.0, 63.97, 64.0, 256.5, 1023.97, 1024.0, 1024.03, 5000.5, 32767.97, 32768.0, 32768.5, 60000.0]
BRIGHT_DRAWS = 200_000


@pytest.mark.parametrize("sensor", BRIGHT_SENSORS.values(), ids=BRIGHT_SENSORS)
def test_bright_light(sensor):
    """Mean, variance and χ² of all readings against exact sums; each mean is the brightest of its frame.

    False alarm 1e-4 in all: three numbers of 39 pairs of mean and sensor; |z| < 4.93.
    """
    alarm = ALARM / (3 * len(BRIGHT_SENSORS) * len(BRIGHT))
    for k, nu in enumerate(BRIGHT):
        law, readings = reading_law(nu, sensor), side_by_side([nu], sensor, BRIGHT_DRAWS, 100 + k)[:, 0]
        z = z_scores(readings, law)
        assert np.abs(z).max() < norm.isf(alarm / 2), (nu, z)
        p = chi_square_p(readings, law)
        assert p > alarm, (nu, p)


WELL = TABLE3._replace(full_well_e=7270.0)
CLIPPED = {
    "below the well": (6950.0, WELL),
    "at the well": (7270.0, WELL),
    "above the well": (7600.0, WELL),
    "far above the well": (60000.0, WELL),
    "a small well without noise": (95.5, SensorModel(0.5, 0.0, full_well_e=100.5, black_level_dn=3.0)),
    "below full scale": (9100.0, TABLE3),
    "at full scale": (9300.0, TABLE3),
    "above full scale": (9600.0, TABLE3),
    "far above full scale": (60000.0, TABLE3),
    "black takes most": (55.0, SensorModel(0.5, 8.0, black_level_dn=-30.0, full_scale_dn=255.0)),
    "the end of 16 bit": (3280.0, SensorModel(20.0, 2.0)),
}


@pytest.mark.parametrize(("nu", "sensor"), CLIPPED.values(), ids=CLIPPED)
def test_clips(nu, sensor):
    """χ² of readings that the well, full scale, black or the container clips; false alarm 1e-4 for all 11."""
    readings = side_by_side([nu], sensor, 200_000, 23)[:, 0]
    assert chi_square_p(readings, reading_law(nu, sensor)) > ALARM / len(CLIPPED)


@pytest.mark.parametrize("light_e", [0.0, 6.03, 40.7])
@pytest.mark.parametrize("dark_e", [0.0, 7.0, 1000.3])
def test_dark_current_adds_its_electrons(light_e, dark_e):
    """Light and dark electrons have one Poisson law; without either a reading is read noise alone, and with none of it
    the black level. False alarm 1e-4 for all 9 χ²."""
    s = SensorModel(2.0, 1.5, 1e4 * dark_e, np.inf, 20.4, 4095.0)
    readings = random_frame(np.full((400, 500), 2.0 * light_e), s, 24, exposure_s=1e-4)
    if light_e == dark_e == 0:
        law = np.diff(norm.cdf((np.arange(-1, 4095) + 0.5 - 20.4) / 3.0), append=1.0)
        assert (random_frame(np.zeros((50, 50)), s._replace(read_noise_e=0.0), 1) == 20).all()
    else:
        law = reading_law(light_e + dark_e, s)
    assert chi_square_p(readings.ravel(), law) > ALARM / 9


def test_less_than_no_light_is_no_light():
    """Where a model goes below 0, the frame is that of 0."""
    light = gaussian(40, 300.0, 20, 20, 4.0) - 20.0
    np.testing.assert_array_equal(random_frame(light, TABLE3, 3), random_frame(np.maximum(light, 0), TABLE3, 3))
    assert not np.array_equal(random_frame(light, TABLE3, 3), random_frame(light + 20, TABLE3, 3))


# --- independence ---

LAGS = [(0, 1), (0, 2), (1, 0), (7, 11)]
EVEN = [0.0, 0.03, 7.03, 31.99, 49.9, 1023.97, 32768.5]
SIDE = 1000


@pytest.mark.parametrize("nu", EVEN)
def test_pixels_are_independent(nu):
    """A frame of even light: correlation of neighbours, and χ² of how the quarters of their readings meet.

    All pixels share one generator, and those with an electron in the rest wait until the others of a chunk are drawn.
    |r| < 4/√N: false alarm 6e-5 each, 1.8e-3 for all 28; χ²: 1e-4 for all 28.
    """
    sensor = SensorModel(1.0, 2.0, black_level_dn=20.0, full_scale_dn=65535.0)
    readings = random_frame(np.full((SIDE, SIDE), nu), sensor, 25).astype(float)
    # Spread over its step, so that there are quarters.
    readings += np.random.default_rng(0).uniform(-0.5, 0.5, readings.shape)
    quarter = np.searchsorted(np.quantile(readings, [0.25, 0.5, 0.75]), readings)
    centred = (readings - readings.mean()) / readings.std()
    for down, across in LAGS:
        here = (slice(down, None), slice(across, None))
        there = (slice(0, SIDE - down), slice(0, SIDE - across))
        r = np.mean(centred[here] * centred[there])
        assert abs(r) < 4 / SIDE, (down, across, r)
        table = np.bincount((4 * quarter[here] + quarter[there]).ravel(), minlength=16).reshape(4, 4)
        want = table.sum(1)[:, None] * table.sum(0) / table.sum()
        assert chi2.sf(np.sum((table - want) ** 2 / want), 9) > ALARM / (len(LAGS) * len(EVEN)), (down, across)


# --- against the plain chain ---


@pytest.mark.parametrize("black", [0.0, 40.0])
def test_spot_as_the_plain_chain_draws_it(black):
    """Means and variances of each pixel over 2000 frames of a spot, bright and faint, against 2000 of numpy.

    Largest z of 1600 pixels and Σ z² of both, two-sided: 1e-4 in all (six numbers of two cases).
    """
    sensor, count = TABLE3._replace(black_level_dn=black, dark_current_e_per_s=2e4), 2000
    light = gaussian(40, 950.0, 19.3, 20.4, 5.0)
    rng = np.random.default_rng(27)
    own = np.array(list(frames(itertools.repeat(light, count), 1e-4, sensor, frame_generators(28, count))), float)
    plain = np.array([draw(light, 1e-4, sensor, rng) for _ in range(count)], float)
    z = []
    squares = [(a - a.mean(axis=0)) ** 2 for a in (own, plain)]
    for a, b in ((own, plain), squares):
        # The variance of each from both, which are draws of one law.
        error = np.sqrt((a.var(axis=0) + b.var(axis=0)) / count)
        z.append((a.mean(axis=0) - b.mean(axis=0)) / error)
    alarm = ALARM / 8
    for each in z:
        assert np.abs(each).max() < norm.isf(alarm / 2 / light.size)
        total = float(np.sum(each**2))
        assert chi2.ppf(alarm / 2, light.size) < total < chi2.isf(alarm / 2, light.size)


# --- streams ---


def test_equal_seeds_equal_frames():
    """Whatever the order, however many frames a call has and whatever else they show; other seeds, other frames."""
    light = gaussian(60, 300.0, 30, 30, 8.0)
    four = list(frames([light] * 4, 1e-4, TABLE3, frame_generators(7, 4)))
    backward = list(frames([light] * 4, 1e-4, TABLE3, frame_generators(7, 4)[::-1]))[::-1]
    single = [next(frames([light], 1e-4, TABLE3, [g])) for g in frame_generators(7, 9)]
    mixed = list(frames([9 * light, light, light[:5], light], 1e-4, TABLE3, frame_generators(7, 4)))
    for a, b, c in zip(four, backward, single[:4], strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    for k in (1, 3):
        np.testing.assert_array_equal(mixed[k], four[k])
    others = [*single, *frames([light] * 2, 1e-4, TABLE3, frame_generators(8, 2))]
    for a, b in itertools.combinations(others, 2):
        # Two readings of the border agree in 47 %, as black takes 64 % of them; others in 20 %; 0.01 is one sd.
        assert np.mean(a == b) < 0.53


def test_a_bright_pixel_changes_no_other():
    """Its counts need larger tables and come when all others are drawn."""
    light = gaussian(60, 300.0, 30, 30, 8.0)
    brighter = light.copy()
    brighter[-1, -1] = 1000.0 * 0.11 * 40
    a, b = (random_frame(own, TABLE3._replace(full_scale_dn=65535.0), 4) for own in (light, brighter))
    assert b[-1, -1] > 3000
    np.testing.assert_array_equal(a.ravel()[:-1], b.ravel()[:-1])


@pytest.mark.parametrize("shape", [(1, 1), (1, 2048), (3, 683), (2049, 1), (0, 5)])
def test_shapes(shape):
    """A frame has its light's shape, whatever part of a chunk is left over; every pixel is drawn."""
    sensor = SensorModel(1.0, 0.0, full_well_e=100.0, black_level_dn=1.0, full_scale_dn=255.0)
    got = random_frame(np.full(shape, 1000.0), sensor, 0)
    assert got.shape == shape and got.dtype == np.uint16 and (got == 101).all()


def test_light_in_any_memory_order():
    """A turned or sliced image is read by its rows and columns."""
    light = gaussian(60, 300.0, 30, 20, 8.0)
    for own in (light.T, light[::2, 1::3], np.asfortranarray(light)):
        np.testing.assert_array_equal(random_frame(own, TABLE3, 5), random_frame(own.copy("C"), TABLE3, 5))


def test_frames_are_made_one_at_a_time():
    """Of endless light and generators each frame takes one, when asked for."""
    taken = {"light": 0, "rng": 0}

    def counted(name, values):
        for value in values:
            taken[name] += 1
            yield value

    light = counted("light", itertools.repeat(np.full((20, 20), 50.0)))
    rng = counted("rng", (np.random.default_rng(k) for k in itertools.count()))
    stream = frames(light, 1e-4, TABLE3, rng)
    assert taken == {"light": 0, "rng": 0}
    for k in range(1, 4):
        assert next(stream).shape == (20, 20)
        assert taken == {"light": k, "rng": k}
