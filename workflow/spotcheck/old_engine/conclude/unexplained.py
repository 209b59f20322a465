"""How much is left once the light's shape is learned: by size, since p-values flag structure that no one would miss.

Mean residuals of blocks have the power of noise and what is unexplained beside it. Of noise fits take their part: the
frames' own numbers and the shape (`evidence/cells.py`).
"""

from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.conclude.detect import Looked
from spotcheck.old_engine.evidence.cells import BLOCK, COUNT, NORM, RADII, SUM, TAKEN

# Blocks whose middle lies further from the spot than this [σ] are left out: there is hardly any light.
REACH = float(RADII[-1])


class Unexplained(NamedTuple):
    """Power of block means above noise, as rms in parts of each frame's peak: `size` over all frames, its `error` (of
    the square, in squared peaks), and `noise`, what noise alone has; `z` the excess in its own errors; and `taken`, the
    part of the blocks' noise that fits took."""

    size: float
    error: float
    noise: float
    z: float
    taken: float


def unexplained(looked: Looked) -> Unexplained:
    """Measure what a fit with a learned shape leaves."""
    numbers, parts = looked.model.numbers, []
    for k, cells in enumerate(looked.cells):
        label, sums, drawn = cells["block"]
        middle = BLOCK * label + (BLOCK - 1) / 2 + np.array(looked.scene.corner)
        off = middle - [numbers.y[k], numbers.x[k]]
        good = (sums[:, COUNT] == BLOCK**2) & (np.hypot(*off.T) < REACH * np.exp(numbers.log_width[k]))
        unit = (BLOCK**2 * np.exp(numbers.log_peak[k])) ** 2
        taken = (sums[:, TAKEN:] ** 2).sum(axis=1) + (drawn**2).sum(axis=1)
        parts.append(np.stack([sums[:, SUM] ** 2, sums[:, NORM], taken])[:, good] / unit)
    square, before, taken = np.concatenate(parts, axis=1)
    if not square.size:
        return Unexplained(0.0, np.inf, np.inf, 0.0, 0.0)
    left = np.maximum(before - taken, 0.0)
    # Of a few draws a block may seem to lose more than it has: the mean over blocks is right, that of what is cut not.
    total = float((square - before + taken).mean())
    error = float(np.sqrt(2 * (left**2).sum())) / left.size
    noise = float((before - taken).mean())
    root = [float(np.sqrt(max(own, 0.0))) for own in (total, noise)]
    return Unexplained(root[0], error, root[1], total / max(error, 1e-300), 1 - noise / float(before.mean()))
