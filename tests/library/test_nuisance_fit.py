"""The joint fit of shape and numbers: against the beam that was drawn, and against the law of its errors."""

import numpy as np
from scipy import stats

from spotcheck.discrepancy.nuisance.fit import NUMBERS, contrasts
from spotcheck.discrepancy.observe.pixels import Expectation
from tests.library.small_light import BLACK, SIDE, beam, fitted

Y, X = np.mgrid[:SIDE, :SIDE].astype(float)


def test_the_beam_is_learned():
    """A beam that is 4 % off a Gaussian: the mean of every frame within 0.4 % of its peak (rms of the blocks' noise is
    0.2 %), and residuals that are noise: χ² a pixel 1 to five standard errors, 0.7 % of pixels being coefficients."""
    frames, fit, known = fitted(1)
    ready = Expectation(frames, fit.model)
    chi2, pixels = 0.0, 0
    for k, frame in enumerate(frames):
        seen = ready.of(frame, k)
        _, peak, width, x0, y0 = known[k]
        truth = peak * beam((X - x0) / width, (Y - y0) / width) + BLACK
        assert np.sqrt(np.mean((seen.mean - truth)[truth > BLACK + 0.05 * peak] ** 2)) < 0.004 * peak
        chi2 += float(((frame.pixels - seen.mean) ** 2 / seen.variance).sum())
        pixels += frame.pixels.size
    taken = fit.model.baseline.learned.coefficients.size
    assert -5 * np.sqrt(2 * pixels) - taken < chi2 - pixels < 5 * np.sqrt(2 * pixels)


def test_numbers_scatter_by_their_errors():
    """Brightness and width of frames against the truth, all but the common part: over five sets of 12 frames the pulls
    of 44 contrasts each have mean square 1 (false alarm 1e-4)."""
    square, count = 0.0, 0
    for seed in range(5):
        frames, fit, known = fitted(seed)
        off = np.stack(
            [
                fit.model.numbers.log_peak - np.log(known[:, 1]),
                fit.model.numbers.log_width - np.log(known[:, 2]),
                (fit.model.numbers.x - known[:, 3]) / known[:, 2],
                (fit.model.numbers.y - known[:, 4]) / known[:, 2],
            ],
            axis=1,
        ).ravel()
        apart = contrasts(fit.model).T @ off
        square += float(apart @ fit.schur.left @ apart)
        count += NUMBERS * (len(frames) - 1)
    assert stats.chi2.ppf(5e-5, count) < square < stats.chi2.isf(5e-5, count)
