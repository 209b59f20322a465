"""What pixels share beside the model: fields of a site, gains of the sensor's pixels, and offsets of a frame's rows.

A field δ on the light moves a reading by a δ, a its slope. With weights 1/V a member (a frame, or a site of a sensor)
has s = a r/V and n = a²/V of each pixel; what members share has S = Σ s and N = Σ n, and S the variance N + θ N² where
the field's is θ. Products of different members have the mean θ n n' whatever the noise is; one alone has its square.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.evidence.pixels import CELLS, Ready, cells_of
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.model.effect import Context, Effect, Present

# Rounds in which a variance and the weights that depend on it are found.
ROUNDS = 8
# Rows that only one frame of a condition shows are told beyond this distance from the spot [σ].
BESIDE = 3.0
# Fewer places than this tell no variance.
FEWEST = 30


class Places(NamedTuple):
    """Of every place (a pixel of a window, or a row) [place]: what the squared sum exceeds its noise by, what it would
    for a variance of 1, N, the variance of that excess without any field, and its cell and cluster: places of different
    clusters know nothing of each other."""

    excess: np.ndarray
    unit: np.ndarray
    weight: np.ndarray
    noise: np.ndarray
    cell: np.ndarray
    cluster: np.ndarray


class Variance(NamedTuple):
    """Variance of a pattern and its standard error, what −2 ln L gains with it, and Q over so many cells."""

    value: float
    error: float
    gain: float
    q: float
    cells: int


class Pattern(NamedTuple):
    """An effect that scatters pixels or rows, its strength's standard error, and what tells it."""

    own: Present
    error: float
    told: Variance


def patterns_of(
    sites: Sequence["Site"], rows: Places, effects: Sequence[Effect], context: Context
) -> Iterator[Pattern]:
    """What sums over frames (`gathered`) tell of effects that scatter pixels or rows, beside a fit without them."""
    kinds = {(e.scatter.of, e.scatter.shared): e for e in effects if e.scatter and e.scatter.of in ("field", "row")}
    sensor = variance_of(shared_by_sensor(sites))
    found = {
        ("field", "sensor"): sensor,
        ("field", "site"): variance_of(shared_by_sites(sites), sensor.value if sensor else 0.0),
        ("row", "frame"): variance_of(rows),
    }
    for kind, told in found.items():
        if kind in kinds and told is not None and told.value > 0:
            effect, root = kinds[kind], float(np.sqrt(told.value))
            values = (root, *map(float, effect.starts(context)[0][1:]))
            yield Pattern(Present(effect, effect.forms[0], values), told.error / (2 * root), told)


class Site(NamedTuple):
    """Of one site: the corner of its window (row, column) [px], and of its pixels [row, column] S, Σ s², N, Σ n² over
    its frames, and the cell; `single` where it has one frame."""

    corner: tuple[int, int]
    pull: np.ndarray
    square: np.ndarray
    weight: np.ndarray
    heavy: np.ndarray
    cell: np.ndarray
    single: bool


def gathered(frames: Sequence[Frame], design: Design, ready: Ready) -> tuple[list[Site], Places]:
    """One pass over all frames: the sums of every site, and the places of all rows."""
    sites, lines = [], []
    for site in np.unique(design.site):
        own = np.flatnonzero(design.site == site)
        corners = np.array([_corner(frames[k]) for k in own])
        low = corners.min(axis=0)
        high = (corners + [frames[k].pixels.shape for k in own]).max(axis=0)
        total = np.zeros((4, *(high - low)))
        cell = np.zeros(high - low, int)
        for k, corner in zip(own, corners, strict=True):
            frame = frames[k]
            seen, tells = ready.of(frame, int(k))
            a = seen.spot * seen.slope
            s, n = a * tells.mean, a * a * tells.sure
            (top, left), (height, width) = corner - low, frame.pixels.shape
            at = slice(top, top + height), slice(left, left + width)
            for sums, part in zip(total, (s, s * s, n, n * n), strict=True):
                sums[at] += part
            cell[at] = cells_of(seen.u, seen.v)
            far = np.hypot(seen.u, seen.v) > (BESIDE if np.sum(design.condition == design.condition[k]) < 2 else 0.0)
            row = np.broadcast_to(np.rint(seen.v * np.exp(ready.plain.model.numbers.log_width[k])), far.shape)[:, 0]
            lines.append((int(k), row, (tells.mean * far).sum(axis=1), (tells.sure * far).sum(axis=1)))
        sites.append(Site((int(low[0]), int(low[1])), *total, cell, len(own) < 2))
    return sites, _rows(lines, design)


def _corner(frame: Frame) -> tuple[int, int]:
    return int(np.rint(frame.view.y.min())), int(np.rint(frame.view.x.min()))


def _rows(lines, design: Design) -> Places:
    """Rows of all frames, beside what frames of one condition have in common at the same distance from the spot."""
    which, row, pull, weight = (
        np.concatenate([np.broadcast_to(own[j], own[1].shape) for own in lines]) for j in range(4)
    )
    _, group = np.unique(np.stack([design.condition[which], row.astype(int)]), axis=1, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)[group]
    common, total = np.bincount(group, pull)[group], np.bincount(group, weight)[group]
    # A frame alone has nothing in common with others, and is told beside the spot alone.
    part = np.where(count > 1, weight / np.maximum(total, 1e-300), 0.0)
    rest = pull - np.where(count > 1, part * common, 0.0)
    left = weight * (1 - part)
    good = left > 0
    return Places((rest**2 - left)[good], (weight * left)[good], weight[good], (2 * left**2)[good],
                  which[good] % CELLS, which[good])  # fmt: skip


def shared_by_sites(sites: Sequence[Site]) -> Places:
    """The fields that frames of a site share: products of different frames, or the square of one alone."""
    parts = []
    for k, own in enumerate(sites):
        beside, other = (own.weight, 0.0) if own.single else (own.square, own.heavy)
        places = Places(own.pull**2 - beside, own.weight**2 - other, own.weight, 2 * (own.weight**2 - other), own.cell,
                        k * CELLS + own.cell)  # fmt: skip
        # Where one frame alone sees a pixel that others of its site do not, nothing is shared.
        parts.append([part[places.unit > 0] for part in places])
    return Places(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def shared_by_sensor(sites: Sequence[Site]) -> Places | None:
    """The field that all sites share where their windows lie on the same pixels: products of different sites."""
    if len(sites) < 2:
        return None
    low = np.min([own.corner for own in sites], axis=0)
    high = np.max([np.add(own.corner, own.pull.shape) for own in sites], axis=0)
    if np.any(high - low > 2 * np.max([own.pull.shape for own in sites], axis=0)):
        return None
    total, cell = np.zeros((4, *(high - low))), np.zeros(high - low, int)
    for own in sites:
        (top, left), (height, width) = np.subtract(own.corner, low), own.pull.shape
        at = slice(top, top + height), slice(left, left + width)
        for sums, part in zip(total, (own.pull, own.pull**2, own.weight, own.weight**2), strict=True):
            sums[at] += part
        cell[at] = own.cell
    pull, square, weight, heavy = total
    unit = weight**2 - heavy
    places = Places(pull**2 - square, unit, weight, 2 * unit, cell, cell)
    return Places(*(own[unit > 0] for own in places))


def variance_of(places: Places | None, known: float = 0.0) -> Variance | None:
    """Variance of what places share, beside a part of it that is known; None where too few tell it."""
    if places is None or len(places.unit) < FEWEST:
        return None
    excess = places.excess - known * places.unit
    value, light = 0.0, np.ones_like(places.unit)
    for _ in range(ROUNDS):
        # The weight of a place beside the field itself.
        light = (1 + (value + known) * places.weight) ** -2.0
        value = max(float(light @ excess) / float(light @ places.unit), 0.0)
    rest, unit = light * (excess - value * places.unit), float(light @ places.unit)
    spread = light**2 * places.noise / light
    clusters = np.bincount(places.cluster, rest)
    own = float(spread.sum())
    # Neighbours of a granular field share it: what clusters scatter by tells how many count as one.
    inflated = max(float(clusters @ clusters) / own, 1.0)
    x = value * places.weight
    share = places.weight**2 / places.unit
    seen = 1 + excess * share / places.weight
    gain = float(np.sum(seen * x / (1 + x) - np.log1p(x))) / inflated
    by_cell, noise = np.bincount(places.cell, rest, CELLS), np.bincount(places.cell, spread, CELLS) * inflated
    told = noise > 1e-4 * noise.max()
    return Variance(value, float(np.sqrt(own * inflated)) / unit, gain, float(np.sum(by_cell[told] ** 2 / noise[told])),
                    int(told.sum()))  # fmt: skip
