"""The spot fit: returns the truth within its errors, agrees with scipy, and never calls a failure converged."""

import numpy as np
import pytest
from scipy.optimize import curve_fit

from spotcheck.estimate.spotfit import PARAMETERS, fit_spot, model_image
from spotcheck.model import spot
from spotcheck.store import flag
from tests.library.conftest import SENSOR, gaussian, noisy

SIDE = 50
TRUTH = np.array([600.0, 24.3, 26.1, 6.5, 4.8, 30.0, SENSOR.black_level_dn])
NAMES = list(PARAMETERS)
Y, X = np.mgrid[:SIDE, :SIDE].astype(float)


def image_of(value) -> np.ndarray:
    """A Gaussian on an offset, orientation in degrees, written out once more by its covariance matrix."""
    amplitude, x0, y0, major, minor, degrees, offset = value[:7]
    u = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    cov = major**2 * np.outer(u, u) + minor**2 * (np.eye(2) - np.outer(u, u))
    d = np.stack([X - x0, Y - y0])
    return amplitude * np.exp(-np.einsum("iyx,ij,jyx->yx", d, np.linalg.inv(cov), d) / 2) + offset


def turned(degrees):
    """Difference of two directions, within ± 90°."""
    return (degrees + 90) % 180 - 90


@pytest.fixture(scope="module")
def pulls() -> np.ndarray:
    """(Value − truth)/error [frame, parameter] over 200 seeded frames, and reduced χ² as the last column."""
    light = image_of(TRUTH) - SENSOR.black_level_dn
    out = []
    for seed in range(200):
        fit = fit_spot(noisy(light, seed).astype(np.float32), 1e-4, SENSOR)
        miss = fit.value[:7] - TRUTH
        miss[5] = turned(miss[5])
        mean_miss = fit.value[7] - (TRUTH[3] + TRUTH[4]) / 2
        out.append([*(miss / fit.stderr[:7]), mean_miss / fit.stderr[7], fit.chi2_reduced])
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
def test_pulls_have_mean_0_and_width_1(pulls, name):
    """Four standard errors: 0.28 for the mean and 0.2 for the width of 200 pulls; false alarm 6e-5 each."""
    own = pulls[:, NAMES.index(name)]
    assert abs(own.mean()) < 4 / np.sqrt(200)
    assert abs(own.std(ddof=1) - 1) < 4 / np.sqrt(400)


def test_reduced_chi_square_is_one(pulls):
    """Mean over 200 frames of 2493 degrees of freedom: standard error √(2/2493/200)."""
    assert pulls[:, -1].mean() == pytest.approx(1, abs=5 * np.sqrt(2 / 2493 / 200))


@pytest.mark.parametrize("seed", range(5))
def test_against_scipy(seed):
    """scipy's Levenberg–Marquardt on the same data, to 1e-4 of a standard error."""
    data = noisy(image_of(TRUTH) - SENSOR.black_level_dn, seed).astype(float)
    fit = fit_spot(data, 1e-4, SENSOR)

    def flat(_, *p):
        return image_of(p).ravel()

    best, covariance = curve_fit(flat, None, data.ravel(), p0=TRUTH, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    miss = fit.value[:7] - best
    miss[5] = turned(miss[5])
    # Both stop within their own step tolerance (1e-6 of a width, 1e-12 relative); an error is about 1e-2 px.
    assert np.abs(miss / fit.stderr[:7]).max() < 1e-4 + 1e-6 * TRUTH[3] / fit.stderr[3]
    # Without a sensor model the errors are those of white noise, as curve_fit has them.
    white = fit_spot(data, 1e-4, None)
    np.testing.assert_allclose(white.stderr[:7], np.sqrt(np.diag(covariance)), rtol=1e-3)


def test_gaps_are_left_out():
    """NaN pixels: no noise, so the other pixels give the truth back; a third of the spot may be gone."""
    data = image_of(TRUTH)
    data[:, :20] = np.nan
    data[30, 25:28] = np.nan
    fit = fit_spot(data, 1e-4, SENSOR)
    # The least squares of data without noise is 0 at the truth; steps of 1e-6 of a width remain.
    np.testing.assert_allclose(fit.value[:7], TRUTH, rtol=1e-5)
    assert fit.status == 0


@pytest.mark.parametrize("degrees", [0.0, 45.0, 89.0, 120.0, 179.0])
def test_orientation_turns_from_x_towards_y(degrees):
    """Noise-free ellipses at any direction."""
    truth = TRUTH.copy()
    truth[5] = degrees
    fit = fit_spot(image_of(truth), 1e-4, None)
    assert abs(turned(fit.value[5] - degrees)) < 1e-3 and 0 <= fit.value[5] < 180
    np.testing.assert_allclose(model_image(fit.value, SIDE), image_of(truth), atol=0.01)


def test_a_round_spot():
    """No special point: it converges, and the mean width of 60 frames scatters as its error says."""
    light = gaussian(SIDE, 600.0, 25.2, 24.9, 5.5)
    fits = [fit_spot(noisy(light, seed), 1e-4, SENSOR) for seed in range(60)]
    assert all(f.status == 0 for f in fits)
    pull = np.array([(f.value[7] - 5.5) / f.stderr[7] for f in fits])
    # Four standard errors of mean and width: false alarm 6e-5 each. The mean of both widths has no bias to first order.
    assert abs(pull.mean()) < 4 / np.sqrt(60) and abs(pull.std(ddof=1) - 1) < 4 / np.sqrt(120)


def test_a_gaussian_fitted_to_a_top_hat():
    """4.3 % wider than the Gaussian under it, and an amplitude 17 % above the plateau: what the paper's steps do."""
    light = spot.top_hat(gaussian(240, 1000.0, 120, 120, 15.0), 1000.0)
    fit = fit_spot(light, 1e-4, None)
    # Numbers of paper-notes to their last digit; a closed form is not known.
    assert fit.value[7] / 15 == pytest.approx(1.043, abs=1e-3)
    assert fit.value[0] / (1000 * spot.TOP_HAT_LEVEL) == pytest.approx(1.17, abs=0.01)


def stationary(data, fit) -> float:
    """How far, in standard errors of white noise, a Gauss–Newton step from the fit would still go (0 at a minimum)."""
    known = np.isfinite(data)
    theta = fit.value[:7]
    columns = []
    for k in range(7):
        h = 1e-6 * max(abs(theta[k]), 1.0) * (np.arange(7) == k)
        columns.append(((image_of(theta + h) - image_of(theta - h)) / (2 * h[k]))[known])
    jac = np.array(columns)
    residual = (data - image_of(theta))[known]
    covariance = np.linalg.pinv(jac @ jac.T, rcond=1e-12) * (residual @ residual) / residual.size
    step = np.linalg.pinv(jac @ jac.T, rcond=1e-12) @ (jac @ residual)
    return float(np.max(np.abs(step) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))))


HARD = {
    "noise": lambda s: noisy(np.zeros((SIDE, SIDE)), s).astype(float),
    "two spots": lambda s: noisy(gaussian(SIDE, 500, 12, 15, 4) + gaussian(SIDE, 480, 38, 36, 4), s).astype(float),
    "in a corner": lambda s: noisy(gaussian(SIDE, 500, 1, 2, 5), s).astype(float),
    "beyond the border": lambda s: noisy(gaussian(SIDE, 900, -6, 25, 6), s).astype(float),
    "wider than the crop": lambda s: noisy(gaussian(SIDE, 500, 25, 25, 70), s).astype(float),
    "one pixel": lambda s: noisy(gaussian(SIDE, 700, 25, 25, 0.3), s).astype(float),
    "hot pixels": lambda s: np.where(np.random.default_rng(s).random((SIDE, SIDE)) < 1e-2, 1023.0, 40.0),
    "a ramp": lambda s: noisy(8.0 * X, s).astype(float),
}


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("seed", range(4))
def test_never_converged_away_from_a_minimum(name, seed):
    """Status 0 means a minimum with the centre on the crop; anything else is flagged and holds no false number."""
    data = HARD[name](seed)
    fit = fit_spot(data, 1e-4, SENSOR)
    if fit.status & flag("not_converged"):
        assert np.isnan(fit.value).all()
        return
    assert fit.status in (0, flag("at_limit"))
    if fit.status == 0:
        # 1e-2: a hundredth of a standard error is no visible distance from a minimum.
        assert stationary(data, fit) < 1e-2
        assert 0 <= fit.value[1] < SIDE and 0 <= fit.value[2] < SIDE and fit.value[0] > 0


@pytest.mark.parametrize("value", [0.0, 40.0, np.nan])
def test_nothing_to_fit(value):
    """A uniform crop, and one of gaps, are not fitted."""
    assert fit_spot(np.full((SIDE, SIDE), value), 1e-4, SENSOR).status == flag("not_converged")


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_an_overexposed_crop_ends_in_a_flag(part):
    """Full scale over a part of the crop: whatever comes out, no exception."""
    data = np.full((SIDE, SIDE), 300.0)
    data[: int(part * SIDE)] = 1023.0
    fit = fit_spot(data, 1e-4, SENSOR)
    assert fit.status != 0 or np.isfinite(fit.value).all()
