"""Detection of disagreement with a model: residual tests with one common p-value, and the size of the residual.

The null distribution of each test takes into account that the spot of each frame and the read noise were fitted. The
smallest p-value of all tests, corrected for their number, decides. It does not take into account that effects or a free
light shape may have been fitted as well. These absorb more of the residual, so that p-values are then too large rather
than too small.

A cell is a part of the images, such as a block, a ring or a row, over which residuals are summed. A division of the
frames (all together, by condition, by angle, one by one) says which frames are summed. A field is a random relative
variation of the light that several pixels or frames share: granular light, or gains of pixels.

A `StandardizedFrame` has images of a frame: residuals in units of their noise (`z`), derivatives of z by the light
(`offset`) and by ln peak (`relative`), and orthonormal columns that span the changes of z by the spot (`absorbed`). `u`
and `v` are distances from the spot [σ]. A `CellSums` has the `kind` of its cells, with a name.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import special

from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.findings import Detection, ResidualTest, Unexplained
from spotcheck.discrepancy.places import (
    NO_SCATTER,
    KnownScatter,
    correct_for_number,
    correlated_length,
    describe_cell,
    strongest_cells,
    to_normal,
    two_sided,
)
from spotcheck.discrepancy.residual_sums import CellSums, ResidualSums, standardize, sum_residuals
from spotcheck.discrepancy.residuals import ResidualImages

# Smallest p-value that is reported, so that none is 0.
SMALLEST_P = 1e-300
# Names of the tests of second moments.
SECOND_MOMENTS = ("noise", "neighbours", "common pattern")
# Fewest pairs of neighbours whose correlation is tested; names of the pairs at each of `residual_sums.LAGS`.
FEWEST_PAIRS = 1000
NEIGHBOURS = (
    "neighbours in a row",
    "neighbours in a column",
    "neighbours along the diagonal",
    "neighbours across the diagonal",
    "pixels two columns apart",
    "pixels two rows apart",
)
# Largest side of the blocks over which residuals are averaged for their size: in px, and as a part of σ. Blocks farther
# from the spot than `SIZE_RADIUS` [σ] hold hardly any light and are left out.
SIZE_BLOCK_PX, SIZE_BLOCK_SIGMA, SIZE_RADIUS = 8, 0.5, 4.0
# Fewest sites whose scatter gives an error.
FEWEST_SITES = 4
# Variance of the overlap of two blocks (a triangle) along an axis, in squared sides: it widens their correlation.
OVERLAP_VARIANCE = 1 / 6


class Trial(NamedTuple):
    """One p-value within a test."""

    p_value: float  # of this trial alone
    statistic: float  # strongest residual in standard errors
    where: str  # place of this residual in words


def test_residuals(
    images: ResidualImages,
    black_level_dn: float = 0.0,
    scatter: KnownScatter = NO_SCATTER,
    others: Sequence[ResidualTest] = (),
    sums: ResidualSums | None = None,
) -> Detection:
    """Test whether residuals disagree with their model.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit at full resolution.
    black_level_dn : float
        Black level [DN], from which grey levels are counted.
    scatter : KnownScatter
        Named scatter that the weights of the images do not include. If there is any, only mean residuals are tested,
        since the scatter was itself measured from the second moments.
    others : sequence of ResidualTest
        Further tests of the same model that count as well, such as of laws of the spots; see `deviate_test`.
    sums : ResidualSums, optional
        Result of `sum_residuals`, if it is known.

    Returns
    -------
    Detection
        Common p-value, and all tests with the smallest p-value first.
    """
    sums = sum_residuals(images) if sums is None else sums
    trials_of = {cells.kind.name: _try_cells(cells, images, black_level_dn, scatter) for cells in sums.means}
    if scatter.is_empty:
        noise, neighbours, pattern = SECOND_MOMENTS
        trials_of[noise] = _try_cells(sums.noise, images, black_level_dn, scatter)
        trials_of[neighbours], trials_of[pattern] = _try_neighbours(sums.neighbours), _try_pattern(sums.pattern)
    tests = [*(_combine(name, trials) for name, trials in trials_of.items() if trials), *others]
    # Several p-values may be cut off at SMALLEST_P: a mean residual then tells more than a second moment.
    tests.sort(key=lambda test: (test.p_value, test.name in SECOND_MOMENTS, -abs(test.statistic)))
    p_value = correct_for_number(tests[0].p_value, len(tests)) if tests else 1.0
    return Detection(max(p_value, SMALLEST_P), tuple(tests))


# pytest takes a function of this name for a test.
test_residuals.__test__ = False  # type: ignore[attr-defined]


def deviate_test(name: str, where: str, z: float) -> ResidualTest:
    """Return the two-sided test of a normal deviate z, such as a fitted value against a stated one."""
    return _combine(name, [Trial(two_sided(z), z, where)])


def _combine(name: str, trials: Sequence[Trial]) -> ResidualTest:
    """Return the test of the smallest of several p-values, corrected for their number."""
    best = min(trials, key=lambda trial: (trial.p_value, -abs(trial.statistic)))
    p_value = max(correct_for_number(best.p_value, len(trials)), SMALLEST_P)
    return ResidualTest(name, best.where, best.statistic, p_value, float(-special.ndtri(p_value / 2)))


def _try_cells(cells: CellSums, images: ResidualImages, black_level_dn: float, scatter: KnownScatter) -> list[Trial]:
    """Return the trials of cells: for each division of the frames, the strongest cell and the sum of all squares.

    There is no sum of squares with a single cell or with known scatter. Both trials name the strongest cell.
    `black_level_dn` [DN] serves to describe its place. `squares` of a `StrongestCell` is the sum of all squares; `mean`
    and `variance` are those of this sum under the model.
    """
    trials = []
    for strongest in strongest_cells(cells, images.design, scatter):
        where = describe_cell(cells.kind, strongest.cell, strongest.frames, images, black_level_dn)
        p_value = correct_for_number(two_sided(strongest.z), strongest.count)
        trials.append(Trial(p_value, strongest.z, where))
        # Known scatter correlates neighbouring cells: the sum of their squares then has another distribution.
        if strongest.count > 1 and scatter.is_empty:
            p_value = _exceedance(strongest.squares, strongest.mean, strongest.variance)
            trials.append(Trial(p_value, strongest.z, where))
    return trials


def _exceedance(total: float, mean: float, variance: float) -> float:
    """Return the probability that a sum of squares of some mean and variance exceeds `total`.

    The sum is taken as a scaled χ² variable of this mean and variance.

    References
    ----------
    Satterthwaite (1946), doi:10.2307/3002019.
    """
    if min(mean, variance) <= 0:
        return 1.0
    return float(special.gammaincc(mean**2 / variance, max(total, 0.0) * mean / variance))


def _try_neighbours(sums: np.ndarray) -> list[Trial]:
    """Return the trials of the correlation of neighbours; see `ResidualSums.neighbours`.

    sums [lag, region, 2] has the sum of products and the number of pairs; regions are the light and dark pixels.
    """
    trials = []
    for name, by_region in zip(NEIGHBOURS, sums, strict=True):
        for (total, pairs), region in zip(by_region, ("in the light of the spot", "in dark pixels"), strict=True):
            if pairs >= FEWEST_PAIRS:
                z = float(total / np.sqrt(pairs))
                trials.append(Trial(two_sided(z), z, f"{name}, {region}"))
    return trials


def _try_pattern(sums: np.ndarray) -> list[Trial]:
    """Return the trials of a pattern that the same pixels show in several frames; see `ResidualSums.pattern`.

    sums [scope, weight, 3] has sum, variance and third cumulant of products over pairs of frames.
    """
    trials = []
    # The first weight of pixels stands for an offset of the light, the second for a relative change of it.
    for by_weight, scope in zip(sums, ("in frames of one site", "at different sites"), strict=True):
        for (total, variance, third), region in zip(by_weight, ("", ", in the light of the spot"), strict=True):
            if variance > 0:
                z = float(to_normal(total / np.sqrt(variance), third / variance**1.5))
                trials.append(Trial(two_sided(z), z, f"the same pixel {scope}{region}"))
    return trials


# Size of the residual of the mean image


@dataclass(frozen=True)
class BlockPower:
    """Squared mean residuals of the blocks of a frame, in parts of the peak; sums over blocks."""

    excess: float  # squares less those expected by noise and known scatter [peak²]
    count: int  # number of blocks
    noise_variance: float  # variance of the sum of squares by noise and known scatter [peak⁴]
    scatter_variance: float  # the same by known scatter alone [peak⁴]
    field_slopes: np.ndarray  # derivative of the expected squares by the relative variance of each field [field, peak²]


def measure_unexplained(images: ResidualImages, scatter: KnownScatter = NO_SCATTER) -> Unexplained:
    """Return the size of the difference between the mean image and a model; `share` and `p_value` are NaN.

    Residuals are averaged over blocks and divided by the peak of their frame. From the mean square of the blocks, the
    part that noise and known scatter explain is subtracted. It allows for what the fit of the spot absorbs. The
    standard error is the larger of two: that by noise, known scatter and the errors of the fields' variances, and that
    by the scatter of sites.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    scatter : KnownScatter
        Scatter that the weights of the images do not include.
    """
    side = int(np.clip(SIZE_BLOCK_SIGMA * np.exp(np.min(images.spots.log_sigma)), 1, SIZE_BLOCK_PX))
    with ThreadPoolExecutor(THREADS) as pool:
        powers = list(pool.map(partial(_measure_blocks, images, side, scatter), range(len(images.left))))
    excess, count = np.array([power.excess for power in powers]), np.array([power.count for power in powers], float)
    blocks = count.sum()
    if blocks == 0:
        return Unexplained(0.0, np.inf, 0.0, np.nan, np.nan)
    mean = float(excess.sum() / blocks)
    site = np.unique(images.design.site, return_inverse=True)[1]
    # Grains are the same in all frames of a site, and correlate blocks: number of squares that vary with each square.
    grain_px = max((np.nan_to_num(field.grain_px) for field in scatter.fields), default=0.0)
    further_squares = np.bincount(site)[site] * max(1.0, np.pi * (grain_px**2 / side**2 + OVERLAP_VARIANCE)) - 1
    variance = sum(p.noise_variance + n * p.scatter_variance for p, n in zip(powers, further_squares, strict=True))
    field_slopes = np.sum([power.field_slopes for power in powers], axis=0)
    field_errors = np.array([np.nan_to_num(field.stderr) for field in scatter.fields])
    error = float(np.sqrt(variance + np.sum((field_slopes * field_errors) ** 2)) / blocks)
    sites = site.max() + 1
    if sites >= FEWEST_SITES:
        deviations = np.bincount(site, excess - mean * count)
        error = max(error, float(np.sqrt(np.sum(deviations**2) * sites / (sites - 1)) / blocks))
    return Unexplained(float(np.sqrt(max(mean, 0.0))), error, mean / max(error, 1e-300), np.nan, np.nan)


def _measure_blocks(images: ResidualImages, side: int, scatter: KnownScatter, frame: int) -> BlockPower:
    """Return the power of the blocks of a frame; blocks have `side` × `side` pixels.

    The columns Q [pixel, spot parameter] are orthonormal in units of the noise, and a fit of the spot takes Q Q'z off
    the residuals z. Let U [spot parameter, block] be the block sums of Q times the noise [DN], and W those of Q over
    the noise, divided by the pixels of a block [1/DN]. The fit then takes about U'W s off the block sums s [DN].
    """
    standard = standardize(images, frame)
    is_used = standard.offset > 0
    root_weight = np.sqrt(np.where(is_used, images.weight[frame], 1.0))
    rows, columns = (length // side for length in is_used.shape)

    def block_sums(values: np.ndarray) -> np.ndarray:
        """Return the sums [..., block] of values [..., row, column] over whole blocks."""
        cut = values[..., : rows * side, : columns * side]
        blocks = cut.reshape(*values.shape[:-2], rows, side, columns, side).sum(axis=-1, dtype=float).sum(axis=-2)
        return blocks.reshape(*values.shape[:-2], rows * columns)

    u, w = block_sums(standard.absorbed / root_weight), block_sums(standard.absorbed * root_weight) / side**2

    def subtract_fitted(powers: np.ndarray, far_powers: np.ndarray) -> np.ndarray:
        """Return expected squares of block sums [block, DN²] after the fit of the spot, from those before it.

        `far_powers` [block, DN²] are the covariances of each block sum with the sum of all blocks, which the fit uses.
        """
        # Covariance of the fitted amounts W s [spot parameter, spot parameter].
        of_coefficients = (w * far_powers) @ w.T
        return powers - 2 * far_powers * np.sum(u * w, axis=0) + np.sum(u * (of_coefficients @ u), 0)

    squared_light = block_sums((standard.relative / root_weight) ** 2)
    squared_slope = block_sums((standard.offset / root_weight) ** 2)
    # Expected squares by a relative variance of 1 of each field, and by all known scatter [block, DN²].
    field_powers = []
    for field in scatter.fields:
        near, far = (correlated_length(field.grain_px, length) ** 2 for length in (side, max(is_used.shape)))
        field_powers.append(subtract_fitted(near * squared_light, far * squared_light))
    row_power = scatter.row_variance * side * squared_slope
    known = subtract_fitted(row_power, row_power)
    for field, power in zip(scatter.fields, field_powers, strict=True):
        known = known + max(field.variance, 0.0) * power
    noise = block_sums(is_used / root_weight**2) - np.sum(u**2, axis=0)
    distance = block_sums(np.hypot(standard.u, standard.v)) / side**2
    is_counted = (block_sums(is_used) == side**2) & (distance < SIZE_RADIUS)
    # Square of a block sum [DN²] for a mean residual of one peak.
    unit = (side**2 * float(np.exp(images.spots.log_peak[frame]))) ** 2
    return BlockPower(
        excess=float(np.sum((block_sums(standard.z / root_weight) ** 2 - noise - known)[is_counted])) / unit,
        count=int(is_counted.sum()),
        noise_variance=float(2 * np.sum((noise + known)[is_counted] ** 2)) / unit**2,
        scatter_variance=float(2 * np.sum(known[is_counted] ** 2)) / unit**2,
        field_slopes=np.array([power[is_counted].sum() / unit for power in field_powers]),
    )
