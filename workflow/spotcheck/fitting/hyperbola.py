"""The hyperbola through radii of a beam at several distances: waist, divergence, Rayleigh length and M² (ISO 11146-1).

ISO 11146-1:2021, clause 9, fits d²(z) = a + b z + c z² to beam diameters d at distances z along the beam. This module
fits w²(z) with the radius w = d/2 = 2σ, the 1/e² radius of a Gaussian. Its coefficients are a quarter of those of the
standard.
"""

from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from spotcheck.model.baseline import jacobian

# Coefficients of the hyperbola.
COEFFICIENTS = 3
# Confidence level of the intervals of the file and the figure.
LEVEL = 0.6827
# Least relative scatter [1] of the radii, which stands for 0, and the largest that is tried.
LEAST_SCATTER, LARGEST_SCATTER = 1e-9, 10.0
# Iterations of the weights, which follow the fitted curve.
MAX_ITERATIONS = 20
# Least fitted w² in the weights, as a fraction of the measured one: a fitted hyperbola may fall below 0.
LEAST_SQUARE = 1e-6
# Parameters of a beam: name, unit and description.
QUANTITIES = {
    "waist_radius": ("m", "1/e2 radius w0 at the waist"),
    "waist_position": ("m", "distance z0 of the waist"),
    "divergence": ("rad", "half-angle of divergence theta"),
    "rayleigh_length": ("m", "Rayleigh length z_R"),
    "m2": ("1", "beam propagation ratio M2"),
}


@dataclass(frozen=True, eq=False)
class Hyperbola:
    """The fitted squared radius w²(z) = a + b (z − origin) + c (z − origin)²."""

    origin: float  # distance that the coefficients count from [m]
    coefficients: np.ndarray  # a, b, c [m², m, 1]
    covariance: np.ndarray  # covariance of the coefficients [3, 3], by the errors of the radii and their scatter
    scatter: float  # relative scatter of the radii in addition to their errors [1]
    chi2_reduced: float  # χ² per degree of freedom by the errors of the radii alone
    degrees: int  # degrees of freedom, points less three

    def radius(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return w and its standard error [m] at distances z [point] in m; NaN where w² is not positive."""
        powers = np.vander(z - self.origin, COEFFICIENTS, increasing=True)
        square = powers @ self.coefficients
        square_stderr = np.sqrt(np.einsum("ij,jk,ik->i", powers, self.covariance, powers))
        radius = np.sqrt(np.where(square > 0, square, np.nan))
        return radius, square_stderr / (2 * radius)


def fit_hyperbola(z: np.ndarray, radius: np.ndarray, stderr: np.ndarray) -> Hyperbola:
    """Fit the squared radius w² over z by weighted least squares.

    If the points scatter by more than their errors, one relative scatter of w is added in quadrature to all errors so
    that χ² per degree of freedom becomes 1. Weights follow the fitted curve, not the points: a point that is low by
    chance must not weigh more.

    Parameters
    ----------
    z : distances [point] in m.
    radius, stderr : radii w and their standard errors [point] in m.
    """
    origin = float(np.mean(z))
    powers = np.vander(z - origin, COEFFICIENTS, increasing=True)
    degrees_of_freedom = len(z) - COEFFICIENTS
    square = radius**2

    def fit_with_scatter(scatter: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return coefficients [3], their covariance, and χ² per degree of freedom for a relative scatter of w."""
        fitted_square = square
        for _ in range(MAX_ITERATIONS):
            # Standard deviation of w²: 2 w times that of w.
            sd = 2 * np.sqrt(fitted_square) * np.hypot(stderr, scatter * np.sqrt(fitted_square))
            weighted = powers / sd[:, None]
            covariance = np.linalg.inv(weighted.T @ weighted)
            coefficients = covariance @ weighted.T @ (square / sd)
            previous, fitted_square = fitted_square, np.maximum(powers @ coefficients, LEAST_SQUARE * square)
            if np.allclose(previous, fitted_square, rtol=1e-12, atol=0):
                break
        chi2 = np.sum(((square - powers @ coefficients) / sd) ** 2)
        return coefficients, covariance, float(chi2 / degrees_of_freedom)

    # The least scatter instead of 0 keeps weights finite for points without an error.
    coefficients, covariance, chi2_reduced = fit_with_scatter(LEAST_SCATTER)
    scatter = 0.0
    if chi2_reduced > 1:
        # χ² falls with the scatter over many decades: the root of ln χ² is sought over ln scatter.
        ends = np.log(LEAST_SCATTER), np.log(LARGEST_SCATTER)
        scatter = float(np.exp(optimize.brentq(lambda ln_s: np.log(fit_with_scatter(np.exp(ln_s))[2]), *ends)))
        coefficients, covariance, _ = fit_with_scatter(max(scatter, LEAST_SCATTER))
    return Hyperbola(origin, coefficients, covariance, scatter, chi2_reduced, degrees_of_freedom)


def derive_beam_parameters(fit: Hyperbola, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the values [5] and covariance [5, 5] of `QUANTITIES`; all NaN if the hyperbola has no waist.

    With D = 4ac − b²: w0² = D/(4c), z0 = −b/(2c), θ = √c, z_R = √D/(2c), M² = π w0 θ/λ = π √D/(2λ).
    """

    def derive(a, b, c):
        """Return the values [5]."""
        root, theta = np.sqrt(4 * a * c - b * b), np.sqrt(c)
        waist_position = fit.origin - b / (2 * c)
        return np.array([root / (2 * theta), waist_position, theta, root / (2 * c), np.pi * root / (2 * wavelength_m)])

    a, b, c = fit.coefficients
    if not (c > 0 and 4 * a * c - b * b > 0):
        return np.full(len(QUANTITIES), np.nan), np.full((len(QUANTITIES),) * 2, np.nan)
    # Derivatives of the values by a, b, c [coefficient, value].
    slopes = jacobian(derive, fit.coefficients)
    return derive(a, b, c), slopes.T @ fit.covariance @ slopes


def compute_interval_half_width(stderr: np.ndarray, degrees: int) -> np.ndarray:
    """Return half of the 68 % interval: the standard error times Student's t of the degrees of freedom.

    The few points of a scan estimate the scatter about the hyperbola, hence Student's t.
    """
    return stderr * stats.t.ppf((1 + LEVEL) / 2, degrees)
