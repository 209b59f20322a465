"""Frames that had no part in the search: how far they are from the model before and after, and who closes the gap.

Each unseen frame has its own brightness, width and centre fitted under every model, as those that were seen had: what
is compared is shape and effects. The likelihood of readings counts noise and scatter as well as means.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.conclude.judgement import Gap
from spotcheck.old_engine.evidence.stripes import with_waves
from spotcheck.old_engine.model.sensor import noise_line
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.nuisance.numbers import expected_of
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Expected, Frame, Model, Numbers, deviance_of


class Distance(NamedTuple):
    """How far frames are from a model: −2 ln L but for constants, and mean squares of residuals in DN² and over the
    noise of the declared model, its ends left out: of a reading that cannot move no residual is small."""

    deviance: float
    square_dn: float
    square: float


class Unseen(NamedTuple):
    """The gap, and by name what −2 ln L of unseen frames loses without each effect."""

    gap: Gap
    gains: dict[str, float]


def unseen(frames: Sequence[Frame], design: Design, numbers: Numbers, before: Model, after: Fitted, on: str) -> Unseen:
    """Compare the declared model `before` and the one that was found `after` on frames that start from `numbers`."""
    final = after.model._replace(numbers=numbers)
    frames = with_waves(frames, design, final)
    first, last = (expected_of(frames, model) for model in (before._replace(numbers=numbers), final))
    line = noise_line(before.sensor)
    noise = [line.variance(seen.mean) for seen in first]
    # Where the found model has more noise than the declared one, or less, so have its frames.
    floor = sum(float(np.sum(seen.variance / own)) for seen, own in zip(last, noise, strict=True))
    floor /= sum(own.size for own in noise)
    start, end = distance(frames, first, noise), distance(frames, last, noise)
    shaped = start
    if final.lights is not None:
        shaped = distance(frames, expected_of(frames, final._replace(present=())), noise)
    excess = max(start.square - floor, 1e-12)
    fewer = {
        own.effect.name: distance(frames, expected_of(frames, final.without(k)), noise)
        for k, own in enumerate(final.present)
    }
    parts = {name: (one.square - end.square) / excess for name, one in fewer.items()}
    gap = Gap(
        before=float(np.sqrt(start.square)),
        after=float(np.sqrt(end.square)),
        noise_floor=float(np.sqrt(floor)),
        rms_dn_before=float(np.sqrt(start.square_dn)),
        rms_dn_after=float(np.sqrt(end.square_dn)),
        closed=float((start.square - end.square) / excess),
        by_light=float((start.square - shaped.square) / excess),
        by_effect=parts,
        gain=start.deviance - end.deviance,
        on=on,
    )
    return Unseen(gap, {name: one.deviance - end.deviance for name, one in fewer.items()})


def distance(frames: Sequence[Frame], expected: Sequence[Expected], noise: Sequence[np.ndarray]) -> Distance:
    """How far frames are from what they should read; `noise` [frame][row, column] in DN²."""
    deviance = square_dn = square = 0.0
    count = 0
    for frame, seen, own in zip(frames, expected, noise, strict=True):
        known = np.isfinite(frame.pixels)
        rest = (frame.pixels - seen.mean)[known]
        deviance += deviance_of(frame, seen)
        square_dn += float(rest @ rest)
        square += float(rest @ (rest / own[known]))
        count += rest.size
    return Distance(deviance, square_dn / max(count, 1), square / max(count, 1))
