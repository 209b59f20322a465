"""Standardised readings summed over cells, with all that the laws of such sums need.

z = (y − µ)/√V of a reading y has mean 0, variance 1 and excess kurtosis κ₄. The frame's own four numbers were fitted:
with their slopes as orthonormal columns Q [pixel, 4], what is left of z is (1 − QQᵀ) z, and a sum aᵀz has the variance
aᵀa − |Qᵀa|².

Of noise a learned shape leaves the covariance (1 − H)², H the fit's projection of standardised readings. In terms of
the shape's coefficients, S = G + λP, a sum aᵀz loses aᵀ(2H − H²)a = Var aᵀBx + Var aᵀBx', with x ~ N(0, S⁻¹) and
x' ~ N(0, S⁻¹λPS⁻¹): draws of x + x' stand beside Q.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import linalg

from spotcheck.old_engine.evidence.pixels import AZIMUTHS
from spotcheck.old_engine.evidence.pixels import cells_of as about
from spotcheck.old_engine.evidence.windows import corner_of
from spotcheck.old_engine.model.chain import Free, light, true_exposure
from spotcheck.old_engine.nuisance.fit import NUMBERS, Fitted
from spotcheck.old_engine.nuisance.taken import draws_of
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Lights, Model
from spotcheck.old_engine.observe.readings import cumulants_of, look_up

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Columns of what `gather` sums over a cell: a z, a², a⁴κ₄; z² − 1 + h, its variance; pixels; then Qᵀa.
SUM, NORM, FOURTH, SQUARE, SQUARE_NORM, COUNT, TAKEN = range(7)
# Nodes of light, even in its root, at which fourth cumulants are summed: a thousandth of these matters not.
NODES = 2000
# Kinds of cells, and weights of the readings in their sums: plain, by an offset's score, by that of a part of the spot.
KINDS = {"block": 0, "row": 1, "column": 1, "level": 1, "sector": 2}
# Levels of light, even in its root; sides [px] of blocks and patches; bounds of the radius of
# sectors about the spot [σ].
LEVELS, BLOCK, PATCH = 12, 8, 24
RADII = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])
# A pixel whose variance is below this [DN²] repeats one number: the law of its z would be that of one reading in a
# million, which the exact law of the oddest reading judges instead.
CERTAIN = 1e-6


class Standard(NamedTuple):
    """Of every pixel of a frame [pixel]: z, √V [DN] (0: masked), cumulant κ₄ of its law; the slopes of z by an offset
    and by a part of the spot's declared light; that light, and all electrons [e-]; what fits take [column, pixel]: the
    frame's numbers Q, behind them draws of a learned shape; place about the spot, u and v [σ]. Row and column of the
    first pixel on the sensor; rows and columns of the crop."""

    z: np.ndarray
    spread: np.ndarray
    fourth: np.ndarray
    offset: np.ndarray
    relative: np.ndarray
    declared: np.ndarray
    electrons: np.ndarray
    taken: np.ndarray
    u: np.ndarray
    v: np.ndarray
    corner: tuple[int, int]
    shape: tuple[int, int]


class Readings:
    """A model made ready to standardise the readings of its frames; `shapes` are draws of what a learned one takes."""

    def __init__(self, frames: Sequence[Frame], model: Model, shapes: Sequence[Lights] = ()):
        self.frames, self.model, self.shapes = frames, model, shapes
        self.ready = Expectation(frames, model)
        law = self.ready.law
        root = law.first + law.step * np.arange(law.mean.size)
        # ASSUME: an effect behind the charge changes mean and variance, and hardly the higher cumulants.
        coarse = np.linspace(root[0], root[-1], NODES)
        self.fourth = np.interp(root, coarse, cumulants_of(model.sensor, coarse * np.abs(coarse))[3])[:, None]

    def of(self, k: int) -> Standard:
        """Standardised readings of frame `k`."""
        frame, model, law = self.frames[k], self.model, self.ready.law
        seen, centre, shape = self.ready.of(frame, k), self.ready.numbers_of(k), frame.pixels.shape
        # A learned shape follows the readings' noise: weights and levels that follow it would, too.
        view = frame.view._replace(x0=centre.x, y0=centre.y)
        base = Free(np.exp(centre.log_peak), np.exp(centre.log_width))
        declared = light(view, model.baseline, base, model.present)[0].ravel()
        dark = model.sensor.dark_current_e_per_s * true_exposure(frame.view, model.present)
        electrons = np.broadcast_to((seen.spot + seen.beside) / model.sensor.gain_dn_per_e + dark, (1, *shape))[0]
        fourth = np.empty((1, *shape))
        look_up(electrons, law.first, law.step, self.fourth, fourth)
        variance = seen.variance.ravel()
        known = np.isfinite(frame.pixels).ravel() & (variance > CERTAIN)
        weight = np.where(known, 1 / np.sqrt(np.maximum(variance, CERTAIN)), 0.0)
        z = np.where(known, (frame.pixels - seen.mean).ravel(), 0.0) * weight
        offset = seen.slope.ravel() * weight
        # A change s of the shape changes a reading by peak · slope · s.
        unit = offset * float(np.exp(centre.log_peak).item()) / np.sqrt(max(len(self.shapes), 1))
        taken = np.empty((NUMBERS + len(self.shapes), *shape))
        numbers = self.ready.by_numbers(frame, k, seen).reshape(NUMBERS, -1) * offset
        taken[:NUMBERS] = whitened(numbers).reshape(-1, *shape)
        for own, surface in zip(taken[NUMBERS:], self.shapes, strict=True):
            np.multiply(surface.of(k)(seen.u[None], seen.v[None])[0], unit.reshape(shape), out=own)
        return Standard(
            z, np.where(known, np.sqrt(variance), 0.0), fourth.ravel() * weight**4, offset, offset * declared,
            declared / model.sensor.gain_dn_per_e, electrons.ravel(), taken.reshape(len(taken), -1),
            np.broadcast_to(seen.u, shape).ravel(), np.broadcast_to(seen.v, shape).ravel(), corner_of(frame), shape,
        )  # fmt: skip


def whitened(slopes: np.ndarray) -> np.ndarray:
    """Slopes [number, pixel] made orthonormal; those that say nothing are 0."""
    size, axes = linalg.eigh(slopes @ slopes.T)
    good = size > 1e-10 * max(size[-1], 1e-300)
    root = np.where(good, 1 / np.sqrt(np.where(good, size, 1.0)), 0.0)
    return (axes * root).T @ slopes


def shapes_of(fitted: Fitted, count: int, rng: np.random.Generator) -> list[Lights]:
    """Shapes x + x' whose variance at any place is what a learned shape takes of noise there; none, none is learned."""
    lights = fitted.model.lights
    if lights is None:
        return []
    side = lights.side
    second = np.diff(np.eye(side), 2, axis=0)
    out = []
    for drawn in draws_of(fitted.schur, side, count, rng):
        # P is the sum of squared second differences along both axes.
        bent = [second.T @ rng.standard_normal((side - 2, side)) + rng.standard_normal((side, side - 2)) @ second
                for _ in drawn]  # fmt: skip
        smooth = linalg.cho_solve_banded((fitted.schur.factor, True), np.sqrt(fitted.penalty) * np.ravel(bent))
        out.append(lights._replace(coefficients=drawn + smooth.reshape(drawn.shape)))
    return out


@compiled
def gather(index, weight, which, z, fourth, taken, out):
    """Add a frame's pixels to cells: `index` [kind, pixel] of the cell, `weight` [weight, pixel] and `which` [kind] of
    the weights a is, `taken` [pixel, column]; `out` [cell, column] as named above."""
    for k in range(z.size):
        if weight[0, k] == 0:
            continue
        h = 0.0
        for j in range(taken.shape[1]):
            h += taken[k, j] * taken[k, j]
        for kind in range(index.shape[0]):
            own = out[index[kind, k]]
            a = weight[which[kind], k]
            a2 = a * a
            own[0] += a * z[k]
            own[1] += a2
            own[2] += a2 * a2 * fourth[k]
            own[3] += z[k] * z[k] - 1 + h
            own[4] += 2 + fourth[k] - 4 * h
            own[5] += 1
            for j in range(taken.shape[1]):
                own[6 + j] += a * taken[k, j]


class Cells(NamedTuple):
    """Sums of one kind over the cells of one frame: `label` [cell, 2] says which cell, `sums` [cell, column] as named
    above; `drawn` [cell, draw], the same sums of what a learned shape takes in each draw."""

    label: np.ndarray
    sums: np.ndarray
    drawn: np.ndarray


def cells_of(seen: Standard, brightest: float, corner: tuple[int, int]) -> dict[str, Cells]:
    """The cells of a frame by kind. Levels are counted up to `brightest` [e-], blocks from `corner` (row, column)."""
    rows, columns = (own - first + np.arange(n) for own, first, n in zip(seen.corner, corner, seen.shape, strict=True))
    rows = rows[:, None]
    level = np.minimum((np.sqrt(np.clip(seen.declared / brightest, 0.0, 1.0)) * LEVELS).astype(int), LEVELS - 1)
    level, sector = (own.reshape(seen.shape) for own in (level, about(seen.u, seen.v, RADII)))
    none = np.zeros((1, 1), int)
    labels = {
        "block": (rows // BLOCK, columns // BLOCK), "row": (rows, none), "column": (columns, none),
        "level": (level, none), "sector": (sector // AZIMUTHS, sector % AZIMUTHS),
    }  # fmt: skip
    index, spans, first = np.empty((len(KINDS), *seen.shape), np.int32), {}, 0
    for k, (kind, (one, two)) in enumerate(labels.items()):
        low = np.array([one.min(), two.min()])
        size = int(one.max()) - low[0] + 1, int(two.max()) - low[1] + 1
        index[k] = first + (one - low[0]) * size[1] + two - low[1]
        spans[kind] = slice(first, first + size[0] * size[1]), low + np.argwhere(np.ones(size))
        first += size[0] * size[1]
    out, last = np.zeros((first, TAKEN + len(seen.taken))), TAKEN + NUMBERS
    gather(index.reshape(len(KINDS), -1), np.stack([seen.spread, seen.offset, seen.relative]),
           np.array([*KINDS.values()]), seen.z, seen.fourth,
           np.ascontiguousarray(seen.taken.T), out)  # fmt: skip
    found = {kind: Cells(label, out[at, :last], out[at, last:]) for kind, (at, label) in spans.items()}
    # Blocks lie in patches, as rows do in the frame.
    coarse = {"patch": ("block", PATCH // BLOCK), "frame": ("row", seen.shape[0] + int(rows[0, 0]))}
    own = {name: found[kind]._replace(label=found[kind].label // side) for name, (kind, side) in coarse.items()}
    return found | {name: pooled([cells]) for name, cells in own.items()}


def pooled(frames: Sequence[Cells]) -> Cells:
    """Cells of one label added up over frames. What the numbers of each frame take stays apart: 4 columns a frame; the
    shape is the same in all."""
    labels = np.concatenate([own.label for own in frames]).astype(np.int64)
    low, span = labels.min(axis=0), int(np.ptp(labels[:, 1])) + 1
    place, where = np.unique((labels - low) @ [span, 1], return_inverse=True)
    sums, drawn = (
        np.zeros((len(place), TAKEN + NUMBERS * len(frames))),
        np.zeros((len(place), frames[0].drawn.shape[1])),
    )
    parts = np.split(where.reshape(-1), np.cumsum([len(own.label) for own in frames])[:-1])
    for k, (own, at) in enumerate(zip(frames, parts, strict=True)):
        mine = slice(TAKEN + NUMBERS * k, TAKEN + NUMBERS * (k + 1))
        np.add.at(sums[:, :TAKEN], at, own.sums[:, :TAKEN])
        np.add.at(sums[:, mine], at, own.sums[:, TAKEN:])
        np.add.at(drawn, at, own.drawn)
    return Cells(np.stack([place // span, place % span], 1) + low, sums, drawn)
