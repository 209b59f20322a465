"""Whether the declared light stands or a shape is learned, and what is named beside either."""

import pytest

from spotcheck.discrepancy.search.light import find
from spotcheck.model.effects import vocabulary
from tests.library.small_light import CONTEXT, designed, drawn, gaussian, started

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
    model = model._replace(baseline=model.baseline._replace(learned=None))
    context = CONTEXT._replace(peak_dn=690.0 / 0.97)
    outcome = find(frames, designed(known), model, [vocabulary()[name] for name in KNOWN], context)
    assert (outcome.after.model.baseline.learned is not None) == learned
    assert [one.own.effect.name for one in outcome.found] == named
