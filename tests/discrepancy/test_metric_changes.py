"""The paper's metrics of held-out frames that numpy drew, beside those of frames that models simulate."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.findings import MetricChange
from spotcheck.discrepancy.frames import FrameParameters, FrameSet
from spotcheck.discrepancy.metric_changes import compare_metrics
from spotcheck.discrepancy.named_scatter import NamedScatter
from spotcheck.discrepancy.nested_models import ValidatedChain, validate_chain
from spotcheck.discrepancy.validation import FrameScatter, NestedModel, PixelGains, Prediction
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from tests.samples.drawn_frames import (
    P1,
    P2,
    PEAK,
    SENSOR_SIDE,
    Conditions,
    DrawnCamera,
    DrawnFrames,
    DrawnLight,
    draw_frames,
    follow_law,
    lay_out,
)
from tests.samples.models_of_frames import (
    BASELINE,
    DEPARTURES,
    SENSOR,
    apply_effect,
    fit_law,
    frame_set,
    starting_spots,
    true_spots,
)

# Two angles, three exposures and two repeats: 12 frames.
CONDITIONS = lay_out(angles_deg=(0.0, 60.0), repeats=2)
NAMES = ["PSNR", "speckle contrast", "maximum", "sum", "amplitude", "width"]
# Sets of frames over which differences are averaged, and the largest |t| of a mean difference: 1e-4 for 11 degrees of
# freedom, thus 6e-4 for the six metrics of a case.
SETS, LARGEST_T = 12, 5.9

TRUE_LAW = ForwardModel(BASELINE, SENSOR, ExposureLaw(P1, P2, PEAK))
CLIP = apply_effect("saturation", "sharp", level=450.0)
SPECKLE = apply_effect("speckle", "", contrast=0.06, grain=1.5)
ROWS = apply_effect("row_noise", rms=3.0)
BRIGHTNESS = apply_effect("power_fluctuation", rms=0.02)


def predict_truth(frames: FrameSet, spots: FrameParameters, *nested: NestedModel) -> ValidatedChain:
    """Return a chain of models that all predict the same spots."""
    prediction = Prediction(gap=1.0, floor=1.0, deviation=0.1, rms_dn=0.0, score=0.0, spots=spots)
    return ValidatedChain(nested, (prediction,) * len(nested))


def compare_with_truth(
    drawn: DrawnFrames,
    mean: tuple[AppliedEffect, ...] = (),
    scatter: tuple[AppliedEffect, ...] = (),
    seed: int = 0,
) -> dict[str, MetricChange]:
    """Return metrics by name; the models have the true law and spots, the extended one also effects."""
    frames = frame_set(drawn)
    spots = replace(true_spots(drawn), log_peak=np.log(follow_law(drawn.conditions)[0]))
    last = NestedModel("", replace(TRUE_LAW, effects=mean))
    chain = [NestedModel("", TRUE_LAW), last, *(replace(last, added=applied.effect.name) for applied in scatter)]
    named = [NamedScatter(applied, {}, 20.0, ()) for applied in scatter]
    changes = compare_metrics(predict_truth(frames, spots, *chain), frames, named, seed)
    return {change.name: change for change in changes}


def t_values(differences: np.ndarray) -> np.ndarray:
    """Return Student's t of the means of differences [set, …]."""
    return differences.mean(axis=0) / (differences.std(axis=0, ddof=1) / np.sqrt(len(differences)))


def fluctuate(conditions: Conditions, seed: int) -> np.ndarray:
    """Return a factor [frame] on the brightness that scatters by 2 %."""
    return 1 + 0.02 * np.random.default_rng(1000 + seed).standard_normal(len(conditions))


# What is drawn: light, camera, whether the brightness scatters, effects of the mean image, effects that scatter, and
# the metrics in which the declared model must differ from the frames.
CASES = {
    "plain": (DrawnLight(), DrawnCamera(), False, (), (), ()),
    "clip": (DrawnLight(), DrawnCamera(clip_dn=450.0), False, (CLIP,), (), ("maximum", "sum", "amplitude", "width")),
    "speckle": (DrawnLight(speckle_contrast=0.06, grain_px=1.5), DrawnCamera(), False, (), (SPECKLE,), ("PSNR",)),
    "rows": (DrawnLight(), DrawnCamera(row_dn=3.0), False, (), (ROWS,), ("PSNR",)),
    "brightness": (DrawnLight(), DrawnCamera(), True, (), (BRIGHTNESS,), ()),
}


@pytest.mark.parametrize("name", CASES)
def test_the_true_model_has_the_metrics_of_the_frames(name: str):
    """Over sets of frames all six metrics of the extended model agree with the measured ones, as it is the true one."""
    light, camera, has_scatter, mean, scatter, changed = CASES[name]
    rows = []
    for seed in range(SETS):
        factor = fluctuate(CONDITIONS, seed) if has_scatter else 1.0
        drawn = draw_frames(seed, CONDITIONS, light, camera, factor)
        changes = compare_with_truth(drawn, mean, scatter, seed)
        assert list(changes) == NAMES
        rows.append([[c.declared - c.measured, c.extended - c.measured] for c in changes.values()])
    declared, extended = np.moveaxis(t_values(np.array(rows)), 1, 0)
    assert np.abs(extended).max() < LARGEST_T
    assert all(abs(declared[NAMES.index(metric)]) > LARGEST_T for metric in changed)


# The whole chain, fitted.


def compare_fitted(drawn: DrawnFrames) -> dict[str, MetricChange]:
    """Return the metrics on held-out frames of models that were fitted to the others: without and with a clip."""
    is_unseen = frame_set(drawn).held_out()
    fitted, unseen = drawn.select(np.flatnonzero(~is_unseen)), np.flatnonzero(is_unseen)
    frames = frame_set(drawn).select(unseen)
    chain = [NestedModel("", fit_law(fitted)), NestedModel("saturation", fit_law(fitted, [DEPARTURES["clip"].start]))]
    validated = validate_chain(chain, frames, starting_spots(drawn).select(unseen))
    return {change.name: change for change in compare_metrics(validated, frames, ())}


def test_the_clip_brings_the_metrics_nearer():
    """With the clip that was fitted, metrics of held-out frames are nearer to the measured ones than without."""
    drawn = draw_frames(41, lay_out(angles_deg=(0.0, 60.0), repeats=6), camera=DrawnCamera(clip_dn=450.0))
    changes = compare_fitted(drawn)
    assert list(changes) == NAMES
    for name in ("maximum", "sum", "amplitude", "width"):
        change = changes[name]
        assert abs(change.extended - change.measured) < abs(change.declared - change.measured)


# Gains, masks and missing values.


def plain_frames() -> tuple[FrameSet, FrameParameters]:
    """Return plain frames and their spots."""
    drawn = draw_frames(5, CONDITIONS)
    return frame_set(drawn), true_spots(drawn)


def by_name(changes: tuple[MetricChange, ...]) -> dict[str, MetricChange]:
    """Return metrics by name."""
    return {change.name: change for change in changes}


def test_gains_of_pixels_are_those_that_were_estimated():
    """Gains of 1.1 for all pixels of the sensor raise the amplitude by 10 %; the declared model has none."""
    frames, spots = plain_frames()
    side = (SENSOR_SIDE, SENSOR_SIDE)
    gains = PixelGains(np.full(side, 0.1), np.full(side, 1e-6), 1e-6, top=0, left=0)
    extended = NestedModel("fixed_pattern", TRUE_LAW, FrameScatter(gains=gains))
    drawn = apply_effect("fixed_pattern", prnu=0.5, hot_pixels=0.0)
    validated = predict_truth(frames, spots, NestedModel("", TRUE_LAW), extended)
    amplitude = by_name(compare_metrics(validated, frames, [NamedScatter(drawn, {}, 20.0, ())]))["amplitude"]
    # Amplitudes of 12 frames are known to 0.2 % each: 0.4 % are 5 standard errors of the ratio.
    assert amplitude.extended / amplitude.declared == pytest.approx(1.1, rel=4e-3)


def test_only_named_scatter_of_the_chain_is_drawn():
    """Scatter with a reason against it, or that is not in the chain, leaves the simulated frames as they are."""
    frames, spots = plain_frames()
    validated = predict_truth(frames, spots, NestedModel("", TRUE_LAW), NestedModel("speckle", TRUE_LAW))
    refused = [NamedScatter(SPECKLE, {}, 20.0, ("not white",)), NamedScatter(ROWS, {}, 20.0, ())]
    changes = compare_metrics(validated, frames, refused)
    assert all(change.declared == change.extended for change in changes)


def test_masked_pixels_take_no_part():
    """Masked pixels count in neither frame: without four dark columns the sum lacks their black level."""
    frames, spots = plain_frames()
    readings = frames.readings.copy()
    readings[:, :, :4] = np.nan
    validated = predict_truth(frames, spots, NestedModel("", TRUE_LAW))
    whole = by_name(compare_metrics(validated, frames, ()))
    masked = by_name(compare_metrics(validated, replace(frames, readings=readings), ()))
    assert list(masked) == NAMES
    for source in ("measured", "declared", "extended"):
        lost = getattr(whole["sum"], source) - getattr(masked["sum"], source)
        # The left 4 of 72 columns are dark: 288 pixels of 12 DN with a noise of 0.8 DN and less than 1 DN of light.
        assert lost == pytest.approx(4 * 72 * 12.0, rel=0.03)


def test_frames_without_a_prediction_are_left_out():
    """A frame whose predicted spot is no number is left out; nothing is reported without any frame."""
    frames, spots = plain_frames()
    log_peak = spots.log_peak.copy()
    log_peak[0] = np.nan
    models = (NestedModel("", TRUE_LAW), NestedModel("speckle", TRUE_LAW))
    some = compare_metrics(predict_truth(frames, replace(spots, log_peak=log_peak), *models), frames, ())
    rest = np.arange(1, len(frames))
    others = compare_metrics(predict_truth(frames.select(rest), spots.select(rest), *models), frames.select(rest), ())
    assert some == others and len(some) == 6
    nowhere = replace(spots, log_peak=np.full(len(frames), np.nan))
    assert compare_metrics(predict_truth(frames, nowhere, *models), frames, ()) == ()


def test_the_psnr_needs_repeats():
    """Without a repeat at the same angle there is no PSNR between measured frames, and none is reported."""
    frames, spots = plain_frames()
    single = np.flatnonzero(frames.design.repeat == 0)
    validated = predict_truth(frames.select(single), spots.select(single), NestedModel("", TRUE_LAW))
    changes = compare_metrics(validated, frames.select(single), ())
    assert [change.name for change in changes] == NAMES[1:]


def test_a_spot_that_moves_between_repeats_leaves_the_psnr():
    """The PSNR of plain frames is that of their noise: 10 lg(full scale²/2 variance), though spots lie apart."""
    frames, spots = plain_frames()
    longest = np.flatnonzero(frames.design.condition == 2)
    alone = predict_truth(frames.select(longest), spots.select(longest), NestedModel("", TRUE_LAW))
    psnr = by_name(compare_metrics(alone, frames.select(longest), ()))["PSNR"]
    sigma_px = float(np.exp(spots.log_sigma[longest[0]]))
    # Read noise, rounding and, averaged over the 72² pixels of a crop, shot noise K µ [DN²].
    variance = (0.11 * 6.0) ** 2 + 1 / 12 + 0.11 * PEAK * 2 * np.pi * sigma_px**2 / 72**2
    # A mean square, of whose 5184 pixels shot noise fills about 300, has a relative error of 6 %: 0.2 dB for two pairs.
    assert psnr.measured == pytest.approx(10 * np.log10(1023.0**2 / (2 * variance)), abs=0.8)
    assert psnr.measured == pytest.approx(psnr.declared, abs=0.8)
