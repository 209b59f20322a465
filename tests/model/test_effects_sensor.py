"""The sensor's part of effects, and what is drawn.

`drawn` below is the dataset contract's chain at pixels, one stage a function, in a given order of stages: the library
must agree in the contract's order, and would not in another.
"""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from spotcheck.model.conditions import PixelGrid
from spotcheck.model.effect import AppliedStep, RandomStep
from spotcheck.model.effects import vocabulary
from spotcheck.sensor import SensorModel
from tests.samples.effect_cases import FRAMES, SATURATION, SCALES, SENSOR, expected_of, free_frame, of

# The sensor's part, by a chain of random draws that follows the contract's order.

DRAWS = 100_000
LEVELS_DN = np.array([0.0, 3.0, 25.0, 120.0, 380.0, 640.0])


class Noisy(NamedTuple):
    """Draws [draw, pixel] on their way through the sensor: electrons, then DN; what stays the same for all of them."""

    signal: np.ndarray
    noise: np.ndarray
    sensor: SensorModel
    values: dict[str, dict[str, float]]
    variant: dict[str, str]


def smear(s: Noisy) -> Noisy:
    """Each pixel here stands for the one row of a column of 4: it leaves a quarter of `fraction` behind."""
    if "smear" not in s.values:
        return s
    return s._replace(signal=s.signal + s.values["smear"]["fraction"] * s.signal.mean(axis=0) / 4)


def soft_knee(y, level, width):
    """What (1 + e^(x/w − 1/k)) / (1 + e^(−1/k)) leaves of x: 0 at 0, the level at the end."""
    scale = level / np.log1p(np.exp(1 / width)) if width > 0.01 else level * width
    return y - scale * (np.logaddexp(0, y / scale - 1 / width) - np.logaddexp(0, -1 / width))


KNEES = {
    "soft": soft_knee,
    # (x^−m + level^−m)^(−1/m), by logarithms: high powers of numbers of hundreds overflow.
    "power": lambda x, level, k: np.exp(-k * np.logaddexp(-np.log(x) / k, -np.log(level) / k)),
}


def knee(y, level, width, variant):
    """The bent response itself; signals below 0 are noise and stay."""
    if variant.startswith("sharp"):
        return np.minimum(y, level)
    return np.where(y > 1e-9, KNEES[variant.split()[0]](np.maximum(y, 1e-9), level, width), y)


def well(s: Noisy) -> Noisy:
    """Full well; saturation [DN without black level] of the charge, read noise still to come."""
    out = np.minimum(s.signal, s.sensor.full_well_e)
    if s.variant.get("saturation", "with noise").endswith("with noise"):
        return s._replace(signal=out)
    p, gain = dict(s.values["saturation"]), s.sensor.gain_dn_per_e
    if "scatter" in p:
        p["level"] = p["level"] * np.maximum(1 + p["scatter"] * levels(), 0)
    return s._replace(signal=knee(gain * out, p["level"], p.get("knee"), s.variant["saturation"]) / gain)


def read(s: Noisy) -> Noisy:
    """Read noise [e-], then K."""
    total = s.values.get("excess_read_noise", {"total": s.sensor.read_noise_e})["total"]
    return s._replace(signal=s.sensor.gain_dn_per_e * (s.signal + total * s.noise[:, :6]))


def late_knee(s: Noisy) -> Noisy:
    """Saturation of what has read noise already."""
    if not s.variant.get("saturation", "").endswith("with noise"):
        return s
    p = s.values["saturation"]
    return s._replace(signal=knee(s.signal, p["level"], p.get("knee"), s.variant["saturation"]))


def bent(s: Noisy) -> Noisy:
    """y − q y²/full scale."""
    q = s.values.get("nonlinearity", {"q": 0.0})["q"]
    return s._replace(signal=s.signal - q * s.signal**2 / s.sensor.full_scale_dn)


def black(s: Noisy) -> Noisy:
    """Black level, and pedestals of the electronics."""
    level = s.sensor.black_level_dn
    if s.variant.get("dark_offset") == "electronic":
        level += s.values["dark_offset"]["level"]
    return s._replace(signal=s.signal + level)


def rows(s: Noisy) -> Noisy:
    """One offset a row."""
    rms = s.values.get("row_noise", {"rms": 0.0})["rms"]
    return s._replace(signal=s.signal + rms * s.noise[:, 6:])


def cut_black(s: Noisy) -> Noisy:
    """A threshold that is taken off, or below which readings are 0."""
    threshold = s.values.get("black_clipping", {"threshold": 0.0})["threshold"]
    if s.variant.get("black_clipping") == "subtracted":
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


@cache
def levels() -> np.ndarray:
    """Standard normal numbers [draw, pixel] for the levels of pixels."""
    return np.random.default_rng(7).standard_normal((DRAWS, 6))


def drawn(cases, sensor: SensorModel, stages=SENSOR_STAGES) -> np.ndarray:
    """Readings [draw, pixel]."""
    values, variant = {c.name: c.values for c in cases}, {c.name: c.variant for c in cases}
    light = LEVELS_DN.copy()
    if variant.get("dark_offset") == "light":
        light += values["dark_offset"]["level"]
    electrons = light / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * 1e-3
    state = Noisy(counts(*electrons), normals(), sensor, values, variant)
    for stage in stages:
        state = stage(state)
    return np.clip(np.rint(state.signal), 0, sensor.full_scale_dn)


def predicted(cases, sensor: SensorModel) -> tuple[np.ndarray, np.ndarray]:
    """The library's mean and variance of the same pixels: they lie where the spot has these levels."""
    reach = np.sqrt(2 * np.log(640.0 / np.maximum(LEVELS_DN, 1e-300)))
    grid = PixelGrid(120.4 + 10.0 * reach[None, :], np.array([[119.7]]), 240, 4)
    return expected_of(cases, sensor, [free_frame(640.0, 10.0, grid)], "free")[:, 0, 0]


QUIET = replace(SENSOR, read_noise_e=6.0, full_well_e=5000.0)
LOW = replace(SENSOR, black_level_dn=0.0)
READINGS = {
    "plain": ([], SENSOR),
    "no black level": ([], LOW),
    "full well": ([], QUIET),
    **{f"saturation, {case.variant}": ([case], SENSOR) for case in SATURATION},
    "saturation within the noise": ([of("saturation", "sharp", level=630.0)], SENSOR),
    "nonlinearity": ([of("nonlinearity", q=0.4)], SENSOR),
    "nonlinearity, upwards": ([of("nonlinearity", q=-0.5)], SENSOR),
    "subtracted": ([of("black_clipping", "subtracted", threshold=41.0)], SENSOR),
    "dead zone": ([of("black_clipping", "dead zone", threshold=43.3)], SENSOR),
    "ambient light": ([of("dark_offset", "light", level=30.0)], SENSOR),
    "black level": ([of("dark_offset", "electronic", level=30.0)], LOW),
    "excess read noise": ([of("excess_read_noise", total=40.0)], SENSOR),
    "excess read noise at black": ([of("excess_read_noise", total=40.0)], LOW),
    "smear": ([of("smear", fraction=0.3)], SENSOR),
    "smear into the well": ([of("smear", fraction=1.0)], QUIET),
    "smear, knee and bend": (
        [
            of("smear", fraction=1.2),
            of("saturation", "sharp", level=560.0),
            of("nonlinearity", q=0.3),
            of("excess_read_noise", total=25.0),
            of("black_clipping", "subtracted", threshold=38.0),
        ],
        SENSOR,
    ),
    "noise into the knee": (
        [
            of("saturation", "sharp with noise", level=380.3),
            of("excess_read_noise", total=60.0),
            of("nonlinearity", q=-0.2),
            of("dark_offset", "light", level=10.0),
            of("black_clipping", "dead zone", threshold=45.0),
        ],
        SENSOR,
    ),
    "a clip between two readings": ([of("saturation", "sharp with noise", level=380.3)], SENSOR),
    "rows at black": ([of("row_noise", rms=3.0)], LOW),
    "rows into a dead zone": ([of("row_noise", rms=1.2), of("black_clipping", "dead zone", threshold=4.0)], LOW),
    "to full scale": ([of("nonlinearity", q=-0.6), of("dark_offset", "electronic", level=110.0)], SENSOR),
}


def compare(readings: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> float:
    """Largest deviation of mean and variance from the draws', in standard errors; 1e-3 DN and DN² are left to
    interpolation and to smear, whose missing shot noise the model takes off to first order."""
    spread = readings.var(axis=0)
    fourth = ((readings - readings.mean(axis=0)) ** 4).mean(axis=0)
    error = np.sqrt(spread / DRAWS) + 1e-3
    error_2 = np.sqrt(np.maximum(fourth - spread**2, 0) / DRAWS) + 1e-3
    return max((np.abs(mean - readings.mean(axis=0)) / error).max(), (np.abs(variance - spread) / error_2).max())


@pytest.mark.parametrize(("cases", "sensor"), READINGS.values(), ids=READINGS)
def test_readings_against_draws(cases, sensor):
    """100,000 draws a pixel. Beyond five standard errors one comparison in 1.7 million falls by chance, and here are
    some 300."""
    assert compare(drawn(cases, sensor), *predicted(cases, sensor)) < 5


SENSOR_ORDER = {
    "smear before the well": ([of("smear", fraction=1.0)], QUIET, (smear, well)),
    "well before read noise": ([of("saturation", "sharp", level=380.0)], SENSOR, (well, read)),
    "nonlinearity without black level": ([of("nonlinearity", q=0.4)], SENSOR, (bent, black)),
    "read noise before nonlinearity": ([of("nonlinearity", q=0.45), of("excess_read_noise", total=200.0)], SENSOR,
                                       (read, bent)),
    "black level before black clipping": ([of("black_clipping", "dead zone", threshold=43.0)], SENSOR,
                                          (black, cut_black)),
    "row noise before black clipping": ([of("row_noise", rms=1.2), of("black_clipping", "dead zone", threshold=4.0)],
                                        LOW, (rows, cut_black)),
}  # fmt: skip


@pytest.mark.parametrize(("cases", "sensor", "pair"), SENSOR_ORDER.values(), ids=SENSOR_ORDER)
def test_order_of_the_sensor(cases, sensor, pair):
    """The contract's order agrees within five standard errors, the swapped one is off by far more."""
    first, second = (SENSOR_STAGES.index(stage) for stage in pair)
    others = [stage for stage in SENSOR_STAGES if stage is not pair[0]]
    swapped = [*others[:second], pair[0], *others[second:]]
    assert first < second
    right, wrong = (compare(drawn(cases, sensor, order), *predicted(cases, sensor)) for order in
                    (SENSOR_STAGES, swapped))  # fmt: skip
    assert right < 5 and wrong > 20, (right, wrong)


# Knees and smear, by their closed forms.


def act(case, *arguments):
    """Return what the first step of a case makes of the arguments of its stage."""
    effect = case.applied()
    return AppliedStep(effect.effect.variants[effect.variant][0], effect)(*arguments)


@pytest.mark.parametrize("variant", KNEES)
def test_a_knee_stops_the_signal_however_far_it_is_driven(variant):
    """The sentence: "the signal stops at a level". Within the bounds: 50 times the level, any width of the knee; in
    front of the read noise and behind it. Darkness stays dark, and a signal never decreases."""
    (low, _), (narrow, wide), _ = vocabulary()["saturation"].bounds(SCALES["the paper's"])
    for level in (low, 400.0):
        for knee_width in np.geomspace(narrow, wide, 12):
            for text in (variant, f"{variant} with noise"):
                case = of("saturation", text, level=level, knee=knee_width)
                x = level * np.geomspace(0.02, 100.0, 400)
                value = act(case, x)
                np.testing.assert_allclose(value, KNEES[variant](x, level, knee_width), rtol=1e-9, atol=1e-9)
                assert np.all(value <= level * (1 + 1e-12)) and np.all(np.diff(value) >= -1e-12 * level)
                ends = act(case, np.array([-5.0, 0.0, 1e6 * level]))
                assert ends == pytest.approx([-5.0, 0.0, level], abs=1e-3 * level)


def test_smear_spreads_each_column_evenly():
    """What comes on top is the same in every row of a column, and `fraction` of all the column's electrons if the frame
    is the whole sensor; a window gets the share of its rows."""
    electrons = np.random.default_rng(3).uniform(0, 5000, (44, 48))
    case = of("smear", fraction=0.07)
    window = replace(FRAMES[0], pixels=PixelGrid(np.arange(48)[None, :], np.arange(44)[:, None], 48, 300))
    whole = replace(window, pixels=replace(window.pixels, sensor_rows=44))
    for frame, rows in ((window, 300), (whole, 44)):
        extra = act(case, frame, electrons) * np.ones((44, 1))
        np.testing.assert_allclose(rows * extra, 0.07 * electrons.sum(axis=0) * np.ones((44, 1)), rtol=1e-12)
    assert extra.sum() == pytest.approx(0.07 * electrons.sum(), rel=1e-12)


# What is drawn: fields and numbers of a frame, a site or the sensor.


def draw_of(name: str, shape=(), seed: int = 11, count: int = 1, **values) -> np.ndarray:
    """Return what all random steps of an effect draw [draw, step, ...], with one generator."""
    effect, rng = of(name, **values).applied(), np.random.default_rng(seed)
    steps = [
        AppliedStep(step, effect) for step in effect.effect.variants[effect.variant] if isinstance(step, RandomStep)
    ]
    return np.array([[step.call(step.step.draw, rng, shape) for step in steps] for _ in range(count)])


@pytest.mark.parametrize(("contrast", "grain"), [(0.05, 2.0), (0.3, 1.0), (0.6, 3.5), (1.0, 2.0)])
def test_speckle_field(contrast, grain):
    """Mean 1, the stated contrast, never negative, correlated as exp(−d²/2 grain²)."""
    side = 256
    fields = [draw_of("speckle", (side, side), seed=k, contrast=contrast, grain=grain)[0, 0] for k in range(3)]
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


@pytest.mark.parametrize(("name", "values", "mean"), [
    ("fixed_pattern", {"prnu": 0.02, "hot_pixels": 0.0}, 1.0),
    ("row_noise", {"rms": 0.7}, 0.0),
    ("power_fluctuation", {"rms": 0.1}, 1.0),
    ("pointing_jitter", {"rms": 0.3}, 0.0),
])  # fmt: skip
def test_what_is_drawn_is_normal(name, values, mean):
    """With the stated rms; 40,000 numbers tell it to 0.35 %, five errors are 1.8 %. Rows get one number each, pixels
    one each, and both coordinates of a centre their own."""
    rms = next(iter(values.values()))
    shape, count = {"fixed_pattern": ((200, 200), 1), "row_noise": ((40_000, 7), 1)}.get(name, ((8, 9), 40_000))
    numbers = draw_of(name, shape, count=count, **values)
    sizes = {"fixed_pattern": (1, 1, 200, 200), "row_noise": (1, 1, 40_000, 1), "pointing_jitter": (40_000, 2)}
    assert numbers.shape == sizes.get(name, (40_000, 1))
    assert numbers.mean() == pytest.approx(mean, abs=5 * rms / 200)
    np.testing.assert_allclose(numbers.reshape(40_000, -1).std(axis=0), rms, rtol=0.018)
    if name == "pointing_jitter":
        assert abs(np.corrcoef(numbers.T)[0, 1]) < 0.025


@pytest.mark.parametrize(("name", "values"), [("fixed_pattern", {"prnu": 1.0, "hot_pixels": 0.0}),
                                              ("power_fluctuation", {"rms": 2.0}),
                                              ("speckle", {"contrast": 1.0, "grain": 0.5})])  # fmt: skip
def test_a_factor_on_light_is_never_negative(name, values):
    """It is cut at 0."""
    assert draw_of(name, (50, 50), count=50, **values).min() >= 0
