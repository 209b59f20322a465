"""The forward model: moments against random frames, derivatives, random draws, and effects from files at every stage.

Statistical tests have fixed seeds. `deviations` takes some 1000 comparisons for each case; each of them lies beyond 5.5
standard errors by chance once in two million times (variances of a thousand frames are skewed), so that with other
seeds one of the 60 cases would fail once in thirty runs.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from spotcheck.errors import InputError
from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, SpotState, WidthLaw, crop_grid
from spotcheck.model.effect import AppliedEffect, Only, Scope
from spotcheck.model.effect_file import NEVER_RANDOM, read_effect
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel, RandomStreams
from spotcheck.model.light import ExposureLaw
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel
from tests.samples.effect_cases import GHOST, LIGHT, SATURATION, SCATTERED, STEADY, applied, of, title, written

# A frame of 24 × 20 px with a spot of σ_g = 3.96 px and 355 DN in its middle.
FRAME = FrameConditions(
    crop_grid(range(24), range(20), 24, 20), 11.7, 9.4, 3e-4, 9e-4, 4e-4, np.deg2rad(50.0), 0.7, 355.0, 3.96
)
BASELINE, LAW = Baseline(0.5, "spot_area", False, 9e-4), ExposureLaw(0.4, 6.7, 360.0)
# Three standard deviations of the noise lie below black, so that zero cuts a little of the noise.
SENSOR = SensorModel(0.11, 13.0, 2e5, np.inf, 4.5, 1023.0)
# What changes of `STEADY` for so small a frame and so low a black level.
CHANGED = {
    "ghost_reflection": {"dx": 7.0, "dy": -5.0},
    "scatter_halo": {"radius": 8.0},
    "interference_fringes": {"period": 9.0},
    "background_gradient": {"slope": 30.0},
    "saturation": {"level": 210.0},
}
CLIPPING = [of("black_clipping", "subtracted", threshold=3.5), of("black_clipping", "dead zone", threshold=4.3)]
FIXED = [
    case.changed(**CHANGED.get(case.name, {})) for case in [*STEADY, SATURATION[3]] if case.name != "black_clipping"
]
PARTIAL_GRAINS = of("speckle", "over a floor", contrast=0.4, grain=0.7, floor=0.3)
EVERY = [
    *FIXED,
    *CLIPPING,
    PARTIAL_GRAINS,
    *(case.changed(**CHANGED.get(name, {})) for name, case in SCATTERED.items()),
]


def model_of(*cases, sensor=SENSOR, baseline=BASELINE, law=LAW) -> ForwardModel:
    """Return the model of the small frame with effects."""
    return ForwardModel(baseline, sensor, law, applied(cases))


def sampled(model: ForwardModel, count: int, frame=FRAME) -> np.ndarray:
    """Return frames [frame, row, column], each of another seed: another sensor, site and frame."""
    return np.array([model.sample(frame, RandomStreams(seed, 3, 2)) for seed in range(count)], float)


def deviations(readings: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> float:
    """Return the largest deviation of means and variances of frames from those expected, in standard errors.

    Of every pixel, and of sums over all and over the bright pixels of a frame, whose error is that from frame to frame:
    what is random may be common to all pixels. Errors of 1e-3 DN and DN² are left to interpolation.
    """
    off = readings - mean
    chance = np.sqrt(len(readings))
    bright = mean > np.median(mean)
    found = [off.mean(axis=0) / (off.std(axis=0) / chance + 1e-3)]
    square = off**2 - variance
    found.append(square.mean(axis=0) / (square.std(axis=0) / chance + 1e-3))
    for weight in (np.ones_like(mean), bright, mean * bright):
        for part in (off * weight, weight * square / (variance + 0.01)):
            total = part.sum(axis=(1, 2))
            found.append(total.mean() / (total.std() / chance + 1e-3))
    return max(float(np.abs(part).max()) for part in found)


# Mean and variance.


def test_every_effect_and_variant_is_drawn():
    """All of the vocabulary but those without steps, which stand for a learned shape (`test_light_shape`)."""
    steps = {(e.name, v.value) for e in vocabulary().values() for v, steps in e.variants.items() if steps}
    assert {(case.name, case.variant) for case in EVERY} == steps


TOGETHER = {
    "nothing": [],
    "speckle and a clip at 0.6 of the peak": [of("speckle", contrast=0.5, grain=0.7), SATURATION[0].changed(level=213)],
    # A thousandth of the column in each row: `expected` leaves out how much smear scatters with the grains.
    "partial grains and a clip": [PARTIAL_GRAINS, SATURATION[0].changed(level=213)],
    "speckle, pedestal and smear": [of("speckle", contrast=0.4, grain=0.7), of("dark_offset", "light", level=30.0),
                                    of("smear", fraction=0.02)],
    "speckle and gains of pixels": [of("speckle", contrast=0.4, grain=0.7), SCATTERED["fixed_pattern"]],
    "row noise and black clipping": [SCATTERED["row_noise"], CLIPPING[0]],
    "row noise and a dead zone": [SCATTERED["row_noise"], CLIPPING[1]],
    "sites, speckle and scattered levels": [SCATTERED["site_variation"], of("speckle", contrast=0.4, grain=0.7),
                                            SATURATION[3].changed(level=213)],
    "frames, sites and gains": [SCATTERED[name] for name in ("power_fluctuation", "site_variation", "fixed_pattern")],
}  # fmt: skip


@pytest.mark.parametrize("cases", [*([case] for case in EVERY), *TOGETHER.values()],
                         ids=[*map(title, EVERY), *TOGETHER])  # fmt: skip
def test_moments_are_those_of_random_frames(cases):
    """Mean and variance of `expected` and of 600 frames of `sample`, or 1500 of what is random beyond pixels."""
    model = model_of(*cases)
    expected = model.expected(FRAME)
    count = 1500 if any(case.name in SCATTERED for case in cases) else 600
    assert deviations(sampled(model, count), expected.mean, expected.variance) < 5.5


# Derivatives.


def value_of(model: ForwardModel, frame: FrameConditions, name: str) -> float:
    """Return the value of a parameter; names are those of `jacobian`."""
    effect, _, parameter = name.rpartition(".")
    if effect:
        return {own.effect.name: own.parameters for own in model.effects}[effect][parameter]
    return getattr(model.law if model.law is not None and hasattr(model.law, name) else frame, name)


def with_value(model: ForwardModel, frame: FrameConditions, name: str, value: float):
    """Return model and frame with another value of a parameter."""
    effect, _, parameter = name.rpartition(".")
    if effect:
        effects = (own.with_value(parameter, value) if own.effect.name == effect else own for own in model.effects)
        return replace(model, effects=tuple(effects)), frame
    if model.law is not None and hasattr(model.law, name):
        return replace(model, law=replace(model.law, **{name: value})), frame
    return model, replace(frame, **{name: value})


def differences(model: ForwardModel, frame: FrameConditions, name: str) -> np.ndarray:
    """Return the derivatives of mean and variance of `expected` by five-point differences; their error is of h⁴."""
    value = value_of(model, frame, name)
    h = 0.01 if name in ("x0", "y0") else 1e-3 * abs(value)

    def moments(steps: int) -> np.ndarray:
        shifted, conditions = with_value(model, frame, name, value + steps * h)
        expected = shifted.expected(conditions)
        return np.array([expected.mean, expected.variance])

    return (moments(-2) - 8 * moments(-1) + 8 * moments(1) - moments(2)) / (12 * h)


def check_jacobian(model: ForwardModel, frame: FrameConditions, names: list[str]) -> None:
    """Compare derivatives with differences, to 1e-3 of the largest, or where a relative change of the parameter by 1
    moves a mean by 0.01 DN and a variance by 0.1 DN²: rounding makes both wavy by some 1e-5."""
    for name, *got in zip(names, *model.jacobian(frame, names), strict=True):
        scale = 1.0 if name in ("x0", "y0") else abs(value_of(model, frame, name))
        for slope, wanted, floor in zip(got, differences(model, frame, name), (0.01, 0.1), strict=True):
            tolerance = 1e-3 * np.abs(wanted).max() + floor / scale
            assert np.abs(slope - wanted).max() < tolerance, (name, np.abs(slope - wanted).max() / tolerance)


@pytest.mark.parametrize("case", EVERY, ids=title)
def test_jacobian_of_every_effect(case):
    """By place, law and all parameters of the effect."""
    names = list(case.values)
    if case.variant == "sharp with noise":
        # Where all readings stop at one whole number, they know no derivative by the level.
        names.remove("level")
    elif case.variant.endswith("with noise"):
        case = case.changed(level=600, knee=0.3)
    check_jacobian(model_of(case), FRAME, ["x0", "y0", "p1", "p2", "peak_dn", *(f"{case.name}.{n}" for n in names)])


def test_jacobian_without_a_law():
    """By place, peak and width of the frame; far from the sensor's corner, which must not matter."""
    far = replace(FRAME, pixels=crop_grid(range(3000, 3024), range(2000, 2020), 4096, 3072), x0=3011.7, y0=2009.4)
    for frame in (FRAME, far):
        check_jacobian(model_of(law=None), frame, ["x0", "y0", "peak_dn", "sigma_px"])


@pytest.mark.parametrize("name", ["sigma_px", "phase", "smear.fraction", "saturation.depth", "saturation.knee"])
def test_a_parameter_that_the_model_lacks(name):
    """Also one that a law gives, or that another variant has."""
    with pytest.raises(KeyError):
        model_of(SATURATION[0]).jacobian(replace(FRAME, sigma_px=np.nan), [name])


# Random draws.

ALL_SCATTERED = [*SCATTERED.values(), SATURATION[3].changed(level=213.0)]
# Seen almost without noise: 4e7 electrons at the peak.
CLEAN, BRIGHT = SensorModel(1e-3, 1.0, full_scale_dn=65535.0), replace(LAW, peak_dn=40000.0)


def clean(cases, streams: RandomStreams, frame=FRAME) -> np.ndarray:
    """Return a frame almost without noise of its own, over what it is without effects."""
    model = model_of(*cases, sensor=CLEAN, law=BRIGHT)
    return model.sample(frame, streams) / model_of(sensor=CLEAN, law=BRIGHT).light(frame).total


def test_a_frame_depends_on_seed_number_and_site_alone():
    """Not on which frames were drawn before; another seed, frame or site is another frame."""
    model = model_of(*ALL_SCATTERED)
    places = [RandomStreams(seed, frame, site) for seed in (1, 2) for frame in (0, 1) for site in (0, 5)]
    first = [model.sample(FRAME, streams) for streams in places]
    again = [model_of(*ALL_SCATTERED).sample(FRAME, streams) for streams in reversed(places)]
    for k, frame in enumerate(first):
        np.testing.assert_array_equal(frame, again[-1 - k])
        assert all((frame != other).mean() > 0.5 for other in first[:k])


def test_the_scope_of_what_is_drawn():
    """Speckle and stripes are those of a site at all its exposures, gains and levels those of the sensor; the rest is
    anew in every frame. Correlations of what 480 pixels say; independent fields of 40 grains may correlate by 0.5."""
    dim = replace(FRAME, exposure_s=9e-5)
    for name, scope in (("speckle", Scope.SITE), ("interference_fringes", Scope.SITE), ("fixed_pattern", Scope.SENSOR)):
        case = SCATTERED[name]
        lit = model_of(sensor=CLEAN, law=BRIGHT).light(dim).total > 1000
        first, second, elsewhere, other = (
            clean([case], streams, frame)[lit]
            for streams, frame in ((RandomStreams(4, 0, 0), FRAME), (RandomStreams(4, 1, 0), dim),
                                   (RandomStreams(4, 2, 1), FRAME), (RandomStreams(5, 0, 0), FRAME))
        )  # fmt: skip
        np.testing.assert_allclose(second, first, atol=0.02)
        if scope is Scope.SENSOR:
            np.testing.assert_allclose(elsewhere, first, atol=0.02)
        else:
            assert np.corrcoef(elsewhere, first)[0, 1] < 0.6
        assert np.corrcoef(other, first)[0, 1] < 0.6
    # Brightness and place of a frame, which the site does not decide.
    for name in ("power_fluctuation", "pointing_jitter"):
        first, second = (clean([SCATTERED[name]], RandomStreams(4, k, 0)) for k in (0, 1))
        assert np.abs(first - second).max() > 0.01
    factor = [clean([SCATTERED["site_variation"]], RandomStreams(4, k, site))[9, 11] for k, site in
              ((0, 0), (1, 0), (2, 1))]  # fmt: skip
    assert factor[0] == pytest.approx(factor[1], rel=1e-3) != pytest.approx(factor[2], rel=1e-3)


FIELDS = ("speckle", "fixed_pattern", "power_fluctuation", "pointing_jitter", "site_variation")


@pytest.mark.parametrize("name", FIELDS)
def test_another_effect_leaves_the_draws_of_the_others(name):
    """The same frame to the last digit beside effects of next to no strength, before it and behind it."""
    strengths = {"contrast": 1e-12, "prnu": 1e-12, "rms": 1e-12, "brightness": 1e-12, "width": 1e-12}
    others = [case.changed(**{key: strengths[key] for key in case.values if key in strengths})
              for key, case in SCATTERED.items() if key in FIELDS and key != name]  # fmt: skip
    streams = RandomStreams(3, 1, 1)
    np.testing.assert_array_equal(clean([SCATTERED[name]], streams), clean([*others, SCATTERED[name]], streams))


def test_the_order_of_the_effects_does_not_matter():
    """Stages are in their order, and effects of a stage in that of their numbers."""
    cases = [*ALL_SCATTERED[:5], *LIGHT[:1], LIGHT[8], LIGHT[11], LIGHT[12], GHOST, CLIPPING[0],
             of("nonlinearity", q=0.3)]  # fmt: skip
    model, streams = model_of(*cases), RandomStreams(1, 2, 3)
    few = model_of(*cases[5:])
    frame, expected = model.sample(FRAME, streams), few.expected(FRAME)
    rng = np.random.default_rng(1)
    for _ in range(3):
        other = replace(model, effects=tuple(model.effects[k] for k in rng.permutation(len(cases))))
        np.testing.assert_array_equal(other.sample(FRAME, streams), frame)
        other = replace(few, effects=tuple(few.effects[k] for k in rng.permutation(len(few.effects))))
        np.testing.assert_array_equal(other.expected(FRAME).variance, expected.variance)


def test_scattered_levels_are_fixed_to_the_sensor():
    """Under light beyond every level each pixel reads its own, the same in every frame, normal with the relative
    deviation `scatter` (false alarm 1e-4 each); mean and variance over sensors are those of `expected`."""
    sensor = SensorModel(0.1, 5.0, black_level_dn=10.0, full_scale_dn=4095.0)
    model = model_of(SATURATION[3].changed(level=600.0, scatter=0.05), sensor=sensor, law=None)
    frame = replace(FRAME, peak_dn=2000.0, sigma_px=1e4)
    first, second, other = (model.sample(frame, RandomStreams(*where)) - 10.0 for where in
                            ((1, 0, 0), (1, 7, 5), (2, 0, 0)))  # fmt: skip
    # Read noise of 0.5 DN and rounding: six deviations of it.
    noise = 0.25 + 1 / 12
    np.testing.assert_allclose(first, second, atol=6 * np.sqrt(2 * noise))
    assert abs(stats.pearsonr(first.ravel(), other.ravel()).statistic) < stats.norm.isf(5e-5) / np.sqrt(first.size)
    assert stats.kstest((first / 600 - 1).ravel() / 0.05, "norm").pvalue > 1e-4
    assert first.std() == pytest.approx(30, rel=stats.norm.isf(5e-5) / np.sqrt(2 * first.size))
    expected = model.expected(frame)
    np.testing.assert_allclose(expected.mean, 610, rtol=1e-5)
    # Levels stand in cells of a sixth of a deviation, whose own variance is 1/432 of it.
    np.testing.assert_allclose(expected.variance, 30**2 + noise, rtol=0.003)


def test_more_light_than_a_converter_holds():
    """A peak of 1e30 DN is full scale, and no error."""
    model = model_of(law=replace(LAW, peak_dn=1e30))
    assert sampled(model, 1).min() == 1023 == model.expected(FRAME).mean.max()


# Effects from files.

# What a function at each stage returns in these tests; nothing at a = 0.
BODIES = {
    Stage.EXPOSURE: "exposure_s * (1 + a)",
    Stage.WIDTH: "replace(width, factor=width.factor * (1 + a))",
    Stage.BRIGHTNESS: "peak_dn * (1 + a)",
    Stage.COORDINATES: "(dx * (1 + a), dy / (1 + a))",
    Stage.PROFILE: "half_square * (1 + a / (1 + half_square))",
    Stage.BLUR: "np.array([[-8 * a, 8 * a], [4 * a, 0], [0.5, 0.5]])",
    Stage.ADDED_LIGHT: "light_dn + a * spot.peak_dn / spot.sigma_px",
    Stage.MODULATION: "light_dn * (1 + a * np.cos(frame.pixels.x))",
    Stage.SPECKLE_FIELD: "light_dn * (1 + a * np.cos(frame.pixels.y))",
    Stage.PEDESTAL: "pedestal_dn + a * (50 + frame.pixels.x)",
    Stage.PIXEL_GAIN: "light_dn * (1 + a * np.cos(frame.pixels.x + frame.pixels.y))",
    Stage.CHARGE: "mean_e + a * np.roll(mean_e, 2, axis=1)",
    Stage.SMEAR: "a * np.mean(mean_e, axis=0, keepdims=True)",
    Stage.WELL: "signal_dn - a * np.maximum(signal_dn - 150, 0)",
    Stage.READ_NOISE: "variance_e2 * (1 + a) ** 2",
    Stage.RESPONSE: "signal_dn - a * np.maximum(signal_dn - 0.15 * full_scale_dn, 0)",
    Stage.BLACK_LEVEL: "offset_dn + a * (6 + 0.02 * frame.pixels.x)",
    Stage.ROW_NOISE_AND_HOT_PIXELS: "offset_dn + 0.8 * a * (frame.pixels.y - 9.5)",
    Stage.DIGITAL: "np.where(signal_dn > 60, signal_dn - 9 * a, signal_dn * (1 - 0.15 * a))",
}
FILE = '''"""An effect."""

from dataclasses import replace

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, RandomStep, Scope, Stage, Step, normal_draws


def act({arguments}):
    """Return the result."""
    return {body}


DRAWS = normal_draws("a", lambda deviation: deviation)

EFFECT = Effect(
    name="does_something",
    sentence="something happens",
    parameters=(Parameter("a", "1", 0.0, 1.0),),
    variants={{Only.ONLY: ({step},)}},
    starts=lambda scales: [(0.2,)],
)
'''


def effect_from_file(folder, stage: Stage, step: str, a: float, drawn: bool = False) -> AppliedEffect:
    """Write a file with an effect at a stage and return what is read of it; `drawn`: a is what a step draws."""
    named = [name for name in ("full_scale_dn",) if name in BODIES[stage]]
    last = ["a"] if drawn else ["*", "a"]
    named = ["*", *named] if drawn and named else named
    arguments = ", ".join([stage.value.arguments, *last, *named])
    path = written(folder, "own", FILE.format(arguments=arguments, body=BODIES[stage], step=step))
    effect, _ = read_effect(path)
    return AppliedEffect(effect, Only.ONLY, (a,))


def slow_readings(stage: Stage, act, count: int) -> np.ndarray:
    """Draw frames [frame, row, column] of the contract's chain, slowly, with one function at one stage."""
    rng, x, y, gain = np.random.default_rng(8), FRAME.pixels.x, FRAME.pixels.y, SENSOR.gain_dn_per_e

    def at(here: Stage, *value, frame=FRAME):
        if here is not stage:
            return value if len(value) > 1 else value[0]
        is_of_frame = here.value.arguments.startswith("frame")
        return act(*((frame, *value) if is_of_frame else value))

    exposure_s = at(Stage.EXPOSURE, FRAME.exposure_s)
    width = at(Stage.WIDTH, WidthLaw(lambda t: LAW.p1 * np.log(t) + LAW.p2))

    def share(t: float) -> float:
        return (width.propagation_px(t) / (width.propagation_px(t) + BASELINE.laser_px)) ** 2

    sigma = (width.propagation_px(exposure_s) + BASELINE.laser_px) * width.factor
    peak = at(Stage.BRIGHTNESS, LAW.peak_dn * share(exposure_s) / share(FRAME.longest_s))

    def spot(shift_x: float, shift_y: float) -> np.ndarray:
        path = act(FRAME) if stage is Stage.BLUR else np.array([[0.0], [0.0], [1.0]])
        total = 0.0
        for dx, dy, weight in path.T:
            u, v = at(Stage.COORDINATES, x - FRAME.x0 - shift_x - dx, y - FRAME.y0 - shift_y - dy)
            total = total + weight * peak * np.exp(-at(Stage.PROFILE, (u**2 + v**2) / (2 * sigma**2)))
        return total

    light = spot(0.0, 0.0)
    if stage is Stage.ADDED_LIGHT:
        light = act(FRAME, light, SpotState(peak, sigma))
    light = at(Stage.SPECKLE_FIELD, at(Stage.MODULATION, light)) + at(Stage.PEDESTAL, 0.0)
    mean_e = at(Stage.PIXEL_GAIN, light) / gain + SENSOR.dark_current_e_per_s * exposure_s
    mean_e = at(Stage.CHARGE, mean_e)
    electrons = rng.poisson(mean_e, (count, *mean_e.shape)) + (act(FRAME, mean_e) if stage is Stage.SMEAR else 0.0)
    signal = at(Stage.WELL, gain * electrons)
    signal = signal + gain * np.sqrt(at(Stage.READ_NOISE, SENSOR.read_noise_e**2)) * rng.standard_normal(signal.shape)
    signal = at(Stage.RESPONSE, signal) + SENSOR.black_level_dn
    signal = signal + at(Stage.ROW_NOISE_AND_HOT_PIXELS, at(Stage.BLACK_LEVEL, 0.0))
    return np.clip(np.rint(at(Stage.DIGITAL, signal)), 0, SENSOR.full_scale_dn)


@pytest.mark.parametrize("stage", Stage, ids=lambda stage: stage.title)
def test_an_effect_from_a_file_at_every_stage(stage, tmp_path):
    """`expected` and `sample` of the model with it agree with the contract's chain that has its function at the stage;
    those of the model without it do not. No file but its own is touched."""
    applied_effect = effect_from_file(tmp_path, stage, f"Step(Stage.{stage.name}, act)", 0.35)
    (step,) = applied_effect.effect.variants[Only.ONLY]
    sensor = {"full_scale_dn": SENSOR.full_scale_dn} if "full_scale_dn" in BODIES[stage] else {}
    readings = slow_readings(stage, lambda *arguments: step.function(*arguments, a=0.35, **sensor), 1000)
    model = replace(model_of(), effects=(applied_effect,))
    expected, plain = model.expected(FRAME), model_of().expected(FRAME)
    assert deviations(readings, expected.mean, expected.variance) < 5.5
    assert deviations(sampled(model, 600), expected.mean, expected.variance) < 5.5
    assert deviations(readings, plain.mean, plain.variance) > 15
    assert [path.name for path in tmp_path.iterdir()] == ["own.py"]


# Stages at which a random step has a meaning of its own (`speckle`, `saturation`).
OWN_MEANING = (Stage.SPECKLE_FIELD, Stage.WELL)


@pytest.mark.parametrize(
    "stage", [stage for stage in Stage if stage not in (*OWN_MEANING, *NEVER_RANDOM)], ids=lambda stage: stage.title
)
def test_a_random_effect_from_a_file(stage, tmp_path):
    """Mean and variance are those of frames. A pedestal keeps the light above 0."""
    step = f"RandomStep(Stage.{stage.name}, act, Scope.FRAME, *DRAWS)"
    model = model_of(of("dark_offset", "light", level=60.0))
    plain = model.expected(FRAME)
    model = replace(model, effects=(*model.effects, effect_from_file(tmp_path, stage, step, 0.2, drawn=True)))
    expected, readings = model.expected(FRAME), sampled(model, 800)
    assert deviations(readings, expected.mean, expected.variance) < 5.5
    assert deviations(readings, plain.mean, plain.variance) > 15


@pytest.mark.parametrize("stage", NEVER_RANDOM, ids=lambda stage: stage.title)
def test_a_stage_that_is_never_random(stage, tmp_path):
    """One sentence says so."""
    with pytest.raises(InputError, match=f"a RandomStep cannot act at the stage {stage.title}; make it a Step"):
        effect_from_file(tmp_path, stage, f"RandomStep(Stage.{stage.name}, act, Scope.FRAME, *DRAWS)", 0.2, drawn=True)


@pytest.mark.parametrize("scope", Scope)
def test_a_random_effect_of_each_scope(scope, tmp_path):
    """Which frames share what was drawn: those of one frame's number, of one site, or all of a seed."""
    step = f"RandomStep(Stage.BRIGHTNESS, act, Scope.{scope.name}, *DRAWS)"
    model = model_of(sensor=CLEAN, law=BRIGHT)
    model = replace(model, effects=(effect_from_file(tmp_path, Stage.BRIGHTNESS, step, 0.2, drawn=True),))
    first, *others = (float(model.sample(FRAME, RandomStreams(*where))[9, 11]) for where in
                      ((1, 0, 0), (1, 1, 0), (1, 0, 1), (2, 0, 0)))  # fmt: skip
    # The shot noise is 2e-4 of the light, what is drawn scatters by 0.2 of it.
    shared = [other == pytest.approx(first, rel=2e-3) for other in others]
    assert shared == {Scope.FRAME: [False, True, False], Scope.SITE: [True, False, False],
                      Scope.SENSOR: [True, True, False]}[scope]  # fmt: skip
