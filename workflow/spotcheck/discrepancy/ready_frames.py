"""Frames of a dataset, selected and given starting spots, ready to be analysed for a verdict."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from spotcheck.characterization.sensor_choice import read_sensor_model, read_standard_errors
from spotcheck.crops.cropping import is_usable
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.analysis import Setting
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, load_frames
from spotcheck.discrepancy.starting_spots import (
    WIDEST_SPOT,
    fit_spots,
    has_trusted_fit,
    load_spots,
    spots_by_moments,
    usable_cells,
)
from spotcheck.io import store
from spotcheck.model.baseline import of_instrument
from spotcheck.model.forward import ForwardModel

UNKNOWN_SENSOR = "gain or read noise of the sensor is unknown, and the frames do not tell them"
NO_SPOT = "no spot could be fitted in any frame"
TOO_WIDE = f"{NO_SPOT}: it is as wide as its crop"
# Crops of one site that lie further apart than this part of a crop do not show the same spot.
SITE_SHIFT = 0.5


@dataclass(frozen=True)
class ReadyFrames:
    """The frames of a dataset, ready to be analysed."""

    frames: FrameSet  # usable frames that show the spot of their site
    cells: tuple[tuple[tuple[int, ...], Frame], ...]  # place on the grid and row of the manifest of each frame
    spots: FrameParameters  # spot of each frame, from which fits start
    setting: Setting  # what the instrument fixes
    remarks: tuple[str, ...]  # what of the dataset no verdict rests on

    @property
    def indices(self) -> list[tuple[int, ...]]:
        """Place of each frame on the grid."""
        return [index for index, _ in self.cells]

    @property
    def rows(self) -> list[Frame]:
        """Row of the manifest of each frame."""
        return [row for _, row in self.cells]


def prepare_dataset(
    dataset: Dataset, crops: xr.Dataset, sensor: xr.Dataset, fits: xr.Dataset | None
) -> ReadyFrames | str:
    """Return the frames of a dataset, ready to be analysed; or in one sentence why they cannot be.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    crops, sensor : xr.Dataset
        Content of crops.nc and sensor.nc.
    fits : xr.Dataset or None
        Content of fits.nc, from which fits start; None to fit each frame alone first.
    """
    cells = usable_cells(dataset, crops["status"].sel(centring="light"))
    unusable = describe_unusable(dataset, crops)
    if not cells:
        return unusable
    model = read_sensor_model(sensor)
    if model is None:
        return UNKNOWN_SENSOR
    if not dataset.exposures:
        # Without exposures nobody knows what a dark current per second brings.
        model = replace(model, dark_current_e_per_s=0.0)
    frames = load_frames(dataset, crops)
    shows_spot = find_shared_spots(frames, dataset.instrument.crop_px)
    left_out = len(frames) - int(shows_spot.sum())
    remarks = [unusable, *store.remarks_of(sensor), never_searched(frames.select(np.flatnonzero(shows_spot)))]
    if left_out:
        text = "spots lie more than half a crop from where their site has its others"
        remarks.append(f"{left_out} of {len(frames)} {text}")
        frames = frames.select(np.flatnonzero(shows_spot))
        cells = [cell for cell, is_kept in zip(cells, shows_spot, strict=True) if is_kept]
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    spots: FrameParameters | str
    if fits is not None and has_trusted_fit(fits, cells):
        spots = load_spots(fits, frames, cells)
    else:
        spots = fit_starting_spots(ForwardModel(replace(baseline, photon_budget="free"), model), frames)
    if isinstance(spots, str):
        return spots
    names = ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    stderr = dict(zip(names, read_standard_errors(sensor), strict=True))
    setting = Setting(baseline, model, float(dataset.instrument.crop_px), stderr)
    return ReadyFrames(frames, tuple(cells), spots, setting, tuple(filter(None, remarks)))


def fit_starting_spots(forward: ForwardModel, frames: FrameSet) -> FrameParameters | str:
    """Return the spot of each frame, fitted alone, or by moments if its fit fails; or why no frame has a spot."""
    moments = spots_by_moments(frames)
    fitted = fit_spots(forward, frames, moments)
    is_wide = np.exp(fitted.spots.log_sigma) > WIDEST_SPOT * min(frames.readings.shape[1:])
    is_trusted = fitted.has_converged & ~is_wide
    if not is_trusted.any():
        return TOO_WIDE if (fitted.has_converged & is_wide).any() else NO_SPOT
    return FrameParameters(*np.where(is_trusted, fitted.spots.as_rows(), moments.as_rows()))


def describe_unusable(dataset: Dataset, crops: xr.Dataset) -> str:
    """Return how many spot frames cannot be used, and why; "" if all can."""
    total = len(dataset.spots)
    if not total:
        return "the manifest names no spot frame, and flats and darks are judged by `spotcheck flats`"
    status, dims = crops["status"].sel(centring="light"), store.grid_dims(crops)
    flags = [int(status.isel(dict(zip(dims, index, strict=True)))) for index, _ in dataset.cells()]
    reasons = Counter(text for flag in flags for bit, (_, text) in store.STATUS.items() if flag & bit & store.UNUSABLE)
    if not reasons:
        return ""
    count = sum(not is_usable(flag) for flag in flags)
    if total == 1:
        subject = "the only spot frame cannot"
    elif count == total:
        subject = f"none of {total} spot frames can"
    else:
        subject = f"{count} of {total} spot frames cannot"
    parts = [text if len(reasons) == 1 else f"{number}: {text}" for text, number in reasons.items()]
    return f"{subject} be used ({'; '.join(parts)})"


def find_shared_spots(frames: FrameSet, crop_px: int) -> np.ndarray:
    """Return which frames [frame] show the spot of their site.

    Crops of a site that lie far apart show different things. The largest group counts; of equal ones, that with the
    longest exposure.
    """
    site, exposure_s = frames.design.site, frames.design.exposure_s
    shows_spot = np.zeros(len(frames), bool)
    for number in np.unique(site):
        members = np.flatnonzero(site == number)
        corners = np.stack([frames.left[members], frames.top[members]], 1)
        distance = np.abs(corners[:, None] - corners[None]).max(axis=2)
        groups = [members[near] for near in distance <= SITE_SHIFT * crop_px]
        shows_spot[max(groups, key=lambda group: (len(group), exposure_s[group].max()))] = True
    return shows_spot


def never_searched(frames: FrameSet) -> str:
    """Return how many frames belong to conditions of which all frames are held out; "" if there is none."""
    is_held_out = frames.held_out()
    keys = np.stack([frames.design.condition, frames.design.angle], 1)
    searched = {tuple(key) for key in keys[~is_held_out]}
    count = sum(tuple(key) not in searched for key in keys[is_held_out])
    if not count:
        return ""
    subject = "1 frame belongs" if count == 1 else f"{count} frames belong"
    return f"{subject} to conditions of which every frame is held out: they test the model, but did not select it"
