"""Propose a crop size for the spots of a folder of images.

A crop is the square image that is cut out around a spot.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from spotcheck.crops.spotfinding import find_light_centroid
from spotcheck.dataset.frames import average_blocks
from spotcheck.dataset.instrument import Instrument
from spotcheck.dataset.scan.draft import ManifestDraft
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour

# Largest number of spot frames, and of others, that are read, evenly spaced over the rows: spots change slowly along a
# scan.
MAX_FRAMES = 16
# Side of the blocks that are averaged first, so that a hot pixel is not the peak [px].
BLOCK_PX = 4
# Side of the crop in standard deviations of the spot, which the required form of a dataset sets, and its step [px].
CROP_SIGMAS, STEP_PX = 10, 20
# Least number of blocks above half of the peak that give a covariance of positions.
MIN_BLOCKS = 3
# σ of a Gaussian over the standard deviation of positions inside its half maximum. These fill a disk of radius
# √(2 ln 2) σ, and the standard deviation per axis of a uniform disk is half its radius.
SIGMA_OVER_DISK = 2 / np.sqrt(2 * np.log(2))

AnyFrame = TypeVar("AnyFrame")


class CropProposal(NamedTuple):
    """Result of a search for spots in some frames of a folder."""

    side_px: int | None  # side of the crop [px] for the widest spot; None if the default is large enough
    has_spot: bool  # whether a spot was found, or no row is a spot frame
    errors: Mapping[str, str] = MappingProxyType({})  # by file of the sample that cannot be read, one sentence


def propose_crop_size(folder: Path, draft: ManifestDraft, colour: Colour = MONOCHROME) -> CropProposal:
    """Return the side of a crop for the widest spot in a sample of the spot frames of a folder.

    Parameters
    ----------
    folder : folder of the images.
    draft : frames found in it, and for each the row of the manifest with its `kind` (spot, dark or flat).
    colour : how colour images are converted to one channel.
    """
    sigmas, errors = list[float](), dict[str, str]()
    spot_frames = [frame for frame, row in zip(draft.frames, draft.rows, strict=True) if row["kind"] == "spot"]
    # Flats and darks are read for their errors alone.
    others = [frame for frame, row in zip(draft.frames, draft.rows, strict=True) if row["kind"] != "spot"]
    for frame in (*sample_evenly(spot_frames), *sample_evenly(others)):
        if frame.file in errors:
            continue
        try:
            pixels = files.read_pixels(folder / frame.file, frame.page, frame.file, colour)
        except InputError as error:
            errors[frame.file] = str(error)
            continue
        if frame in spot_frames and find_light_centroid(pixels, Instrument.crop_px).exists:
            sigmas.append(estimate_sigma(pixels))
    if not spot_frames:
        return CropProposal(None, True, errors)
    # Rounded up to a multiple of the step, but at least the default crop size and at most the smallest frame.
    side = STEP_PX * -(-CROP_SIGMAS * max(sigmas, default=0.0) // STEP_PX)
    smallest_frame = min(min(frame.shape) for frame in spot_frames)
    side = int(min(smallest_frame, max(Instrument.crop_px, side)))
    return CropProposal(None if side == Instrument.crop_px else side, bool(sigmas), errors)


def sample_evenly(frames: Sequence[AnyFrame]) -> Sequence[AnyFrame]:
    """Return at most `MAX_FRAMES` frames at even distances, the first one included."""
    # Every n-th frame, with n rounded up.
    return frames[:: max(1, -(-len(frames) // MAX_FRAMES))]


def estimate_sigma(pixels: np.ndarray) -> float:
    """Return the standard deviation of a spot along its longer axis [px], from the region above half its peak.

    `pixels` [row, column] are in DN. The result is 0 if that region has fewer than `MIN_BLOCKS` blocks.
    """
    side = min(BLOCK_PX, *pixels.shape)
    means = average_blocks(pixels, side)
    background = float(np.median(means))
    positions = np.argwhere(means > (background + float(means.max())) / 2)
    if len(positions) < MIN_BLOCKS:
        return 0.0
    # The largest eigenvalue is the variance of the positions along the longer axis.
    return float(SIGMA_OVER_DISK * side * np.sqrt(np.linalg.eigvalsh(np.cov(positions.T))[-1]))
