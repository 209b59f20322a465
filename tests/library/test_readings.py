"""The law of a reading as a table: against sums over all electrons and readings, and against the table of the fit."""

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.law import faint_law
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.readings import look_up, reading_law, through_field

ONE = np.ones((1, 1, 1))
VIEW = View(ONE, ONE, ONE, ONE, ONE, ONE, ONE, ONE, ONE, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0)


def moments(sensor: SensorModel, electrons, present=()) -> np.ndarray:
    """Mean and variance of readings, from the table."""
    law = reading_law(sensor, present, VIEW, 4e4)
    out = np.empty((4, 1, len(electrons)))
    look_up(np.asarray(electrons, float)[None], law.first, law.step, np.stack(law[2:], axis=1), out)
    return out[:, 0]


def summed(sensor: SensorModel, electrons: float, read_e: float, level: float = np.inf) -> tuple[float, float]:
    """Mean and variance of rounded, cut readings, summed over electrons and readings."""
    counts = np.arange(int(electrons + 12 * np.sqrt(electrons) + 30))
    readings = np.arange(int(sensor.full_scale_dn) + 1)
    signal = sensor.gain_dn_per_e * counts
    edges = np.minimum.outer(np.full(len(counts), np.inf), readings[:-1] + 0.5) - sensor.black_level_dn
    # What stops stops with its read noise: readings above the level's own gather there.
    edges = np.where(edges > level, np.inf, edges)
    above = stats.norm.sf(edges, signal[:, None], sensor.gain_dn_per_e * read_e)
    above = stats.poisson.pmf(counts, electrons) @ above
    first, second = above.sum(), ((2 * readings[1:] - 1) * above).sum()
    return first, second - first**2


@pytest.mark.parametrize("black", [0.0, 3.0, 40.0])
@pytest.mark.parametrize("read_e", [2.0, 6.0])
def test_faint_light_by_sums(black, read_e):
    """From no light to where Poisson's law passes for normal: the mean to 1e-4 DN, the variance to a part in 1000.

    A pedestal of 0.001 DN is what a million pixels of 1 DN of noise tell.
    """
    sensor = SensorModel(0.11, read_e, black_level_dn=black, full_scale_dn=1023)
    electrons = np.array([0.0, 0.3, 2.0, 10.0, 40.0, 300.0, 2500.0])
    mean, variance = moments(sensor, electrons)[:2]
    want = np.array([summed(sensor, e, read_e) for e in electrons]).T
    np.testing.assert_allclose(mean, want[0], atol=1e-4)
    np.testing.assert_allclose(variance, want[1], rtol=1e-3)


def test_as_the_table_of_the_fit():
    """`faint_law` is the same law, tabulated for single readings. Where noise is 0.2 DN, straight lines between the
    nodes are off by 1e-4 DN."""
    sensor = SensorModel(0.11, 2.0, black_level_dn=1.0, full_scale_dn=1023)
    table = faint_law(sensor)
    own = table.levels > -20
    mean, variance = moments(sensor, table.levels[own])[:2]
    np.testing.assert_allclose(mean, table.mean[own], atol=2e-4)
    np.testing.assert_allclose(variance, table.variance[own], rtol=2e-3, atol=1e-4)


def test_a_clip_in_faint_light():
    """A converter that stops at 20 DN above black: its readings pile up there."""
    sensor = SensorModel(0.11, 6.0, black_level_dn=3.0, full_scale_dn=1023)
    clip = Present(vocabulary()["saturation"], "sharp with noise", (20.0, 0.03))
    electrons = np.array([50.0, 150.0, 180.0, 250.0, 1000.0])
    mean, variance = moments(sensor, electrons, (clip,))[:2]
    want = np.array([summed(sensor, e, 6.0, 20.0) for e in electrons]).T
    np.testing.assert_allclose(mean, want[0], atol=2e-3)
    np.testing.assert_allclose(variance, want[1], rtol=5e-3, atol=1e-4)


def test_bright_light_and_slopes():
    """Far from both ends a reading has mean K ν + black, variance K² (ν + noise²) + 1/12, slopes 1 and K."""
    sensor = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
    mean, variance, slope, growth = moments(sensor, [1000.0, 5000.0])
    np.testing.assert_allclose(mean, [122.0, 562.0], rtol=1e-6)
    np.testing.assert_allclose(variance, 0.11**2 * (np.array([1000.0, 5000.0]) + 36) + 1 / 12, rtol=1e-4)
    np.testing.assert_allclose(slope, 1, rtol=1e-4)
    np.testing.assert_allclose(growth, 0.11, rtol=1e-2)


@pytest.mark.parametrize("contrast", [0.1, 0.4])
@pytest.mark.parametrize("clip", [np.inf, 60.0])
def test_light_behind_a_field(contrast, clip):
    """Faint, bright, and about a clip: mean and variance of 400,000 readings whose light follows a gamma law, within 5
    of their errors (6e-7 each) and 2 % of the field's own scatter and variance, which 16 steps for its law cost."""
    sensor, rng = SensorModel(0.11, 6.0, black_level_dn=3.0, full_scale_dn=1023), np.random.default_rng(9)
    present = () if clip == np.inf else (Present(vocabulary()["saturation"], "sharp with noise", (clip, 0.03)),)
    levels, size = np.array([30.0, 545.0, 1500.0]), 400_000
    plain = reading_law(sensor, present, VIEW, 4e4)
    law = through_field(plain, contrast, sensor.gain_dn_per_e)
    out = np.empty((2, 4, 1, 3))
    for own, table in zip(out, (law, plain), strict=True):
        look_up(levels[None], table.first, table.step, np.stack(table[2:], axis=1), own)
    for k, level in enumerate(levels):
        electrons = rng.poisson(level * rng.gamma(contrast**-2, contrast**2, size))
        signal = 0.11 * (electrons + 6.0 * rng.standard_normal(size))
        reading = np.clip(np.rint(np.minimum(signal, clip) + 3.0), 0, 1023)
        mean, variance = reading.mean(), reading.var()
        added = abs(out[0, 1, 0, k] - out[1, 1, 0, k])
        assert abs(out[0, 0, 0, k] - mean) < 5 * np.sqrt(variance / size) + 0.02 * np.sqrt(added) + 1e-4
        fourth = np.mean((reading - mean) ** 4)
        assert abs(out[0, 1, 0, k] - variance) < 5 * np.sqrt((fourth - variance**2) / size) + 0.02 * added + 1e-4


def test_no_field_leaves_the_law():
    law = reading_law(SensorModel(0.11, 6.0, full_scale_dn=1023), (), VIEW, 4e4)
    assert through_field(law, 0.0, 0.11) is law
