"""Codes that a camera never outputs, as an internal look-up table causes.

A code is a possible reading of a pixel [DN, integer].
"""

from collections.abc import Sequence

import numpy as np

# A code without pixels is missing if its neighbours suggest more than this count; by chance, such a count is 0 once in
# 5e8.
MIN_EXPECTED = 20.0
# Number of codes on each side that give the expected count of a code. They must lie within twice this distance.
NEIGHBOURS = 2


def find_missing_codes(images: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Return the codes that no pixel has although neighbouring codes are frequent, in ascending order.

    A gap directly above 0 is black clipping and does not count.

    Parameters
    ----------
    images : one image or more [rows, columns] in DN; NaN pixels do not count. If any reading is not a whole number or
        is negative, such as in a mean of frames, an empty tuple is returned.
    """
    # ASSUME: light varies smoothly, so that neighbouring codes are about equally frequent.
    readings = np.concatenate([image[np.isfinite(image)] for image in images])
    codes = readings.astype(int)
    if np.any(codes != readings) or codes.min(initial=0) < 0:
        return ()
    counts = np.bincount(codes, minlength=1).astype(float)
    used_codes = np.flatnonzero(counts)
    # A missing code needs `NEIGHBOURS` codes that occur on each side. One more is required, since a gap above code 0
    # does not count.
    if len(used_codes) < 2 * NEIGHBOURS + 1:
        return ()
    lowest = used_codes[1] if used_codes[0] == 0 else used_codes[0]
    missing_codes = []
    for code in range(lowest + 1, used_codes[-1]):
        if counts[code] == 0:
            # The nearest codes that occur: the table may also skip the adjacent one, or two in a row.
            below, above = used_codes[used_codes < code][-NEIGHBOURS:], used_codes[used_codes > code][:NEIGHBOURS]
            if min(_estimate_count(counts, code, below), _estimate_count(counts, code, above)) > MIN_EXPECTED:
                missing_codes.append(code)
    return tuple(missing_codes)


def _estimate_count(counts: np.ndarray, code: int, neighbours: np.ndarray) -> float:
    """Return the number of pixels expected at a code: the least count of its neighbours on one side.

    It is 0 if the neighbours are too few or too far away. `counts` [code] are numbers of pixels, and `neighbours` the
    nearest codes on this side that occur.
    """
    if len(neighbours) < NEIGHBOURS or np.abs(neighbours - code).max() > 2 * NEIGHBOURS:
        return 0.0
    return float(counts[neighbours].min())
