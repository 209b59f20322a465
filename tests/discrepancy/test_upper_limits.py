"""Upper limits hold the truth as often as they say, are about as narrow as the Fisher information allows, and explain
themselves; effects that a design cannot show are listed.

A limit holds the truth in at least 95 % of the sets. Fewer than `fewest_covered` sets have it once in 1,000 tests.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy import limits
from spotcheck.discrepancy.findings import UpperLimit
from spotcheck.discrepancy.fluctuations import measure_components
from spotcheck.discrepancy.frames import select_pixels
from spotcheck.discrepancy.limits import find_limits, limit_laws, limit_mean_effects, limit_scatter, list_not_assessed
from spotcheck.discrepancy.mixed_model import Interval
from spotcheck.discrepancy.named_scatter import NamedScatter, deviation_of_fluctuation, name_scatter
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.model.effect import Need, Scope
from spotcheck.model.effects import vocabulary
from spotcheck.model.stage import Stage
from tests.samples import drawn_frames as drawing
from tests.samples import models_of_frames
from tests.samples.drawn_frames import (
    DrawnCamera,
    DrawnFrames,
    DrawnLight,
    draw_frames,
    draw_numbers,
    lay_out,
)
from tests.samples.models_of_frames import (
    BASELINE,
    LONGEST_S,
    apply_effect,
    design_of,
    fit_drawn,
    frame_set,
    search_of,
    starting_spots,
)

EFFECTS = vocabulary()
# One angle and three exposures; numbers of twelve sites.
CONDITIONS, LAW_CONDITIONS = lay_out(angles_deg=(0.0,), repeats=1), lay_out(repeats=3)
# Tables of readings up to 512 DN take half the time of those up to 1024 DN.
PEAK_FACTOR = 0.7
SCALES = replace(models_of_frames.SCALES, peak_dn=PEAK_FACTOR * drawing.PEAK)
# Sets of frames and of numbers for each coverage.
SETS, LAW_SETS = 14, 60
ONE_SIDED, TWO_SIDED = stats.norm.ppf([0.95, 0.975])
# 95 % quantile of the length of a vector of two normal numbers.
OF_VECTOR = stats.rayleigh.ppf(0.95)


def fewest_covered(sets: int) -> int:
    """Return the number of sets with the truth within their limits that is missed once in 1,000 tests."""
    return int(stats.binom.ppf(1e-3, sets, 0.95))


def holds(limit: UpperLimit, truth: float) -> bool:
    """Return whether a strength lies within a limit; an end that is NaN is none."""
    return not (truth < limit.low or truth > limit.high)


# Effects of the mean image


def add_slope(drawn: DrawnFrames, seed: int, slope: float, direction_deg: float) -> DrawnFrames:
    """Return frames with more light that rises by `slope` [DN per 100 px] from 0 at the edge of the sensor."""
    rng, angle = np.random.default_rng([seed, 1]), np.deg2rad(direction_deg)
    readings = []
    for frame, left, top in zip(drawn.readings, drawn.left, drawn.top, strict=True):
        x, y = pixel_places(left, top)
        light = slope * (0.7 * drawing.SENSOR_SIDE + x * np.cos(angle) + y * np.sin(angle)) / 100
        more = drawing.GAIN * rng.poisson(np.maximum(light, 0.0) / drawing.GAIN)
        readings.append(np.clip(np.rint(frame + more), 0, drawing.FULL_SCALE))
    return replace(drawn, readings=np.array(readings))


def pixel_places(left: int, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of a crop from the middle of the sensor [px]."""
    middle = (drawing.SENSOR_SIDE - 1) / 2
    return np.arange(drawing.SIDE)[None] + left - middle, np.arange(drawing.SIDE)[:, None] + top - middle


def draw_with(effect: str, strength: float, seed: int) -> DrawnFrames:
    """Draw frames with an effect of a strength."""
    light, camera = DrawnLight(), DrawnCamera()
    if effect == "nonlinearity":
        camera = DrawnCamera(bend=strength)
    elif effect == "dark_offset":
        light = DrawnLight(pedestal_dn=strength)
    elif effect == "saturation":
        camera = DrawnCamera(clip_dn=strength)
    drawn = draw_frames(seed, CONDITIONS, light, camera, PEAK_FACTOR)
    return add_slope(drawn, seed, strength, 35.0) if effect == "background_gradient" else drawn


# Change of the mean [DN] by a strength of 1, from the light [DN] and the places of the pixels [px]; then what else is
# free with it, and the quantile of its limit.
CHANGES = {
    "nonlinearity": ([lambda light, x, y: light**2 / drawing.FULL_SCALE], TWO_SIDED),
    "dark_offset": ([lambda light, x, y: 1.0], ONE_SIDED),
    "background_gradient": ([lambda light, x, y: x / 100, lambda light, x, y: 1.0], OF_VECTOR),
}


def bound_of(effect: str) -> float:
    """Return the limit that the Fisher information of the fitted pixels allows, by brute force beside the spots."""
    changes, quantile = CHANGES[effect]
    drawn = draw_frames(1, CONDITIONS, peak_factor=PEAK_FACTOR)
    pixels = select_pixels(frame_set(drawn), starting_spots(drawn))
    information = np.zeros((len(changes), len(changes)))
    for f in range(len(drawn.x)):
        x, y = pixels.x[f], pixels.y[f]
        spot = np.array([drawn.peak_dn[f], drawn.sigma_px[f], drawn.x[f], drawn.y[f]])

        def light_of(spot, x=x, y=y):
            return spot[0] * np.exp(-((x - spot[2]) ** 2 + (y - spot[3]) ** 2) / (2 * spot[1] ** 2))

        light, middle = light_of(spot), (drawing.SENSOR_SIDE - 1) / 2
        variance = drawing.GAIN * light + (drawing.GAIN * drawing.READ_NOISE_E) ** 2 + 1 / 12
        root = np.sqrt(pixels.is_used[f] / variance).ravel()
        slopes = np.array([(light_of(spot + step) - light).ravel() / 1e-4 for step in 1e-4 * np.eye(4)]) * root
        columns = np.array([(change(light, x - middle, y - middle) + 0 * light).ravel() for change in changes]) * root
        basis = np.linalg.qr(slopes.T)[0]
        columns -= columns @ basis @ basis.T
        information += columns @ columns.T
    return quantile * float(np.sqrt(np.linalg.inv(information)[0, 0]))


@pytest.mark.parametrize("effect", CHANGES)
def test_limits_of_the_mean_image(effect: str):
    """Without the effect and with half its limit, the limit holds the truth; its median is about the Fisher bound."""
    bound, covered, widths = bound_of(effect), 0, []
    for seed in range(SETS):
        truth = bound / 2 if seed % 2 else 0.0
        limit = limit_mean_effects(fit_drawn(draw_with(effect, truth, 100 + seed)), [EFFECTS[effect]], SCALES)[effect]
        covered += holds(limit, truth)
        if seed % 2 == 0:
            widths.append((limit.high - limit.low) / 2 if np.isfinite(limit.low) else limit.high)
    assert covered >= fewest_covered(SETS)
    # The scatter of the estimate itself adds up to a half on average.
    assert 0.7 * bound < np.median(widths) < 2 * bound


def test_a_clip_is_limited_from_below():
    """The level of a clip lies above the limit, whether the light of at most 490 DN reaches it or not."""
    levels, lows = (np.inf, 500.0, 480.0, np.inf, 485.0, 475.0), []
    for seed, level in enumerate(levels):
        fit = fit_drawn(draw_with("saturation", level, 300 + seed))
        limit = limit_mean_effects(fit, [EFFECTS["saturation"]], SCALES)["saturation"]
        assert np.isnan(limit.high) and limit.frames is None
        assert limit.remark in (limits.SET_BY_LIGHT, limits.ALREADY_PRESENT)
        lows.append(limit.low)
    assert np.sum(np.array(lows) < levels) >= fewest_covered(len(levels))
    assert 450 < np.median(lows) < 490


def test_frames_that_would_halve_a_limit():
    """Four times the frames for a strength that changes the mean linearly, sixteen for a blur, which does by its
    square: three and fifteen times as many more."""
    fit = fit_drawn(draw_frames(5, CONDITIONS, peak_factor=PEAK_FACTOR))
    effects = [EFFECTS["smear"], EFFECTS["motion_blur"]]
    of_effects = limit_mean_effects(fit, effects, SCALES)
    assert of_effects["smear"].frames == 3 * len(CONDITIONS)
    assert of_effects["motion_blur"].frames == pytest.approx(15 * len(CONDITIONS), rel=0.2)


def test_misfit_widens_limits():
    """Beside an effect that is in the frames and not in the model, limits of others say that misfit sets them."""
    drawn = draw_frames(6, CONDITIONS, DrawnLight(ratio=1.1), peak_factor=PEAK_FACTOR)
    limit = limit_mean_effects(fit_drawn(drawn), [EFFECTS["nonlinearity"]], SCALES)["nonlinearity"]
    assert limit.remark == limits.SET_BY_MISFIT and limit.frames is None
    assert holds(limit, 0.0)


# Laws and scatter


def follow_angle(strength: float) -> np.ndarray:
    """Return a factor [frame] on the brightness that follows the fibre angle, brightest at 20°."""
    return 1 + strength * np.cos(2 * (LAW_CONDITIONS.angle - np.deg2rad(20.0)))


def grow_by_power(strength: float) -> np.ndarray:
    """Return a factor [frame] that is a power of the exposure."""
    return (LAW_CONDITIONS.exposure_s / LONGEST_S) ** strength


# Factor on the brightness, a strength of about half the limit, and the regressor of ln peak by the strength.
LAWS = {
    "angle_reflectance": (follow_angle, 0.0018, OF_VECTOR, np.cos(2 * LAW_CONDITIONS.angle)),
    "photon_budget": (grow_by_power, 0.001, TWO_SIDED, np.log(LAW_CONDITIONS.exposure_s)),
}


@pytest.mark.parametrize("name", LAWS)
def test_limits_of_laws(name: str):
    """Brightness that scatters by 0.5 % from frame to frame: limits hold the truth and are near the closed form of a
    straight line in the regressor."""
    factor, strength, quantile, regressor = LAWS[name]
    covered, widths = 0, []
    for seed in range(LAW_SETS):
        truth = strength if seed % 2 else 0.0
        search = search_of(draw_numbers(seed, LAW_CONDITIONS, factor(truth), frame_scatter=0.005))
        limit = limit_laws(search, [], [EFFECTS[name]])[name]
        covered += holds(limit, truth)
        if seed % 2 == 0:
            widths.append((limit.high - limit.low) / 2 if np.isfinite(limit.low) else limit.high)
    assert covered >= fewest_covered(LAW_SETS)
    scatter = np.hypot(0.005, drawing.PEAK_ERROR)
    bound = quantile * scatter / np.sqrt(np.sum((regressor - regressor.mean()) ** 2))
    assert 0.7 * bound < np.median(widths) < 2 * bound


@pytest.mark.parametrize("rms", [0.0, 0.003, 0.006])
def test_limits_of_power_fluctuation(rms: float):
    """The limit holds the truth. Without fluctuation it is what the errors of the numbers allow."""
    effect, highs = EFFECTS["power_fluctuation"], []
    for seed in range(LAW_SETS):
        search = search_of(draw_numbers(seed, LAW_CONDITIONS, frame_scatter=rms))
        deviation = deviation_of_fluctuation(measure_components(search)["frame brightness"])
        (named,) = name_scatter([effect], {(Stage.BRIGHTNESS, Scope.FRAME): deviation}, 0, models_of_frames.SCALES)
        highs.append(limit_scatter(named, len(LAW_CONDITIONS), models_of_frames.SCALES).high)
    assert np.sum(np.array(highs) > rms) >= fewest_covered(LAW_SETS)
    assert np.median(highs) < 2 * max(rms, drawing.PEAK_ERROR)


def test_limits_of_scatter_say_what_would_halve_them():
    """The root of a variance needs 16 times the frames; gains of pixels, which pairs of frames show, 4 times."""
    scatter = [
        (apply_effect("row_noise", rms=0.0), "rms", 15),
        (apply_effect("fixed_pattern", prnu=0.0, hot_pixels=0.0), "prnu", 3),
    ]
    for applied, parameter, more in scatter:
        interval = Interval(0.0, 0.01, 0.0, 0.02)
        limit = limit_scatter(NamedScatter(applied, {parameter: interval}, 0.5, ("z below the least",)), 10, SCALES)
        assert limit.high == 0.02 and limit.frames == 10 * more and limit.reason == limits.NOT_FOUND
    unknown = NamedScatter(applied, {parameter: Interval(0.0, 0.0, 0.0, 0.0)}, 0.0, ())
    assert limit_scatter(unknown, 10, SCALES).reason == limits.NOT_MEASURED


# All effects


def test_every_effect_has_a_limit_or_a_reason():
    """Each effect that is not named is limited or not assessed, and no end is infinite."""
    drawn = draw_frames(8, lay_out(angles_deg=(0.0, 45.0, 90.0), repeats=1), peak_factor=PEAK_FACTOR)
    fit, effects = fit_drawn(drawn), list(EFFECTS.values())
    prepared = SimpleNamespace(scales=SCALES, setting=SimpleNamespace(baseline=BASELINE))
    analysis = SimpleNamespace(prepared=prepared, selected=SimpleNamespace(fit=fit), search=None, named_scatter=(),
                               withdrawn=["nonlinearity"])  # fmt: skip
    out = find_limits(analysis, ["smear"], effects)
    not_assessed = [name for name, _ in list_not_assessed(effects, fit.model.design, BASELINE)]
    assert sorted([*not_assessed, "smear", *(limit.effect for limit in out)]) == sorted(EFFECTS)
    by_name = {limit.effect: limit for limit in out}
    assert by_name["nonlinearity"].reason == limits.NOT_CONFIRMED
    assert by_name["spread_law"].reason == limits.NO_SIZE
    for limit in out:
        assert limit.reason and not np.isinf([limit.low, limit.high]).any() and not limit.low > limit.high
        assert limit.frames is None or limit.frames > 0
    limited = [limit.effect for limit in out if np.isfinite([limit.low, limit.high]).any()]
    assert {"saturation", "nonlinearity", "black_clipping", "dark_offset", "background_gradient", "super_gaussian",
            "scatter_halo", "beam_ellipticity", "motion_blur", "ghost_reflection"} <= set(limited)  # fmt: skip


def test_static_shapes_are_confounded_with_a_free_shape():
    """Beside a free light shape no static shape has a limit."""
    model = replace(fit_drawn(draw_frames(9, CONDITIONS)).model, grid=ShapeGrid())
    for effect in EFFECTS.values():
        if effect.is_static_shape:
            assert limits.explain_missing(effect, model).reason == limits.CONFOUNDED
            assert not limits.is_limited_by_pixels(effect, model)


def test_effects_that_a_design_cannot_show():
    """Two angles fit any amplitude and phase, one exposure no law, and one frame no drift."""
    effects = list(EFFECTS.values())

    def missing(conditions, **changes) -> dict[str, str]:
        return dict(list_not_assessed(effects, replace(design_of(conditions), **changes), BASELINE))

    assert missing(lay_out()) == {}
    two_angles = missing(lay_out(angles_deg=(0.0, 60.0)))
    assert set(two_angles) == {effect.name for effect in effects if Need.ANGLES in effect.needs}
    assert two_angles["angle_reflectance"] == "needs several angles"
    # 0° and 180° are the same fibres.
    assert set(missing(lay_out(angles_deg=(0.0, 60.0, 180.0)))) == set(two_angles)
    one_exposure = missing(lay_out(exposures_s=(9e-4,)))
    needs = {Need.EXPOSURES, Need.THREE_EXPOSURES}
    assert set(one_exposure) == {effect.name for effect in effects if needs & set(effect.needs)}
    assert "laser_drift" in missing(lay_out(), has_order=False)
    lawless = dict(list_not_assessed(effects, design_of(lay_out()), replace(BASELINE, photon_budget="free")))
    assert set(lawless) == {effect.name for effect in effects if Need.LAW in effect.needs}
