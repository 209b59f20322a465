"""Densities, Fisher information and bounds: sums over counts, closed forms, and a bound that an estimator meets."""

import math

import numpy as np
import pytest
from scipy import integrate
from scipy.stats import norm, poisson

from spotcheck.estimate import bounds, fisher
from spotcheck.model.baseline import jacobian
from spotcheck.model.sensor import SensorModel
from tests.library.conftest import gaussian

MEANS = [0.3, 4.0, 60.0]


def counts_of(mean: float) -> np.ndarray:
    """Counts that hold all but 1e-15 of a Poisson law."""
    return np.arange(0, int(mean + 12 * math.sqrt(mean) + 30))


@pytest.mark.parametrize("mean", MEANS)
@pytest.mark.parametrize(("read", "shift"), [(0.7, 0.0), (3.0, 0.0), (3.0, 0.5)])
def test_density_with_read_noise(mean, read, shift):
    """Eq. 30 integrates to 1, with mean ν + µ_q and variance ν + σ_q²."""
    spread = 10 * math.sqrt(mean + read**2) + 5
    z = np.linspace(mean - spread, mean + spread, 4001)
    density = np.exp(fisher.log_density(z, mean, read, shift))
    total, first = np.trapezoid(density, z), np.trapezoid(density * z, z)
    second = np.trapezoid(density * (z - first) ** 2, z)
    # Trapezoids of a sum of Gaussians that are wider than 20 steps are exact; beyond 10 sd lies < 1e-8 (Poisson tail).
    assert (total, first, second) == pytest.approx((1, mean + shift, mean + read**2), rel=1e-6)


def test_density_with_read_noise_is_the_sum_it_says():
    """Eq. 30 at one point, as a plain sum of Poisson weights times normal densities."""
    z, mean, read = 5.3, 6.0, 1.5
    want = sum(math.exp(-mean) * mean**k / math.factorial(k) * norm.pdf(z - k, scale=read) for k in range(60))
    assert math.exp(float(fisher.log_density(z, mean, read))) == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize("mean", MEANS)
def test_density_of_counts(mean):
    """Eq. 31 against scipy's Poisson law; it sums to 1 with mean and variance ν."""
    k = counts_of(mean)
    p = np.exp(fisher.log_density_poisson(k, mean))
    np.testing.assert_allclose(p, poisson.pmf(k, mean), rtol=1e-9)
    assert (p.sum(), p @ k, p @ (k - mean) ** 2) == pytest.approx((1, mean, mean), rel=1e-9)


@pytest.mark.parametrize("mean", MEANS)
def test_score_and_information_of_a_count(mean):
    """Eqs. 35 and 36: S is the squared derivative of ln ρ; its mean, which is the score's variance, is 1/ν."""
    k, p = counts_of(mean), poisson.pmf(counts_of(mean), mean)
    step = 1e-5 * mean
    slope = (fisher.log_density_poisson(k, mean + step) - fisher.log_density_poisson(k, mean - step)) / (2 * step)
    np.testing.assert_allclose(fisher.score_squared(k, mean), slope**2, rtol=1e-5, atol=1e-8)
    assert p @ slope == pytest.approx(0, abs=1e-7 / mean)  # a score has mean 0, so E[S] is its variance
    assert p @ fisher.score_squared(k, mean) == pytest.approx(1 / mean, rel=1e-9)
    assert fisher.poisson_information(mean) == pytest.approx(1 / mean, rel=1e-15)


def pixel(theta) -> complex:
    """Mean electrons of one pixel off the centre of a Gaussian, for θ = (peak, σ)."""
    return theta[0] * np.exp(-9 / (2 * theta[1] ** 2)) + 0.5


def test_three_forms_of_the_information_agree():
    """Eqs. 32–34 and 37 for one Poisson pixel: curvature, scores and slopes over ν, summed over every count."""
    theta = np.array([20.0, 4.0])
    mean = float(pixel(theta))
    k = counts_of(mean)
    p = poisson.pmf(k, mean)

    def log_density(a, s):
        value = pixel((a, s))
        return k * np.log(value) - value

    scores = jacobian(log_density, theta)
    second = np.empty((2, 2, k.size))
    for j in range(2):  # derivative of the exact score: central difference, relative error h²
        h = 1e-4 * theta[j] * (np.arange(2) == j)
        second[:, j] = (jacobian(log_density, theta + h) - jacobian(log_density, theta - h)) / (2 * h[j])
    from_slopes = fisher.information(jacobian(lambda a, s: np.array([pixel((a, s))]), theta), np.array([1 / mean]))
    np.testing.assert_allclose(fisher.information_from_scores(scores, p), from_slopes, rtol=1e-10)
    np.testing.assert_allclose(fisher.information_from_curvature(second, p), from_slopes, rtol=1e-6, atol=1e-9)


def test_information_adds_over_pixels():
    """Eqs. 33, 34 and 37: an image's information is the sum of its pixels'."""
    rng = np.random.default_rng(2)
    slopes, mean = rng.normal(size=(3, 5, 4)), rng.uniform(1, 9, (5, 4))
    whole = fisher.information(slopes, fisher.poisson_information(mean))
    each = sum(np.outer(slopes[:, i, j], slopes[:, i, j]) / mean[i, j] for i in range(5) for j in range(4))
    np.testing.assert_allclose(whole, each, rtol=1e-12)
    # A mean in DN in the same law: K² from the slopes, 1/K from the mean.
    in_dn = fisher.information_in_dn(0.11 * slopes, 0.11 * mean)
    np.testing.assert_allclose(in_dn, 0.11 * whole, rtol=1e-12)


def exact_information(mean: float, read: float) -> float:
    """E[(∂ ln ρ/∂ν)²] of Poisson plus normal, by quadrature between neighbouring counts."""
    k = np.arange(max(0, int(mean - 9 * math.sqrt(mean) - 12)), int(mean + 9 * math.sqrt(mean) + 12))
    p = poisson.pmf(k, mean)
    step = min(read, 1.0) / 12
    z = np.arange(k[0] - 8 * read, k[-1] + 8 * read, step)
    kernel = norm.pdf(z[:, None], k, read)
    density, slope = kernel @ p, kernel @ (p * (k / mean - 1))
    good = density > 1e-280
    return float(np.sum(slope[good] ** 2 / density[good]) * step)


@pytest.mark.parametrize(
    ("mean", "read"),
    [(m, r) for r in (0.5, 1.0, 2.5, 13.0) for m in (0.01, 1.0, 37.0, 900.0)]
    + [(1e4, 0.3), (1e4, 0.5), (0.001, 0.1), (0.03, 0.06)],
)
def test_information_with_read_noise(mean, read):
    """Eqs. 30 and 34: information of a mean under read noise, against a finer quadrature; never above 1/ν.

    2 %: linear interpolation between nodes a factor 1.33 apart, of a ratio that bends where ν passes σ².
    """
    got = float(fisher.read_noise_information(np.array([mean]), read)[0])
    assert got <= 1 / mean * (1 + 1e-6)
    assert got == pytest.approx(exact_information(mean, read), rel=0.02)


@pytest.mark.parametrize("sigma", [3.0, 10.0])
@pytest.mark.parametrize("efficiency", [1.0, 0.38])
def test_bounds_of_an_isolated_gaussian(sigma, efficiency):
    """Eq. 38 against the closed form without background: var σ ≥ σ²/4N and var A ≥ 2A²/N, N = 2πσ² η A electrons.

    I_AA = N/A², I_Aσ = 2N/(Aσ), I_σσ = 8N/σ², from E[r²] = 2σ² and E[r⁴] = 8σ⁴; then invert.
    """
    peak, side = 500.0, 2 * int(9 * sigma) + 1
    sensor = SensorModel(0.11, 0.0, 0.0, quantum_efficiency=efficiency)
    got = bounds.peak_bounds(peak, sigma, 1e-4, sensor, side)
    electrons = 2 * math.pi * sigma**2 * efficiency * peak
    want = np.array([2 * peak**2 / electrons, sigma**2 / (4 * electrons)])
    # σ ≥ 3 px: samples sum to integrals within 2 exp(−2π²·9); the border is 9 σ away.
    np.testing.assert_allclose(got[1], want, rtol=1e-6)
    # No read noise is the same law, but that means below 1e-3 e- count as 1e-3: they hold about that part of σ's bound.
    np.testing.assert_allclose(got[0], want, rtol=1e-3)
    # The paper's law: a mean in DN has K times the information, 1/K times the variance.
    np.testing.assert_allclose(got[2], want / 0.11, rtol=1e-6)


def test_read_noise_and_dark_current_cost_information():
    """Eq. 38: each nuisance widens both bounds."""
    clean = bounds.peak_bounds(500.0, 6.0, 1e-4, SensorModel(0.11, 0.0), 61)[0]
    for worse in (SensorModel(0.11, 5.0), SensorModel(0.11, 0.0, 1e5)):
        assert (bounds.peak_bounds(500.0, 6.0, 1e-4, worse, 61)[0] > 1.01 * clean).all()


def test_an_estimator_meets_the_bound():
    """Eq. 38: the mean of Poisson counts, the efficient estimator of ν, scatters by just the bound over 4000 trials."""
    mean, pixels, trials = 40.0, 25, 4000
    matrix = fisher.information(np.ones((1, pixels)), fisher.poisson_information(np.full(pixels, mean)))
    estimates = np.random.default_rng(9).poisson(mean, (trials, pixels)).mean(axis=1)
    # Standard error of a variance √(2/n); five of them: false alarm 6e-7.
    assert estimates.var() == pytest.approx(fisher.bounds(matrix)[0], rel=5 * math.sqrt(2 / trials))


def test_bounds_are_the_diagonal_of_the_inverse():
    """Eq. 38 by hand for a 2 × 2 matrix: I_22/det and I_11/det."""
    np.testing.assert_allclose(fisher.bounds(np.array([[4.0, 2.0], [2.0, 3.0]])), [3 / 8, 4 / 8], rtol=1e-12)


def test_information_of_a_gaussian_by_integral():
    """Eq. 37: the sum over pixels is the integral 2π ∫ (r²/σ³)² ν r dr for σ, with its closed value 8N/σ²."""
    sigma, peak = 5.0, 30.0
    light = gaussian(101, peak, 50, 50, sigma)
    slopes = jacobian(lambda s: peak * np.exp(-R2 / (2 * s * s)), (sigma,))
    got = fisher.information(slopes, 1 / np.maximum(light, 1e-300))[0, 0]
    whole, _ = integrate.quad(
        lambda r: 2 * np.pi * r * (r**2 / sigma**3) ** 2 * peak * np.exp(-(r**2) / 2 / sigma**2), 0, 60
    )
    assert got == pytest.approx(whole, rel=1e-6) and got == pytest.approx(8 * 2 * np.pi * peak, rel=1e-6)


R2 = (np.mgrid[-50:51, -50:51] ** 2).sum(axis=0)
