"""Advice on the next measurement: worth of frames against brute force, and that the advised frames separate a pair."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.advice import (
    MOST_FRAMES,
    FrameWorth,
    PresentFits,
    advise,
    choose_condition,
    compare_images,
    compare_laws,
    list_conditions,
)
from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.discrepancy.findings import NamedEffect
from spotcheck.model.effects import vocabulary
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import Conditions, DrawnLight, draw_frames, draw_numbers, lay_out
from tests.samples.models_of_frames import (
    LONGEST_S,
    SCALES,
    apply_effect,
    design_of,
    fit_drawn,
    search_of,
)

EFFECTS = vocabulary()
# Uniform light under the drawn spots [DN].
PEDESTAL = 0.8
# Scatter of the brightness from frame to frame.
FRAME_SCATTER = 0.005


def named(applied, **rivals: float) -> NamedEffect:
    """Return a named effect with rivals."""
    return NamedEffect(applied, {}, gain=100.0, z=10.0, rivals=rivals)


# Worth of frames


def test_growth_is_that_of_a_refit():
    """Growth by n frames: brute-force least squares of the rival's parameters, with their present information."""
    rng = np.random.default_rng(1)
    columns, residual = rng.standard_normal((2, 30)), rng.standard_normal(30)
    known = np.diag([5.0, 50.0])
    worth = FrameWorth(float(residual @ residual), columns @ residual, columns @ columns.T)
    for frames in (1, 4, 50):
        design = np.vstack([np.tile(columns.T, (frames, 1)), np.sqrt(known)])
        target = np.concatenate([np.tile(residual, frames), np.zeros(2)])
        left = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
        assert worth.growth(frames, known) == pytest.approx(left @ left)
    number = worth.frames_needed(known)
    assert worth.growth(number, known) >= MIN_GAIN > worth.growth(number - 1, known)


def test_no_advice_without_a_difference():
    """Frames that both models predict alike separate nothing, and no condition is chosen."""
    same = FrameWorth(0.0, np.zeros(1), np.eye(1))
    assert same.frames_needed(np.eye(1)) > MOST_FRAMES
    assert choose_condition([{"exposure_s": 1e-4}], lambda condition: same, np.eye(1)) is None
    assert choose_condition([{"exposure_s": 1e-4}], lambda condition: None, np.eye(1)) is None


def test_candidate_conditions():
    """Exposures and angles lie between and beyond the present ones; the beam may be blocked."""
    conditions = list_conditions(design_of(lay_out()))
    exposures = [condition["exposure_s"] for condition in conditions]
    assert min(exposures) == pytest.approx(1e-4 / 4) and max(exposures) == pytest.approx(4 * LONGEST_S)
    angles = [condition["angle_deg"] for condition in conditions if "angle_deg" in condition]
    np.testing.assert_allclose(angles, [22.5, 67.5, 112.5, 157.5, 180.0])
    assert conditions[-1] == {"exposure_s": LONGEST_S, "blocked": True}
    one_frame = design_of(lay_out(exposures_s=(9e-4,), angles_deg=(0.0,), repeats=1))
    assert conditions[-1] in list_conditions(one_frame)


# Effects of the mean image


def test_a_blocked_beam_tells_a_pedestal_from_a_halo():
    """A dark frame reads the pedestal, of which a halo of the spot has nothing: each pixel is worth level²/variance."""
    drawn = draw_frames(3, lay_out(angles_deg=(0.0,), repeats=1), DrawnLight(pedestal_dn=PEDESTAL))
    fit = fit_drawn(drawn, apply_effect("dark_offset", "light", level=1.0))
    present = PresentFits(fit, SCALES)
    worth_of, known = compare_images("dark_offset", EFFECTS["scatter_halo"], present)
    worth = worth_of({"exposure_s": LONGEST_S, "blocked": True})
    pixels = fit.pixels.is_used[-1].sum()
    level = fit.model.effect_named("dark_offset").values[0]
    variance = (drawing.GAIN * fit.model.forward.sensor.read_noise_e) ** 2 + drawing.GAIN * level + 1 / 12
    assert worth.square == pytest.approx(pixels * level**2 / variance, rel=0.02)
    (advice,) = advise([named(fit.model.forward.effects[0], scatter_halo=3.0)], list(EFFECTS.values()), present)
    assert advice.separates == ("dark_offset", "scatter_halo") and advice.frames == 1
    assert advice.frames == min(worth_of(condition).frames_needed(known)
                                for condition in list_conditions(fit.model.design) if worth_of(condition))  # fmt: skip


def test_frames_that_would_clip_are_not_asked_for():
    """Four times the longest exposure is beyond full scale."""
    drawn = draw_frames(3, lay_out(angles_deg=(0.0,), repeats=1), DrawnLight(pedestal_dn=PEDESTAL))
    fit = fit_drawn(drawn, apply_effect("dark_offset", "light", level=1.0))
    worth_of, _ = compare_images("dark_offset", EFFECTS["scatter_halo"], PresentFits(fit, SCALES))
    assert worth_of({"exposure_s": 4 * LONGEST_S}) is None
    assert worth_of({"exposure_s": LONGEST_S / 2}).square > 0


def test_advice_only_for_rivals():
    """Effects without rivals need no measurement; rivals of another kind cannot be compared."""
    fit = fit_drawn(draw_frames(3, lay_out(angles_deg=(0.0,), repeats=1)))
    pedestal = apply_effect("dark_offset", "light", level=1.0)
    effects = [named(pedestal), named(pedestal, laser_drift=1.0), named(apply_effect("row_noise", rms=0.1), smear=1.0)]
    assert advise(effects, list(EFFECTS.values()), PresentFits(fit, SCALES)) == ()


# Laws


def ordered_by_exposure() -> Conditions:
    """Return conditions whose exposures were taken one after the other, so that a drift looks like a power."""
    conditions = lay_out(angles_deg=(0.0, 60.0, 120.0), repeats=2)
    rank = np.argsort(np.argsort(np.log(conditions.exposure_s) + 1e-3 * np.arange(len(conditions))))
    return replace(conditions, order=rank / (len(conditions) - 1))


def grow_by_power(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] on the brightness that is the power 0.02 of the exposure."""
    return (conditions.exposure_s / LONGEST_S) ** 0.02


def with_more_frames(conditions: Conditions, exposure_s: float, frames: int) -> Conditions:
    """Return conditions with more frames after all others, each at a site of its own."""
    sites = conditions.site.max() + 1 + np.arange(frames)
    more = {"exposure_s": exposure_s, "angle": 0.0, "order": 1.0, "repeat": 9, "site": sites, "condition": 9}
    return Conditions(**{name: np.append(values, np.broadcast_to(more[name], frames))
                         for name, values in vars(conditions).items()})  # fmt: skip


def test_frames_tell_a_power_from_a_drift_as_foretold():
    """Frames of a condition that is worth some of them raise −2 ln L of the wrong law by what is foretold."""
    conditions, exposure_s = ordered_by_exposure(), float(np.sqrt(3e-4 * 9e-4))
    first, second = EFFECTS["photon_budget"], EFFECTS["laser_drift"]
    longer = with_more_frames(conditions, exposure_s, 6)
    foretold, gained = [], []
    for seed in range(12):
        search = search_of(draw_numbers(seed, conditions, grow_by_power(conditions), FRAME_SCATTER))
        laws = search.fit([first])
        worth_of, known = compare_laws(first, second, PresentFits(None, SCALES, search, laws))
        foretold.append(worth_of({"exposure_s": exposure_s}).growth(6, known))
        after = search_of(draw_numbers(100 + seed, longer, grow_by_power(longer), FRAME_SCATTER))
        gained.append(after.fit([second]).chi2 - after.fit([first]).chi2 - search.fit([second]).chi2 + laws.chi2)
    # Each difference scatters by about 2 √gain = 10 to 15, their mean over 12 sets by 4.
    assert np.mean(gained) == pytest.approx(np.mean(foretold), rel=0.5)


def test_the_advised_frame_tells_a_power_from_a_drift():
    """Short exposures after all others, at which the drift and the power disagree."""
    conditions = ordered_by_exposure()
    search = search_of(draw_numbers(1, conditions, grow_by_power(conditions), FRAME_SCATTER))
    laws = search.fit([EFFECTS["photon_budget"]])
    fit = fit_drawn(draw_frames(1, conditions))
    present = PresentFits(fit, SCALES, search, laws)
    (advice,) = advise([named(laws.effects[0], laser_drift=5.0)], list(EFFECTS.values()), present)
    assert advice.separates == ("photon_budget", "laser_drift")
    assert advice.condition["exposure_s"] < 1e-4 and advice.frames == 1
