"""Impossible readings of a frame: zeros far below all others, constant rows, columns and regions, drawn lines.

Lost packets of a camera link, masks and thresholds of programs, and overlays replace readings by a constant. Such
pixels were not measured. The tests use one frame alone, so that they apply to every frame of a dataset and to images
without a description. A code is one possible reading. A step is the distance of neighbouring codes [DN].

Lens and pixels blur every edge of the light, so that most pixels beside a bright or dark region read less far from it
than those a little further away. An edge without this flank was not in the light.

Up to `MAX_DEFECT_LINES` rows or columns of one reading are mostly a defect of the sensor, which is in every frame. The
search for outlier pixels treats them, so that they can be learned as bad rows or columns.

# ASSUME: no light is finer than a Gaussian of σ 0.45 px, of which 18 % reach the pixel beside a line of one pixel.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

# The lowest code is separated from the others if at least this number of codes above it is empty. It is counted in the
# widest of the next `TESTED_STEPS` steps: the empty codes of look-up tables, such as that of a gamma of 2.2, are fewer.
MIN_EMPTY_CODES, TESTED_STEPS = 4, 3
# Least number of pixels in the range of codes above the empty one and as wide, and of those beside the lowest code.
# Smooth light has as many pixels in the lower of two such ranges, which is empty by chance once in exp(25).
MIN_EXPECTED_PX = 25
# A faint edge of light leaves no reading in its lowest third. The readings must therefore extend to this multiple of
# the empty range, in all but this part of the pixels, or the empty range to this number of codes.
MIN_EXTENT, BRIGHTEST_PART, MIN_WIDE_CODES = 3, 1e-3, 20
# Least connected pixels at the lowest code. Fewer are dead pixels, which the masks of bad and outlier pixels treat.
MIN_CONNECTED_PX = 16
# Readings were cut at a threshold if the histogram above it begins with an edge: the darkest `EDGE_PX` pixels or more,
# of at least `MIN_EDGE_PX`, span some codes, and the next codes, as many, hold at most `MAX_RISE` times their number.
# Smooth light has no more pixels there, and so many by chance less than once in 1e4. A tail of noise rises 4 times or
# more; noise on light with a sharp edge 2.8 times.
EDGE_PX, MIN_EDGE_PX, MAX_RISE = 30, 200, 2.0
# A larger part of the pixels at the lowest codes is a background with less noise than a step, and no edge: light above
# a threshold of 5 codes has 14 % of its pixels or less at the next code.
MAX_EDGE_PART = 0.25
# Least jump of readings that counts as an edge [steps].
MIN_JUMP_STEPS = 8
# A constant row or column was not measured if the lines on both sides jump from it at this number of the same places,
# which excludes hot pixels; or if both have this number of pixels with another reading. Noise that spares so many
# pixels of a line has a probability below exp(−50).
MIN_JUMPS, MIN_OTHER = 5, 50
# Least sides of a constant region [px]. With noise of 2 steps, 8 pixels in a row agree once in 1e5 places.
MIN_REGION_SIDE = 8
# Rows are searched for constant regions in this interval [px], which every region of `MIN_REGION_SIDE` contains twice.
ROW_INTERVAL = 4
# A region of more than this part of a frame is its background.
MAX_REGION_PART = 0.5
# A pixel beside a region is on a flank if its difference from the region is smaller, by this part, than all of those
# 2 px from the region and within this distance [px] of the pixel. An edge is sharp if at most this part of its pixels
# is on a flank.
FLANK, FLANK_PX, MAX_FLANKED_PART = 0.1, 4, 0.2
# The same part for the lowest code, beside which the light of a spot that was cut at a threshold has a slope itself.
# Beside a dark region without noise, an edge of light rises by more than this from one pixel to the next.
STEEP = 0.6
# Lines are drawn if they are not thicker [px], consist of connected pieces of this size [px], and have this number of
# pixels in all.
MAX_THICKNESS_PX, MIN_PIECE_PX, MIN_DRAWN_PX = 4, 8, 30
# Least height of a drawn line in standard deviations of the readings around it: noise alone does not connect so many
# pixels of one code.
MIN_HEIGHT_SD = 4.0
# Most neighbouring rows or columns that count as a defect of the sensor if they are constant as a whole.
MAX_DEFECT_LINES = 3
# Standard deviation of a normal distribution over its median absolute deviation.
MAD_TO_SIGMA = 1.4826
# Neighbours of a pixel along rows, columns and diagonals.
EIGHT_NEIGHBOURS = np.ones((3, 3), bool)

SEPARATED = "pixels have the lowest reading, far below all others; they were not measured and are left out"
CUT = (
    "pixels have the lowest reading, and none reads a little more: camera or program cut off faint light, so that"
    " widths are uncertain; save frames without a threshold"
)
CONSTANT_LINES = "pixels are in rows or columns of one constant reading; they were not measured and are left out"
CONSTANT_REGIONS = (
    "pixels are in regions of one constant reading with sharp edges; they were not measured and are left out"
)
DRAWN_LINES = (
    "pixels form thin lines at the highest reading, drawn by a program; they were not measured and are left out"
)


class ImpossibleReadings(NamedTuple):
    """Pixels of a frame that were not measured.

    A threshold tells that the light was below it, and may belong to the camera; other masked pixels tell nothing.
    """

    mask: np.ndarray  # True where a pixel was not measured, apart from the following ones, [row, column]
    is_cut: np.ndarray  # True where faint light was cut off at a threshold, [row, column]
    counts: Mapping[str, int]  # number of pixels by reason: one of the sentences of this module

    @property
    def is_unmeasured(self) -> np.ndarray:
        """True for all these pixels [row, column]. Widths leave them out: light below a threshold is not 0."""
        return self.mask | self.is_cut


class _Edge(NamedTuple):
    """Edge of a region of one code."""

    height: float  # median difference of the readings 2 px away from the code [DN]
    least_height: float  # difference of all but `MAX_FLANKED_PART` of these readings [DN]
    scatter: float  # standard deviation of these differences, from their median [DN]
    flanked_part: float  # part of the pixels beside the region that are on a flank

    @property
    def is_sharp(self) -> bool:
        """Whether the edge has no flanks."""
        return self.flanked_part <= MAX_FLANKED_PART


def find_impossible_readings(pixels: np.ndarray, is_bad: np.ndarray | None = None) -> ImpossibleReadings:
    """Return the pixels of a frame that were not measured, with the reasons.

    Parameters
    ----------
    pixels : readings [row, column] in DN, unsigned integers.
    is_bad : True for pixels that are known to be bad [row, column]; None if there are none. They are not tested.

    Returns
    -------
    ImpossibleReadings
        Its masks are False for bad pixels. A pixel counts for the first reason that applies.

    Examples
    --------
    >>> import numpy as np
    >>> frame = np.random.default_rng(1).normal(40, 2, (60, 80)).round().astype(np.uint16)
    >>> frame[10:14] = 0
    >>> found = find_impossible_readings(frame)
    >>> list(found.counts.values()), np.flatnonzero(found.mask.all(axis=1)).tolist()
    ([320], [10, 11, 12, 13])
    """
    is_good = np.ones(pixels.shape, bool) if is_bad is None else ~is_bad
    mask, is_cut, counts = np.zeros(pixels.shape, bool), np.zeros(pixels.shape, bool), dict[str, int]()
    if min(pixels.shape) < MIN_REGION_SIDE or not is_good.any():
        return ImpossibleReadings(mask, is_cut, counts)
    reason, is_lowest = _find_separated_code(pixels, is_good)
    is_in_line = _find_constant_rows(pixels, is_good) | _find_constant_rows(pixels.T, is_good.T).T
    for sentence, is_impossible in (
        (reason, is_lowest),
        (CONSTANT_LINES, is_in_line),
        (CONSTANT_REGIONS, _find_constant_regions(pixels, is_good)),
        (DRAWN_LINES, _find_drawn_lines(pixels, is_good)),
    ):
        is_new = is_impossible & is_good & ~mask & ~is_cut
        if is_new.any():
            is_new &= ~_find_defects(is_impossible, can_cross=sentence != DRAWN_LINES)
        if is_new.any():
            place = is_cut if sentence == CUT else mask
            place |= is_new
            counts[sentence] = int(np.count_nonzero(is_new))
    # A frame must keep pixels: tests that leave none do not apply to it.
    if not (is_good & ~mask & ~is_cut).any():
        return ImpossibleReadings(mask & False, is_cut & False, {})
    return ImpossibleReadings(mask, is_cut, counts)


def describe_impossible_readings(frames: Sequence[tuple[str, Mapping[str, int]]], most_named: int) -> list[str]:
    """Return one sentence for each reason, with the frames that it concerns.

    Parameters
    ----------
    frames : name and `ImpossibleReadings.counts` of each frame.
    most_named : largest number of frames that a sentence names.
    """
    phrases_by_reason: dict[str, list[str]] = {}
    for name, counts in frames:
        for reason, count in counts.items():
            phrases_by_reason.setdefault(reason, []).append(f"{name}: {count}")
    sentences = []
    for reason, phrases in phrases_by_reason.items():
        more = f" and {len(phrases) - most_named} more frames:" if len(phrases) > most_named else ""
        sentences.append(f"{', '.join(phrases[:most_named])}{more} {reason}")
    return sentences


def _find_defects(mask: np.ndarray, can_cross: bool) -> np.ndarray:
    """Return the mask [row, column] of up to `MAX_DEFECT_LINES` whole rows or columns of a mask, apart from its others.

    `can_cross` is whether rows that cross whole columns count as well; drawn lines cross.
    """
    is_defect = np.zeros(mask.shape, bool)
    for axis in (0, 1):
        is_whole = np.asarray(mask.all(axis=1 - axis))
        rest = mask & ~mask.all(axis=axis, keepdims=True) if can_cross else mask
        labels, number = ndimage.label(rest.any(axis=1 - axis))
        for label in range(1, number + 1):
            is_run = labels == label
            if np.count_nonzero(is_run) <= MAX_DEFECT_LINES and is_whole[is_run].all():
                is_defect |= np.expand_dims(is_run, 1 - axis)
    return is_defect


def _find_separated_code(pixels: np.ndarray, is_good: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the reason and the mask [row, column] of the lowest code if empty codes separate it from the others."""
    none = SEPARATED, np.zeros(pixels.shape, bool)
    lowest = pixels[is_good].min() if not is_good.all() else pixels.min()
    # Every 8th pixel along both axes decides most frames quickly: few of them have empty codes.
    above = pixels[::8, ::8][is_good[::8, ::8]] - lowest
    if ((above > 0) & (above <= MIN_EMPTY_CODES)).any():
        return none
    counts = np.bincount((pixels[is_good] - lowest).ravel())
    codes = np.flatnonzero(counts)[1 : TESTED_STEPS + 2]
    if len(codes) <= TESTED_STEPS:
        return none
    gap, step = int(codes[0]), int(np.diff(codes).max())
    if gap <= MIN_EMPTY_CODES * step or counts[gap : 2 * gap].sum() < MIN_EXPECTED_PX:
        return none
    # The code that all but `BRIGHTEST_PART` of the other pixels do not exceed.
    brightest = int(np.searchsorted(np.cumsum(counts[1:]), (1 - BRIGHTEST_PART) * counts[1:].sum())) + 1
    if brightest < MIN_EXTENT * gap and gap <= MIN_WIDE_CODES * step:
        return none
    is_lowest = (pixels == lowest) & is_good
    is_beside = ndimage.binary_dilation(is_lowest, EIGHT_NEIGHBOURS) & is_good & ~is_lowest
    edge = _measure_edge(pixels, is_lowest, is_good, steep=STEEP)
    if np.count_nonzero(pixels[is_beside] - lowest < 2 * gap) < MIN_EXPECTED_PX or not edge.is_sharp:
        return none
    labels, _ = ndimage.label(is_lowest, EIGHT_NEIGHBOURS)
    if np.bincount(labels.ravel())[1:].max() < MIN_CONNECTED_PX:
        return none
    return (CUT if _ends_in_edge(counts[gap:], step) else SEPARATED), is_lowest


def _ends_in_edge(counts: np.ndarray, step: int) -> bool:
    """Return whether a histogram begins with an edge, as at a threshold, and not with a tail of noise or a background.

    `counts` are pixels [code] from the lowest reading on, and `step` is the distance of neighbouring codes [DN].
    """
    # Pixels up to each step.
    below = np.cumsum(np.add.reduceat(counts, np.arange(0, len(counts), step)))
    total = int(below[-1])
    if total < MIN_EDGE_PX:
        return False
    width = int(np.searchsorted(below, EDGE_PX)) + 1
    lowest, next_ones = below[width - 1], below[min(2 * width, len(below)) - 1] - below[width - 1]
    return bool(lowest <= MAX_EDGE_PART * total and next_ones <= MAX_RISE * lowest)


def _find_constant_rows(pixels: np.ndarray, is_good: np.ndarray) -> np.ndarray:
    """Return the mask [row, column] of rows with one reading that the rows beside them do not have.

    Rows at the highest reading are left out: they may be saturated.
    """
    mask = np.zeros(pixels.shape, bool)
    # Bad pixels neither make nor prevent a constant row. A row of bad pixels alone is not constant.
    if is_good.all():
        highest, lowest = pixels.max(axis=1), pixels.min(axis=1)
    else:
        highest = np.where(is_good, pixels, 0).max(axis=1)
        lowest = np.where(is_good, pixels, np.iinfo(pixels.dtype).max).min(axis=1)
    is_constant = (highest == lowest) & (highest < highest.max())
    if not is_constant.any() or is_constant.all():
        return mask
    # Runs of neighbouring rows with the same constant reading: [start, end).
    is_new_run = np.concatenate([[True], (highest[1:] != highest[:-1]) | (is_constant[1:] != is_constant[:-1]), [True]])
    bounds = np.flatnonzero(is_new_run)
    for start, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        # Two rows on the other side replace one beyond the frame.
        beside = [row for row in (start - 2, start - 1, end, end + 1) if 0 <= row < len(pixels)]
        beside = beside[1:3] if len(beside) == 4 else beside
        if not is_constant[start] or len(beside) < 2:
            continue
        difference = np.abs(pixels[beside].astype(np.int64) - int(highest[start])) * is_good[beside]
        least_jump = MIN_JUMP_STEPS * _find_step(pixels[is_good], int(highest[start]))
        has_jump = (difference >= least_jump).all(axis=0)
        if np.count_nonzero(has_jump) >= MIN_JUMPS:
            box = slice(max(start - 3, 0), end + 3)
            is_run = np.zeros(pixels[box].shape, bool)
            is_run[start - box.start : end - box.start] = True
            edge = _measure_edge(pixels[box], is_run, is_good[box] & has_jump, flank_px=end - start + FLANK_PX)
            mask[start:end] = edge.is_sharp
        # Light that varies smoothly along the lowest row has other readings on both sides as well, by small steps.
        elif highest[start] > lowest.min():
            mask[start:end] = np.count_nonzero(difference, axis=1).min() >= MIN_OTHER
    return mask


def _find_constant_regions(pixels: np.ndarray, is_good: np.ndarray) -> np.ndarray:
    """Return the mask [row, column] of connected regions of one code with sharp edges.

    Regions at the highest code are left out: they may be saturated.
    """
    mask = np.zeros(pixels.shape, bool)
    rows, columns, codes = _find_constant_runs(pixels)
    candidates, run_counts = np.unique(codes[codes < pixels[is_good].max()], return_counts=True)
    for code in candidates[run_counts >= MIN_REGION_SIDE // ROW_INTERVAL].tolist():
        least_jump = MIN_JUMP_STEPS * _find_step(pixels[is_good], code)
        labels, _ = ndimage.label((pixels == code) & is_good, EIGHT_NEIGHBOURS)
        is_code = codes == code
        run_labels, run_rows = labels[rows[is_code], columns[is_code]], rows[is_code]
        boxes = ndimage.find_objects(labels)
        for number in np.unique(run_labels[run_labels > 0]).tolist():
            if len(np.unique(run_rows[run_labels == number])) < MIN_REGION_SIDE // ROW_INTERVAL:
                continue
            box = _grow_box(boxes[number - 1])
            is_region = labels[box] == number
            if np.count_nonzero(is_region) > MAX_REGION_PART * pixels.size:
                continue
            edge = _measure_edge(pixels[box], is_region, is_good[box])
            if edge.is_sharp and edge.least_height >= least_jump:
                mask[box] |= is_region
    return mask


def _find_constant_runs(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return row, first column and code [run] of long constant runs in every `ROW_INTERVAL`th row that end in a jump.

    The jump is in DN, whatever the step is.
    """
    lines = pixels[::ROW_INTERVAL].ravel()
    columns = pixels.shape[1]
    is_start = np.ones(lines.size, bool)
    np.not_equal(lines[1:], lines[:-1], out=is_start[1:])
    is_start[::columns] = True
    starts = np.flatnonzero(is_start)
    ends = np.append(starts[1:], lines.size)
    is_long = ends - starts >= MIN_REGION_SIDE
    starts, ends = starts[is_long], ends[is_long]
    codes = lines[starts].astype(np.int64)
    # The reading before the first and behind the last pixel of a run; the run's own one at the edge of the frame.
    before = np.where(starts % columns > 0, lines[starts - 1], codes)
    behind = np.where(ends % columns > 0, lines[ends % lines.size], codes)
    has_jump = np.maximum(np.abs(before - codes), np.abs(behind - codes)) >= MIN_JUMP_STEPS
    return starts[has_jump] // columns * ROW_INTERVAL, starts[has_jump] % columns, codes[has_jump]


def _find_drawn_lines(pixels: np.ndarray, is_good: np.ndarray) -> np.ndarray:
    """Return the mask [row, column] of thin lines at the highest code with sharp edges."""
    mask = np.zeros(pixels.shape, bool)
    highest = int(pixels[is_good].max())
    is_highest = (pixels == highest) & is_good
    if not MIN_DRAWN_PX <= np.count_nonzero(is_highest) <= MAX_REGION_PART * pixels.size:
        return mask
    # The opening keeps the pixels of squares that are wider than a line.
    is_wide = ndimage.minimum_filter(is_highest.view(np.uint8), MAX_THICKNESS_PX + 1, mode="constant", cval=1)
    is_wide = ndimage.maximum_filter(is_wide, MAX_THICKNESS_PX + 1, mode="constant", cval=0)
    labels, _ = ndimage.label(is_highest & (is_wide == 0), EIGHT_NEIGHBOURS)
    sizes = np.bincount(labels.ravel())
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if sizes[number] < MIN_PIECE_PX:
            continue
        box = _grow_box(box)
        is_piece = labels[box] == number
        edge = _measure_edge(pixels[box], is_piece, is_good[box] & ~is_highest[box])
        if edge.is_sharp and edge.height >= max(MIN_JUMP_STEPS, MIN_HEIGHT_SD * edge.scatter):
            mask[box] |= is_piece
    return mask if np.count_nonzero(mask) >= MIN_DRAWN_PX else mask & False


def _grow_box(box: tuple[slice, ...]) -> tuple[slice, ...]:
    """Return the rows and columns of a box and of 3 px around it, from 0; slices may end beyond the frame."""
    return tuple(slice(max(side.start - 3, 0), side.stop + 3) for side in box)


def _measure_edge(
    pixels: np.ndarray, is_region: np.ndarray, is_usable: np.ndarray, flank_px: int = FLANK_PX, steep: float = FLANK
) -> _Edge:
    """Return the edge of a region of one code; of no height if there are no pixels around it.

    Parameters
    ----------
    pixels : readings around the region [row, column] in DN.
    is_region, is_usable : True for the pixels of the region, and for those that are compared with it [row, column].
    flank_px : distance within which pixels are compared to find flanks [px].
    steep : least part by which the difference of a pixel on a flank from the region is smaller.
    """
    within = [ndimage.binary_dilation(is_region, EIGHT_NEIGHBOURS, distance) for distance in (1, 2)]
    is_beside, is_away = within[0] & ~is_region & is_usable, within[1] & ~within[0] & is_usable
    if not is_beside.any() or not is_away.any():
        return _Edge(0.0, 0.0, 0.0, 1.0)
    difference = np.abs(pixels.astype(float) - float(pixels[is_region][0]))
    height = float(np.median(difference[is_away]))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(difference[is_away] - height)))
    least_away = ndimage.minimum_filter(np.where(is_away, difference, np.inf), 2 * flank_px + 1, mode="nearest")
    is_flank = difference[is_beside] < (1 - steep) * least_away[is_beside]
    least_height = float(np.quantile(difference[is_away], MAX_FLANKED_PART))
    return _Edge(height, least_height, scatter, float(is_flank.mean()))


def _find_step(readings: np.ndarray, code: int) -> int:
    """Return the widest of the next `TESTED_STEPS` steps [DN] between the codes above one code; 1 if there are none.

    `readings` are unsigned integers [DN] of any shape. The step from the code itself does not count.
    """
    counts = np.bincount(readings.ravel())
    codes = code + 1 + np.flatnonzero(counts[code + 1 :])[: TESTED_STEPS + 1]
    return int(np.diff(codes).max(initial=1))
