"""Spots of single frames: starting values by fits.nc or by moments, and fits of single frames under a fixed model.

The spot parameters of a frame are ln peak, ln σ, x and y, with the peak in DN, the width σ_g and the centre in px. A
law makes
brightness and width follow the conditions of a frame, such as its exposure.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import linalg

from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Cell, FrameParameters, FrameSet, select_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import is_law
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.moments import second_moments
from spotcheck.io import store
from spotcheck.model.effect import AppliedEffect, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage

# Smallest peak [DN] and width σ_g [px] from which a fit starts, and the largest width [longest side of a crop].
LEAST_PEAK_DN, LEAST_SIGMA_PX, LARGEST_SIGMA = 1.0, 0.3, 1.0
# Width [longest side of a crop] of a spot that has neither a fit nor moments.
UNKNOWN_SIGMA = 0.1
# Largest width [shortest side of a crop] of a fit that is trusted: a wider spot cannot be distinguished from a
# background.
WIDEST_SPOT = 0.7
# Names in fits.nc of peak [DN], width [px], column and row of the centre [px].
FITTED = ("amplitude", "sigma_mean", "x_centre", "y_centre")
# D4σ, a second-moment width, in standard deviations of a Gaussian.
D4SIGMA = 4


@dataclass(frozen=True)
class FittedSpots:
    """Spots of F frames, each fitted alone."""

    spots: FrameParameters  # spot parameters of the frames
    covariance: np.ndarray  # of ln peak, ln σ, x and y of each frame [frame, 4, 4]
    has_converged: np.ndarray  # True for frames whose fit has converged [frame]

    @property
    def joint_covariance(self) -> np.ndarray:
        """Covariance of the spot parameters of frame after frame [4F, 4F]: 0 between frames."""
        return linalg.block_diag(*self.covariance)


def load_spots(fits: xr.Dataset, frames: FrameSet, cells: Iterable[Cell]) -> FrameParameters | None:
    """Return the spots of frames by fits.nc, or by second moments for frames without a trusted fit.

    None if no frame has a trusted fit.

    Parameters
    ----------
    fits : xr.Dataset
        Content of fits.nc.
    frames : FrameSet
        The frames.
    cells : iterable of (index, Frame)
        Cell of each frame, in the order of `frames.usable_cells`.
    """
    fit, dims = select_preferred_fits(fits), store.grid_dims(fits)
    status = fit["status"].transpose(*dims).values
    values = np.stack([fit[name].transpose(*dims).values.astype(float) for name in FITTED], axis=-1)
    rows, has_trusted_fit = [], False
    for frame, (index, _) in enumerate(cells):
        row = values[index]
        # `UNTRUSTED` is the set of flags of fits that must not be used, such as those that did not converge.
        is_trusted = not status[index] & store.UNTRUSTED and row[0] > 0 and row[1] > 0 and np.isfinite(row).all()
        rows.append(row if is_trusted else _spot_by_moments(frames, frame))
        has_trusted_fit |= is_trusted
    return _as_parameters(rows, frames) if has_trusted_fit else None


def spots_by_moments(frames: FrameSet) -> FrameParameters:
    """Return the spots of frames by second moments of their readings."""
    return _as_parameters([_spot_by_moments(frames, f) for f in range(len(frames))], frames)


def _spot_by_moments(frames: FrameSet, frame: int) -> np.ndarray:
    """Return peak [DN], width σ_g, column and row on the sensor [px] of a frame's spot by second moments.

    Without a width the peak is the range of the readings. The centre is that of the light, or of the crop without
    light.
    """
    image = np.asarray(frames.readings[frame], float)
    moments = second_moments(image)
    corner = np.array([frames.left[frame], frames.top[frame]], float)
    # Major and minor are the D4σ widths along both axes [px].
    sigma = np.sqrt(moments.major * moments.minor) / D4SIGMA
    peak = moments.light / (2 * np.pi * sigma**2)
    if np.isfinite([peak, sigma]).all() and min(peak, sigma) > 0:
        return np.array([peak, sigma, moments.x + corner[0], moments.y + corner[1]])
    is_measured = np.isfinite(image)
    reading_range = np.ptp(image[is_measured]) if is_measured.any() else 0.0
    middle = (np.array(image.shape[::-1]) - 1) / 2
    centre = np.array([moments.x, moments.y])
    centre = np.where(np.isfinite(centre), centre, middle) + corner
    return np.array([reading_range, UNKNOWN_SIGMA * max(image.shape), *centre])


def _as_parameters(rows: Sequence[np.ndarray], frames: FrameSet) -> FrameParameters:
    """Return spots from peak [DN], width, column and row [px] of each frame, clipped to what a fit may start from."""
    peak, sigma, x, y = np.array(rows).reshape(-1, SPOT_PARAMETERS).T
    _, height, width = frames.readings.shape
    return FrameParameters(
        log_peak=np.log(np.maximum(peak, LEAST_PEAK_DN)),
        log_sigma=np.log(np.clip(sigma, LEAST_SIGMA_PX, LARGEST_SIGMA * max(height, width))),
        x=np.clip(x, frames.left, frames.left + width - 1),
        y=np.clip(y, frames.top, frames.top + height - 1),
    )


def acts_on_mean(applied: AppliedEffect) -> bool:
    """Return whether an effect enters the mean image of a frame whose brightness and width are fitted.

    Laws of brightness and width do not, nor random effects, except those at the well of a pixel: averaged over pixels
    they bend the mean.
    """
    steps = applied.effect.variants[applied.variant]
    is_random = all(isinstance(step, RandomStep) and step.stage is not Stage.WELL for step in steps)
    return not is_random and not is_law(applied.effect)


def fit_spots(forward: ForwardModel, frames: FrameSet, start: FrameParameters) -> FittedSpots:
    """Fit the spot of each frame alone under a model whose other parameters are fixed.

    Laws across frames and random effects take no part, see `acts_on_mean`.

    Parameters
    ----------
    forward : ForwardModel
        Baseline, sensor and effects.
    frames : FrameSet
        The frames.
    start : FrameParameters
        Spot of each frame, from which its fit starts.
    """
    forward = replace(forward, law=None, effects=tuple(filter(acts_on_mean, forward.effects)))

    def fit_frame(frame: int) -> JointFit:
        """Return the fit of one frame."""
        selected = frames.select(np.array([frame]))
        model = JointModel(forward, start.select(np.array([frame])), selected.design)
        return fit_jointly(model, select_pixels(selected, model.spots))

    # Frames are fitted one by one, so that a frame's result does not depend on the others.
    with ThreadPoolExecutor(THREADS) as pool:
        fits = list(pool.map(fit_frame, range(len(frames))))
    covariances = [
        # A misfit widens the errors, and so does granular light that neighbouring pixels share.
        invert_information(fit.equations.information) * max(fit.equations.dispersion, fit.pixels.dispersion)
        for fit in fits
    ]
    rows = np.array([fit.model.spots.as_rows()[:, 0] for fit in fits]).reshape(-1, SPOT_PARAMETERS)
    covariance = np.array(covariances).reshape(-1, SPOT_PARAMETERS, SPOT_PARAMETERS)
    return FittedSpots(FrameParameters(*rows.T), covariance, np.array([fit.has_converged for fit in fits]))
