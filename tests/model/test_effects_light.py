"""The light of effects: against the dataset contract's words, `slow_light`, and each shape's own closed forms."""

from dataclasses import replace
from math import gamma

import numpy as np
import pytest
from scipy.special import erf

from spotcheck.model.conditions import FrameConditions, PixelGrid
from spotcheck.model.effects import vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from tests.samples.effect_cases import (
    BLUR,
    ELLIPSES,
    EXPOSURES,
    FRAMES,
    FREE,
    FRINGES,
    GHOST,
    HALO,
    LASER,
    LAW,
    LAWS,
    LIGHT,
    LONGEST,
    P1,
    P2,
    PEAK,
    PEDESTALS,
    PROFILES,
    REFERENCE,
    SCATTERED,
    SENSOR,
    SLOW_STAGES,
    added,
    applied,
    blur,
    expected_of,
    free_frame,
    fringes,
    model_light,
    model_of,
    of,
    pedestals,
    pixel_gains,
    slow_light,
    speckle,
    title,
    top_hat,
)

ON_LIGHT = [*LIGHT, *(case for name, case in SCATTERED.items() if name not in ("row_noise", "interference_fringes"))]
every_light = pytest.mark.parametrize("case", ON_LIGHT, ids=title)


@pytest.mark.parametrize("budget", ["linear", "spot_area"])
@pytest.mark.parametrize("cut", [False, True], ids=["", "top hat"])
@every_light
def test_light_of_each_effect(case, cut, budget):
    """Against the contract's words. To rounding of a few hundred products; a path to 2e-7 of the peak (below), and
    to 1 % where it crosses the top hat's rim, whose kink six nodes step over."""
    got, want = model_light([case], budget, cut), slow_light([case], budget, cut)
    tolerance = 1e-11 if case.name != "motion_blur" else 0.01 if cut else 3e-7
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * PEAK)
    # And the effect is at work.
    assert np.abs(got - model_light([], budget, cut)).max() > 1e-3 * PEAK


def combinations(count: int = 24) -> list:
    """Some of everything: every kind of effect by the toss of a coin. One ellipse at a time: two do not commute and
    the contract does not order them; a path with a kink or a cusp in its way is another test."""
    rng = np.random.default_rng(20)
    kinds = [ELLIPSES, PROFILES, [BLUR], HALO, [GHOST], FRINGES, PEDESTALS[:1], PEDESTALS[1:]]
    kinds += [[SCATTERED[name]] for name in ("speckle", "fixed_pattern", "power_fluctuation", "site_variation")]
    laws = [LAWS[:1], LAWS[1:3], LAWS[3:5], LAWS[5:6], LAWS[6:]]
    out = []
    for k in range(count):
        own = [kind[rng.integers(len(kind))] for kind in (*laws, *kinds) if rng.random() < 0.6]
        names = {case.name for case in own}
        cut = bool(rng.random() < 0.5)
        if cut or names & {"super_gaussian", "shutter_offset"}:
            own = [case for case in own if case.name != "motion_blur"]
        out.append(pytest.param(own, cut, ("linear", "spot_area")[k % 2], id=str(k)))
    return out


@pytest.mark.parametrize(("cases", "cut", "budget"), combinations())
def test_light_of_many_effects_at_once(cases, cut, budget):
    """Every stage hands on what the next one needs."""
    got, want = model_light(cases, budget, cut), slow_light(cases, budget, cut)
    tolerance = 1e-5 if any(case.name == "motion_blur" for case in cases) else 1e-11
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * max(want.max(), PEAK))


# Two stages and effects that do not commute.
ORDER = {
    "top hat before blur": ([BLUR], (top_hat, blur)),
    "top hat before the halo": ([HALO[1]], (top_hat, added)),
    "top hat before the ghost": ([of("ghost_reflection", fraction=0.5, dx=8.0, dy=0.0)], (top_hat, added)),
    "the halo is not blurred": ([BLUR, HALO[0]], (blur, added)),
    "fringes on halo and ghost": ([FRINGES[1], HALO[1], GHOST], (added, fringes)),
    "fringes not on pedestals": ([FRINGES[1], PEDESTALS[0]], (fringes, pedestals)),
    "top hat before fringes": ([FRINGES[0]], (top_hat, fringes)),
    "blur before fringes": ([FRINGES[0], BLUR], (blur, fringes)),
    "speckle on halo and ghost": ([SCATTERED["speckle"], HALO[1], GHOST], (added, speckle)),
    "speckle not on pedestals": ([SCATTERED["speckle"], PEDESTALS[0]], (speckle, pedestals)),
    "gains on pedestals": ([SCATTERED["fixed_pattern"], PEDESTALS[0]], (pedestals, pixel_gains)),
}


@pytest.mark.parametrize(("cases", "pair"), ORDER.values(), ids=ORDER)
def test_order_of_the_light(cases, pair):
    """The contract's order agrees to 1 % (a path over the top hat's rim) or better, the swapped one does not."""
    cut = top_hat in pair
    got = model_light(cases, cut=cut)
    right = np.abs(got - slow_light(cases, cut=cut)).max()
    first, second = (SLOW_STAGES.index(stage) for stage in pair)
    swapped = [stage for stage in SLOW_STAGES if stage is not pair[0]]
    swapped.insert(second, pair[0])
    assert first < second
    wrong = np.abs(got - slow_light(cases, cut=cut, stages=swapped)).max()
    assert right < 1e-10 or (BLUR in cases and right < (0.01 if cut else 3e-7) * PEAK)
    assert wrong > 20 * right and wrong > 1e-3 * PEAK


# Each shape's own closed forms.


def light_of(cases, frame: FrameConditions, cut: bool = False) -> np.ndarray:
    """Return the light [row, column] of a frame without a law, pedestals left out."""
    model = ForwardModel(replace(FREE, top_hat=cut), SENSOR, None, applied(cases))
    return np.broadcast_to(model.light(frame).spot, (frame.pixels.y.size, frame.pixels.x.size))


def at(frame: FrameConditions, x, y) -> FrameConditions:
    """Return the frame at points: columns x and rows y [px]."""
    return replace(frame, pixels=PixelGrid(np.reshape(x, (1, -1)), np.reshape(y, (-1, 1)), 240, 240))


@pytest.mark.parametrize("length", [0.3, 1.0, 2.0, 3.0])
def test_motion_blur_against_2000_spots(length):
    """Up to three widths the six nodes leave less than 1e-6 of the peak: their rule's error is
    f⁽¹²⁾(L/2)¹²·1.5e-12/2 with |f⁽¹²⁾| ≤ 10395/σ¹², 1.0e-6 at L = 3σ. The midpoint rule of 2000 spots is off by
    (L/2000)²/24 f'' = 1e-7 at most, the closed form by nothing."""
    frame = free_frame(1.0, 11.0)
    angle = np.deg2rad(28.0)
    got = light_of([of("motion_blur", speed=length * 11.0 / 1e-3, direction=28.0)], frame)
    dx, dy = frame.pixels.x - 120.4, frame.pixels.y - 119.7
    path = length * 11.0 * ((np.arange(2000) + 0.5) / 2000 - 0.5)
    row = 131  # one row of pixels for the dense sum, all of them for the closed form
    x, y = dx[0], dy[row, 0]
    dense = sum(np.exp(-((x - s * np.cos(angle)) ** 2 + (y - s * np.sin(angle)) ** 2) / 242) for s in path) / 2000
    along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    half, root = length / 2, np.sqrt(2)
    rise = erf((along / 11 + half) / root) - erf((along / 11 - half) / root)
    closed = np.exp(-(across**2) / 242) * rise * np.sqrt(np.pi / 2) / length
    np.testing.assert_allclose(dense, closed[row], atol=1.1e-7)
    np.testing.assert_allclose(got[row], dense, atol=1.1e-6 if length == 3 else 3e-7)
    np.testing.assert_allclose(got, closed, atol=1e-6)
    # It takes no light away and keeps the centre.
    assert got.sum() == pytest.approx(2 * np.pi * 121, rel=1e-9)
    assert (got * frame.pixels.x).sum() / got.sum() == pytest.approx(120.4, abs=1e-7)


def test_two_smears_in_a_row():
    """Of a user's vocabulary there may be two: along x and along y they are the product of two closed forms, each of
    which the nodes meet to 1e-6 of the peak; in either order."""
    frame = free_frame(1.0, 11.0)
    along_x, along_y = (
        of("motion_blur", speed=length * 11.0 / 1e-3, direction=angle) for length, angle in ((2, 0), (1, 90))
    )

    def smeared(offset, length):
        rise = erf((offset / 11 + length / 2) / np.sqrt(2)) - erf((offset / 11 - length / 2) / np.sqrt(2))
        return rise * np.sqrt(np.pi / 2) / length

    closed = smeared(frame.pixels.x - 120.4, 2) * smeared(frame.pixels.y - 119.7, 1)
    for cases in ([along_x, along_y], [along_y, along_x]):
        np.testing.assert_allclose(light_of(cases, frame), closed, atol=2e-6)


@pytest.mark.parametrize("ratio", [1.0, 1.5, 4.0])
@pytest.mark.parametrize("direction", [0.0, 35.0, 90.0, 130.0])
def test_ellipses_keep_their_area(ratio, direction):
    """All light, and second moments σ²·ratio along `direction` (from +x towards +y) and σ²/ratio across it."""
    sigma = 9.0
    frame = free_frame(500.0, sigma)
    camera = light_of([of("beam_ellipticity", ratio=ratio, direction=direction)], frame)
    # The fibre axis lies at ±angle + zero; here at 0.5 rad.
    for variant, sense in (("same sense", 1), ("opposite sense", -1)):
        zero = direction - sense * np.rad2deg(0.5)
        fibre = light_of([of("fibre_anisotropy", variant, ratio=ratio, zero=zero)], frame)
        np.testing.assert_allclose(fibre, camera, rtol=1e-9, atol=1e-12)
    # The narrow axis is 4.5 px wide at least: samples sum to the integral to exp(−2π²·20).
    assert camera.sum() == pytest.approx(2 * np.pi * sigma**2 * 500, rel=1e-9)
    dx, dy = frame.pixels.x - 120.4, frame.pixels.y - 119.7
    turn = np.deg2rad(direction)
    along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
    moments = [(camera * v).sum() / camera.sum() for v in (along**2, across**2, along * across)]
    # 240 px end 6.6 widths of the longest ellipse from its centre.
    np.testing.assert_allclose(moments, [sigma**2 * ratio, sigma**2 / ratio, 0.0], rtol=1e-6, atol=1e-6)


def test_two_ellipses_on_one_axis_multiply():
    """And at right angles they undo each other: each direction is the camera's, whatever other ellipse there is."""
    frame = free_frame(500.0, 9.0)
    one = light_of([of("beam_ellipticity", ratio=2.4, direction=30.0)], frame)
    zero = 30.0 - np.rad2deg(0.5)
    camera = of("beam_ellipticity", ratio=1.6, direction=30.0)
    fibre = of("fibre_anisotropy", "same sense", ratio=1.5, zero=zero)
    np.testing.assert_allclose(light_of([camera, fibre], frame), one, rtol=1e-9, atol=1e-12)
    across = fibre.changed(ratio=1.6, zero=zero + 90.0)
    np.testing.assert_allclose(light_of([camera, across], frame), light_of([], frame), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n", [0.3, 0.7, 1.0, 2.0, 5.0])
def test_super_gaussian_flanks(n):
    """exp(−(ρ²/2)^n): 1/e at ρ = √2 for every n, the peak at the centre, and n times the slope of a Gaussian there."""
    out = np.array([0.0, 1e-3, 200**0.5, 200**0.5 - 0.01, 200**0.5 + 0.01, 25.0])
    frame = free_frame(100.0, 10.0)
    got = light_of([of("super_gaussian", n=n)], at(frame, frame.x0 + out, frame.y0))[0]
    # ρ²/2 is kept above 1e-12: at n = 0.3 the very centre reads 2.5e-4 low, at n = 0.5 already 1e-6.
    assert got[0] == pytest.approx(100.0, rel=2 * 1e-12**n)
    np.testing.assert_allclose(got[1:], 100 * np.exp(-((out[1:] ** 2 / 200) ** n)), rtol=1e-8)
    assert got[2] == pytest.approx(100 / np.e, rel=1e-9)
    # d ln I/dρ at ρ = √2 is −n √2, where a Gaussian's is −√2; a difference over 0.002 adds 1e-6 n² of it.
    assert np.log(got[4] / got[3]) / 0.002 == pytest.approx(-n * np.sqrt(2), rel=1e-5)


def test_super_gaussian_holds_its_light():
    """∫ exp(−(ρ²/2)^n) 2πρ dρ = 2πσ² Γ(1 + 1/n)."""
    for n in (0.8, 1.0, 1.6, 3.0):
        got = light_of([of("super_gaussian", n=n)], free_frame(3.0, 10.0)).sum()
        # The flank of n = 3 is 2 px wide: samples sum to the integral to 1e-5.
        assert got == pytest.approx(3 * 2 * np.pi * 100 * gamma(1 + 1 / n), rel=2e-5)


@pytest.mark.parametrize("case", HALO, ids=title)
def test_halo_profile(case):
    """`fraction` of A at the spot's centre in every variant; the light at one radius, and the whole halo's sum."""
    frame, fraction, radius = free_frame(800.0, 10.0), case.values["fraction"], 12.0
    case = case.changed(radius=radius)
    points = at(frame, frame.x0 + np.array([0.0, radius]), frame.y0)
    halo = light_of([case], points)[0] - light_of([], points)[0]
    tail = case.values.get("tail", 0.0)
    there = {"exponential": np.exp(-1), "gaussian": np.exp(-0.5), "power": 2**-tail}[case.variant]
    np.testing.assert_allclose(halo, 800 * fraction * np.array([1.0, there]), rtol=1e-10)
    # Integrals over the plane: 2πa², 2πa², πa²/(tail − 1) less what lies beyond the crop.
    total = (light_of([case], frame) - light_of([], frame)).sum() / (800 * fraction * np.pi * radius**2)
    if case.variant == "power":
        # Within a disc of 119 px, by the closed form; the square's corners are the rest.
        disc = (1 - (1 + (119 / radius) ** 2) ** (1 - tail)) / (tail - 1)
        assert disc < total < 1 / (tail - 1)
    else:
        assert total == pytest.approx(2.0, rel=2e-3 if case.variant == "exponential" else 1e-9)


def test_ghost_copies_what_is_there():
    """A copy of the blurred, cut spot; dx to the right, dy downwards, whole pixels tell it exactly."""
    frame, ghost = free_frame(600.0, 12.0), of("ghost_reflection", fraction=0.3, dx=40.0, dy=-25.0)
    for cases in ([], [of("motion_blur", speed=15e3, direction=15.0)], [of("super_gaussian", n=1.4)]):
        plain = light_of(cases, frame, cut=True)
        got = light_of([*cases, ghost], frame, cut=True)
        np.testing.assert_allclose((got - plain)[:-25, 40:], 0.3 * plain[25:, :-40], atol=1e-9)


def test_fringes_are_stripes():
    """Constant along the stripes, one period across them; the phase stays with the sensor or with the spot."""
    frame, x, y = free_frame(1.0, 1e6), 50.0, 70.0
    period, direction = 13.0, 40.0
    cos, sin = np.cos(np.deg2rad(direction)), np.sin(np.deg2rad(direction))

    def factor(variant, x, y, **changes):
        case = of("interference_fringes", variant, d=0.5, period=period, direction=direction, phase=25.0)
        return float(light_of([case], replace(at(frame, x, y), **changes))[0, 0])

    for variant in ("sensor", "spot"):
        here = factor(variant, x, y)
        assert factor(variant, x - 7 * sin, y + 7 * cos) == pytest.approx(here, abs=1e-8)
        assert factor(variant, x + period * cos, y + period * sin) == pytest.approx(here, abs=1e-8)
        assert factor(variant, x + period / 2 * cos, y + period / 2 * sin) - 1 == pytest.approx(1 - here, abs=1e-8)
    moved = {"x0": frame.x0 + 3.0, "y0": frame.y0 - 1.0}
    assert factor("sensor", x, y, **moved) == pytest.approx(factor("sensor", x, y), abs=1e-8)
    assert factor("spot", x + 3.0, y - 1.0, **moved) == pytest.approx(factor("spot", x, y), abs=1e-8)
    assert factor("sensor", 0.0, 0.0) == pytest.approx(1 + 0.5 * np.cos(np.deg2rad(25)), abs=1e-7)


def test_a_gradient_rises_uphill_and_is_never_negative():
    """`level` at the frame's centre, `slope` more at 100 px towards `direction`; where that would be negative, 0."""

    def pedestal(frame, **values):
        model = ForwardModel(FREE, SENSOR, None, applied([of("background_gradient", "light", **values)]))
        return np.broadcast_to(model.light(frame).pedestal, (frame.pixels.y.size, frame.pixels.x.size))

    frame = free_frame(0.0, 10.0)
    points = at(frame, 119.5, [119.5, 219.5, 44.6, 44.4, 0.0])
    got = pedestal(points, level=6.0, slope=8.0, direction=90.0)[:, 0]
    np.testing.assert_allclose(got, [6.0, 14.0, 6 - 8 * 0.749, 0.0, 0.0], atol=1e-12)
    for direction in np.arange(0.0, 360.0, 30.0):
        got = pedestal(frame, level=1.0, slope=300.0, direction=direction)
        assert got.min() == 0.0 and got.max() > 100
        row, column = np.unravel_index(np.argmax(got), got.shape)
        uphill = np.deg2rad(direction)
        assert (column - 119.5) * np.cos(uphill) + (row - 119.5) * np.sin(uphill) > 100


# The laws of width and brightness.


def states(cases, budget="spot_area", law=LAW, frames=FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """Return peak [DN] and σ_g [px] of frames."""
    model = replace(model_of(cases, budget), law=law)
    spots = [model.spot(frame) for frame in frames]
    return np.array([spot.peak_dn for spot in spots]), np.array([spot.sigma_px for spot in spots])


def test_spread_law_replaces_p1():
    """Two numbers give the widths: p_b = p_ref (t/t_ref)^exponent, with p_ref the baseline's at the geometric mean; p1
    then only moves p_ref, and the peak follows the new spread."""
    assert vocabulary()["spread_law"].replaces == ("p1",)
    peak, sigma = states([of("spread_law", exponent=0.4)])
    p_ref = P1 * np.log(REFERENCE) + P2
    spread = p_ref * (np.array(EXPOSURES * 2) / REFERENCE) ** 0.4
    np.testing.assert_allclose(sigma, spread + LASER, rtol=1e-12)
    ratio = spread / sigma
    np.testing.assert_allclose(peak, PEAK * (ratio / ratio[2]) ** 2, rtol=1e-12)
    # Without p1 the same widths come from p2 alone.
    again = states([of("spread_law", exponent=0.4)], law=ExposureLaw(0.0, p_ref, PEAK))
    np.testing.assert_allclose(again, (peak, sigma), rtol=1e-12)
    # A power of exponent p1/p_ref has the logarithm's slope at the reference: what is left is (p1 ln t/t_ref)²/2 p_ref,
    # and a third of its share of p_ref more at the ends, ±ln 3.
    near = states([of("spread_law", exponent=P1 / p_ref)])[1] - states([])[1]
    np.testing.assert_allclose(
        near[[0, 1, 2]], (P1 * np.log(3)) ** 2 / (2 * p_ref) * np.array([1, 0, 1]), rtol=0.07, atol=1e-12
    )


@pytest.mark.parametrize("budget", ["spot_area", "linear"])
def test_shutter_offset_acts_on_the_width_and_on_the_light(budget):
    """As if frames had been taken at nominal + offset; the peak is told relative to the nominal longest exposure."""
    shutter = of("shutter_offset", offset=4e-5)
    peak, sigma = states([shutter], budget)
    true = np.array(EXPOSURES * 2) + 4e-5
    np.testing.assert_allclose(sigma, P1 * np.log(true) + P2 + LASER, rtol=1e-12)
    np.testing.assert_allclose(peak, PEAK * model_of([], budget).baseline.relative_peak(true, P1, P2), rtol=1e-12)
    # Under the power law as well.
    both = states([shutter, of("spread_law", exponent=0.4)], budget)[1]
    np.testing.assert_allclose(both, (P1 * np.log(REFERENCE) + P2) * (true / REFERENCE) ** 0.4 + LASER, rtol=1e-12)


def test_the_true_exposure_is_what_the_whole_frame_sees():
    """The true exposure is the nominal one plus a constant: dark current gathers and the spot moves during it too."""
    shutter, moving = of("shutter_offset", offset=5e-5), of("motion_blur", speed=1e5, direction=150.0)
    sensor = replace(SENSOR, dark_current_e_per_s=1e6)
    frames = [free_frame(PEAK, 15.0, exposure_s=exposure) for exposure in EXPOSURES]
    far = [at(frame, [1e5], [1e5]) for frame in frames]
    nominal, true = (expected_of(cases, sensor, far, "free")[0, :, 0, 0] for cases in ([], [shutter]))
    # Between its nodes the table is off by 1e-4 of the noise of 1.8 DN.
    np.testing.assert_allclose(true - nominal, SENSOR.gain_dn_per_e * 1e6 * 5e-5, atol=4e-4)
    for frame in frames:
        longer = replace(frame, exposure_s=frame.exposure_s + 5e-5)
        np.testing.assert_allclose(light_of([shutter, moving], frame), light_of([moving], longer), atol=1e-9 * PEAK)


def test_brightness_laws():
    """Photon budget 1 at the longest exposure; reflectance of period 180°, mean 1; drift from 0 to the total."""

    def factor(case, frames=FRAMES):
        return states([case], frames=frames)[0] / states([], frames=frames)[0]

    for q in (-0.7, 0.5):
        ratio = factor(of("photon_budget", q=q))
        np.testing.assert_allclose(ratio, np.array(EXPOSURES * 2) ** q / LONGEST**q, rtol=1e-12)
        assert ratio[2] == pytest.approx(1, rel=1e-14)
    places = np.arange(6) / 5
    np.testing.assert_allclose(factor(of("laser_drift", total=0.3)), 1 + 0.3 * places, rtol=1e-12)
    settling = of("laser_drift", "settling", total=0.3, rate=2.5)
    np.testing.assert_allclose(factor(settling), 1 + 0.3 * (1 - np.exp(-2.5 * places)) / (1 - np.exp(-2.5)))
    # By equal factors, and as straight as a rate of 0 says.
    np.testing.assert_allclose(factor(settling.changed(rate=-np.log(1.3))), 1.3**places, rtol=1e-12)
    np.testing.assert_allclose(factor(settling.changed(rate=0.0)), 1 + 0.3 * places, rtol=1e-6)
    turned = [replace(FRAMES[0], angle=np.deg2rad(angle)) for angle in (*np.arange(0.0, 360.0, 15.0), 28.0, 118.0)]
    ratio = factor(of("angle_reflectance", d=0.3, gamma0=28.0), turned)
    assert ratio[:24].mean() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(ratio[:12], ratio[12:24], rtol=1e-12)
    np.testing.assert_allclose(ratio[24:], [1.3, 0.7], rtol=1e-14)


def test_brightness_acts_on_halo_and_ghost_but_not_on_pedestals():
    """It is the light that changes, not the room's."""
    cases = [HALO[1], GHOST, PEDESTALS[0]]
    dimmed = model_light([*cases, of("laser_drift", total=-0.9)])
    factor = (1 - 0.9 * np.arange(6) / 5)[:, None, None]
    np.testing.assert_allclose(dimmed - 17.0, factor * (model_light(cases) - 17.0), rtol=1e-10)
