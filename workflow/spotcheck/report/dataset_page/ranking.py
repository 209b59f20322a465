"""The table of frames: what is left of each, and why, in words."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.discrepancy.words import percent_text
from spotcheck.io import store
from spotcheck.io.plus_minus import two_digits
from spotcheck.report.dataset_page.packed import thinned

# A deviation from the law of all frames is worth a word above this part of it, or this many px, and this many of its
# standard errors: smaller ones no user could act on, and of 1,000 frames noise alone makes less than one stand out.
NOTED = {"brighter": 0.02, "wider": 0.01, "right": 0.25, "down": 0.25}
ERRORS = 5.0
WORDS = {"brighter": ("brighter", "fainter"), "wider": ("wider", "narrower")}
# Blocks along a crop's side in which the place is looked for where most is left.
BLOCKS = 24
# What is left of such a block is worth a word above so many standard deviations of its noise.
STANDS_OUT = 6.0
# Flags that say what the table says otherwise.
TOLD = store.flag("clipped") | store.flag("left_out")


class Deviation(NamedTuple):
    """How far a frame is off the law of all, with the standard error."""

    value: float
    stderr: float


def flags_text(status: int, left_out: str, at_full_scale: int) -> list[str]:
    """What the flags of a fit say."""
    texts = [text for bit, (_, text) in store.STATUS.items() if status & bit and not bit & TOLD]
    if status & store.flag("clipped"):
        many = f"{at_full_scale:,} pixels" if at_full_scale != 1 else "1 pixel"
        texts.append(f"{many} at full scale" if at_full_scale else store.STATUS[store.flag("clipped")][1])
    if status & store.flag("left_out"):
        texts.append(f"left out of the fit: {left_out}" if left_out else store.STATUS[store.flag("left_out")][1])
    return texts


def deviations_text(deviations: dict[str, Deviation]) -> list[str]:
    """How the frame differs from what all share, as far as it matters and is no chance."""
    beside = [
        f"{percent_text(abs(own.value))} {more if own.value > 0 else less}"
        for name, (more, less) in WORDS.items()
        if (own := deviations.get(name)) is not None and _stands_out(name, own)
    ]
    texts = [f"{' and '.join(beside)} than the law says"] if beside else []
    aside = [deviations[name] for name in ("right", "down") if name in deviations]
    if any(_stands_out(name, deviations[name]) for name in ("right", "down") if name in deviations):
        texts.append(f"{float(np.linalg.norm([own.value for own in aside])):.2g} px off its site's centre")
    return texts


def _stands_out(name: str, own: Deviation) -> bool:
    return abs(own.value) > NOTED[name] and abs(own.value) > ERRORS * own.stderr


def place_text(residual: np.ndarray, variance: np.ndarray, centre: tuple[float, float]) -> str:
    """Where most is left of a frame [row, column] in DN, beside what noise leaves, seen from the spot's `centre` (x, y)
    [px]; "" where nothing stands out."""
    block = max(min(residual.shape) // BLOCKS, 1)
    mean, noise = thinned(residual, block), np.sqrt(thinned(variance, block)) / block
    if not np.isfinite(mean).any():
        return ""
    row, column = np.unravel_index(int(np.nanargmax(np.abs(mean))), mean.shape)
    excess = float(mean[row, column])
    if not abs(excess) >= STANDS_OUT * float(noise[row, column]):
        return ""
    right, down = (block * (at + 0.5) - 0.5 - middle for at, middle in zip((column, row), centre, strict=True))
    return f"most remains {_direction(right, down, block)}: {'+' if excess > 0 else '−'}{two_digits(abs(excess))} DN"


def _direction(right: float, down: float, block: int) -> str:
    if np.hypot(right, down) <= 1.5 * block:
        return "at the centre"
    parts = [f"{abs(right):.0f} px to the {'right' if right > 0 else 'left'}"] if abs(right) >= block / 2 else []
    parts += [f"{abs(down):.0f} px {'below' if down > 0 else 'above'}"] if abs(down) >= block / 2 else []
    return (
        f"{' and '.join(parts)} of the centre"
        if len(parts) == 1 and "to the" in parts[0]
        else (f"{' and '.join(parts)} the centre")
    )


def usual_of(views: xr.Dataset) -> dict[str, float]:
    """By which factor the median frame is brighter and wider than the law of all frames: where the law as a whole is
    off, no frame is worse for it."""
    known = {name: views[name].values for name in WORDS if name in views}
    return {name: 1.0 + float(np.nanmedian(own)) for name, own in known.items() if np.isfinite(own).any()}


def deviations_of(views: xr.Dataset, at: dict[str, int], usual: Mapping[str, float]) -> dict[str, Deviation]:
    """The deviations of a frame that are known, beside those of the median frame."""
    found = {}
    for name in NOTED:
        if name in views and np.isfinite(value := float(views[name].isel(at))):
            factor, stderr = usual.get(name, 1.0), float(views[f"{name}_stderr"].isel(at))
            value = (1.0 + value) / factor - 1.0 if name in usual else value
            found[name] = Deviation(value, stderr / factor)
    return found
