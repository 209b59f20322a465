"""The library's numeric bound of an isolated Gaussian against its closed form, for photons without background."""

import numpy as np

from spotcheck.fitting import fisher
from spotcheck.model.baseline import jacobian
from spotcheck.model.spot import circular_gaussian, elliptical_gaussian
from tests.validation.benchmarks.table import Figure, Limit, Part

# A frame that reaches this many widths cuts off 1e-13 of the light, and no mean in it is too small for a double.
REACH = 8.0


def circular(truth) -> np.ndarray:
    """Variances of amplitude, x, y, σ: N = 2π A σ² electrons give 2A²/N, σ²/N, σ²/N, σ²/4N."""
    amplitude, _, _, sigma = truth
    electrons = 2 * np.pi * amplitude * sigma**2
    return np.array([2 * amplitude**2, sigma**2, sigma**2, sigma**2 / 4]) / electrons


def elliptical(truth) -> np.ndarray:
    """Variances of amplitude, x, y, both σ, orientation.

    The centre has the spot's own covariance over N, each width σ²/2N; a turn moves the covariance by the difference of
    both variances, which gives σ₁² σ₂² / (N (σ₁² − σ₂²)²).
    """
    amplitude, _, _, major, minor, orientation = truth
    electrons = 2 * np.pi * amplitude * major * minor
    cos, sin = np.cos(orientation), np.sin(orientation)
    x, y = (major * cos) ** 2 + (minor * sin) ** 2, (major * sin) ** 2 + (minor * cos) ** 2
    turn = (major * minor / (major**2 - minor**2)) ** 2
    return np.array([2 * amplitude**2, x, y, major**2 / 2, minor**2 / 2, turn]) / electrons


def numeric(shape, truth, widest: float) -> np.ndarray:
    """Variances from the library: derivatives by complex step, Poisson information, inverse."""
    half = int(np.ceil(REACH * widest))
    x, y = np.arange(-half, half + 1.0)[None, :], np.arange(-half, half + 1.0)[:, None]
    derivatives = jacobian(lambda *theta: shape(x, y, *theta), truth)
    return fisher.cramer_rao_bounds(fisher.information(derivatives, fisher.poisson_information(shape(x, y, *truth))))


def measure() -> Part:
    """Largest relative difference of a variance, over some spots of either kind."""
    round_spots = ((9091.0, 0.3, -0.2, 15.0), (50.0, 0.0, 0.5, 3.0), (1e4, -0.4, 0.1, 40.0))
    ellipses = ((9091.0, 0.3, -0.2, 17.0, 14.0, 0.7), (50.0, 0.1, 0.5, 9.0, 3.0, 2.5))
    figures = []
    for name, shape, exact, truths in (("circular", circular_gaussian, circular, round_spots),
                                       ("elliptical", elliptical_gaussian, elliptical, ellipses)):  # fmt: skip
        ratios = [numeric(shape, truth, truth[3]) / exact(truth) for truth in truths]
        largest = float(np.max(np.abs(np.concatenate(ratios) - 1)))
        title = f"{name} spot: largest difference of a variance"
        figures.append(Figure(title, largest, f"{largest:.1e}", Limit("≤", 1e-6)))
    return Part("Bound of an isolated Gaussian against its closed form", figures)
