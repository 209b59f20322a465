"""Level of the dark frames of a dataset that contain no light, and of the dark pixels of its spot frames.

The level of a frame is its reading where the spot does not reach; the black level is the reading without any light.
A reduced frame consists of the means of blocks, rows and columns of a whole frame [DN].
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.frames import ReducedFrame

# A dark frame contains light if it reads more than the lowest level of all frames by this part of full scale.
MAX_STRAY_LIGHT = 1e-3


class DarkLevels(NamedTuple):
    """Levels of the dark frames without light."""

    # Level of each dark frame without light [DN]; empty if all contain light or there are none.
    levels: Sequence[float] = ()
    remark: str = ""  # sentence on the dark frames with light; "" if there are none
    darkest_dn: float = np.nan  # lowest level of all frames, spots included [DN]; NaN if there are none
    # Level of the dark pixels of the spot frames with its standard error [DN]; NaN without spots or with dark frames.
    dark_pixels: tuple[float, float] = (np.nan, np.nan)


NO_DARKS = DarkLevels()


class _Summary(NamedTuple):
    """Summary of a reduced frame."""

    # Medians of the block, row and column means [DN]. The lowest one is the level of the frame beside its spot: a spot
    # and hot pixels hardly change it.
    medians: Sequence[float]
    mean: float  # mean reading [DN]
    is_uniform: bool  # whether all pixels have the same reading


def select_dark_levels(
    darks: Iterable[ReducedFrame], spots: Iterable[ReducedFrame], full_scale_dn: float
) -> DarkLevels:
    """Return the levels of the dark frames without light.

    Light only adds to a reading, so the lowest level of all frames is an upper limit of the black level. A dark frame
    contains light if its level or its mean exceeds this limit by more than `MAX_STRAY_LIGHT` of full scale. The mean
    also shows light in a part of the frame, which hardly changes the level.

    Parameters
    ----------
    darks, spots : means of blocks, rows and columns [DN] of each dark frame and of each frame with a spot.
    full_scale_dn : largest reading of the converter [DN].
    """
    levels_and_means = [(min(frame.medians), frame.mean) for frame in _summarize_frames(darks)]
    spot_medians = [frame.medians for frame in _summarize_frames(spots)]
    all_levels = [level for level, _ in levels_and_means] + [min(medians) for medians in spot_medians]
    darkest_dn = min(all_levels, default=np.nan)
    # Light in the dark frames shows that the room was lit, so that the dark pixels of the spots are not black either.
    dark_pixels = (np.nan, np.nan) if levels_and_means else _estimate_dark_pixel_level(spot_medians)
    limit_dn = darkest_dn + MAX_STRAY_LIGHT * full_scale_dn
    unlit_levels = [level for level, mean in levels_and_means if max(level, mean) <= limit_dn]
    total, lit_count = len(levels_and_means), len(levels_and_means) - len(unlit_levels)
    if not lit_count:
        return DarkLevels(unlit_levels, "", darkest_dn, dark_pixels)
    brightest_dn = max(mean for _, mean in levels_and_means)
    consequence = "that of the others" if unlit_levels else "not taken from them"
    remark = (
        f"{lit_count} of {total} dark frames hold light (they read up to {brightest_dn:.4g} DN"
        f" on average, where black is {darkest_dn:.4g} DN at most), so the black level is {consequence}"
    )
    return DarkLevels(unlit_levels, remark, darkest_dn, dark_pixels)


def _summarize_frames(frames: Iterable[ReducedFrame]) -> list[_Summary]:
    """Return the summaries of frames, without those that hold no measurement.

    A frame with one reading in all pixels, such as that of an empty page, holds none, unless all frames are alike.
    """
    summaries = []
    for frame in frames:
        finite_means = [values[np.isfinite(values)] for values in frame]
        if any(values.size == 0 for values in finite_means):
            continue
        is_uniform = len({float(level) for values in finite_means for level in (values.min(), values.max())}) == 1
        medians = [float(np.median(values)) for values in finite_means]
        summaries.append(_Summary(medians, float(np.nanmean(frame.row_mean)), is_uniform))
    return [summary for summary in summaries if not summary.is_uniform] or summaries


def _estimate_dark_pixel_level(medians: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the level of the dark pixels of spot frames and its standard error [DN]; NaN without frames.

    `medians` [frame, kind of mean] are those of `_Summary`. The level is the lowest one, as light only adds. Its
    error contains the differences between the kinds of means, which light of the spot raises differently, and the
    scatter of the frames, which stray light raises differently.
    """
    if not medians:
        return np.nan, np.nan
    levels = [min(frame_medians) for frame_medians in medians]
    difference = np.ptp(medians[int(np.argmin(levels))])
    scatter = np.std(levels, ddof=1) if len(levels) > 1 else 0.0
    return min(levels), float(np.hypot(difference, scatter))
