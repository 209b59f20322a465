"""One frame alone, and sheets that are off: what dark pixels, codes and the sheet's errors let a search say."""

import numpy as np
import pytest

from spotcheck.old_engine.evidence.codes import gathers
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.nuisance.parameters import free_of, free_of_sheet
from spotcheck.old_engine.observe.pixels import Lights, Sheet
from spotcheck.old_engine.search.light import find
from tests.library import small_light
from tests.library.small_light import BLACK, CONTEXT, GAIN, NOISE, SENSOR, designed, drawn, started

STATED = (0.06 * GAIN, 0.1 * NOISE, 0.3)


def effects(*names: str):
    return [vocabulary()[name] for name in names]


def bare(model):
    """A model of the declared light alone."""
    return model._replace(lights=None)


def one(seed: int, **kinds):
    """The brightest frame of a site, its model and its design."""
    images, known = drawn(seed, sites=1, **kinds)
    frames, model = started(images[-1:], known[-1:])
    return frames, bare(model), designed(known).take(np.array([2]))


@pytest.mark.parametrize("level", [0.0, 2.0])
def test_the_level_of_one_frame_is_that_of_its_dark_pixels(level):
    """Beside a learned shape that could be a pedestal itself: named, within four of its errors (6e-5), or nothing."""
    frames, model, design = one(3, pedestal=level)
    tried = effects("dark_offset", "smear", "background_gradient", "scatter_halo")
    found = find(frames, design, model, tried, CONTEXT).found
    assert [own.own.effect.name for own in found] == (["dark_offset"] if level else [])
    for own in found:
        assert own.own.values[0] == pytest.approx(level, abs=4 * own.holding.error) and own.holding.error < 0.1


def test_a_clip_is_told_by_its_code_and_flat_light_is_not():
    """Readings that stop at 400 DN gather and lose their noise; light that is flat up there keeps it."""

    def flat(u, v):
        return np.minimum(small_light.beam(u, v), 0.8)

    for kinds, known, level in (({"clip": 400.0}, True, 400.0), ({"shape": flat}, False, 560.0)):
        frames, model, _ = one(5, **kinds)
        own = Present(vocabulary()["saturation"], "sharp with noise", (level, 0.03))
        model = model._replace(lights=Lights.common(small_light.light_shape.empty(0.3, 5.1), 1))
        fitted = fit(frames, model.with_effect(own), 1.0, steps=16)
        assert gathers(frames, fitted.model, 0) == known


def test_what_a_sheet_leaves_open_is_free_in_every_fit():
    """Numbers with an error and that dark pixels do not tell, behind the effects' own; exact ones never."""
    frames, model, _ = one(1)
    model = model.with_effect(Present(vocabulary()["smear"], "", (0.01,)))
    for free, count in (((True, True, True), 3), ((True, False, False), 1)):
        stated = model._replace(sheet=Sheet(SENSOR, STATED, free))
        assert len(free_of_sheet(stated)) == count
        fitted = fit(frames, stated, 1.0, free_of(stated, CONTEXT), steps=1)
        assert [own.effect for own in fitted.free] == [0] + [-1] * count
    assert free_of_sheet(model) == free_of_sheet(model._replace(sheet=Sheet(SENSOR))) == ()


@pytest.mark.parametrize(("kinds", "names"), [({}, []), ({"clip": 560.0}, ["saturation"])])
def test_a_gain_that_is_off_gives_no_name_and_takes_none(kinds, names):
    """Twelve frames, a gain stated 15 % too low, so that dark pixels have more noise in electrons than is stated: no
    effect beside errors of 6 % and 10 %. A shape so fine takes a sixth of the bright pixels' noise, by which the gain
    is off."""
    images, known = drawn(11, **kinds)
    frames, model = started(images, known)
    sensor = SENSOR._replace(gain_dn_per_e=0.85 * GAIN)
    model = bare(model)._replace(sensor=sensor, sheet=Sheet(sensor, STATED))
    tried = effects("saturation", "excess_read_noise", "dark_offset")
    context = CONTEXT._replace(peak_dn=kinds.get("clip", 679.0) / 0.97)
    outcome = find(frames, designed(known), model, tried, context)
    assert [own.own.effect.name for own in outcome.found] == names
    assert outcome.after.model.sensor.black_level_dn == pytest.approx(BLACK, abs=0.05)
