"""Stripes whose phase is new at each site, on frames that numpy drew."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.candidates import changes_mean_image
from spotcheck.discrepancy.evidence import compare_cells
from spotcheck.discrepancy.joint_fit import fit_jointly
from spotcheck.discrepancy.selection import select_effects
from spotcheck.discrepancy.site_draws import start_draws
from spotcheck.discrepancy.validation import NestedModel, predict_frames
from spotcheck.model.effects import vocabulary
from spotcheck.model.light import ExposureLaw
from tests.samples import drawn_frames
from tests.samples.drawn_frames import DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import SCALES, apply_effect, fit_drawn, frame_set

DEPTH, PERIOD_PX, DIRECTION_DEG = 0.04, 9.0, 30.0
# A wave of the residuals about as near as the peak of a spectrum finds it.
NEAR = replace(SCALES, waves=((9.15, 31.0),))
# Bound on the distance of one estimate from its truth in standard errors: two-sided 6.8e-6 for a normal estimate.
LARGEST_Z = 4.5


def draw_striped(seed: int, repeats: int = 1, has_new_stripes: bool = True) -> drawn_frames.DrawnFrames:
    """Return frames of four angles with stripes."""
    light = DrawnLight(stripes=(DEPTH, PERIOD_PX, DIRECTION_DEG), has_new_stripes=has_new_stripes)
    return draw_frames(seed, lay_out(repeats=repeats), light)


@pytest.mark.parametrize(("has_new_stripes", "variant"), [(True, "site"), (False, "sensor")])
def test_stripes_are_named_with_the_reference_of_their_phase(has_new_stripes: bool, variant: str):
    """Stripes are found beside all other effects, and the phases of sites are spared where one phase is enough."""
    effects = [effect for effect in vocabulary().values() if changes_mean_image(effect)]
    fit = select_effects(fit_drawn(draw_striped(41, has_new_stripes=has_new_stripes)), effects, NEAR).fit
    (applied,) = fit.model.forward.effects
    assert (applied.effect.name, applied.variant.value) == ("interference_fringes", variant)
    assert fit.has_converged
    truth = {"d": DEPTH, "period": PERIOD_PX, "direction": DIRECTION_DEG}
    errors = np.sqrt(np.diag(np.linalg.inv(fit.equations.information)))[-len(fit.model.free) :]
    for parameter, error in zip(fit.model.free, errors, strict=True):
        if parameter.name in truth:
            # Directions that differ by half a turn are those of the same stripes.
            difference = fit.model.value_of(parameter) - truth[parameter.name]
            difference = (difference + 90) % 180 - 90 if parameter.name == "direction" else difference
            assert abs(difference) < LARGEST_Z * error, parameter.name


def test_frames_of_new_sites_are_predicted_with_phases_of_their_own():
    """Without the stripes held-out frames keep a gap; with them it is that of noise."""
    effects = [effect for effect in vocabulary().values() if effect.name == "interference_fringes"]
    fit = select_effects(fit_drawn(draw_striped(42)), effects, NEAR).fit
    unseen = draw_striped(43)
    law = ExposureLaw(drawn_frames.P1, drawn_frames.P2 - fit.model.forward.baseline.laser_px, drawn_frames.PEAK)
    start = fit_drawn(unseen).model.spots
    with_stripes = replace(fit.model.forward, law=law)
    striped, plain = (
        predict_frames(NestedModel("", forward), frame_set(unseen), start)
        for forward in (with_stripes, replace(with_stripes, effects=()))
    )
    assert plain.open_z > LARGEST_Z > striped.open_z


@pytest.mark.parametrize("is_new_in_frames", [False, True])
def test_frames_of_a_site_must_agree_about_the_phase(is_new_in_frames: bool):
    """Stripes whose phase is new in every frame are inconsistent with stripes that are drawn at sites."""
    conditions = lay_out(repeats=1)
    drawn_at = replace(conditions, site=np.arange(len(conditions))) if is_new_in_frames else conditions
    light = DrawnLight(stripes=(DEPTH, PERIOD_PX, DIRECTION_DEG))
    drawn = replace(draw_frames(44, drawn_at, light), conditions=conditions)
    plain = fit_drawn(drawn)
    start = apply_effect("interference_fringes", "site", d=DEPTH, period=PERIOD_PX, direction=DIRECTION_DEG)
    fit = fit_jointly(start_draws(plain.model.with_effect(start, NEAR), plain.pixels), plain.pixels)
    cells = compare_cells(fit, "interference_fringes")
    # The chance of a false alarm is that of χ² beyond 8 standard deviations, less than 1e-9.
    assert (cells.q > cells.limit(plain.deviance - fit.deviance)) == is_new_in_frames
