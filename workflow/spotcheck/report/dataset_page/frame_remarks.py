"""Remarks on a frame in words: flags of its fit, its deviation from the other frames, and its largest residual.

The law is the model of brightness and width of the spot over exposure that all frames share. A site is a place on the
sample; its frames share the centre of the spot. views.nc has four deviations of each frame with standard errors:
`brighter` and `wider`, the relative deviations of brightness and width from the law [1], and `right` and `down`, the
distance of the spot's centre from that of its site [px]. The grid of frames has the dimensions angle, exposure, repeat
and declared conditions.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.discrepancy.words import percent_text
from spotcheck.io import store
from spotcheck.io.number_text import two_digits
from spotcheck.report.dataset_page.frame_packing import block_means

# A deviation is reported if it exceeds both LEAST_DEVIATION [1 or px] and LEAST_ERRORS standard errors. Smaller
# deviations have no practical consequence. Noise alone exceeds LEAST_ERRORS in less than one of 1,000 frames.
LEAST_DEVIATION = {"brighter": 0.02, "wider": 0.01, "right": 0.25, "down": 0.25}
LEAST_ERRORS = 5.0
# Words for a positive and a negative deviation from the law, by the name of the deviation.
OPPOSITES = {"brighter": ("brighter", "fainter"), "wider": ("wider", "narrower")}
# The largest residual is searched among blocks of pixels, of which so many lie along the side of a crop.
BLOCKS = 24
# A block is "at the centre" if it is nearer to the centre of the spot than so many times the side of a block.
CENTRE_BLOCKS = 1.5
# The residual of a block is reported above this number of standard deviations of its noise.
LEAST_SIGMAS = 6.0
# Flags whose texts include numbers or reasons of the frame.
DETAILED_FLAGS = store.flag("clipped") | store.flag("left_out")


class Deviation(NamedTuple):
    """Deviation of a frame from the law of all frames or from its site."""

    value: float  # relative deviation from the law [1], 0 if equal; or distance from the centre of the site [px]
    stderr: float  # standard error, in the unit of the value


def describe_flags(status: int, left_out: str, at_full_scale: int) -> list[str]:
    """Return the meaning of each flag of a fit in words.

    Parameters
    ----------
    status : int
        Flags of the fit, a sum of keys of `store.STATUS`.
    left_out : str
        Pixels that were left out of the fit, in words; "" if unknown.
    at_full_scale : int
        Number of pixels of the frame that read full scale.
    """
    texts = [text for bit, (_, text) in store.STATUS.items() if status & bit and not bit & DETAILED_FLAGS]
    if status & store.flag("clipped"):
        # The flag may also mean many pixels at the frame's highest reading below full scale.
        count = f"{at_full_scale:,} pixels" if at_full_scale != 1 else "1 pixel"
        texts.append(f"{count} at full scale" if at_full_scale else store.STATUS[store.flag("clipped")][1])
    if status & store.flag("left_out"):
        texts.append(f"left out of the fit: {left_out}" if left_out else store.STATUS[store.flag("left_out")][1])
    return texts


def describe_deviations(deviations: Mapping[str, Deviation]) -> list[str]:
    """Return phrases on the significant deviations of a frame from the law of all frames and from its site.

    Parameters
    ----------
    deviations : mapping of str to Deviation
        Deviations by the names of `LEAST_DEVIATION`, without unknown ones.
    """
    significant = {
        name: deviation.value
        for name, deviation in deviations.items()
        if abs(deviation.value) > LEAST_DEVIATION[name] and abs(deviation.value) > LEAST_ERRORS * deviation.stderr
    }
    comparisons = [
        f"{percent_text(abs(significant[name]))} {positive if significant[name] > 0 else negative}"
        for name, (positive, negative) in OPPOSITES.items()
        if name in significant
    ]
    texts = [f"{' and '.join(comparisons)} than predicted by the law"] if comparisons else []
    if {"right", "down"} & significant.keys():
        # One significant coordinate suffices; the distance includes the other one.
        distance = np.linalg.norm([deviations[name].value for name in ("right", "down") if name in deviations])
        texts.append(f"{distance:.2g} px off its site's centre")
    return texts


def describe_residual(residual: np.ndarray, variance: np.ndarray, centre: Sequence[float]) -> str:
    """Return place and size of the largest residual of a frame, averaged over blocks; "" if it is within the noise.

    Parameters
    ----------
    residual : ndarray
        Measured minus model [row, column] in DN; NaN where not measured.
    variance : ndarray
        Variance of the noise of a reading [row, column] in DN².
    centre : sequence of float
        Column and row of the spot's centre in the image [px].
    """
    block = max(min(residual.shape) // BLOCKS, 1)
    # The noise of the mean of block² pixels is that of a pixel divided by the side.
    means, noise = block_means(residual, block), np.sqrt(block_means(variance, block)) / block
    if not np.isfinite(means).any():
        return ""
    row, column = np.unravel_index(int(np.nanargmax(np.abs(means))), means.shape)
    largest = float(means[row, column])
    if not abs(largest) >= LEAST_SIGMAS * float(noise[row, column]):
        return ""
    # Distance from the centre of the spot to the centre of the block. The first pixel of a block is at block · k.
    right, down = (block * (k + 0.5) - 0.5 - middle for k, middle in zip((column, row), centre, strict=True))
    sign = "+" if largest > 0 else "−"
    return f"largest residual {_describe_place(right, down, block)}: {sign}{two_digits(abs(largest))} DN"


def _describe_place(right: float, down: float, block: int) -> str:
    """Return the place of a block in words: "12 px to the right and 5 px above the centre".

    `right` and `down` are the distances of the block from the spot's centre [px], `block` is its side [px]. Distances
    below half a side are not mentioned.
    """
    if np.hypot(right, down) <= CENTRE_BLOCKS * block:
        return "at the centre"
    horizontal = f"{abs(right):.0f} px to the {'right' if right > 0 else 'left'}" if abs(right) >= block / 2 else ""
    vertical = f"{abs(down):.0f} px {'below' if down > 0 else 'above'}" if abs(down) >= block / 2 else ""
    return f"{' and '.join(filter(None, (horizontal, vertical)))}{'' if vertical else ' of'} the centre"


def compute_median_factors(views: xr.Dataset) -> dict[str, float]:
    """Return the ratio of the median frame to the law, in brightness ("brighter") and in width ("wider").

    `views` is the content of views.nc. Frames are compared with the median frame, so that an error of the law itself is
    not attributed to single frames. A ratio is omitted if it is unknown for all frames.
    """
    deviations = {name: views[name].values for name in OPPOSITES if name in views}
    return {name: 1.0 + float(np.nanmedian(values)) for name, values in deviations.items() if np.isfinite(values).any()}


def read_deviations(
    views: xr.Dataset, place: dict[str, int], median_factors: Mapping[str, float]
) -> dict[str, Deviation]:
    """Return the known deviations of a frame by their names in `LEAST_DEVIATION`.

    Brightness and width are relative to the median frame.

    Parameters
    ----------
    views : Dataset
        Content of views.nc.
    place : dict
        Index of the frame by dimension of the grid.
    median_factors : mapping of str to float
        As `compute_median_factors` returns them.
    """
    deviations = {}
    for name in LEAST_DEVIATION:
        if name in views and np.isfinite(value := float(views[name].isel(place))):
            factor, stderr = median_factors.get(name, 1.0), float(views[f"{name}_stderr"].isel(place))
            value = (1.0 + value) / factor - 1.0 if name in median_factors else value
            deviations[name] = Deviation(value, stderr / factor)
    return deviations
