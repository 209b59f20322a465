"""The sensor's part of effects, and what is drawn.

`drawn` below is the dataset contract's chain at pixels, one stage a function, in a given order of stages: the library
must agree in the contract's order, and would not in another.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from spotcheck.model import chain
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import SensorModel
from tests.library.effect_cases import CONTEXTS, PLAIN, SENSOR, VIEW, all_moments, free, of, present

# The sensor's part, by a chain of random draws that follows the contract's order.

DRAWS = 100_000
LEVELS_DN = np.array([0.0, 3.0, 25.0, 120.0, 380.0, 640.0])


class Noisy(NamedTuple):
    """Draws [draw, pixel] on their way through the sensor: electrons, then DN; what stays the same for all of them."""

    signal: np.ndarray
    noise: np.ndarray
    sensor: SensorModel
    own: dict[str, dict[str, float]]
    form: dict[str, str]


def smear(s: Noisy) -> Noisy:
    """Each pixel here stands for the one row of a column of 4: it leaves a quarter of `fraction` behind."""
    if "smear" not in s.own:
        return s
    return s._replace(signal=s.signal + s.own["smear"]["fraction"] * s.signal.mean(axis=0) / 4)


def soft_knee(y, level, width):
    """What (1 + e^(x/w − 1/k)) / (1 + e^(−1/k)) leaves of x: 0 at 0, the level at the end."""
    scale = level / np.log1p(np.exp(1 / width)) if width > 0.01 else level * width
    return y - scale * (np.logaddexp(0, y / scale - 1 / width) - np.logaddexp(0, -1 / width))


def knee(y, level, width, form):
    """The bent response itself."""
    if form.startswith("sharp"):
        return np.minimum(y, level)
    if form.startswith("soft"):
        return soft_knee(y, level, width)
    lit = np.maximum(y, 1e-9)
    return np.where(y > 1e-9, (lit ** (-1 / width) + level ** (-1 / width)) ** -width, y)


def well(s: Noisy) -> Noisy:
    """Full well; saturation [DN without black level] of the charge, read noise still to come."""
    out = np.minimum(s.signal, s.sensor.full_well_e)
    if s.form.get("saturation", "with noise").endswith("with noise"):
        return s._replace(signal=out)
    p, gain = s.own["saturation"], s.sensor.gain_dn_per_e
    return s._replace(signal=knee(gain * out, p["level"], p["knee"], s.form["saturation"]) / gain)


def read(s: Noisy) -> Noisy:
    """Read noise [e-], then K."""
    total = s.own.get("excess_read_noise", {"total": s.sensor.read_noise_e})["total"]
    return s._replace(signal=s.sensor.gain_dn_per_e * (s.signal + total * s.noise[:, :6]))


def late_knee(s: Noisy) -> Noisy:
    """Saturation of what has read noise already."""
    if not s.form.get("saturation", "").endswith("with noise"):
        return s
    p = s.own["saturation"]
    return s._replace(signal=knee(s.signal, p["level"], p["knee"], s.form["saturation"]))


def bent(s: Noisy) -> Noisy:
    """y − q y²/full scale."""
    q = s.own.get("nonlinearity", {"q": 0.0})["q"]
    return s._replace(signal=s.signal - q * s.signal**2 / s.sensor.full_scale_dn)


def black(s: Noisy) -> Noisy:
    """Black level, and pedestals of the electronics."""
    level = s.sensor.black_level_dn
    if s.form.get("dark_offset") == "electronic":
        level += s.own["dark_offset"]["level"]
    return s._replace(signal=s.signal + level)


def rows(s: Noisy) -> Noisy:
    """One offset a row."""
    rms = s.own.get("row_noise", {"rms": 0.0})["rms"]
    return s._replace(signal=s.signal + rms * s.noise[:, 6:])


def cut_black(s: Noisy) -> Noisy:
    """A threshold that is taken off, or below which readings are 0."""
    threshold = s.own.get("black_clipping", {"threshold": 0.0})["threshold"]
    if s.form.get("black_clipping") == "subtracted":
        return s._replace(signal=s.signal - threshold)
    return s._replace(signal=np.where(s.signal < threshold, 0.0, s.signal))


SENSOR_STAGES = (smear, well, read, late_knee, bent, black, rows, cut_black)


@cache
def counts(*electrons: float) -> np.ndarray:
    """Electrons [draw, pixel], the same for every case with this light."""
    return np.random.default_rng(5).poisson(electrons, (DRAWS, len(electrons))).astype(float)


@cache
def normals() -> np.ndarray:
    """Standard normal numbers [draw, pixel and row]."""
    return np.random.default_rng(6).standard_normal((DRAWS, 7))


def drawn(cases, sensor: SensorModel, stages=SENSOR_STAGES, turned: int = 0) -> np.ndarray:
    """Readings [draw, pixel]; `turned`: the same rows' offsets with the pixels' noise of other draws."""
    own, form = {c.name: c.values for c in cases}, {c.name: c.form for c in cases}
    light = LEVELS_DN.copy()
    if form.get("dark_offset") == "light":
        light += own["dark_offset"]["level"]
    electrons = light / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * 1e-3
    noise = np.concatenate([np.roll(normals()[:, :6], turned, axis=0), normals()[:, 6:]], axis=1)
    state = Noisy(np.roll(counts(*electrons), turned, axis=0), noise, sensor, own, form)
    for stage in stages:
        state = stage(state)
    return np.clip(np.rint(state.signal), 0, sensor.full_scale_dn)


def predicted(cases, sensor: SensorModel) -> tuple[np.ndarray, np.ndarray]:
    """The library's mean and variance of the same pixels: they lie where the spot has these levels."""
    reach = np.sqrt(2 * np.log(640.0 / np.maximum(LEVELS_DN, 1e-300)))
    view, base = free(640.0, 10.0)
    view = view._replace(x=view.x0 + 10.0 * reach[None, None, :], y=view.y0, frame_rows=4.0)
    got = chain.moments(view, PLAIN, base, present(cases), sensor)
    return got.mean[0, 0], got.variance[0, 0]


QUIET = SENSOR._replace(read_noise_e=6.0, full_well_e=5000.0)
LOW = SENSOR._replace(black_level_dn=0.0)
# y + 0.2 y²/1023 = 406.
WHOLE = float((np.sqrt(1 + 0.8 * 406 / 1023) - 1) * 1023 / 0.4)
READINGS = {
    "plain": ([], SENSOR),
    "no black level": ([], LOW),
    "full well": ([], QUIET),
    **{
        f"saturation, {form}": ([of("saturation", form, level=380.0, knee=0.15)], SENSOR)
        for form in vocabulary()["saturation"].forms
    },
    "saturation within the noise": ([of("saturation", "sharp", level=630.0, knee=0.1)], SENSOR),
    "nonlinearity": ([of("nonlinearity", q=0.4)], SENSOR),
    "nonlinearity, upwards": ([of("nonlinearity", q=-0.5)], SENSOR),
    "subtracted": ([of("black_clipping", "subtracted", threshold=41.0)], SENSOR),
    "dead zone": ([of("black_clipping", "dead zone", threshold=43.3)], SENSOR),
    "ambient light": ([of("dark_offset", "light", level=30.0)], SENSOR),
    "black level": ([of("dark_offset", "electronic", level=30.0)], LOW),
    "excess read noise": ([of("excess_read_noise", total=40.0)], SENSOR),
    "excess read noise at black": ([of("excess_read_noise", total=40.0)], LOW),
    "smear": ([of("smear", fraction=0.3)], SENSOR),
    "smear into the well": ([of("smear", fraction=2.0)], QUIET),
    "smear, knee and bend": (
        [
            of("smear", fraction=1.2),
            of("saturation", "sharp", level=560.0, knee=0.1),
            of("nonlinearity", q=0.3),
            of("excess_read_noise", total=25.0),
            of("black_clipping", "subtracted", threshold=38.0),
        ],
        SENSOR,
    ),
    "noise into the knee": (
        [
            # Bent to 446 DN with the black level: a whole number, see below.
            of("saturation", "sharp with noise", level=WHOLE, knee=0.1),
            of("excess_read_noise", total=60.0),
            of("nonlinearity", q=-0.2),
            of("dark_offset", "light", level=10.0),
            of("black_clipping", "dead zone", threshold=45.0),
        ],
        SENSOR,
    ),
    "to full scale": ([of("nonlinearity", q=-0.6), of("dark_offset", "electronic", level=110.0)], SENSOR),
}


def compare(readings: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations of mean and variance from the draws', in standard errors. A normal law for electrons and half a
    curvature for a knee may be off by 0.3 % of the scatter or 0.01 DN, and 0.8 % of a variance or 0.01 DN²."""
    own, spread = readings.mean(axis=0), readings.var(axis=0)
    fourth = ((readings - own) ** 4).mean(axis=0)
    error = np.sqrt(np.maximum(spread, 1e-6) / DRAWS) + (0.003 * np.sqrt(spread) + 0.01) / 5
    error_2 = np.sqrt(np.maximum(fourth - spread**2, 1e-6) / DRAWS) + (0.008 * spread + 0.01) / 5
    return np.abs(mean - own) / error, np.abs(variance - spread) / error_2


@pytest.mark.parametrize(("cases", "sensor"), READINGS.values(), ids=READINGS)
def test_readings_against_draws(cases, sensor):
    """100,000 draws a pixel. Beyond five standard errors one comparison in 1.7 million falls by chance, and here are
    some 300."""
    mean, variance = predicted(cases, sensor)
    off_mean, off_variance = compare(drawn(cases, sensor), mean, variance)
    assert off_mean.max() < 5, off_mean
    assert off_variance.max() < 5, off_variance


def test_row_noise_moves_the_mean_where_black_cuts_it():
    """The mean is that over all rows; the variance that of the pixels within one row, mean over all rows."""
    case = of("row_noise", rms=3.0)
    mean, variance = predicted([case], LOW)
    assert compare(drawn([case], LOW), mean, variance)[0].max() < 5
    # Of two readings in one row the half square of the difference.
    half = (drawn([case], LOW) - drawn([case], LOW, turned=1)) ** 2 / 2
    # A draw has a part in two differences: at most √2 of the error of independent ones.
    error = np.sqrt(2) * half.std(axis=0) / np.sqrt(DRAWS)
    assert (np.abs(half.mean(axis=0) - variance) / error).max() < 5
    # Far above black the mean stays.
    np.testing.assert_allclose(mean[3:], predicted([], LOW)[0][3:], rtol=1e-12)
    assert mean[0] > predicted([], LOW)[0][0] + 0.5


SENSOR_ORDER = {
    "smear before the well": ([of("smear", fraction=2.0)], QUIET, (smear, well)),
    "well before read noise": ([of("saturation", "sharp", level=380.0, knee=0.1)], SENSOR, (well, read)),
    "nonlinearity without black level": ([of("nonlinearity", q=0.4)], SENSOR, (bent, black)),
    "read noise before nonlinearity": ([of("nonlinearity", q=0.45), of("excess_read_noise", total=200.0)], SENSOR,
                                       (read, bent)),
    "black level before black clipping": ([of("black_clipping", "dead zone", threshold=43.0)], SENSOR,
                                          (black, cut_black)),
    "row noise before black clipping": ([of("row_noise", rms=3.0), of("black_clipping", "dead zone", threshold=4.0)],
                                        LOW, (rows, cut_black)),
}  # fmt: skip


@pytest.mark.parametrize(("cases", "sensor", "pair"), SENSOR_ORDER.values(), ids=SENSOR_ORDER)
def test_order_of_the_sensor(cases, sensor, pair):
    """The contract's order agrees within five standard errors, the swapped one is off by far more."""
    mean, variance = predicted(cases, sensor)
    if "row_noise" in [case.name for case in cases]:
        variance = np.full_like(variance, np.nan)  # another variance: the test above
    right = np.nanmax(compare(drawn(cases, sensor), mean, variance))
    first, second = (SENSOR_STAGES.index(stage) for stage in pair)
    others = [stage for stage in SENSOR_STAGES if stage is not pair[0]]
    swapped = [*others[:second], pair[0], *others[second:]]
    assert first < second
    wrong = np.nanmax(compare(drawn(cases, sensor, swapped), mean, variance))
    assert right < 5 and wrong > 20, (right, wrong)


def test_a_clip_between_two_readings():
    """Noise that is cut at 380.3 DN reads 420 with the black level, not 420.3: for a fit to find that whole number the
    mean follows the level, so it is off by up to that 0.3 DN where noise is cut, and nowhere else."""
    case = of("saturation", "sharp with noise", level=380.3, knee=0.1)
    mean, variance = predicted([case], SENSOR)
    readings = drawn([case], SENSOR).mean(axis=0)
    assert readings[5] == 420 and mean[5] == pytest.approx(420.3) and variance[5] < 1e-6
    # Five errors of 100,000 draws of 4 DN are 0.06 DN.
    off = np.abs(mean - readings)
    assert off[4] < 0.3 and off[:4].max() < 0.06


# Single functions of the sensor's part, by quadrature and differences.

NODES = np.linspace(-9.0, 9.0, 60_001)
# Trapezoid rule: with h = 3e-4 between the nodes the kink of a clip costs h²/8 of a density, 5e-9.
WEIGHTS = np.exp(-(NODES**2) / 2) * (NODES[1] - NODES[0]) / np.sqrt(2 * np.pi)


def well_of(form: str, mean, variance, read_variance, level: float, width: float):
    """Saturation as the chain calls it."""
    own = of("saturation", form, level=level, knee=width).present()
    return own.apply(np.asarray(mean, float), np.asarray(variance, float), np.asarray(read_variance, float))


@pytest.mark.parametrize("form", ["sharp", "sharp with noise"])
@pytest.mark.parametrize("sd", [0.3, 4.0, 25.0])
def test_a_sharp_knee_clips_a_normal_law(form, sd):
    """Mean and variance by quadrature from far below to far above the level. `with noise` clips read noise as well:
    the variance, once the chain has added that noise again, is that of all noise, clipped."""
    level, noise = 300.0, 9.0
    at = level + sd * np.array([-30.0, -8.0, -3.0, -1.0, -0.2, 0.0, 0.7, 2.0, 5.0, 11.0, 40.0])
    mean, variance = well_of(form, at, np.full(at.size, sd**2), noise, level, 0.1)
    spread = np.sqrt(sd**2 + (noise if form == "sharp with noise" else 0.0))
    for m, own, second in zip(at, mean, variance + (noise if form == "sharp with noise" else 0.0), strict=True):
        clipped = np.minimum(m + spread * NODES, level)
        want = WEIGHTS @ clipped
        # Sums of 300: 1e-12 of it; the kink as above.
        assert own == pytest.approx(want, abs=1e-9 + 1e-8 * spread)
        assert second == pytest.approx(WEIGHTS @ (clipped - want) ** 2, abs=1e-9 + 1e-7 * spread**2)
    if spread == sd:
        assert mean[-1] == level


KNEES = {
    "soft": soft_knee,
    # (x^−m + level^−m)^(−1/m), by logarithms: high powers of numbers of hundreds overflow.
    "power": lambda x, level, k: np.exp(-k * np.logaddexp(-np.log(x) / k, -np.log(level) / k)),
}


@pytest.mark.parametrize("width", [0.002, 0.03, 0.2, 1.0])
@pytest.mark.parametrize("form", KNEES)
def test_soft_knees(form, width):
    """Value, slope and curvature: without noise the value, with a little noise slope² v and half the curvature times v,
    against differences of the closed form at five points."""
    level = 400.0
    x = level * np.array([0.02, 0.3, 0.7, 0.95, 1.0, 1.02, 1.3, 2.0, 3.0])
    nothing = np.zeros(x.size)
    value, still = well_of(form, x, nothing, 0.0, level, width)
    closed = KNEES[form]
    np.testing.assert_allclose(value, closed(x, level, width), rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(still, 0.0)
    assert np.all(value <= level * (1 + 1e-12))
    # Darkness stays dark, and light without end comes to the level.
    assert well_of(form, [0.0, 1e6 * level], [0.0, 0.0], 0.0, level, width)[0] == pytest.approx([0, level], abs=1e-3)
    # Errors of five points: h⁴/30 f⁗ and rounding 1e-13/h²; h a fiftieth of the knee.
    h = min(0.02 * width * level, 2.0)
    ends = {k: closed(x + k * h, level, width) for k in (-2, -1, 0, 1, 2)}
    slope = (ends[-2] - 8 * ends[-1] + 8 * ends[1] - ends[2]) / (12 * h)
    bend = (-ends[-2] + 16 * ends[-1] - 30 * ends[0] + 16 * ends[1] - ends[2]) / (12 * h * h)
    v = 2.5
    mean, variance = well_of(form, x, nothing + v, 0.0, level, width)
    sharpest = 1 / (width * level)
    np.testing.assert_allclose(variance, slope**2 * v, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose((mean - value) * 2 / v, bend, rtol=1e-5, atol=1e-5 * sharpest)
    # With noise: that of the read-out goes through the knee too, and the chain adds it again.
    late = well_of(f"{form} with noise", x, nothing + v, 4.0, level, width)
    np.testing.assert_allclose(late[1] + 4.0, slope**2 * (v + 4.0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(late[0], value + bend * (v + 4.0) / 2, atol=1e-5 * sharpest * (v + 4) + 1e-9)


@pytest.mark.parametrize("form", ["soft", "power"])
def test_a_knee_stops_the_signal_however_far_it_is_driven(form):
    """The sentence: "the signal stops at a level". Within the bounds: 50 times the level, any width of the knee."""
    context = CONTEXTS["the paper's"]
    (low, _), (narrow, wide) = vocabulary()["saturation"].bounds(context)
    level = float(low)
    x = np.linspace(0.5 * level, context.peak_dn, 400)
    for width in np.geomspace(narrow, wide, 12):
        value, _ = well_of(form, x, 0 * x, 0.0, level, float(width))
        np.testing.assert_allclose(value, KNEES[form](x, level, width), rtol=1e-9, err_msg=f"knee {width:g}")


@pytest.mark.parametrize("form", ["soft", "power"])
def test_a_knee_against_quadrature(form):
    """A knee ten noises wide: half the curvature times the variance leaves (sd/width)² of that shift and of the change
    in variance."""
    level, width, sd = 400.0, 0.25, 10.0
    x = np.array([100.0, 300.0, 400.0, 480.0, 700.0])
    mean, variance = well_of(form, x, np.full(5, sd**2), 0.0, level, width)
    for m, own, second in zip(x, mean, variance, strict=True):
        bent_draws = KNEES[form](np.maximum(m + sd * NODES, 1e-6), level, width)
        want = WEIGHTS @ bent_draws
        assert own == pytest.approx(want, abs=0.01)
        assert second == pytest.approx(WEIGHTS @ (bent_draws - want) ** 2, rel=0.02)


@pytest.mark.parametrize("q", [-0.6, 0.02, 0.45])
def test_nonlinearity_of_a_normal_law(q):
    """E[y − q y²/F] = m − q (m² + v)/F exactly, the noise's own term included; Var = s² v + 2 q² v²/F², s the slope;
    its last term, below 0.01 DN² here, is left out."""
    y, v, full = np.array([0.0, 100.0, 500.0, 1000.0]), np.array([2.1, 13.0, 57.0, 112.0]), 1023.0
    mean, variance = of("nonlinearity", q=q).present().apply(y, v, full)
    for k in range(4):
        z = y[k] + np.sqrt(v[k]) * NODES
        readings = z - q * z**2 / full
        assert mean[k] == pytest.approx(WEIGHTS @ readings, abs=1e-8)
        left_out = 2 * (q * v[k] / full) ** 2
        assert variance[k] == pytest.approx(WEIGHTS @ (readings - mean[k]) ** 2 - left_out, rel=1e-9, abs=1e-8)
        assert left_out < 0.01


def test_smear_spreads_each_column_evenly():
    """What comes on top is the same in every row of a column, and `fraction` of all the column's electrons in all;
    points that stand for several rows count as often."""
    rng = np.random.default_rng(3)
    electrons = rng.uniform(0, 5000, (6, 44, 48))
    case = of("smear", fraction=0.07).present()
    extra = case.apply(VIEW, electrons.copy()) - electrons
    np.testing.assert_allclose(extra, np.broadcast_to(extra[:, :1], extra.shape), rtol=1e-9)
    np.testing.assert_allclose(300 * extra[:, 0], 0.07 * 2 * electrons.sum(axis=1), rtol=1e-12)
    # A frame that is all seen: (1 + fraction) times the charge.
    whole = case.apply(VIEW._replace(rows_each=1.0, frame_rows=44.0), electrons)
    assert whole.sum() == pytest.approx(1.07 * electrons.sum(), rel=1e-12)
    assert np.ptp((whole - electrons)[0], axis=0).max() < 1e-9


def test_read_noise_is_the_total():
    """In electrons, instead of the stated one; the mean stays where black cuts nothing."""
    plain, own = all_moments([]), all_moments([of("excess_read_noise", total=31.0)])
    bright = plain.mean > 100
    np.testing.assert_allclose(own.mean[bright], plain.mean[bright], rtol=1e-12)
    added_noise = SENSOR.gain_dn_per_e**2 * (31.0**2 - 13.0**2)
    np.testing.assert_allclose((own.variance - plain.variance)[bright], added_noise, rtol=1e-9)


@pytest.mark.parametrize("form", ["light", "electronic"])
def test_a_pedestal_brings_shot_noise_only_as_light(form):
    """Uniform in every frame; its variance K · level or none."""
    plain, own = all_moments([]), all_moments([of("dark_offset", form, level=21.0)])
    np.testing.assert_allclose(own.mean - plain.mean, 21.0, rtol=1e-9)
    noise = SENSOR.gain_dn_per_e * 21.0 if form == "light" else 0.0
    np.testing.assert_allclose(own.variance - plain.variance, noise, rtol=1e-9, atol=1e-10)


def test_forms_of_black_clipping():
    """A level that is taken off shifts what is far above it; a dead zone leaves that alone and makes the rest 0."""
    plain = all_moments([])
    taken = all_moments([of("black_clipping", "subtracted", threshold=25.0)])
    dead = all_moments([of("black_clipping", "dead zone", threshold=55.0)])
    high = plain.mean > 150
    np.testing.assert_allclose((plain.mean - taken.mean)[high], 25.0, rtol=1e-12)
    np.testing.assert_allclose(dead.mean[high], plain.mean[high], rtol=1e-12)
    border = plain.mean < 41
    assert border.any() and dead.mean[border].max() < 1e-6


def test_two_thresholds():
    """Of a user's vocabulary there may be two: levels taken off add up, of dead zones the larger counts."""
    for form, first, second, together in (("subtracted", 10.0, 15.0, 25.0), ("dead zone", 55.0, 30.0, 55.0)):
        both = all_moments([of("black_clipping", form, threshold=own) for own in (first, second)])
        for got, want in zip(both, all_moments([of("black_clipping", form, threshold=together)]), strict=True):
            np.testing.assert_array_equal(got, want)


# What is drawn: fields and numbers of a frame, a site or the sensor.


def draw_of(name: str, *arguments, seed: int = 11, **values):
    """The effect's own function with a generator."""
    return vocabulary()[name].function(*arguments, np.random.default_rng(seed), **values)


def test_where_scatter_belongs():
    """Of what, and shared by what, as the contract's table says; and what it is to a fit."""
    assert {name: tuple(effect.scatter) for name, effect in vocabulary().items() if effect.scatter} == {
        "speckle": ("field", "site", "grain"),
        "power_fluctuation": ("gain", "frame", "gain"),
        "pointing_jitter": ("centre", "frame", "centre"),
        "fixed_pattern": ("field", "sensor", "pixel"),
        "row_noise": ("row", "frame", "row"),
    }


@pytest.mark.parametrize(("contrast", "grain"), [(0.05, 2.0), (0.3, 1.0), (0.6, 3.5), (1.0, 2.0)])
def test_speckle_field(contrast, grain):
    """Mean 1, the stated contrast, never negative, correlated as exp(−d²/2 grain²)."""
    side = 256
    fields = [draw_of("speckle", (side, side), seed=k, contrast=contrast, grain=grain) for k in range(3)]
    assert min(f.min() for f in fields) >= 0
    # Every field is scaled to its own mean and scatter; cutting at 0 what scaling brought below moves little.
    assert np.mean(fields) == pytest.approx(1, abs=2e-3)
    assert np.mean([f.std() for f in fields]) == pytest.approx(contrast, rel=5e-3)
    power = np.mean([np.abs(np.fft.fft2(f / f.mean() - 1)) ** 2 for f in fields], axis=0)
    correlation = np.real(np.fft.ifft2(power))
    correlation /= correlation[0, 0]
    lags = np.arange(1, int(2 * grain) + 1)
    want = np.exp(-(lags**2) / (2 * grain**2))
    # Three fields of 256²/(4π grain²) grains leave 1/√ of their number, 0.03 at the coarsest; three of it.
    error = 3 / np.sqrt(3 * side**2 / (4 * np.pi * grain**2))
    for found in (correlation[0, lags], correlation[lags, 0]):
        np.testing.assert_allclose(found, want, atol=error + 0.01)


@pytest.mark.parametrize(
    ("name", "shape", "strength", "values"),
    [
        ("speckle", ((8, 9),), "contrast", {"grain": 2.0}),
        ("fixed_pattern", ((8, 9),), "prnu", {"hot_pixels": 0.0}),
        ("power_fluctuation", (), "rms", {}),
        ("pointing_jitter", (), "rms", {}),
        ("row_noise", (8,), "rms", {}),
    ],
)
def test_scatter_without_strength(name, shape, strength, values):
    """At the neutral strength a factor is 1 and a shift 0."""
    effect = vocabulary()[name]
    assert effect.parameters[0].name == strength and effect.neutral == 0
    got = draw_of(name, *shape, **values, **{strength: 0.0})
    neutral = 1.0 if name in ("speckle", "fixed_pattern", "power_fluctuation") else 0.0
    np.testing.assert_allclose(got, neutral, atol=1e-12)


def test_scatter_of_numbers():
    """Normal, with the stated rms; 40,000 of them tell it to 0.35 %, five errors are 1.8 %."""
    rng = np.random.default_rng(4)
    known = vocabulary()
    gains = known["fixed_pattern"].function((200, 200), rng, prnu=0.02, hot_pixels=0.0)
    assert gains.mean() == pytest.approx(1, abs=5e-4) and gains.std() == pytest.approx(0.02, rel=0.018)
    rows_of = known["row_noise"].function(40_000, rng, rms=0.7)
    assert rows_of.mean() == pytest.approx(0, abs=0.0175) and rows_of.std() == pytest.approx(0.7, rel=0.018)
    powers = np.array([known["power_fluctuation"].function(rng, rms=0.1) for _ in range(40_000)])
    assert powers.mean() == pytest.approx(1, abs=2.5e-3) and powers.std() == pytest.approx(0.1, rel=0.018)
    shifts = np.array([known["pointing_jitter"].function(rng, rms=0.3) for _ in range(40_000)])
    np.testing.assert_allclose(shifts.std(axis=0), 0.3, rtol=0.018)
    np.testing.assert_allclose(np.corrcoef(shifts.T)[0, 1], 0, atol=0.025)
    # A factor on light is never negative.
    assert known["fixed_pattern"].function((200, 200), rng, prnu=1.0, hot_pixels=0.0).min() == 0
    assert min(known["power_fluctuation"].function(rng, rms=2.0) for _ in range(99)) == 0
