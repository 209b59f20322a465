"""Codes that a camera never outputs, as an internal look-up table causes."""

from collections.abc import Sequence

import numpy as np

# A code that no pixel reads is missing if its neighbours let expect this count: by chance once in 5e8.
MIN_EXPECTED = 20.0
# Number of codes on each side from which the count of a code is expected.
NEIGHBOURS = 2


def find_missing_codes(images: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Return the codes that no pixel reads although neighbouring codes are read often.

    # ASSUME: light varies smoothly, so that neighbouring codes are about equally frequent. A gap directly above 0 is
    black clipping and does not count.

    Parameters
    ----------
    images : images [rows, columns] in DN; NaN pixels do not count. If any reading is not a whole number of at least 0,
        such as in a mean of frames, no code is missing.
    """
    readings = np.concatenate([image[np.isfinite(image)] for image in images])
    codes = readings.astype(int)
    if np.any(codes != readings) or codes.min(initial=0) < 0:
        return ()
    count = np.bincount(codes, minlength=1).astype(float)
    present = np.flatnonzero(count)
    if len(present) < 2 * NEIGHBOURS + 1:
        return ()
    lowest = present[1] if present[0] == 0 else present[0]
    missing = []
    for code in range(lowest + 1, present[-1]):
        if count[code] == 0:
            # Next codes that are present: a table may skip every other one, or two in a row.
            below, above = present[present < code][-NEIGHBOURS:], present[present > code][:NEIGHBOURS]
            if min(_expect_count(count, code, below), _expect_count(count, code, above)) > MIN_EXPECTED:
                missing.append(code)
    return tuple(missing)


def _expect_count(count: np.ndarray, code: int, neighbours: np.ndarray) -> float:
    """Return the least count of the neighbours on one side of a code; 0 if they are too few or too far away."""
    if len(neighbours) < NEIGHBOURS or np.abs(neighbours - code).max() > 2 * NEIGHBOURS:
        return 0.0
    return float(count[neighbours].min())
