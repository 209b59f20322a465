"""What is said of a learned light: closed forms of its size, orders and axes, modes, and noise that is nothing."""

import re
from functools import cache

import numpy as np
import pytest
from scipy import integrate, optimize, special, stats

from spotcheck import store
from spotcheck.old_engine.conclude.judge import lights_of
from spotcheck.old_engine.conclude.judgement import Light
from spotcheck.old_engine.conclude.light import (
    ALL,
    attributes_of,
    described,
    gauge_of,
    gauged,
    in_gauge,
    light_of,
    present_of,
    through,
)
from spotcheck.old_engine.conclude.modes import modes_of
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, View, light
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.light_file import read_light, written_light
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.nuisance.normal import Schur
from spotcheck.old_engine.observe.pixels import Expectation, Lights, Model, Numbers
from tests.library.small_light import CONTEXT, PENALTY, SENSOR, fitted

STEP, SIDE = 0.12, 87
NODES = STEP * (np.arange(SIDE) - (SIDE - 1) / 2)
U, V = NODES[None, :], NODES[:, None]
RHO2, PHI = U * U + V * V, np.arctan2(V, U)
# Scatter of a coefficient [peaks] where noise hardly matters.
QUIET = 1e-6


def known(whole: np.ndarray, noise: float = QUIET, top_hat: bool = False) -> Fitted:
    """A fit that found a whole shape of those values at the nodes, with the same error for every coefficient."""
    factor = np.zeros((3 * SIDE + 4, SIDE * SIDE))
    factor[0] = 1 / noise
    nothing = np.zeros((SIDE * SIDE, 0))
    schur = Schur(factor, nothing, np.zeros((0, 0)), np.zeros((0, 0)))
    declared = np.exp(-RHO2 / 2)
    declared = np.minimum(declared, np.exp(-0.25)) if top_hat else declared
    lights = Lights.common(through(whole - declared, STEP), 1)
    model = Model(Baseline(0.0, "free", top_hat, 1.0), SENSOR, (), Numbers(*np.zeros((4, 1))), lights=lights)
    return Fitted(model, (), 0.0, schur, PENALTY, 1)


def ellipse(major: float, minor: float, turn: float) -> np.ndarray:
    """A Gaussian of two widths [σ], the larger one along `turn` [deg]."""
    a, b = (np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn)))
    return np.exp(-((U * a + V * b) ** 2) / (2 * major**2) - (V * a - U * b) ** 2 / (2 * minor**2))


def lobes(size: float, order: int = 3) -> np.ndarray:
    """A Gaussian with lobes: size ρ³ cos(order φ) exp(−ρ²/8) of it."""
    return np.exp(-RHO2 / 2) * (1 + size * RHO2**1.5 * np.cos(order * PHI) * np.exp(-RHO2 / 8))


# ½ ∫|cos| dφ ∫ρ⁴ exp(−5ρ²/8) dρ over 2π, for lobes of size 1.
LOBE_POWER = 0.5 * 4 * 3 * np.sqrt(np.pi) / (8 * 0.625**2.5) / (2 * np.pi)


def test_more_than_all_light_is_no_light():
    """Lobes so large that the shape lies below 0 where it is not in one of them."""
    effects = tuple(vocabulary().values())
    for power, count in ((0.3, 1), (1.2, 0)):
        fit = known(lobes(power / LOBE_POWER))
        assert light_of(fit).power == pytest.approx(power, rel=0.1)
        assert len(lights_of(fit, (ALL,), effects, CONTEXT)) == count


def test_an_ellipse():
    """Widths and direction as they are; the power of 1 ± e is 2e/π to first order (½ ∫|e ρ² cos 2φ| B over ∫B)."""
    fit = known(ellipse(1.02, 0.98, 30.0))
    own, wide = light_of(fit), gauge_of(fit.model).wide
    assert own.axes == (
        pytest.approx(1.02 / wide, abs=1e-4),
        pytest.approx(0.98 / wide, abs=1e-4),
        pytest.approx(30, abs=0.1),
    )
    assert own.power == pytest.approx(0.04 / np.pi, rel=0.01)
    assert own.orders[2] > 0.999 and own.lowest == pytest.approx(0, abs=1e-6)
    assert described(own) == (
        "1.3 % of the light lies elsewhere than a Gaussian's,"
        " most of it in a spot 1.04 times as long as wide, along 30°"
    )


def test_a_super_gaussian():
    """Against a search for A and w by quadrature along the radius; second moments by the gamma function."""
    n = 1.5
    own = light_of(known(np.exp(-((RHO2 / 2) ** n))))
    rho = np.linspace(0, 8, 16001)
    whole = np.exp(-((rho * rho / 2) ** n))

    def off(values):
        return integrate.simpson((whole - values[0] * np.exp(-((rho / values[1]) ** 2) / 2)) ** 2 * rho, x=rho)

    a, w = optimize.minimize(off, (1.0, 1.0), tol=1e-12).x
    left = np.abs(whole - a * np.exp(-((rho / w) ** 2) / 2))
    assert own.power == pytest.approx(
        integrate.simpson(left * rho, x=rho) / integrate.simpson(whole * rho, x=rho) / 2, rel=5e-3
    )
    assert own.orders[0] > 0.999
    assert own.axes[:2] == pytest.approx([np.sqrt(special.gamma(2 / n) / special.gamma(1 / n)) / w] * 2, abs=2e-3)
    assert described(own).endswith("most of it in rings about the centre")


@pytest.mark.parametrize(("order", "words"), [(1, "to one side"), (3, "in three lobes"), (5, "in five lobes")])
def test_lobes(order, words):
    """All in one order, and of the closed form's power; but for the first order, of which the gauge takes a part."""
    own = light_of(known(lobes(0.03, order)))
    assert own.orders[order] > 0.99 and own.orders[0] < 0.01
    assert order == 1 or own.power == pytest.approx(0.03 * LOBE_POWER, rel=0.01)
    assert described(own).endswith(f"than a Gaussian's, most of it {words}")


def test_the_gauge_keeps_the_light():
    """A brighter, wider and moved shape: in its gauge nothing is left beside B, and any shape is the same light."""
    moved = 1.1 * np.exp(-((U - 0.1) ** 2 + (V + 0.05) ** 2) / (2 * 1.08**2))
    gauge = gauge_of(known(moved).model)
    assert gauge == pytest.approx((1.1, 1.08, 0.1, -0.05), abs=1e-3)
    assert np.abs(gauged(known(moved).model, gauge).coefficients).max() < 1e-4
    fit = known(moved * (1 + 0.05 * np.cos(3 * PHI) * RHO2))
    gauge = gauge_of(fit.model)
    shape, at = gauged(fit.model, gauge), np.linspace(-4, 4, 60)
    u, v = at[None, None, :], at[None, :, None]
    before = light(view(u, v), fit.model.baseline_of(0), Free(one(1), one(1)), ())[0]
    base = Free(one(gauge.bright), one(gauge.wide))
    after = light(view(u, v, gauge.x, gauge.y), fit.model.baseline._replace(learned=shape), base, ())[0]
    np.testing.assert_allclose(after, before, atol=2e-4)


def test_a_model_in_its_gauge_expects_the_same_frames():
    """Means of all pixels to 3 % of their noise, rms: splines of 0.3 σ that are moved lose the finest noise."""
    frames, fit, _ = fitted(1)
    before, after = (Expectation(frames, model) for model in (fit.model, in_gauge(fit.model)))
    for k in (0, 5):
        was, now = before.of(frames[k], k), after.of(frames[k], k)
        assert np.sqrt(np.mean((now.mean - was.mean) ** 2 / was.variance)) < 0.03
    assert np.abs(np.array(gauge_of(after.model)) - (1, 1, 0, 0)).max() < 1e-4


def test_what_stands_for_a_light(tmp_path):
    """The effect that is learned, by its place, with values that its bounds allow; and what its file says of it."""
    own = light_of(known(lobes(0.03)))
    effects = vocabulary().values()
    present = present_of(own, effects)
    assert present is not None and present.named() == {"power": own.power, "order": 3.0}
    assert present_of(own, [effect for effect in effects if effect.starts(CONTEXT)]) is None
    assert present_of(own._replace(power=-1e-4), effects) == present._replace(values=(0.0, 3.0))
    written_light([own.shape], tmp_path / "light.nc", title="T", dataset="d", code="c", attributes=attributes_of(own))
    np.testing.assert_array_equal(read_light(tmp_path / "light.nc").coefficients, own.shape.coefficients)
    with store.read(tmp_path / "light.nc") as ds:
        assert ds.attrs["described"] == described(own) and ds.attrs["orders"][3] == own.orders[3]


def one(value: float) -> np.ndarray:
    return np.full((1, 1, 1), float(value))


def view(u, v, x=0.0, y=0.0) -> View:
    """Light at places u, v about a spot."""
    return View(u, v, one(x), one(y), one(1), one(0), one(0), one(0), one(0), 1.0, 1.0, 0.0, 0.0, 1.0, 1.0)


def mode(m: int, n: int, width: float, turn: float) -> np.ndarray:
    """Intensity of a Hermite–Gauss mode of integral 1, by recurrence of normalised Hermite functions."""
    a, b = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))

    def amplitude(order, x):
        before, now = 0.0, np.pi**-0.25 * np.exp(-x * x / 2)
        for k in range(order):
            before, now = now, np.sqrt(2 / (k + 1)) * x * now - np.sqrt(k / (k + 1)) * before
        return now

    scale = np.sqrt(2) * width
    return (amplitude(m, (U * a + V * b) / scale) * amplitude(n, (V * a - U * b) / scale) / scale) ** 2


def test_modes():
    """Weights, width and direction of a sum of three modes come back to 2 %, and are told: higher modes make up
    for a width that is 1 % off, to 1e-10."""
    width, turn, weights = 0.85, 20.0, {(0, 0): 0.75, (1, 0): 0.2, (0, 2): 0.05}
    whole = sum(part * mode(*own, width, turn) for own, part in weights.items())
    fit = known(whole / whole.max())
    own, wide = light_of(fit), gauge_of(fit.model).wide
    found = modes_of(own)
    assert found is not None and found.explained > 0.99
    assert found.parts == {own: pytest.approx(p, abs=0.02) for own, p in weights.items()}
    assert (found.width, found.direction) == (pytest.approx(width / wide, rel=0.02), pytest.approx(turn, abs=1))
    assert re.search(r", as if it were 7\d % TEM00, 20 % TEM10 and 4.9 % TEM02$", described(own, found))


def test_lobes_are_no_sum_of_modes():
    """Intensities of modes are even about the centre; three lobes are not."""
    assert modes_of(light_of(known(lobes(0.05)))) is None


def test_a_declared_top_hat_is_nothing_new():
    """The light is compared with what was declared."""
    own = light_of(known(np.minimum(np.exp(-RHO2 / 2), np.exp(-0.25)), top_hat=True))
    assert abs(own.power) < 1e-5


def test_a_shape_below_zero_is_told():
    """Where it is so by more than noise: a dip of 5 % of the peak, and the same under noise as large."""
    whole = np.exp(-RHO2 / 2) - 0.05 * np.exp(-((U - 3) ** 2 + V * V) / (2 * 0.4**2))
    own = light_of(known(whole))
    assert own.lowest == pytest.approx((whole / whole.max()).min(), abs=3e-3)
    assert "falls to −" in described(own)
    assert light_of(known(whole, 0.05)).lowest >= 0


@cache
def a_fit() -> Fitted:
    """Shape and numbers of 12 small frames of a beam with lobes."""
    return fitted(1)[1]


def noisy(size: float, count: int) -> list[Light]:
    """Lights of lobes of a size with the noise of `a_fit`, each drawn anew."""
    fit = a_fit()
    learned = fit.model.lights
    assert learned is not None
    side = learned.side
    nodes = learned.step * (np.arange(side) - (side - 1) / 2)
    u, v = nodes[None, :], nodes[:, None]
    r2 = u * u + v * v
    true = through(size * (u**3 - 3 * u * v * v) * np.exp(-r2 * 0.625), learned.step)
    rng, out = np.random.default_rng(7), []
    # N(0, S⁻¹) by the dense inverse, not by the code that is tested.
    band = fit.schur.factor
    lower = np.zeros((side * side, side * side))
    for gap in range(len(band)):
        lower[np.arange(gap, side * side), np.arange(side * side - gap)] = band[gap, : side * side - gap]
    for k in range(count):
        drawn = np.linalg.solve(lower.T, rng.standard_normal(side * side)).reshape(side, side)
        lights = learned._replace(coefficients=(true.coefficients + drawn)[None])
        model = fit.model._replace(lights=lights)
        out.append(light_of(fit._replace(model=model), seed=k))
    return out


def test_noise_is_nothing():
    """Its size is some nine errors, of which none is left: 24 draws within two errors of 0 and on either side, and no
    order is told. z scatters by 0.5 about 0.5 (a tenth of noise is in the error), so that one draw fails in 1,000."""
    lights = noisy(0.0, 24)
    z = np.array([own.power / own.error for own in lights])
    assert np.abs(z).max() < 2.5 and z.min() < 0 < z.max()
    assert not any(any(own.orders) for own in lights)
    assert all(described(own).startswith("less than 0.") and own.lowest >= 0 for own in lights)


@pytest.mark.parametrize("size", [0.003, 0.03])
def test_noise_is_taken_off(size):
    """Lobes of 0.2 and 2 % of the light under noise of 0.27 %: each of 12 within three errors."""
    lights = noisy(size, 12)
    z = np.array([(own.power - size * LOBE_POWER) / own.error for own in lights])
    assert np.abs(z).max() < 3
    assert all(np.argmax(own.orders) == 3 for own in lights)


def test_frames_of_a_beam():
    """From pixels: 3 % lobes that a fit learned, within three errors of the closed form (false alarm 0.3 %)."""
    own = light_of(a_fit())
    assert abs(own.power - 0.03 * LOBE_POWER) < stats.norm.isf(0.0015) * own.error
    assert described(own) == "2.1 % of the light lies elsewhere than a Gaussian's, most of it in three lobes"
