"""What a learned shape takes of the noise, against dense matrices."""

from functools import cache

import numpy as np
import pytest
from scipy import linalg

from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.nuisance import taken
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.observe.pixels import Expectation, Lights, told
from tests.library import splines
from tests.library.small_light import drawn, started

STEP, NODES = 0.5, 15


@cache
def one_frame():
    """One frame, and its fit under a shape of 15 × 15 coefficients that ends within it."""
    images, known = drawn(3, sites=1)
    frames, model = started(images[2:], known[2:])
    model = model._replace(lights=Lights.common(light_shape.empty(STEP, 3.5), 1))
    return frames[0], fit(frames, model, 1.0)


def test_draws_have_the_shapes_covariance():
    """Of 4,000 draws: every covariance of the middle 25 coefficients within 5 of its errors of S⁻¹ (2e-4 for all)."""
    _, own = one_frame()
    drawn_shapes = taken.draws_of(own.schur, NODES, 4000, np.random.default_rng(1)).reshape(4000, -1)
    covariance = linalg.cho_solve_banded((own.schur.factor, True), np.eye(NODES**2))
    at = (np.arange(5, 10)[:, None] * NODES + np.arange(5, 10)).ravel()
    want, found = covariance[np.ix_(at, at)], (drawn_shapes.T @ drawn_shapes / 4000)[np.ix_(at, at)]
    error = np.sqrt((np.outer(np.diag(want), np.diag(want)) + want**2) / 4000)
    assert np.abs(found - want).max() > 0
    assert (np.abs(found - want) < 5 * error).all()


@pytest.mark.parametrize(("draws", "within"), [(2000, 0.02), (taken.DRAWS, 0.1)])
def test_what_is_lacking_is_half_the_hat_matrix(monkeypatch, draws, within):
    """Σ ½ h/V over the pixels, h the diagonal of B S⁻¹ Bᵀ/V of dense matrices: with many draws within 2 %, what means
    over cells cost, and twice that in each ring; with those of a search within 10 %, four errors of 16 draws of 224
    coefficients and that."""
    monkeypatch.setattr(taken, "DRAWS", draws)
    frame, own = one_frame()
    ready = Expectation([frame], own.model)
    seen = ready.of(frame, 0)
    tells = told(frame, seen)
    u, v = (place.ravel() for place in np.broadcast_arrays(seen.u, seen.v))
    peak = float(np.exp(own.model.numbers.log_peak[0]))
    slopes = peak * seen.slope.ravel()[:, None] * splines.matrix(u, v, STEP, NODES)
    inner = linalg.cho_solve_banded((own.schur.factor, True), slopes.T)
    hat = np.einsum("pc,cp->p", slopes, inner) * tells.sure.ravel()
    (variance,) = taken.variances_of(own)
    found = 2 * taken.lacking(variance, peak, seen, tells).ravel() / tells.sure.ravel()
    assert 200 < hat.sum() < NODES**2
    assert found.sum() == pytest.approx(hat.sum(), rel=within)
    ring = np.maximum(abs(u), abs(v)).astype(int)
    for radius in range(3):
        assert found[ring == radius].sum() == pytest.approx(hat[ring == radius].sum(), rel=2 * within)


def test_without_a_shape_nothing_is_lacking():
    frame, own = one_frame()
    seen = Expectation([frame], own.model).of(frame, 0)
    assert taken.variances_of(own._replace(model=own.model._replace(lights=None))) == [None]
    assert not taken.lacking(None, 500.0, seen, told(frame, seen)).any()
