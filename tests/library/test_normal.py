"""Sums and solutions of the normal equations against dense matrices."""

import numpy as np

from spotcheck.discrepancy.nuisance import normal
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
