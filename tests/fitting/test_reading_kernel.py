"""The compiled kernel of the spot fit: against its approximation in plain numpy, and its distance to the exact law."""

from typing import NamedTuple

import numpy as np
import pytest

from spotcheck.fitting.reading_kernel import (
    ReadingLaw,
    build_reading_law,
    compute_row_variances,
    score_row_by_likelihood,
)
from spotcheck.sensor import ReadingDistribution, SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps
from tests.reference.numpy_kernel import Pixel, Tables, one_pixel, one_pixel_on_maps, reading_variance, tables_of
from tests.sensor.test_faint import SENSORS as FAINT_SENSORS

pytestmark = pytest.mark.filterwarnings("error")
# Both compute in double precision. A score is a difference of terms as large as the inverse standard deviation, so that
# it is compared relative to that where it is smaller.
RELATIVE = 1e-10
# Far above full scale information is 1e-300 and has no digits left.
NOTHING = 1e-280


def by_kernel(
    readings: np.ndarray, electrons: np.ndarray, law: ReadingLaw
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return score, information and χ² of each pair; χ² is NaN where the kernel counts none."""
    score, information, chi2 = np.empty((3, readings.size))
    for k in range(readings.size):
        one = slice(k, k + 1)
        total, used = score_row_by_likelihood(
            readings[one], electrons[one], False, 0, None, law, information[one], score[one]
        )
        chi2[k] = total if used else np.nan
    return score, information, chi2


def some_pixels(sensor: SensorModel, tables: Tables, rng: np.random.Generator, count: int):
    """Return readings [DN] and mean electrons [e-]: below black, faint, bright, and about full scale and the well."""
    top = sensor.full_scale_dn if np.isfinite(sensor.full_scale_dn) else 5000.0
    end = min(tables.signal(top), sensor.full_well_e)
    low = tables.faint.lowest_e
    faint = rng.uniform(1.3 * low - 2, min(1.2 * tables.highest, 1.3 * end) + 1, count)
    bright, near_end = rng.uniform(0, 1.3 * end, count), end * rng.uniform(0.9, 1.1, count)
    # Levels, where both ways of looking up meet.
    levels = tables.faint.levels[rng.integers(0, tables.count, 5)]
    electrons = np.concatenate([faint, bright, near_end, levels])
    sd = np.sqrt(np.maximum(electrons, 0) + tables.noise)
    readings = sensor.black_level_dn + sensor.gain_dn_per_e * (electrons + sd * rng.normal(0, 2.5, electrons.size))
    # Some that nothing makes likely.
    readings[::9] = rng.uniform(0, top, readings[::9].size)
    return np.clip(np.rint(readings), 0, top), electrons


def assert_equal(got, want: list[Pixel], electrons: np.ndarray, tables: Tables, what) -> None:
    """Compare score, information and χ² of pixels."""
    score, information, chi2 = (np.array([getattr(p, name) for p in want]) for name in ("score", "information", "chi2"))
    scale = np.maximum(np.abs(score), 1 / np.sqrt(np.maximum(electrons, 0) + tables.noise))
    assert np.max(np.abs(got[0] - score) / scale) < RELATIVE, what
    np.testing.assert_allclose(got[1], information, rtol=RELATIVE, atol=NOTHING, err_msg=str(what))
    np.testing.assert_allclose(got[2], chi2, rtol=RELATIVE, atol=RELATIVE, err_msg=str(what))


def random_sensor(rng: np.random.Generator) -> SensorModel:
    """Return any sensor: with and without read noise, clips and curvature, black levels below 0 too."""
    return SensorModel(
        gain_dn_per_e=10 ** rng.uniform(-1.7, 0.9),
        read_noise_e=rng.choice([0.0, *10 ** rng.uniform(-0.7, 1.3, 4)]),
        full_well_e=rng.choice([np.inf, 10 ** rng.uniform(1.5, 4)]),
        black_level_dn=rng.uniform(-5, 60),
        full_scale_dn=rng.choice([255.0, 1023.0, 4095.0, np.inf]),
        response_bend=rng.choice([0.0, rng.uniform(-0.2, 0.2)]),
    )


def test_the_kernel_is_its_numpy_version_for_random_sensors():
    """Score, information and χ² to 1e-10 for 1,000 random sensors, each with 26 random pixels."""
    rng = np.random.default_rng(46)
    for _ in range(1000):
        sensor = random_sensor(rng).without_curvature()
        tables, law = tables_of(sensor), build_reading_law(sensor)
        assert law.highest_level == tables.highest
        readings, electrons = some_pixels(sensor, tables, rng, 7)
        want = [one_pixel(float(y), float(nu), tables) for y, nu in zip(readings, electrons, strict=True)]
        assert_equal(by_kernel(readings, electrons, law), want, electrons, tables, sensor)


@pytest.mark.parametrize("stderr", [(0.0, 0.0), (0.4, 0.02)], ids=["known", "uncertain"])
def test_pixels_with_offsets_and_gains_of_their_own(stderr):
    """Score, information and χ² to 1e-10 with maps of the pixels, faint and bright, for 40 random sensors."""
    rng, shape = np.random.default_rng(6), (2, 30)
    for _ in range(40):
        sensor = random_sensor(rng).without_curvature()
        maps = PixelMaps(rng.normal(0, 3, shape), rng.normal(1, 0.05, shape), *stderr)
        law, tables = build_reading_law(sensor, maps), tables_of(sensor)
        readings, electrons = some_pixels(sensor, tables, rng, 9)
        readings, electrons = readings[:30], np.maximum(electrons[:30], 0.0)
        got = np.full((3, 30), np.nan)
        for k in range(30):
            one = slice(k, k + 1)
            # The kernel takes the map's columns from 0 on.
            own = law._replace(
                maps=law.maps._replace(
                    offsets=np.ascontiguousarray(maps.offset_dn[:, one]), gains=np.ascontiguousarray(maps.gain[:, one])
                )
            )
            total, used = score_row_by_likelihood(
                readings[one], electrons[one], False, 1, own.maps, own, got[1, one], got[0, one]
            )
            got[2, k] = total if used else np.nan
        want = [
            one_pixel_on_maps(float(y), float(nu), sensor, maps, (1, k))
            for k, (y, nu) in enumerate(zip(readings, electrons, strict=True))
        ]
        assert_equal(got, want, electrons, tables, sensor)


def test_variances_are_those_of_the_numpy_version():
    """The variance of a reading, which equal weights state their errors by, to 1e-10 for 200 random sensors."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        sensor = random_sensor(rng).without_curvature()
        tables, law = tables_of(sensor), build_reading_law(sensor)
        readings, electrons = some_pixels(sensor, tables, rng, 7)
        electrons = np.maximum(electrons, tables.faint.lowest_e)
        weight, score = np.empty((2, readings.size))
        mean = sensor.black_level_dn + sensor.gain_dn_per_e * electrons
        compute_row_variances(readings, mean, electrons, law, weight, score)
        want = [reading_variance(float(nu), tables) for nu in electrons]
        # Far above full scale it is what is left of numbers as large as the variance without a clip.
        np.testing.assert_allclose(weight, want, rtol=RELATIVE, atol=RELATIVE, err_msg=str(sensor))


# How far the kernel is from the exact law.

PAPER = SensorModel(0.11, 13.0, full_scale_dn=1023.0)
CAMERAS = {
    "the paper's, clipped at black": PAPER,
    "the paper's with a black level": SensorModel(0.11, 13.0, black_level_dn=40.0, full_scale_dn=1023.0),
    "the paper's with a full well": SensorModel(0.11, 13.0, 0.0, 7000.0, 40.0, 1023.0),
    "the paper's, full well at full scale": SensorModel(0.11, 13.0, 0.0, 983 / 0.11, 40.0, 1023.0),
    "quiet": SensorModel(0.5, 2.0, black_level_dn=20.0, full_scale_dn=4095.0),
    "quiet with a full well": SensorModel(0.5, 2.0, 0.0, 6000.0, 20.0, 4095.0),
    "20 e- for each DN": SensorModel(0.05, 2.0, black_level_dn=3.3, full_scale_dn=255.0),
}


def lights_of(sensor: SensorModel) -> dict[str, np.ndarray]:
    """Return mean electrons [e-] by regime."""
    end = min((sensor.full_scale_dn - sensor.black_level_dn) / sensor.gain_dn_per_e, sensor.full_well_e)
    highest, sd = build_reading_law(sensor).highest_level, np.sqrt(end + sensor.read_noise_e**2)
    return {
        # The step of the table from there to no light joins two laws, without and with electrons.
        "below black": -sensor.read_noise_e * np.array([4.0, 3.0, 2.0, 1.0, 0.5, 0.3]),
        "black": np.array([0.0, 0.01, 0.1, 0.3, 0.5, 1.0]),
        "faint": np.array([1.3, 2.0, 3.3, 5.0, 8.0, 13.0, 20.0, 31.0]),
        "table ends": highest * np.array([0.9, 0.97, 0.999, 1.001, 1.03, 1.1, 1.5]),
        "bright": np.geomspace(max(40.0, 1.5 * highest), end - 7 * sd, 15),
        "clip": end + sd * np.array([-5.0, -4, -3, -2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2, 3]),
    }


class Distance(NamedTuple):
    """How far the kernel is from the exact distribution of a reading: the largest of each over some lights."""

    bias: float  # size of the expected score, in roots of the information without clips
    loss: float  # part of the information that an estimator with these scores does not use
    information: float  # error of the stated information, in units of that without clips
    share: float  # exact information, in units of that without clips


def distance_of(sensor: SensorModel, electrons: np.ndarray) -> Distance:
    """Return the distance of the kernel from the exact distribution at mean electrons [e-]."""
    exact, law = ReadingDistribution(sensor), build_reading_law(sensor)
    rows = []
    for nu in electrons:
        codes = exact.probabilities(np.array([nu]))
        # Less probable readings are the kernel's outliers, not the model's.
        is_likely = codes.probability[0] > 1e-15
        probability, slope = codes.probability[0, is_likely], codes.slope[0, is_likely]
        readings = codes.codes[is_likely].astype(float)
        score, weight, _ = by_kernel(readings, np.full(readings.size, nu), law)
        information = np.sum(slope**2 / probability)
        unclipped = 1 / (max(nu, 0.0) + sensor.read_noise_e**2 + 1 / 12 / sensor.gain_dn_per_e**2)
        # A reading that is certain tells nothing.
        loss = 0.0
        if information > 1e-12 * unclipped:
            loss = 1 - (score @ slope) ** 2 / (probability @ score**2) / information
        bias, error = abs(probability @ score), abs(probability @ weight - information)
        rows.append((bias / np.sqrt(unclipped), loss, error / unclipped, information / unclipped))
    return Distance(*np.max(rows, axis=0))


# Largest distances that were measured (docs/fit.md states them), with a margin: expected score, information that is not
# used, error of the stated information.
MEASURED = {
    "below black": (1e-6, 1e-8, 0.01),
    "black": (5e-6, 1e-6, 0.01),
    "faint": (5e-7, 0.015, 0.015),
    "table ends": (1.3e-3, 0.025, 0.025),
    "bright": (1e-4, 0.002, 0.002),
    "clip": (0.003, 3e-5, 0.005),
}
AT_THE_WELL = (0.013, 4e-4, 0.17)


@pytest.mark.parametrize("name", CAMERAS)
def test_distance_from_the_exact_distribution(name):
    """No further than was measured and docs/fit.md says, in every regime of light."""
    sensor = CAMERAS[name]
    for regime, electrons in lights_of(sensor).items():
        has_well = regime == "clip" and np.isfinite(sensor.full_well_e)
        limits = AT_THE_WELL if has_well else MEASURED[regime]
        got = distance_of(sensor, electrons)[:3]
        assert np.less(got, limits).all(), (regime, got)


@pytest.mark.parametrize("name", FAINT_SENSORS)
def test_half_way_between_levels(name):
    """Score and information half way between levels of the table, of sensors of every kind.

    An expected score that is not 0 shifts an estimate by its ratio to the root of the information, times the root of
    the number of such pixels, in standard errors: with 4e-3 by one standard error of 240 × 240 px of the same light.
    The information bends where single electrons can just be told apart and hardly any comes, by up to 16 %; it sets
    steps and stated errors, not the estimate.
    """
    sensor = FAINT_SENSORS[name]
    tables = tables_of(sensor)
    levels = tables.faint.levels[: tables.count]
    middles = (levels[:-1] + levels[1:]) / 2
    # The law bends most next to 0, where read noise alone moves a reading on one side and an electron on the other.
    zero = int(np.argmin(np.abs(levels)))
    picked = np.unique(np.concatenate([np.linspace(0, middles.size - 1, 20).astype(int), zero + np.arange(3)]))
    middles = middles[picked[picked < middles.size]]
    for nu in middles[(middles > 0) | (middles < -tables.faint.step_e)]:
        distance = distance_of(sensor, np.array([nu]))
        assert distance.bias < 4e-3, nu
        assert distance.information < (0.2 if sensor.read_noise_e < 1 else 0.01) * distance.share + 6e-3, nu
