"""Advice for rivals: what a frame is worth against closed forms, and the condition that needs the fewest."""

import numpy as np
import pytest

from spotcheck.old_engine.conclude.advise import cheapest, feasible, worth_of
from spotcheck.old_engine.criteria import GAIN
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.sensor import ROUNDING_VARIANCE
from tests.library.small_light import EXPOSURES, NOISE, SIDE, designed, drawn, gaussian, started
from tests.library.small_light import GAIN as K

LEVEL = 0.8


def models():
    """Frames of Gaussian light, a model with a pedestal, and one without."""
    images, known = drawn(3, sites=2, shape=gaussian)
    frames, plain = started(images, known)
    plain = plain._replace(lights=None)
    effect = vocabulary()["dark_offset"]
    return frames, designed(known), plain.with_effect(Present(effect, effect.forms[0], (LEVEL,))), plain


def test_a_blocked_beam_is_worth_what_its_pixels_are():
    """Each pixel tells the level with the variance of a dark reading: shot noise of the level, read noise, rounding."""
    frames, _, first, other = models()
    variance = K * LEVEL + (K * NOISE) ** 2 + ROUNDING_VARIANCE
    worth = worth_of(frames, first, other, {"exposure_s": EXPOSURES[-1], "blocked": True}, None)
    # Rounding adds no more than 1 % where noise is 0.7 DN.
    assert worth == pytest.approx(SIDE**2 * LEVEL**2 / variance, rel=0.02)


def test_nothing_is_worth_a_frame_that_both_foretell():
    frames, design, first, _ = models()
    assert worth_of(frames, first, first, {"exposure_s": EXPOSURES[0]}, None) == pytest.approx(0.0, abs=1e-6)
    assert cheapest(frames, design, first, first, None) is None


def test_the_cheapest_condition_needs_as_many_frames_as_its_worth_says():
    """The worth is that of whichever model is true."""
    frames, design, first, other = models()
    condition, number = cheapest(frames, design, first, other, None)
    worth = min(worth_of(frames, *pair, condition, None) for pair in ((first, other), (other, first)))
    assert number == int(np.ceil(GAIN.value / worth)) == 1
    assert condition in list(feasible(design))


def test_a_frame_that_would_clip_is_not_asked_for():
    """Four times the longest exposure is four times as bright: beyond full scale."""
    frames, _, first, other = models()
    assert worth_of(frames, first, other, {"exposure_s": 4 * EXPOSURES[-1]}, None) == 0.0
    assert worth_of(frames, first, other, {"exposure_s": EXPOSURES[0] / 2}, None) > 0
