"""The sensor: mean and variance of each stage against the closed form, the clip, the converter."""

import numpy as np
import pytest

from rig import exposure, plan, sensor
from rig.settings import Sensor, from_dict

SIDE = 400
PIXELS = SIDE * SIDE


def rng(seed):
    return np.random.default_rng(seed)


def assert_mean_and_variance(frame, mean, variance, kurtosis=3.0):
    """Both within 4.5 standard errors: false alarm 1.4e-5 a call."""
    values = frame.astype(float).ravel()
    assert values.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(variance / PIXELS))
    assert values.var() == pytest.approx(variance, abs=4.5 * variance * np.sqrt((kurtosis - 1) / PIXELS))


@pytest.mark.parametrize("photons", [400.0, 6000.0])
def test_shot_dark_and_read_noise_with_quantisation(photons):
    chip = Sensor(dark_current_e_per_s=3e5, black_level_dn=20.0)
    frame = sensor.expose(chip, np.full((SIDE, SIDE), photons), 1e-3, None, rng(1))
    electrons = 0.38 * photons + 300.0
    mean = 0.11 * electrons + 20.0
    variance = 0.11**2 * (electrons + 13.0**2) + 1 / 12
    assert_mean_and_variance(frame, mean, variance)


@pytest.mark.parametrize("exposure_s", [9e-4, 2.0])
def test_a_dark_frame_has_the_same_law(exposure_s):
    # 0.063 and 140 dark electrons: the two ways of drawing them.
    chip = Sensor(black_level_dn=30.0)
    dark_e = 70.0 * exposure_s
    frame = sensor.dark_frame(chip, (SIDE, SIDE), exposure_s, rng(2))
    assert_mean_and_variance(frame, 30.0 + 0.11 * dark_e, 0.11**2 * (dark_e + 13.0**2) + 1 / 12)
    exposed = sensor.expose(chip, np.zeros((SIDE, SIDE)), exposure_s, None, rng(3))
    assert_mean_and_variance(exposed, 30.0 + 0.11 * dark_e, 0.11**2 * (dark_e + 13.0**2) + 1 / 12)


def test_black_level_zero_cuts_half_of_the_read_noise():
    frame = sensor.dark_frame(Sensor(), (SIDE, SIDE), 1e-4, rng(4))
    sigma = 0.11 * 13.0
    # E[max(0, X)] = σ/√(2π); rounding 0.5 up and down leaves it, but for the step at zero (0.01 DN).
    assert frame.mean() == pytest.approx(sigma / np.sqrt(2 * np.pi), abs=0.02)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_the_converter_stops_at_full_scale(bits):
    chip = Sensor(bit_depth=bits)
    frame = sensor.expose(chip, np.full((8, 8), 1e8), 1e-3, None, rng(5))
    assert frame.dtype == np.uint16
    assert (frame == 2**bits - 1).all()


def test_rounding_is_to_nearest_and_once():
    chip = Sensor(gain_dn_per_e=1.0, read_noise_e=0.0)
    out = sensor.digitise(chip, np.array([0.4, 0.6, 1.2, -3.0, 2000.0]))
    np.testing.assert_array_equal(out, [0, 1, 1, 0, 1023])


CLIPPED = Sensor(
    clip_level_e=7000.0,
    clip_pixel_scatter=0.01,
    clip_row_scatter=0.004,
    clip_row_step=0.03,
    clip_row_period_px=5,
    clip_screen_sigma=2.0,
)


def test_nothing_passes_the_clip_level_but_read_noise():
    rows, columns = range(50, 50 + SIDE), range(300, 300 + SIDE)
    levels = sensor.clip_levels_e(CLIPPED, 9, rows, columns)
    frame = sensor.expose(CLIPPED, np.full(levels.shape, 1e5), 1e-4, levels, rng(6))
    off = frame - 0.11 * levels
    # 160,000 normal draws of σ = 1.43 DN pass 6 σ once in 3000 runs; rounding adds half a step.
    assert np.abs(off).max() < 6 * 0.11 * 13.0 + 0.5
    assert_mean_and_variance(off, 0.0, 0.11**2 * 13.0**2 + 1 / 12)


def test_the_map_of_levels_belongs_to_the_chip():
    whole = sensor.clip_levels_e(CLIPPED, 9, range(0, 600), range(0, 700))
    part = sensor.clip_levels_e(CLIPPED, 9, range(130, 530), range(250, 560))
    np.testing.assert_array_equal(whole[130:530, 250:560], part)
    assert not np.array_equal(whole, sensor.clip_levels_e(CLIPPED, 10, range(0, 600), range(0, 700)))
    assert sensor.clip_levels_e(Sensor(), 9, range(3), range(3)) is None


def test_the_levels_scatter_as_stated():
    levels = sensor.clip_levels_e(CLIPPED, 9, range(0, 1000), range(0, 500)) / 7000.0 - 1.0
    rows = levels.mean(axis=1)
    striped = np.arange(1000) % 5 == 0
    # A row's mean is known to 4e-4; the rows' scatter of 0.004 makes 3.2e-4 for the mean of 200 rows: 5 errors.
    assert rows[striped].mean() - rows[~striped].mean() == pytest.approx(0.03, abs=5 * 3.2e-4)
    pixels = levels - rows[:, None]
    # A normal cut at 2 σ keeps 0.8796 of its standard deviation; its scatter from 500,000 draws is 0.1 %.
    assert pixels.std() == pytest.approx(0.01 * 0.8796, rel=0.01)
    assert np.abs(pixels).max() < 0.02 + 5 * 4e-4


def test_frames_differ_only_by_noise_where_no_light_falls():
    rig = from_dict({"frame": {"width_px": 300, "height_px": 200, "window_px": 64}, "pointing": {"border_px": 60}})
    shot = plan.Shot(0, "a.tif", "spot", 0.0, 1e-4, "0")
    lit = exposure.light(rig, plan.Site(0, (shot,)))
    frame = exposure.whole_frame(rig, lit, shot)
    np.testing.assert_array_equal(frame[lit.window.slices], exposure.window_frame(rig, lit, shot))
    outside = frame.copy()
    outside[lit.window.slices] = 0
    assert frame.max() > 300 > 12 > outside.max()
