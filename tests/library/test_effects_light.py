"""The light of effects: against the dataset contract's words, `slow_light`, and each shape's own closed forms."""

from math import gamma

import numpy as np
import pytest
from scipy.special import erf

from spotcheck.model import chain
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.effects import vocabulary
from tests.library.effect_cases import (
    BLUR,
    ELLIPSES,
    EXPOSURES,
    FRINGES,
    GHOST,
    HALO,
    LASER,
    LAWS,
    LONGEST,
    P1,
    P2,
    PEAK,
    PEDESTALS,
    PLAIN,
    PROFILES,
    REFERENCE,
    SENSOR,
    SINGLE,
    STAGES,
    VIEW,
    added,
    all_moments,
    blur,
    fast_light,
    free,
    fringes,
    of,
    pedestals,
    present,
    slow_light,
    title,
    top_hat,
)

every_light = pytest.mark.parametrize("case", SINGLE, ids=title)


@pytest.mark.parametrize("budget", ["linear", "spot_area"])
@pytest.mark.parametrize("cut", [False, True], ids=["", "top hat"])
@every_light
def test_light_of_each_effect(case, cut, budget):
    """Against the contract's words. To rounding of a few hundred products; a path to 2e-7 of the peak (below), and
    to 1 % where it crosses the top hat's rim, whose kink six nodes step over."""
    got, want = fast_light([case], budget, cut), slow_light([case], budget, cut)
    tolerance = 1e-11 if case.name != "motion_blur" else 0.01 if cut else 3e-7
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * PEAK)
    # And the effect is at work.
    assert np.abs(got - fast_light([], budget, cut)).max() > 1e-3 * PEAK


def combinations(count: int = 24) -> list:
    """Some of everything: every kind of effect by the toss of a coin. One ellipse at a time: two do not commute and
    the contract does not order them; a path with a kink or a cusp in its way is another test."""
    rng = np.random.default_rng(20)
    kinds = [ELLIPSES, PROFILES, [BLUR], HALO, [GHOST], FRINGES, PEDESTALS[:1], PEDESTALS[1:]]
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
    got, want = fast_light(cases, budget, cut), slow_light(cases, budget, cut)
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
}


@pytest.mark.parametrize(("cases", "pair"), ORDER.values(), ids=ORDER)
def test_order_of_the_light(cases, pair):
    """The contract's order agrees to 1 % (a path over the top hat's rim) or better, the swapped one does not."""
    cut = top_hat in pair
    got = fast_light(cases, cut=cut)
    right = np.abs(got - slow_light(cases, cut=cut)).max()
    first, second = (STAGES.index(stage) for stage in pair)
    swapped = list(STAGES)
    swapped[first], swapped[second] = swapped[second], swapped[first]
    if second - first == 2:
        # The one between moves along with the first.
        swapped = [*STAGES[:first], *STAGES[first + 1 : second + 1], STAGES[first], *STAGES[second + 1 :]]
    wrong = np.abs(got - slow_light(cases, cut=cut, stages=swapped)).max()
    assert right < 1e-10 or (BLUR in cases and right < (0.01 if cut else 3e-7) * PEAK)
    assert wrong > 20 * right and wrong > 1e-3 * PEAK


# Each shape's own closed forms.


def light_of(cases, view: View, base: Free) -> np.ndarray:
    """Light [row, column] of one view, pedestals apart left out."""
    return np.broadcast_to(chain.light(view, PLAIN, base, present(cases))[0], (1, view.y.size, view.x.size))[0]


@pytest.mark.parametrize("length", [0.3, 1.0, 2.0, 3.0])
def test_motion_blur_against_2000_spots(length):
    """Up to three widths the six nodes leave less than 1e-6 of the peak: their rule's error is
    f⁽¹²⁾(L/2)¹²·1.5e-12/2 with |f⁽¹²⁾| ≤ 10395/σ¹², 1.0e-6 at L = 3σ. The midpoint rule of 2000 spots is off by
    (L/2000)²/24 f'' = 1e-7 at most, the closed form by nothing."""
    view, base = free(1.0, 11.0)
    angle = np.deg2rad(28.0)
    got = light_of([of("motion_blur", speed=length * 11.0 / 1e-3, direction=28.0)], view, base)
    dx, dy = view.x[0] - 120.4, view.y[0] - 119.7
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
    assert (got * view.x[0]).sum() / got.sum() == pytest.approx(120.4, abs=1e-7)


def test_two_smears_in_a_row():
    """Of a user's vocabulary there may be two: along x and along y they are the product of two closed forms, each of
    which the nodes meet to 1e-6 of the peak; in either order."""
    view, base = free(1.0, 11.0)
    along_x, along_y = (
        of("motion_blur", speed=length * 11.0 / 1e-3, direction=angle) for length, angle in ((2, 0), (1, 90))
    )

    def smeared(offset, length):
        rise = erf((offset / 11 + length / 2) / np.sqrt(2)) - erf((offset / 11 - length / 2) / np.sqrt(2))
        return rise * np.sqrt(np.pi / 2) / length

    closed = smeared(view.x[0] - 120.4, 2) * smeared(view.y[0] - 119.7, 1)
    for cases in ([along_x, along_y], [along_y, along_x]):
        np.testing.assert_allclose(light_of(cases, view, base), closed, atol=2e-6)


@pytest.mark.parametrize("ratio", [1.0, 1.5, 4.0])
@pytest.mark.parametrize("direction", [0.0, 35.0, 90.0, 130.0])
def test_ellipses_keep_their_area(ratio, direction):
    """All light, and second moments σ²·ratio along `direction` (from +x towards +y) and σ²/ratio across it."""
    sigma = 9.0
    view, base = free(500.0, sigma)
    camera = light_of([of("beam_ellipticity", ratio=ratio, direction=direction)], view, base)
    # The fibre axis lies at ±angle + zero; here at 0.5 rad.
    for form, sense in (("same sense", 1), ("opposite sense", -1)):
        zero = direction - sense * np.rad2deg(0.5)
        fibre = light_of([of("fibre_anisotropy", form, ratio=ratio, zero=zero)], view, base)
        np.testing.assert_allclose(fibre, camera, rtol=1e-9, atol=1e-12)
    # The narrow axis is 4.5 px wide at least: samples sum to the integral to exp(−2π²·20).
    assert camera.sum() == pytest.approx(2 * np.pi * sigma**2 * 500, rel=1e-9)
    dx, dy = view.x[0] - 120.4, view.y[0] - 119.7
    turn = np.deg2rad(direction)
    along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
    moments = [(camera * v).sum() / camera.sum() for v in (along**2, across**2, along * across)]
    # 240 px end 6.6 widths of the longest ellipse from its centre.
    np.testing.assert_allclose(moments, [sigma**2 * ratio, sigma**2 / ratio, 0.0], rtol=1e-6, atol=1e-6)


def test_two_ellipses_on_one_axis_multiply():
    """And at right angles they undo each other: each direction is the camera's, whatever other ellipse there is."""
    view, base = free(500.0, 9.0)
    one = light_of([of("beam_ellipticity", ratio=2.4, direction=30.0)], view, base)
    zero = 30.0 - np.rad2deg(0.5)
    two = [
        of("beam_ellipticity", ratio=1.6, direction=30.0),
        of("fibre_anisotropy", "same sense", ratio=1.5, zero=zero),
    ]
    np.testing.assert_allclose(light_of(two, view, base), one, rtol=1e-9, atol=1e-12)
    two[1].values["zero"] += 90.0
    two[1].values["ratio"] = 1.6
    np.testing.assert_allclose(light_of(two, view, base), light_of([], view, base), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n", [0.3, 0.7, 1.0, 2.0, 5.0])
def test_super_gaussian_flanks(n):
    """exp(−(ρ²/2)^n): 1/e at ρ = √2 for every n, the peak at the centre, and n times the slope of a Gaussian there."""
    view, base = free(
        100.0, 10.0, x=120.4 + np.array([0.0, 1e-3, 200**0.5, 200**0.5 - 0.01, 200**0.5 + 0.01, 25.0])[None, None, :]
    )
    view = view._replace(y=view.y0)
    got = light_of([of("super_gaussian", n=n)], view, base)[0]
    # ρ²/2 is kept above 1e-12: at n = 0.3 the very centre reads 2.5e-4 low, at n = 0.5 already 1e-6.
    assert got[0] == pytest.approx(100.0, rel=2 * 1e-12**n)
    np.testing.assert_allclose(got[1:], 100 * np.exp(-(((view.x[0, 0, 1:] - 120.4) ** 2 / 200) ** n)), rtol=1e-8)
    assert got[2] == pytest.approx(100 / np.e, rel=1e-9)
    # d ln I/dρ at ρ = √2 is −n √2, where a Gaussian's is −√2; a difference over 0.002 adds 1e-6 n² of it.
    assert np.log(got[4] / got[3]) / 0.002 == pytest.approx(-n * np.sqrt(2), rel=1e-5)


def test_super_gaussian_holds_its_light():
    """∫ exp(−(ρ²/2)^n) 2πρ dρ = 2πσ² Γ(1 + 1/n)."""
    view, base = free(3.0, 10.0)
    for n in (0.8, 1.0, 1.6, 3.0):
        got = light_of([of("super_gaussian", n=n)], view, base).sum()
        # The flank of n = 3 is 2 px wide: samples sum to the integral to 1e-5.
        assert got == pytest.approx(3 * 2 * np.pi * 100 * gamma(1 + 1 / n), rel=2e-5)


@pytest.mark.parametrize("case", HALO, ids=title)
def test_halo_profile(case):
    """`fraction` of A at the spot's centre whatever the form; the light at one radius, and the whole halo's sum."""
    view, base = free(800.0, 10.0)
    fraction, radius = case.values["fraction"], 12.0
    case = case._replace(values=case.values | {"radius": radius})
    at = view._replace(x=view.x0 + np.array([[[0.0, radius]]]), y=view.y0)
    halo = light_of([case], at, base)[0] - light_of([], at, base)[0]
    there = {"exponential": np.exp(-1), "gaussian": np.exp(-0.5), "power": 2 ** -case.values["tail"]}[case.form]
    np.testing.assert_allclose(halo, 800 * fraction * np.array([1.0, there]), rtol=1e-10)
    # Integrals over the plane: 2πa², 2πa², πa²/(tail − 1) less what lies beyond the crop.
    total = (light_of([case], view, base) - light_of([], view, base)).sum() / (800 * fraction * np.pi * radius**2)
    if case.form == "power":
        # Within a disc of 119 px, by the closed form; the square's corners are the rest.
        tail = case.values["tail"]
        disc = (1 - (1 + (119 / radius) ** 2) ** (1 - tail)) / (tail - 1)
        assert disc < total < 1 / (tail - 1)
    else:
        assert total == pytest.approx(2.0, rel=2e-3 if case.form == "exponential" else 1e-9)


def test_ghost_copies_what_is_there():
    """A copy of the blurred, cut spot; dx to the right, dy downwards, whole pixels tell it exactly."""
    view, base = free(600.0, 12.0)
    cut = PLAIN._replace(top_hat=True)
    for own in ([], [of("motion_blur", speed=15e3, direction=15.0)], [of("super_gaussian", n=1.4)]):
        plain = chain.light(view, cut, base, present(own))[0][0]
        got = chain.light(view, cut, base, present([*own, of("ghost_reflection", fraction=0.3, dx=40.0, dy=-25.0)]))[0][
            0
        ]
        np.testing.assert_allclose((got - plain)[:-25, 40:], 0.3 * plain[25:, :-40], atol=1e-9)


def test_fringes_are_stripes():
    """Constant along the stripes, one period across them; the phase stays with the sensor, the spot, or the site."""
    view, base = free(1.0, 1e6)
    at = view._replace(x=np.array([50.0])[None, None], y=np.array([70.0])[None, :, None])
    period, direction = 13.0, 40.0
    cos, sin = np.cos(np.deg2rad(direction)), np.sin(np.deg2rad(direction))

    def factor(form, **changes):
        case = of("interference_fringes", form, d=0.5, period=period, direction=direction, phase=25.0)
        return float(light_of([case], at._replace(**changes), base)[0, 0])

    for form in ("sensor", "spot"):
        own = factor(form)
        assert factor(form, x=at.x - 7 * sin, y=at.y + 7 * cos) == pytest.approx(own, abs=1e-8)
        assert factor(form, x=at.x + period * cos, y=at.y + period * sin) == pytest.approx(own, abs=1e-8)
        half = factor(form, x=at.x + period / 2 * cos, y=at.y + period / 2 * sin)
        assert half - 1 == pytest.approx(1 - own, abs=1e-8)
    moved = {"x0": at.x0 + 3.0, "y0": at.y0 - 1.0}
    assert factor("sensor", **moved) == pytest.approx(factor("sensor"), abs=1e-8)
    assert factor("spot", **moved, x=at.x + 3.0, y=at.y - 1.0) == pytest.approx(factor("spot"), abs=1e-8)
    assert factor("sensor", x=0 * at.x, y=0 * at.y) == pytest.approx(1 + 0.5 * np.cos(np.deg2rad(25)), abs=1e-7)
    wave = {"wave_cos": 0.5 * np.cos(np.deg2rad(25)) + 0 * at.x0, "wave_sin": -0.5 * np.sin(np.deg2rad(25)) + 0 * at.x0}
    assert factor("site", **wave) == pytest.approx(factor("spot"), abs=1e-12)


def test_a_gradient_rises_uphill_and_is_never_negative():
    """`level` at the frame's centre, `slope` more at 100 px towards `direction`; where that would be negative, 0."""
    view, _ = free(0.0, 10.0)
    case = of("background_gradient", "light", level=6.0, slope=8.0, direction=90.0).present()
    at = view._replace(x=np.full((1, 1, 1), 119.5), y=np.array([119.5, 219.5, 44.6, 44.4, 0.0])[None, :, None])
    got = np.broadcast_to(case.apply(at), (1, 5, 1))[0, :, 0]
    np.testing.assert_allclose(got, [6.0, 14.0, 6 - 8 * 0.749, 0.0, 0.0], atol=1e-12)
    for direction in np.arange(0.0, 360.0, 30.0):
        own = of("background_gradient", "light", level=1.0, slope=300.0, direction=direction).present().apply(view)
        assert own.min() == 0.0 and own.max() > 100
        row, column = np.unravel_index(np.argmax(own[0]), own[0].shape)
        uphill = np.deg2rad(direction)
        assert (column - 119.5) * np.cos(uphill) + (row - 119.5) * np.sin(uphill) > 100


# The laws of width and brightness.


def states(cases, budget="spot_area", base=None) -> tuple[np.ndarray, np.ndarray]:
    """Peak [DN] and σ_g [px] of the six views."""
    own = chain.spot_state(VIEW, Baseline(LASER, budget, False, LONGEST), base or Law(P1, P2, PEAK), present(cases))
    return tuple(np.broadcast_to(v, (6, 1, 1))[:, 0, 0] for v in own)


def test_spread_law_replaces_p1():
    """Two numbers give the widths: p_b = p_ref (t/t_ref)^exponent, with p_ref the baseline's at the geometric mean; p1
    then only moves p_ref, and the peak follows the new spread."""
    effect = vocabulary()["spread_law"]
    assert effect.replaces == ("p1",)
    amplitude, sigma = states([of("spread_law", exponent=0.4)])
    p_ref = P1 * np.log(REFERENCE) + P2
    spread = p_ref * (np.array(EXPOSURES * 2) / REFERENCE) ** 0.4
    np.testing.assert_allclose(sigma, spread + LASER, rtol=1e-12)
    ratio = spread / sigma
    np.testing.assert_allclose(amplitude, PEAK * (ratio / ratio[2]) ** 2, rtol=1e-12)
    # Without p1 the same widths come from p2 alone.
    again = states([of("spread_law", exponent=0.4)], base=Law(0.0, p_ref, PEAK))
    np.testing.assert_allclose(again, (amplitude, sigma), rtol=1e-12)
    # A power of exponent p1/p_ref has the logarithm's slope at the reference: what is left is (p1 ln t/t_ref)²/2 p_ref,
    # and a third of its share of p_ref more at the ends, ±ln 3.
    near = states([of("spread_law", exponent=P1 / p_ref)])[1] - states([])[1]
    np.testing.assert_allclose(
        near[[0, 1, 2]], (P1 * np.log(3)) ** 2 / (2 * p_ref) * np.array([1, 0, 1]), rtol=0.07, atol=1e-12
    )


@pytest.mark.parametrize("budget", ["spot_area", "linear"])
def test_shutter_offset_acts_on_the_width_and_on_the_light(budget):
    """As if frames had been taken at nominal + offset; the peak is told relative to the nominal longest exposure."""
    offset = 4e-5
    amplitude, sigma = states([of("shutter_offset", offset=offset)], budget)
    true = np.array(EXPOSURES * 2) + offset
    np.testing.assert_allclose(sigma, P1 * np.log(true) + P2 + LASER, rtol=1e-12)
    own = Baseline(LASER, budget, False, LONGEST)
    np.testing.assert_allclose(amplitude, PEAK * own.relative_peak(true, P1, P2), rtol=1e-12)
    # Under the power law as well.
    both = states([of("shutter_offset", offset=offset), of("spread_law", exponent=0.4)], budget)[1]
    np.testing.assert_allclose(both, (P1 * np.log(REFERENCE) + P2) * (true / REFERENCE) ** 0.4 + LASER, rtol=1e-12)


def test_the_true_exposure_is_what_the_whole_frame_sees():
    """The true exposure is the nominal one plus a constant: dark current gathers and the spot moves during it too."""
    offset, late = 5e-5, 150.0
    shutter = of("shutter_offset", offset=offset)
    dark = SENSOR._replace(dark_current_e_per_s=1e6)
    far = VIEW._replace(x=VIEW.x + 1e5)
    base = Free(np.full((6, 1, 1), PEAK), np.full((6, 1, 1), 15.0))
    nominal, true = (all_moments(own, dark, far, base).mean[:, 0, 0] for own in ([], [shutter]))
    np.testing.assert_allclose(true - nominal, SENSOR.gain_dn_per_e * 1e6 * offset, rtol=1e-6)
    moving = of("motion_blur", speed=1e5, direction=late)
    longer = VIEW._replace(exposure_s=VIEW.exposure_s + offset)
    own = Baseline(LASER, "free", False, LONGEST)
    got = chain.light(VIEW, own, base, present([shutter, moving]))[0]
    np.testing.assert_allclose(got, chain.light(longer, own, base, present([moving]))[0], atol=1e-9 * PEAK)


def test_brightness_laws():
    """Photon budget 1 at the longest exposure; reflectance of period 180°, mean 1; drift from 0 to the total."""
    plain = states([])[0]
    for q in (-0.7, 0.5):
        ratio = states([of("photon_budget", q=q)])[0] / plain
        np.testing.assert_allclose(ratio, np.array(EXPOSURES * 2) ** q / LONGEST**q, rtol=1e-12)
        assert ratio[2] == pytest.approx(1, rel=1e-14)
    drift = states([of("laser_drift", total=0.3)])[0] / plain
    np.testing.assert_allclose(drift, 1 + 0.3 * np.arange(6) / 5, rtol=1e-12)
    settling = of("laser_drift", "settling", total=0.3, rate=2.5).present()
    places = VIEW.order[:, 0, 0]
    np.testing.assert_allclose(
        settling.apply(VIEW)[:, 0, 0], 1 + 0.3 * (1 - np.exp(-2.5 * places)) / (1 - np.exp(-2.5))
    )
    # By equal factors, and as straight as a rate of 0 says.
    grown = of("laser_drift", "settling", total=0.3, rate=-np.log(1.3)).present().apply(VIEW)[:, 0, 0]
    np.testing.assert_allclose(grown, 1.3**places, rtol=1e-12)
    straight = of("laser_drift", "settling", total=0.3, rate=0.0).present().apply(VIEW)[:, 0, 0]
    np.testing.assert_allclose(straight, 1 + 0.3 * places, rtol=1e-6)
    # Frames of one condition: the mean of the course, not the course of the mean; NaN is no frame.
    many = VIEW._replace(order=np.array([[[0.1, 0.5, 0.9]], [[0.2, 0.4, np.nan]]]))
    alone = [settling.apply(VIEW._replace(order=np.full((1, 1, 1), u)))[0, 0, 0] for u in (0.1, 0.5, 0.9, 0.2, 0.4)]
    np.testing.assert_allclose(settling.apply(many)[:, 0, 0], [np.mean(alone[:3]), np.mean(alone[3:])], rtol=1e-14)
    reflected = of("angle_reflectance", d=0.3, gamma0=28.0).present()
    at = VIEW._replace(angle=np.deg2rad(np.arange(0.0, 360.0, 15.0))[:, None, None])
    ratio = reflected.apply(at)[:, 0, 0]
    assert ratio.mean() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(ratio[:12], ratio[12:], rtol=1e-12)
    assert reflected.apply(VIEW._replace(angle=np.deg2rad(28.0))) == pytest.approx(1.3, rel=1e-14)
    assert reflected.apply(VIEW._replace(angle=np.deg2rad(118.0))) == pytest.approx(0.7, rel=1e-14)


def test_brightness_acts_on_halo_and_ghost_but_not_on_pedestals():
    """It is the light that changes, not the room's."""
    cases = [HALO[1], GHOST, PEDESTALS[0]]
    dimmed = fast_light([*cases, of("laser_drift", total=-0.9)])
    factor = (1 - 0.9 * np.arange(6) / 5)[:, None, None]
    np.testing.assert_allclose(dimmed - 17.0, factor * (fast_light(cases) - 17.0), rtol=1e-10)
