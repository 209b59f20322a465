"""Compiled passes over a frame: its mean under the base model, and its residuals summed into all that a verdict looks
at.

The residual is that of every single pixel from the model's exact mean; blocks, rows and fields only sum it. So the size
of a block enters nowhere but through the small difference between two models.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.interpolate import CubicSpline

from spotcheck.model.law import faint_law
from spotcheck.model.sensor import SensorModel, reading
from spotcheck.model.spot import TOP_HAT_LEVEL

# A pixel this many standard deviations off is an outlier: one in 1.7 million is by chance.
OUTLIER = 5.0
# Readings with less variance [DN²] than this (1/12 is the rounding's own) repeat one number: they say little, and
# what they say hangs on the noise's law far from its middle.
CERTAIN = 0.12
# Unless dark pixels of a block do not: their sum is off by so many standard deviations of readings on that verge. Less
# would wake blocks by chance, since so few numbers have no normal law.
AWAKE = 8.0
# Nor do lit ones if their mean square is so many times that: a reading on the verge is at times the next number.
SCATTERED = 4.0
# Less light than this many standard deviations of a dark reading counts as none.
DARK = 6.0
# A reading that passes a dead zone where others do not counts as so many standard deviations at most, and so far beyond
# its end is one that does not as rare as that.
JUMP = 4.0
# Light whose noise a level cuts to less than this part of itself has heavy tails: only the blocks' own means and
# variances look at it.
FREE = 0.4
# Periods of the converter's code [DN] whose comb in the readings is looked for, and the variance [DN²] from which on
# noise smooths the comb of an even converter away (3 rad rms of phase).
CODES = np.array([2, 4, 8, 16, 32])
CODE_VARIANCE = (3 * CODES / (2 * np.pi)) ** 2
# The comb is looked for above this reading [DN]: below, black cuts the law of a reading.
CODE_FLOOR = 12.0
# Step of the table of moments [DN].
STEP_DN = 1 / 16

compiled = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})


class Table(NamedTuple):
    """Mean [DN] and variance [DN²] of a reading over mean electrons `i step` [e-]."""

    step_e: float
    mean: np.ndarray
    variance: np.ndarray


class Scene(NamedTuple):
    """What a model expects of one frame [row, column]: mean [DN], variance [DN²] of each reading, the light [DN] that
    random factors would act on, and by how much a reading follows such a factor [DN]: the light, unless the response
    bends or stops."""

    mean: np.ndarray
    variance: np.ndarray
    light: np.ndarray
    shown: np.ndarray


@lru_cache(maxsize=8)
def table_of(sensor: SensorModel, highest_dn: float) -> Table:
    """Moments of readings, exact where light is faint, up to `highest_dn` of light and dark signal."""
    step = STEP_DN / sensor.gain_dn_per_e
    electrons = step * np.arange(int(highest_dn / STEP_DN) + 3)
    plain = reading(sensor.gain_dn_per_e * electrons, 0.0, sensor)
    mean, variance = np.array(plain.mean), np.array(plain.variance)
    law = faint_law(sensor)
    lit = law.levels >= 0
    faint = electrons < law.highest_e
    mean[faint] = CubicSpline(law.levels[lit], law.mean[lit])(electrons[faint])
    variance[faint] = CubicSpline(law.levels[lit], law.variance[lit])(electrons[faint])
    return Table(step, mean, np.maximum(variance, 1e-3))


@compiled
def fill_scene(amplitude, x0, y0, sigma, top_hat, gain, dark_e, step, means, variances, mean, variance, light):
    """Fill a scene with the base model's spot."""
    rows, columns = mean.shape
    across = np.empty(columns)
    two = 2 * sigma * sigma
    for k in range(columns):
        across[k] = math.exp(-((k - x0) ** 2) / two)
    cut = TOP_HAT_LEVEL if top_hat else 2.0
    for j in range(rows):
        along = math.exp(-((j - y0) ** 2) / two)
        for k in range(columns):
            own = amplitude * min(along * across[k], cut)
            at = (own / gain + dark_e) / step
            i = min(int(at), means.size - 2)
            f = at - i
            light[j, k] = own
            mean[j, k] = means[i] + f * (means[i + 1] - means[i])
            variance[j, k] = variances[i] + f * (variances[i + 1] - variances[i])


def awake(image: np.ndarray, scene: Scene, faint_dn: float, side: int) -> Scene:
    """A scene in which pixels that should repeat one number have the variance `CERTAIN` wherever those of a block [side
    × side px] do not: dark ones (light below `faint_dn`) whose mean is off, since a pedestal or a halo would else go
    unheard by a camera that rounds its noise away; lit ones that scatter, where a model stops noise at a level and the
    camera does not."""
    sure = (scene.variance < CERTAIN) & np.isfinite(image)
    rows, columns = (n // side for n in image.shape)
    if not sure.any() or not rows * columns:
        return scene
    inner = slice(rows * side), slice(columns * side)

    def blocks(values: np.ndarray) -> np.ndarray:
        return values[inner].reshape(rows, side, columns, side).sum(axis=(1, 3))

    dark = sure & (scene.light < faint_dn)
    lit = sure & ~dark
    off = np.where(sure, image - scene.mean, 0.0)
    restless = np.abs(blocks(off * dark)) > AWAKE * np.sqrt(CERTAIN * blocks(dark))
    scattered = blocks(off**2 * lit) > SCATTERED * CERTAIN * (blocks(lit) + side)
    if not restless.any() and not scattered.any():
        return scene
    variance = scene.variance.copy()
    for pixels, loud in ((dark, restless), (lit, scattered)):
        variance[inner][pixels[inner] & loud.repeat(side, 0).repeat(side, 1)] = CERTAIN
    return scene._replace(variance=variance)


@compiled
def add_frame(
    image, mean, variance, light, shown, black, top, dark_variance, least, zone, gain, side,
    residual, spread, count, rough, rough_dof, fourth, row, row_weight, row_light, column, column_weight,
    column_light, comb, totals, pull, weight, dark_pull, dark_weight, dark_light, at, chip_at,
):  # fmt: skip
    """Add one frame to the sums of `measure.Sums`. `side` is that of a block [px]; `at`, `chip_at` are (row, column) of
    the crop's corner in the windows of the site's and the chip's fields; `black` and `top` are the readings [DN]
    without light and at the converter's end; `dark_variance` [DN²] is that of a reading without light and clips, and
    what a reading has beyond it, a pedestal's light included, times the `gain` [DN per electron] the third moment of
    shot noise; a pixel of `least` variance [DN²] or less has no part in the sums of lines; signals below `zone` [DN]
    read 0."""
    rows, columns = image.shape
    blocks_y, blocks_x = residual.shape
    sums = np.zeros((blocks_x, 12))
    lit = DARK * math.sqrt(dark_variance)
    beyond = zone + JUMP * math.sqrt(dark_variance + gain * zone) if zone else -1.0
    jump = max(dark_variance, (zone / JUMP) ** 2)
    middle = (side - 1) / 2
    for j in range(rows):
        by = j // side
        fresh = j % side
        if fresh == 0:
            sums[:] = 0.0
        v = fresh - middle
        for k in range(columns):
            y = float(image[j, k])
            if y != y or variance[j, k] < CERTAIN:
                continue
            r = y - mean[j, k]
            w = 1 / variance[j, k]
            sd = math.sqrt(variance[j, k])
            z = r / sd
            rw = r * w
            own = light[j, k]
            lw = own * w
            if own < lit or variance[j, k] > FREE * (dark_variance + gain * own):
                if variance[j, k] > least:
                    row[j] += rw
                    row_weight[j] += w
                    row_light[j] += lw * lw
                    column[k] += rw
                    column_weight[k] += w
                    column_light[k] += lw * lw
                # Where black cuts the law of a reading its tail is that of the noise before the cut, but where a dead
                # zone does it has a few readings far from all others.
                before_cut = 1 / max(variance[j, k], jump if mean[j, k] < beyond else dark_variance)
                if r * r * before_cut > OUTLIER * OUTLIER:
                    totals[0] += 1
                factor = shown[j, k]
                totals[3] += (factor * rw) ** 2
                totals[4] += (factor * factor * w) ** 2
                totals[5] += (factor * w) ** 2
                pull[at[0] + j, at[1] + k] += factor * rw
                weight[at[0] + j, at[1] + k] += factor * factor * w
                dark_pull[chip_at[0] + j, chip_at[1] + k] += r * before_cut
                dark_weight[chip_at[0] + j, chip_at[1] + k] += before_cut
                dark_light[chip_at[0] + j, chip_at[1] + k] += own * before_cut
            # At either end the converter itself makes readings gather.
            if CODE_FLOOR < y < top and max(CODE_FLOOR, black) + 6 * sd < mean[j, k] < top - 6 * sd:
                wide = 0
                while wide < CODE_VARIANCE.size and variance[j, k] > CODE_VARIANCE[wide]:
                    wide += 1
                comb[wide, int(y) % comb.shape[1]] += 1
            if by < blocks_y and k // side < blocks_x:
                b = k // side
                u = k % side - middle
                sums[b, 0] += r
                sums[b, 1] += variance[j, k]
                sums[b, 2] += 1
                sums[b, 3] += z * z
                sums[b, 4] += z
                sums[b, 5] += z * u
                sums[b, 6] += z * v
                sums[b, 7] += u * u
                sums[b, 8] += v * v
                sums[b, 9] += z * z * z * z
                if mean[j, k] > 6 * sd and variance[j, k] > 1:
                    sums[b, 10] += z * z * z - gain * max(variance[j, k] - dark_variance, 0.0) / (variance[j, k] * sd)
                    sums[b, 11] += 1
        if fresh == side - 1 and by < blocks_y:
            for b in range(blocks_x):
                n = sums[b, 2]
                # Where pixels are missing the block's mean is not that at its points.
                if n == side * side:
                    count[by, b] = n
                    residual[by, b] = sums[b, 0] / n
                    spread[by, b] = sums[b, 1] / n
                    flat = sums[b, 4] ** 2 / n + sums[b, 5] ** 2 / sums[b, 7] + sums[b, 6] ** 2 / sums[b, 8]
                    rough[by, b] = sums[b, 3] - flat
                    rough_dof[by, b] = n - 3
                    fourth[by, b] = sums[b, 9]
                if n == side * side and sums[b, 11] == n:
                    # About the block's own mean: a mean that is off has a third moment of its own.
                    m = sums[b, 4] / n
                    totals[1] += sums[b, 10] - 3 * m * sums[b, 3] + 2 * n * m * m * m
                    totals[2] += n
