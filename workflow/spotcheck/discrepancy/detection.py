"""Whether anything disagrees with a model: residual tests with one p-value, and the size of what is left.

Each test has its own null law, in which the spot of each frame and the read noise were fitted. The smallest p-value of
all tests, corrected for their number, decides. Effects and light shapes that were fitted beside the spots absorb more,
so that p-values beside them are too large rather than too small.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

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

# p-values below this are reported as this: never 0.
SMALLEST_P = 1e-300
# Names of the tests of second moments.
SECOND_MOMENTS = ("noise", "neighbours", "common pattern")
# Pairs of neighbours without which their correlation is not tested, and what pairs at `residual_sums.LAGS` are called.
FEWEST_PAIRS = 1000
NEIGHBOURS = (
    "neighbours in a row",
    "neighbours in a column",
    "neighbours along the diagonal",
    "neighbours across the diagonal",
    "pixels two columns apart",
    "pixels two rows apart",
)
# Sides of the blocks in which the size of what is left is measured: at most this [px], and at most this part of σ.
# Blocks further from the spot than `SIZE_RADIUS` [σ] hardly hold light.
SIZE_BLOCK_PX, SIZE_BLOCK_SIGMA, SIZE_RADIUS = 8, 0.5, 4.0
# Sites from which on their scatter gives an error.
FEWEST_SITES = 4


@dataclass(frozen=True)
class Trial:
    """One p-value within a test."""

    p_value: float
    statistic: float  # strongest residual in standard errors
    where: str  # its place in words


def test_residuals(
    images: ResidualImages,
    black_level_dn: float = 0.0,
    scatter: KnownScatter = NO_SCATTER,
    others: Sequence[ResidualTest] = (),
    sums: ResidualSums | None = None,
) -> Detection:
    """Return whether residuals disagree with their model.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit at full resolution.
    black_level_dn : float
        Black level [DN], from which grey levels are counted.
    scatter : KnownScatter
        Named scatter that the weights of the images lack. Beside it only means are tested, since it was itself measured
        from the second moments.
    others : sequence of ResidualTest
        Further tests of the same model that count as well, such as of laws of the spots; see `deviate_test`.
    sums : ResidualSums, optional
        Result of `sum_residuals`, if it is known.

    Returns
    -------
    Detection
        Its tests are ordered by their p-values.
    """
    sums = sum_residuals(images) if sums is None else sums
    trials = {cells.kind.name: _try_cells(cells, images, black_level_dn, scatter) for cells in sums.means}
    if scatter.is_empty:
        tried = (
            _try_cells(sums.noise, images, black_level_dn, scatter),
            _try_neighbours(sums.neighbours),
            _try_pattern(sums.pattern),
        )
        trials |= dict(zip(SECOND_MOMENTS, tried, strict=True))
    tests = [*(_combine(name, of_test) for name, of_test in trials.items() if of_test), *others]
    # Among equal p-values, such as the smallest ones, a mean residual says more than a second moment.
    tests.sort(key=lambda test: (test.p_value, test.name in SECOND_MOMENTS, -abs(test.statistic)))
    p_value = correct_for_number(tests[0].p_value, len(tests)) if tests else 1.0
    return Detection(max(p_value, SMALLEST_P), tuple(tests))


# pytest takes a function of this name for a test.
test_residuals.__test__ = False  # type: ignore[attr-defined]


def deviate_test(name: str, where: str, z: float) -> ResidualTest:
    """Return the two-sided test of a normal deviate z, such as a fitted value against a stated one."""
    return _combine(name, [Trial(two_sided(z), z, where)])


def _combine(name: str, trials: Sequence[Trial]) -> ResidualTest:
    """Return the test of the smallest of several p-values."""
    best = min(trials, key=lambda trial: (trial.p_value, -abs(trial.statistic)))
    p_value = max(correct_for_number(best.p_value, len(trials)), SMALLEST_P)
    return ResidualTest(name, best.where, best.statistic, p_value, float(-special.ndtri(p_value / 2)))


def _try_cells(cells: CellSums, images: ResidualImages, black_level_dn: float, scatter: KnownScatter) -> list[Trial]:
    """Return, for each division of the frames, the p-values of the strongest cell and of the sum of squares."""
    trials = []
    for strongest in strongest_cells(cells, images.design, scatter):
        where = describe_cell(cells.kind, strongest.cell, strongest.frames, images, black_level_dn)
        p_value = correct_for_number(two_sided(strongest.z), strongest.count)
        trials.append(Trial(p_value, strongest.z, where))
        # Known scatter is common to neighbouring cells, whose squares then have no such law.
        if strongest.count > 1 and scatter.is_empty:
            p_value = _exceedance(strongest.squares, strongest.mean, strongest.variance)
            trials.append(Trial(p_value, strongest.z, where))
    return trials


def _exceedance(total: float, mean: float, variance: float) -> float:
    """Return the probability that a sum of squares exceeds a total: that of a scaled χ² of the same mean and variance.

    References
    ----------
    Satterthwaite (1946), doi:10.2307/3002019.
    """
    if min(mean, variance) <= 0:
        return 1.0
    return float(special.gammaincc(mean**2 / variance, max(total, 0.0) * mean / variance))


def _try_neighbours(sums: np.ndarray) -> list[Trial]:
    """Return p-values of the correlation of neighbours; sums [lag, dark, 2]."""
    trials = []
    for name, of_lag in zip(NEIGHBOURS, sums, strict=True):
        for (total, pairs), region in zip(of_lag, ("in the light of the spot", "in dark pixels"), strict=True):
            if pairs >= FEWEST_PAIRS:
                z = float(total / np.sqrt(pairs))
                trials.append(Trial(two_sided(z), z, f"{name}, {region}"))
    return trials


def _try_pattern(sums: np.ndarray) -> list[Trial]:
    """Return p-values of what the same pixel shows in several frames; sums [scope, weight, 3]."""
    trials = []
    for of_scope, scope in zip(sums, ("in frames of one site", "at different sites"), strict=True):
        for (total, variance, third), region in zip(of_scope, ("", ", in the light of the spot"), strict=True):
            if variance > 0:
                z = float(to_normal(total / np.sqrt(variance), third / variance**1.5))
                trials.append(Trial(two_sided(z), z, f"the same pixel {scope}{region}"))
    return trials


# Size of what is left


@dataclass(frozen=True)
class BlockPower:
    """Squared mean residuals of the blocks of a frame, in parts of the peak; sums over blocks."""

    excess: float  # squares beyond noise and known scatter [peak²]
    count: int  # number of blocks
    noise_variance: float  # variance of the squares by noise and known scatter [peak⁴]
    scatter_variance: float  # the part of known scatter alone in it
    of_fields: np.ndarray  # derivative of the expected squares by the relative variance of each field [field]


def measure_rms(images: ResidualImages, scatter: KnownScatter = NO_SCATTER) -> float:
    """Return the rms of the mean image about the model [peak], noise taken off."""
    return measure_unexplained(images, scatter).size


def measure_unexplained(images: ResidualImages, scatter: KnownScatter = NO_SCATTER) -> Unexplained:
    """Return the size of what is left beside a model; `share` and `p_value` are NaN.

    Mean residuals of blocks, in parts of each frame's peak, have the power of noise and of what is left. The noise of a
    block is that of the model and of known scatter, less what the fit of the spot absorbs of it. The error is the
    larger of that by noise, with the error of the fields' variances, and that by the scatter of sites.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    scatter : KnownScatter
        Scatter that the weights of the images lack; it is no part of what is left.
    """
    side = int(np.clip(SIZE_BLOCK_SIGMA * np.exp(np.min(images.spots.log_sigma)), 1, SIZE_BLOCK_PX))
    with ThreadPoolExecutor(THREADS) as pool:
        frames = list(pool.map(partial(_measure_blocks, images, side, scatter), range(len(images.left))))
    excess, count = np.array([frame.excess for frame in frames]), np.array([frame.count for frame in frames], float)
    blocks = count.sum()
    if blocks == 0:
        return Unexplained(0.0, np.inf, 0.0, np.nan, np.nan)
    mean = float(excess.sum() / blocks)
    site = np.unique(images.design.site, return_inverse=True)[1]
    # Grains of a site are the same in all its frames and lie in several blocks: their squares do not average out.
    grain_px = max((np.nan_to_num(field.grain_px) for field in scatter.fields), default=0.0)
    alike = np.bincount(site)[site] * max(1.0, np.pi * (grain_px**2 / side**2 + 1 / 6)) - 1
    variance = sum(
        frame.noise_variance + more * frame.scatter_variance for frame, more in zip(frames, alike, strict=True)
    )
    of_fields = np.sum([frame.of_fields for frame in frames], axis=0)
    field_errors = np.array([np.nan_to_num(field.stderr) for field in scatter.fields])
    error = float(np.sqrt(variance + np.sum((of_fields * field_errors) ** 2)) / blocks)
    sites = site.max() + 1
    if sites >= FEWEST_SITES:
        deviations = np.bincount(site, excess - mean * count)
        error = max(error, float(np.sqrt(np.sum(deviations**2) * sites / (sites - 1)) / blocks))
    return Unexplained(float(np.sqrt(max(mean, 0.0))), error, mean / max(error, 1e-300), np.nan, np.nan)


def _measure_blocks(images: ResidualImages, side: int, scatter: KnownScatter, frame: int) -> BlockPower:
    """Return the power of the blocks of a frame."""
    standard = standardize(images, frame)
    used = standard.offset > 0
    root = np.sqrt(np.where(used, images.weight[frame], 1.0))
    rows, columns = (length // side for length in used.shape)

    def block_sums(values: np.ndarray) -> np.ndarray:
        cut = values[..., : rows * side, : columns * side]
        blocks = cut.reshape(*values.shape[:-2], rows, side, columns, side).sum(axis=-1, dtype=float).sum(axis=-2)
        return blocks.reshape(*values.shape[:-2], rows * columns)

    absorbed, weighted = block_sums(standard.absorbed / root), block_sums(standard.absorbed * root) / side**2

    def remaining(powers: np.ndarray, far_powers: np.ndarray) -> np.ndarray:
        # The fit changes sums of blocks by −U W': with the powers of far sums, which all correlated blocks share.
        of_fit = (weighted * far_powers) @ weighted.T
        return powers - 2 * far_powers * np.sum(absorbed * weighted, axis=0) + np.sum(absorbed * (of_fit @ absorbed), 0)

    squared_light, squared_slope = (block_sums((values / root) ** 2) for values in (standard.relative, standard.offset))
    of_fields = []
    for field in scatter.fields:
        near, far = (correlated_length(field.grain_px, length) ** 2 for length in (side, max(used.shape)))
        of_fields.append(remaining(near * squared_light, far * squared_light))
    known = remaining(*2 * (scatter.row_variance * side * squared_slope,))
    for field, powers in zip(scatter.fields, of_fields, strict=True):
        known = known + max(field.variance, 0.0) * powers
    noise = block_sums(used / root**2) - np.sum(absorbed**2, axis=0)
    distance = block_sums(np.hypot(standard.u, standard.v)) / side**2
    good = (block_sums(used) == side**2) & (distance < SIZE_RADIUS)
    unit = (side**2 * float(np.exp(images.spots.log_peak[frame]))) ** 2
    return BlockPower(
        excess=float(np.sum((block_sums(standard.z / root) ** 2 - noise - known)[good])) / unit,
        count=int(good.sum()),
        noise_variance=float(2 * np.sum((noise + known)[good] ** 2)) / unit**2,
        scatter_variance=float(2 * np.sum(known[good] ** 2)) / unit**2,
        of_fields=np.array([powers[good].sum() / unit for powers in of_fields]),
    )
