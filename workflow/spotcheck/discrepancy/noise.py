"""Observables of noise and scatter: what the mean of a condition does not show.

Every observable is an excess over the model, 0 on average where the model is right, and comes with its loads: by how
much a component of variance moves it. So read noise, row noise, pixel gains, speckle, brightness and pointing are
fitted as variance components, all together, and what none of them explains stays visible.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

from spotcheck.discrepancy.cells import LEVELS, Cells
from spotcheck.discrepancy.measure import Measured
from spotcheck.discrepancy.pixels import CODES
from spotcheck.discrepancy.shots import Design
from spotcheck.model.spot import TOP_HAT_LEVEL

# Variance components: white noise [DN²], row offsets [DN²], pixel gains [1], a granular field of each site [1],
# brightness of a frame [1], its centre [px²].
COMPONENTS = ("read", "row", "pixel", "grain", "gain", "centre")
# Bounds between bands of spatial frequency [cycles/px]. Below the first the mean's own refit acts.
BANDS = np.array([0.03, 0.045, 0.065, 0.09, 0.125, 0.175, 0.25, 0.35, 0.5, 0.71])
# A band of fewer independent modes has no normal law.
LEAST_MODES = 10
# Frequencies nearer to an axis than this [cycles/px] are left to rows and columns.
AXIS = 0.015
# Side of the box whose mean is taken off a field to leave its finest structure [px].
BOX = 5
# Pairs of sites that must be apart on the sensor, for what goes with the spot to be told.
LEAST_PAIRS = 6
HOT = 7.0
HOT_GAIN = 0.1
# No place of a granular field is brighter by more than so many times its contrast, but once in 10⁵ sets: one fully
# developed pattern has an exponential tail (Goodman, Speckle Phenomena in Optics, 2nd ed., sec. 3.2).
GRAIN_TAIL = 22.0
# Frequencies along an axis for `crossed`.
CROSSED = 64
# Rings of spatial frequency, over whose mean stripes must rise: fine enough for the steepest spectrum of grain.
RINGS = 120


class Observable(NamedTuple):
    """A number with its block and label, the condition it belongs to (None: all), its bin, its standard error under
    the model (which grows with an excess as (floor + excess)/floor), and its loads [component]; that of a granular
    field is for unit grain factor (`grained`). Under the light that shows a field, none correlates farther than
    `window` [px]."""

    block: str
    label: str
    condition: int | None
    low: float
    high: float
    unit: str
    value: float
    error: float
    floor: float
    load: np.ndarray
    window: float = np.inf


def observables(
    measured: Measured, cells: Cells, light: np.ndarray, shone: np.ndarray, response: np.ndarray, top_hat: bool
) -> list[Observable]:
    """All observables; `light` [condition, row, column] is what the model reads at the blocks above black, `shone` what
    it has there before black cuts and without a pedestal, `response` what a reading there follows of an offset."""
    out = _levels(measured, cells, light, response)
    out += _fields(measured, light, response)
    out += _lines(measured, response)
    out += _frames(measured, shone, response, top_hat)
    out += _readings(measured)
    return [o for o in out if np.isfinite(o.value) and np.isfinite(o.error) and np.isfinite(o.load).all()]


def _load(**own: float) -> np.ndarray:
    return np.array([own.get(name, 0.0) for name in COMPONENTS])


def block_correlation(grain: float, side: int) -> float:
    """Mean correlation of two pixels of a block."""
    lag = np.arange(-side + 1, side)
    return float(((side - abs(lag)) * np.exp(-(lag**2) / (2 * grain**2))).sum() ** 2 / side**4)


def _smooth_part(grain: float, side: int) -> float:
    """Part of a granular field's variance within a block that a plane takes away."""
    u = np.arange(side) - (side - 1) / 2
    line = np.exp(-((u[:, None] - u[None, :]) ** 2) / (2 * grain**2))
    flat, tilt = np.ones(side) / np.sqrt(side), u / np.sqrt((u**2).sum())
    mean, slope = flat @ line @ flat / side, tilt @ line @ tilt / side
    return float(min(mean * mean + 2 * mean * slope, 1.0))


def grained(seen: list[Observable], grain: float, side: int) -> np.ndarray:
    """Loads [observable, component] for a field that correlates as exp(−d²/2 grain²), grain in px."""
    loads = np.array([o.load for o in seen])
    k = COMPONENTS.index("grain")
    together = cell_of(grain)
    neighbours = np.exp(-np.array([1.0, 4.0]) / (2 * grain**2))
    rough = 1 - _smooth_part(grain, side)
    for row, o in zip(loads, seen, strict=True):
        if o.block == "variance":
            row[k] *= rough
        elif o.label == "band":
            row[k] *= band_part(o, grain)
        elif o.label == "site":
            row[k] *= _fine_part(_narrowed(grain, o.window))
        elif o.block == "frame":
            row[k] *= together
        elif o.block == "line":
            row[k] *= max(np.sqrt(together), 1.0) * (1.5 - 2 * neighbours[0] + 0.5 * neighbours[1]) / 1.5
    return loads


def cell_of(grain: float) -> float:
    """Pixels that such a field moves as one."""
    return 2 * np.pi * grain**2


def band_part(band: Observable, grain: float) -> float:
    """Mean power of such a field in a band, over that of a white one of the same variance."""
    grain = _narrowed(grain, band.window)
    a, low, high = 2 * (np.pi * grain) ** 2, 1 / band.high, 1 / band.low
    return cell_of(grain) * float(np.exp(-a * low**2) - np.exp(-a * high**2)) / (a * (high**2 - low**2))


def _narrowed(grain: float, window: float) -> float:
    """Grain [px] of a field times a window whose own correlation is exp(−d²/2 window²)."""
    return float(grain / np.sqrt(1 + (grain / window) ** 2))


def _fine_part(grain: float) -> float:
    """Part of a granular field's variance that `_fine` leaves, over that of a white one."""
    u = np.arange(BOX) - BOX // 2
    line = np.exp(-((u[:, None] - u[None, :]) ** 2) / (2 * grain**2))
    mean, cross = (line.mean()) ** 2, (line[BOX // 2].mean()) ** 2
    return float((1 - 2 * cross + mean) / (1 - 1 / BOX**2))


def crossed(grain: float, excess: float) -> float:
    """By what factor products of the fine structure of two sites scatter more where a field of that grain [px] has
    `excess` times the power of a pixel's noise.

    # ASSUME: the weight falls off as a Gaussian spot does, so that bright pixels count 4/3 and twice as much.
    """
    u = fft.fftfreq(CROSSED)
    square = u[:, None] ** 2 + u[None, :] ** 2
    power = np.exp(-2 * (np.pi * grain) ** 2 * square)
    power *= excess / max(float(power.mean()), 1e-300)
    box = np.zeros(CROSSED)
    box[np.arange(BOX) - BOX // 2] = 1 / BOX
    line = fft.fft(box).real
    kept = (1 - np.outer(line, line)) ** 4
    return float(np.sqrt((kept * (1 + 8 / 3 * power + 2 * power**2)).sum() / kept.sum()))


def _levels(measured: Measured, cells: Cells, light: np.ndarray, response: np.ndarray) -> list[Observable]:
    """Noise about a plane in every block, by condition and level of light."""
    sums, design = measured.sums, measured.design
    out = []
    relative = light[design.condition] ** 2
    # Of a row's own offset a plane leaves six degrees of freedom of eight, out of all that it leaves.
    rows_left = measured.side * (measured.side - 2) / (measured.side**2 - 3)
    bins = cells.rough.shape[1]
    for c in range(design.conditions):
        own = np.flatnonzero(design.condition == c)
        for level in range(bins):
            value = cells.rough[c, level]
            if not np.isfinite(value):
                continue
            at = (cells.level[c] == level)[None] & (sums.rough_dof[own] > 0)
            white = float(np.mean(1 / sums.variance[own][at]))
            per_light = float(np.mean(relative[own][at] / sums.variance[own][at]))
            moved = float(np.mean((response[c] ** 2 / np.maximum(sums.variance[own], 1e-6))[at]))
            load = _load(read=white, row=rows_left * moved, pixel=per_light, grain=per_light)
            low, high = max(LEVELS[level], 0.0), min(LEVELS[level + 1], 1.0)
            error = float(cells.rough_error[c, level])
            out.append(Observable("variance", f"level {level}", c, low, high, "of the peak", value - 1, error,
                                  1.0, load))  # fmt: skip
    return out


def _fields(measured: Measured, light: np.ndarray, response: np.ndarray) -> list[Observable]:
    """Power of what a site's exposures share by spatial frequency, and of what all sites share on the sensor."""
    sums = measured.sums
    pull, weight = sums.pull, sums.weight
    count, rows, columns = pull.shape
    power = np.zeros((rows, columns // 2 + 1))
    noise = noise_squared = 0.0
    for site in range(count):
        power += np.abs(fft.rfft2(pull[site])) ** 2
        own = float(weight[site].sum(dtype=float))
        noise, noise_squared = noise + own, noise_squared + own**2
    squared = float((weight.astype(float) ** 2).sum())
    if not squared:  # a model that leaves no pixel any light
        return []
    frame_noise = float(sums.totals[:, 5].sum())
    # The light is a window: it makes neighbouring frequencies one.
    window = noise**2 / (count * rows * columns * squared)
    # ASSUME: the light falls off as a Gaussian does, which correlates as exp(−d²/2 reach²) if it covers 2π reach².
    reach = np.sqrt(window * rows * columns / (2 * np.pi))
    ky, kx = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None, :]
    radius = np.hypot(kx, ky)
    twice = np.where((kx > 0) & (kx < 0.5), 2.0, 1.0) + 0 * ky
    # Rows and columns that scatter together lie on the axes.
    aslant = (np.abs(kx) >= AXIS) & (np.abs(ky) >= AXIS)
    out = []
    for low, high in pairwise(BANDS):
        at = (radius >= low) & (radius < high) & aslant
        if twice[at].sum() * window < 2 * LEAST_MODES:
            continue
        share = twice[at] / twice[at].sum()
        value = (float((power[at] * share).sum()) - noise) / squared
        modes = twice[at].sum() / 2 * window
        error = np.sqrt(noise_squared / max(modes, 1.0)) / squared
        load = _load(read=frame_noise / squared, pixel=1.0, grain=1.0)
        out.append(Observable("spectrum", "band", None, 1 / high, 1 / low, "px period", value, error,
                              noise / squared, load, reach))  # fmt: skip
    peaked = np.where((radius > 1.5 * BANDS[0]) & (radius < 0.5), power, 0.0)
    # Beside a broad spectrum a stripe is a peak over its surroundings in radius.
    ring = np.digitize(radius, np.linspace(0, 0.75, RINGS))
    counts = np.maximum(np.bincount(ring.ravel(), minlength=RINGS + 1), 1)
    mean = np.bincount(ring.ravel(), power.ravel(), RINGS + 1) / counts
    contrast = peaked / np.maximum(mean[ring], 1e-300)
    out.append(Observable("spectrum", "stripes", None, np.nan, np.nan, "", float(contrast.max()), 1.0, 1.0, _load()))
    # Of a row's own offset the finest structure keeps four fifths.
    condition = measured.design.condition
    moved = (light * response)[condition] / np.where(sums.pixels > 0, sums.variance, np.inf)
    by_row = 0.8 * measured.side**2 * float((moved**2).sum())
    out += _shared(measured, squared, by_row, reach)
    return out


def _fine(field: np.ndarray) -> np.ndarray:
    return field - ndimage.uniform_filter(field, BOX, mode="constant")


def _fine_noise(squares: np.ndarray) -> np.ndarray:
    """Variance of `_fine` of white noise of variance `squares`."""
    return (1 - 2 / BOX**2) * squares + ndimage.uniform_filter(squares, BOX, mode="constant") / BOX**2


def _shared(measured: Measured, squared: float, by_row: float, reach: float) -> list[Observable]:
    """Fine structure that exposures of a site share, that sites share on the sensor or about the spot, and that dark
    pixels keep. `by_row` is what offsets of rows of 1 DN bring to it, `reach` [px] how far light correlates."""
    sums, design = measured.sums, measured.design
    chip = np.zeros(sums.dark_pull.shape)
    chip_weight = np.zeros(sums.dark_pull.shape)
    own_chip, own_weight = np.zeros(sums.dark_pull.shape), np.zeros(sums.dark_pull.shape)
    site_total = 0.0
    for site in range(design.sites):
        part = _fine(sums.pull[site].astype(float))
        site_total += float((part**2).sum())
        if measured.common:
            at = _window(measured, site, chip.shape, part.shape)
            chip[at[0]] += part[at[1]]
            chip_weight[at[0]] += sums.weight[site][at[1]]
            own_chip[at[0]] += part[at[1]] ** 2
            own_weight[at[0]] += sums.weight[site][at[1]].astype(float) ** 2
    left = 1 - 1 / BOX**2
    out = []
    # Against the model's own noise: what a site's exposures share is part of each frame's own scatter as well.
    noise = sum(float(_fine_noise(own.astype(float)).sum()) for own in sums.weight)
    white = float(sums.totals[:, 5].sum()) / squared
    value, error = (site_total - noise) / (left * squared), np.sqrt(2 / squared)
    floor = noise / (left * squared)
    load = _load(read=white, row=by_row / (left * squared), pixel=1.0, grain=1.0)
    out.append(Observable("spectrum", "site", None, np.nan, np.nan, "", value, error, floor, load, reach))
    norm = left * float((chip_weight**2 - own_weight).sum())
    if measured.common and norm > 1e-6 * squared:
        value = float((chip**2 - own_chip).sum()) / norm
        error = np.sqrt(2 / norm)
        out.append(Observable("spectrum", "sensor", None, np.nan, np.nan, "", value, error, 30 * error,
                              _load(pixel=1.0)))  # fmt: skip
    out += _about_the_spot(measured)
    out.append(Observable("spectrum", "hot", None, np.nan, np.nan, "", hottest(measured), 1.0, 1.0, _load()))
    return out


def _about_the_spot(measured: Measured) -> list[Observable]:
    """Fine structure that goes with the spot from site to site, as no grain, no pattern of pixels and no noise does:
    crops are cut about the spot. Only pairs of sites count that lie so far apart on the sensor that no pixel comes
    near itself; how their products scatter is the error."""
    sums = measured.sums
    own = np.array([_fine(pull.astype(float)).ravel() for pull in sums.pull])
    weight = sums.weight.reshape(len(own), -1).astype(float)
    apart = np.maximum(*(np.abs(v[:, None] - v[None, :]) for v in (measured.site_left, measured.site_top))) >= BOX
    pairs = np.triu(apart, 1)
    products = (own @ own.T)[pairs]
    norm = (1 - 1 / BOX**2) * float((weight @ weight.T)[pairs].sum())
    if products.size < LEAST_PAIRS or norm <= 0:
        return []
    error = np.sqrt(max(norm, float((products**2).sum()))) / norm
    value = float(products.sum()) / norm
    return [Observable("spectrum", "spot", None, np.nan, np.nan, "", value, error, 30 * error, _load())]


def hottest(measured: Measured, grain: float = 0.0) -> float:
    """By how many standard deviations the oddest dark pixel is off in all frames together, beyond what a granular field
    of relative variance `grain` brings to faint light: far less than this where sites differ."""
    off, by_light = _off(measured)
    return float((np.abs(off) - GRAIN_TAIL * np.sqrt(grain) * by_light).max())


def hot_pixels(measured: Measured, prnu: float) -> int:
    """Pixels that are off in all frames alike, far beyond their neighbours and what gains of rms `prnu` bring."""
    return int(np.count_nonzero(hot_field(measured, prnu)))


def hot_power(measured: Measured) -> float:
    """χ² of the pixels that are off by more than any gain or grain of `HOT_GAIN` brings."""
    weight = np.maximum(measured.sums.dark_weight, 0.0)
    return float((hot_field(measured, HOT_GAIN) ** 2 * weight).sum())


def hot_field(measured: Measured, prnu: float) -> np.ndarray:
    """By how much each of them is off [row, column of the window] in DN, 0 elsewhere."""
    off, by_light = _off(measured)
    weight = np.where(measured.sums.dark_weight > 0, measured.sums.dark_weight, 1.0)
    return np.where(np.abs(off) > HOT * np.sqrt(1 + (prnu * by_light) ** 2), off / np.sqrt(weight), 0.0)


def _off(measured: Measured) -> tuple[np.ndarray, np.ndarray]:
    """How far every dark pixel of the window is off its neighbours in all frames together, in standard deviations, and
    by how much more for each part of its light; 0 elsewhere."""
    sums = measured.sums
    root = np.sqrt(np.where(sums.dark_weight > 0, sums.dark_weight, 1.0))
    z = np.where(sums.dark_weight > 0, sums.dark_pull / root, 0.0)
    return z - ndimage.median_filter(z, BOX), sums.dark_light / root


def _window(measured: Measured, site: int, chip: tuple[int, ...], part: tuple[int, ...]):
    """Slices of the sensor's window and of a site's own that cover each other."""
    top = int(measured.site_top[site] - measured.corner[0])
    left = int(measured.site_left[site] - measured.corner[1])
    rows, columns = min(part[0], chip[0] - top), min(part[1], chip[1] - left)
    return (slice(top, top + rows), slice(left, left + columns)), (slice(0, rows), slice(0, columns))


def _lines(measured: Measured, response: np.ndarray) -> list[Observable]:
    """Scatter of neighbouring lines, in each frame and of all frames together."""
    sums = measured.sums
    out = []
    lines = (
        ("row", sums.row, sums.row_weight, sums.row_light, measured.top, measured.corner[0]),
        ("column", sums.column, sums.column_weight, sums.column_light, measured.left, measured.corner[1]),
    )
    # What an offset of 1 DN of a whole row brings to its sum, less where black cuts readings.
    per_dn = response[measured.design.condition] / np.where(sums.pixels > 0, sums.variance, np.inf)
    by_row = per_dn.sum(axis=2) * measured.side
    by_row = np.repeat(by_row, measured.side, axis=1) ** 2
    by_row = np.pad(by_row, ((0, 0), (0, sums.row.shape[1] - by_row.shape[1])), mode="edge")
    for name, pull, weight, lit, first, corner in lines:
        known = np.maximum(weight, 1e-300)
        solid = weight > 0.05 * weight.max()
        white = float(np.mean(_mean_white(sums)))
        value, used = _second(pull / np.sqrt(known), solid)
        per_light = float(np.mean((lit / known)[solid]))
        row = float(np.mean((by_row / known)[solid])) if name == "row" else 0.0
        out.append(Observable("line", f"{name}s of a frame", None, np.nan, np.nan, "", value, 2 / np.sqrt(used), 1.0,
                              _load(read=white, row=row, pixel=per_light, grain=per_light)))  # fmt: skip
        if not measured.common:
            continue
        size = int(np.max(first)) - corner + pull.shape[1]
        total, total_weight, squares = np.zeros(size), np.zeros(size), np.zeros(size)
        for k in range(len(pull)):
            at = slice(first[k] - corner, first[k] - corner + pull.shape[1])
            total[at] += pull[k]
            total_weight[at] += weight[k]
            squares[at] += by_row[k] if name == "row" else 0.0
        full = total_weight > 0.5 * total_weight.max()
        value, kept = _second((total / np.sqrt(np.maximum(total_weight, 1e-300)))[None], full[None])
        row = float(np.mean(squares[full] / total_weight[full]))
        out.append(Observable("line", f"{name}s of the sensor", None, np.nan, np.nan, "", value, 2 / np.sqrt(kept), 1.0,
                              _load(read=white, row=row, pixel=per_light * len(pull), grain=per_light)))  # fmt: skip
    return out


def _mean_white(sums) -> np.ndarray:
    """Mean of 1/v of each frame, weighted as lines are."""
    return sums.row_weight.mean(axis=1) / np.maximum(sums.pixels.sum(axis=(1, 2)) / sums.row.shape[1], 1)


def _second(z: np.ndarray, known: np.ndarray) -> tuple[float, int]:
    """Mean square of each line less the mean of its neighbours, over 3/2, less 1; and how many lines there were."""
    d = z[:, 1:-1] - (z[:, :-2] + z[:, 2:]) / 2
    used = known[:, 1:-1] & known[:, :-2] & known[:, 2:]
    count = max(int(used.sum()), 1)
    return float(np.sum(d[used] ** 2) / count / 1.5 - 1), count


class FrameFits(NamedTuple):
    """What every frame says for itself of a quantity: value and variance [frame, axis] as a change from the model;
    whether it can be told [frame]."""

    value: np.ndarray
    variance: np.ndarray
    known: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """One over the variance [frame, axis], 0 where nothing can be told."""
        return np.where(self.known[:, None], 1 / np.where(self.known[:, None], self.variance, 1.0), 0.0)


# Quantity → its own directions, and those fitted beside it: of gain, x, y, ln σ, two of the ellipse, offset.
QUANTITIES = {
    "brightness": ([0], []),
    "centre": ([1, 2], [0]),
    "width": ([3], [0]),
    "roundness": ([4, 5], [0, 3]),
    "pedestal": ([6], [0, 3]),
}

GIVEN = {"brightness": slice(0, 1), "centre": slice(1, 3)}


def frame_fits(measured: Measured, name: str) -> FrameFits:
    """One quantity of every frame, from its own score and information."""
    base = measured.base
    turn = np.zeros((len(base.sigma), 7, 7))
    curvature = base.sigma**-2.0
    turn[:, 0, 0] = base.amplitude
    turn[:, 1, 1] = turn[:, 2, 2] = turn[:, 6, 6] = 1
    turn[:, 3, 3] = turn[:, 5, 3] = -2 * curvature
    turn[:, 3, 4], turn[:, 5, 4], turn[:, 4, 5] = curvature, -curvature, curvature
    own, beside = QUANTITIES[name]
    turn = turn[:, :, [*own, *beside]]
    pull = np.einsum("fij,fi->fj", turn, measured.score)
    matrix = np.einsum("fki,fkl,flj->fij", turn, measured.information, turn)
    known = np.isfinite(matrix).all(axis=(1, 2))
    known[known] = np.linalg.cond(matrix[known]) < 1e10
    inverse = np.zeros_like(matrix)
    inverse[known] = np.linalg.inv(matrix[known])
    value = np.einsum("fij,fj->fi", inverse, pull)[:, : len(own)]
    # What a frame was given of its own still counts, so that a model that says nothing of it is asked as before.
    if name in GIVEN:
        value = value + measured.given[:, GIVEN[name]]
    return FrameFits(value, np.einsum("fii->fi", inverse)[:, : len(own)], known)


def scatter_of(fits: FrameFits, group: np.ndarray) -> tuple[float, int, float]:
    """χ² of the scatter within groups, its degrees of freedom, and by how much a variance of 1 would raise it."""
    weight = fits.weight
    freedom, load = 0, 0.0
    for g in np.unique(group):
        at = (group == g) & fits.known
        if np.count_nonzero(at) < 2:
            continue
        total = weight[at].sum(axis=0)
        freedom += (np.count_nonzero(at) - 1) * weight.shape[1]
        load += float((total - (weight[at] ** 2).sum(axis=0) / total).sum())
    return float((deviations(fits, group) ** 2).sum()), freedom, load


def deviations(fits: FrameFits, group: np.ndarray) -> np.ndarray:
    """Deviations of the frames from the mean of their group, in standard deviations [frame × axis]; 0 where a frame
    tells nothing."""
    weight, out = fits.weight, np.zeros_like(fits.value)
    for g in np.unique(group):
        at = (group == g) & fits.known
        if at.any():
            mean = (weight[at] * fits.value[at]).sum(axis=0) / weight[at].sum(axis=0)
            out[at] = np.sqrt(weight[at]) * (fits.value[at] - mean)
    return out.ravel()


def pointing_of(fits: FrameFits, design: Design) -> tuple[float, int, float]:
    """As `scatter_of` for centres: a site's own place and a shift that all sites of a condition share are no
    scatter."""
    chi2, freedom, load = 0.0, 0, 0.0
    place = design.place[design.condition]
    for p in np.unique(place):
        at = np.flatnonzero((place == p) & fits.known)
        if not at.size:
            continue
        site = np.unique(design.site[at], return_inverse=True)[1]
        condition = np.unique(design.condition[at], return_inverse=True)[1]
        means = np.concatenate([np.eye(site.max() + 1)[site], np.eye(condition.max() + 1)[condition]], axis=1)
        for axis in range(fits.value.shape[1]):
            root = 1 / np.sqrt(fits.variance[at, axis])
            q, size, _ = np.linalg.svd(means * root[:, None], full_matrices=False)
            q = q[:, size > 1e-9 * size[0]]
            z = fits.value[at, axis] * root
            chi2 += float(((z - q @ (q.T @ z)) ** 2).sum())
            freedom += len(at) - q.shape[1]
            # Of a scatter of 1 in every frame, what the means leave.
            load += float((root**2 * (1 - (q**2).sum(axis=1))).sum())
    return chi2, freedom, load


def _frames(measured: Measured, light: np.ndarray, response: np.ndarray, top_hat: bool) -> list[Observable]:
    """Scatter of brightness, centre, width, roundness and pedestal from frame to frame of a condition or site."""
    design = measured.design
    out = []
    loads = _frame_loads(measured, light, response, top_hat)
    for name in QUANTITIES:
        if measured.base.law is None and name in ("brightness", "width"):
            continue  # free in every frame
        fits = frame_fits(measured, name)
        if name == "centre":
            chi2, freedom, load = pointing_of(fits, design)
        else:
            chi2, freedom, load = scatter_of(fits, design.condition)
        if not freedom:
            continue
        component = {"brightness": "gain", "centre": "centre"}.get(name)
        row, read, grain = loads[name]
        own_load = _load(read=read, row=row, grain=grain)
        if component:
            own_load = own_load + _load(**{component: load / freedom})
        out.append(Observable("frame", name, None, np.nan, np.nan, "", chi2 / freedom - 1, np.sqrt(2 / freedom), 1.0,
                              own_load))  # fmt: skip
    return out


def _frame_loads(measured: Measured, light: np.ndarray, response: np.ndarray, top_hat: bool) -> dict[str, np.ndarray]:
    """By how much each quantity of a frame scatters more for unit components `row`, `read` and `grain` (without its
    grain factor), over its own variance: mean over the conditions."""
    design, base, side = measured.design, measured.base, measured.side
    totals = {name: np.zeros(3) for name in QUANTITIES}
    present = np.unique(design.condition)
    y, x = (side * np.arange(n) + (side - 1) / 2 for n in light.shape[1:])
    pixels = side**2
    for c in present:
        own = design.condition == c
        inverse = 1 / np.maximum(measured.sums.variance[own].mean(axis=0), 1e-6)
        inverse[measured.sums.pixels[own].sum(axis=0) == 0] = 0.0
        dx, dy = x[None, :] - base.x0[own].mean(), y[:, None] - base.y0[own].mean()
        mu, width = np.maximum(light[c], 0.0), base.sigma[own].mean()
        shapes = (1 + 0 * mu, dx / width**2, dy / width**2, (dx**2 + dy**2) / width**2, (dx**2 - dy**2) / width**2,
                  dx * dy / width**2)  # fmt: skip
        # On the plateau of a top hat nothing but brightness and pedestal shows.
        steep = mu * (np.exp(-(dx**2 + dy**2) / (2 * width**2)) < (TOP_HAT_LEVEL if top_hat else 2.0))
        # Where black cuts readings, light moves them as little as an offset does.
        slopes = np.stack([mu, *(steep * s for s in shapes[1:]), 1 + 0 * mu]) * response[c]
        score = slopes * inverse
        information = pixels * np.einsum("iyx,jyx->ij", score, slopes)
        by_light = pixels * np.einsum("iyx,jyx->ij", score * mu, score * mu)
        lines = (score * response[c]).sum(axis=2) * side
        by_row = side * lines @ lines.T
        by_noise = pixels * np.einsum("iyx,jyx->ij", score, score)
        for name, (mine, beside) in QUANTITIES.items():
            index = np.ix_([*mine, *beside], [*mine, *beside])
            inner = np.linalg.pinv(information[index])
            size = len(mine)
            variance = np.diag(inner)[:size]
            for k, matrix in enumerate((by_row, by_noise, by_light)):
                totals[name][k] += np.mean(np.diag(inner @ matrix[index] @ inner)[:size] / variance) / len(present)
    totals["centre"][2] *= apart(base.sigma, design.site)
    return totals


def apart(sigma: np.ndarray, site: np.ndarray) -> float:
    """Mean part of the shift that a granular field brings to spots of widths `sigma` [frame] which those of one site do
    not share: the field is the same, and two Gaussians see its slope with a correlation of (2ab/(a² + b²))²."""
    alike = (2 * np.outer(sigma, sigma) / (sigma[:, None] ** 2 + sigma[None, :] ** 2)) ** 2
    together = (site[:, None] == site[None, :]) & ~np.eye(len(site), dtype=bool)
    return float(np.mean(1 - alike[together])) if together.any() else 0.0


def _readings(measured: Measured) -> list[Observable]:
    """Outliers, skewness, and the comb of the converter's code."""
    sums = measured.sums
    outliers = float(sums.totals[:, 0].sum())
    out = [Observable("frame", "outliers", None, np.nan, np.nan, "", float(np.log1p(outliers)), 1.0, 1.0, _load())]
    lit = max(float(sums.totals[:, 2].sum()), 1.0)
    out.append(Observable("frame", "skewness", None, np.nan, np.nan, "", float(sums.totals[:, 1].sum()) / lit,
                          np.sqrt(15 / lit), 1.0, _load()))  # fmt: skip
    table = sums.comb.sum(axis=0)
    longest = table.shape[1]
    for k, code in enumerate(CODES):
        used = table[k + 1 :].sum(axis=0)
        total = float(used.sum())
        wave = abs(np.sum(used * np.exp(2j * np.pi * np.arange(longest) / code))) ** 2 / max(total, 1.0)
        out.append(
            Observable("frame", f"code {code}", None, np.nan, np.nan, "", float(np.log1p(wave)), 1.0, 1.0, _load())
        )
    return out
