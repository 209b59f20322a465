"""Densities, Fisher information and bounds: sums over counts, closed forms, and a bound that an estimator meets."""

import math

import numpy as np
import pytest
from scipy.stats import norm, poisson

from spotcheck.fitting import bounds, fisher
from spotcheck.model.baseline import jacobian
from spotcheck.model.spot import elliptical_gaussian
from spotcheck.sensor import SensorModel

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


def exact_information(mean: float, read: float) -> float:
    """E[(∂ ln ρ/∂ν)²] of Poisson plus normal, by quadrature between neighbouring counts."""
    k = np.arange(max(0, int(mean - 9 * math.sqrt(mean) - 12)), int(mean + 9 * math.sqrt(mean) + 12))
    p = poisson.pmf(k, mean)
    # Counts lie on the grid, so that density and slope are counts convolved with the noise, of which 9 σ are enough.
    fine = math.ceil(12 / min(read, 1.0))
    reach = math.ceil(9 * read * fine)
    noise = norm.pdf(np.arange(-reach, reach + 1) / fine, 0.0, read)
    on_grid = np.zeros((2, (len(k) - 1) * fine + 1))
    on_grid[:, ::fine] = p, p * (k / mean - 1)
    density, slope = (np.convolve(own, noise) for own in on_grid)
    good = density > 1e-280
    return float(np.sum(slope[good] ** 2 / density[good]) / fine)


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
    got = bounds.compute_peak_bounds(peak, sigma, 1e-4, sensor, side)
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
    clean = bounds.compute_peak_bounds(500.0, 6.0, 1e-4, SensorModel(0.11, 0.0), 61)[0]
    for worse in (SensorModel(0.11, 5.0), SensorModel(0.11, 0.0, 1e5)):
        assert (bounds.compute_peak_bounds(500.0, 6.0, 1e-4, worse, 61)[0] > 1.01 * clean).all()


def ellipse(side: int):
    """Mean electrons of an elliptical Gaussian with offset over side × side pixels, as a function of all seven."""
    pixel = np.arange(side, dtype=float) - side // 2
    return lambda *theta: elliptical_gaussian(pixel[None, :], pixel[:, None], *theta)


def test_bounds_of_an_isolated_elliptical_gaussian():
    """Eq. 38 for six parameters against closed forms without background, N = 2π σ_1 σ_2 A electrons.

    var x = (C)_xx/N with C the spot's covariance; var σ_k = σ_k²/2N; var A = 2A²/N; var φ = (σ_1 σ_2/(σ_1² − σ_2²))²/N:
    each photon's place is a draw of the normal law C, and the sample's moments are efficient for it.
    """
    peak, major, minor, turn = 400.0, 8.0, 5.0, 0.6
    at = (peak, 0.2, -0.3, major, minor, turn)
    matrix = fisher.information_of_mean(ellipse(161), at, lambda mean: 1 / np.maximum(mean, 1e-290))
    electrons = 2 * math.pi * major * minor * peak
    c, s = math.cos(turn), math.sin(turn)
    want = [
        2 * peak**2,
        c * c * major**2 + s * s * minor**2,
        s * s * major**2 + c * c * minor**2,
        major**2 / 2,
        minor**2 / 2,
        (major * minor / (major**2 - minor**2)) ** 2,
    ]
    # The border is 10 σ away and σ ≥ 5 px: sampling and truncation are below 1e-20 of the light.
    np.testing.assert_allclose(fisher.cramer_rao_bounds(matrix), np.array(want) / electrons, rtol=1e-6)


# picassosr 0.11.3, picasso.fitting.precision._gauss_crlb(rotated=True): standard deviations of photons, x, y, σ_1, σ_2,
# background and angle for 18000 photons in 61 × 61 px, centre (30, 30), widths 6 and 4 px, background 3, angle 0.5 rad;
# then with a read-out variance of 4 e-².
PICASSO = {
    0.0: [144.93001376, 0.047029758344, 0.038088051838, 0.041016720941, 0.027344487455, 0.031988214822, 0.011200294925],
    2.0: [156.14473599, 0.050988541255, 0.041294156526, 0.046563750028, 0.031042506139, 0.048395112093, 0.012649351963],
}


@pytest.mark.parametrize("read", list(PICASSO))
def test_bounds_of_another_package(read):
    """Eq. 38: all seven bounds of a rotated Gaussian as picasso prints them, to the digits that were written down."""
    pixel = np.arange(61.0)

    def mean(photons, x, y, one, two, background, angle):
        peak = photons / (2 * np.pi * one * two)
        return elliptical_gaussian(pixel[None, :], pixel[:, None], peak, x, y, one, two, angle, background)

    at = (18000.0, 30.0, 30.0, 6.0, 4.0, 3.0, 0.5)
    # Its law is the shifted Poisson one: 1/(ν + σ²).
    matrix = fisher.information_of_mean(mean, at, lambda nu: 1 / (nu + read**2))
    np.testing.assert_allclose(np.sqrt(fisher.cramer_rao_bounds(matrix)), PICASSO[read], rtol=1e-6)
    # The law of a reading, for a fine converter far from its clips, has no less information, and not much more.
    sensor = SensorModel(10.0, read, black_level_dn=500.0)
    exact = np.sqrt(
        fisher.cramer_rao_bounds(
            fisher.information_of_mean(mean, at, lambda nu: fisher.reading_information(nu, sensor))
        )
    )
    # 2 %: the background of three electrons is where read noise and Poisson noise are not yet one normal law.
    np.testing.assert_allclose(exact, PICASSO[read], rtol=0.02)


@pytest.mark.parametrize("excess", [-4.0, -1.0, 0.0, 1.0, 2.5])
def test_information_of_a_reading_at_full_scale(excess):
    """Censored normal law with mean `excess` standard deviations above full scale: (Φ(a) − φ(a)(a − φ(a)/Q(a)))/s².

    Cohen (1959), Technometrics 1, 217: information on the mean of a singly censored sample.
    """
    gain, noise, mean = 0.5, 4.0, 6000.0
    s = math.sqrt(mean + noise**2 + 1 / 12 / gain**2)
    full_scale = round(gain * (mean - excess * s))
    a = ((full_scale - 0.5) / gain - mean) / s
    want = (norm.cdf(a) - norm.pdf(a) * (a - norm.pdf(a) / norm.sf(a))) / s**2
    got = fisher.reading_information(np.array([mean]), SensorModel(gain, noise, full_scale_dn=full_scale))
    assert float(got[0]) == pytest.approx(want, rel=1e-9)


def test_clipping_never_adds_information():
    """A reading that is clipped, at black, at full scale or at the well, knows no more than one that is not."""
    mean = np.concatenate([np.linspace(0.0, 60.0, 121), np.geomspace(60, 20000, 200)])
    free = fisher.reading_information(mean, SensorModel(0.11, 13.0, black_level_dn=50.0))
    for clipped, at, most in (
        (SensorModel(0.11, 13.0), 0, 0.8),
        (SensorModel(0.11, 13.0, black_level_dn=50.0, full_scale_dn=1023.0), -1, 1e-3),
        (SensorModel(0.11, 13.0, black_level_dn=50.0, full_well_e=8000.0), -1, 1e-3),
    ):
        got = fisher.reading_information(mean, clipped)
        # 1 %: where black clips, the free law counts rounding as 1/12 DN² and the table does not.
        assert (got <= 1.01 * free).all() and (got >= 0).all()
        assert got[at] < most * free[at]


def test_information_on_parameters_of_the_sensor():
    """Slepian–Bangs for N readings of one mean: var(σ²) ≥ 2σ⁴/N for the variance, and V/N for the mean."""
    count, noise = 5000, 9.0
    one, none = np.ones(count), np.zeros(count)
    matrix = fisher.information_of_moments(noise * one, np.stack([one, none]), np.stack([none, one]))
    np.testing.assert_allclose(fisher.cramer_rao_bounds(matrix), [noise / count, 2 * noise**2 / count], rtol=1e-12)
