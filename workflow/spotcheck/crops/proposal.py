"""How large a crop the spots of a folder need."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.crops.spotfinding import light_centroid
from spotcheck.dataset.frames import average_blocks
from spotcheck.dataset.instrument import Instrument
from spotcheck.dataset.scan.draft import ManifestDraft
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour

# Frames that are looked at, evenly over the rows: the spots of a scan change slowly.
MOST_FRAMES = 16
# Blocks over which readings are averaged first, so that no hot pixel is the peak [px].
BLOCK = 4
# A crop holds ten standard deviations of a Gaussian (the contract asks for as much), in steps of this size [px].
SIGMAS, STEP = 10, 20
# Standard deviation of a Gaussian over that of places within its half maximum: these fill a disk of radius 1.177 σ,
# whose places have half its radius.
OVER_DISK = 2 / np.sqrt(2 * np.log(2))


class Look(NamedTuple):
    """Side of the crop [px] that the widest spot needs, None where the default is enough and fits into the frames; and
    whether a spot stands out in any frame that was looked at, or none was looked for."""

    side: int | None
    seen: bool


def look(folder: Path, rows: ManifestDraft, colour: Colour = MONOCHROME) -> Look:
    """Look at some spots of a folder for the size of their crop."""
    spots = [shot for shot, cell in zip(rows.frames, rows.rows, strict=True) if cell["kind"] == "spot"]
    if not spots:
        return Look(None, True)
    room, widest, seen = min(min(shot.shape) for shot in spots), 0.0, False
    for shot in spots[:: -(-len(spots) // MOST_FRAMES)]:
        try:
            pixels = files.read_pixels(folder / shot.file, shot.page, shot.file, colour)
        except InputError:
            continue
        if light_centroid(pixels, Instrument.crop_px).found:
            seen, widest = True, max(widest, sigma_px(pixels))
    side = int(min(room, max(Instrument.crop_px, STEP * -(-SIGMAS * widest // STEP))))
    return Look(None if side == Instrument.crop_px else side, seen)


def sigma_px(pixels: np.ndarray) -> float:
    """Standard deviation of a spot along its longer axis [px], roughly: from where it is above half its peak."""
    side = min(BLOCK, *pixels.shape)
    means = average_blocks(pixels, side)
    background = float(np.median(means))
    places = np.argwhere(means > (background + float(means.max())) / 2)
    if len(places) < 3:
        return 0.0
    return float(OVER_DISK * side * np.sqrt(np.linalg.eigvalsh(np.cov(places.T))[-1]))
