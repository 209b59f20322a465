"""Analysis of one image: Gaussian fit and second moments of the spot, clipped pixels, and data for a picture.

D4σ is the width by second moments; its area of integration is a rectangle around the spot. The window is the part of
the image around the spot that is fitted. Readings are in DN. Fits and their noise models count in rounding steps of the
camera (`Camera.step_dn`); the fits are then converted to DN.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.stats import chi2

from spotcheck.characterization.outlier_pixels import find_outlier_pixels
from spotcheck.fitting.fit_results import NAMES, SpotFits
from spotcheck.fitting.moments import AREA, Moments, second_moments
from spotcheck.fitting.scan_widths import compute_width_excess
from spotcheck.fitting.spotfit import evaluate_fit, fit_spots
from spotcheck.quicklook.camera import Camera, find_clip_level
from spotcheck.quicklook.images import Image
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Half the side of the fitted window, in D4σ: the area of integration and a border that constrains the background; and
# its least value [px].
HALF_SIDE, LEAST_HALF_SIDE = 0.6 * AREA, 8.0
# Number of fitted parameters, which come first in `NAMES` and have a covariance; the mean width follows from them.
FITTED_PARAMETERS = len(NAMES) - 1
# Longest side of the picture of a window [px]; points of a profile, and its half length in σ.
PICTURE_SIDE, PROFILE_POINTS, PROFILE_SIGMAS = 240, 241, 5
# Signals, as fractions of the peak, above which pixels are bright and below which they are dark in the estimate of the
# noise; and the fewest pixels of either kind.
BRIGHT, DARK, FEWEST_PIXELS = 0.3, 0.02, 30
# Largest reduced χ² of a spot that is consistent with a Gaussian: the noise model itself is an estimate.
GAUSSIAN_CHI2 = 1.1
# A variance that grows by less than this fraction of that of dark pixels counts as constant: errors are then 5 % wrong.
LEAST_GROWTH = 0.1
# Least level of a clip above the offset [DN], which avoids a division by 0.
LEAST_CLIP_DN = 1e-9

# Two widths [px] along the long and the short axis, each with its standard error.
Widths = list[tuple[float, float]]
# Most noise of an image whose swapped bytes would show a spot [variance of all readings]; noise alone has 1.
MOST_NOISE_PART = 0.25


class Profile(NamedTuple):
    """Readings along one axis of the fitted spot."""

    distance: np.ndarray  # distance from the fitted centre [px], shape [point]
    reading: np.ndarray  # interpolated readings [DN], shape [point]
    fitted: np.ndarray  # readings of the fit [DN], shape [point]


class SpotPicture(NamedTuple):
    """Data for a picture of the spot."""

    window: np.ndarray  # every n-th reading around the spot [DN], shape [rows, columns]; NaN where unknown
    extent: tuple[float, float, float, float]  # left, right, bottom and top edge of the window in the image [px]
    profiles: tuple[Profile, Profile]  # along the long and the short axis


class Clipping(NamedTuple):
    """Clipped pixels of an image."""

    pixels: int  # number of readings at the clip level or above
    level_dn: float  # reading at which the image clips [DN]; infinite if it does not
    highest_dn: float  # highest reading [DN]; NaN if there is none


@dataclass(frozen=True, eq=False)
class ImageResult:
    """Results for one image."""

    name: str  # name of the image
    shape: tuple[int, ...]  # rows, columns [px]
    z_m: float | None  # position along the beam [m]; None if unknown
    moments: Moments  # second moments of the spot; NaN if there is no spot
    fit: SpotFits | None  # Gaussian fit, with errors that include the misfit; None if there is no spot
    clipping: Clipping  # clipped pixels
    residual_rms: float  # rms residual within the 1/e² contour, as a fraction of the fitted peak; NaN without a fit
    is_noise_known: bool  # whether the fit uses the noise model of the camera
    outlier_text: str  # sentence about outlying pixels, which are left out; "" if there are none
    impossible_counts: Mapping[str, int]  # number of pixels that were not measured, by the reason as a sentence
    picture: SpotPicture | None  # data for a picture; None if there is no spot
    has_swapped_spot: bool = False  # whether there is no spot, but one if both bytes of each reading are swapped

    @property
    def has_reliable_fit(self) -> bool:
        """Whether the image constrains all parameters of the fit."""
        return self.fit is not None and self.fit.status == "ok"

    def fit_value(self, name: str) -> tuple[float, float]:
        """Return a fitted parameter, one of `NAMES`, and its standard error; NaN if there is no fit."""
        if self.fit is None:
            return np.nan, np.nan
        return float(getattr(self.fit, name)), float(getattr(self.fit, f"{name}_stderr"))

    @property
    def moment_widths(self) -> Widths:
        """D4σ along the long and the short axis [px]; NaN if it was not measured."""
        moments = self.moments
        if not moments.is_measured:
            return [(np.nan, np.nan)] * 2
        return [(moments.major, moments.major_stderr), (moments.minor, moments.minor_stderr)]

    @property
    def fit_widths(self) -> Widths:
        """4σ of the fit along the long and the short axis [px]; NaN if there is no fit."""
        return [(4 * sigma, 4 * stderr) for sigma, stderr in map(self.fit_value, ("sigma_major", "sigma_minor"))]

    @property
    def clip_widening(self) -> float:
        """Factor by which the clip widens D4σ of the fitted Gaussian; 1 without a clip."""
        if not self.clipping.pixels or self.fit is None:
            return 1.0
        clip_dn = max(self.clipping.level_dn - float(self.fit.offset), LEAST_CLIP_DN)
        return compute_clip_widening(float(self.fit.amplitude) / clip_dn)

    @property
    def width_excess(self) -> float:
        """Relative excess of the mean D4σ over 4σ of the fit; 0 if it is not significant or a width is unknown.

        The widening of D4σ by a clip does not count.
        """
        if not self.moments.is_measured:
            return 0.0
        (major, major_stderr), (minor, minor_stderr) = self.fit_widths
        fit_width = (major + minor) / 2, float(np.hypot(major_stderr, minor_stderr)) / 2
        return compute_width_excess(
            self.moments.mean_width, fit_width, is_whole=self.moments.is_whole, clip_widening=self.clip_widening
        )


def analyse_image(image: Image, camera: Camera, z_m: float | None = None) -> ImageResult:
    """Return the results for one image.

    Parameters
    ----------
    image : the image.
    camera : camera that took it.
    z_m : position along the beam [m], if known.

    Returns
    -------
    ImageResult
        Fit and picture are None if nothing stands out of the noise, the picture also if the fit does not converge.

    Raises
    ------
    InputError
        If the image has no finite reading.
    """
    pixels = image.read()
    moments = second_moments(pixels)
    outlier_text, fit, picture, residual_rms = "", None, None, np.nan
    if np.isfinite(moments.x):
        top, left, window = _cut_window(pixels, moments)
        # With the sensor model the fit is by maximum likelihood. A noise model from a fit is too rough for that.
        sensor = camera.sensor_model(pixels)
        noise = sensor or _estimate_noise(_mask_clip(window, camera) / camera.step_dn)
        if noise is not None and (outliers := find_outlier_pixels(window / camera.step_dn, noise)).mask.any():
            outlier_text = outliers.describe(left, top)
            # The window is a view of the pixels: the outliers become NaN in both.
            window[outliers.mask] = np.nan
            moments = second_moments(pixels)
        fit = _fit_window(window, camera, sensor, noise)
        if fit.status != "not_converged":
            picture = _make_picture(window, fit, top, left)
            residual_rms = _measure_residual(_mask_clip(window, camera), fit)
            # From here on positions are those in the image.
            fit.value[NAMES.index("x_centre")] += left
            fit.value[NAMES.index("y_centre")] += top
    readings = pixels[np.isfinite(pixels)]
    # Without a clip level of the camera, a plateau of this image is still reported.
    level = camera.clip_level_dn if np.isfinite(camera.clip_level_dn) else find_clip_level(pixels, image.bits)
    highest = float(readings.max()) if readings.size else np.nan
    clipping = Clipping(int(np.count_nonzero(readings >= level)), level, highest)
    return ImageResult(
        name=image.name, shape=pixels.shape, z_m=z_m, moments=moments, fit=fit, clipping=clipping,
        residual_rms=residual_rms, is_noise_known=camera.gain is not None, outlier_text=outlier_text,
        impossible_counts=image.impossible_readings.counts, picture=picture,
        has_swapped_spot=fit is None and image.bits == 16 and _has_spot_if_swapped(pixels),
    )  # fmt: skip


def _has_spot_if_swapped(pixels: np.ndarray) -> bool:
    """Return whether an image [rows, columns] of 16 bit shows a spot if the two bytes of each reading are swapped.

    NaN pixels read 0. Unlike the check of files, this also finds swapped bytes of readings that use all 16 bits.
    """
    swapped = np.nan_to_num(pixels).astype(np.uint16).byteswap().astype(float)
    # Noise, by differences of neighbours along a row, must be small beside the spot.
    if swapped.shape[1] < 2 or np.mean(np.diff(swapped, axis=1) ** 2) / 2 > MOST_NOISE_PART * swapped.var():
        return False
    return second_moments(swapped).is_measured


def compute_clip_widening(amplitude_over_clip: float) -> float:
    """Return the factor √(⟨r²⟩/2σ²) by which a clip widens D4σ of a Gaussian; 1 without a clip.

    With ρ = r²/2σ² and ρc = ln amplitude_over_clip, where the clip begins,
    ⟨r²⟩/2σ² = ∫ρ min(e^−ρ, e^−ρc) dρ / ∫ min(e^−ρ, e^−ρc) dρ = (ρc²/2 + ρc + 1) / (ρc + 1).

    Parameters
    ----------
    amplitude_over_clip : amplitude of the Gaussian over the clip level, which is counted from the offset too; 1 or
        below means no clip.
    """
    rho_clip = np.log(max(amplitude_over_clip, 1.0))
    return float(np.sqrt((rho_clip**2 / 2 + rho_clip + 1) / (rho_clip + 1)))


def _cut_window(pixels: np.ndarray, moments: Moments) -> tuple[int, int, np.ndarray]:
    """Return first row, first column [px] and readings [rows, columns] of the window to fit, a view of `pixels`.

    The window is the whole image if its spot has no width.
    """
    if not np.isfinite(moments.major):
        return 0, 0, pixels
    half = max(HALF_SIDE * moments.major, LEAST_HALF_SIDE)
    top, left = max(int(moments.y - half), 0), max(int(moments.x - half), 0)
    return top, left, pixels[top : int(moments.y + half) + 2, left : int(moments.x + half) + 2]


def _mask_clip(window: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the window [rows, columns] in DN with NaN at clipped pixels."""
    return np.where(window >= camera.clip_level_dn, np.nan, window)


def _fit_window(window: np.ndarray, camera: Camera, sensor: SensorModel | None, noise: SensorModel | None) -> SpotFits:
    """Return the Gaussian fit of a window [rows, columns] in DN.

    The fit is by maximum likelihood with a `sensor` model, else with equal weights and without a χ². `noise` gives the
    errors of a fit with equal weights. Both models count in units of `camera.step_dn`; None means unknown.
    """
    step_dn, unclipped_window = camera.step_dn, _mask_clip(window, camera) / camera.step_dn
    if sensor is None:
        fit = _inflate_errors(fit_spots(unclipped_window, noise, weighting="equal"))
        return _convert_to_dn(replace(fit, chi2_reduced=np.asarray(np.nan)), step_dn)
    # A likelihood takes the clip into account, so that clipped pixels stay.
    fit, equal_weight_fit = fit_spots(window / step_dn, sensor), None
    if fit.chi2_reduced > GAUSSIAN_CHI2:
        equal_weight_fit = fit_spots(unclipped_window, noise, weighting="equal")
    return _convert_to_dn(_inflate_errors(fit, equal_weight_fit), step_dn)


def _estimate_noise(window: np.ndarray) -> SensorModel | None:
    """Return a rough noise model from the residuals of a fit with equal weights, for errors of fits and outliers.

    `window` [rows, columns] and the model are in rounding steps; clipped pixels are NaN. Returns None if the fit fails,
    bright or dark pixels are too few, the noise does not grow with the signal, or rounding hides it.
    """
    fit = fit_spots(window, weighting="equal")
    if fit.status != "ok":
        return None
    signal = evaluate_fit(fit.value, *np.ogrid[: window.shape[0], : window.shape[1]]) - fit.offset
    # The median of these squares is the variance of normal noise, and hot pixels hardly change it.
    scaled_squares = (window - signal - fit.offset) ** 2 / chi2.median(1)
    is_bright = (signal > BRIGHT * fit.amplitude) & np.isfinite(window)
    is_dark = (signal < DARK * fit.amplitude) & np.isfinite(window)
    if min(np.count_nonzero(is_bright), np.count_nonzero(is_dark)) < FEWEST_PIXELS:
        return None
    dark_variance = float(np.median(scaled_squares[is_dark]))
    growth = float(np.median(scaled_squares[is_bright])) - dark_variance
    if growth < LEAST_GROWTH * dark_variance or dark_variance < ROUNDING_VARIANCE:
        return None
    # Shot noise: the variance grows by the gain times the signal.
    gain = growth / float(np.mean(signal[is_bright]))
    read_noise = float(np.sqrt(max(dark_variance - ROUNDING_VARIANCE, 0.0))) / gain
    return SensorModel(gain, read_noise, black_level_dn=float(fit.offset))


def _inflate_errors(fit: SpotFits, equal_weight_fit: SpotFits | None = None) -> SpotFits:
    """Return a fit with errors times √χ² if the reduced χ² exceeds 1.

    If a fit with equal weights is given and converged, the difference from it is added in quadrature: the weighting of
    pixels is arbitrary for a spot that is not Gaussian.
    """
    factor = np.sqrt(max(float(np.nan_to_num(fit.chi2_reduced, nan=1.0)), 1.0))
    stderr, covariance = fit.stderr * factor, fit.covariance * factor**2
    if equal_weight_fit is not None and equal_weight_fit.status != "not_converged":
        difference = equal_weight_fit.value - fit.value
        # Directions of an axis repeat after 180°.
        angle = NAMES.index("orientation")
        difference[angle] = (difference[angle] + 90) % 180 - 90
        stderr = np.hypot(stderr, difference)
        covariance = covariance + np.diag(difference[:FITTED_PARAMETERS] ** 2)
    return replace(fit, stderr=stderr, covariance=covariance)


def _convert_to_dn(fit: SpotFits, step_dn: float) -> SpotFits:
    """Return a fit of readings in units of `step_dn` as one of readings in DN."""
    factor = np.where(np.isin(NAMES, ("amplitude", "offset")), step_dn, 1.0)
    covariance = fit.covariance * np.outer(factor[:FITTED_PARAMETERS], factor[:FITTED_PARAMETERS])
    return replace(fit, value=fit.value * factor, stderr=fit.stderr * factor, covariance=covariance)


def _measure_residual(window: np.ndarray, fit: SpotFits) -> float:
    """Return the rms residual of a window [rows, columns] in DN within the 1/e² contour, as a fraction of the peak.

    NaN pixels do not count. Returns NaN if no pixel is within the contour.
    """
    model = evaluate_fit(fit.value, *np.ogrid[: window.shape[0], : window.shape[1]])
    is_inside = (model - fit.offset > fit.amplitude * np.exp(-2)) & np.isfinite(window)
    if not is_inside.any():
        return np.nan
    return float(np.sqrt(np.mean((window - model)[is_inside] ** 2)) / fit.amplitude)


def _make_picture(window: np.ndarray, fit: SpotFits, top: int, left: int) -> SpotPicture:
    """Return the readings of a window [rows, columns] in DN, thinned, and the profiles along both axes of the fit.

    `top` and `left` are first row and column of the window in the image [px], while positions of `fit` are those in the
    window. In profiles, NaN pixels read as the offset, and points outside the window are NaN.
    """
    step = max(1, math.ceil(max(window.shape) / PICTURE_SIDE))
    rows, columns = (np.array(window.shape) // step) * step
    extent = (left - 0.5, left + columns - 0.5, top + rows - 0.5, top - 0.5)
    # Every n-th pixel instead of means, which would hide noise and clip.
    thinned = window[:rows:step, :columns:step].astype(np.float32)
    filled = np.where(np.isfinite(window), window, float(fit.offset))

    def take_profile(angle: float, sigma: float) -> Profile:
        """Return the profile through the fitted centre at an angle [deg] for a width σ [px]."""
        distance = np.linspace(-PROFILE_SIGMAS, PROFILE_SIGMAS, PROFILE_POINTS) * sigma
        x = fit.x_centre + distance * np.cos(np.radians(angle))
        y = fit.y_centre + distance * np.sin(np.radians(angle))
        reading = ndimage.map_coordinates(filled, [y, x], order=1, cval=np.nan)
        return Profile(distance, reading, evaluate_fit(fit.value, y, x))

    angle = float(fit.orientation)
    profiles = take_profile(angle, float(fit.sigma_major)), take_profile(angle + 90, float(fit.sigma_minor))
    return SpotPicture(thinned, extent, profiles)
