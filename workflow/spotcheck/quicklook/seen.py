"""What one image shows: the spot by a Gaussian fit and by its second moments, its shape, and what is clipped."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.stats import chi2

from spotcheck.characterization.odd_pixels import odd_pixels
from spotcheck.fitting.fit_results import NAMES, SpotFits
from spotcheck.fitting.moments import AREA, Moments, second_moments
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.model import spot
from spotcheck.quicklook.camera import Camera, stop_of
from spotcheck.quicklook.images import Image
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Half the side of the window that is fitted, in D4σ: the area of integration and a rim that tells the background.
HALF = 0.6 * AREA
# Side of the picture's window [px] at most, and points of a profile.
PICTURE, POINTS = 240, 241
# Light above and below these parts of the peak is compared where the camera's noise is unknown, and pixels that takes.
BRIGHT, DARK, FEWEST = 0.3, 0.02, 30
# χ² per degree of freedom up to which a light is a Gaussian within its noise, whose law is not known exactly.
AS_NOISE = 1.1
# Variance that grows with light by less than this part does not: errors are then 5 % off.
GROWN = 0.1


class Profile(NamedTuple):
    """Readings along an axis of the fitted spot and those of the fit [DN], at distances from its centre [px]."""

    distance: np.ndarray
    reading: np.ndarray
    fitted: np.ndarray


class Picture(NamedTuple):
    """What a picture of the spot needs: readings of the window, thinned, with the edges that they span [px: left,
    right, bottom, top], and the profiles along the longer and the shorter axis."""

    window: np.ndarray
    extent: tuple[float, float, float, float]
    profiles: tuple[Profile, ...]


class Seen(NamedTuple):
    """One image. Lengths are in px, readings in DN.

    Attributes
    ----------
    name, rows, columns : the image.
    z_m : where along the beam it was taken [m]; None where nobody says so.
    moments : the spot by second moments.
    fit : the spot by its Gaussian fit; None where there is no spot. Errors are times √χ² where the residuals
        exceed the noise.
    highest_dn : highest reading.
    clipped_px, stop_dn : pixels at the reading at which the camera stops, and that reading (infinite: none does).
    misfit : rms of the residuals within the 1/e² contour, in parts of the fitted peak.
    noise_known : whether the fit knows the camera's noise.
    left_out : pixels that were left out, in words.
    picture : what is drawn; None where there is no spot.
    """

    name: str
    rows: int
    columns: int
    z_m: float | None
    moments: Moments
    fit: SpotFits | None
    highest_dn: float
    clipped_px: int
    stop_dn: float
    misfit: float
    noise_known: bool
    left_out: str
    picture: Picture | None

    @property
    def fitted(self) -> bool:
        """Whether the fit can be trusted."""
        return self.fit is not None and self.fit.status == "ok"

    def fitted_to(self, name: str) -> tuple[float, float]:
        """A parameter of the fit and its standard error; NaN where there is no fit."""
        if self.fit is None:
            return np.nan, np.nan
        return float(getattr(self.fit, name)), float(getattr(self.fit, f"{name}_stderr"))

    @property
    def widened(self) -> float:
        """Factor by which the clip widens D4σ of the fitted Gaussian; 1 without a clip."""
        if not self.clipped_px or self.fit is None:
            return 1.0
        return widened_by_clip(float(self.fit.amplitude) / max(self.stop_dn - float(self.fit.offset), 1e-9))


def seen_on(image: Image, camera: Camera, z_m: float | None = None) -> Seen:
    """Look at one image of a camera."""
    pixels = image.read()
    moments = second_moments(pixels)
    left_out, fit, picture, misfit = "", None, None, np.nan
    if np.isfinite(moments.x):
        top, left, window = _window(pixels, moments)
        sensor = camera.sensor(pixels)
        step = camera.step_dn
        noise = sensor or _noise_by_residuals(_below_stop(window, camera) / step)
        if noise is not None and (odd := odd_pixels(window / step, noise)).mask.any():
            left_out = odd.sentence(left, top)
            window = np.where(odd.mask, np.nan, window)
            pixels = pixels.copy()
            pixels[top : top + window.shape[0], left : left + window.shape[1]] = window
            moments = second_moments(pixels)
        fit = _fitted(window, camera, sensor, noise)
        if fit.status != "not_converged":
            picture, misfit = _picture(window, fit, top, left), _misfit(window, fit, camera.stop_dn)
            fit.value[1] += left
            fit.value[2] += top
    known = pixels[np.isfinite(pixels)]
    stop = camera.stop_dn if np.isfinite(camera.stop_dn) else stop_of(pixels, image.bits)
    return Seen(
        image.name, pixels.shape[0], pixels.shape[1], z_m, moments, fit, float(known.max()) if known.size else np.nan,
        int(np.count_nonzero(known >= stop)), stop, misfit, camera.gain is not None, left_out, picture,
    )  # fmt: skip


def widened_by_clip(height: float) -> float:
    """Factor on D4σ of a Gaussian whose light stops at 1/height of its peak.

    With ρ = r²/2σ² and ρc = ln height, ⟨r²⟩/2σ² = ∫ρ min(e^−ρ, e^−ρc) dρ / ∫ min(e^−ρ, e^−ρc) dρ
    = (ρc²/2 + ρc + 1) / (ρc + 1).
    """
    cut = np.log(max(height, 1.0))
    return float(np.sqrt((cut**2 / 2 + cut + 1) / (cut + 1)))


def _window(pixels: np.ndarray, moments: Moments) -> tuple[int, int, np.ndarray]:
    """First row, first column and pixels of what is fitted; the whole image where no width is known."""
    if not np.isfinite(moments.major):
        return 0, 0, pixels
    half = max(HALF * moments.major, 8.0)
    top, left = max(int(moments.y - half), 0), max(int(moments.x - half), 0)
    return top, left, pixels[top : int(moments.y + half) + 2, left : int(moments.x + half) + 2]


def _fitted(window: np.ndarray, camera: Camera, sensor: SensorModel | None, noise: SensorModel | None) -> SpotFits:
    """The Gaussian fit of a window: by the sensor's law where that is known, else with equal weights."""

    def equal() -> SpotFits:
        return fit_spots(_below_stop(window, camera) / camera.step_dn, noise, weighting="equal")

    if sensor is None:
        return _in_dn(replace(_with_misfit(equal()), chi2_reduced=np.asarray(np.nan)), camera.step_dn)
    fit = fit_spots(window / camera.step_dn, sensor)
    return _in_dn(_with_misfit(fit, equal() if fit.chi2_reduced > AS_NOISE else None), camera.step_dn)


def _below_stop(window: np.ndarray, camera: Camera) -> np.ndarray:
    """The window, NaN where the image stops."""
    return np.where(window >= camera.stop_dn, np.nan, window)


def _noise_by_residuals(window: np.ndarray) -> SensorModel | None:
    """A law of noise that grows with light by the residuals of a fit, for its errors alone; None where it does not
    grow, or is finer than whole numbers. Medians pass over hot pixels."""
    fit = fit_spots(window, weighting="equal")
    if fit.status != "ok":
        return None
    y, x = np.ogrid[: window.shape[0], : window.shape[1]]
    light = _model(fit, y, x) - fit.offset
    squared = (window - light - fit.offset) ** 2 / chi2.median(1)
    bright = (light > BRIGHT * fit.amplitude) & np.isfinite(window)
    dark = (light < DARK * fit.amplitude) & np.isfinite(window)
    if min(np.count_nonzero(bright), np.count_nonzero(dark)) < FEWEST:
        return None
    floor = float(np.median(squared[dark]))
    grown = float(np.median(squared[bright])) - floor
    # Rounding hides noise that is finer.
    if grown < GROWN * floor or floor < ROUNDING_VARIANCE:
        return None
    gain = grown / float(np.mean(light[bright]))
    return SensorModel(
        gain, float(np.sqrt(max(floor - ROUNDING_VARIANCE, 0.0))) / gain, black_level_dn=float(fit.offset)
    )


def _with_misfit(fit: SpotFits, otherwise: SpotFits | None = None) -> SpotFits:
    """A fit whose errors hold what its residuals exceed the noise by, and how far a fit lies that weighs pixels
    `otherwise`: of light that is no Gaussian, nothing says which is right."""
    times = np.sqrt(max(float(np.nan_to_num(fit.chi2_reduced, nan=1.0)), 1.0))
    stderr, covariance = fit.stderr * times, fit.covariance * times**2
    if otherwise is not None and otherwise.status != "not_converged":
        apart = otherwise.value - fit.value
        turn = NAMES.index("orientation")
        apart[turn] = (apart[turn] + 90) % 180 - 90
        stderr, covariance = np.hypot(stderr, apart), covariance + np.diag(apart[:7] ** 2)
    return SpotFits(fit.value.copy(), stderr, covariance, fit.chi2_reduced, fit.flags)


def _in_dn(fit: SpotFits, step_dn: float) -> SpotFits:
    """A fit of readings in steps as one in DN."""
    factor = np.where(np.isin(NAMES, ("amplitude", "offset")), step_dn, 1.0)
    covariance = fit.covariance * np.outer(factor[:7], factor[:7])
    return SpotFits(fit.value * factor, fit.stderr * factor, covariance, fit.chi2_reduced, fit.flags)


def _model(fit: SpotFits, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The fitted spot [DN] at rows and columns of the window."""
    amplitude, x0, y0, major, minor, orientation, offset, _ = fit.value
    return spot.elliptical_gaussian(x, y, amplitude, x0, y0, major, minor, np.radians(orientation)) + offset


def _misfit(window: np.ndarray, fit: SpotFits, stop_dn: float) -> float:
    """rms of the residuals of whole readings within the 1/e² contour, in parts of the peak."""
    y, x = np.ogrid[: window.shape[0], : window.shape[1]]
    model = _model(fit, y, x)
    inside = (model - fit.offset > fit.amplitude * np.exp(-2)) & (window < stop_dn)
    if not inside.any():
        return np.nan
    return float(np.sqrt(np.mean((window - model)[inside] ** 2)) / fit.amplitude)


def _picture(window: np.ndarray, fit: SpotFits, top: int, left: int) -> Picture:
    """Window and profiles for a picture."""
    step = max(1, -(-max(window.shape) // PICTURE))
    rows, columns = (np.array(window.shape) // step) * step
    edges = (left - 0.5, left + columns - 0.5, top + rows - 0.5, top - 0.5)
    # The pixel itself, not a mean: a mean would hide noise and clip.
    thin = window[:rows:step, :columns:step].astype(np.float32)
    filled, profiles = np.where(np.isfinite(window), window, float(fit.offset)), []
    for angle, sigma in ((fit.orientation, fit.sigma_major), (fit.orientation + 90, fit.sigma_minor)):
        u = np.linspace(-5, 5, POINTS) * float(sigma)
        x, y = fit.x_centre + u * np.cos(np.radians(angle)), fit.y_centre + u * np.sin(np.radians(angle))
        reading = ndimage.map_coordinates(filled, [y, x], order=1, cval=np.nan)
        profiles.append(Profile(u, reading, _model(fit, y, x)))
    return Picture(thin, edges, tuple(profiles))
