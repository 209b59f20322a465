"""A learned light shape compared with the declared one: the power that lies elsewhere, its pattern and its noise.

A shape is the light of a spot over its peak at places u, v [σ] from its centre. Brightness, width and centre of a shape
cannot be told from those of each frame's spot. The learned shape S is therefore described in the gauge (brightness A,
width w and centre a, b) in which it is nearest to the declared shape B. The difference of both is
d(u, v) = S(w u + a, w v + b)/A − B(u, v). All arrays [ring, direction] are values on a polar grid about the centre. A
`Baseline` is a model of the light: `spot(u, v, peak, σ)` is its light, and `learned` the learned difference S − B.

Unknowns of the fit are the coefficients of the learned shape, the spot parameters of the frames (ln peak, ln σ_g, x, y)
and the fitted parameters of sensor and effects. In the normal equations of a fit, `shape.factor` is the Cholesky factor
L of the information on the coefficients; it solves with L (`half_solve`) and with L' (`back_solve`). The frames of a
site share angle, declared conditions and repeat.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg, ndimage, optimize

from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.discrepancy.evaluation import differentiate_readings, evaluate, map_batches
from spotcheck.discrepancy.evidence import MANY_SITES
from spotcheck.discrepancy.findings import LearnedLight
from spotcheck.discrepancy.frames import SPOT_PARAMETERS
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import NULL_EIGENVALUE, solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.discrepancy.words import percent_text
from spotcheck.model.baseline import Baseline
from spotcheck.model.light_shape import LightShape

# Distance of the rings of the polar grid [σ], about half the distance of the nodes; and places on each ring.
RING_STEP, DIRECTIONS = 0.065, 256
# Draws of the coefficients: they give standard errors to 1 part in 11.
DRAWS = 64
# Azimuthal orders that are reported, from 0 on. Order k of d varies as cos k φ around a ring.
ORDERS = 9
# Power of d is clear of noise where it exceeds CLEAR_POWER times that of noise; both are means over rings within about
# NEARBY [σ].
CLEAR_POWER, NEARBY = 2.0, 0.5
# Error of the correction for noise, relative to the mean absolute noise: in simulated fits it is off by 0.04.
BIAS_ERROR = 0.1
# Least upper limit of the power that is stated, as a fraction of the light.
LEAST_LIMIT = 1e-5
# Share of ∫d² that one azimuthal order must have to be called the pattern.
MAJORITY = 0.5
# Steps of width [1] and centre [σ] in the derivatives of the declared shape.
GAUGE_STEP = 1e-4
# Number of lobes in words, by azimuthal order; orders 0 and 1 have other words.
LOBES = ("", "", "two", "three", "four", "five", "six", "seven", "eight")


@dataclass(frozen=True)
class PolarGrid:
    """Places about the centre of a spot, on equally spaced rings of `DIRECTIONS` places each."""

    rings: int  # number of rings

    @cached_property
    def radius(self) -> np.ndarray:
        """Radius of each ring [ring, 1] in σ."""
        return RING_STEP * (np.arange(self.rings)[:, None] + 0.5)

    @cached_property
    def u(self) -> np.ndarray:
        """Horizontal position of each place [ring, direction] in σ."""
        return self.radius * np.cos(2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)

    @cached_property
    def v(self) -> np.ndarray:
        """Vertical position of each place [ring, direction] in σ."""
        return self.radius * np.sin(2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)

    @cached_property
    def area(self) -> np.ndarray:
        """Area that each place represents in integrals [ring, 1] in σ²."""
        return self.radius * RING_STEP * 2 * np.pi / DIRECTIONS

    def mean_nearby(self, squares: np.ndarray) -> np.ndarray:
        """Return squares [draw, ring, order] averaged over draws and nearby rings, times the radius [ring, order].

        The radius weights rings by area. It cancels in ratios, the only use of the result. Values are above 0.
        """
        smooth = ndimage.gaussian_filter1d(self.radius * squares.mean(axis=0), NEARBY / RING_STEP, axis=0)
        return np.maximum(smooth, 1e-300)


@dataclass(frozen=True)
class Gauge:
    """Brightness, width and centre of a shape, relative to the declared one."""

    brightness: float = 1.0  # A, relative to the peak of the declared shape
    width: float = 1.0  # w [σ]
    u: float = 0.0  # a, horizontal position of the centre [σ]
    v: float = 0.0  # b, vertical position of the centre [σ]

    def places_of(self, grid: PolarGrid) -> tuple[np.ndarray, np.ndarray]:
        """Return (w u + a, w v + b), the places of a grid scaled and moved to this gauge [ring, direction] in σ."""
        return self.width * grid.u + self.u, self.width * grid.v + self.v

    def shape_of(self, baseline: Baseline, grid: PolarGrid) -> np.ndarray:
        """Return the shape of a baseline with this brightness, width and centre on a grid [ring, direction]."""
        return baseline.spot(grid.u - self.u, grid.v - self.v, self.brightness, self.width)


def describe_light(fit: JointFit, declared: Baseline | None = None, seed: int = 0) -> LearnedLight:
    """Compare the learned light shape of a fit with the declared one.

    Parameters
    ----------
    fit : JointFit
        Fit whose model has a free light shape.
    declared : Baseline, optional
        Baseline with the declared shape; by default that of the fit without its learned shape.
    seed : int
        Seed of the draws from which noise is measured.

    Returns
    -------
    LearnedLight
        Its power is corrected for noise: without a difference it scatters about 0. `orders` are 0 unless the power is
        above `CLEAR_ERRORS` standard errors. Widths and direction are those of the second moments of S.
    """
    baseline = fit.model.forward.baseline
    shape = baseline.learned
    assert shape is not None
    declared = replace(baseline, learned=None) if declared is None else declared
    grid = PolarGrid(int(shape.step * (len(shape.coefficients) - 1) / 2 / RING_STEP))
    gauge = fit_gauge(baseline, declared, grid, find_covered(fit, grid.u, grid.v))
    u, v = gauge.places_of(grid)
    # The learned shape is taken to be the declared one at places where no frame has pixels.
    is_covered = find_covered(fit, u, v)
    declared_shape = Gauge().shape_of(declared, grid)
    light = np.where(is_covered, baseline.spot(u, v, 1.0, 1.0) / gauge.brightness, declared_shape)
    noise = draw_noise(fit, gauge, grid, np.random.default_rng(seed)) * is_covered
    # The fit of the gauge has removed this part of the noise from the difference as well.
    noise -= project_on_gauge(noise, declared, grid, is_covered)
    power, stderr = measure_power(light - declared_shape, noise, grid, float(np.sum(light * grid.area)))
    orders = measure_orders(light - declared_shape, noise, grid) if power > CLEAR_ERRORS * stderr else np.zeros(ORDERS)
    major, minor, direction_deg = measure_axes(light - noise.mean(axis=0), declared_shape, grid)
    words = describe_difference(power, stderr, orders, (major, minor, direction_deg))
    lowest = float(light.min())
    return LearnedLight(shape, power, stderr, tuple(map(float, orders)), major, minor, direction_deg, lowest, words)


def summarize_shape(light: LearnedLight) -> dict[str, Any]:
    """Return the attributes of light.nc that describe a learned light; numbers as in `LearnedLight`."""
    return {
        "described": light.words,
        "power": light.power,
        "power_stderr": light.stderr,
        "orders": np.array(light.orders),
        "major_over_sigma": light.major,
        "minor_over_sigma": light.minor,
        "direction_deg": light.direction_deg,
        "lowest": light.lowest,
    }


def find_covered(fit: JointFit, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return which places u, v [σ] lie in the rectangle of used pixels of at least one frame [ring, direction]."""
    pixels, spots = fit.pixels, fit.model.spots
    is_covered = np.zeros(u.shape, bool)
    for frame, sigma in enumerate(np.exp(spots.log_sigma)):
        used = pixels.is_used[frame]
        if used.any():
            x = (pixels.x[frame, 0, used.any(axis=0)] - spots.x[frame]) / sigma
            y = (pixels.y[frame, used.any(axis=1), 0] - spots.y[frame]) / sigma
            is_covered |= (u >= x.min()) & (u <= x.max()) & (v >= y.min()) & (v <= y.max())
    return is_covered


def fit_gauge(baseline: Baseline, declared: Baseline, grid: PolarGrid, is_covered: np.ndarray) -> Gauge:
    """Return the gauge in which the declared shape is nearest to the shape of a baseline, by ∫(S − A B)² on the grid.

    Places where `is_covered` [ring, direction] is False do not count.
    """
    light, weight = baseline.spot(grid.u, grid.v, 1.0, 1.0), np.sqrt(grid.area) * is_covered

    def gauge_of(values: np.ndarray) -> Gauge:
        """Return the gauge with the parameters `values`: ln A, ln w, a and b [4]."""
        return Gauge(float(np.exp(values[0])), float(np.exp(values[1])), float(values[2]), float(values[3]))

    def residual(values: np.ndarray) -> np.ndarray:
        """Return the weighted S − A B at all places [place]; `values` as above."""
        return (weight * (light - gauge_of(values).shape_of(declared, grid))).ravel()

    return gauge_of(optimize.least_squares(residual, np.zeros(4), xtol=1e-10, ftol=1e-12).x)


# Noise


def draw_noise(fit: JointFit, gauge: Gauge, grid: PolarGrid, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the noise of a learned shape in a gauge [draw, ring, direction].

    Their covariance is the inverse of the Fisher information. The frames of a site may share a field such as speckle,
    which adds scatter between sites. Azimuthal orders that scatter more between sites than this covariance allows are
    scaled up to the observed scatter. With fewer than `MANY_SITES` sites the draws are scaled to the residuals instead.

    Parameters
    ----------
    fit : JointFit
        Fit with the learned shape.
    gauge : Gauge
        Brightness, width and centre relative to which the shape is described.
    grid : PolarGrid
        Places [ring, direction] at which it is evaluated.
    rng : Generator
        Source of the random numbers.
    """
    shape = fit.model.forward.baseline.learned
    assert shape is not None
    u, v = gauge.places_of(grid)

    def noise_of(draws: np.ndarray) -> np.ndarray:
        """Return the shapes [draw, ring, direction] of draws of the coefficients [coefficient, draw]."""
        draws = draws.T.reshape(-1, *shape.coefficients.shape) / gauge.brightness
        return np.array([LightShape(shape.step, draw)(u, v) for draw in draws])

    noise = noise_of(draw_by_information(fit, rng))
    if fit.model.design.sites < MANY_SITES:
        return noise * np.sqrt(max(fit.equations.dispersion, 1.0))
    spectrum = np.fft.rfft(noise, axis=2)
    site_spectrum = np.fft.rfft(noise_of(draw_by_sites(fit, rng)), axis=2)
    power, site_power = (grid.mean_nearby(np.abs(draws) ** 2) for draws in (spectrum, site_spectrum))
    return np.fft.irfft(spectrum * np.sqrt(np.maximum(site_power / power, 1.0)), DIRECTIONS, axis=2)


def draw_by_information(fit: JointFit, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the shape's coefficients [coefficient, draw], with the inverse Fisher information as covariance.

    With the information L L' of the coefficients, L⁻¹C their cross terms with the n other unknowns and the information
    I of these beside the shape, a draw is L⁻ᵀ(z − L⁻¹C x), where z is standard normal and x has the covariance I⁻¹.
    """
    equations = fit.equations
    assert equations.shape is not None
    normal = rng.standard_normal((fit.model.coefficients.size, DRAWS))
    # Units differ by many orders of magnitude: I is scaled to a unit diagonal. Directions without information are not
    # drawn: their amounts stay 0.
    scale = 1 / np.sqrt(np.maximum(np.diag(equations.information), 1e-300))
    values, vectors = np.linalg.eigh(equations.information * scale[:, None] * scale)
    roots = np.where(values > NULL_EIGENVALUE, 1 / np.sqrt(np.maximum(values, NULL_EIGENVALUE)), 0.0)
    others = scale[:, None] * (vectors @ (roots[:, None] * rng.standard_normal((len(values), DRAWS))))
    return equations.shape.solve_coefficients(normal, others)


def draw_by_sites(fit: JointFit, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the shape's coefficients [coefficient, draw] with the cluster-robust covariance of sites.

    The score of a site moves the coefficients from their optimum by some change. A draw is the sum of these changes
    over the sites, each times a standard normal number (multiplier bootstrap).
    """
    model, equations = fit.model, fit.equations
    assert equations.shape is not None

    def score_frames(batch: slice) -> list[tuple[np.ndarray, list[float]]]:
        """Return the scores of each frame: of the coefficients, and of the fitted parameters of sensor and effects."""
        scores = []
        for frame in range(batch.start, batch.stop):
            evaluation = evaluate(model, fit.pixels, slice(frame, frame + 1), with_slopes=False)
            # A column holds the derivatives of mean and variance of the readings by one fitted parameter.
            parameter_scores = [evaluation.score(column) for column in differentiate_readings(model, evaluation)]
            scores.append((ShapeSums(model, evaluation).score(), parameter_scores))
        return scores

    frames = [frame for batch in map_batches(score_frames, fit.pixels) for frame in batch]
    site = np.unique(model.design.site, return_inverse=True)[1]
    is_of_site = np.equal.outer(np.arange(site.max() + 1), site).astype(float)
    shape_scores = is_of_site @ np.array([score for score, _ in frames])
    parameter_scores = is_of_site @ np.reshape([scores for _, scores in frames], (len(site), -1))
    # Scores of all unknowns but the coefficients [unknown, site]. Those of spots are 0 at the optimum.
    other_scores = np.zeros((equations.size, len(shape_scores)))
    other_scores[SPOT_PARAMETERS * equations.frame_count :] = parameter_scores.T
    # Solve the normal equations for each site, by elimination of the coefficients (see `normal_equations`).
    half = equations.shape.factor.half_solve(shape_scores.T)
    other_changes = solve_positive(equations.information, other_scores - equations.shape.multiply_transposed(half))
    changes = equations.shape.solve_coefficients(half, other_changes)
    changes -= changes.mean(axis=1, keepdims=True)
    sites = len(shape_scores)
    return changes @ (rng.standard_normal((sites, DRAWS)) * np.sqrt(sites / (sites - 1)))


def project_on_gauge(noise: np.ndarray, declared: Baseline, grid: PolarGrid, is_covered: np.ndarray) -> np.ndarray:
    """Return the part of noise [draw, ring, direction] that equals a change of brightness, width and centre.

    It is the least-squares projection on the derivatives of the declared shape by these four, weighted by area.
    """
    declared_shape = Gauge().shape_of(declared, grid)
    moved = (Gauge(width=1 + GAUGE_STEP), Gauge(u=GAUGE_STEP), Gauge(v=GAUGE_STEP))
    tangents = [declared_shape, *((gauge.shape_of(declared, grid) - declared_shape) / GAUGE_STEP for gauge in moved)]
    basis = np.multiply(tangents, is_covered)
    weighted = (basis * grid.area).reshape(len(basis), -1)
    basis = basis.reshape(len(basis), -1)
    amounts = linalg.lstsq(weighted @ basis.T, weighted @ noise.reshape(len(noise), -1).T)[0]
    return (amounts.T @ basis).reshape(noise.shape)


# Measures of the difference


def measure_power(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid, total: float) -> tuple[float, float]:
    """Return the power that lies elsewhere, ½ ∫|d| over the whole light ∫S, and its standard error.

    The mean of |d| with noise is too large where d is 0, and right where d is large. This bias is measured with draws
    of the noise that are added to the clear part of d, and subtracted.

    Parameters
    ----------
    difference : array [ring, direction]
        The difference d.
    noise : array [draw, ring, direction]
        Draws of its noise.
    grid : PolarGrid
        Places of both.
    total : float
        ∫S over the grid [σ²].
    """

    def power_of(values: np.ndarray) -> np.ndarray:
        """Return ½ ∫|values| over the whole light, for arrays [..., ring, direction]."""
        return np.sum(np.abs(values) * grid.area, axis=(-2, -1)) / (2 * max(total, 1e-300))

    clear = find_clear_part(difference, noise, grid)
    noisy_powers = power_of(clear + noise)
    bias = noisy_powers.mean() - power_of(clear)
    power = power_of(difference) - bias
    stderr = np.hypot(noisy_powers.std(ddof=1), BIAS_ERROR * power_of(noise).mean())
    return float(power), float(stderr)


def find_clear_part(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid) -> np.ndarray:
    """Return the part of the difference that exceeds its noise [ring, direction].

    Each azimuthal order at each radius is multiplied by 1 − `CLEAR_POWER` (noise power)/(power), or by 0 if less. The
    noise is [draw, ring, direction].
    """
    spectrum = np.fft.rfft(difference, axis=1)
    noise_power = grid.mean_nearby(np.abs(np.fft.rfft(noise, axis=2)) ** 2)
    share = 1 - CLEAR_POWER * noise_power / grid.mean_nearby(np.abs(spectrum[None]) ** 2)
    return np.fft.irfft(np.clip(share, 0.0, 1.0) * spectrum, DIRECTIONS, axis=1)


def measure_orders(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid) -> np.ndarray:
    """Return the shares of the first `ORDERS` azimuthal orders in ∫d², the sum over all orders [order].

    The mean ∫noise² of each order is subtracted first; an order that does not exceed it has the share 0. The difference
    d is [ring, direction], its noise [draw, ring, direction].
    """

    def squares(values: np.ndarray) -> np.ndarray:
        """Return ∫values² of each azimuthal order [..., order], up to a common factor."""
        square = np.abs(np.fft.rfft(values, axis=-1)) ** 2
        # Each order but 0 and the last stands for two terms of the full transform (Parseval).
        square[..., 1:-1] *= 2
        return np.sum(square * grid.area, axis=-2)

    excess = np.maximum(squares(difference) - squares(noise).mean(axis=0), 0.0)
    return excess[:ORDERS] / max(excess.sum(), 1e-300)


def measure_axes(light: np.ndarray, declared_shape: np.ndarray, grid: PolarGrid) -> tuple[float, float, float]:
    """Return the widths of a shape along its long and short axis, and the direction of the long axis.

    Widths are roots of second central moments, relative to that of the declared shape, which is round and centred. The
    direction is in degrees from 0 to 180, from the u axis towards v. Both shapes are [ring, direction].
    """
    weight = light * grid.area / max(float(np.sum(light * grid.area)), 1e-300)
    declared_moment = np.sum(declared_shape * grid.area * grid.radius**2) / 2 / np.sum(declared_shape * grid.area)
    du, dv = grid.u - np.sum(weight * grid.u), grid.v - np.sum(weight * grid.v)
    mu_11 = np.sum(weight * du * dv)
    moments = [[np.sum(weight * du * du), mu_11], [mu_11, np.sum(weight * dv * dv)]]
    (small, large), axes = np.linalg.eigh(moments)
    minor, major = np.sqrt(np.maximum([small, large], 0.0) / declared_moment)
    return float(major), float(minor), float(np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])) % 180)


def describe_difference(power: float, stderr: float, orders: np.ndarray, axes: tuple[float, float, float]) -> str:
    """Return the comparison in words that follow "the light does not have the declared shape:".

    `orders` by `measure_orders`; `axes` by `measure_axes`. A power that is not clear gives an upper limit of 2 σ.
    """
    if not power > CLEAR_ERRORS * stderr:
        limit = max(max(power, 0.0) + 2 * stderr, LEAST_LIMIT)
        return f"less than {percent_text(limit)} of its power lies elsewhere"
    return f"{percent_text(power)} of its power lies elsewhere, {describe_pattern(orders, axes)}"


def describe_pattern(orders: np.ndarray, axes: tuple[float, float, float]) -> str:
    """Return in words where most of ∫d² lies, by its strongest azimuthal order.

    `orders` [order] are the shares of the azimuthal orders in ∫d²; `axes` are those of `describe_difference`.
    """
    order = int(np.argmax(orders))
    if orders[order] < MAJORITY:
        return "in no simple pattern"
    major, minor, direction_deg = axes
    if order == 2 and minor > 0:
        ratio, direction = f"{major / minor:.3g}", round(direction_deg) % 180
        return f"most of it in a spot that is {ratio} times as long as wide, along {direction}°"
    if order < 2:
        return ("most of it in rings about the centre", "most of it on one side")[order]
    return f"most of it in {LOBES[order]} lobes"
