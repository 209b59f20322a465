"""Every frame's brightness, width and centre under a light's shape that stands, each frame alone.

Quasi-likelihood (McCullagh & Nelder, Generalized Linear Models, 2nd ed., ch. 9): scores of the mean alone, weighted by
the exact variance. Then, to first order, the numbers' covariance is I⁻¹ and what is left of the standardised readings
is their projection beside the slopes, whatever the law of a reading.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.pixels import Expectation, Expected, Frame, Model, Numbers

# Steps at most, and the squared length of a step in its own errors that ends a frame's fit.
STEPS, ENOUGH = 12, 1e-6
# Longest step of a number: logs of peak and width, centre in σ. A start may be far off.
LONGEST = 0.3


class Numbered(NamedTuple):
    """A model with the numbers of its frames fitted, and the information [frame, 4, 4] that each frame has of its own
    logs of peak and width and centre [px]."""

    model: Model
    information: np.ndarray


def fit_numbers(frames: Sequence[Frame], model: Model) -> Numbered:
    """Fit the numbers of all frames, from those of the model."""
    numbers = Numbers(*(np.array(v, float) for v in model.numbers))
    ready = Expectation(frames, model)
    ready.model = model._replace(numbers=numbers)
    information = np.empty((len(frames), 4, 4))

    def part(which: np.ndarray) -> list[float]:
        for k in which:
            information[k] = _fit_one(frames[k], k, ready, numbers)
        return [0.0]

    shared(part, len(frames))
    return Numbered(model._replace(numbers=numbers), information)


def _fit_one(frame: Frame, k: int, ready: Expectation, numbers: Numbers) -> np.ndarray:
    """Move a frame's numbers to where they fit; returns their information."""
    for _ in range(STEPS):
        seen = ready.of(frame, k)
        known = np.isfinite(frame.pixels)
        spread = np.sqrt(seen.variance)
        slopes = (ready.by_numbers(frame, k, seen) * (seen.slope / spread) * known).reshape(len(numbers), -1)
        z = np.where(known, (frame.pixels - seen.mean) / spread, 0.0).ravel()
        own, score = slopes @ slopes.T, slopes @ z
        width = float(np.exp(numbers.log_width[k]))
        step = linalg.lstsq(own, score)[0]
        length = float(step @ own @ step)
        step *= min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-300))
        for value, change in zip(numbers, step * [1, 1, width, width], strict=True):
            value[k] += change
        if length < ENOUGH:
            break
    return own / np.outer([1, 1, width, width], [1, 1, width, width])


def expected_of(frames: Sequence[Frame], model: Model) -> list[Expected]:
    """What frames should read under a model, each with its own numbers fitted."""
    model = fit_numbers(frames, model).model
    ready = Expectation(frames, model)
    return [ready.of(frame, k) for k, frame in enumerate(frames)]
