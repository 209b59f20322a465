"""Remarks on a frame in words: flags of its fit, its deviation from the other frames, and its largest residual."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.discrepancy.words import percent_text
from spotcheck.io import store
from spotcheck.io.number_text import two_digits
from spotcheck.report.dataset_page.frame_packing import block_means

# A deviation is reported above this size [1, or px] and this number of standard errors. Smaller ones have no practical
# consequence; among 1,000 frames noise alone exceeds the number of errors in less than one.
LEAST_DEVIATION = {"brighter": 0.02, "wider": 0.01, "right": 0.25, "down": 0.25}
LEAST_ERRORS = 5.0
# Words for a positive and a negative relative deviation from the law of all frames.
OPPOSITES = {"brighter": ("brighter", "fainter"), "wider": ("wider", "narrower")}
# Number of blocks along the side of a crop among which the largest residual is searched.
BLOCKS = 24
# The residual of a block is reported above this number of standard deviations of its noise.
LEAST_SIGMAS = 6.0
# Flags that are described with further details.
DETAILED_FLAGS = store.flag("clipped") | store.flag("left_out")


class Deviation(NamedTuple):
    """Deviation of a frame from what all frames share."""

    value: float  # relative for brightness and width, else [px]
    stderr: float  # its standard error


def describe_flags(status: int, left_out: str, at_full_scale: int) -> list[str]:
    """Return the meanings of the flags of a fit.

    Parameters
    ----------
    status : int
        Flags, as in `store.STATUS`.
    left_out : str
        Pixels that were left out of the fit, in words; "" if unknown.
    at_full_scale : int
        Number of pixels at full scale.
    """
    texts = [text for bit, (_, text) in store.STATUS.items() if status & bit and not bit & DETAILED_FLAGS]
    if status & store.flag("clipped"):
        count = f"{at_full_scale:,} pixels" if at_full_scale != 1 else "1 pixel"
        texts.append(f"{count} at full scale" if at_full_scale else store.STATUS[store.flag("clipped")][1])
    if status & store.flag("left_out"):
        texts.append(f"left out of the fit: {left_out}" if left_out else store.STATUS[store.flag("left_out")][1])
    return texts


def describe_deviations(deviations: Mapping[str, Deviation]) -> list[str]:
    """Return how a frame deviates from the law of all frames and from its site, as far as that is significant.

    Parameters
    ----------
    deviations : mapping of str to Deviation
        Known deviations by the names of `LEAST_DEVIATION`.
    """
    significant = {
        name: deviation.value
        for name, deviation in deviations.items()
        if abs(deviation.value) > LEAST_DEVIATION[name] and abs(deviation.value) > LEAST_ERRORS * deviation.stderr
    }
    parts = [
        f"{percent_text(abs(significant[name]))} {positive if significant[name] > 0 else negative}"
        for name, (positive, negative) in OPPOSITES.items()
        if name in significant
    ]
    texts = [f"{' and '.join(parts)} than predicted by the law"] if parts else []
    if {"right", "down"} & significant.keys():
        distance = np.linalg.norm([deviations[name].value for name in ("right", "down") if name in deviations])
        texts.append(f"{distance:.2g} px off its site's centre")
    return texts


def describe_residual(residual: np.ndarray, variance: np.ndarray, centre: tuple[float, float]) -> str:
    """Return place and size of the largest residual of a frame, averaged over blocks; "" if it is within the noise.

    Parameters
    ----------
    residual : ndarray
        Measured less model [row, column] in DN.
    variance : ndarray
        Variance of its noise [row, column] in DN².
    centre : tuple of float
        Column and row of the spot [px].
    """
    block = max(min(residual.shape) // BLOCKS, 1)
    means, noise = block_means(residual, block), np.sqrt(block_means(variance, block)) / block
    if not np.isfinite(means).any():
        return ""
    row, column = np.unravel_index(int(np.nanargmax(np.abs(means))), means.shape)
    largest = float(means[row, column])
    if not abs(largest) >= LEAST_SIGMAS * float(noise[row, column]):
        return ""
    right, down = (block * (at + 0.5) - 0.5 - middle for at, middle in zip((column, row), centre, strict=True))
    sign = "+" if largest > 0 else "−"
    return f"largest residual {_describe_place(right, down, block)}: {sign}{two_digits(abs(largest))} DN"


def _describe_place(right: float, down: float, block: int) -> str:
    """Return a place relative to the spot's centre [px]; `block` is its uncertainty [px]."""
    if np.hypot(right, down) <= 1.5 * block:
        return "at the centre"
    across = f"{abs(right):.0f} px to the {'right' if right > 0 else 'left'}" if abs(right) >= block / 2 else ""
    along = f"{abs(down):.0f} px {'below' if down > 0 else 'above'}" if abs(down) >= block / 2 else ""
    return f"{' and '.join(filter(None, (across, along)))}{'' if along else ' of'} the centre"


def median_factors(views: xr.Dataset) -> dict[str, float]:
    """Return the factors by which the median frame is brighter and wider than the law of all frames.

    If the law as a whole is off, no single frame is to be blamed for it.
    """
    deviations = {name: views[name].values for name in OPPOSITES if name in views}
    return {name: 1.0 + float(np.nanmedian(v)) for name, v in deviations.items() if np.isfinite(v).any()}


def read_deviations(views: xr.Dataset, at: dict[str, int], factors: Mapping[str, float]) -> dict[str, Deviation]:
    """Return the known deviations of a frame, relative to the median frame.

    Parameters
    ----------
    views : Dataset
        Content of views.nc.
    at : dict
        Index of the frame by dimension.
    factors : mapping of str to float
        As `median_factors` returns them.
    """
    deviations = {}
    for name in LEAST_DEVIATION:
        if name in views and np.isfinite(value := float(views[name].isel(at))):
            factor, stderr = factors.get(name, 1.0), float(views[f"{name}_stderr"].isel(at))
            value = (1.0 + value) / factor - 1.0 if name in factors else value
            deviations[name] = Deviation(value, stderr / factor)
    return deviations
