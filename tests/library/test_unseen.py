"""Frames that no search has seen: what a found model foretells of them, and what an effect that is not there does."""

import numpy as np
import pytest

from spotcheck.old_engine.conclude.unseen import unseen
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.nuisance.parameters import free_of
from tests.library.small_light import CONTEXT, PENALTY, designed, drawn, fitted, started


def found(seed: int, own: Present, **kinds):
    """A fit with a learned shape and an effect, of one set of frames; frames of another with start and design."""
    frames, before, _ = fitted(seed, **kinds)
    model = before.model.with_effect(own)
    after = fit(frames, model, PENALTY, free_of(model, CONTEXT))
    images, known = drawn(seed + 1000, **kinds)
    others, start = started(images, known)
    declared = start._replace(lights=None)
    return after, others, designed(known), declared


def test_a_found_model_closes_the_gap_of_frames_that_it_has_not_seen():
    """Light and pedestal each close their part: the residual's mean square over the declared noise comes down to 1, to
    within the numbers that each frame fits for itself and the noise of so many readings."""
    own = Present(vocabulary()["dark_offset"], "light", (1.0,))
    after, frames, design, declared = found(3, own, pedestal=2.0)
    gap, gains = unseen(frames, design, declared.numbers, declared, after, "unseen repeats")
    readings = sum(frame.pixels.size for frame in frames)
    # The variance of a mean of squares is 2 over their number; a shape of 4 sites brings noise of its own.
    assert gap.after**2 == pytest.approx(gap.noise_floor**2, abs=5 * np.sqrt(2 / readings) + 0.02)
    assert gap.before > 1.5 and 0.98 < gap.closed < 1.02
    assert gap.by_effect["dark_offset"] > 0.3 and gains["dark_offset"] > 1000


def test_what_is_not_there_foretells_nothing():
    """A pedestal of 0.3 DN in a model of frames that have none is worse on other frames."""
    own = Present(vocabulary()["dark_offset"], "light", (0.3,))
    _, before, _ = fitted(4)
    after = before._replace(model=before.model.with_effect(own))
    images, known = drawn(1004)
    others, start = started(images, known)
    declared = start._replace(lights=None)
    _, gains = unseen(others, designed(known), start.numbers, declared, after, "unseen repeats")
    assert gains["dark_offset"] < -100
