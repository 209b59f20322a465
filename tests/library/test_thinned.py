"""Frames of which every second row and column is looked at: lengths and places are those of the sensor all the same."""

import numpy as np
import pytest

from spotcheck.old_engine.conclude.detect import looked_at
from spotcheck.old_engine.conclude.judge import judge
from spotcheck.old_engine.evidence.patterns import gathered, shared, variance_of
from spotcheck.old_engine.evidence.pixels import Ready
from spotcheck.old_engine.evidence.stripes import stripes_of
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.observe.frames import MOST_PIXELS, Setting, observed, thinned, whole
from spotcheck.old_engine.observe.shots import Shot
from spotcheck.old_engine.verdict.document import document
from tests.library.small_light import CONTEXT, FULL, GAIN, NOISE, PENALTY, SENSOR, designed, drawn, gaussian, started

STEP = 2


def thin(seed: int, **kinds):
    """Thinned frames, their design and a fit of round spots."""
    images, known = drawn(seed, sites=6, shape=gaussian, **kinds)
    frames, model = started(images, known)
    frames = [thinned(frame, STEP) for frame in frames]
    return frames, designed(known), fit(frames, model._replace(lights=None), PENALTY)


def test_rows_and_columns_are_those_that_the_step_divides():
    """Crops that begin anywhere share the sensor's pixels, each with the reading that it had."""
    images, known = drawn(1, sites=1)
    (frame, *_), _ = started(images, known)
    for left in range(4):
        view = frame.view._replace(x=frame.view.x + left, y=frame.view.y + 5)
        own = thinned(frame._replace(view=view), 3)
        x, y = own.view.x.ravel().astype(int), own.view.y.ravel().astype(int)
        assert (x % 3 == 0).all() and (y % 3 == 0).all() and own.step == 3
        assert (x.size, y.size) == own.pixels.shape[::-1] and x.size in (24, 25)
        np.testing.assert_array_equal(own.pixels, frame.pixels[np.ix_(y - 5, x - left)])


def test_stripes_have_their_period_and_place():
    """Period within 1 %, direction within 1°, at each site anew."""
    frames, design, fitted = thin(3, stripes=(0.05, 11.0, 30.0), stay="site")
    sites, _ = gathered(frames, design, Ready(frames, fitted, []))
    found = stripes_of(sites, CONTEXT.sigma_px)
    assert found.gain > 50
    assert found.period == pytest.approx(11.0, rel=0.01) and found.direction % 180 == pytest.approx(30.0, abs=1.0)


def test_a_field_has_its_grain_and_contrast():
    """Grain within 10 %; the variance within four errors of what was drawn (a false alarm once in 1e4)."""
    frames, design, fitted = thin(2, speckle=(0.1, 3.0))
    sites, _ = gathered(frames, design, Ready(frames, fitted, []))
    told = variance_of(shared(sites), 0.0, 4.0)
    assert sites[0].grain == pytest.approx(3.0, rel=0.1)
    assert told.value == pytest.approx(0.01, abs=4 * told.error)


def test_an_odd_pixel_has_its_place():
    """A pixel of 60 DN too much in all frames is told by its row and column on the sensor."""
    images, known = drawn(4, sites=4, shape=gaussian)
    images[:, 20, 46] += 60
    frames, model = started(images, known)
    frames = [thinned(frame, STEP) for frame in frames]
    _, found = looked_at(frames, fit(frames, model._replace(lights=None), PENALTY).model, designed(known))
    assert any("row 20, column 46" in part.where for part in found.parts)


@pytest.mark.slow
def test_a_wide_spot_on_many_pixels_is_judged_by_some_of_them():
    """Six frames of 400² px and σ 40 px, clipped at 500 DN of signal: every second row and column, and the level all
    the same, within four errors and what noise before a clip moves (0.3 %)."""
    side, sigma, clip = 400, 40.0, 500.0
    rng, (y, x) = np.random.default_rng(8), np.mgrid[:side, :side].astype(float)
    shots = []
    for k in range(6):
        x0, y0 = side / 2 + rng.uniform(-2, 2, 2)
        light = 700.0 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))
        electrons = rng.poisson(light / GAIN) + NOISE * rng.standard_normal(x.shape)
        pixels = np.clip(np.rint(np.minimum(GAIN * electrons, clip) + SENSOR.black_level_dn), 0, FULL)
        shots.append(Shot(0.0, 1e-3, k, k, (), 7, 4, lambda pixels=pixels: pixels))
    setting = Setting(Baseline(0.0, "linear", False, 1e-3), SENSOR, (0.0, 0.0, 0.0), 420, 420)
    # Of six repeats four are searched.
    assert 4 * side**2 > MOST_PIXELS and observed(shots, setting).frames[0].step == STEP
    # What stands beside measured frames has all their pixels.
    assert {own.pixels.shape for own in whole(shots, setting).frames} == {(side, side)}
    found = judge(shots, setting, list(vocabulary().values()))
    assert document(found, "wide")["detection"]["every_px"] == STEP
    own = {one.own.effect.name: one for one in found.found}
    assert "saturation" in own
    assert own["saturation"].own.values[0] == pytest.approx(
        clip, abs=4 * own["saturation"].holding.error + 0.003 * clip
    )
