"""The light of effects: against the dataset contract's words, `slow_light`, and each shape's own closed forms."""

from dataclasses import replace

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
    LAW,
    LAWS,
    LIGHT,
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


def states(cases, law=LAW) -> np.ndarray:
    """Return peak [DN] and σ_g [px] of frames [quantity, frame]."""
    model = replace(model_of(cases, "spot_area"), law=law)
    return np.transpose([(spot.peak_dn, spot.sigma_px) for spot in map(model.spot, FRAMES)])


def test_spread_law_replaces_p1():
    """Without p1 the same widths come from p2 alone: p1 only moves the width at the reference exposure."""
    assert vocabulary()["spread_law"].replaces == ("p1",)
    p_ref = P1 * np.log(REFERENCE) + P2
    law = of("spread_law", exponent=0.4)
    np.testing.assert_allclose(states([law], ExposureLaw(0.0, p_ref, PEAK)), states([law]), rtol=1e-12)
    # A power of exponent p1/p_ref has the logarithm's slope at the reference: what is left is (p1 ln t/t_ref)²/2 p_ref,
    # and a third of its share of p_ref more at the ends, ±ln 3.
    near = (states([of("spread_law", exponent=P1 / p_ref)]) - states([]))[1, :3]
    np.testing.assert_allclose(near, (P1 * np.log(3)) ** 2 / (2 * p_ref) * np.array([1, 0, 1]), rtol=0.07, atol=1e-12)


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


def test_a_drift_that_accelerates_or_runs_straight():
    """At a rate below 0 the brightness grows by equal factors; at a rate of 0 it is as straight as the linear drift."""
    places, plain = np.arange(6) / 5, states([])[0]
    for rate, wanted, tolerance in ((-np.log(1.3), 1.3**places, 1e-12), (0.0, 1 + 0.3 * places, 1e-6)):
        factor = states([of("laser_drift", "settling", total=0.3, rate=rate)])[0] / plain
        np.testing.assert_allclose(factor, wanted, rtol=tolerance)
