"""Noise of a camera without a data sheet, from its frames alone, and what stands against trusting it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.nuisance.noise_curve import (
    Correlated,
    Gain,
    correlated_px,
    gain_from_curve,
    noise_curve,
)
from spotcheck.estimate.noise import NoiseCurve
from spotcheck.model.sensor import ROUNDING_VARIANCE

# The rim of a frame, whose median is its dark level, in parts of its sides: a spot lies within.
RIM = 0.05
# So many codes on either side let expect how often one is read; the side with fewer counts, as at the ends.
NEIGHBOURS = 2


class Unstated(NamedTuple):
    """What frames tell of their camera: gain [DN/e-] with the noise floor [DN²] above rounding, both with errors (None
    where they do not); how far neighbours share noise; codes that the camera skips, as a look-up table of its own makes
    it do; and the level [DN] above which each frame's light was counted."""

    gain: Gain | None
    correlated: Correlated
    skipped: tuple[int, ...]
    black: tuple[float, ...]


def unstated_noise(frames: Sequence[np.ndarray], full_scale: float, black: float | None = None) -> Unstated:
    """Of frames [DN, NaN where masked] of one camera, pooled.

    Light is counted above `black` [DN], or above what each frame's rim reads: the floor is then the noise of a dark
    pixel, shot noise of stray light included. Where noise is not white the gain is given all the same, if its law is
    seen; `correlated` says that it is not that of single pixels.
    """
    levels = tuple(dark_level(frame) if black is None else black for frame in frames)
    curves = [noise_curve(frame, full_scale) for frame in frames]
    above = [curve._replace(level=curve.level - level) for curve, level in zip(curves, levels, strict=True)]
    pooled = NoiseCurve(*(np.concatenate(parts) for parts in zip(*above, strict=True)))
    gain = gain_from_curve(pooled, 0.0)
    gain = None if gain is None else gain._replace(floor=gain.floor - ROUNDING_VARIANCE)
    shared = [correlated_px(frame, full_scale) for frame in frames]
    # Chance makes a frame's noise look shared once in a while, and compression that of most.
    reach = int(np.median([own.reach_px for own in shared]))
    correlated = Correlated(reach, sum(own.tells for own in shared) > len(shared) / 2)
    return Unstated(gain, correlated, skipped_codes(frames), levels)


def dark_level(frame: np.ndarray) -> float:
    """What most pixels of the rim read [DN]."""
    rows, columns = (max(1, round(RIM * side)) for side in frame.shape)
    inner = np.zeros(frame.shape, bool)
    inner[rows:-rows, columns:-columns] = True
    return float(np.nanmedian(frame[~inner]))


def skipped_codes(frames: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Codes that no pixel reads although their neighbours are read often.

    # ASSUME: light varies smoothly, so that codes next to each other are read about as often. A run of skipped codes
    # above 0 is black clipping, and not told here.
    """
    codes = np.concatenate([frame[np.isfinite(frame)].astype(int) for frame in frames])
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
            if min(_expected(count, code, below), _expected(count, code, above)) > criteria.EXPECTED.value:
                out.append(code)
    return tuple(out)


def _expected(count: np.ndarray, code: int, near: np.ndarray) -> float:
    """Readings of a code by the codes on one side of it: the least of them, and 0 where those are far."""
    if len(near) < NEIGHBOURS or np.abs(near - code).max() > 2 * NEIGHBOURS:
        return 0.0
    return float(count[near].min())
