"""Read noise and black level of dark pixels against brute-force draws."""

import numpy as np
import pytest

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance.darkness import Histogram, darkness, fit_dark, kept_counts
from spotcheck.old_engine.observe.pixels import Around, Frame, Model, Numbers

DRAWS, PIXELS, HOT = 200, 5000, 2e-4
# Gain, read noise [e-], black level [DN], mean electrons, dead zone [DN].
CAMERAS = {
    "plain": (0.11, 6.0, 12.0, 0.0, 0.0),
    "black at 0": (0.11, 6.0, 0.0, 0.0, 0.0),
    "black at 1": (0.11, 6.0, 1.0, 0.0, 0.0),
    "dark current": (0.11, 13.0, 40.0, 200.0, 0.0),
    "dead zone": (0.11, 13.0, 2.0, 20.0, 2.0),
    "skewed": (1.0, 2.0, 10.0, 3.0, 0.0),
}


def readings(rng, camera: tuple, size: int) -> np.ndarray:
    """Drawn step by step; a few pixels are hot."""
    gain, noise, black, electrons, dead = camera
    signal = black + gain * (rng.poisson(electrons, size) + noise * rng.standard_normal(size))
    out = np.clip(np.rint(np.where(signal < dead, 0, signal)), 0, 1023)
    return np.where(rng.random(size) < HOT, out + 100, out)


@pytest.mark.parametrize("name", CAMERAS)
def test_value_and_error(name):
    """Of 200 draws: bias below 3 of its own errors (false alarm 3e-3), pulls of variance 1 within 3 of its (3e-3)."""
    camera, rng = CAMERAS[name], np.random.default_rng(3)
    gain, noise, black, electrons, dead = camera
    found = [
        fit_dark([Histogram(electrons, 0.0, kept_counts(readings(rng, camera, PIXELS)))], gain, dead)
        for _ in range(DRAWS)
    ]
    for k, truth in ((0, black), (2, noise)):
        values, errors = np.array([own[k : k + 2] for own in found]).T
        assert abs(values.mean() - truth) < 3 * values.std(ddof=1) / np.sqrt(DRAWS)
        assert abs(np.var((values - truth) / errors, ddof=1) - 1) < 3 * np.sqrt(2 / DRAWS)


def test_two_codes_tell_nothing():
    """Noise of 0.2 DN between two codes: errors are infinite, as they are where all pixels read one."""
    rng = np.random.default_rng(1)
    for camera in ((0.1, 2.0, 3.4, 0.0, 0.0), (0.1, 0.1, 3.0, 0.0, 0.0)):
        own = fit_dark([Histogram(0.0, 0.0, kept_counts(readings(rng, camera, PIXELS)))], 0.1)
        assert np.isinf(own.black_level_stderr) and np.isinf(own.read_noise_stderr)


def test_pixels_of_unlike_light_share_the_sensor():
    """Three groups of light, joined: as well known as by all their pixels, and unbiased at 4 errors (6e-5)."""
    rng = np.random.default_rng(5)
    groups = [
        Histogram(nu, 0.0, kept_counts(readings(rng, (0.11, 6.0, 12.0, nu, 0.0), 20000))) for nu in (0.0, 9.0, 60.0)
    ]
    joint, alone = fit_dark(groups, 0.11), fit_dark(groups[:1], 0.11)
    assert abs(joint.black_level_dn - 12) < 4 * joint.black_level_stderr < 4 * alone.black_level_stderr
    assert abs(joint.read_noise_e - 6) < 4 * joint.read_noise_stderr < 4 * alone.read_noise_stderr


def test_rows_of_the_model_are_no_read_noise():
    """Rows of 0.8 DN in the model are taken off what dark pixels scatter by; left out of it, they are read noise of
    √(6² + (0.8/0.11)²) e-. Four errors each of the histogram and of what 640 rows scatter by: 6e-5."""
    rng, side = np.random.default_rng(8), 160
    sensor, one = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023), np.zeros((1, 1, 1))
    x, y = np.arange(side, dtype=float)[None, None], np.arange(side, dtype=float)[None, :, None]
    view = View(x, y, one, one, one + 1, one, one, one, one, 1.0, 1.0, 80.0, 80.0, float(side), 1.0)
    light = 600 * np.exp(-((x - 80) ** 2 + (y - 80) ** 2)[0] / (2 * 9.0**2))
    numbers = Numbers(*(np.full(4, v) for v in (np.log(600), np.log(9.0), 80.0, 80.0)))
    frames = []
    for _ in range(4):
        electrons = rng.poisson(light / 0.11) + 6 * rng.standard_normal(light.shape)
        signal = 12 + 0.11 * electrons + 0.8 * rng.standard_normal((side, 1))
        frames.append(Frame(np.clip(np.rint(signal), 0, 1023), view))
    rows = Present(vocabulary()["row_noise"], "", (0.8,))
    for present, want in (((rows,), 6.0), ((), np.hypot(6, 0.8 / 0.11))):
        model = Model(Baseline(0.0, "free", False, 1.0), sensor, present, numbers)
        own = darkness(frames, model)
        scatter = 4 * np.sqrt(2 / (4 * side)) * (0.8 / 0.11) ** 2 / (2 * want)
        assert own is not None and abs(own.read_noise_e - want) < 4 * own.read_noise_stderr + scatter


@pytest.mark.parametrize("pedestal", ["", "light", "electronic"])
def test_of_frames_with_a_spot(pedestal):
    """Spots and masked pixels are passed by; a pedestal of the model is no black level. Four errors: 6e-5 each."""
    rng, side = np.random.default_rng(7), 160
    sensor = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023)
    one = np.zeros((1, 1, 1))
    x, y = np.arange(side, dtype=float)[None, None], np.arange(side, dtype=float)[None, :, None]
    view = View(x, y, one, one, one + 1, one, one, one, one, 1.0, 1.0, 80.0, 80.0, float(side), 1.0)
    light = 600 * np.exp(-((x - 80) ** 2 + (y - 78) ** 2)[0] / (2 * 9.0**2))
    level = 3.0 if pedestal else 0.0
    from_light = level if pedestal == "light" else 0.0
    electrons = rng.poisson((light + from_light) / 0.11) + 6 * rng.standard_normal(light.shape)
    pixels = np.clip(np.rint(12 + level - from_light + 0.11 * electrons), 0, 1023)
    pixels[:5] = np.nan
    present = (Present(vocabulary()["dark_offset"], pedestal, (level,)),) if pedestal else ()
    numbers = Numbers(*(np.array([v]) for v in (np.log(600), np.log(9.0), 80.0, 78.0)))
    model = Model(Baseline(0.0, "free", False, 1.0), sensor, present, numbers)
    own = darkness([Frame(pixels, view)], model)
    assert own is not None and 5000 < own.pixels < side * side
    assert abs(own.black_level_dn - 12) < 4 * own.black_level_stderr
    assert abs(own.read_noise_e - 6) < 4 * own.read_noise_stderr


@pytest.mark.parametrize("black", [12.0, 1.0, 0.0, -6.0])
def test_where_only_blocks_around_are_dark(black):
    """Black cuts half of the noise of a level of 0, so that blocks read 0.6 DN there: the level is 0 all the same, and
    one far below black is not told. Over 60 frames the pull's mean is within four errors (6e-5)."""
    rng, side, blocks, edge = np.random.default_rng(17), 60, 40, 16
    sensor = SensorModel(0.11, 13.0, black_level_dn=0.0, full_scale_dn=1023)
    one = np.zeros((1, 1, 1))
    x, y = np.arange(side, dtype=float)[None, None], np.arange(side, dtype=float)[None, :, None]
    view = View(x, y, one, one, one + 1, one, one, one, one, 1.0, 1.0, 30.0, 30.0, 400.0, 1.0)
    numbers = Numbers(*(np.array([v]) for v in (np.log(600), np.log(20.0), 30.0, 30.0)))
    model = Model(Baseline(0.0, "free", False, 1.0), sensor, (), numbers)
    light = 600 * np.exp(-((x - 30) ** 2 + (y - 30) ** 2)[0] / (2 * 20.0**2))
    places = 200.0 + 5 * np.arange(blocks, dtype=float)
    pull = []
    for _ in range(60):
        pixels = readings(rng, (0.11, 13.0, black, light.ravel() / 0.11, 0.0), side * side).reshape(side, side)
        dark = readings(rng, (0.11, 13.0, black, 0.0, 0.0), blocks * edge**2).reshape(blocks, -1)
        own = darkness([Frame(pixels, view, Around(places, places, dark.mean(axis=1), edge**2))], model)
        if black < -5:
            assert own is None
            continue
        assert own is not None and np.isinf(own.read_noise_stderr)
        pull.append((own.black_level_dn - black) / own.black_level_stderr)
    # One block in twenty has a hot pixel, which moves their median by a quarter of its error.
    assert abs(np.mean(pull or [0.0])) < 4 / np.sqrt(60) + 0.25
    assert not pull or np.var(pull) < 1 + 4 * np.sqrt(2 / 59)
