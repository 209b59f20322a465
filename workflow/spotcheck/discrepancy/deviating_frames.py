"""Held-out frames that deviate from the model far more than any searched frame, such as damaged ones.

Detection tests the searched frames alone, so that a fault of a held-out frame does not change its p-value. The spot of
each held-out frame is fitted by itself here: brightness, width and place of its spot do not count.
"""

import numpy as np

from spotcheck.discrepancy.analysis import Analysis
from spotcheck.discrepancy.criteria import LARGEST_GAP
from spotcheck.discrepancy.extended_model import FinalModel
from spotcheck.discrepancy.ready_frames import ReadyFrames
from spotcheck.discrepancy.residuals import ResidualImages, measure_residuals, sum_over_blocks
from spotcheck.discrepancy.validation import BLOCK_PX, GAP_RADIUS
from spotcheck.discrepancy.words import list_text

# Most frames that the sentence names.
MOST_NAMED = 3


def describe_deviating_frames(analysis: Analysis, final: FinalModel, ready: ReadyFrames) -> str:
    """Return a clause on held-out frames whose gap is `LARGEST_GAP` times that of any searched frame; "" if none is.

    Parameters
    ----------
    analysis : Analysis
        Analysis of the frames.
    final : FinalModel
        Extended model with the spots of all frames.
    ready : ReadyFrames
        The frames, as they were given to the analysis.
    """
    held_out = np.flatnonzero(ready.frames.held_out())
    if not held_out.size:
        return ""
    frames = analysis.prepared.unseen
    gaps = measure_frame_gaps(measure_residuals(final.of_frames(held_out, frames.design), frames))
    # The gap of a right model is 1.
    limit = LARGEST_GAP * max(1.0, float(np.nanmax(measure_frame_gaps(analysis.images), initial=1.0)))
    is_deviating = gaps > limit
    if not is_deviating.any():
        return ""
    labels = [ready.rows[held_out[number]].label for number in np.flatnonzero(is_deviating)]
    more = [f"{len(labels) - MOST_NAMED} more"] if len(labels) > MOST_NAMED else []
    verb, factor = "deviates" if len(labels) == 1 else "deviate", float(np.sqrt(gaps[is_deviating].max()))
    return (
        f"{list_text([*labels[:MOST_NAMED], *more])} {verb} from the model by {factor:.2g} times the noise, far more"
        " than the searched frames: look for damage, and set keep to no in manifest.csv where there is some"
    )


def measure_frame_gaps(images: ResidualImages) -> np.ndarray:
    """Return the mean over blocks near the spot of (Σ r)²/Σ v of each frame [frame]; NaN for frames without a block.

    `r` is the residual of a pixel and `v` the variance of its noise; noise alone gives 1.
    """
    _, rows, columns = images.residual.shape
    x = (images.left - images.spots.x)[:, None, None] + np.arange(columns)
    y = (images.top - images.spots.y)[:, None, None] + np.arange(rows)[:, None]
    is_used = (images.weight > 0) & (np.hypot(x, y) < GAP_RADIUS * np.exp(images.spots.log_sigma)[:, None, None])
    variance = np.where(is_used, 1 / np.where(is_used, images.weight, 1.0), 0.0)
    residual, noise = (sum_over_blocks(values * is_used, BLOCK_PX) for values in (images.residual, variance))
    is_block = sum_over_blocks(is_used, BLOCK_PX) > BLOCK_PX**2 / 2
    squares = np.where(is_block, residual**2 / np.where(is_block, noise, 1.0), 0.0).sum(axis=(1, 2))
    count = is_block.sum(axis=(1, 2))
    return np.divide(squares, count, out=np.full(len(count), np.nan), where=count > 0)
