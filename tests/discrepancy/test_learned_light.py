"""A learned light against closed forms of its power, orders and axes, and against noise of known size."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import integrate, ndimage, optimize, special

from spotcheck.discrepancy.candidates import Candidate, is_unresolved_shape
from spotcheck.discrepancy.evidence import estimate_covariance
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, select_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.learned_light import DRAWS, describe_light, draw_by_information, summarize_shape
from spotcheck.discrepancy.light_shape import fit_free_shape
from spotcheck.discrepancy.normal_equations import NormalEquations, ShapePart, assemble
from spotcheck.discrepancy.shape_grid import BlockFactor, ShapeGrid
from spotcheck.discrepancy.shape_sums import NEIGHBOURS
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light_shape import LightShape
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import DrawnCamera, DrawnLight
from tests.samples.models_of_frames import BASELINE, SENSOR, apply_effect, design_of, frame_set, starting_model

GRID = ShapeGrid()
NODES = GRID.step * (np.arange(GRID.nodes) - (GRID.nodes - 1) / 2)
U, V = NODES[None, :], NODES[:, None]
RHO2, PHI = U * U + V * V, np.arctan2(V, U)
GAUSSIAN = np.exp(-RHO2 / 2)
# Standard deviation of a coefficient [peak] at which noise hardly matters.
QUIET = 1e-6
# Width of the spot [px].
SIGMA = 10.0
# ½ ∫|cos mφ| dφ ∫ρ⁴ exp(−ρ²) dρ over 2π: the power of lobes of size 1.
LOBE_POWER = 0.5 * 4 * 3 * np.sqrt(np.pi) / 8 / (2 * np.pi)


@cache
def factor_of(noise: float, grid: ShapeGrid = GRID) -> BlockFactor:
    """Factor of an information that gives every coefficient the same independent noise [peak]."""
    band = np.zeros(((NEIGHBOURS + 1) * (2 * NEIGHBOURS + 1), grid.nodes**2))
    band[NEIGHBOURS] = 1 / noise**2
    return BlockFactor(grid, band, 0.0)


def fit_of(whole: np.ndarray, noise: float = QUIET, *, top_hat: bool = False, reach: float = 7.0) -> JointFit:
    """A fit that found a whole light of these values at the nodes, on pixels up to `reach` [σ] on each side."""
    declared = np.minimum(GAUSSIAN, np.exp(-0.25)) if top_hat else GAUSSIAN
    # Coefficients of the spline through values at the nodes.
    coefficients = ndimage.spline_filter(whole - declared, order=3, mode="mirror")
    return learned_fit(coefficients, noise, top_hat=top_hat, reach=reach)


def learned_fit(
    coefficients: np.ndarray, noise: float = QUIET, *, top_hat: bool = False, reach: float = 7.0
) -> JointFit:
    """A fit of one frame that found these coefficients, with independent noise of each."""
    learned = LightShape(GRID.step, coefficients)
    forward = ForwardModel(replace(BASELINE, photon_budget="free", top_hat=top_hat, learned=learned), SENSOR)
    design = design_of(drawing.lay_out((1e-3,), (0.0,), 1))
    one, half = np.ones(1), round(reach * SIGMA)
    spots = FrameParameters(0 * one, np.log(SIGMA) * one, half * one, half * one)
    side = 2 * half + 1
    frames = FrameSet(np.zeros((1, side, side)), np.zeros(1, int), np.zeros(1, int), design, side, side)
    model, pixels = JointModel(forward, spots, design, (), GRID), select_pixels(frames, spots)
    nothing = np.zeros((GRID.nodes**2, 4))
    shape = ShapePart(factor_of(noise), nothing, np.zeros((4, 4)), nothing[:, :0], np.zeros(GRID.nodes**2))
    equations = NormalEquations(np.eye(4), np.zeros(4), np.ones(4), 0.0, 1.0, 1, shape)
    return JointFit(model, pixels, equations, True, 1)


def ellipse(major: float, minor: float, direction_deg: float) -> np.ndarray:
    """A Gaussian of two widths [σ]."""
    cos, sin = np.cos(np.deg2rad(direction_deg)), np.sin(np.deg2rad(direction_deg))
    return np.exp(-((U * cos + V * sin) ** 2) / (2 * major**2) - (V * cos - U * sin) ** 2 / (2 * minor**2))


def lobes(size: float, order: int = 4) -> np.ndarray:
    """A Gaussian with lobes around it."""
    return GAUSSIAN + size * RHO2**1.5 * np.cos(order * PHI) * np.exp(-RHO2)


def test_an_ellipse():
    """Widths 1 ± e have the power 2e/π to first order: ½ ∫|e ρ² cos 2φ| B over ∫B."""
    light = describe_light(fit_of(ellipse(1.02, 0.98, 30.0)))
    assert light.major / light.minor == pytest.approx(1.02 / 0.98, abs=1e-4)
    assert light.major * light.minor == pytest.approx(1.0, abs=2e-3)
    assert light.direction_deg == pytest.approx(30.0, abs=0.1)
    assert light.power == pytest.approx(0.04 / np.pi, rel=0.01)
    assert light.orders[2] > 0.999 and len(light.orders) == 9
    assert light.lowest == pytest.approx(0.0, abs=1e-5)
    assert light.words == (
        "1.3 % of its power lies elsewhere, most of it in a spot that is 1.04 times as long as wide, along 30°"
    )


def test_flanks():
    """A super-Gaussian against quadrature along the radius, and its second moment by the gamma function."""
    n = 1.5
    light = describe_light(fit_of(np.exp(-((RHO2 / 2) ** n))))
    rho = np.linspace(0, 8, 16001)
    whole = np.exp(-((rho * rho / 2) ** n))

    def remainder(values):
        return whole - values[0] * np.exp(-((rho / values[1]) ** 2) / 2)

    def square(values):
        return integrate.simpson(remainder(values) ** 2 * rho, x=rho)

    best = optimize.minimize(square, (1.0, 1.0), tol=1e-12).x
    total = integrate.simpson(whole * rho, x=rho)
    assert light.power == pytest.approx(integrate.simpson(np.abs(remainder(best)) * rho, x=rho) / total / 2, rel=5e-3)
    width = np.sqrt(special.gamma(2 / n) / special.gamma(1 / n)) / best[1]
    assert (light.major, light.minor) == pytest.approx((width, width), abs=2e-3)
    assert light.orders[0] > 0.999 and light.words.endswith("most of it in rings about the centre")


@pytest.mark.parametrize(("order", "words"), [(3, "three"), (4, "four"), (8, "eight")])
def test_lobes(order, words):
    light = describe_light(fit_of(lobes(0.1, order)))
    assert light.orders[order] > 0.99 and sum(light.orders) == pytest.approx(1.0, abs=0.01)
    assert light.power == pytest.approx(0.1 * LOBE_POWER, rel=0.01)
    assert light.words.endswith(f"of its power lies elsewhere, most of it in {words} lobes")


def test_other_patterns():
    """Three patterns of equal power are none; of a one-sided one the gauge takes a part."""
    mixed = lobes(0.05, 3) + lobes(0.05, 5) + lobes(0.05, 6) - 2 * GAUSSIAN
    assert describe_light(fit_of(mixed)).words.endswith("in no simple pattern")
    assert describe_light(fit_of(lobes(0.1, 1))).words.endswith("most of it on one side")


def test_what_the_frames_share_is_no_difference():
    """A brighter, wider and displaced Gaussian is the declared shape."""
    moved = 1.1 * np.exp(-((U - 0.1) ** 2 + (V + 0.05) ** 2) / (2 * 1.08**2))
    light = describe_light(fit_of(moved))
    assert abs(light.power) < 1e-4 and not any(light.orders)
    assert (light.major, light.minor) == pytest.approx((1.0, 1.0), abs=2e-3)
    assert light.words.startswith("less than 0.0")


def test_the_declared_shape_may_be_any():
    """A declared top hat, and a profile that the instrument names."""
    top_hat = describe_light(fit_of(np.minimum(GAUSSIAN, np.exp(-0.25)), top_hat=True))
    assert abs(top_hat.power) < 1e-5 and top_hat.major == pytest.approx(1.0, abs=1e-3)
    fit = fit_of(lobes(0.1))
    assert abs(describe_light(fit, declared=fit.model.forward.baseline).power) < 1e-5


def test_places_without_pixels_do_not_count():
    """A bump 4 σ from the centre, of 1 % of the light, half of which counts, on and off the pixels."""
    bump = 0.0625 * np.exp(-((U - 4) ** 2 + V * V) / (2 * 0.4**2))
    near, far = (describe_light(fit_of(GAUSSIAN + bump, reach=reach)) for reach in (7.0, 2.5))
    assert near.power == pytest.approx(0.005, rel=0.03)
    assert abs(far.power) < 1e-5 and far.major == pytest.approx(1.0, abs=1e-3)


def test_the_least_value():
    dip = 0.05 * np.exp(-((U - 3) ** 2 + V * V) / (2 * 0.4**2))
    assert describe_light(fit_of(GAUSSIAN - dip)).lowest == pytest.approx((GAUSSIAN - dip).min(), abs=3e-3)


def noisy_lights(size: float, count: int, noise: float = 0.01) -> list:
    """Lights with lobes of a size and independent noise of each coefficient, drawn anew."""
    exact = ndimage.spline_filter(lobes(size) - GAUSSIAN, order=3, mode="mirror")
    rng = np.random.default_rng(7)
    return [
        describe_light(learned_fit(exact + noise * rng.standard_normal(exact.shape), noise), seed=k)
        for k in range(count)
    ]


def test_noise_is_no_difference():
    """The absolute noise is some 10 standard errors, none of which is left. z scatters by less than 1, since a part of
    the noise is in the error: 12 draws beyond 3 on either side have a probability below 3 %, and the seed is fixed."""
    lights = noisy_lights(0.0, 12)
    z = np.array([light.power / light.stderr for light in lights])
    assert np.abs(z).max() < 3.0 and np.abs(z.mean()) < 1.0
    assert not any(any(light.orders) for light in lights)
    assert all(light.words.startswith("less than ") for light in lights)


@pytest.mark.parametrize("size", [0.2, 1.0])
def test_the_power_has_no_bias_in_noise(size):
    """Lobes of 2 and 11 % of the light under noise of about 5 %: all of 8 within three standard errors (false alarms
    2 %, fixed seed)."""
    lights = noisy_lights(size, 8)
    z = np.array([(light.power - size * LOBE_POWER) / light.stderr for light in lights])
    assert np.abs(z).max() < 3.0
    assert all(np.argmax(light.orders) == 4 for light in lights)


def test_noise_of_other_unknowns_is_in_that_of_the_shape():
    """One unknown that is nearly the same as a pattern of the shape: its variance is 10 times that with the other one
    fixed, by the inverse of the joint information."""
    grid = ShapeGrid(0.8)
    count = grid.nodes**2
    pattern = np.random.default_rng(1).standard_normal(count)
    pattern /= np.linalg.norm(pattern)
    # Joint information of shape and one unknown; the unknown's beside the shape is 1 − 0.9.
    joint = np.eye(count + 1)
    joint[:count, count] = joint[count, :count] = np.sqrt(0.9) * pattern
    variance = pattern @ np.linalg.inv(joint)[:count, :count] @ pattern
    assert variance == pytest.approx(10.0)
    plain = fit_of(GAUSSIAN)
    model = replace(plain.model, grid=grid).with_coefficients(np.zeros(count))
    cross = (np.sqrt(0.9) * pattern)[:, None]
    shape = ShapePart(factor_of(1.0, grid), cross[:, :0], np.zeros((0, 0)), cross, np.zeros(count))
    equations = NormalEquations(np.array([[0.1]]), np.zeros(1), np.ones(1), 0.0, 1.0, 0, shape)
    fit = replace(plain, model=model, equations=equations)
    draws = draw_by_information(fit, np.random.default_rng(2))
    # χ² of 64 draws: 1/2 and 3/2 times the variance are 2.8 standard deviations off, 0.5 %, with a fixed seed.
    assert 0.5 < np.mean((pattern @ draws) ** 2) / variance < 1.5
    beside = draws - np.outer(pattern, pattern @ draws)
    assert np.sum(beside**2) / DRAWS == pytest.approx(count - 1, rel=0.05)


def test_frames_that_share_speckle():
    """From readings: an ellipse with a field of contrast 5 % at each of 8 sites, whose noise is three times that of the
    photons. Within three standard errors of the closed form (false alarms 0.3 %, fixed seed)."""
    drawn = drawing.draw_frames(3, drawing.lay_out(), DrawnLight(ratio=1.04, direction_deg=30.0, speckle_contrast=0.05))
    model = starting_model(drawn)
    declared = fit_jointly(model, select_pixels(frame_set(drawn), model.spots))
    light = describe_light(fit_free_shape(declared))
    assert abs(light.power - np.log(1.04) / np.pi) < 3 * light.stderr < light.power
    assert "times as long as wide, along" in light.words
    assert light.direction_deg == pytest.approx(30.0, abs=10.0)


def test_a_shape_is_held_where_it_would_fall_below_zero():
    """The black level lies 4 DN below the stated one: the light would end at −0.006 of the peak. The fit converges with
    part of its blocks at the least light."""
    drawn = drawing.draw_frames(5, drawing.lay_out(), camera=DrawnCamera(black_dn=drawing.BLACK - 4.0))
    model = starting_model(drawn)
    fit = fit_free_shape(fit_jointly(model, select_pixels(frame_set(drawn), model.spots)))
    fit = fit if fit.has_converged else fit_jointly(fit.model, fit.pixels)
    assert fit.has_converged
    light, least = fit.model.mean_light(), fit.model.least_light
    held = light < 0.99 * least
    assert light.min() > 1.001 * least and 10 < held.sum() < held.size / 2
    raised = fit.model.with_coefficients(fit.model.coefficients + 1e-4 * GRID.spread_blocks(held))
    assert assemble(raised, fit.pixels).deviance > fit.deviance


def test_a_pedestal_beside_a_free_shape_of_weak_spots():
    """Spots of 140 DN: a shape whose noise could not go below 0 would take light from the pedestal. The mean error of
    four sets is within three standard errors (false alarms 0.3 %, fixed seeds)."""
    errors = []
    for seed in range(20, 24):
        drawn = drawing.draw_frames(seed, drawing.lay_out(), DrawnLight(pedestal_dn=0.6), peak_factor=0.2)
        model = starting_model(drawn, apply_effect("dark_offset", "light", level=0.6)).with_free_shape(GRID)
        fit = fit_jointly(model, select_pixels(frame_set(drawn), model.spots))
        assert fit.has_converged
        error = fit.model.effect_named("dark_offset").parameters["level"] - 0.6
        errors.append(error / np.sqrt(estimate_covariance(fit)[-1, -1]))
    assert abs(np.mean(errors)) < 3 / np.sqrt(len(errors))


@pytest.mark.parametrize(("exposures_s", "is_unresolved"), [((9e-4,), True), (drawing.EXPOSURES_S, False)])
def test_stripes_of_one_width_are_part_of_the_shape(exposures_s: tuple[float, ...], is_unresolved: bool):
    """Stripes that move with the spot are the same in all frames of one exposure, in units of the spot; over widths of
    5.6 to 7.2 px stripes of 3 px are not. The nodes are taken to leave half of their information."""
    drawn = drawing.draw_frames(7, drawing.lay_out(exposures_s))
    model = starting_model(drawn).with_free_shape(GRID)
    fit = replace(fit_of(GAUSSIAN), model=model, pixels=select_pixels(frame_set(drawn), model.spots))
    stripes = apply_effect("interference_fringes", "spot", d=0.02, period=3.0, direction=20.0, phase=0.0)
    candidate = Candidate(stripes, score=500.0, place=0, share=0.5, field_share=0.0)
    assert is_unresolved_shape(fit, candidate) == is_unresolved
    assert is_unresolved_shape(fit, replace(candidate, share=1e-6)) is False


def test_attributes_of_the_file():
    light = describe_light(fit_of(lobes(0.1)))
    attributes = summarize_shape(light)
    assert attributes["described"] == light.words and attributes["power"] == light.power
    assert attributes["orders"][4] == light.orders[4] and attributes["direction_deg"] == light.direction_deg
