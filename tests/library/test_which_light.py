"""Whether the declared light stands or a shape is learned, and what is named beside either."""

import numpy as np
import pytest

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.observe.frames import round_spot
from spotcheck.old_engine.observe.pixels import Numbers
from spotcheck.old_engine.search.light import find
from tests.library.small_light import BLACK, CONTEXT, SENSOR, beam, designed, drawn, gaussian, started

GAUSSIAN = Baseline(0.0, "free", False, 1.0)
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
    first = np.log([round_spot(image, SENSOR, GAUSSIAN) for image in images])
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


def turned(u, v):
    """The beam of the other tests, a right angle further: its three lobes lie elsewhere."""
    return beam(v, -u)


@pytest.mark.parametrize(("shapes", "lights"), [((beam, turned), 2), ((beam, beam), 1)])
def test_poses_have_lights_of_their_own_where_one_for_all_does_not_do(shapes, lights):
    """Six sites of each of two poses, with the same beam in both, or with another in each; a pedestal of 1 DN is found
    beside both."""
    parts = [drawn(seed, sites=6, shape=shape, pedestal=1.0) for seed, shape in zip((11, 12), shapes, strict=True)]
    images, known = (np.concatenate(own) for own in zip(*parts, strict=True))
    frames, model = started(images, known)
    pose = np.repeat([0, 1], len(known) // 2)
    plain = designed(known)
    design = plain._replace(
        angle_deg=90.0 * pose, pose=pose.astype(str), condition=plain.condition + pose * (plain.condition.max() + 1)
    )
    effects = [vocabulary()[name] for name in ("dark_offset", "smear", "nonlinearity")]
    model = model._replace(lights=None)
    outcome = find(frames, design, model, effects, CONTEXT._replace(peak_dn=690.0 / 0.97))
    assert outcome.after.model.lights is not None and len(outcome.after.model.lights.coefficients) == lights
    assert [one.own.effect.name for one in outcome.found] == ["dark_offset"]
    assert abs(outcome.found[0].own.values[0] - 1.0) < 0.05


def test_each_frame_of_a_scan_has_a_light_and_a_level_of_its_own():
    """Four frames, one at each of four poses, of four beams over levels that differ by 3 DN: the offset that they have
    in common is named within its error, which is as large as they disagree."""
    levels, beams = (1.0, 2.0, 3.0, 4.0), (beam, turned, gaussian, lambda u, v: beam(-u, v))
    parts = [
        drawn(k, sites=1, shape=own, pedestal=level) for k, (own, level) in enumerate(zip(beams, levels, strict=True))
    ]
    images, known = (np.stack([own[0] for own in some]) for some in zip(*parts, strict=True))
    frames, model = started(images, known)
    order = np.arange(4)
    design = designed(known)._replace(
        site=order, condition=order, pose=order.astype(str), exposure_s=np.full(4, np.nan)
    )
    effects = [vocabulary()[name] for name in ("dark_offset", "smear")]
    outcome = find(frames, design, model._replace(lights=None), effects, CONTEXT)
    lights = outcome.after.model.lights
    assert lights is not None and len(lights.coefficients) == 4
    np.testing.assert_allclose(lights.level - lights.level.mean(), np.array(levels) - 2.5, atol=0.3)
    for one in outcome.found:
        assert one.own.effect.name == "dark_offset" and abs(one.own.values[0] - 2.5) < 3 * one.holding.error
