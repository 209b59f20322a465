"""Quality metrics of a spot image: PSNR, speckle contrast, maximum, sum and peak ratio (Sections 2.2.2, 4.1.2, 6.2).

`PER_IMAGE` lists the metrics of a single crop. Each is computed for measured and simulated frames, stored in metrics.nc
with its mean and standard deviation over repeats, and drawn in the report.

Images are arrays [row, column] in DN, from which the black level is not subtracted. NaN pixels are ignored, except by
`mean_of_frames`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.metrics import peak_signal_noise_ratio

# Largest value of the 16-bit container [DN], to which the paper scales PSNR. The sensor fills 10 bits of it, so that
# PSNR is 36.1 dB larger than with the range of the sensor.
CONTAINER_RANGE = 65535.0
# Peak pixels are at most this share of the maximum below it, and plateau pixels are above this share of the maximum
# (Section 6.2).
PEAK_WITHIN = 0.02
PLATEAU_ABOVE = 0.5
# Share of undefined pixels [1] in a shifted pixel that still counts as zero, since rounding alone can cause it.
ROUNDING_ERROR = 1e-9


def largest_reading(image: np.ndarray) -> float:
    """Return the largest pixel of an image [DN]."""
    return float(np.nanmax(image))


def pixel_sum(image: np.ndarray) -> float:
    """Return the sum of all pixels of an image [DN]."""
    return float(np.nansum(image, dtype=np.float64))


def speckle_contrast(image: np.ndarray) -> float:
    """Return C_s [1], the population standard deviation of all pixels divided by their mean (Eq. 2).

    NaN if the mean is not above 0.
    """
    mean = float(np.nanmean(image, dtype=np.float64))
    return float(np.nanstd(image, dtype=np.float64)) / mean if mean > 0 else np.nan


def mean_of_frames(frames: np.ndarray) -> float:
    """Return µ_y [DN], the mean over all pixels of several frames [frame, row, column] in DN (Eq. 17).

    The paper prints the factor 1/(KMN + 1) for K frames of M × N pixels; a mean has 1/(KMN). Whole frames have no NaN
    pixels, so NaN is not ignored here: a NaN pixel makes the result NaN.
    """
    return float(np.mean(frames, dtype=np.float64))


def mean_maximum(maxima: np.ndarray) -> float:
    """Return µ_y,max [DN], the mean of the maxima of several frames [frame] in DN (Eq. 18)."""
    return float(np.nanmean(maxima))


def mean_sum(sums: np.ndarray) -> float:
    """Return µ_y,total [DN], the mean of the pixel sums of several frames [frame] in DN (Eq. 19)."""
    return float(np.nanmean(sums))


def peak_ratio(image: np.ndarray) -> float:
    """Return the number of peak pixels divided by the number of plateau pixels [1] (Section 6.2).

    Peak pixels are within 2 % of the maximum, plateau pixels above half of it. NaN if the maximum is not above 0.
    """
    maximum = np.nanmax(image)
    if not maximum > 0:
        return np.nan
    return float(np.sum(image >= (1 - PEAK_WITHIN) * maximum) / np.sum(image > PLATEAU_ABOVE * maximum))


def psnr(reference: np.ndarray, image: np.ndarray, data_range: float) -> float:
    """Return the peak signal-to-noise ratio [dB] of two images of one shape, over the pixels that are finite in both.

    It is 10 log10(`data_range`² / mean squared difference), with the range in DN. Equal images give infinity, images
    without a common finite pixel NaN.
    """
    common = np.isfinite(reference) & np.isfinite(image)
    if not common.any():
        return np.nan
    expected, actual = reference[common].astype(float), image[common].astype(float)
    # scikit-image would divide by the mean squared difference, which is 0.
    if np.array_equal(expected, actual):
        return np.inf
    return float(peak_signal_noise_ratio(expected, actual, data_range=data_range))


def shift_image(image: np.ndarray, row_shift: float, column_shift: float) -> np.ndarray:
    """Return an image moved by two shifts [px] towards larger rows and columns, by cubic interpolation.

    A pixel of the result is NaN if it is interpolated from a place beyond the edge of `image`, or within one pixel of a
    gap, a pixel that is not finite.
    """
    gaps, shift = ~np.isfinite(image), (row_shift, column_shift)
    # Gaps are filled with the nearest pixel first: a step to 0 would make the splines ring.
    nearest_index = ndimage.distance_transform_edt(gaps, return_distances=False, return_indices=True)
    moved = ndimage.shift(image[tuple(nearest_index)].astype(float), shift, order=3, mode="nearest")
    # Cubic splines reach further than one pixel, but the filled gap changes those pixels little: they stay defined.
    near_gap = ndimage.binary_dilation(gaps) if gaps.any() else gaps
    # Share of each moved pixel [1] that comes from beyond the edge or from near a gap.
    undefined_share = ndimage.shift(near_gap.astype(float), shift, order=1, mode="constant", cval=1.0)
    return np.where(undefined_share > ROUNDING_ERROR, np.nan, moved)


class Metric(NamedTuple):
    """A metric of one crop."""

    name: str  # variable of metrics.nc
    units: str  # unit of the values
    long_name: str  # meaning, as axis label and netCDF attribute
    function: Callable[[np.ndarray], float]  # function of a crop [row, column] in DN, NaN beyond the frame


PER_IMAGE = (
    Metric("maximum", "DN", "largest reading of the crop", largest_reading),
    Metric("sum", "DN", "sum of all readings of the crop", pixel_sum),
    Metric("speckle_contrast", "1", "standard deviation over mean of the crop", speckle_contrast),
    Metric("peak_ratio", "1", "pixels within 2 % of the maximum over pixels above half of it", peak_ratio),
)
