"""Find repeats that show different spots, as each frame holds two spots of about equal light, or only one of two.

Repeats are frames of the same condition: the same place on all axes of the grid but the repeat. A spot may lie
elsewhere in each of them if camera or laser were moved in between. Repeats show different spots if both frames hold
light at both places, or if the widths at two places differ as well.
"""

from collections.abc import Callable, Hashable, Sequence

import numpy as np
from scipy import stats

from spotcheck.crops.outlier_frames import FALSE_ALARM_RATE, SpotMoments, drop_repeat
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame

# Distance of two places [σ of the narrower spot] beyond which they are compared. Two equal spots in one crop have a
# common σ of 0.35 times their distance at least, hence 2 and not more.
COMPARED_SIGMAS = 2.0
# Two places show two spots if they are this far apart [σ of either spot]: 3σ of both do not overlap.
SEPARATE_SIGMAS = 6.0
# Least light of the second spot relative to the cropped one: flicker by less than a factor of two swaps them.
LEAST_LIGHT = 0.5
# Least relative difference of the widths at two places; a move that defocuses may change the width by less.
LEAST_WIDTH_DIFFERENCE = 0.1

# Measures the light of a frame in a square around a column and a row with a given side [px]; None without light.
MeasureAt = Callable[[Frame, float, float, float], SpotMoments | None]


def describe_second_spots(
    dataset: Dataset, moments: Sequence[SpotMoments | None], centres: np.ndarray, measure_at: MeasureAt
) -> str:
    """Return a remark on the first condition whose repeats show different spots; "" if there is none.

    Noise is never a second spot, as `measure_moments` asks for nine pixels above it. The test of widths is made only
    for spots at two places, and has a rate of false alarms of `FALSE_ALARM_RATE` per condition.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    moments : sequence
        Moments of each of `dataset.spots` in its crop; None for unusable frames.
    centres : array [spot, 2]
        Column and row of the centre of each crop [px]: the centroid of the spot that was found.
    measure_at : callable
        Measures the light of a frame elsewhere. It is called for two frames of a condition.
    """
    conditions: dict[Hashable, list[int]] = {}
    # `dataset.cells` follows the order of `dataset.spots`.
    for spot, ((index, _), moment) in enumerate(zip(dataset.cells(), moments, strict=True)):
        if moment is not None:
            conditions.setdefault(drop_repeat(index), []).append(spot)
    sigmas = np.array([np.nan if moment is None else moment.sigma for moment in moments])
    for spots in map(np.array, conditions.values()):
        first, second = _find_extremes(centres[spots])
        distance = float(np.hypot(*(centres[spots[first]] - centres[spots[second]])))
        if distance <= COMPARED_SIGMAS * sigmas[spots[[first, second]]].min():
            continue
        pair = [(dataset.spots[spots[member]], *centres[spots[member]].tolist()) for member in (first, second)]
        is_near = np.hypot(*(centres[spots] - centres[spots[first]]).T) < distance / 2
        if _holds_both(pair, distance, measure_at):
            evidence = "both frames hold both"
        elif _have_different_widths(sigmas[spots], is_near, distance):
            evidence = "their widths differ as well"
        else:
            continue
        return (
            f"{pair[0][0].label} and {pair[1][0].label} are repeats but show different spots, {distance:.0f} px apart"
            f" ({evidence}): name the pixels of one spot in bad_pixels.mask, or leave out the"
            f" {np.count_nonzero(~is_near)} of {len(spots)} repeats with the other one by keep = no in manifest.csv"
        )
    return ""


def _find_extremes(centres: np.ndarray) -> tuple[int, int]:
    """Return the numbers of two of the places [spot, 2] that are far apart: one far from the median, one from that."""
    first = int(np.argmax(np.hypot(*(centres - np.median(centres, axis=0)).T)))
    return first, int(np.argmax(np.hypot(*(centres - centres[first]).T)))


def _holds_both(pair: Sequence[tuple[Frame, float, float]], distance: float, measure_at: MeasureAt) -> bool:
    """Return whether each frame of a pair holds a spot of comparable light where the other frame has its spot.

    `pair` has the frame, and the column and row of its spot [px]. The squares end halfway between both places, which
    are `distance` [px] apart.
    """
    for (frame, x, y), (_, other_x, other_y) in (pair, pair[::-1]):
        cropped, elsewhere = measure_at(frame, x, y, distance), measure_at(frame, other_x, other_y, distance)
        if cropped is None or elsewhere is None or elsewhere.light < LEAST_LIGHT * cropped.light:
            return False
        shift = np.hypot(elsewhere.x - other_x, elsewhere.y - other_y)
        if SEPARATE_SIGMAS * max(cropped.sigma, elsewhere.sigma) > distance or shift > elsewhere.sigma:
            return False
    return True


def _have_different_widths(sigmas: np.ndarray, is_near: np.ndarray, distance: float) -> bool:
    """Return whether spots at two places, `distance` [px] apart, differ in their mean ln width (Student's t test).

    `sigmas` [spot] in px are those of the repeats, and `is_near` [spot] tells those at the first place. A single frame
    elsewhere is not tested: it is an outlier frame.
    """
    if min(np.count_nonzero(is_near), np.count_nonzero(~is_near)) < 2 or SEPARATE_SIGMAS * sigmas.max() > distance:
        return False
    groups = np.log(sigmas[is_near]), np.log(sigmas[~is_near])
    difference = abs(np.mean(groups[0]) - np.mean(groups[1]))
    is_significant = stats.ttest_ind(*groups).pvalue < FALSE_ALARM_RATE
    return bool(is_significant and difference > np.log1p(LEAST_WIDTH_DIFFERENCE))
