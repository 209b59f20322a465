"""How a field of each site correlates from pixel to pixel, and which part of it shape and numbers leave.

Brightness, width and place of a frame, and the shape of all, follow a field as they follow any light, and take a part
of it away. How much is told by fields that are drawn: the fit answers them in a straight line, and what it leaves of
them is compared with what they were, pixel by pixel. So what the draws themselves happen to be cancels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize_scalar

from spotcheck.old_engine.evidence.pixels import CELLS, Ready
from spotcheck.old_engine.evidence.windows import LAGS, Site, evened, placed, products, whole_of, windows_of
from spotcheck.old_engine.nuisance import normal
from spotcheck.old_engine.nuisance.fit import NUMBERS, coefficients_of, contrasts, rows_of
from spotcheck.old_engine.nuisance.parameters import changes_of
from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame

# The finest and the coarsest grain in steps: below, all pixels are on their own; the other is the farthest lag's.
FINEST, COARSEST = 0.2, 20.0
# Less than this part of a field's variance that is left tells nothing of the rest.
LEAST = 0.05


class Correlation(NamedTuple):
    """Variance of a field that correlates as exp(−d²/2 grain²) with the distance d, and its grain [px]."""

    variance: float
    grain: float


def correlation_of(product: np.ndarray, unit: np.ndarray, step: int) -> Correlation:
    """From products of pixels at each of the distances [lag], and what they would be for a variance of 1 that all
    pixels share, a lag being so many pixels: least squares of their ratio."""
    square = step**2 * np.array([down**2 + right**2 for down, right in LAGS], float)
    good = unit > 0
    weight, ratio = unit[good], product[good] / unit[good]

    def fitted(log_grain: float) -> tuple[float, float]:
        law = np.exp(-square[good] / (2 * np.exp(2 * log_grain)))
        size = max(float((weight * law) @ ratio) / float((weight * law) @ law), 0.0)
        return size, float(weight @ (ratio - size * law) ** 2)

    best = minimize_scalar(
        lambda x: fitted(x)[1], bounds=(np.log(step * FINEST), np.log(step * COARSEST)), method="bounded"
    )
    return Correlation(fitted(best.x)[0], float(np.exp(best.x)))


def neighbours(grain: float) -> float:
    """How many pixels of a field count as one in the variance of its squares: the sum of its squared correlations; its
    grain in steps from pixel to pixel."""
    steps = np.arange(-int(4 * grain) - 1, int(4 * grain) + 2)
    return float(np.exp(-((steps / max(grain, FINEST)) ** 2)).sum() ** 2)


def drawn_field(rng: np.random.Generator, shape: tuple[int, ...], grain: float) -> np.ndarray:
    """A normal field [row, column] of variance 1 and a grain in steps; of grain 0 each pixel is its own."""
    white = rng.standard_normal(shape)
    if grain <= 0:
        return white
    across, along = (power_of(frequency, grain) for frequency in (fft.fftfreq(shape[0]), fft.rfftfreq(shape[1])))
    return fft.irfft2(fft.rfft2(white) * np.sqrt(across[:, None] * along), s=shape)


def power_of(frequency: np.ndarray, grain: float) -> np.ndarray:
    """Power of a field along one axis: the transform of exp(−d²/2 grain²), folded back as sampling does."""
    folded = frequency[:, None] + np.arange(-3, 4)
    return np.sqrt(2 * np.pi) * grain * np.exp(-2 * (np.pi * grain * folded) ** 2).sum(axis=1)


class Drawn:
    """Fields of each site, and one of the sensor where all windows lie on the same pixels (`whole`), drawn the same at
    each call; and what the fit answers to them."""

    def __init__(self, frames: Sequence[Frame], design: Design, ready: Ready, grain: float, whole: Site | None):
        self.frames, self.ready, self.whole = frames, ready, whole
        rng = np.random.default_rng(0)
        self.windows = list(windows_of(frames, design))
        self.fields = [drawn_field(rng, window.shape, grain / window.step) for window, _ in self.windows]
        self.sensor = drawn_field(rng, (0, 0) if whole is None else whole.cell.shape, 0.0)
        self.window = {k: j for j, (_, own) in enumerate(self.windows) for k in own}
        # Coefficients of the shape, and steps of numbers and free parameters [·, kind], by which the fit answers.
        self.shapes, self.others = self._answer()

    def of(self, k: int) -> np.ndarray:
        """Fields on the pixels of a frame [kind, row, column]."""
        j = self.window[k]
        window = self.windows[j][0]
        at, out = window.at(self.frames[k]), [self.fields[j]]
        if self.whole is not None:
            out.append(self.sensor[placed(window.corner, window.shape, self.whole.corner)])
        return np.stack([own[at] for own in out])

    def _answer(self) -> tuple[np.ndarray, np.ndarray]:
        ready, kinds = self.ready, 1 if self.whole is None else 2
        few, more = NUMBERS * len(self.frames), len(ready.nudged)

        def part(which: np.ndarray) -> list[np.ndarray]:
            size = coefficients_of(ready.fitted.model).size
            shape, numbers = np.zeros((size, kinds)), np.zeros((few + more, kinds))
            for k in which:
                frame = self.frames[k]
                seen, tells = ready.of(frame, k)
                mean = seen.spot * seen.slope * self.of(int(k))
                lights = mean * (tells.slope * tells.sure)
                slopes = ready.plain.by_numbers(frame, k, seen).reshape(NUMBERS, -1)
                numbers[NUMBERS * k : NUMBERS * (k + 1)] = slopes @ lights.reshape(kinds, -1).T
                own = shape[rows_of(ready.fitted.model, k)]
                normal.project(seen.u, seen.v, ready.step, ready.side, ready.peaks[k] * seen.factor * lights, own)
                for row, change in zip(numbers[few:], changes_of(frame, k, seen, ready.nudged), strict=True):
                    row += (mean * change[0] * tells.sure).sum(axis=(1, 2))
            return [shape, numbers]

        shape, numbers = shared(part, len(self.frames))
        basis = contrasts(ready.fitted.model, more)
        solved = [ready.fitted.schur.solve(x, basis.T @ n) for x, n in zip(shape.T, numbers.T, strict=True)]
        return np.stack([own[0] for own in solved], 1), np.stack([basis @ own[1] for own in solved], 1)

    def pulls(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """s of a frame's pixels by the fields, before and after the fit [kind, 2, row, column], and n."""
        frame, ready, few = self.frames[k], self.ready, NUMBERS * len(self.frames)
        seen, tells = ready.of(frame, k)
        a = seen.spot * seen.slope
        mean = a * self.of(k)
        light = np.tensordot(self.others[NUMBERS * k : NUMBERS * (k + 1)].T, ready.plain.by_numbers(frame, k, seen), 1)
        for own, coefficients in zip(light, self.shapes.T, strict=True):
            own += ready.made_up(coefficients, k, seen)
        rest = mean - tells.slope * light
        for sizes, change in zip(self.others[few:], changes_of(frame, k, seen, ready.nudged), strict=True):
            rest -= sizes[:, None, None] * change[0]
        return a * tells.sure * np.stack([mean, rest], axis=1), a * a * tells.sure


def by_cell(own: Site, sums: np.ndarray, variance: float) -> np.ndarray:
    """Σ of products of different members, or of squares of one alone [2, cell], from S and Σ s² of fields before and
    after the fit [2, 2, row, column]; each pixel weighted as it is beside fields of that variance."""
    unit = np.maximum(own.unit, 0.0)
    light = np.where(unit > 0, (1 + variance * np.sqrt(unit)) ** -2.0, 0.0)
    excess = light * (sums[0] ** 2 - (0.0 if own.single else sums[1]))
    return np.stack([np.bincount(own.cell.ravel(), part.ravel(), CELLS) for part in excess])


def completed(
    frames: Sequence[Frame], design: Design, ready: Ready, sites: Sequence[Site], variance: float, by_sensor: float
) -> list[Site]:
    """Sites with the part of fields that is left, and with their grain. `variance` is that of the fields as they are
    found, `by_sensor` that of the sensor's.

    # ASSUME: what stays on the sensor's pixels is theirs, each its own.
    """
    product, unit = (np.sum([getattr(own, name) for own in sites], axis=0) for name in ("product", "product_unit"))
    product[0] -= by_sensor * unit[0]
    found = correlation_of(product, unit, sites[0].step)
    whole = whole_of(sites) if by_sensor > 0 else None
    drawn = Drawn(frames, design, ready, found.grain, whole)
    of_cells, by_lag = np.zeros((2, CELLS)), np.zeros((2, len(LAGS)))
    every = np.zeros((2, 2, *sites[0].cell.shape) if whole is None else (2, 2, *whole.cell.shape))
    for own, (window, members) in zip(sites, drawn.windows, strict=True):
        sums, of_sensor, flat = (np.zeros((*n, 2, *own.cell.shape)) for n in ((2,), (), ()))
        for k in members:
            s, n = drawn.pulls(k)
            at, even = window.at(frames[k]), s[0] * evened(n)
            sums[:, :, *at] += s[0], s[0] ** 2
            of_sensor[:, *at] += s[-1]
            flat[:, *at] += even
            if not own.single:
                by_lag -= [products(part) for part in even]
        by_lag += [products(part) for part in flat]
        of_cells += by_cell(own, sums, variance)
        if whole is not None:
            every[:, :, *placed(own.corner, own.cell.shape, whole.corner)] += of_sensor, of_sensor**2
    # What products lack is as much of what they are as it is in those of drawn fields.
    part = max(by_lag[1, 0] / by_lag[0, 0], LEAST) if by_lag[0, 0] > 0 else 1.0
    grain = correlation_of(product + found.variance / part * (by_lag[0] - by_lag[1]), unit, sites[0].step).grain
    by_pixel = kept_of(by_cell(whole, every, by_sensor)) if whole is not None else np.ones(CELLS)
    return [own._replace(kept=kept_of(of_cells), kept_by_sensor=by_pixel, grain=grain) for own in sites]


def kept_of(sums: np.ndarray) -> np.ndarray:
    """The part that is left [cell], of sums before and after [2, cell]."""
    before, after = sums
    return np.maximum(np.where(before > 0, after / np.where(before > 0, before, 1.0), 1.0), LEAST)
