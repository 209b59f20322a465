"""Standardised readings summed over cells, with all that the laws of such sums need.

z = (y − µ)/√V of a reading y has mean 0, variance 1 and cumulants κ₃, κ₄. The frame's own four numbers were fitted:
with their slopes as orthonormal columns Q [pixel, 4], what is left of z is (1 − QQᵀ) z, and a sum aᵀz has the
variance aᵀa − |Qᵀa|². Where a learned shape was fitted too, draws of what it takes stand beside Q (`taken.py`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import linalg

from spotcheck.discrepancy.observe.pixels import Expectation, Frame, Model
from spotcheck.discrepancy.observe.readings import cumulants_of, look_up
from spotcheck.model.chain import Free, light, true_exposure

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Columns of what `gather` sums over a cell: a z, a², a³κ₃, a⁴κ₄; z² − 1 + h, its variance; then Qᵀa.
SUM, NORM, THIRD, FOURTH, SQUARE, SQUARE_NORM, COUNT, TAKEN = range(8)
NUMBERS = 4
# Nodes of light, even in its root, at which third and fourth cumulants are summed: a thousandth of these matters not.
NODES = 2000
# Levels of light, even in its root, at which residuals are compared.
LEVELS = 12
# Side [px] of the smallest blocks, and how many of them a coarse block has along each side.
BLOCK, COARSE = 8, 3
# Sectors about the spot: azimuths, and bounds of the radius [σ].
AZIMUTHS, RADII = 8, np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])
# A pixel whose variance is below this [DN²] repeats one number: the law of its z would be that of one reading in a
# million, which the exact law of the largest reading judges instead.
CERTAIN = 1e-6


class Standard(NamedTuple):
    """Of every pixel of a frame [pixel]: z, √V [DN] (0: masked), cumulants κ₃ and κ₄ of its law; the slopes of z by an
    offset and by a part of the spot's declared light; that light [e-], and all electrons; what the frame's numbers
    take, Q [4, pixel]; place on the sensor (row, column) and about the spot, u and v [σ]; and rows and columns of the
    crop."""

    z: np.ndarray
    spread: np.ndarray
    third: np.ndarray
    fourth: np.ndarray
    offset: np.ndarray
    relative: np.ndarray
    declared: np.ndarray
    electrons: np.ndarray
    taken: np.ndarray
    row: np.ndarray
    column: np.ndarray
    u: np.ndarray
    v: np.ndarray
    shape: tuple[int, int]


class Readings:
    """A model made ready to standardise the readings of its frames."""

    def __init__(self, frames: Sequence[Frame], model: Model):
        self.frames, self.model = frames, model
        self.ready = Expectation(frames, model)
        law = self.ready.law
        root = law.first + law.step * np.arange(law.mean.size)
        # ASSUME: an effect behind the charge changes mean and variance, and hardly the higher cumulants.
        coarse = np.linspace(root[0], root[-1], NODES)
        higher = cumulants_of(model.sensor, coarse * np.abs(coarse))[2:]
        self.table = np.stack([np.interp(root, coarse, own) for own in higher])

    def of(self, k: int) -> Standard:
        """Standardised readings of frame `k`."""
        frame, model, law = self.frames[k], self.model, self.ready.law
        seen = self.ready.of(frame, k)
        own = self.ready.numbers_of(k)
        # A learned shape follows the readings' noise: weights and levels that follow it would, too.
        view = frame.view._replace(x0=own.x, y0=own.y)
        plain = model.baseline._replace(learned=None)
        declared = light(view, plain, Free(np.exp(own.log_peak), np.exp(own.log_width)), model.present)[0].ravel()
        shape = frame.pixels.shape
        dark = model.sensor.dark_current_e_per_s * true_exposure(frame.view, model.present)
        electrons = np.broadcast_to((seen.spot + seen.beside) / model.sensor.gain_dn_per_e + dark, (1, *shape))[0]
        higher = np.empty((2, *shape))
        look_up(electrons, law.first, law.step, self.table, higher)
        electrons, higher = electrons.ravel(), higher.reshape(2, -1)
        variance = seen.variance.ravel()
        known = np.isfinite(frame.pixels).ravel() & (variance > CERTAIN)
        weight = np.where(known, 1 / np.sqrt(np.maximum(variance, CERTAIN)), 0.0)
        z = np.where(known, (frame.pixels - seen.mean).ravel(), 0.0) * weight
        offset = seen.slope.ravel() * weight
        slopes = self.ready.by_numbers(frame, k, seen).reshape(NUMBERS, -1) * offset
        taken = whitened(slopes)
        row, column = (np.rint(np.broadcast_to(axis, (1, *frame.pixels.shape))).astype(np.int64).ravel()
                       for axis in (frame.view.y, frame.view.x))  # fmt: skip
        u, v = (np.broadcast_to(place, shape).ravel() for place in (seen.u, seen.v))
        return Standard(
            z, np.where(known, np.sqrt(variance), 0.0), higher[0] * weight**3, higher[1] * weight**4, offset,
            offset * declared, declared / model.sensor.gain_dn_per_e, electrons, taken, row, column, u, v,
            shape,
        )  # fmt: skip


def whitened(slopes: np.ndarray) -> np.ndarray:
    """Slopes [number, pixel] made orthonormal; those that say nothing are 0."""
    size, axes = linalg.eigh(slopes @ slopes.T)
    good = size > 1e-10 * max(size[-1], 1e-300)
    root = np.where(good, 1 / np.sqrt(np.where(good, size, 1.0)), 0.0)
    return (axes * root).T @ slopes


@compiled
def gather(index, weight, which, z, third, fourth, taken, out):
    """Add a frame's pixels to cells: `index` [kind, pixel] of the cell (below 0: none), `weight` [weight, pixel] and
    `which` [kind] of the weights a is; `out` [cell, column] as named above."""
    numbers = taken.shape[0]
    for k in range(z.size):
        if weight[0, k] == 0 and weight[1, k] == 0:
            continue
        h = 0.0
        for j in range(numbers):
            h += taken[j, k] * taken[j, k]
        square, spread = z[k] * z[k] - 1 + h, 2 + fourth[k] - 4 * h
        for kind in range(index.shape[0]):
            cell = index[kind, k]
            if cell < 0:
                continue
            a = weight[which[kind], k]
            a2 = a * a
            out[cell, 0] += a * z[k]
            out[cell, 1] += a2
            out[cell, 2] += a2 * a * third[k]
            out[cell, 3] += a2 * a2 * fourth[k]
            out[cell, 4] += square
            out[cell, 5] += spread
            out[cell, 6] += 1
            for j in range(numbers):
                out[cell, 7 + j] += a * taken[j, k]


class Cells(NamedTuple):
    """Sums of one kind over the cells of one frame: `label` [cell, 2] says which cell, `sums` [cell, column] as named
    above; `drawn` [cell, draw], the same sums of what a learned shape takes in each draw."""

    label: np.ndarray
    sums: np.ndarray
    drawn: np.ndarray


KINDS = ("block", "row", "column", "level", "sector")


def cells_of(
    seen: Standard, brightest: float, corner: tuple[int, int], drawn: np.ndarray | None = None
) -> dict[str, Cells]:
    """The cells of a frame by kind. Levels are counted up to `brightest` [e-], blocks from `corner` (row, column);
    `drawn` [draw, pixel] is what a learned shape takes."""
    rows, columns = seen.row - corner[0], seen.column - corner[1]
    level = np.sqrt(np.clip(seen.declared / brightest, 0.0, 1.0))
    turn = np.floor((np.arctan2(seen.v, seen.u) / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int) % AZIMUTHS
    ring = np.digitize(np.hypot(seen.u, seen.v), RADII)
    labels = {
        "block": (rows // BLOCK, columns // BLOCK),
        "row": (rows, 0 * rows),
        "column": (columns, 0 * rows),
        "level": (np.minimum((level * LEVELS).astype(int), LEVELS - 1), 0 * rows),
        "sector": (ring, turn),
    }
    index, spans, first = np.empty((len(labels), seen.z.size), np.int32), [], 0
    for k, (one, two) in enumerate(labels.values()):
        low = int(one.min()), int(two.min())
        size = int(one.max()) - low[0] + 1, int(two.max()) - low[1] + 1
        index[k] = first + (one - low[0]) * size[1] + two - low[1]
        spans.append((first, low, size))
        first += size[0] * size[1]
    taken = seen.taken if drawn is None else np.concatenate([seen.taken, drawn])
    out = np.zeros((first, TAKEN + len(taken)))
    which = np.array([1 if kind == "sector" else 0 for kind in KINDS])
    weights = np.stack([seen.offset, seen.relative])
    gather(index, weights, which, seen.z, seen.third, seen.fourth, taken, out)
    found = {}
    for kind, (start, low, size) in zip(KINDS, spans, strict=True):
        place = np.stack(np.meshgrid(*(low[d] + np.arange(size[d]) for d in (0, 1)), indexing="ij"), -1).reshape(-1, 2)
        own = out[start : start + size[0] * size[1]]
        found[kind] = Cells(place, own[:, : TAKEN + NUMBERS], own[:, TAKEN + NUMBERS :])
    return found


def place_of(kind: str, label: tuple[int, int], corner: tuple[int, int]) -> str:
    """Where a cell lies, in words."""
    one, two = label
    if kind in ("block", "coarse block"):
        side = BLOCK * (COARSE if kind == "coarse block" else 1)
        return f"{side} px about row {corner[0] + side * one + side // 2}, column {corner[1] + side * two + side // 2}"
    if kind in ("row", "column"):
        return f"{kind} {corner[kind == 'column'] + one}"
    if kind == "level":
        return f"light of {(one / LEVELS) ** 2:.3f} to {((one + 1) / LEVELS) ** 2:.3f} of the brightest"
    if kind == "sector":
        radius = "within 0.5 σ" if one == 0 else f"beyond {RADII[one - 1]:g} σ"
        return f"{radius} at {(two + 0.5) * 360 / AZIMUTHS - 180:.0f}°"
    return ""


def coarser(cells: Cells, factor: int = COARSE) -> Cells:
    """Blocks of blocks."""
    return pooled([cells._replace(label=cells.label // factor)])


def pooled(frames: Sequence[Cells]) -> Cells:
    """Cells of one label added up over frames. What the numbers of each frame take stays apart: 4 columns a frame; the
    shape is the same in all."""
    labels = np.concatenate([own.label for own in frames]).astype(np.int64)
    low, span = labels.min(axis=0), int(np.ptp(labels[:, 1])) + 1
    place, where = np.unique((labels[:, 0] - low[0]) * span + labels[:, 1] - low[1], return_inverse=True)
    where = where.reshape(-1)
    label = np.stack([place // span + low[0], place % span + low[1]], axis=1)
    sums = np.zeros((len(label), TAKEN + NUMBERS * len(frames)))
    drawn = np.zeros((len(label), frames[0].drawn.shape[1]))
    first = 0
    for k, own in enumerate(frames):
        at = where[first : first + len(own.label)]
        first += len(own.label)
        mine = TAKEN + NUMBERS * k
        np.add.at(sums[:, :TAKEN], at, own.sums[:, :TAKEN])
        np.add.at(drawn, at, own.drawn)
        np.add.at(sums[:, mine : mine + NUMBERS], at, own.sums[:, TAKEN:])
    return Cells(label, sums, drawn)
