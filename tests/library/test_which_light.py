"""Whether the declared light stands or a shape is learned, and what is named beside either."""

import numpy as np
import pytest

from spotcheck.discrepancy.observe.frames import round_spot
from spotcheck.discrepancy.observe.pixels import Numbers
from spotcheck.discrepancy.search.light import find
from spotcheck.model.effects import vocabulary
from tests.library.small_light import BLACK, CONTEXT, SENSOR, designed, drawn, gaussian, started

KNOWN = ("dark_offset", "nonlinearity", "smear", "super_gaussian", "ghost_reflection", "speckle", "row_noise")


@pytest.mark.parametrize(
    ("kinds", "learned", "named"),
    [
        ({"shape": gaussian}, False, []),
        ({"shape": gaussian, "pedestal": 1.0}, False, ["dark_offset"]),
        ({"shape": gaussian, "speckle": (0.2, 1.5)}, False, ["speckle"]),
        ({"shape": gaussian, "rows": 0.5}, False, ["row_noise"]),
        ({}, True, []),
        ({"pedestal": 1.0}, True, ["dark_offset"]),
    ],
)
def test_the_declared_light_stands_where_effects_explain_the_frames(kinds, learned, named):
    """A Gaussian with or without one effect is left as declared; a beam with three lobes is learned. Where pixels share
    a field, its mean over few sites is no shape."""
    images, known = drawn(11, sites=6, **kinds)
    frames, model = started(images, known)
    model = model._replace(lights=None)
    context = CONTEXT._replace(peak_dn=690.0 / 0.97)
    outcome = find(frames, designed(known), model, [vocabulary()[name] for name in KNOWN], context)
    assert (outcome.after.model.lights is not None) == learned
    assert [one.own.effect.name for one in outcome.found] == named


def test_a_level_far_below_the_light_is_found_under_grains():
    """Light eight times as bright as in the other tests, 1.3 to 10 times the level, under speckle of contrast 0.4, the
    level differing by 1.5 % from pixel to pixel, and each frame begun by the spot that fits it alone: the level and the
    field alone are named, and brightness and width are those of the light, not of what is cut."""
    seed = 12
    images, known = drawn(
        seed, 6, clip=560.0, shape=lambda u, v: 8 * gaussian(u, v), speckle=(0.4, 1.0), skewed=True, uneven=0.015
    )
    frames, model = started(images, known)
    first = np.log([round_spot(image, SENSOR, top_hat=False) for image in images])
    numbers = Numbers(first[:, 0], first[:, 3], np.exp(first[:, 1]), np.exp(first[:, 2]))
    model = model._replace(lights=None, numbers=numbers)
    assert np.median(np.exp(numbers.log_peak) / known[:, 1]) < 4
    top = np.sort(images.ravel())[-20] - BLACK
    effects = [vocabulary()[name] for name in (*KNOWN, "saturation", "scatter_halo", "fibre_anisotropy")]
    outcome = find(frames, designed(known), model, effects, CONTEXT._replace(peak_dn=top / 0.97))
    found = {one.own.effect.name: one for one in outcome.found}
    assert set(found) == {"saturation", "speckle"}
    level = found["saturation"]
    assert abs(level.own.values[0] - 560) < 4 * level.holding.error < 2
    assert abs(found["speckle"].own.values[0] - 0.4) < 0.03
    assert abs(outcome.after.model.uneven - 0.015) < 0.002
    fitted = outcome.after.model.numbers
    assert np.all(np.abs(np.exp(fitted.log_width) / known[:, 2] - 1) < 0.05)
    assert abs(np.median(np.exp(fitted.log_peak) / (8 * known[:, 1])) - 1) < 0.05
