"""How much is left once the light's shape is learned: by size, since p-values flag structure that no one would miss.

Mean residuals of blocks have the power of noise and what is unexplained beside it. Noise goes through the fit as well:
with H the fit's projection of standardised readings, it is left with the covariance (1 − H)². Draws of the shape's
coefficients tell how much the shape takes (`evidence/taken.py`); the frame's own numbers take |Qᵀa|² besides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.evidence.cells import BLOCK, RADII, Readings, Standard
from spotcheck.discrepancy.evidence.taken import shapes_of
from spotcheck.discrepancy.nuisance.fit import Fitted
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.model.light_shape import LightShape

# Draws of the shape's coefficients, by which it is told how much noise the shape takes: to 1 part in 30 of that, since
# many nodes share in it.
DRAWS = 12
# Blocks whose middle lies further from the spot than this [σ] are left out: there is hardly any light.
REACH = float(RADII[-1])


class Unexplained(NamedTuple):
    """Power of block means above noise, as rms in parts of each frame's peak: `size` over all frames, its `error` (of
    the square, in squared peaks), and `noise`, what noise alone has; `z` the excess in its own errors; `by_frame`
    [frame] and `by_ring` [ring of the radius] rms likewise (0: below noise); `taken` the part of the blocks' noise that
    fits took; and the oddest block's frame, row, column [px of the sensor] and mean residual in parts of the peak."""

    size: float
    error: float
    noise: float
    z: float
    by_frame: np.ndarray
    by_ring: np.ndarray
    taken: float
    worst: tuple[int, float, float, float]


class _Blocks(NamedTuple):
    """Of the blocks of a frame about the spot [block]: mean residual and its variance before fits [peak, peak²], what
    the frame's numbers take of that, radius [σ], place [px]; of each pixel, its block (−1: none) and the slope of its
    reading [1]."""

    mean: np.ndarray
    variance: np.ndarray
    taken: np.ndarray
    radius: np.ndarray
    row: np.ndarray
    column: np.ndarray
    block: np.ndarray
    share: np.ndarray


def unexplained(frames: Sequence[Frame], fitted: Fitted, design: Design, seed: int = 0) -> Unexplained:
    """Measure what a fit leaves."""
    readings = Readings(frames, fitted.model)
    peak = np.exp(fitted.model.numbers.log_peak)
    condition = np.asarray(design.condition)
    learned = fitted.model.baseline.learned is not None
    shapes = shapes_of(fitted, DRAWS, np.random.default_rng(seed)) if learned else []
    blocks, parts = [], {}
    for k in range(len(frames)):
        seen = readings.of(k)
        own = _blocks(seen, float(peak[k]))
        blocks.append(own)
        c = int(condition[k])
        if c not in parts:
            # Frames of one condition are so alike that the shape takes the same part of their noise.
            parts[c] = _taken_by_shape(seen, own, shapes) / max(float(own.variance.sum()), 1e-300)
    left = [own.variance * max(1 - parts[int(c)], 0.0) - own.taken for own, c in zip(blocks, condition, strict=True)]
    excess = [own.mean**2 - v for own, v in zip(blocks, left, strict=True)]
    count = sum(len(own) for own in excess)
    if not count:
        return Unexplained(0.0, np.inf, np.inf, 0.0, np.zeros(len(frames)), np.zeros(len(RADII)), 0.0, (0, 0, 0, 0.0))
    total = float(sum(own.sum() for own in excess)) / count
    noise = float(sum(v.sum() for v in left)) / count
    before = float(sum(own.variance.sum() for own in blocks)) / count
    error = float(np.sqrt(2 * sum((np.maximum(v, 0.0) ** 2).sum() for v in left))) / count
    ring = np.concatenate([np.digitize(own.radius, RADII) for own in blocks])
    size = np.maximum(np.bincount(ring, minlength=len(RADII)), 1)
    by_ring = np.bincount(ring, np.concatenate(excess), len(RADII)) / size
    score = [own / np.sqrt(np.maximum(v, 1e-3 * b.variance)) for own, v, b in zip(excess, left, blocks, strict=True)]
    k = int(np.argmax([own.max(initial=-1.0) for own in score]))
    j = int(np.argmax(score[k]))
    worst = k, float(blocks[k].row[j]), float(blocks[k].column[j]), float(blocks[k].mean[j])
    return Unexplained(_root(total), error, _root(noise), total / max(error, 1e-300),
                       np.array([_root(own.mean()) if own.size else 0.0 for own in excess]),
                       np.sqrt(np.maximum(by_ring, 0.0)), 1 - noise / before, worst)  # fmt: skip


def _root(power: float) -> float:
    return float(np.sqrt(max(power, 0.0)))


def _blocks(seen: Standard, peak: float) -> _Blocks:
    """The whole blocks of a frame about its spot."""
    rows, columns = seen.shape
    across = columns // BLOCK
    row, column = (axis - axis.min() for axis in (seen.row, seen.column))
    inside = (row < rows // BLOCK * BLOCK) & (column < across * BLOCK) & (seen.spread > 0)
    index = np.where(inside, row // BLOCK * across + column // BLOCK, -1)
    number = max(rows // BLOCK * across, 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(index[inside], values[inside], number) / np.maximum(count, 1)

    count = np.bincount(index[inside], minlength=number)
    radius = np.hypot(mean(seen.u), mean(seen.v))
    good = (count == BLOCK**2) & (radius < REACH)
    new = np.cumsum(good) - 1
    kept = np.where(inside & good[np.maximum(index, 0)], new[np.maximum(index, 0)], -1)
    variance = mean(seen.spread**2) / BLOCK**2
    taken = np.sum([mean(seen.spread * own) ** 2 for own in seen.taken], axis=0)
    share = seen.spread * seen.offset
    return _Blocks(mean(seen.z * seen.spread)[good] / peak, variance[good] / peak**2, taken[good] / peak**2,
                   radius[good], mean(seen.row)[good], mean(seen.column)[good], kept, share)  # fmt: skip


def _taken_by_shape(seen: Standard, blocks: _Blocks, shapes: Sequence[LightShape]) -> float:
    """Σ over blocks of the variance that the shape takes [peak²]."""
    inside = blocks.block >= 0
    u, v, index = seen.u[inside], seen.v[inside], blocks.block[inside]
    # A change s of the shape changes a reading by peak · slope · s.
    share = blocks.share[inside]
    total = 0.0
    for shape in shapes:
        moved = np.bincount(index, share * shape(u, v), len(blocks.mean)) / BLOCK**2
        total += float(moved @ moved)
    return total / max(len(shapes), 1)
