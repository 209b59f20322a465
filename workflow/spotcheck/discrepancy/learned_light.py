"""A learned light shape compared with the declared one: the power that lies elsewhere, its pattern and its noise.

Brightness, width and centre of a shape are those of each frame's spot as well. The declared shape B is therefore first
brought to the brightness A, width w and centre (a, b) at which ∫(S − A B)² is least, where S is the learned light. What
remains is the difference d(u, v) = S(w u + a, w v + b)/A − B(u, v), a function of places u, v [σ] about the spot.
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
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import NULL_EIGENVALUE, solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.discrepancy.words import percent_text
from spotcheck.model.baseline import Baseline
from spotcheck.model.light_shape import LightShape

# Distance of the rings [σ] on which integrals are taken, about half the distance of the nodes; places on each ring.
RING_STEP, DIRECTIONS = 0.065, 256
# Draws of the coefficients: they give standard errors to 1 part in 11.
DRAWS = 64
# Azimuthal orders that are reported, from 0 on.
ORDERS = 9
# Parts of d that exceed so many times the power of noise within so many σ of radius are clear of it.
CLEAR_POWER, NEARBY = 2.0, 0.5
# Error of what is taken off the power for its noise, as part of the absolute noise: simulated fits are off by 0.04.
BIAS_ERROR = 0.1
# Least upper limit of a power that is stated.
LEAST_LIMIT = 1e-5
# Part of the power that one order must have for a pattern.
MOST = 0.5
# Step of width and centre in the derivatives of the declared shape.
GAUGE_STEP = 1e-4
LOBES = ("", "", "two", "three", "four", "five", "six", "seven", "eight")


@dataclass(frozen=True)
class PolarGrid:
    """Places about the centre of a spot on rings that are equally spaced."""

    rings: int  # number of rings

    @cached_property
    def radius(self) -> np.ndarray:
        """Radius of each ring [ring, 1] [σ]."""
        return RING_STEP * (np.arange(self.rings)[:, None] + 0.5)

    @cached_property
    def u(self) -> np.ndarray:
        """Columns [ring, direction] [σ]."""
        return self.radius * np.cos(2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)

    @cached_property
    def v(self) -> np.ndarray:
        """Rows [ring, direction] [σ]."""
        return self.radius * np.sin(2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)

    @cached_property
    def area(self) -> np.ndarray:
        """Area that each place stands for [ring, 1] [σ²]."""
        return self.radius * RING_STEP * 2 * np.pi / DIRECTIONS

    def mean_nearby(self, squares: np.ndarray) -> np.ndarray:
        """Return the mean of squares [draw, ring, order] over draws and, weighted by area, over rings nearby, in terms
        of the area; above 0."""
        smooth = ndimage.gaussian_filter1d(self.radius * squares.mean(axis=0), NEARBY / RING_STEP, axis=0)
        return np.maximum(smooth, 1e-300)


@dataclass(frozen=True)
class Gauge:
    """Brightness, width and centre of a shape."""

    brightness: float = 1.0  # A, over that of the declared shape
    width: float = 1.0  # w [σ]
    u: float = 0.0  # column a of the centre [σ]
    v: float = 0.0  # row b of the centre [σ]

    def places_of(self, grid: PolarGrid) -> tuple[np.ndarray, np.ndarray]:
        """Return the places of a grid about this centre, in units of this width."""
        return self.width * grid.u + self.u, self.width * grid.v + self.v

    def shape_of(self, baseline: Baseline, grid: PolarGrid) -> np.ndarray:
        """Return a declared shape with this brightness, width and centre on a grid [ring, direction]."""
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
        Its power has the bias of noise taken off and scatters about 0 if there is nothing but noise; `orders` are 0
        unless it is `CLEAR_ERRORS` standard errors. Beyond the pixels the declared shape stands. Widths and direction
        are those of the second moments of S.
    """
    baseline = fit.model.forward.baseline
    shape = baseline.learned
    if fit.model.grid is None or shape is None:
        raise ValueError("the fit has no free light shape")
    declared = replace(baseline, learned=None) if declared is None else declared
    grid = PolarGrid(int(shape.step * (len(shape.coefficients) - 1) / 2 / RING_STEP))
    gauge = fit_gauge(baseline, declared, grid, find_reached(fit, grid.u, grid.v))
    u, v = gauge.places_of(grid)
    is_reached = find_reached(fit, u, v)
    before = Gauge().shape_of(declared, grid)
    light = np.where(is_reached, baseline.spot(u, v, 1.0, 1.0) / gauge.brightness, before)
    noise = draw_noise(fit, gauge, grid, np.random.default_rng(seed)) * is_reached
    noise -= project_on_gauge(noise, declared, grid, is_reached)
    power, stderr = measure_power(light - before, noise, grid, float(np.sum(light * grid.area)))
    orders = measure_orders(light - before, noise, grid) if power > CLEAR_ERRORS * stderr else np.zeros(ORDERS)
    major, minor, direction_deg = measure_axes(light - noise.mean(axis=0), before, grid)
    words = describe_difference(power, stderr, orders, (major, minor, direction_deg))
    lowest = float(light.min())
    return LearnedLight(shape, power, stderr, tuple(map(float, orders)), major, minor, direction_deg, lowest, words)


def summarize_shape(light: LearnedLight) -> dict[str, Any]:
    """Return the attributes of light.nc that describe a learned light."""
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


def find_reached(fit: JointFit, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return which places [ring, direction] lie within the used pixels of at least one frame."""
    pixels, spots = fit.pixels, fit.model.spots
    is_reached = np.zeros(u.shape, bool)
    for frame, sigma in enumerate(np.exp(spots.log_sigma)):
        used = pixels.is_used[frame]
        if used.any():
            x = (pixels.x[frame, 0, used.any(axis=0)] - spots.x[frame]) / sigma
            y = (pixels.y[frame, used.any(axis=1), 0] - spots.y[frame]) / sigma
            is_reached |= (u >= x.min()) & (u <= x.max()) & (v >= y.min()) & (v <= y.max())
    return is_reached


def fit_gauge(baseline: Baseline, declared: Baseline, grid: PolarGrid, is_reached: np.ndarray) -> Gauge:
    """Return brightness, width and centre at which the declared shape is nearest to that of a baseline."""
    light, root = baseline.spot(grid.u, grid.v, 1.0, 1.0), np.sqrt(grid.area) * is_reached

    def gauge_of(values: np.ndarray) -> Gauge:
        return Gauge(float(np.exp(values[0])), float(np.exp(values[1])), float(values[2]), float(values[3]))

    def residual(values: np.ndarray) -> np.ndarray:
        return (root * (light - gauge_of(values).shape_of(declared, grid))).ravel()

    return gauge_of(optimize.least_squares(residual, np.zeros(4), xtol=1e-10, ftol=1e-12).x)


# Noise


def draw_noise(fit: JointFit, gauge: Gauge, grid: PolarGrid, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the noise of a learned shape in a gauge [draw, ring, direction].

    They are those by the Fisher information. The frames of a site may share a field such as speckle: azimuthal orders
    that scatter more between sites are scaled to that. With few sites the draws are scaled to the residuals.
    """
    shape = fit.model.forward.baseline.learned
    assert shape is not None
    u, v = gauge.places_of(grid)

    def noise_of(draws: np.ndarray) -> np.ndarray:
        draws = draws.T.reshape(-1, *shape.coefficients.shape) / gauge.brightness
        return np.array([LightShape(shape.step, draw)(u, v) for draw in draws])

    noise = noise_of(draw_by_information(fit, rng))
    if fit.model.design.sites < MANY_SITES:
        return noise * np.sqrt(max(fit.equations.dispersion, 1.0))
    spectrum = np.fft.rfft(noise, axis=2)
    between_sites = np.fft.rfft(noise_of(draw_by_sites(fit, rng)), axis=2)
    by_information, by_sites = (grid.mean_nearby(np.abs(draws) ** 2) for draws in (spectrum, between_sites))
    return np.fft.irfft(spectrum * np.sqrt(np.maximum(by_sites / by_information, 1.0)), DIRECTIONS, axis=2)


def draw_by_information(fit: JointFit, rng: np.random.Generator) -> np.ndarray:
    """Return draws [coefficient, draw] of the inverse of the Fisher information.

    With the information L L' of the coefficients, L⁻¹C their cross terms with the n other unknowns and the information
    I of these beside the shape, a draw is L⁻ᵀ(z − L⁻¹C x), where z is standard normal and x has the covariance I⁻¹.
    """
    equations = fit.equations
    assert equations.shape is not None
    normal = rng.standard_normal((fit.model.coefficients.size, DRAWS))
    # Units differ by many orders of magnitude: I is scaled to a unit diagonal. Directions without information stay.
    scale = 1 / np.sqrt(np.maximum(np.diag(equations.information), 1e-300))
    values, vectors = np.linalg.eigh(equations.information * scale[:, None] * scale)
    roots = np.where(values > NULL_EIGENVALUE, 1 / np.sqrt(np.maximum(values, NULL_EIGENVALUE)), 0.0)
    others = scale[:, None] * (vectors @ (roots[:, None] * rng.standard_normal((len(values), DRAWS))))
    return equations.shape.factor.back_solve(normal - equations.shape.cross @ others)


def draw_by_sites(fit: JointFit, rng: np.random.Generator) -> np.ndarray:
    """Return draws [coefficient, draw] with the cluster-robust covariance, where the clusters are sites.

    Each is a sum over sites of the change of the coefficients that the score of a site asks for, times a standard
    normal number (multiplier bootstrap).
    """
    model, equations = fit.model, fit.equations
    assert equations.shape is not None

    def of_batch(part: slice) -> list[tuple[np.ndarray, list[float]]]:
        out = []
        for frame in range(part.start, part.stop):
            at = evaluate(model, fit.pixels, slice(frame, frame + 1), with_slopes=False)
            scores = [at.score(column) for column in differentiate_readings(model, at)]
            out.append((ShapeSums(model, at).score(), scores))
        return out

    frames = [frame for batch in map_batches(of_batch, fit.pixels) for frame in batch]
    site = np.unique(model.design.site, return_inverse=True)[1]
    is_of_site = np.equal.outer(np.arange(site.max() + 1), site).astype(float)
    scores = is_of_site @ np.array([score for score, _ in frames])
    # The score of each frame's own spot is 0 at the optimum.
    of_others = np.zeros((equations.size, len(scores)))
    of_others[4 * equations.frames :] = (is_of_site @ np.reshape([others for _, others in frames], (len(site), -1))).T
    half = equations.shape.factor.half_solve(scores.T)
    others = solve_positive(equations.information, of_others - equations.shape.cross.T @ half)
    changes = equations.shape.factor.back_solve(half - equations.shape.cross @ others)
    changes -= changes.mean(axis=1, keepdims=True)
    weights = rng.standard_normal((len(scores), DRAWS)) * np.sqrt(len(scores) / (len(scores) - 1))
    return changes @ weights


def project_on_gauge(noise: np.ndarray, declared: Baseline, grid: PolarGrid, is_reached: np.ndarray) -> np.ndarray:
    """Return the part of noise [draw, ring, direction] that brightness, width and centre take."""
    step = GAUGE_STEP
    before = Gauge().shape_of(declared, grid)
    moved = (Gauge(width=1 + step), Gauge(u=step), Gauge(v=step))
    tangents = [before, *((gauge.shape_of(declared, grid) - before) / step for gauge in moved)]
    basis = np.reshape(tangents * is_reached, (4, -1))
    weighted = (basis.reshape(4, *noise.shape[1:]) * grid.area).reshape(4, -1)
    amounts = linalg.lstsq(weighted @ basis.T, weighted @ noise.reshape(len(noise), -1).T)[0]
    return (amounts.T @ basis).reshape(noise.shape)


# Measures of the difference


def measure_power(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid, total: float) -> tuple[float, float]:
    """Return ½ ∫|d| over all light without the bias of its noise, and its standard error.

    Noise adds |noise| where d is 0 and nothing where d is large. Its bias is therefore that of draws about the part of
    d that stands out of the noise, by azimuthal order and radius.
    """

    def power_of(values: np.ndarray) -> np.ndarray:
        return np.sum(np.abs(values) * grid.area, axis=(-2, -1)) / (2 * max(total, 1e-300))

    clear = find_clear_part(difference, noise, grid)
    scattered = power_of(clear + noise)
    power = power_of(difference) - (scattered.mean() - power_of(clear))
    stderr = np.hypot(scattered.std(ddof=1), BIAS_ERROR * power_of(noise).mean())
    return float(power), float(stderr)


def find_clear_part(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid) -> np.ndarray:
    """Return the difference with each azimuthal order and radius weighted by how far it exceeds the noise."""
    spectrum = np.fft.rfft(difference, axis=1)
    of_noise = grid.mean_nearby(np.abs(np.fft.rfft(noise, axis=2)) ** 2)
    share = 1 - CLEAR_POWER * of_noise / grid.mean_nearby(np.abs(spectrum[None]) ** 2)
    return np.fft.irfft(np.clip(share, 0.0, 1.0) * spectrum, DIRECTIONS, axis=1)


def measure_orders(difference: np.ndarray, noise: np.ndarray, grid: PolarGrid) -> np.ndarray:
    """Return the share of ∫d² by azimuthal order from 0 on [order], without that of noise."""

    def squares(values: np.ndarray) -> np.ndarray:
        square = np.abs(np.fft.rfft(values, axis=-1)) ** 2
        # Each order but 0 and the last stands for two terms of the full transform (Parseval).
        square[..., 1:-1] *= 2
        return np.sum(square * grid.area, axis=-2)

    excess = np.maximum(squares(difference) - squares(noise).mean(axis=0), 0.0)
    return excess[:ORDERS] / max(excess.sum(), 1e-300)


def measure_axes(light: np.ndarray, before: np.ndarray, grid: PolarGrid) -> tuple[float, float, float]:
    """Return the widths of a shape along its long and its short axis over that of the declared one, and the direction
    of the long axis [deg] from 0 to 180; widths are roots of second central moments."""
    weight = light * grid.area / max(float(np.sum(light * grid.area)), 1e-300)
    declared = np.sum(before * grid.area * grid.radius**2) / 2 / np.sum(before * grid.area)
    du, dv = grid.u - np.sum(weight * grid.u), grid.v - np.sum(weight * grid.v)
    mu_11 = np.sum(weight * du * dv)
    moments = [[np.sum(weight * du * du), mu_11], [mu_11, np.sum(weight * dv * dv)]]
    (small, large), axes = np.linalg.eigh(moments)
    minor, major = np.sqrt(np.maximum([small, large], 0.0) / declared)
    return float(major), float(minor), float(np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])) % 180)


def describe_difference(power: float, stderr: float, orders: np.ndarray, axes: tuple[float, float, float]) -> str:
    """Return the comparison in words that follow "the light does not have the declared shape:"."""
    if not power > CLEAR_ERRORS * stderr:
        most = max(max(power, 0.0) + 2 * stderr, LEAST_LIMIT)
        return f"less than {percent_text(most)} of its power lies elsewhere"
    return f"{percent_text(power)} of its power lies elsewhere, {describe_pattern(orders, axes)}"


def describe_pattern(orders: np.ndarray, axes: tuple[float, float, float]) -> str:
    """Return where most of the power lies."""
    order = int(np.argmax(orders))
    if orders[order] < MOST:
        return "in no simple pattern"
    major, minor, direction_deg = axes
    if order == 2 and minor > 0:
        ratio, direction = f"{major / minor:.3g}", round(direction_deg) % 180
        return f"most of it in a spot that is {ratio} times as long as wide, along {direction}°"
    if order < 2:
        return ("most of it in rings about the centre", "most of it on one side")[order]
    return f"most of it in {LOBES[order]} lobes"
