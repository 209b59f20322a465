"""Hot pixels: isolated pixels of the sensor whose mean reading over frames is far above that of their neighbours.

A `FrameSet` has crops around the spots, `readings` [frame, row, column] in DN, NaN where a pixel is masked. `left` and
`top` are column and row of the sensor under pixel (0, 0) of each crop. Frames of a site share granular light
("grains").
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.fields import MOST_CANVAS
from spotcheck.discrepancy.frames import FrameSet
from spotcheck.discrepancy.residuals import place_on_sensor
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# A hot pixel exceeds its neighbours by LEAST_Z standard deviations plus LEAST_SHARE of its light.
LEAST_Z, LEAST_SHARE = 8.0, 0.03
# Part of the largest mean light above which pixels are used to estimate the relative scatter of the light.
BRIGHT_SHARE = 0.3
# Relative scatter of the light above which grains of a single site cannot be distinguished from hot pixels.
GRANULAR = 0.2
# Sides of the neighbourhoods of a pixel [px] for its level and for the scatter about it.
LEVEL_PX, SCATTER_PX = 5, 11
# Standard deviation of a Gaussian over its median absolute deviation.
MAD_TO_SD = 1.4826


def mask_hot_pixels(frames: FrameSet, sensor: SensorModel) -> tuple[FrameSet, int]:
    """Mask the hot pixels of the sensor in all frames.

    Parameters
    ----------
    frames : FrameSet
        Crops around the spots.
    sensor : SensorModel
        Gain, black level and read noise, from which the noise of the mean readings follows.

    Returns
    -------
    FrameSet
        The frames with NaN at hot pixels.
    int
        Number of hot pixels. It is 0 without a search if crops lie too far apart to share pixels, or if the light of
        a single site is granular.
    """
    _, rows, columns = frames.readings.shape
    extent = (int(np.ptp(frames.top)) + rows, int(np.ptp(frames.left)) + columns)
    if np.prod(extent) > MOST_CANVAS * rows * columns:
        return frames, 0
    # Mean reading and its noise at each pixel of the part of the sensor that holds all crops [row, column].
    is_known = np.isfinite(frames.readings)
    total = place_on_sensor(np.where(is_known, frames.readings, 0.0), frames.left, frames.top).sum(axis=0, dtype=float)
    count = place_on_sensor(is_known, frames.left, frames.top).sum(axis=0)
    mean = total / np.maximum(count, 1)
    mean[count == 0] = np.median(mean[count > 0])
    light = np.maximum(mean - sensor.black_level_dn, 0.0)
    variance = (sensor.gain_dn_per_e * sensor.read_noise_e) ** 2 + sensor.gain_dn_per_e * light + ROUNDING_VARIANCE
    # Excess over the neighbours, and its scatter by noise, by structure of the light, and as observed nearby.
    excess = mean - ndimage.median_filter(mean, LEVEL_PX)
    is_bright = light > BRIGHT_SHARE * light.max()
    relative_scatter = MAD_TO_SD * np.median(np.abs(excess[is_bright] / light[is_bright]))
    if frames.design.sites == 1 and relative_scatter > GRANULAR:
        return frames, 0
    local_scatter = MAD_TO_SD * ndimage.median_filter(np.abs(excess), SCATTER_PX)
    deviation = np.sqrt(variance / np.maximum(count, 1) + (relative_scatter * light) ** 2 + local_scatter**2)
    is_hot = (excess > LEAST_Z * deviation + LEAST_SHARE * light) & (count > len(frames) / 2)
    if not is_hot.any():
        return frames, 0
    readings = frames.readings.copy()
    down, right = frames.top - frames.top.min(), frames.left - frames.left.min()
    for f in range(len(frames)):
        readings[f][is_hot[down[f] : down[f] + rows, right[f] : right[f] + columns]] = np.nan
    return replace(frames, readings=readings), int(is_hot.sum())
