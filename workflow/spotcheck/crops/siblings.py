"""Spot frames that are not like their siblings: blocked, moved, or exposed twice.

Light, width and place of a frame are set beside those of its siblings. These are the repeats of its condition, less
what a site has in all its frames; where a condition has fewer than three, the same site at the exposures before and
after, or at the places along the beam. Only gross outliers are set aside. A laser that flickers, drifts or walks makes
a scatter that all frames share: it is the scale here, and the verdict's matter.
"""

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from spotcheck.crops.spotfinding import median_of_nine
from spotcheck.dataset.folder import Dataset

# Good frames stand out at this rate at most where their numbers scatter by Student's law of five degrees of freedom,
# whose tails are far heavier than normal ones. Each of a frame's four numbers has a quarter of it.
ALARM, TAILS, NUMBERS = 1e-4, 5.0, 4
# What a median absolute deviation is of a normal σ, and the part of the values that would tell σ as well by squares.
NORMAL, EFFICIENCY = 1.4826, 0.37
# What is gross: the siblings' light or width times this, or a centre that is off by this part of their width.
BLOCKED, TWICE, NARROW, WIDE, MOVED = 0.75, 1.5, 0.75, 1.33, 0.5
# As many repeats tell an odd one among them. A third of them may be odd, and of all spots a tenth, or one.
FEWEST, OF_SIBLINGS, OF_ALL = 3, 3, 10
# Frames of a series on either side of one that it judges: an odd end must not make its neighbour odd.
BESIDE = 2
# Axes along which light and place run smoothly; along any other they may do anything.
SMOOTH = ("exposure", "z_m")
# Medians of conditions and of sites in turn settle in a few turns.
TURNS = 5
# A pixel counts as lit by so much over the noise of a reading, of which the median of nine keeps 0.41, or over this.
LIT, FAINTEST_DN = 3.0, 1.0
FEWEST_LIT = 9


class Glance(NamedTuple):
    """Light [DN px], width σ [px] and centre on the sensor [px] of a spot by its moments, and what noise does to ln
    light, ln width and the centre along an axis [px]."""

    light: float
    sigma: float
    x: float
    y: float
    light_error: float
    sigma_error: float
    centre_error: float


class Odd(NamedTuple):
    """A frame to be set aside: its place among the spots, its flag, and what is wrong."""

    spot: int
    flag: str
    why: str


class _Beside(NamedTuple):
    """Of every frame [frame, number] how far ln light, ln width, x and y are off its siblings', and how far they may be
    (infinite: not judged); and a name of the siblings that it is among."""

    off: np.ndarray
    most: np.ndarray
    among: list[Hashable]


def glance(crop: np.ndarray, left: int, top: int) -> Glance | None:
    """Moments of the light of a crop [row, column] in DN (NaN: no reading) above the median of its rim, without single
    bright pixels; None where hardly a pixel stands out of the noise."""
    good = np.isfinite(crop)
    if not good.any():
        return None
    image = np.where(good, crop, np.median(crop[good])).astype(np.float32)
    rim = np.ones(image.shape, bool)
    rim[tuple(slice(1 + n // 16, -1 - n // 16) for n in image.shape)] = False
    noise = float(np.median(np.abs(np.diff(image, axis=1)))) / 0.954
    signal = median_of_nine(image) - np.median(image[rim])
    rows, columns = np.nonzero((signal > max(LIT * noise, FAINTEST_DN)) & good)
    if len(rows) < FEWEST_LIT:
        return None
    light = float(signal[rows, columns].sum(dtype=float))
    share = signal[rows, columns] / light
    x, y = float(columns @ share), float(rows @ share)
    square = ((columns - x) ** 2 + (rows - y) ** 2) / 2
    variance = float(square @ share)
    # The median makes neighbours' noise alike: sums have 1.5 times that of single readings.
    each = 1.5 * noise / light
    errors = (np.sqrt(np.sum(own**2)) for own in (np.ones(len(rows)), (square / variance - 1) / 2, np.sqrt(square)))
    return Glance(light, variance**0.5, left + x, top + y, *(float(each * own) for own in errors))


def odd_ones(dataset: Dataset, glances: Sequence[Glance | None]) -> tuple[list[Odd], str]:
    """Which of `dataset.spots` are to be set aside, by a glance at each (None: of no use anyway, and nobody's sibling).
    The text says so where too many stand out for an accident, so that none is."""
    seen = [k for k, own in enumerate(glances) if own is not None]
    if len(seen) < FEWEST:
        return [], ""
    by_frame = {id(frame): index for index, frame in dataset.cells()}
    index = [by_frame[id(dataset.spots[k])] for k in seen]
    own = np.array([glances[k] for k in seen], float)
    values, errors = np.column_stack([np.log(own[:, :2]), own[:, 2:4]]), own[:, [4, 5, 6, 6]]
    repeat = [axis.name for axis in dataset.axes].index("repeat")
    beside = _beside_repeats(values, errors, index, repeat)
    beside = _beside_neighbours(values, errors, index, dataset, beside)
    found = [_odd(k, *rest) for k, *rest in zip(seen, beside.off, beside.most, own[:, 1], strict=True)]
    siblings, odd = Counter(beside.among), Counter(a for a, one in zip(beside.among, found, strict=True) if one)
    few = [
        one
        for among, one in zip(beside.among, found, strict=True)
        if one and odd[among] <= siblings[among] // OF_SIBLINGS
    ]
    out = [one for one in few if dataset.spots[one.spot].keep is None]
    if len(out) > max(len(seen) // OF_ALL, 1):
        first = dataset.spots[out[0].spot].label
        return [], (
            f"{len(out)} of {len(seen)} spot frames are unlike their siblings, {first} first ({out[0].why}): too many"
            " for accidents, so that all are used"
        )
    return out, ""


def _beside_repeats(values: np.ndarray, errors: np.ndarray, index: list[tuple[int, ...]], repeat: int) -> _Beside:
    """Frames beside the others of their condition, and in turn beside the others of their site."""
    condition = [tuple(own[:repeat] + own[repeat + 1 :]) for own in index]
    count = Counter(condition)
    judged = np.array([count[own] >= FEWEST for own in condition])
    # The grid's second axis is the exposure: what is left is the site.
    site = [(own[0], *own[2:]) for own in index]
    off, most = np.full(values.shape, np.nan), np.full(values.shape, np.inf)
    if not judged.any():
        return _Beside(off, most, list(condition))
    conditions, sites = _groups(condition, judged), _groups(site, judged)
    exposure = np.array([own[1] for own in index])
    several = np.isin(np.arange(len(index)), np.concatenate(sites)) if sites else np.zeros(len(index), bool)
    # A frame whose site is hardly seen otherwise stands beside its condition alone, among the scatter of all sites.
    for groups, told in (((conditions,), judged & ~several), ((conditions, sites), judged & several)):
        rest = np.where(judged[:, None], values, np.nan)
        for _ in range(TURNS):
            for own in (group for each in groups for group in each):
                rest[own] -= np.median(rest[own], axis=0)
        freedom = int(judged.sum()) - sum(map(len, groups)) + len(groups) - 1
        scale = _scale(rest[judged])
        for k in np.flatnonzero(told):
            # Short exposures may scatter by more than long ones.
            like = judged & (exposure == exposure[k])
            like[k] = False
            off[k], most[k] = rest[k], _most(np.maximum(scale, _scale(rest[like])), errors[k], freedom)
    return _Beside(off, most, list(condition))


def _groups(labels: Sequence[Hashable], among: np.ndarray) -> list[np.ndarray]:
    """Frames of one label each, where there are enough."""
    members: dict[Hashable, list[int]] = {}
    for k in np.flatnonzero(among).tolist():
        members.setdefault(labels[k], []).append(k)
    return [np.array(own) for own in members.values() if len(own) >= FEWEST]


def _scale(off: np.ndarray) -> np.ndarray:
    """Robust σ of each column [frame, number]; what a median made exactly 0 tells nothing."""
    there = [np.sort(np.abs(own[own != 0])) for own in off.T]
    return np.array([NORMAL * own[(len(own) - 1) // 2] if len(own) else 0.0 for own in there])


def _most(scale: np.ndarray, errors: np.ndarray, freedom: float) -> np.ndarray:
    """How far numbers may be off, of their scatter and its degrees of freedom, and of the noise of each."""
    if freedom <= 0:
        return np.full(errors.shape, np.inf)
    law = stats.t(min(TAILS, EFFICIENCY * freedom))
    return law.isf(ALARM / NUMBERS / 2) * np.hypot(scale, errors)


def _beside_neighbours(
    values: np.ndarray, errors: np.ndarray, index: list[tuple[int, ...]], dataset: Dataset, beside: _Beside
) -> _Beside:
    """Frames of conditions with too few repeats beside those before and after in a series along a smooth axis."""
    lone = np.isnan(beside.off).all(axis=1)
    lengths = {axis.name: axis.size for axis in dataset.axes if axis.name in SMOOTH and axis.values is not None}
    if not lone.any() or not lengths or max(lengths.values()) <= 2 * BESIDE:
        return beside
    along = max(lengths, key=lambda name: lengths[name])
    at = [axis.name for axis in dataset.axes].index(along)
    place = np.array(dataset.axes[at].values, float)
    place = np.log(place) if along == "exposure" else place
    off, most, among = beside.off.copy(), beside.most.copy(), list(beside.among)
    series = _groups([(along, *own[:at], *own[at + 1 :]) for own in index], lone)
    for k in (k for own in series for k in own):
        among[k] = (along, *index[k][:at], *index[k][at + 1 :])
    series = [own[np.argsort([index[k][at] for k in own])] for own in series]
    where = np.array([place[own[at]] for own in index])
    while True:
        for own in series:
            off[own] = _off_line(where[own], values[own])
        inner = np.concatenate([own[1:-1] for own in series]) if series else np.zeros(0, int)
        if not len(inner):
            return _Beside(off, most, among)
        # Width follows no straight line at a waist.
        most[inner] = _most(_scale(off[inner]), errors[inner], len(inner))
        most[inner, 1] = np.inf
        ratio = np.abs(off[inner]) / most[inner]
        worst = inner[int(np.argmax(ratio.max(axis=1)))]
        if _odd(0, off[worst], most[worst], np.exp(values[worst, 1])) is None:
            return _Beside(off, most, among)
        # The others are then judged without it. Whether it is odd or the end of its series, nobody knows.
        if not any(worst in own[BESIDE:-BESIDE] for own in series):
            most[worst] = np.inf
        series = [own[own != worst] for own in series]


def _off_line(where: np.ndarray, values: np.ndarray) -> np.ndarray:
    """By how much each of some frames is off the straight line between its neighbours; NaN for both ends."""
    out = np.full(values.shape, np.nan)
    part = ((where[1:-1] - where[:-2]) / (where[2:] - where[:-2]))[:, None]
    out[1:-1] = values[1:-1] - (1 - part) * values[:-2] - part * values[2:]
    return out


def _odd(spot: int, off: np.ndarray, most: np.ndarray, sigma: float) -> Odd | None:
    """What is wrong with a frame of which some number is grossly off; light tells it first, as what lacks light is off
    in place as well."""
    judged = np.where(np.isfinite(most), off, 0.0)
    light, width, away = float(np.exp(judged[0])), float(np.exp(judged[1])), float(np.hypot(*judged[2:]))
    # Places are told in widths of the siblings.
    gross = light < BLOCKED or light > TWICE, width < NARROW or width > WIDE, away > MOVED * sigma / width
    beyond = np.abs(judged) > most
    if not ((gross[0] and beyond[0]) or (gross[1] and beyond[1]) or (gross[2] and beyond[2:].any())):
        return None
    if gross[0]:
        share = f"{100 * light:.2g} % of" if light < 1 else f"{light:.2g} times"
        return Odd(spot, "blocked" if light < 1 else "double", f"it holds {share} the light of its siblings")
    if gross[1]:
        return Odd(
            spot, "blocked" if width < 1 else "double", f"its spot is {width:.2g} times as wide as its siblings'"
        )
    return Odd(spot, "moved", f"its spot lies {away:.3g} px from where its siblings have theirs")
