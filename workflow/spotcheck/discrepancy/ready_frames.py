"""Frames of a dataset that are ready to be analysed for a verdict: selected, and with spots from which fits start.

A site is the set of frames with the same angle, declared conditions and repeat; they show the same spot at several
exposures. The grid of a dataset has a cell for each angle, exposure, repeat and declared condition. The baseline is the
declared model of the light: shape of the spot, and laws of its brightness and width.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from spotcheck.characterization.sensor_choice import read_sensor_model, read_sources, read_standard_errors
from spotcheck.crops.cropping import is_usable
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.analysis import Setting
from spotcheck.discrepancy.frames import Cell, FrameParameters, FrameSet, load_frames, usable_cells
from spotcheck.discrepancy.starting_spots import WIDEST_SPOT, fit_spots, load_spots, spots_by_moments
from spotcheck.io import store
from spotcheck.model.baseline import build_baseline
from spotcheck.model.forward import ForwardModel

UNKNOWN_SENSOR = "gain or read noise of the sensor is unknown, and the frames do not tell them"
NO_SPOT = "no spot could be fitted in any frame"
TOO_WIDE = f"{NO_SPOT}: it is as wide as its crop"
# Largest distance of two crops of a site that show the same spot, along each axis [side of a crop].
SITE_SHIFT = 0.5


@dataclass(frozen=True)
class ReadyFrames:
    """The frames of a dataset that are analysed, in the order of `usable_cells`."""

    frames: FrameSet  # usable frames that show the spot of their site
    cells: tuple[Cell, ...]  # index on the grid and row of the manifest of each frame
    spots: FrameParameters  # spot of each frame, from which fits start
    setting: Setting  # what the instrument fixes: light, sensor, standard errors of the sensor's numbers
    remarks: tuple[str, ...]  # sentences about parts of the dataset that the verdict does not rest on

    @property
    def indices(self) -> list[tuple[int, ...]]:
        """Index of each frame on the grid."""
        return [index for index, _ in self.cells]

    @property
    def rows(self) -> list[Frame]:
        """Row of the manifest of each frame."""
        return [row for _, row in self.cells]


def prepare_dataset(
    dataset: Dataset, crops: xr.Dataset, sensor: xr.Dataset, fits: xr.Dataset | None
) -> ReadyFrames | str:
    """Return the frames of a dataset that can be analysed; or one sentence that says why none can.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    crops, sensor : xr.Dataset
        Content of crops.nc and sensor.nc.
    fits : xr.Dataset or None
        Content of fits.nc. Its spots are the starts of later fits; frames without a trusted fit start from second
        moments. If it is None, or has no trusted fit at all, each frame is first fitted alone.
    """
    # crops.nc has crops about the centroid of the light, and others about the brightest pixel.
    cells = usable_cells(dataset, crops["status"].sel(centring="light"))
    unusable = describe_unusable(dataset, crops)
    if not cells:
        return unusable
    sensor_model = read_sensor_model(sensor)
    if sensor_model is None:
        return UNKNOWN_SENSOR
    if not dataset.exposures:
        # A dark current per second has no known effect without exposures.
        sensor_model = replace(sensor_model, dark_current_e_per_s=0.0)
    frames = load_frames(dataset, crops, cells)
    shows_spot = find_shared_spots(frames, dataset.instrument.crop_px)
    left_out = len(frames) - int(shows_spot.sum())
    remarks = [unusable, *store.remarks_of(sensor), never_searched(frames.select(np.flatnonzero(shows_spot)))]
    if left_out:
        text = "spots lie more than half a crop away from the other spots of their site"
        remarks.append(f"{left_out} of {len(frames)} {text}")
        frames = frames.select(np.flatnonzero(shows_spot))
        cells = [cell for cell, is_kept in zip(cells, shows_spot, strict=True) if is_kept]
    baseline = build_baseline(dataset.instrument, dataset.exposures)
    spots: FrameParameters | str | None = None if fits is None else load_spots(fits, frames, cells)
    if spots is None:
        # Each frame is fitted with a peak of its own, whatever law of the peak the instrument states.
        spots = fit_starting_spots(ForwardModel(replace(baseline, photon_budget="free"), sensor_model), frames)
    if isinstance(spots, str):
        return spots
    names = ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    stderr = dict(zip(names, read_standard_errors(sensor), strict=True))
    setting = Setting(baseline, sensor_model, float(dataset.instrument.crop_px), stderr, read_sources(sensor))
    return ReadyFrames(frames, tuple(cells), spots, setting, tuple(filter(None, remarks)))


def fit_starting_spots(forward: ForwardModel, frames: FrameSet) -> FrameParameters | str:
    """Return the spot of each frame, fitted alone; or a sentence that says why no frame has a spot.

    A frame whose fit does not converge, or is as wide as its crop, gets its spot by second moments.
    """
    moments = spots_by_moments(frames)
    fitted = fit_spots(forward, frames, moments)
    is_wide = np.exp(fitted.spots.log_sigma) > WIDEST_SPOT * min(frames.readings.shape[1:])
    is_trusted = fitted.has_converged & ~is_wide
    if not is_trusted.any():
        return TOO_WIDE if (fitted.has_converged & is_wide).any() else NO_SPOT
    return FrameParameters(*np.where(is_trusted, fitted.spots.as_rows(), moments.as_rows()))


def describe_unusable(dataset: Dataset, crops: xr.Dataset) -> str:
    """Return a clause that says how many spot frames cannot be used, and why; "" if all can.

    `crops` is the content of crops.nc.
    """
    total = len(dataset.spots)
    if not total:
        return "the manifest names no spot frame, and flats and darks are judged by `spotcheck flats`"
    status, dims = crops["status"].sel(centring="light"), store.grid_dims(crops)
    # `STATUS` has (name, text) of each bit of the flags; `UNUSABLE` is the set of bits that exclude a frame.
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
    causes = [text if len(reasons) == 1 else f"{number}: {text}" for text, number in reasons.items()]
    return f"{subject} be used ({'; '.join(causes)})"


def find_shared_spots(frames: FrameSet, crop_px: int) -> np.ndarray:
    """Return a mask [frame], True for frames that show the spot of their site.

    Crops are centred on their light, so that crops of a site that lie far apart show different things. The crops near
    each frame of a site form a group. The largest group shows the spot of the site; of several such groups, the one
    with the longest exposure.

    Parameters
    ----------
    frames : FrameSet
        Usable frames.
    crop_px : int
        Side of the crops [px].
    """
    site, exposure_s = frames.design.site, frames.design.exposure_s
    shows_spot = np.zeros(len(frames), bool)
    for number in np.unique(site):
        members = np.flatnonzero(site == number)
        corners = np.stack([frames.left[members], frames.top[members]], 1)
        distance = np.abs(corners[:, None] - corners[None]).max(axis=2)
        groups = [members[is_near] for is_near in distance <= SITE_SHIFT * crop_px]
        shows_spot[max(groups, key=lambda group: (len(group), exposure_s[group].max()))] = True
    return shows_spot


def never_searched(frames: FrameSet) -> str:
    """Return a clause that says how many frames belong to conditions with held-out frames only; "" if none do.

    Held-out frames are repeats that test the model and do not take part in the search for effects. A condition is an
    exposure, angle and setting of the declared conditions.
    """
    is_held_out = frames.held_out()
    conditions = np.stack([frames.design.condition, frames.design.angle], 1)
    searched = {tuple(condition) for condition in conditions[~is_held_out]}
    count = sum(tuple(condition) not in searched for condition in conditions[is_held_out])
    if not count:
        return ""
    subject = "1 frame belongs" if count == 1 else f"{count} frames belong"
    return f"{subject} to conditions of which every frame is held out: they test the model, but did not select it"
