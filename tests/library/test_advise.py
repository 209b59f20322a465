"""Advice: the next measurement that tells two explanations apart, and how many frames of it."""

import numpy as np
import pytest

from rig import hidden
from spotcheck.discrepancy.advise import APART, advise, conditions_for, feasible, separations
from spotcheck.discrepancy.calibration import Kind, null_look
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.shots import Shot, design_of
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import reading
from tests.library.hidden_set import set_of


def look_of(angles, exposures, repeats=2):
    """Noise of a design."""
    grid = [(a, t, r) for a in angles for t in exposures for r in range(repeats)]
    shots = [Shot(a, t, r, k, (), 0, 0, lambda: np.zeros((1, 1))) for k, (a, t, r) in enumerate(grid)]
    return null_look(design_of(shots), Kind(96, 10, "linear", False), 1, 0)


def present(look, name, *values):
    """An account of one effect with these values and the base as it is."""
    effect = vocabulary()[name]
    own = account(look, [Present(effect, effect.forms[0], values)])
    model = own.refit.model._replace(present=(Present(effect, effect.forms[0], values),))
    return own._replace(refit=own.refit._replace(model=model))


@pytest.fixture(scope="module")
def one_angle():
    """Frames of one angle, and an ellipse that turns with the fibre or does not."""
    look = look_of([0.0], [1e-4, 3e-4, 9e-4])
    return look, present(look, "fibre_anisotropy", 1.2, 20.0), present(look, "beam_ellipticity", 1.2, 20.0)


def test_an_ellipse_at_one_angle_needs_another_angle(one_angle):
    """No exposure tells whether it turns with the fibre; one frame at another angle does."""
    look, fibre, beam = one_angle
    (own,) = advise(look, [fibre, beam])
    assert own.pair == (0, 1) and own.condition.angle_deg != 0 and own.frames == 1
    for condition, frames, _ in conditions_for(look, fibre, beam):
        assert (frames <= 1) == (condition.angle_deg != 0)


def test_as_many_frames_as_it_takes(one_angle):
    """−2 ln L grows with frames: what is asked for reaches five standard deviations within a tenth, and a frame fewer
    does not. Of an ellipse so round that one frame is not enough."""
    look, *_ = one_angle
    weak = present(look, "fibre_anisotropy", 1.001, 20.0), present(look, "beam_ellipticity", 1.001, 20.0)
    (own,) = advise(look, weak)
    assert 2 < own.frames < 200
    reached, _ = separations(look, *weak, own.condition, own.frames)
    short, _ = separations(look, *weak, own.condition, own.frames - 1)
    assert reached > 0.9 * APART and short < 1.1 * APART and short < reached


def test_a_pedestal_or_a_halo_needs_a_blocked_beam(one_angle):
    """Frames without the beam show the one and not the other: as many as bring the noise of a dark frame's mean down to
    a fifth of the level. No other pair asks for them."""
    look, fibre, beam = one_angle
    sensor = look.setting.sensor
    dark = np.hypot(sensor.gain_dn_per_e * sensor.read_noise_e, np.sqrt(1 / 12))
    level = dark / 96 / 2
    pedestal, halo = present(look, "dark_offset", level), present(look, "scatter_halo", 0.01, 3.0, 1.5)
    asked = {c: frames for c, frames, _ in conditions_for(look, pedestal, halo)}
    (blocked,) = (c for c in asked if c.blocked)
    assert blocked in feasible(look) and np.isclose(asked[blocked], 2 * 2 * APART, rtol=0.02)
    assert {c: frames for c, frames, _ in conditions_for(look, fibre, beam)}[blocked] == np.inf
    slope = present(look, "background_gradient", 1e-3, 0.1, 0.0)
    assert {c: frames for c, frames, _ in conditions_for(look, pedestal, slope)}[blocked] == np.inf


def test_a_pattern_needs_another_site():
    """At one site grain and pixel gains are one; a frame elsewhere tells them apart. Other scatter gets no advice."""
    look = look_of([0.0], [3e-4], 1)
    known = vocabulary()
    pixels, grain, power = (
        account(look, [Present(known[name], known[name].forms[0], values)])
        for name, values in (("fixed_pattern", (0.02, 0.0)), ("speckle", (0.1, 1.0)), ("power_fluctuation", (0.1,)))
    )
    pixels = pixels._replace(component={"pixel": 0.02**2})
    (own,) = advise(look, [pixels, grain])
    assert own.frames == 1
    assert advise(look, [pixels, power]) == []


def test_nothing_is_too_bright(one_angle):
    """Light in the middle of the range: four times the longest exposure would be cut."""
    look, fibre, beam = one_angle
    bright = [c for c in feasible(look) if c.exposure_s > 3e-3]
    assert bright and all(separations(look, fibre, beam, c)[1] for c in bright)


def test_an_exposure_may_be_shorter_than_a_shutter_is_late(one_angle):
    """A quarter of the shortest exposure is none if the shutter opens that late, whichever explanation says so."""
    look, fibre, _ = one_angle
    late = present(look, "shutter_offset", -4e-5)
    short = min(feasible(look), key=lambda condition: condition.exposure_s)
    assert short.exposure_s < 4e-5
    for way in ((fibre, late), (late, fibre)):
        assert separations(look, *way, short) == (0.0, True)
        assert separations(look, *way, None)[0] > 0


def test_frames_are_added_at_sites_that_lack_them():
    """At sites of the angle first, then at new ones; earlier frames keep their readings."""
    case = hidden.draw_case(7, "one:smear:strong", "three_repeats")
    more = hidden.with_more(case, 45.0, 2e-3, 5)
    old, new = more.shots[: len(case.shots)], more.shots[len(case.shots) :]
    assert old == case.shots and [s.repeat for s in new] == [0, 1, 2, 3, 4]
    where = {(s.angle_deg, s.repeat): (s.site, s.x_px, s.y_px) for s in case.shots}
    assert [(s.site, s.x_px, s.y_px) for s in new[:3]] == [where[45.0, r] for r in range(3)]
    assert len({s.site for s in more.shots}) == len({s.site for s in case.shots}) + 2
    first = [next(hidden.frames(own))[1] for own in (case, more)]
    assert np.array_equal(*first)
    with pytest.raises(ValueError, match="no more"):
        hidden.with_more(hidden.draw_case(7, "one:laser_drift:strong"), 0.0, 1e-3, 1)


def test_a_blocked_beam_leaves_the_room():
    """Frames with the beam blocked hold what the room adds and nothing that comes with the light."""
    for kind in ("one:dark_offset:strong", "one:scatter_halo:strong"):
        case = hidden.draw_case(11, kind, "single_frame")
        frames = np.array(hidden.blocked(case, 2e-3, 4), float)
        level = case.truth["effects"][0]["parameters"].get("level", 0.0)
        expected = reading(level, 2e-3, set_of(case).setting.sensor)
        assert np.std([frame.mean() for frame in frames]) > 0
        off = (frames.mean() - expected.mean) / np.sqrt(expected.variance / frames.size)
        # Six standard errors, and what rounding may move a mean of so little noise.
        assert abs(off) < 6
