"""What frames read beside their crops: blocks of the whole frame that hold no light of the spot.

Light of another source, a second spot or stripes of the sensor may lie where no crop is cut. Only blocks count in which
the base's spot is fainter than their own noise: there its parameters do not matter. The level that all blocks share is
taken off: what black level and read noise bring to it is told by the crops.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.detect import cubic
from spotcheck.discrepancy.explain import Account
from spotcheck.discrepancy.look import Look, scenes
from spotcheck.discrepancy.refit import plain
from spotcheck.discrepancy.shots import Shot

STATISTIC = "surround: blocks"
# Points a block along each axis at which a model is evaluated.
POINTS = 4
# Fewer blocks than this say nothing.
LEAST = 6
# Why a verdict that explains the crops does not explain the frames.
LEFT = "what the frames read beside their crops stays unexplained"
SIDES = ("left of the crops", "right of the crops", "above the crops", "below the crops")


class Surround(NamedTuple):
    """Blocks beside the crops [condition, block row, block column], averaged over the frames of a condition: residual
    from the model [DN] without what all share, its variance [DN²] (inf where a block is not to be used); and the side
    of the crops [block row, block column] on which each block lies, by number in `SIDES`."""

    residual: np.ndarray
    variance: np.ndarray
    side: np.ndarray

    def pull(self, side: int | None = None) -> tuple[float, int]:
        """χ² and its degrees of freedom; of one side of the crops only."""
        used = np.isfinite(self.variance) & (True if side is None else self.side == side)
        return float((self.residual[used] ** 2 / self.variance[used]).sum()), max(int(used.sum()) - 1, 0)

    @property
    def statistic(self) -> float:
        """χ² as a normal number; 0 without any degree of freedom."""
        chi2, freedom = self.pull()
        return cubic(chi2, freedom) if freedom else 0.0

    def off(self) -> float:
        """Rms of the residual [DN] in the worst condition, free of noise; within two standard errors it is 0."""
        worst = 0.0
        for residual, variance in zip(self.residual, self.variance, strict=True):
            used = np.isfinite(variance)
            if used.any():
                error = np.sqrt(2 * np.mean(variance[used] ** 2) / used.sum())
                excess = np.mean(residual[used] ** 2 - variance[used]) - 2 * error
                worst = max(worst, float(np.sqrt(max(excess, 0.0))))
        return worst


def surround_of(shots: Sequence[Shot], look: Look, own: Account) -> Surround | None:
    """The surroundings of the frames of a look under an account; None where the frames have none to speak of."""
    if any(shot.beside is None for shot in shots):
        return None
    design = look.measured.design
    *_, expect = scenes(shots, look, own.refit.model, own.latent)
    *_, bare = scenes(shots, look, plain(look.cells), own.latent)
    crop = shots[0].pixels().shape
    total: np.ndarray | None = None
    for k, shot in enumerate(shots):
        assert shot.beside is not None  # asked above
        blocks = shot.beside()
        rows, columns = (n * POINTS for n in blocks.mean.shape)
        x, y = (((np.arange(n) + 0.5) * blocks.side / POINTS - 0.5) for n in (columns, rows))
        scene, spot = expect(k, x, y), bare(k, x, y)
        variance = _pooled(scene.variance) / blocks.side**2
        dark = _pooled(spot.light) < np.sqrt(variance)
        dark &= ~_covered(blocks, shot, crop)
        if total is None:
            total = np.zeros((3, design.conditions, *blocks.mean.shape))
            side = _sides(blocks, shot, crop)
        off = blocks.mean - _pooled(scene.mean)
        if "row" in own.component:
            off, variance = _apart(off, np.where(dark, variance, np.inf), axis=1)
            dark = np.isfinite(variance)
        c = design.condition[k]
        # A frame's own weight is 1: its blocks differ by little else than the light of the spot.
        total[0, c] += np.where(dark, off, 0.0)
        total[1, c] += np.where(dark, variance, 0.0)
        total[2, c] += dark
    assert total is not None  # there are frames
    count = np.maximum(total[2], 1)
    residual = total[0] / count
    variance = np.where(total[2] > 0, total[1] / count**2, np.inf)
    if "pixel" in own.component and look.hot:
        # Hot pixels lie beside the crops as well, and read the same in every condition.
        residual, variance = _apart(residual, variance, axis=0)
    weight = 1 / variance
    if np.count_nonzero(weight) < LEAST:
        return None
    return Surround(np.where(weight > 0, residual - (weight * residual).sum() / weight.sum(), 0.0), variance, side)


def _apart(residual: np.ndarray, variance: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals without what blocks along an axis share, and their variance: inf where a block is the only one."""
    weight = 1 / variance
    total = weight.sum(axis=axis, keepdims=True)
    mean = (weight * residual).sum(axis=axis, keepdims=True) / np.maximum(total, 1e-300)
    left = 1 - weight / np.maximum(total, 1e-300)
    alone = (weight == 0) | (left < 1e-9)
    return residual - mean, np.where(alone, np.inf, variance * np.where(alone, 1.0, left))


def _pooled(values: np.ndarray) -> np.ndarray:
    """Means over the points of every block."""
    rows, columns = (n // POINTS for n in values.shape)
    return values.reshape(rows, POINTS, columns, POINTS).mean(axis=(1, 3))


def _covered(blocks, shot: Shot, crop: tuple[int, ...]) -> np.ndarray:
    """Blocks [block row, block column] that a crop touches."""
    rows, columns = (np.arange(n) * blocks.side for n in blocks.mean.shape)
    inside_y = (rows + blocks.side > shot.top) & (rows < shot.top + crop[0])
    inside_x = (columns + blocks.side > shot.left) & (columns < shot.left + crop[1])
    return inside_y[:, None] & inside_x[None, :]


def _sides(blocks, shot: Shot, crop: tuple[int, ...]) -> np.ndarray:
    """On which side of a crop each block lies: the one towards which it is further off."""
    rows, columns = ((np.arange(n) + 0.5) * blocks.side for n in blocks.mean.shape)
    dy = (rows - shot.top - crop[0] / 2)[:, None] + 0 * columns[None, :]
    dx = (columns - shot.left - crop[1] / 2)[None, :] + 0 * rows[:, None]
    across = np.abs(dx) >= np.abs(dy)
    return np.where(across, np.where(dx < 0, 0, 1), np.where(dy < 0, 2, 3))
