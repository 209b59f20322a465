"""Selection of the dark frames of a dataset that contain no light."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.frames import ReducedFrame

# A dark frame contains light if it reads more than the darkest frame by this part of full scale.
MAX_STRAY_LIGHT = 1e-3


class DarkLevels(NamedTuple):
    """Levels of the dark frames without light."""

    levels: Sequence[float] = ()  # level of each dark frame without light [DN]
    remark: str = ""  # sentence on the dark frames with light; "" if there are none
    darkest_dn: float = np.nan  # lowest level of all frames, spots included [DN]; NaN if there are none


NO_DARKS = DarkLevels()


def select_dark_levels(
    darks: Iterable[ReducedFrame], spots: Iterable[ReducedFrame], full_scale_dn: float
) -> DarkLevels:
    """Return the levels of the dark frames without light.

    Light only adds to a reading. So no part of a frame beside its spot reads less than the black level, and a dark
    frame must read this level both in most places and on average.

    Parameters
    ----------
    darks, spots : reduced copies of the dark frames and of the surroundings of spots.
    full_scale_dn : largest reading of the converter [DN].
    """
    measured = [(measure_frame_level(frame), float(np.nanmean(frame.row_mean))) for frame in darks]
    all_levels = [level for level, _ in measured] + [measure_frame_level(frame) for frame in spots]
    darkest = min(all_levels, default=np.nan)
    limit = darkest + MAX_STRAY_LIGHT * full_scale_dn
    levels = [level for level, mean in measured if max(level, mean) <= limit]
    if len(levels) == len(measured):
        return DarkLevels(levels, "", darkest)
    brightest = max(mean for _, mean in measured)
    consequence = "that of the others" if levels else "not taken from them"
    remark = (
        f"{len(measured) - len(levels)} of {len(measured)} dark frames hold light (they read up to {brightest:.4g} DN"
        f" on average, where black is {darkest:.4g} DN at most), so the black level is {consequence}"
    )
    return DarkLevels(levels, remark, darkest)


def measure_frame_level(frame: ReducedFrame) -> float:
    """Return the level of a frame beside its spot [DN]: the lowest median of its rows, columns and blocks.

    A spot and hot pixels hardly change it.
    """
    return float(min(np.nanmedian(values) for values in frame))
