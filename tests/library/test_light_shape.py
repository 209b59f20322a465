"""The learned shape against scipy's splines."""

import numpy as np
from scipy.interpolate import BSpline

from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, View, light
from spotcheck.model.light_shape import LightShape, cubic, empty


def shape(side: int = 21, step: float = 0.4, seed: int = 3) -> LightShape:
    return LightShape(step, np.random.default_rng(seed).normal(0, 0.1, (side, side)))


def by_scipy(own: LightShape, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Σ c b(v) b(u), a spline at a time."""
    nodes = own.step * (np.arange(len(own.coefficients)) - (len(own.coefficients) - 1) / 2)
    one = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    along, across = (np.nan_to_num(one((x[:, None] - nodes) / own.step)) for x in (u, v))
    return np.einsum("pi,ij,pj->p", across, own.coefficients, along)


def test_cubic_is_scipys():
    t = np.linspace(-2.5, 2.5, 101)
    want = np.nan_to_num(BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)(t))
    np.testing.assert_allclose(cubic(t), want, atol=1e-15)


def test_points_and_grids_agree_with_scipy():
    """Inside, at the edge and beyond; a grid goes by matrices, points by a compiled loop."""
    own, rng = shape(), np.random.default_rng(4)
    u, v = rng.uniform(-6, 6, (2, 500))
    assert np.abs(u).max() > own.reach + 2 * own.step
    np.testing.assert_allclose(own(u, v), by_scipy(own, u, v), atol=1e-14)
    columns, rows = np.linspace(-5, 5, 40), np.linspace(-6, 4, 30)
    grid = own(columns[None, None, :], rows[None, :, None])
    want = by_scipy(own, *(part.ravel() for part in np.meshgrid(columns, rows)))
    np.testing.assert_allclose(grid[0], want.reshape(30, 40), atol=1e-14)


def test_an_empty_shape_reaches_as_far_as_asked():
    own = empty(0.15, 5.1)
    assert own.reach >= 5.1 and not own.coefficients.any()


def test_the_chain_adds_it_to_the_spot():
    """Light of a spot with a learned shape is A (B + s), in the spot's own coordinates."""
    one = np.ones((1, 1, 1))
    x, y = np.arange(50.0)[None, None, :], np.arange(40.0)[None, :, None]
    view = View(x, y, 24 * one, 21 * one, one, one, one, 0 * one, 0 * one, 1.0, 1.0, 0.0, 0.0, 40.0, 1.0)
    own, base = shape(), Free(300 * one, 6 * one)
    plain, learned = (light(view, Baseline(0.0, "free", False, 1.0, s), base, ())[0] for s in (None, own))
    u, v = (part.ravel() for part in np.broadcast_arrays((x - 24) / 6, (y - 21) / 6))
    np.testing.assert_allclose((learned - plain).ravel(), 300 * by_scipy(own, u, v), atol=1e-10)
