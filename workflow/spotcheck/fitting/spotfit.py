"""The spot fit: an elliptical Gaussian with free centre, two widths, orientation, amplitude and offset.

The likelihood is the distribution of a reading (`reading_kernel`): shot, dark and read noise, gain and rounding, and
the probability of being clipped. NaN pixels are left out. With equal weights the fit is the paper's estimator,
unweighted least squares, and needs no sensor.

θ [7] are amplitude [DN], x0, y0 [px], the elements a, b, c [1/px²] of the inverse covariance matrix [[a, b], [b, c]] of
the spot, and offset [DN] (`spot_score`). A point of the search [7] is θ, or widths [px] and orientation [rad] in place
of a, b, c if parameters are fixed (`Parametrization`).
"""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.fit_results import FITTED_NAMES, SpotFits
from spotcheck.fitting.initial_estimate import estimate_start
from spotcheck.fitting.optimization import (
    NARROWEST,
    Parametrization,
    apply_constraints,
    compute_jacobian,
    compute_theta,
    convert_inverse_covariance,
    fit_least_squares,
    run_fisher_scoring,
)
from spotcheck.fitting.reading_kernel import ReadingLaw, build_reading_law
from spotcheck.fitting.spot_score import EQUAL, LIKELIHOOD, VARIANCE, score_spot
from spotcheck.io.store import flag
from spotcheck.model import spot
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor
from spotcheck.sensor.pixel_maps import PixelMaps

# Weightings of the pixels by the name in `fit_spots`.
WEIGHTINGS = {"likelihood": LIKELIHOOD, "equal": EQUAL}
# A spot has an orientation if its axes differ significantly: one round spot in 1000 exceeds this χ² of 2 degrees of
# freedom.
ROUND_CHI2 = 13.8
# A width or an amplitude with a larger relative error was not measured.
MAX_RELATIVE_ERROR = 0.5
# A spot with a smaller width [px] cannot be trusted: pixels do not sample it.
NARROWEST_TRUSTED = 0.3
# Least variance [px²] that remains of a width after that of a pixel is removed.
LEAST_VARIANCE = 1e-6
# Columns of amplitude and both widths among the parameters.
SIZE_COLUMNS = [0, 3, 4]


class FitDesign(NamedTuple):
    """Options of a fit: which parameters are free, and the shape of the light."""

    coordinates: Parametrization  # what the coordinates of a point of the search mean, and which are free
    fixed_values: np.ndarray  # values of the parameters that are not free, orientation in rad; 0 for free ones [7]
    top_hat: bool  # whether the light has a plateau
    integrated: bool  # whether a pixel reads the mean of the light over it


def fit_spots(
    images: np.ndarray | Iterable[np.ndarray],
    sensor: SensorModel | None = None,
    *,
    weighting: str = "likelihood",
    top_hat: bool = False,
    integrated: bool = False,
    fixed: Mapping[str, float] | None = None,
    circular: bool = False,
    maps: PixelMaps | None = None,
) -> SpotFits:
    """Fit one elliptical Gaussian spot on a constant offset in each image, by maximum likelihood.

    No start values are needed. The likelihood is that of the sensor's readings: shot and read noise, rounding, and
    clipped pixels by the probability of being clipped. The fit reaches the Cramér–Rao bound, which `spot_bounds` gives.

    Parameters
    ----------
    images : ndarray or iterable of ndarray
        One image [rows, columns] in DN, or several, of one size or of many. Pixels that are NaN or masked are left out.
        Readings need not be whole: a mean of n frames has their gain over n and their read noise times √n. A single
        image gives a single spot: plain numbers in place of arrays.
    sensor : SensorModel, optional
        Gain, read noise, black level, full scale and curvature of the response; the fitted offset includes dark
        current.
    weighting : {"likelihood", "equal"}
        "likelihood", or "equal" for unweighted least squares with the errors that the sensor's noise causes. Without a
        sensor, errors with equal weights are those of white noise as large as the residuals, and χ² is NaN. These
        errors are too small with shot noise, by a factor of two to three for a bright spot.
    top_hat : bool
        Whether the Gaussian has a plateau at exp(−1/4) of its peak (Eqs. 39–40 of the paper).
    integrated : bool
        Whether a pixel reads the mean of the light over it, not the light at its centre. Amplitude and widths are then
        those of the light itself, to 2e-3/σ⁴ of the peak for a width of σ px.
    fixed : mapping of str to float, optional
        Values of parameters that are not fitted, such as `{"offset": 40.0}`; their standard error is 0.
    circular : bool
        Whether one width is fitted for both axes.
    maps : PixelMaps, optional
        Offsets and gains of the images' pixels with their uncertainty; equal weights ignore them.

    Returns
    -------
    SpotFits
        Values and standard errors by name, covariance, χ² and status of each spot. Centres count from the centre of the
        image's first pixel. If `status` is "not_converged" every value is NaN. A spot that is round within its noise
        has an orientation with infinite standard error.

    Raises
    ------
    ValueError
        An image that is not two-dimensional, a likelihood without a sensor, or options that exclude each other.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> y, x = np.mgrid[:48, :64]
    >>> photons = 900 * np.exp(-(((x - 31.3) / 7) ** 2 + ((y - 22.6) / 5) ** 2) / 2)
    >>> fit = spotcheck.fit_spots(sensor.draw(photons, rng=1), sensor)
    >>> fit
    fitted spot: ok, χ² per degree of freedom 1.02
    amplitude           454.0 ± 1.6 DN
    x_centre         31.313 ± 0.018 pixel
    y_centre         22.608 ± 0.013 pixel
    sigma_major       6.980 ± 0.015 pixel
    sigma_minor       4.977 ± 0.011 pixel
    orientation       179.91 ± 0.24 degree
    offset             19.96 ± 0.06 DN
    sigma_mean        5.979 ± 0.010 pixel
    >>> print(f"{fit.sigma_major:.2f} ± {fit.sigma_major_stderr:.2f} px")
    6.98 ± 0.01 px
    """
    if weighting not in WEIGHTINGS:
        raise ValueError(f"weighting: {weighting!r} is none of {', '.join(WEIGHTINGS)}")
    if weighting == "likelihood" and sensor is None:
        raise ValueError("sensor: the likelihood needs a gain and a read noise; without them use equal weights")
    design = _build_design(dict(fixed or {}), circular, top_hat, integrated)
    law = build_reading_law(None if sensor is None else check_sensor(sensor), maps)

    @cache
    def build_fractional_law(shape: tuple[int, ...]) -> ReadingLaw:
        """Return the law of readings between whole numbers, for images of a shape (rows, columns)."""
        # Uniform maps without errors change nothing but let readings be fractional.
        return build_reading_law(sensor, PixelMaps(np.zeros(shape), np.ones(shape)))

    is_single = getattr(images, "ndim", None) == 2
    image_sequence: Iterable[np.ndarray] = [np.asanyarray(images)] if is_single else images
    shapes, results = [], []
    for image_index, image in enumerate(image_sequence):
        pixels, image_law = _prepare_pixels(image, image_index), law
        if weighting == "likelihood" and maps is None and not np.array_equal(pixels, np.rint(pixels), equal_nan=True):
            image_law = build_fractional_law(pixels.shape)
        if sensor is not None:
            pixels = sensor.linearize(pixels)
        if maps is not None:
            pixels = _mask_unmapped_pixels(pixels, maps, image_index)
        shapes.append(pixels.shape)
        results.append(_fit_image(pixels, image_law, WEIGHTINGS[weighting], sensor is not None, design))
    free_count = int(design.coordinates.free.sum())
    # The shapes are stated for the case of no images.
    points, covariance, chi2 = (
        np.array([result[k] for result in results]).reshape(len(results), *shape)
        for k, shape in enumerate(((7,), (free_count, free_count), ()))
    )
    fits = _convert_to_parameters(points, covariance, chi2, np.array(shapes).reshape(-1, 2), design)
    return fits[0] if is_single else fits


def _prepare_pixels(image: np.ndarray, image_index: int) -> np.ndarray:
    """Return an image [row, column] as contiguous floats with NaN for masked pixels; the index is for messages."""
    if np.ma.isMaskedArray(image):
        image = np.ma.filled(image.astype(float), np.nan)
    pixels = np.asarray(image, dtype=float)
    if pixels.ndim != 2:
        raise ValueError(f"images: number {image_index} has the shape {pixels.shape}; each must be [rows, columns]")
    return np.ascontiguousarray(pixels)


def _mask_unmapped_pixels(pixels: np.ndarray, maps: PixelMaps, image_index: int) -> np.ndarray:
    """Return an image [row, column] with NaN where a map is NaN; the index of the image is for messages."""
    if pixels.shape != np.shape(maps.gain) or pixels.shape != np.shape(maps.offset_dn):
        raise ValueError(f"maps: have the shape {np.shape(maps.gain)}, but image {image_index} has {pixels.shape}")
    return np.where(np.isfinite(maps.offset_dn) & np.isfinite(maps.gain), pixels, np.nan)


def _build_design(fixed: dict[str, float], is_circular: bool, top_hat: bool, integrated: bool) -> FitDesign:
    """Check the options of a fit, which are those of `fit_spots`, and return its design.

    Raises ValueError for unknown parameters, impossible values, or options that exclude each other.
    """
    if unknown := set(fixed) - set(FITTED_NAMES):
        raise ValueError(f"fixed: {', '.join(sorted(unknown))} is none of {', '.join(FITTED_NAMES)}")
    if is_circular and {"sigma_minor", "orientation"} & set(fixed):
        raise ValueError("fixed: a circular spot has one width, sigma_major, and no orientation")
    if integrated and (top_hat or "amplitude" in fixed):
        raise ValueError("integrated: not together with a top hat or a fixed amplitude")
    for name, value in fixed.items():
        if not np.isfinite(value) or (name.startswith("sigma") and value < NARROWEST):
            raise ValueError(
                f"fixed: {name} is {value!r}; give a finite number, and for a width at least {NARROWEST} px"
            )
    free = np.array([name not in fixed for name in FITTED_NAMES])
    fixed_values = np.array([fixed.get(name, 0.0) for name in FITTED_NAMES], dtype=float)
    fixed_values[5] = np.radians(fixed_values[5])
    if is_circular:
        # Minor width and orientation follow from the major width.
        free[4:6] = False
    if integrated:
        # The search fits the light as pixels read it, wider by the variance of a pixel.
        fixed_values[3:5] = np.sqrt(fixed_values[3:5] ** 2 + spot.PIXEL_VARIANCE)
    # θ is regular at a round spot and is preferred, but a fixed width or orientation is no element of θ.
    uses_widths = not bool(free.all())
    return FitDesign(Parametrization(free, uses_widths, is_circular), fixed_values, top_hat, integrated)


def _fit_image(pixels: np.ndarray, law: ReadingLaw, weighting: int, has_sensor: bool, design: FitDesign):
    """Fit one image [row, column] in DN.

    Return the point [7], its covariance [free, free] and χ² per degree of freedom, all NaN without a fit. `weighting`
    is `EQUAL` or `LIKELIHOOD`. With equal weights, χ² is under the sensor's noise, or NaN without a sensor.
    """
    coordinates, top_hat = design.coordinates, design.top_hat
    free_count = int(coordinates.free.sum())
    failure = np.full(7, np.nan), np.full((free_count, free_count), np.nan), np.nan
    point, has_light = estimate_start(pixels, law, top_hat)
    if not has_light:
        return failure
    if coordinates.uses_widths:
        point = apply_constraints(point, coordinates, design.fixed_values)
        point = fit_least_squares(pixels, point, law, top_hat, coordinates)
    point, information, chi2, used, is_root = run_fisher_scoring(pixels, point, weighting, law, top_hat, coordinates)
    if not is_root:
        return failure
    covariance, degrees_of_freedom = invert_information(information), max(used - free_count, 1)
    if weighting == EQUAL and has_sensor:
        # Sandwich covariance: equal weights, variances of the sensor.
        jacobian, theta = compute_jacobian(point, coordinates), compute_theta(point, coordinates)
        _, score_covariance, chi2, used = score_spot(pixels, theta, VARIANCE, law, top_hat)
        covariance = covariance @ (jacobian.T @ score_covariance @ jacobian) @ covariance
        degrees_of_freedom = max(used - free_count, 1)
    elif weighting == EQUAL:
        # White noise as large as the residuals; χ² is their sum of squares here.
        covariance, chi2 = covariance * chi2 / degrees_of_freedom, np.nan
    return point, covariance, chi2 / degrees_of_freedom


def invert_information(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite information matrix [n, n].

    It is scaled by its diagonal first, since the units of parameters differ by many powers of ten.
    """
    scale = 1 / np.sqrt(np.diag(matrix))
    return np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)


def _convert_to_parameters(
    points: np.ndarray, covariance: np.ndarray, chi2: np.ndarray, shapes: np.ndarray, design: FitDesign
) -> SpotFits:
    """Convert points of the search to the parameters of `SpotFits`, with errors, covariance and status.

    `points` are [n, 7], `covariance` is that of their free coordinates [n, free, free], `chi2` is χ² per degree of
    freedom [n], and `shapes` are rows and columns of the images [n, 2]. NaN without a fit.
    """
    coordinates = design.coordinates
    # Values [n, 7], and their derivatives by the coordinates of the point [n, parameter, coordinate].
    if coordinates.uses_widths:
        value, slopes = points.copy(), np.broadcast_to(np.eye(7), (len(points), 7, 7)).copy()
        if coordinates.is_circular:
            # The minor width changes with the major one.
            slopes[:, 4, 3] = 1.0
        is_round = np.isfinite(points[:, 0]) & coordinates.is_circular
    else:
        value, slopes = _convert_theta_to_widths(points)
        is_round = _test_roundness(points, covariance)
    if design.integrated:
        _remove_pixel_variance(value, slopes)
    slopes = slopes[:, :, coordinates.free]
    covariance = slopes @ covariance @ slopes.transpose(0, 2, 1)
    mean_variance = (covariance[:, 3, 3] + covariance[:, 4, 4] + 2 * covariance[:, 3, 4]) / 4
    variance = np.concatenate([np.einsum("nii->ni", covariance), mean_variance[:, None]], axis=1)
    stderr = np.sqrt(np.maximum(variance, 0.0))
    # The orientation of a round spot is undetermined.
    covariance[is_round, 5, :] = covariance[is_round, :, 5] = 0.0
    covariance[is_round, 5, 5] = stderr[is_round, 5] = np.inf
    value = np.append(value, value[:, 3:5].mean(axis=1, keepdims=True), axis=1)
    # Orientation from rad to degrees, 0 … 180.
    value[:, 5] = np.degrees(value[:, 5]) % 180.0
    stderr[:, 5] = np.degrees(stderr[:, 5])
    covariance[:, 5, :] = np.degrees(covariance[:, 5, :])
    covariance[:, :, 5] = np.degrees(covariance[:, :, 5])
    return SpotFits(value, stderr, covariance, chi2, _flag_fits(value, stderr, shapes))


def _convert_theta_to_widths(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert θ [n, 7] to widths, and return the derivatives of this conversion; NaN without a fit.

    Returns
    -------
    value : array [n, 7]
        Amplitude [DN], x0, y0 [px], major and minor width [px], orientation [rad] and offset [DN].
    slopes : array [n, parameter, θ]
        Derivatives of the values by the elements of θ.
    """
    value = theta.copy()
    for point in value:
        point[3:6] = convert_inverse_covariance(*point[3:6])
    cos, sin = np.cos(value[:, 5]), np.sin(value[:, 5])
    slopes = np.broadcast_to(np.eye(7), (len(theta), 7, 7)).copy()
    # Derivatives of the eigenvalues 1/σ² of the inverse covariance by a, b, c, and from them those of σ.
    major_slopes = np.stack([cos * cos, 2 * cos * sin, sin * sin])
    minor_slopes = np.stack([sin * sin, -2 * cos * sin, cos * cos])
    slopes[:, 3, 3:6] = (-0.5 * value[:, 3] ** 3 * major_slopes).T
    slopes[:, 4, 3:6] = (-0.5 * value[:, 4] ** 3 * minor_slopes).T
    # A round spot has no direction: its slopes are huge, and its error of the orientation is set to infinity later.
    difference = np.hypot(theta[:, 3] - theta[:, 5], 2 * theta[:, 4])
    orientation_slopes = np.stack([-cos * sin, cos * cos - sin * sin, cos * sin])
    slopes[:, 5, 3:6] = (orientation_slopes / -np.maximum(difference, 1e-300)).T
    return value, slopes


def _test_roundness(theta: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return whether each spot is round within its errors [n]; False without a fit.

    A spot is round if (a − c)/2 and b of θ [n, 7] are 0 within their errors, by the covariance [n, 7, 7] of θ.
    """
    # Linear map from θ to (a − c)/2 and b.
    projection = np.zeros((2, 7))
    projection[0, 3], projection[0, 5], projection[1, 4] = 0.5, -0.5, 1.0
    is_fitted = np.isfinite(theta[:, 0])
    ellipticity = theta[is_fitted] @ projection.T
    weighted = np.linalg.solve(projection @ covariance[is_fitted] @ projection.T, ellipticity[..., None])[..., 0]
    is_round = np.zeros(len(theta), bool)
    is_round[is_fitted] = np.einsum("ni,ni->n", ellipticity, weighted) < ROUND_CHI2
    return is_round


def _remove_pixel_variance(value: np.ndarray, slopes: np.ndarray) -> None:
    """Convert a spot as pixels read it to the light before integration over pixels, in place.

    Each variance σ² of `value` [n, 7] becomes σ² − 1/12 px², and the amplitude grows as the area of the spot shrinks.
    `slopes` [n, parameter, coordinate] are the derivatives of the values, which change with them.
    """
    sampled = value[:, 3:5].copy()
    light = np.sqrt(np.maximum(sampled**2 - spot.PIXEL_VARIANCE, LEAST_VARIANCE))
    growth = np.prod(sampled, axis=1) / np.prod(light, axis=1)
    # d ln A = d ln σ_sampled − d ln σ_light, with σ_light dσ_light = σ_sampled dσ_sampled
    for k in (0, 1):
        log_slope = 1 / sampled[:, k] - sampled[:, k] / light[:, k] ** 2
        slopes[:, 0, :] += (value[:, 0] * log_slope)[:, None] * slopes[:, 3 + k, :]
    slopes[:, 0, :] *= growth[:, None]
    slopes[:, 3:5, :] *= (sampled / light)[:, :, None]
    value[:, 0] *= growth
    value[:, 3:5] = light


def _flag_fits(value: np.ndarray, stderr: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the flags of each fit [n], of which at most one is set; 0 for a fit that can be trusted.

    The flag "not_converged" means that there are no values; "at_limit" that the image does not determine the amplitude,
    a width or the centre. `value` and `stderr` are [n, 8], `shapes` the rows and columns of the images [n, 2].
    """
    amplitude, x, y, major, minor = value[:, :5].T
    rows, columns = shapes.T
    with np.errstate(invalid="ignore"):
        is_trusted = (amplitude > 0) & (minor > NARROWEST_TRUSTED) & (major < shapes.max(axis=1))
        is_trusted &= (x >= -0.5) & (x <= columns - 0.5) & (y >= -0.5) & (y <= rows - 0.5)
        is_trusted &= np.all(stderr[:, SIZE_COLUMNS] <= MAX_RELATIVE_ERROR * np.abs(value[:, SIZE_COLUMNS]), axis=1)
    return np.where(np.isnan(amplitude), flag("not_converged"), np.where(is_trusted, 0, flag("at_limit")))


def evaluate_fit(value: np.ndarray, y: np.ndarray, x: np.ndarray, *, top_hat: bool = False) -> np.ndarray:
    """Return the fitted readings at rows y and columns x [px], arrays that are broadcast.

    `value` [8] are the parameters of one spot in the order of `SpotFits.parameters`. With `top_hat` the light is cut to
    a plateau.
    """
    amplitude, x0, y0, major, minor, orientation, offset, _ = value
    light = spot.elliptical_gaussian(x, y, amplitude, x0, y0, major, minor, np.radians(orientation))
    return (spot.top_hat(light, amplitude) if top_hat else light) + offset
