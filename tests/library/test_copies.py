"""The copies of the spot of which its light is the sum."""

import numpy as np
import pytest
from scipy.special import erf

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, View, copies_of, light
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.observe.pixels import Expectation, Lights
from tests.library.small_light import drawn, started

GHOST = ("ghost_reflection", "", (0.07, 9.0, -5.0))
BLUR = ("motion_blur", "", (9e3, 20.0))
STRIPES = ("interference_fringes", "sensor", (0.1, 9.0, 30.0, 0.0))
ELLIPSE = ("beam_ellipticity", "", (1.2, 30.0))
SHAPE = LightShape(0.4, np.random.default_rng(1).normal(0, 0.1, (25, 25)))


def effects(*kinds) -> tuple[Present, ...]:
    return tuple(Present(vocabulary()[name], form, values) for name, form, values in kinds)


@pytest.mark.parametrize("integrated", [False, True])
@pytest.mark.parametrize(("kinds", "count"), [((), 1), ((GHOST,), 2), ((BLUR,), 5), ((GHOST, BLUR), 10)])
def test_light_is_the_sum_of_its_copies(kinds, count, integrated):
    """Each a spot of its own, drawn where it was moved to; nine times as many where a pixel reads the mean over it."""
    one = np.ones((1, 1, 1))
    x, y = np.arange(60.0)[None, None], np.arange(50.0)[None, :, None]
    view = View(x, y, 28 * one, 23 * one, 9e-4 * one, one, one, 0 * one, 0 * one, 9e-4, 9e-4, 0.0, 0.0, 50.0, 1.0)
    point, base = Baseline(0.0, "free", False, 9e-4, SHAPE), Free(300 * one, 5 * one)
    baseline = point._replace(pixel_integration=integrated)
    copies = copies_of(view, baseline, effects(*kinds), 300 * one, 5 * one).each
    assert len(copies) == count * (9 if integrated else 1)
    moved = [view._replace(x0=view.x0 + dx, y0=view.y0 + dy) for dx, dy, _ in copies]
    want = sum(weight * light(own, point, base, ())[0] for own, (_, _, weight) in zip(moved, copies, strict=True))
    np.testing.assert_allclose(light(view, baseline, base, effects(*kinds))[0], want, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("length", [0.5, 2.9, 3.1, 13.5, 26.9, 27.1, 40.0])
def test_a_path_has_as_many_copies_as_its_length_asks_for(length):
    """The mean of a Gaussian over a path along x, against its closed form, on both sides of where a copy is added."""
    one, sigma = np.ones((1, 1, 1)), 6.0
    x = np.arange(60.0)[None, None]
    view = View(x, 0 * one, 28 * one, 0 * one, one, one, one, 0 * one, 0 * one, 1.0, 1.0, 0.0, 0.0, 50.0, 1.0)
    copies = copies_of(
        view, Baseline(0.0, "free", False, 1.0), effects(("motion_blur", "", (length, 0.0))), one, sigma * one
    ).each
    got = sum(weight * np.exp(-((x - 28 - dx) ** 2) / (2 * sigma**2)) for dx, _, weight in copies)
    ends = (erf((x - 28 + sign * length / 2) / (sigma * np.sqrt(2))) for sign in (1, -1))
    want = sigma * np.sqrt(np.pi / 2) / length * np.subtract(*ends)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kinds", [(), (GHOST,), (GHOST, STRIPES), (BLUR, GHOST, STRIPES), (ELLIPSE, GHOST)])
def test_a_learned_shape_lies_at_the_places_of_the_copies(kinds):
    """What the splines' coefficients change of the light, as the sum over copies that the scores take."""
    images, known = drawn(1, sites=1)
    frames, model = started(images, known)
    model = model._replace(present=effects(*kinds))
    shaped = model._replace(lights=Lights.common(SHAPE, len(frames)))
    k = 1
    seen, plain = (Expectation(frames, own).of(frames[k], k) for own in (shaped, model))
    peak = np.exp(model.numbers.log_peak[k]) * seen.factor
    places = (np.broadcast_arrays(u, v) for u, v, _ in seen.copies)
    want = sum(peak * copy[2] * SHAPE(*at) for at, copy in zip(places, seen.copies, strict=True))
    assert np.abs(want).max() > 10
    np.testing.assert_allclose(seen.spot - plain.spot, want, atol=1e-9)
