"""Quality metrics of a spot's image: PSNR, speckle contrast, maximum, sum, peak ratio (Sections 2.2.2, 4.1.2 and 6.2).

`PER_IMAGE` lists the metrics of a single crop. Each of them is computed for measured and simulated frames, stored with
its mean and scatter over repeats in metrics.nc, and drawn in the report.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.metrics import peak_signal_noise_ratio

# The paper scales PSNR to the container, although the sensor fills 10 bits of it: 36.1 dB more than the sensor's own
# range.
CONTAINER_RANGE = 65535.0
# A peak pixel lies within this part of the image maximum, a plateau pixel above that one (Section 6.2).
PEAK_WITHIN = 0.02
PLATEAU_ABOVE = 0.5


def largest_reading(image: np.ndarray) -> float:
    """Largest finite pixel of an image [DN]."""
    return float(np.nanmax(image))


def total(image: np.ndarray) -> float:
    """Sum of all finite pixels of an image [DN]."""
    return float(np.nansum(image, dtype=np.float64))


def speckle_contrast(image: np.ndarray) -> float:
    """C_s [1], standard deviation over mean of all finite pixels (Eq. 2). NaN for an image without light."""
    mean = float(np.nanmean(image, dtype=np.float64))
    return float(np.nanstd(image, dtype=np.float64)) / mean if mean > 0 else np.nan


def mean_of_frames(frames: np.ndarray) -> float:
    """µ_y [DN], the mean over all pixels of several frames [frame, rows, columns] (Eq. 17, with its sum rightly
    normalised)."""
    return float(np.mean(frames, dtype=np.float64))


def mean_maximum(maxima: np.ndarray) -> float:
    """µ_y,max [DN], the mean over frames of each frame's maximum (Eq. 18)."""
    return float(np.nanmean(maxima))


def mean_sum(sums: np.ndarray) -> float:
    """µ_y,total [DN], the mean over frames of each frame's pixel sum (Eq. 19)."""
    return float(np.nanmean(sums))


def peak_ratio(image: np.ndarray) -> float:
    """Pixels within 2 % of the maximum over pixels above half of it [1] (Section 6.2)."""
    maximum = np.nanmax(image)
    if not maximum > 0:
        return np.nan
    return float(np.sum(image >= (1 - PEAK_WITHIN) * maximum) / np.sum(image > PLATEAU_ABOVE * maximum))


def psnr(reference: np.ndarray, image: np.ndarray, data_range: float) -> float:
    """Peak signal-to-noise ratio [dB] over the pixels that both images have; infinite for equal images."""
    both = np.isfinite(reference) & np.isfinite(image)
    if not both.any():
        return np.nan
    if np.array_equal(reference[both], image[both]):
        return np.inf
    return float(
        peak_signal_noise_ratio(reference[both].astype(float), image[both].astype(float), data_range=data_range)
    )


def shifted(image: np.ndarray, rows: float, columns: float) -> np.ndarray:
    """The image moved by a fraction of pixels (cubic interpolation); NaN where nothing came from inside."""
    gap = ~np.isfinite(image)
    # Gaps are filled from the nearest pixel: a step down to 0 would ring through the splines.
    nearest = ndimage.distance_transform_edt(gap, return_distances=False, return_indices=True)
    moved = ndimage.shift(image[tuple(nearest)].astype(float), (rows, columns), order=3, mode="nearest")
    near_gap = ndimage.binary_dilation(gap) if gap.any() else gap
    outside = ndimage.shift(near_gap.astype(float), (rows, columns), order=1, mode="constant", cval=1.0)
    return np.where(outside > 1e-9, np.nan, moved)


class Metric(NamedTuple):
    """A metric of one crop [y, x] in DN, NaN beyond the frame: its name in metrics.nc, unit, meaning, and function."""

    name: str
    units: str
    long_name: str
    function: Callable[[np.ndarray], float]


PER_IMAGE = (
    Metric("maximum", "DN", "largest reading of the crop", largest_reading),
    Metric("sum", "DN", "sum of all readings of the crop", total),
    Metric("speckle_contrast", "1", "standard deviation over mean of the crop", speckle_contrast),
    Metric("peak_ratio", "1", "pixels within 2 % of the maximum over pixels above half of it", peak_ratio),
)
