"""Find outlier frames: spot frames that are blocked, displaced or exposed twice.

The frames lie on a grid of angle, exposure, repeat and other conditions; the index of a frame has one number for each
axis. A condition is a combination of all axes but the repeat, and a site one of all axes but the exposure.

Brightness, width and position of each spot are compared with those of its siblings. The siblings of a frame are the
repeats of its condition, after the offset of its site is removed. If a condition has fewer than three repeats, the
siblings are the neighbouring frames of the same site in a series of exposures or of positions along the beam.

The quantities of a spot are ln light, ln width, x and y, in this order. Only gross outliers are reported. Power
fluctuation, drift and pointing jitter are a scatter that all frames share. This scatter sets the scale of the test
here, and the verdict quantifies it.
"""

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from spotcheck.crops.spotfinding import MEDIAN_DIFFERENCE, median_filter_3x3
from spotcheck.dataset.folder import Dataset

# Largest rate of good frames that are reported. It holds for quantities with the heavy tails of Student's t
# distribution with five degrees of freedom, and is shared equally by the four quantities of a frame.
FALSE_ALARM_RATE, TAIL_FREEDOM, QUANTITIES = 1e-4, 5.0, 4
# Standard deviation over median absolute deviation, and efficiency of that estimate, both for a normal distribution.
MAD_TO_SIGMA, MAD_EFFICIENCY = 1.4826, 0.37
# Gross outliers: light relative to the siblings, width relative to the siblings, distance in widths of the siblings.
MIN_LIGHT, MAX_LIGHT, MIN_WIDTH, MAX_WIDTH, MAX_SHIFT = 0.75, 1.5, 0.75, 1.33, 0.5
# Fewest siblings for a test. At most one of 3 siblings, and one of 10 spots of the dataset, can be an outlier.
MIN_SIBLINGS, SIBLINGS_PER_OUTLIER, SPOTS_PER_OUTLIER = 3, 3, 10
# Frames that a series needs on either side of a tested frame. Near an end, an outlier cannot be told from its
# neighbour.
MIN_NEIGHBOURS = 2
# Axes of the grid along which brightness and position change smoothly: exposure, and distance along the beam.
SMOOTH_AXES = ("exposure", "z_m")
# Alternating medians of conditions and sites converge within a few iterations.
MEDIAN_POLISH_ITERATIONS = 5
# A pixel is lit if, after the median filter, its light exceeds this multiple of the noise of an unfiltered reading, and
# this level [DN]. The filter reduces the noise of a pixel to 0.41.
LIT_OVER_NOISE, FAINTEST_DN = 3.0, 1.0
# Fewest lit pixels of a spot whose moments are measured.
MIN_LIT_PIXELS = 9
# The border of a crop is 1 px and 1/`BORDER` of its side wide.
BORDER = 16
# Standard error of a sum of n filtered pixels, over √n times the noise of an unfiltered reading; 1.1 for white noise.
# The median filter reduces the noise of a pixel but correlates that of neighbours, so that the sum keeps its noise.
CORRELATED_NOISE = 1.5
# Column of the width among the quantities of a frame: ln light, ln width, x and y.
WIDTH = 1


@dataclass(frozen=True)
class SpotMoments:
    """Brightness, width and position of a spot, and their standard errors due to pixel noise.

    The errors are those of independent frames of the same spot. They do not include any change of the light.
    """

    light: float  # sum of the light [DN px]
    sigma: float  # root mean square radius per axis [px]
    x: float  # centroid, column on the sensor [px]
    y: float  # centroid, row on the sensor [px]
    log_light_error: float  # standard error of ln light
    log_sigma_error: float  # standard error of ln sigma
    centre_error: float  # standard error of x and of y [px]


class OutlierFrame(NamedTuple):
    """A spot frame that differs grossly from its siblings."""

    spot: int  # index in `dataset.spots`
    flag: str  # status flag: blocked, double or moved
    reason: str  # what is wrong, in words


@dataclass(frozen=True)
class _Comparison:
    """Deviations of frames from their siblings in ln light, ln width, x and y."""

    deviation: np.ndarray  # deviation from the siblings, [frame, quantity]; x and y in px; NaN if not compared
    limit: np.ndarray  # largest deviation of a good frame, [frame, quantity]; infinite if not tested
    group: list[Hashable]  # label of the group of siblings of each frame, which includes the frame


def measure_moments(crop: np.ndarray, left: int, top: int) -> SpotMoments | None:
    """Return the moments of a spot, after a median filter that removes isolated bright pixels.

    Parameters
    ----------
    crop : array [rows, columns]
        Readings [DN], NaN where no pixel was read. The median of the border is the background.
    left, top : int
        Column and row of the first pixel of the crop on the sensor [px].

    Returns
    -------
    SpotMoments or None
        None if fewer than `MIN_LIT_PIXELS` pixels exceed the noise.
    """
    is_valid = np.isfinite(crop)
    if not is_valid.any():
        return None
    image = np.where(is_valid, crop, np.median(crop[is_valid])).astype(np.float32)
    is_border = np.ones(image.shape, bool)
    is_border[tuple(slice(1 + size // BORDER, -1 - size // BORDER) for size in image.shape)] = False
    # Noise of a pixel [DN]; MEDIAN_DIFFERENCE is the median absolute difference of two pixels for a noise of 1.
    noise = float(np.median(np.abs(np.diff(image, axis=1)))) / MEDIAN_DIFFERENCE
    signal = median_filter_3x3(image) - np.median(image[is_border])
    rows, columns = np.nonzero((signal > max(LIT_OVER_NOISE * noise, FAINTEST_DN)) & is_valid)
    if len(rows) < MIN_LIT_PIXELS:
        return None
    light = float(signal[rows, columns].sum(dtype=float))
    weights = signal[rows, columns] / light
    x, y = float(columns @ weights), float(rows @ weights)
    # Squared distance of each lit pixel from the centroid along an axis, averaged over both axes [px²].
    squared_distances = ((columns - x) ** 2 + (rows - y) ** 2) / 2
    variance = float(squared_distances @ weights)
    # Noise of a pixel in a sum, relative to the light. If a pixel changes by the part p of the light, ln light changes
    # by p, ln sigma by p (squared distance/variance − 1)/2, and x by p (column − x). Each error is the root of the sum
    # of the squares of these changes over the lit pixels.
    relative_noise = CORRELATED_NOISE * noise / light
    return SpotMoments(
        light=light,
        sigma=variance**0.5,
        x=left + x,
        y=top + y,
        log_light_error=float(relative_noise * np.sqrt(len(rows))),
        log_sigma_error=float(relative_noise * np.linalg.norm((squared_distances / variance - 1) / 2)),
        centre_error=float(relative_noise * np.sqrt(squared_distances.sum())),
    )


def find_outlier_frames(dataset: Dataset, moments: Sequence[SpotMoments | None]) -> tuple[list[OutlierFrame], str]:
    """Return the spot frames that differ grossly from their siblings.

    Parameters
    ----------
    dataset : Dataset
        Frames whose column `keep` is set are compared but never reported.
    moments : sequence
        Moments of each of `dataset.spots`; None for unusable frames, which are neither tested nor siblings.

    Returns
    -------
    outliers : list of OutlierFrame
        In the order of `dataset.spots`. A group of siblings of which more than a third are outliers reports none.
    remark : str
        Not empty if more than one spot in ten, and more than one, is an outlier. No frame is reported then: so many
        mean that the light changes, not that single frames failed.
    """
    measured = [(spot, moment) for spot, moment in enumerate(moments) if moment is not None]
    if len(measured) < MIN_SIBLINGS:
        return [], ""
    # `dataset.cells` follows the order of `dataset.spots`.
    indices = [index for (index, _), moment in zip(dataset.cells(), moments, strict=True) if moment is not None]
    values = np.array([(np.log(m.light), np.log(m.sigma), m.x, m.y) for _, m in measured])
    errors = np.array([(m.log_light_error, m.log_sigma_error, m.centre_error, m.centre_error) for _, m in measured])
    # Frames are compared with repeats first; those without enough repeats, with their neighbours in a series.
    comparison = _compare_repeats(values, errors, indices)
    comparison = _compare_neighbours(values, errors, indices, dataset, comparison)
    # Flag and reason of each measured frame, None for a good one.
    faults = list(map(_classify, comparison.deviation, comparison.limit, np.exp(values[:, WIDTH])))
    sizes = Counter(comparison.group)
    fault_counts = Counter(group for group, fault in zip(comparison.group, faults, strict=True) if fault)
    outliers = [
        OutlierFrame(spot, *fault)
        for (spot, _), group, fault in zip(measured, comparison.group, faults, strict=True)
        if fault and fault_counts[group] <= sizes[group] // SIBLINGS_PER_OUTLIER and dataset.spots[spot].keep is None
    ]
    if len(outliers) > max(len(measured) // SPOTS_PER_OUTLIER, 1):
        first = dataset.spots[outliers[0].spot].label
        return [], (
            f"{len(outliers)} of {len(measured)} spot frames are unlike their siblings, {first} first"
            f" ({outliers[0].reason}): too many for accidents, so that all are used"
        )
    return outliers, ""


def _compare_repeats(values: np.ndarray, errors: np.ndarray, indices: list[tuple[int, ...]]) -> _Comparison:
    """Compare each frame with the repeats of its condition, after the offset of its site is removed.

    `values` and their standard errors `errors` are [frame, quantity], and `indices` are those of the frames on the
    grid. Conditions with fewer than `MIN_SIBLINGS` frames are not tested.
    """
    conditions: list[Hashable] = [drop_repeat(index) for index in indices]
    # The second axis of the grid is the exposure.
    sites = [(index[0], *index[2:]) for index in indices]
    exposures = np.array([index[1] for index in indices])
    condition_sizes = Counter(conditions)
    is_tested = np.array([condition_sizes[condition] >= MIN_SIBLINGS for condition in conditions])
    deviation, limit = np.full(values.shape, np.nan), np.full(values.shape, np.inf)
    condition_groups, site_groups = _group_frames(conditions, is_tested), _group_frames(sites, is_tested)
    has_site = np.zeros(len(indices), bool)
    has_site[[frame for group in site_groups for frame in group]] = True
    # A site with too few frames has no offset of its own: its frames are compared with the scatter of all sites.
    # Offsets of conditions and of sites have one mean in common, which counts once.
    for groups, frames, common_offsets in (
        (condition_groups, np.flatnonzero(is_tested & ~has_site), 0),
        (condition_groups + site_groups, np.flatnonzero(is_tested & has_site), 1),
    ):
        if not len(frames):
            continue
        # Median polish: the medians of all groups are subtracted in turn.
        residuals = np.where(is_tested[:, None], values, np.nan)
        for _ in range(MEDIAN_POLISH_ITERATIONS):
            for group in groups:
                residuals[group] -= np.median(residuals[group], axis=0)
        degrees_of_freedom = int(is_tested.sum()) - len(groups) + common_offsets
        scatter = _estimate_scatter(residuals[is_tested])
        for frame in frames:
            # Short exposures may scatter more than long ones.
            is_same_exposure = is_tested & (exposures == exposures[frame])
            is_same_exposure[frame] = False
            larger_scatter = np.maximum(scatter, _estimate_scatter(residuals[is_same_exposure]))
            deviation[frame] = residuals[frame]
            limit[frame] = _limit_deviation(larger_scatter, errors[frame], degrees_of_freedom)
    return _Comparison(deviation, limit, conditions)


def drop_repeat(index: tuple[int, ...]) -> tuple[int, ...]:
    """Return the condition of a frame: its index on the grid without the repeat, which is the third axis."""
    return index[:2] + index[3:]


def _group_frames(labels: Sequence[Hashable], is_selected: np.ndarray) -> list[np.ndarray]:
    """Return, for each label with at least `MIN_SIBLINGS` selected frames, an array of the numbers of these frames.

    `labels` and `is_selected` are [frame]; a frame's number is its place there.
    """
    groups: dict[Hashable, list[int]] = {}
    for frame in np.flatnonzero(is_selected).tolist():
        groups.setdefault(labels[frame], []).append(frame)
    return [np.array(group) for group in groups.values() if len(group) >= MIN_SIBLINGS]


def _estimate_scatter(residuals: np.ndarray) -> np.ndarray:
    """Return the robust standard deviation [quantity] of residuals [frame, quantity] without NaN.

    It is 0 if all residuals of a quantity are 0, or if there are none.
    """
    # A residual of exactly 0 belongs to the frame that was the median, and has no information about the scatter.
    magnitudes = [np.sort(np.abs(column[column != 0])) for column in residuals.T]
    # For an even number, the lower middle value is taken and not the mean of both: one outlier among few frames raises
    # it less.
    return np.array([MAD_TO_SIGMA * m[(len(m) - 1) // 2] if len(m) else 0.0 for m in magnitudes])


def _limit_deviation(scatter: np.ndarray, errors: np.ndarray, degrees_of_freedom: float) -> np.ndarray:
    """Return the largest deviation of a good frame, in the shape of `errors`; infinite without degrees of freedom.

    `scatter` [quantity] is that of all frames, estimated with `degrees_of_freedom`, and `errors` [quantity] or
    [frame, quantity] are the standard errors by pixel noise. The limit is a quantile of Student's t distribution.
    """
    if degrees_of_freedom <= 0:
        return np.full(errors.shape, np.inf)
    # A scatter that is known from few frames has heavier tails.
    distribution = stats.t(min(TAIL_FREEDOM, MAD_EFFICIENCY * degrees_of_freedom))
    return distribution.isf(FALSE_ALARM_RATE / QUANTITIES / 2) * np.hypot(scatter, errors)


def _compare_neighbours(
    values: np.ndarray, errors: np.ndarray, indices: list[tuple[int, ...]], dataset: Dataset, comparison: _Comparison
) -> _Comparison:
    """Compare frames without enough repeats with their neighbours in a series along the longest smooth axis.

    Return a copy of `comparison`, the result of `_compare_repeats`, in which frames without a deviation have that from
    their series. Return it unchanged if no axis has more than 2 `MIN_NEIGHBOURS` places. `values` and `errors` are
    [frame, quantity], `indices` those of the frames on the grid. Outliers are removed from the series one at a time,
    the worst first; a removed frame keeps its deviation and limit.
    """
    is_pending = np.isnan(comparison.deviation).all(axis=1)
    # An axis of labels has no values (None).
    lengths = {axis.name: axis.size for axis in dataset.axes if axis.name in SMOOTH_AXES and axis.values is not None}
    if not is_pending.any() or not lengths or max(lengths.values()) <= 2 * MIN_NEIGHBOURS:
        return comparison
    name = max(lengths, key=lambda name: lengths[name])
    axis_number = [axis.name for axis in dataset.axes].index(name)
    coordinates = np.array(dataset.axes[axis_number].values, float)
    # ln light is linear in the logarithm of the exposure.
    coordinates = np.log(coordinates) if name == "exposure" else coordinates
    position = np.array([coordinates[index[axis_number]] for index in indices])
    # A series is labelled by its axis and by the places on all other axes.
    labels: list[Hashable] = [(name, *index[:axis_number], *index[axis_number + 1 :]) for index in indices]
    # Numbers of the frames of each series, in the order of their positions.
    series = [frames[np.argsort(position[frames])] for frames in _group_frames(labels, is_pending)]
    deviation, limit, group = comparison.deviation.copy(), comparison.limit.copy(), list(comparison.group)
    for frame in (frame for frames in series for frame in frames):
        group[frame] = labels[frame]
    while True:
        for frames in series:
            deviation[frames] = _subtract_interpolation(position[frames], values[frames])
        # Frames with a neighbour on both sides.
        inner = np.concatenate([frames[1:-1] for frames in series]) if series else np.zeros(0, int)
        if not len(inner):
            break
        limit[inner] = _limit_deviation(_estimate_scatter(deviation[inner]), errors[inner], len(inner))
        # Near a waist, the width is not linear in the position. It is therefore not tested, along either axis.
        limit[inner, WIDTH] = np.inf
        worst = inner[int(np.argmax((np.abs(deviation[inner]) / limit[inner]).max(axis=1)))]
        if _classify(deviation[worst], limit[worst], float(np.exp(values[worst, WIDTH]))) is None:
            break
        # Near the end of a series, an outlier cannot be distinguished from a change of the light.
        if not any(worst in frames[MIN_NEIGHBOURS:-MIN_NEIGHBOURS] for frames in series):
            limit[worst] = np.inf
        series = [frames[frames != worst] for frames in series]
    return _Comparison(deviation, limit, group)


def _subtract_interpolation(position: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [frame, quantity] minus the linear interpolation between their neighbours; NaN at both ends.

    `position` [frame] increases.
    """
    deviation = np.full(values.shape, np.nan)
    fraction = ((position[1:-1] - position[:-2]) / (position[2:] - position[:-2]))[:, None]
    deviation[1:-1] = values[1:-1] - (1 - fraction) * values[:-2] - fraction * values[2:]
    return deviation


def _classify(deviation: np.ndarray, limit: np.ndarray, sigma: float) -> tuple[str, str] | None:
    """Return flag and reason of an outlier frame, see `OutlierFrame`; None for a good one.

    A frame is an outlier if a quantity is both gross (beyond `MIN_LIGHT` … `MAX_SHIFT`) and significant (beyond
    `limit`). The flag names the first gross quantity among light, width and shift. This quantity need not be the
    significant one: a spot that lacks part of its light is displaced as well.

    Parameters
    ----------
    deviation, limit : those of `_Comparison` for this frame [quantity].
    sigma : width of the spot of this frame [px].
    """
    # A quantity without a limit was not tested.
    tested_deviation = np.where(np.isfinite(limit), deviation, 0.0)
    log_light, log_width, *shift = tested_deviation
    # Light and width relative to the siblings, and distance from them [px].
    light, width, distance = float(np.exp(log_light)), float(np.exp(log_width)), float(np.hypot(*shift))
    is_gross_light, is_gross_width = not MIN_LIGHT <= light <= MAX_LIGHT, not MIN_WIDTH <= width <= MAX_WIDTH
    # sigma/width is the width of the siblings [px].
    is_gross_shift = distance > MAX_SHIFT * sigma / width
    # The shift is significant if it is so along either axis.
    is_significant = np.abs(tested_deviation) > limit
    if not (np.array([is_gross_light, is_gross_width, is_gross_shift, is_gross_shift]) & is_significant).any():
        return None
    if is_gross_light:
        share = f"{100 * light:.2g} % of" if light < 1 else f"{light:.2g} times"
        return "blocked" if light < 1 else "double", f"it holds {share} the light of its siblings"
    if is_gross_width:
        return "blocked" if width < 1 else "double", f"its spot is {width:.2g} times as wide as its siblings'"
    return "moved", f"its spot lies {distance:.3g} px from where its siblings have theirs"
