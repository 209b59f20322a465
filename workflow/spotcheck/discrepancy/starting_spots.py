"""Spots of single frames: where fits start, and fits of one frame under a model that is fixed otherwise."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, select_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import is_law
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.moments import second_moments
from spotcheck.io import store
from spotcheck.model.effect import AppliedEffect, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage

# Smallest peak [DN] and width σ_g [px] from which a fit starts, and the largest width [sides of a crop].
LEAST_PEAK_DN, LEAST_SIGMA_PX, LARGEST_SIGMA = 1.0, 0.3, 1.0
# Width [sides of a crop] of a spot of which neither fit nor moments are known.
UNKNOWN_SIGMA = 0.1
# Largest width [sides of a crop] of a fit that is trusted: a wider spot cannot be told from a background.
WIDEST_SPOT = 0.7
# Names in fits.nc of peak, width and centre.
FITTED = ("amplitude", "sigma_mean", "x_centre", "y_centre")


@dataclass(frozen=True)
class FittedSpots:
    """Spots of F frames, each fitted alone."""

    spots: FrameParameters  # of the frames
    covariance: np.ndarray  # of ln peak, ln σ, x and y of each frame [frame, 4, 4]
    has_converged: np.ndarray  # whether the fit of a frame has converged [frame]

    @property
    def joint_covariance(self) -> np.ndarray:
        """Covariance of the parameters of frame after frame [4F, 4F]."""
        frames = len(self.covariance)
        out = np.zeros((frames, 4, frames, 4))
        out[np.arange(frames), :, np.arange(frames)] = self.covariance
        return out.reshape(4 * frames, 4 * frames)


def usable_cells(dataset: Dataset, status: xr.DataArray) -> list[tuple[tuple[int, ...], Frame]]:
    """Return place on the grid and row of the manifest of each usable spot frame, in the order of `load_frames`.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    status : xr.DataArray
        Flags of the crops over the grid, at one centring.
    """
    # A name of a dimension that was not recorded is kept by the file of crops as well.
    dims = [axis.name for axis in dataset.axes]
    number = {id(frame): k for k, frame in enumerate(dataset.spots)}
    cells = [(at, frame) for at, frame in dataset.cells() if is_usable(status.isel(dict(zip(dims, at, strict=True))))]
    return sorted(cells, key=lambda cell: number[id(cell[1])])


def load_spots(fits: xr.Dataset, frames: FrameSet, cells: Iterable[tuple[tuple[int, ...], Frame]]) -> FrameParameters:
    """Return the spots of frames as fits.nc has them; those of frames without a trusted fit come from moments.

    Parameters
    ----------
    fits : xr.Dataset
        Content of fits.nc.
    frames : FrameSet
        The frames.
    cells : iterable of (index, Frame)
        Place of each frame on the grid, as `usable_cells` returns it.
    """
    trusted = _trusted_fits(fits, cells)
    rows = [_spot_by_moments(frames, f) if row is None else row for f, row in enumerate(trusted)]
    return _as_parameters(np.array(rows).reshape(-1, 4), frames)


def has_trusted_fit(fits: xr.Dataset, cells: Iterable[tuple[tuple[int, ...], Frame]]) -> bool:
    """Return whether fits.nc has a trusted fit of any frame; parameters as in `load_spots`."""
    return any(row is not None for row in _trusted_fits(fits, cells))


def _trusted_fits(fits: xr.Dataset, cells: Iterable[tuple[tuple[int, ...], Frame]]) -> list[np.ndarray | None]:
    """Return peak [DN], width [px], column and row of each frame; None without a trusted fit."""
    fit, dims = select_preferred_fits(fits), store.grid_dims(fits)
    status = fit["status"].transpose(*dims).values
    values = np.stack([fit[name].transpose(*dims).values.astype(float) for name in FITTED], axis=-1)
    rows: list[np.ndarray | None] = []
    for index, _ in cells:
        row = values[index]
        is_trusted = not status[index] & store.UNTRUSTED and row[0] > 0 and row[1] > 0 and np.isfinite(row).all()
        rows.append(row if is_trusted else None)
    return rows


def spots_by_moments(frames: FrameSet) -> FrameParameters:
    """Return the spots of frames by second moments, for frames that nobody has fitted."""
    return _as_parameters(np.array([_spot_by_moments(frames, f) for f in range(len(frames))]).reshape(-1, 4), frames)


def _spot_by_moments(frames: FrameSet, number: int) -> np.ndarray:
    """Return peak [DN], width [px], column and row of the spot of a frame; of a frame without light its middle."""
    image = np.asarray(frames.readings[number], float)
    moments = second_moments(image)
    corner = np.array([frames.left[number], frames.top[number]], float)
    sigma = np.sqrt(moments.major * moments.minor) / 4  # D4σ
    peak = moments.light / (2 * np.pi * sigma**2)
    if np.isfinite([peak, sigma]).all() and min(peak, sigma) > 0:
        return np.array([peak, sigma, moments.x + corner[0], moments.y + corner[1]])
    is_known = np.isfinite(image)
    light = np.ptp(image[is_known]) if is_known.any() else 0.0
    middle = (np.array(image.shape[::-1]) - 1) / 2
    centre = np.array([moments.x, moments.y])
    centre = np.where(np.isfinite(centre), centre, middle) + corner
    return np.array([light, UNKNOWN_SIGMA * max(image.shape), *centre])


def _as_parameters(rows: np.ndarray, frames: FrameSet) -> FrameParameters:
    """Return spots from peak, width, column and row [frame, 4], moved to what a fit may start from."""
    peak, sigma, x, y = rows.T
    _, height, width = frames.readings.shape
    return FrameParameters(
        log_peak=np.log(np.maximum(peak, LEAST_PEAK_DN)),
        log_sigma=np.log(np.clip(sigma, LEAST_SIGMA_PX, LARGEST_SIGMA * max(height, width))),
        x=np.clip(x, frames.left, frames.left + width - 1),
        y=np.clip(y, frames.top, frames.top + height - 1),
    )


def acts_on_mean(applied: AppliedEffect) -> bool:
    """Return whether an effect enters the mean image of a frame whose brightness and width are fitted."""
    steps = applied.effect.variants[applied.variant]
    is_random = all(isinstance(step, RandomStep) and step.stage is not Stage.WELL for step in steps)
    return not is_random and not is_law(applied.effect)


def fit_spots(forward: ForwardModel, frames: FrameSet, start: FrameParameters) -> FittedSpots:
    """Fit the spot of each frame under a model.

    Laws and random effects take no part: each frame has its own brightness, width and centre.

    Parameters
    ----------
    forward : ForwardModel
        Baseline, sensor and effects, which are fixed.
    frames : FrameSet
        The frames.
    start : FrameParameters
        Spot of each frame, from which its fit starts.
    """
    forward = replace(forward, law=None, effects=tuple(filter(acts_on_mean, forward.effects)))

    def fit_one(number: int) -> JointFit:
        frame = frames.select(np.array([number]))
        model = JointModel(forward, start.select(np.array([number])), frame.design)
        return fit_jointly(model, select_pixels(frame, model.spots))

    # Frames are fitted one by one, so that a frame's result does not depend on the others.
    with ThreadPoolExecutor(THREADS) as pool:
        fits = list(pool.map(fit_one, range(len(frames))))
    covariance = [
        # A misfit widens the errors, and so does granular light that neighbouring pixels share.
        invert_information(fit.equations.information) * max(fit.equations.dispersion, fit.pixels.dispersion)
        for fit in fits
    ]
    rows = np.array([fit.model.spots.as_rows()[:, 0] for fit in fits]).reshape(-1, 4)
    return FittedSpots(
        FrameParameters(*rows.T), np.array(covariance).reshape(-1, 4, 4), np.array([fit.has_converged for fit in fits])
    )
