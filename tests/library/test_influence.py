"""Errors of the frames' numbers by how much cells of the spot disagree; and the scatter of a level over pixels."""

import numpy as np

from spotcheck.old_engine.evidence.influence import CELLS, FrameNumbers, as_cells_agree
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import NUMBERS
from spotcheck.old_engine.observe.pixels import Expectation
from tests.library.small_light import BLACK, GAIN, NOISE, drawn, gaussian, started


def test_errors_grow_with_what_cells_disagree_by():
    """72 frames of 12 conditions, cells of one spread and a part that all frames of a condition share: where the spread
    is what the covariance says, it stays; where it is twice that, the covariance is four times as large. Ratios of
    variances scatter by 4 %: the bounds are five of that."""
    frames, rng = 72, np.random.default_rng(3)
    condition = np.arange(frames) % 12
    cells = rng.standard_normal((frames, NUMBERS, CELLS))
    shared = 5 * rng.standard_normal((12, NUMBERS, CELLS))[condition]
    # The variance of a sum of cells of variance 1, of which a frame's own numbers were fitted.
    covariance = np.eye(NUMBERS * frames) * CELLS * (CELLS - 1) / (CELLS - NUMBERS)
    for times, ratio in ((0.5, 1.0), (2.0, 4.0)):
        influence = (times * cells + shared).reshape(NUMBERS * frames, CELLS)
        told = as_cells_agree(FrameNumbers(np.zeros((NUMBERS, frames)), covariance, influence), condition)
        assert np.all(np.abs(np.diag(told.covariance) / np.diag(covariance) / ratio - 1) < 0.2)
    alone = as_cells_agree(FrameNumbers(np.zeros((NUMBERS, frames)), covariance, influence), np.arange(frames))
    assert np.array_equal(alone.covariance, covariance)


def test_a_level_that_differs_from_pixel_to_pixel():
    """Far above the level readings scatter by read noise, rounding and the level's own scatter; far below as without
    it."""
    images, known = drawn(3, 1, shape=lambda u, v: 20 * gaussian(u, v))
    frames, model = started(images, known)
    model = model._replace(lights=None)
    model = model._replace(numbers=model.numbers._replace(log_peak=model.numbers.log_peak + np.log(20)))
    plain = Expectation(frames, model).of(frames[2], 2)
    model = model.with_effect(Present(vocabulary()["saturation"], "sharp", (500.0, 0.03)))._replace(uneven=0.02)
    seen = Expectation(frames, model).of(frames[2], 2)
    above, below = plain.spot > 1000, plain.spot < 300
    assert above.sum() > 100 and below.sum() > 100
    assert np.allclose(seen.mean[above], 500 + BLACK, atol=0.05)
    assert np.allclose(seen.variance[above], (GAIN * NOISE) ** 2 + 1 / 12 + (0.02 * 500) ** 2, rtol=0.01)
    assert np.allclose(seen.variance[below], plain.variance[below], rtol=1e-3)
