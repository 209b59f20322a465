"""Sums and solutions of the normal equations against dense matrices."""

import numpy as np
import pytest
from scipy import linalg

from spotcheck.old_engine.nuisance import normal
from tests.library.splines import matrix as design


def dense_of(band: np.ndarray) -> np.ndarray:
    """The symmetric matrix of a lower banded form."""
    size = band.shape[1]
    out = np.zeros((size, size))
    for gap in range(min(len(band), size)):
        at = np.arange(size - gap)
        out[at + gap, at] = out[at, at + gap] = band[gap, : size - gap]
    return out


def test_sums_are_those_of_dense_matrices():
    rng, side, step = np.random.default_rng(1), 9, 0.5
    u, v = rng.uniform(-3.5, 3.5, (2, 400))
    weight, values = rng.uniform(0, 2, 400), rng.normal(size=(3, 400))
    matrix = design(u, v, step, side)
    gram, out = np.zeros((side * side, 4, 7)), np.zeros((side * side, 3))
    normal.gather(u[None], v[None], step, side, weight[None], gram)
    normal.project(u[None], v[None], step, side, values[:, None], out)
    np.testing.assert_allclose(dense_of(normal.banded(gram, side)), (matrix.T * weight) @ matrix, atol=1e-12)
    np.testing.assert_allclose(out, matrix.T @ values.T, atol=1e-12)


def test_roughness_is_the_square_of_second_differences():
    side, rng = 8, np.random.default_rng(2)
    band, surface = normal.roughness(side), rng.normal(size=(side, side))
    want = (np.diff(surface, 2, axis=0) ** 2).sum() + (np.diff(surface, 2, axis=1) ** 2).sum()
    flat = surface.ravel()
    assert np.isclose(flat @ normal.product(band, flat), want)
    assert np.isclose(flat @ dense_of(band) @ flat, want)


def test_both_parts_of_the_solution():
    """As one dense system, with and without other numbers."""
    rng, side = np.random.default_rng(3), 7
    gram = np.zeros((side * side, 4, 7))
    u, v = rng.uniform(-2, 2, (2, 300))
    normal.gather(u[None], v[None], 0.5, side, np.ones((1, 300)), gram)
    band = normal.banded(gram, side) + normal.roughness(side)
    inner, size = dense_of(band), side * side
    joined, dense = rng.normal(size=(size, 4)), 50 * np.eye(4)
    whole = np.block([[inner, joined], [joined.T, dense]])
    right = rng.normal(size=size + 4)
    solved = normal.schur(band, joined, dense)
    np.testing.assert_allclose(np.concatenate(solved.solve(right[:size], right[size:])), np.linalg.solve(whole, right))
    np.testing.assert_allclose(np.linalg.inv(solved.left), np.linalg.inv(whole)[size:, size:])
    alone = normal.schur(band, joined[:, :0], dense[:0, :0])
    np.testing.assert_allclose(alone.solve(right[:size], right[:0])[0], np.linalg.solve(inner, right[:size]))


@pytest.mark.parametrize("seed", range(4))
def test_rows_of_a_grid_add_up_as_its_points_do(seed):
    """Pixels on a grid, some of them masked, and of its rows and columns a few beyond the last node; both from sums
    that are not 0 to begin with."""
    rng, side, step = np.random.default_rng(seed), 7, 0.6
    u, v = np.sort(rng.uniform(-2.5, 2.5, (1, 31))), np.sort(rng.uniform(-2.3, 2.3, (27, 1)), axis=0)
    v[:3, 0], v[-2:, 0], u[0, -4:] = (-9.0, -3.1, -2.95), (3.0, 44.0), (2.99, 3.0, 3.2, 8.0)
    weight, values = rng.uniform(0, 2, (27, 31)), rng.normal(size=(3, 27, 31))
    weight[rng.random(weight.shape) < 0.1] = 0.0
    grams, outs = np.ones((2, side * side, 4, 7)), np.ones((2, side * side, 3))
    whole = np.broadcast_arrays(u, v)
    for gram, out, (one, two) in zip(grams, outs, ((u, v), whole), strict=True):
        normal.gather(one, two, step, side, weight, gram)
        normal.project(one, two, step, side, values, out)
    np.testing.assert_allclose(normal.banded(grams[0], side), normal.banded(grams[1], side), atol=1e-12)
    np.testing.assert_allclose(outs[0], outs[1], atol=1e-12)
    matrix = design(*(own.ravel() for own in whole), step, side)
    np.testing.assert_allclose(outs[0] - 1, matrix.T @ values.reshape(3, -1).T, atol=1e-12)


def banded_system(side: int, seed: int = 4):
    """A banded matrix as shapes have it, in both forms."""
    rng, gram = np.random.default_rng(seed), np.zeros((side * side, 4, 7))
    u, v = rng.uniform(-2, 2, (2, 1, 600))
    normal.gather(u, v, 4 / side, side, np.ones((1, 600)), gram)
    band = normal.banded(gram, side) + normal.roughness(side)
    return rng, band, dense_of(band)


@pytest.mark.parametrize("side", [4, 5, 9, 12])
@pytest.mark.parametrize("columns", [0, 1, normal.MANY - 1, normal.MANY, 40])
def test_solutions_of_few_and_of_many_columns(side, columns):
    """As scipy solves the whole matrix, of sizes that blocks part evenly and that they do not."""
    rng, band, dense = banded_system(side)
    right = rng.normal(size=(side * side, columns))
    factor = linalg.cholesky_banded(band, lower=True)
    before = right.copy()
    np.testing.assert_allclose(normal.solve_banded(factor, right), np.linalg.solve(dense, right), rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(right, before)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_numbers_behind_others(count):
    """The first few numbers with the others behind are all of them at once; without a shape, too."""
    rng, band, _ = banded_system(6)
    half = rng.normal(size=(8, 20))
    dense = half @ half.T + 40 * np.eye(8)
    for own, size in ((band, 36), (np.zeros((4, 0)), 0)):
        joined = rng.normal(size=(size, 8))
        whole = normal.schur(own, joined, dense)
        first = normal.schur(own, joined[:, :count], dense[:count, :count])
        both = first.bordered(joined[:, count:], dense[:count, count:], dense[count:, count:])
        for one, two in zip(both, whole, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-10)
        for one, two in zip(whole.first(count), first, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-10)
        right = rng.normal(size=size), rng.normal(size=8)
        for one, two in zip(both.solve(*right), whole.solve(*right), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-9)
    assert whole.bordered(np.zeros((0, 0)), np.zeros((8, 0)), np.zeros((0, 0))) is whole


def test_a_number_of_which_nothing_is_told():
    """Its variance is infinite and it takes no step; the others have theirs, whatever their units."""
    scale = np.array([1e-6, 1.0, 1e5])
    information = np.zeros((4, 4))
    information[:3, :3] = (np.eye(3) + 0.5) / np.outer(scale, scale)
    found = normal.covariance(information)
    want = np.linalg.inv(np.eye(3) + 0.5) * np.outer(scale, scale)
    np.testing.assert_allclose(found[:3, :3], want, rtol=1e-7)
    assert np.isinf(found[3, 3]) and not found[3, :3].any()
    scores = np.stack([1 / scale, 2 / scale], 1)
    step = normal.solve(information, np.concatenate([scores, [[0.0, 0.0]]]))
    np.testing.assert_allclose(step[:3], want @ scores, rtol=1e-7)
    assert not step[3].any()
