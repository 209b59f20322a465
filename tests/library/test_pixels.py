"""The compiled passes over a frame: sums against plain numpy, moments against the exact law and random draws."""

from typing import NamedTuple

import numpy as np
import pytest

from spotcheck.discrepancy.measure import BLOCKS, Sums, block_side
from spotcheck.discrepancy.pixels import (
    CERTAIN,
    CODE_FLOOR,
    CODE_VARIANCE,
    CODES,
    FREE,
    JUMP,
    OUTLIER,
    STEP_DN,
    add_frame,
    fill_scene,
    table_of,
)
from spotcheck.model.baseline import Baseline
from spotcheck.model.law import faint_law
from spotcheck.model.sensor import SensorModel, reading
from tests.reference.exact_law import moments, reading_law
from tests.reference.numpy_chain import draw

SENSORS = {
    "the paper's, clipped at black": SensorModel(0.11, 13.0, 70.0, full_scale_dn=1023.0),
    "the paper's with a black level": SensorModel(0.11, 13.0, 70.0, black_level_dn=40.0, full_scale_dn=1023.0),
    "quiet": SensorModel(2.0, 1.5, black_level_dn=20.0, full_scale_dn=4095.0),
    "coarse steps": SensorModel(0.02, 13.0, black_level_dn=5.3, full_scale_dn=255.0),
    "full well": SensorModel(0.5, 4.0, full_well_e=600.0, black_level_dn=10.0, full_scale_dn=1023.0),
    "full scale": SensorModel(0.25, 6.0, black_level_dn=12.0, full_scale_dn=150.0),
    "black below zero": SensorModel(0.8, 2.0, black_level_dn=-6.4, full_scale_dn=255.0),
    "no full scale": SensorModel(0.25, 3.0, black_level_dn=60.0),
}
every_sensor = pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
HIGHEST = 400.0


class Frame(NamedTuple):
    """One frame and what a model expects of it."""

    image: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    light: np.ndarray
    shown: np.ndarray


BLACK, TOP, DARK_VARIANCE, LEAST, ZONE, GAIN = 20.0, 160.0, 2.5, 0.8, 25.0, 0.22
AT, CHIP_AT = (3, 5), (7, 2)
SITE, CHIP = (60, 70), (80, 66)


def some_frame(rows: int, columns: int, seed: int, outliers: bool = True) -> Frame:
    """Random readings about a random model: dark, lit and certain pixels, masked ones, some far off."""
    rng = np.random.default_rng(seed)
    light = np.maximum(rng.normal(60, 60, (rows, columns)), 0.0)
    variance = 0.6 + 0.11 * light
    mean = 20.0 + light
    image = np.maximum(np.rint(mean + np.sqrt(variance) * rng.standard_normal((rows, columns))), 0.0)
    if outliers:
        image[rng.random((rows, columns)) < 0.02] += 60.0
        # Far off for its own variance in the dark, not for the noise before black cut it.
        image[rng.random((rows, columns)) < 0.05] += 5.5
    # A corner whose readings repeat one number, and masked pixels in some of the blocks only.
    certain = (np.arange(rows)[:, None] < rows // 4) & (np.arange(columns)[None, :] < columns // 3)
    variance[certain] = rng.uniform(0.01, CERTAIN - 1e-6, certain.sum())
    image[(rng.random((rows, columns)) < 0.03) & (np.arange(columns)[None, :] > columns // 2)] = np.nan
    return Frame(image, mean, variance, light, light * rng.uniform(0.2, 1.0, light.shape))


def nothing(rows: int, columns: int, side: int) -> Sums:
    """Sums of no frame; those of `Sums` that have an axis of frames without it."""
    blocks = [np.zeros((rows // side, columns // side)) for _ in range(6)]
    lines = [np.zeros(n) for n in (rows,) * 3 + (columns,) * 3]
    tables = [np.zeros((len(CODES) + 1, int(CODES[-1]))), np.zeros(6)]
    fields = [np.zeros(SITE) for _ in range(2)] + [np.zeros(CHIP) for _ in range(3)]
    return Sums(*blocks, *lines, *tables, *fields)


def added(frame: Frame, side: int, parts: Sums) -> Sums:
    """The library's sums."""
    add_frame(*frame, BLACK, TOP, DARK_VARIANCE, LEAST, ZONE, GAIN, side, *parts, AT, CHIP_AT)
    return parts


def plainly(frame: Frame, side: int) -> Sums:
    """The same by numpy, from what `measure.Sums` says of each."""
    image, mean, variance, light, shown = frame
    rows, columns = image.shape
    out = nothing(rows, columns, side)
    used = np.isfinite(image) & (variance >= CERTAIN)
    r = np.where(used, image - mean, 0.0)
    w = np.where(used, 1 / variance, 0.0)
    mu = np.where(used, light, 0.0)
    z = r * np.sqrt(w)
    for by in range(rows // side):
        for bx in range(columns // side):
            own = (slice(by * side, (by + 1) * side), slice(bx * side, (bx + 1) * side))
            if not used[own].all():
                continue
            out.residual[by, bx] = r[own].mean()
            out.variance[by, bx] = variance[own].mean()
            out.pixels[by, bx] = side**2
            y, x = np.mgrid[:side, :side]
            plane = np.stack([np.ones(side**2), x.ravel(), y.ravel()], axis=1)
            left = z[own].ravel() - plane @ np.linalg.lstsq(plane, z[own].ravel(), rcond=None)[0]
            out.rough[by, bx] = left @ left
            out.rough_dof[by, bx] = side**2 - 3
            out.fourth[by, bx] = (z[own] ** 4).sum()
            if np.all((mean[own] > 6 * np.sqrt(variance[own])) & (variance[own] > 1)):
                third = (GAIN * np.maximum(variance[own] - DARK_VARIANCE, 0) / variance[own] ** 1.5).sum()
                out.totals[1] += ((z[own] - z[own].mean()) ** 3).sum() - third
                out.totals[2] += side**2
    # Light whose noise a level cuts speaks in blocks alone.
    cut = (light >= 6 * np.sqrt(DARK_VARIANCE)) & (variance <= FREE * (DARK_VARIANCE + GAIN * light))
    assert 0 < np.sum(used & cut) < np.sum(used)
    assert np.sum(used & (variance <= LEAST)) > 0
    # Some readings pass the end of the dead zone; what they are off counts four standard deviations.
    silent = mean < ZONE + JUMP * np.sqrt(DARK_VARIANCE + GAIN * ZONE)
    noise = np.maximum(DARK_VARIANCE, np.where(silent, (ZONE / JUMP) ** 2, 0.0))
    assert 0 < np.sum(used & silent) < np.sum(used)
    everything, used = used, used & ~cut
    r, w, mu = (np.where(used, own, 0.0) for own in (r, w, mu))
    for axis, line in ((1, ("row", "row_weight", "row_light")), (0, ("column", "column_weight", "column_light"))):
        for name, value in zip(line, (r * w, w, (mu * w) ** 2), strict=True):
            getattr(out, name)[:] = np.where(variance > LEAST, value, 0.0).sum(axis=axis)
    out.totals[0] = np.sum(used & (np.abs(r) > OUTLIER * np.sqrt(np.maximum(variance, noise))))
    nu = np.where(used, shown, 0.0)
    out.totals[3:] = ((nu * r * w) ** 2).sum(), ((nu * nu * w) ** 2).sum(), ((nu * w) ** 2).sum()
    site = (slice(AT[0], AT[0] + rows), slice(AT[1], AT[1] + columns))
    chip = (slice(CHIP_AT[0], CHIP_AT[0] + rows), slice(CHIP_AT[1], CHIP_AT[1] + columns))
    out.pull[site], out.weight[site] = nu * r * w, nu * nu * w
    # What is hot is asked of the noise before black cuts it.
    before = np.minimum(w, 1 / noise)
    out.dark_pull[chip], out.dark_weight[chip], out.dark_light[chip] = r * before, before, mu * before
    known = np.nan_to_num(image)
    lit = everything & (known > CODE_FLOOR) & (known < TOP)
    lit &= (mean > max(CODE_FLOOR, BLACK) + 6 * np.sqrt(variance)) & (mean < TOP - 6 * np.sqrt(variance))
    which = (variance[lit][:, None] > CODE_VARIANCE).sum(axis=1)
    np.add.at(out.comb, (which, image[lit].astype(int) % CODES[-1]), 1)
    return out


def same(got: Sums, want: Sums) -> None:
    """Sums of a few hundred terms in another order: 1e-12 of their largest."""
    for name, a, b in zip(Sums._fields, got, want, strict=True):
        largest = np.abs(b).max(initial=1.0)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * largest, err_msg=name)


@pytest.mark.parametrize(
    ("rows", "columns", "side"), [(48, 48, 8), (40, 56, 4), (45, 50, 8), (37, 41, 2), (33, 29, 7), (12, 13, 16)]
)
def test_sums_of_a_frame(rows, columns, side):
    """Every sum, also where blocks do not fill the crop: what is left over counts in lines and fields only."""
    for seed in range(3):
        frame = some_frame(rows, columns, seed)
        same(added(frame, side, nothing(rows, columns, side)), plainly(frame, side))


def test_the_frames_have_all_that_is_summed():
    """Or the test above would show nothing."""
    want = plainly(some_frame(48, 48, 0), 8)
    assert 0 < np.count_nonzero(want.pixels) < want.pixels.size
    frame = some_frame(48, 48, 0)
    far = np.abs(frame.image - frame.mean) > OUTLIER * np.sqrt(frame.variance)
    assert 5 < want.totals[0] < np.sum(far & (frame.variance >= CERTAIN)) - 5
    assert want.comb.sum() > 100 and np.count_nonzero(want.comb.sum(axis=1)) >= 2
    several = [plainly(some_frame(40, 56, seed), 4).totals[2] for seed in range(3)]
    assert sum(several) > 0 and any(plainly(some_frame(37, 41, 0), 2).totals[1:3])


def test_sums_add_up():
    """Fields, lines and tables add to what is there; blocks belong to one frame and are set."""
    first, second = some_frame(45, 50, 1), some_frame(45, 50, 2)
    parts = added(second, 8, added(first, 8, nothing(45, 50, 8)))
    one, two = plainly(first, 8), plainly(second, 8)
    for name in Sums._fields[6:]:
        a, b = getattr(one, name) + getattr(two, name), getattr(parts, name)
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-11 * np.abs(a).max(), err_msg=name)
    filled = two.pixels > 0
    np.testing.assert_allclose(parts.residual[filled], two.residual[filled], rtol=1e-9, atol=1e-12)


def test_masked_and_certain_pixels_say_nothing():
    """Whatever the model expects of them: not even an outlier. A block that misses one of them is empty."""
    frame = some_frame(32, 32, 5, outliers=False)
    frame.variance[:] = np.maximum(frame.variance, 0.6)
    frame.image[:] = np.where(np.isnan(frame.image), frame.mean, frame.image)
    whole = added(frame, 8, nothing(32, 32, 8))
    assert np.all(whole.pixels == 64)
    for spoil in ("masked", "certain"):
        image, variance = frame.image.copy(), frame.variance.copy()
        if spoil == "masked":
            image[10, 20] = np.nan
        else:
            variance[10, 20] = CERTAIN * 0.99
        own = frame._replace(image=image, variance=variance)
        got = added(own, 8, nothing(32, 32, 8))
        again = added(own._replace(mean=np.where(own.variance < CERTAIN, 1e6, own.mean)), 8, nothing(32, 32, 8))
        same(again, got)
        assert got.pixels[1, 2] == got.residual[1, 2] == got.rough_dof[1, 2] == 0
        assert np.sum(got.pixels == 64) == 15
        assert got.dark_weight[CHIP_AT[0] + 10, CHIP_AT[1] + 20] == 0
        assert np.isfinite(got.row).all() and got.row_weight[10] < whole.row_weight[10]
        # One beside it is as it was.
        assert got.row[11] == pytest.approx(whole.row[11], rel=1e-12)


def test_sums_of_a_true_model():
    """Expectations: squares about a plane n − 3, fourths 3, third moments those of shot noise."""
    rng = np.random.default_rng(9)
    light = np.full((256, 256), 900.0)
    # Poisson electrons at 2 DN each: third moment K² light, standardised by 1.5 powers of the variance.
    image = 2.0 * rng.poisson(light / 2.0)
    # Nine tenths of the light are a pedestal's, which is no light of the spot.
    frame = Frame(image, light, 2.0 * light, light / 10, light / 10)
    parts = nothing(256, 256, 8)._replace(**{name: np.zeros((300, 300)) for name in Sums._fields[14:]})
    add_frame(*frame, 0.0, 1e4, 1.0, 0.0, 0.0, 2.0, 8, *parts, (0, 0), (0, 0))
    n = 256**2
    # χ² of n degrees of freedom, five standard errors √(2n); kurtosis √(96/n); skewness √(15/n).
    assert abs(parts.rough.sum() - parts.rough_dof.sum()) < 5 * np.sqrt(2 * n)
    assert parts.fourth.sum() / n == pytest.approx(3 + 2 / 900, abs=5 * np.sqrt(96 / n))
    assert parts.totals[2] == n
    assert abs(parts.totals[1] / n) < 5 * np.sqrt(15 / n) + 3 / 64 * 2 / np.sqrt(450)
    # A skew of 1/√ν that the model does not know of is seen: here 0.047.
    blind = nothing(256, 256, 8)._replace(**{name: np.zeros((300, 300)) for name in Sums._fields[14:]})
    add_frame(*frame, 0.0, 1e4, 1.0, 0.0, 0.0, 0.0, 8, *blind, (0, 0), (0, 0))
    assert blind.totals[1] / n == pytest.approx(1 / np.sqrt(450), abs=5 * np.sqrt(15 / n))


def test_blocks_of_a_crop():
    """Thirty along the shorter side, and never a side of one pixel: it would have no scatter about a plane."""
    assert [block_side(n) for n in (240, 120, 260, 59, 20)] == [8, 4, 8, 2, 2]
    assert BLOCKS == 30


# Moments of readings over mean electrons.


def at_levels(table, electrons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The table between its levels, as `fill_scene` reads it."""
    levels = table.step_e * np.arange(len(table.mean))
    return np.interp(electrons, levels, table.mean), np.interp(electrons, levels, table.variance)


@every_sensor
def test_the_table_against_the_exact_law(sensor):
    """Off its levels, over all of its range, against the sum over every electron.

    Faint light has the exact law, on levels an eighth of its noise or of an electron apart: splines between them leave
    up to 1.3e-3 DN where a DN is 50 electrons. Above, a Poisson law passes for normal, exactly so for mean and variance
    until a clip is within eight scatters, but for rounding (exp(−2π² sd²) as in
    test_converter); there its skew, 1/√ν, moves the mean by φ(0)/6√ν of a scatter at most, and the
    variance by a third of √(2/ν) of itself.
    """
    table = table_of(sensor, HIGHEST)
    rng = np.random.default_rng(1)
    gain, faint = sensor.gain_dn_per_e, faint_law(sensor).highest_e
    parts = [rng.uniform(0, min(faint, HIGHEST / gain), 30), rng.uniform(0, HIGHEST / gain, 50), [0.0, HIGHEST / gain]]
    electrons = np.concatenate(parts)
    mean, variance = at_levels(table, electrons)
    # Readings that never occur only cost the sum time.
    narrow = sensor._replace(full_scale_dn=min(sensor.full_scale_dn, 2000.0))
    want = np.array([moments(reading_law(nu, narrow))[:2] for nu in electrons])
    scatter = gain * np.sqrt(electrons + sensor.read_noise_e**2)
    highest = min(sensor.full_scale_dn, gain * sensor.full_well_e + sensor.black_level_dn)
    signal = gain * electrons + sensor.black_level_dn
    cut = (signal < 8 * scatter) | (signal > highest - 8 * scatter)
    near = np.where(cut & (electrons >= faint), 1 / np.sqrt(np.maximum(electrons, 1.0)), 0.0)
    wave = (4 * scatter**2 + 0.2) * np.exp(-2 * np.pi**2 * scatter**2)
    exact = np.where(electrons < faint, 2e-3, 1e-6 + wave) + np.where(near > 0, 2e-3, 0.0)
    assert np.all(np.abs(mean - want[:, 0]) < exact + 0.067 * near * scatter)
    assert np.all(np.abs(variance - want[:, 1]) < exact + 0.47 * near * scatter**2)


@every_sensor
def test_the_table_where_nothing_clips(sensor):
    """Far from both ends a reading's mean is light plus black level and its variance K² (ν + noise²) + 1/12."""
    table = table_of(sensor, HIGHEST)
    gain = sensor.gain_dn_per_e
    electrons = table.step_e * np.arange(len(table.mean))
    signal = gain * electrons + sensor.black_level_dn
    spread = gain * np.sqrt(electrons + sensor.read_noise_e**2)
    free = (signal > 8 * spread) & (signal < sensor.full_scale_dn - 8 * spread) & (spread > 1.0) & (electrons > 100)
    free &= electrons + 8 * spread / gain < sensor.full_well_e
    if sensor.full_scale_dn > 200:
        assert free.sum() > 100
    np.testing.assert_allclose(table.mean[free], signal[free], rtol=1e-9)
    np.testing.assert_allclose(table.variance[free], spread[free] ** 2 + 1 / 12, rtol=1e-6)


def test_the_table_covers_what_was_asked_for():
    """In steps of 1/16 DN, two beyond the highest; never without variance; the same table for the same question."""
    sensor = SENSORS["quiet"]
    table = table_of(sensor, 64.0)
    assert table.step_e * sensor.gain_dn_per_e == STEP_DN == 1 / 16
    assert len(table.mean) == len(table.variance) == 64 * 16 + 3
    assert table.variance.min() >= 1e-3
    assert table_of(sensor, 64.0) is table
    # Its upper part is `sensor.reading` itself.
    electrons = table.step_e * np.arange(len(table.mean))
    high = electrons > faint_law(sensor).highest_e + 1e-9
    want = reading(sensor.gain_dn_per_e * electrons, 0.0, sensor)
    np.testing.assert_array_equal(table.mean[high], want.mean[high])


@every_sensor
def test_the_table_against_draws(sensor):
    """100,000 readings a level by the plain chain of `tests.reference`; five standard errors: one chance in 1.7 million
    for each of some hundred numbers."""
    table = table_of(sensor, HIGHEST)
    rng = np.random.default_rng(23)
    levels = np.array([0.0, 0.37, 2.9, 11.3, 57.0, 211.7, 390.0])
    mean, variance = at_levels(table, levels / sensor.gain_dn_per_e)
    light = np.broadcast_to(levels, (100_000, levels.size))
    readings = draw(light, 0.0, sensor, rng).astype(float)
    own, spread = readings.mean(axis=0), readings.var(axis=0)
    fourth = ((readings - own) ** 4).mean(axis=0)
    n = len(readings)
    skew = 1 / np.sqrt(np.maximum(levels / sensor.gain_dn_per_e, 30.0))
    assert np.all(np.abs(mean - own) < 5 * np.sqrt(spread / n) + 2e-3 + 0.067 * skew * np.sqrt(spread))
    assert np.all(
        np.abs(variance - spread) < 5 * np.sqrt(np.maximum(fourth - spread**2, 0) / n) + 4e-3 + 0.1 * skew * spread
    )


# Scenes.


@pytest.mark.parametrize("cut", [False, True], ids=["", "top hat"])
@every_sensor
def test_a_scene_is_the_baselines_spot(sensor, cut):
    """Its light is `Baseline.shape` to rounding; mean and variance are the table's, linear between its steps."""
    table = table_of(sensor, HIGHEST)
    shape = (41, 57)
    mean, variance, light = (np.full(shape, np.nan) for _ in range(3))
    dark_e = 3.0
    spot = (340.0, 30.3, 19.8, 7.5)
    fill_scene(*spot, cut, sensor.gain_dn_per_e, dark_e, *table, mean, variance, light)
    x, y = np.arange(57)[None, :], np.arange(41)[:, None]
    want = Baseline(0.0, "free", cut, 1.0).shape(x, y, *spot)
    np.testing.assert_allclose(light, want, rtol=1e-12, atol=1e-12)
    expected = at_levels(table, want / sensor.gain_dn_per_e + dark_e)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(variance, expected[1], rtol=1e-9, atol=1e-9)


def test_a_scene_brighter_than_its_table():
    """Goes on along the last step: there a sensor is linear, or has long reached its end."""
    sensor = SENSORS["the paper's with a black level"]
    table = table_of(sensor, 64.0)
    mean, variance, light = (np.empty((3, 3)) for _ in range(3))
    fill_scene(100.0, 1.0, 1.0, 50.0, False, sensor.gain_dn_per_e, 0.0, *table, mean, variance, light)
    np.testing.assert_allclose(mean, light + 40.0, rtol=1e-6)
    np.testing.assert_allclose(variance, 0.11 * light + (0.11 * 13) ** 2 + 1 / 12, rtol=1e-3)


def test_a_spot_outside_its_frame():
    """Only its flank is seen, and no light is negative."""
    sensor = SENSORS["quiet"]
    table = table_of(sensor, HIGHEST)
    mean, variance, light = (np.empty((20, 30)) for _ in range(3))
    fill_scene(300.0, -15.0, 44.0, 9.0, True, sensor.gain_dn_per_e, 0.0, *table, mean, variance, light)
    assert light.min() >= 0 and light.max() == light[19, 0]
    assert light[19, 0] == pytest.approx(300 * np.exp(-(15**2 + 25**2) / 162), rel=1e-12)
