"""Codes that a camera skips, as a look-up table of its own makes it do."""

from collections.abc import Sequence

import numpy as np

# A code that none of the pixels read, where its neighbours let expect so many, is missing: by chance once in 5e8.
EXPECTED = 20.0
# So many codes on either side let expect how often one is read; the side with fewer counts, as at the ends.
NEIGHBOURS = 2


def skipped_codes(frames: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Codes that no pixel reads although their neighbours are read often; none where numbers are no codes, such as a
    mean of frames.

    # ASSUME: light varies smoothly, so that codes next to each other are read about as often. A run of skipped codes
    # above 0 is black clipping, and not told here.
    """
    readings = np.concatenate([frame[np.isfinite(frame)] for frame in frames])
    codes = readings.astype(int)
    if np.any(codes != readings) or codes.min(initial=0) < 0:
        return ()
    count = np.bincount(codes, minlength=1).astype(float)
    read = np.flatnonzero(count)
    if len(read) < 2 * NEIGHBOURS + 1:
        return ()
    lowest = read[1] if read[0] == 0 else read[0]
    out = []
    for code in range(lowest + 1, read[-1]):
        if count[code] == 0:
            # The nearest codes that are read at all: a table may skip every other one, or two in a row.
            below, above = read[read < code][-NEIGHBOURS:], read[read > code][:NEIGHBOURS]
            if min(_expected(count, code, below), _expected(count, code, above)) > EXPECTED:
                out.append(code)
    return tuple(out)


def _expected(count: np.ndarray, code: int, near: np.ndarray) -> float:
    """Readings of a code by the codes on one side of it: the least of them, and 0 where those are far."""
    if len(near) < NEIGHBOURS or np.abs(near - code).max() > 2 * NEIGHBOURS:
        return 0.0
    return float(count[near].min())
