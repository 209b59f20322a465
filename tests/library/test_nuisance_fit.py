"""The joint fit of shape and numbers: against the beam that was drawn, and against the law of its errors."""

import numpy as np
import pytest
from scipy import stats

from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import NUMBERS, contrasts, fit
from spotcheck.old_engine.nuisance.parameters import free_of, values_of
from spotcheck.old_engine.observe.pixels import Expectation
from tests.library.small_light import BLACK, CONTEXT, PENALTY, SIDE, beam, drawn, fitted, gaussian, started

Y, X = np.mgrid[:SIDE, :SIDE].astype(float)


def test_the_beam_is_learned():
    """A beam that is 4 % off a Gaussian: the mean of every frame within 0.4 % of its peak (rms of the blocks' noise is
    0.2 %), and residuals that are noise: χ² a pixel 1 to five standard errors, 0.7 % of pixels being coefficients."""
    frames, own, known = fitted(1)
    ready = Expectation(frames, own.model)
    chi2, pixels = 0.0, 0
    for k, frame in enumerate(frames):
        seen = ready.of(frame, k)
        _, peak, width, x0, y0 = known[k]
        truth = peak * beam((X - x0) / width, (Y - y0) / width) + BLACK
        assert np.sqrt(np.mean((seen.mean - truth)[truth > BLACK + 0.05 * peak] ** 2)) < 0.004 * peak
        chi2 += float(((frame.pixels - seen.mean) ** 2 / seen.variance).sum())
        pixels += frame.pixels.size
    taken = own.model.lights.coefficients.size
    assert -5 * np.sqrt(2 * pixels) - taken < chi2 - pixels < 5 * np.sqrt(2 * pixels)


def test_numbers_scatter_by_their_errors():
    """Brightness and width of frames against the truth, all but the common part: over five sets of 12 frames the pulls
    of 44 contrasts each have mean square 1 (false alarm 1e-4)."""
    square, count = 0.0, 0
    for seed in range(5):
        frames, own, known = fitted(seed)
        off = np.stack(
            [
                own.model.numbers.log_peak - np.log(known[:, 1]),
                own.model.numbers.log_width - np.log(known[:, 2]),
                (own.model.numbers.x - known[:, 3]) / known[:, 2],
                (own.model.numbers.y - known[:, 4]) / known[:, 2],
            ],
            axis=1,
        ).ravel()
        apart = contrasts(own.model).T @ off
        square += float(apart @ own.schur.left @ apart)
        count += NUMBERS * (len(frames) - 1)
    assert stats.chi2.ppf(5e-5, count) < square < stats.chi2.isf(5e-5, count)


def test_a_declared_shape_alone():
    """Gaussian light without a learned shape: all numbers are free, none is a contrast. Over six sets of 12 frames the
    mean of the pulls of each number is 0, and their mean square 1 (false alarm 1e-4 each)."""
    pulls, square, count = [], 0.0, 0
    for seed in range(6):
        images, known = drawn(seed, shape=gaussian)
        frames, model = started(images, known)
        model = model._replace(lights=None)
        own = fit(frames, model, PENALTY)
        truth = np.stack([np.log(known[:, 1]), np.log(known[:, 2]), known[:, 3], known[:, 4]])
        off = np.stack(own.model.numbers) - truth
        off[2:] /= known[:, 2]
        assert own.schur.left.shape == (NUMBERS * len(frames),) * 2
        pulls.append((off / np.sqrt(np.diag(own.covariance).reshape(-1, NUMBERS).T)).T)
        square += float(off.T.ravel() @ own.schur.left @ off.T.ravel())
        count += off.size
    every = np.concatenate(pulls)
    assert (np.abs(every.mean(0)) < stats.norm.isf(5e-5) / np.sqrt(len(every))).all()
    assert stats.chi2.ppf(5e-5, count) < square < stats.chi2.isf(5e-5, count)


@pytest.mark.parametrize("learned", [True, False])
def test_a_fit_near_another_finds_the_same(learned):
    """With an effect more, by the matrices of the fit without it: −2 ln L within 0.5, the effect within a tenth of its
    error, numbers within a third of theirs."""
    images, known = drawn(3, pedestal=2.0, shape=beam if learned else gaussian)
    frames, model = started(images, known)
    if not learned:
        model = model._replace(lights=None)
    without = fit(frames, model, PENALTY)
    offset = Present(vocabulary()["dark_offset"], "light", (1.0,))
    more = without.model._replace(present=(offset,))
    free = free_of(more, CONTEXT)
    near = fit(frames, more, PENALTY, free, near=without)
    fresh = fit(frames, more, PENALTY, free, steps=16)
    assert without.total - fresh.total > 1000
    assert near.total == pytest.approx(fresh.total, abs=0.5)
    (one,), (two,) = values_of(near.model, free), values_of(fresh.model, free)
    error = float(np.sqrt(fresh.covariance[-1, -1]))
    assert abs(one - two) < 0.1 * error and abs(two - 2) < 4 * error
    assert float(np.sqrt(near.covariance[-1, -1])) == pytest.approx(error, rel=0.1)
    width = np.exp(fresh.model.numbers.log_width)
    unit = np.stack([np.ones_like(width), np.ones_like(width), width, width], 1).ravel()
    basis = contrasts(fresh.model, 1)
    errors = np.sqrt(np.diag(basis @ fresh.covariance @ basis.T))[:-1] * unit
    moved = (np.stack(near.model.numbers) - np.stack(fresh.model.numbers)).T.ravel()
    assert (np.abs(moved) < errors / 3).all()
