"""The learned shape against scipy's splines."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.model.ellipse import make_round
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light_shape import LightShape
from tests.samples.effect_cases import FREE, SENSOR, applied, free_frame, of
from tests.samples.splines import surface


def shape(side: int = 21, step: float = 0.4, seed: int = 3) -> LightShape:
    return LightShape(step, np.random.default_rng(seed).normal(0, 0.1, (side, side)))


def test_points_and_grids_agree_with_scipy():
    """Inside, at the edge and beyond, where the last spline ends."""
    learned, rng = shape(), np.random.default_rng(4)
    u, v = rng.uniform(-6, 6, (2, 500))
    assert np.abs(u).max() > learned.step * 12
    np.testing.assert_allclose(learned(u, v), surface(learned, u, v), atol=1e-14)
    columns, rows = np.linspace(-5, 5, 40), np.linspace(-6, 4, 30)
    want = surface(learned, *(part.ravel() for part in np.meshgrid(columns, rows))).reshape(30, 40)
    np.testing.assert_allclose(learned(columns[None, :], rows[:, None]), want, atol=1e-14)


@pytest.mark.parametrize("cases", [[], [of("beam_ellipticity", ratio=1.7, direction=35.0)],
                                   [of("super_gaussian", n=1.3)]], ids=["round", "ellipse", "flanks"])  # fmt: skip
@pytest.mark.parametrize("top_hat", [False, True], ids=["", "top hat"])
def test_the_model_adds_it_to_the_spot(cases, top_hat):
    """Light of a spot with a learned shape is A (B + s): stretched with the ellipse, behind the top hat, and not bent
    with the flanks."""
    learned, frame = shape(), free_frame(300.0, 16.0)
    baselines = [replace(FREE, top_hat=top_hat, learned=own) for own in (None, learned)]
    plain, got = (ForwardModel(own, SENSOR, None, applied(cases)).light(frame).spot for own in baselines)
    dx, dy = np.broadcast_arrays(frame.pixels.x - frame.x0, frame.pixels.y - frame.y0)
    if cases and cases[0].name == "beam_ellipticity":
        dx, dy = make_round(dx, dy, 1.7, np.deg2rad(35.0))
    want = plain + 300 * surface(learned, dx.ravel() / 16, dy.ravel() / 16).reshape(dx.shape)
    np.testing.assert_allclose(got, want, atol=1e-10)
