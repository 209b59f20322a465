"""What a pixel should read: the table of every kind of sensor against random draws, and the baseline's spot in it."""

import numpy as np
import pytest

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, Numbers
from spotcheck.old_engine.observe.readings import look_up, reading_law
from tests.reference.numpy_chain import draw

SENSORS = {
    "the paper's, clipped at black": SensorModel(0.11, 13.0, 70.0, full_scale_dn=1023.0),
    "the paper's with a black level": SensorModel(0.11, 13.0, 70.0, black_level_dn=40.0, full_scale_dn=1023.0),
    "quiet": SensorModel(2.0, 1.5, black_level_dn=20.0, full_scale_dn=4095.0),
    "coarse steps": SensorModel(0.02, 13.0, black_level_dn=5.3, full_scale_dn=255.0),
    "full well": SensorModel(0.5, 4.0, full_well_e=600.0, black_level_dn=10.0, full_scale_dn=1023.0),
    "full scale": SensorModel(0.25, 6.0, black_level_dn=12.0, full_scale_dn=150.0),
    "black below zero": SensorModel(0.8, 2.0, black_level_dn=-6.4, full_scale_dn=255.0),
}
every_sensor = pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
ONE = np.ones((1, 1, 1))


def view(rows: int, columns: int) -> View:
    """A crop of an exposure of 0.1 s, with its corner at (0, 0)."""
    x, y = np.arange(float(columns))[None, None, :], np.arange(float(rows))[None, :, None]
    return View(x, y, 0 * ONE, 0 * ONE, 0.1 * ONE, 0 * ONE, 0 * ONE, 0 * ONE, 0 * ONE, 0.1, 0.1, 0.0, 0.0, 100.0, 1.0)


def at_levels(sensor: SensorModel, electrons: np.ndarray) -> np.ndarray:
    """Mean and variance [2, level] of readings from the table."""
    law = reading_law(sensor, (), view(1, 1), 4e4)
    out = np.empty((4, 1, len(electrons)))
    look_up(np.asarray(electrons, float)[None], law.first, law.step, np.stack(law[2:], axis=1), out)
    return out[:2, 0]


@every_sensor
def test_the_table_against_draws(sensor):
    """100,000 readings a level by the plain chain of `tests.reference`; five standard errors: one chance in 1.7 million
    for each of some hundred numbers. Where a clip meets light that passes for normal its skew, 1/√ν, moves the mean by
    up to φ(0)/6 √ν of a scatter, and the variance by a tenth of 1/√ν of itself."""
    levels = np.array([0.0, 0.37, 2.9, 11.3, 57.0, 211.7, 390.0])
    mean, variance = at_levels(sensor, levels / sensor.gain_dn_per_e)
    light = np.broadcast_to(levels, (100_000, levels.size))
    readings = draw(light, 0.0, sensor, np.random.default_rng(23)).astype(float)
    own, spread = readings.mean(axis=0), readings.var(axis=0)
    fourth, n = ((readings - own) ** 4).mean(axis=0), len(readings)
    skew = 1 / np.sqrt(np.maximum(levels / sensor.gain_dn_per_e, 30.0))
    assert np.all(np.abs(mean - own) < 5 * np.sqrt(spread / n) + 2e-3 + 0.067 * skew * np.sqrt(spread))
    noise = 5 * np.sqrt(np.maximum(fourth - spread**2, 0) / n)
    # Of a reading that is certain no variance is left, but for the least that a table gives.
    assert np.all(np.abs(variance - spread) < noise + 4e-3 + 0.1 * skew * spread)


@pytest.mark.parametrize("cut", [False, True], ids=["", "top hat"])
@every_sensor
def test_a_frame_is_the_baselines_spot(sensor, cut):
    """Its light is `Baseline.shape` to rounding; mean and variance are those at light and dark current, from a
    table with other steps: 0.003 DN apart where readings begin to be cut."""
    peak, x, y, width = 340.0, 30.3, 19.8, 7.5
    numbers = Numbers(*(np.array([v]) for v in (np.log(peak), np.log(width), x, y)))
    frame = Frame(np.zeros((41, 57)), view(41, 57))
    seen = Expectation([frame], Model(Baseline(0.0, "free", cut, 0.1), sensor, (), numbers)).of(frame, 0)
    want = Baseline(0.0, "free", cut, 0.1).shape(np.arange(57)[None, :], np.arange(41)[:, None], peak, x, y, width)
    np.testing.assert_allclose(seen.spot, want, rtol=1e-9, atol=1e-9)
    dark = 0.1 * sensor.dark_current_e_per_s
    mean, variance = at_levels(sensor, (want / sensor.gain_dn_per_e + dark).ravel())
    np.testing.assert_allclose(seen.mean.ravel(), mean, atol=3e-3)
    np.testing.assert_allclose(seen.variance.ravel(), variance, rtol=2e-3, atol=3e-3)


def test_a_spot_outside_its_frame():
    """Only its flank is seen, and no light is negative."""
    numbers = Numbers(*(np.array([v]) for v in (np.log(300.0), np.log(9.0), -15.0, 44.0)))
    frame = Frame(np.zeros((20, 30)), view(20, 30))
    seen = Expectation([frame], Model(Baseline(0.0, "free", True, 0.1), SENSORS["quiet"], (), numbers)).of(frame, 0)
    assert seen.spot.min() >= 0 and seen.spot.max() == seen.spot[19, 0]
    assert seen.spot[19, 0] == pytest.approx(300 * np.exp(-(15**2 + 25**2) / 162), rel=1e-9)
