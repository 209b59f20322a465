"""Whether readings gather at a code and their noise stops there: the converter's own mark, whatever the light's shape.

A signal that stops with its noise reads one code wherever more light falls. Light that is flat by itself keeps its
noise, and no code is read much more often than those below it.
"""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from spotcheck.old_engine import criteria
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model

# How many codes below one its readings are compared with.
BELOW = 6
# Noise is gone where so large a part of it is left at most.
LEFT = 0.5
# Side [px] of the squares in which noise is told, and how near to the code their mean must be [DN].
SIDE, NEAR_DN = 3, 1.0
# Noise below this [DN²] is rounding: it leaves one code or two by itself.
LEAST_DN2 = 0.15


def gathers(frames: Sequence[Frame], model: Model, k: int) -> bool:
    """Whether readings gather at the highest code that a model with the effect of a number expects, and have less noise
    there than the model without it expects."""
    with_it, without = Expectation(frames, model), Expectation(frames, model.without(k))
    seen = [with_it.of(frame, j).mean for j, frame in enumerate(frames)]
    code = round(max(float(np.max(own)) for own in seen))
    count = np.zeros(BELOW + 1)
    left, noise, squares = 0.0, 0.0, 0.0
    for j, frame in enumerate(frames):
        count += [np.count_nonzero(frame.pixels == code - gap) for gap in range(BELOW + 1)]
        middle = ndimage.uniform_filter(np.nan_to_num(frame.pixels), SIDE)
        square = ndimage.uniform_filter(np.nan_to_num(frame.pixels - code) ** 2, SIDE) - (middle - code) ** 2
        near = (middle > code - NEAR_DN) & (frame.pixels <= code)
        left += float(square[near].sum()) * SIDE**2 / (SIDE**2 - 1)
        noise += float(without.of(frame, j).variance[near].sum())
        squares += np.count_nonzero(near) / SIDE**2
    if count[0] <= criteria.STANDS_OUT.value * count[1:].mean() or noise < LEAST_DN2 * squares * SIDE**2:
        return False
    # Variance of a square's mean square, of normal noise, in units of its mean.
    z = (1 - left / noise) * np.sqrt(squares * (SIDE**2 - 1) / 2)
    return bool(left < LEFT * noise and z > criteria.SURE.value)
