"""The learned shape against scipy's splines."""

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, View, light
from spotcheck.model.light_shape import LightShape, empty, weights_at
from tests.library.splines import along, surface


def shape(side: int = 21, step: float = 0.4, seed: int = 3) -> LightShape:
    return LightShape(step, np.random.default_rng(seed).normal(0, 0.1, (side, side)))


def test_values_of_one_spline():
    """The four that reach a point, and which they are."""
    out = np.empty(4)
    for t in (0.0, 3.0, 4.25, 6.999, -1.5):
        first = weights_at(t, out)
        want = along(np.array([t - 5.0]), 1.0, 17)[0]
        np.testing.assert_allclose(out, [want[3 + first + k] for k in range(4)], atol=1e-15)


def test_points_and_grids_agree_with_scipy():
    """Inside, at the edge and beyond; a grid goes row by row, points one by one."""
    own, rng = shape(), np.random.default_rng(4)
    u, v = rng.uniform(-6, 6, (2, 500))
    assert np.abs(u).max() > own.reach + 2 * own.step
    np.testing.assert_allclose(own(u, v), surface(own, u, v), atol=1e-14)
    columns, rows = np.linspace(-5, 5, 40), np.linspace(-6, 4, 30)
    grid = own(columns[None, None, :], rows[None, :, None])
    want = surface(own, *(part.ravel() for part in np.meshgrid(columns, rows)))
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
    np.testing.assert_allclose((learned - plain).ravel(), 300 * surface(own, u, v), atol=1e-10)
