"""Stripes on frames drawn by numpy alone: what they are, how they lie, and none where none are."""

import numpy as np
import pytest

from spotcheck.old_engine.evidence.patterns import gathered
from spotcheck.old_engine.evidence.pixels import Ready
from spotcheck.old_engine.evidence.stripes import phases, stripes_of
from spotcheck.old_engine.nuisance.fit import fit
from tests.library.small_light import CONTEXT, PENALTY, WIDTHS, beam, designed, drawn, gaussian, started

PERIOD, DIRECTION, DEPTH = 9.0, 30.0, 0.05
SIGMA = WIDTHS[1]


def sought(seed: int, *, learned: bool, **kinds):
    """The strongest stripes beside a fit without any, and the spot's centre at each site."""
    images, known = drawn(seed, sites=6, spread=3.0, shape=beam if learned else gaussian, **kinds)
    frames, model = started(images, known)
    if not learned:
        model = model._replace(lights=None)
    design = designed(known)
    sites, _ = gathered(frames, design, Ready(frames, fit(frames, model, PENALTY), []))
    return stripes_of(sites, CONTEXT.sigma_px), known[::3, 3:]


def folded(direction: float) -> float:
    """A direction with its opposite as one [deg]."""
    return direction % 180


@pytest.mark.parametrize(
    ("stay", "learned"), [("sensor", False), ("spot", False), ("site", False), ("sensor", True), ("site", True)]
)
def test_stripes_are_found_and_where_they_stay(stay, learned):
    """Period within 1 %, direction within 1°, and the form alone that they were drawn in, with its depth within 10 %.
    Beside a learned shape, those that stay with the spot are the shape's."""
    found, centre = sought(3, learned=learned, stripes=(DEPTH, PERIOD, DIRECTION), stay=stay)
    assert found.gain > 200
    assert found.period == pytest.approx(PERIOD, rel=0.01)
    assert folded(found.direction) == pytest.approx(DIRECTION, abs=1.0)
    (own,) = phases(found, centre)
    assert own.form == stay
    assert own.depth == pytest.approx(DEPTH, rel=0.1)
    if stay == "sensor":
        # Drawn with cos(turn + 1 rad); of the opposite direction it turns the other way.
        turned = 1.0 if abs(found.direction - DIRECTION) < 90 else -1.0
        assert np.cos(np.deg2rad(own.phase) - turned) > np.cos(0.3)


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("kinds", [{}, {"speckle": (0.1, 1.5)}])
def test_no_stripes_where_there_are_none(kinds, learned):
    """Twelve sets: of noise none at all (the bound that takes chance off is passed once in 1e3 or less); of speckle
    none that gains as much as an effect must, 25."""
    for seed in range(12):
        found, _ = sought(seed, learned=learned, **kinds)
        assert found is None or found.gain < (25.0 if kinds else 1e-9), (seed, found)
