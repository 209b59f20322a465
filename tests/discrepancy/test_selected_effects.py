"""Selection of the effects of the mean image: on frames that numpy drew with one of them, and without any."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy import selection as selection_module
from spotcheck.discrepancy.candidates import changes_mean_image, list_starts, screen_candidates
from spotcheck.discrepancy.frames import thin_pixels
from spotcheck.discrepancy.selection import (
    SelectedEffects,
    SelectionStep,
    add_best_effect,
    eliminate_backward,
    replace_removed,
    select_effects,
    select_forward,
)
from spotcheck.model.effects import vocabulary
from spotcheck.model.effects.saturation import Variant
from tests.samples import drawn_frames, models_of_frames
from tests.samples.drawn_frames import DrawnCamera, DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import DEPARTURES, apply_effect, fit_drawn

# Bound on the distance of one estimate from its truth in standard errors: two-sided 6.8e-6 for a normal estimate.
LARGEST_Z = 4.5
# Pixels on which candidates are ranked: these small frames have 17 000. Of subsets of 8 000 one in 14 holds too few of
# the pixels behind the clip, of which there are a handful.
RANKED_PIXELS = 11_000
# Factor on the brightness: tables of readings up to 512 DN take half the time of those up to 1024 DN.
PEAK_FACTOR = 0.7
# Level of a soft limit [DN]: 1.05 times the brightest spots.
SOFT_LEVEL = 1.05 * PEAK_FACTOR * drawn_frames.PEAK
SCALES = replace(models_of_frames.SCALES, peak_dn=PEAK_FACTOR * drawn_frames.PEAK)


@pytest.fixture(autouse=True)
def rank_on_fewer_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rank candidates on a part of the pixels, as in frames of the usual size."""
    monkeypatch.setattr(selection_module, "thin_pixels", lambda pixels: thin_pixels(pixels, RANKED_PIXELS))


def select_on_drawn(light: DrawnLight, camera: DrawnCamera) -> SelectedEffects:
    """Return what is selected from all effects of the mean image on 6 drawn frames, beside the declared light shape or
    a free one."""
    drawn = draw_frames(32, lay_out(angles_deg=(0.0, 60.0), repeats=1), light, camera, PEAK_FACTOR)
    effects = [effect for effect in vocabulary().values() if changes_mean_image(effect)]
    return select_effects(fit_drawn(drawn), effects, SCALES)


@pytest.mark.parametrize("name", DEPARTURES)
def test_selection_finds_the_effect_and_no_other(name: str):
    """Of all effects of the mean image exactly the one that was drawn is selected, with its values."""
    departure = DEPARTURES[name]
    selected = select_on_drawn(departure.light, departure.camera)
    effect = departure.start.effect.name
    model = selected.fit.model
    assert model.effect_names == (effect,)
    assert list(selected.tests) == [effect] and selected.tests[effect].passes
    assert selected.fit.has_converged
    for index, parameter in enumerate(model.free):
        if parameter.effect:
            error = np.sqrt(selected.covariance[index, index])
            assert abs(model.value_of(parameter) - departure.truth[parameter.name]) < LARGEST_Z * error


def test_selection_ends_where_cells_disagree(monkeypatch: pytest.MonkeyPatch):
    """Two frames that are dimmer on one side have no effect of the vocabulary. The first that gains most is a matter of
    few cells, so that nothing is built on it."""
    drawn = draw_frames(32, lay_out(angles_deg=(0.0, 60.0), repeats=1), DrawnLight(), DrawnCamera(), PEAK_FACTOR)
    readings, half = drawn.readings.copy(), drawn.readings.shape[2] // 2
    readings[:2, :, :half] = np.rint(0.8 * readings[:2, :, :half])
    best = []

    def record_best(*arguments):
        best.append(add_best_effect(*arguments))
        return best[-1]

    monkeypatch.setattr(selection_module, "add_best_effect", record_best)
    fit, effects = fit_drawn(replace(drawn, readings=readings)), list(filter(changes_mean_image, vocabulary().values()))
    # The path ends with the fit without effects, although an effect gains enough.
    (step,) = select_forward(fit, effects, SCALES, lambda fit: fit)
    assert step.fit is fit and best[-1] is not None


def test_selection_finds_nothing_on_plain_frames():
    """Frames without an effect keep the model without effects.

    An effect is taken from a drop of −2 ln L by 25 on: 6e-7 for one start with one parameter, and some 1e-4 for the
    largest of about a hundred starts.
    """
    selected = select_on_drawn(DrawnLight(), DrawnCamera())
    assert selected.fit.model.effect_names == () and selected.tests == {}
    # The read noise alone is fitted.
    assert selected.covariance.shape == (1, 1)


def draw_soft_limit() -> DrawnFrames:
    """Frames of a camera whose readings follow x/(1 + (x/`SOFT_LEVEL`)¹²)^(1/12), rounded."""
    drawn = draw_frames(32, lay_out(angles_deg=(0.0, 60.0), repeats=1), peak_factor=PEAK_FACTOR)
    signal = np.maximum(drawn.readings - drawn_frames.BLACK, 0.0)
    noise = np.minimum(drawn.readings - drawn_frames.BLACK, 0.0)
    limited = signal / (1 + (signal / SOFT_LEVEL) ** 12) ** (1 / 12)
    return replace(drawn, readings=np.rint(drawn_frames.BLACK + limited + noise))


def test_a_soft_limit_begins_above_the_brightest_reading():
    """Of the starts of a variant that is a clip, the one whose change fits as it is takes part. A limit at the
    brightest reading or below cannot be a soft one."""
    fit = fit_drawn(draw_soft_limit())
    candidates = screen_candidates(fit, list_starts([vocabulary()["saturation"]], SCALES))
    start_of_variant = {candidate.start.variant: candidate.start for candidate in candidates}
    assert len(start_of_variant) == len(candidates)
    assert start_of_variant[Variant.POWER_WITH_NOISE].parameters["level"] == pytest.approx(1.1 * SCALES.peak_dn)


def test_another_effect_is_sought_in_place_of_a_removed_one():
    """A bend in the place of a clip fails its test. Of the effects without the bend, the clip is then selected."""
    clip = DEPARTURES["clip"]
    drawn = draw_frames(32, lay_out(angles_deg=(0.0, 60.0), repeats=1), clip.light, clip.camera, PEAK_FACTOR)
    with_bend = fit_drawn(drawn, apply_effect("nonlinearity", q=0.02))
    path = [SelectionStep(with_bend, np.nan)]
    selected = eliminate_backward(path, SCALES)
    assert not selected.tests
    effects = [vocabulary()[name] for name in ("nonlinearity", "saturation")]
    assert list(replace_removed(selected, path, effects, SCALES, lambda fit: fit).tests) == ["saturation"]
