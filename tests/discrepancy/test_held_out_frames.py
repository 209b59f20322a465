"""Which frames are held out, and how well models predict them, on frames that numpy drew."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from spotcheck.discrepancy.frames import FrameParameters, FrameSet
from spotcheck.discrepancy.nested_models import ValidatedChain
from spotcheck.discrepancy.validation import FrameScatter, NestedModel, Prediction, predict_frames
from spotcheck.model.conditions import FrameConditions, PixelGrid
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from tests.samples.drawn_frames import Conditions, DrawnCamera, DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import (
    BASELINE,
    DEPARTURES,
    SENSOR,
    fit_law,
    frame_set,
    starting_spots,
)

# Two angles, three exposures and six repeats: 24 frames to fit, 12 held out.
CONDITIONS = lay_out(angles_deg=(0.0, 60.0), repeats=6)
# Bound on the gap of a right model in its standard deviations: 6e-5 for a normal gap.
LARGEST_Z = 4.0
# Standard deviations by which the gap of a wrong model exceeds 1: the departures of these tests give 17 and more.
LEAST_EXCESS = 10.0


# Which frames are held out.


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (range(3), set()),
        (range(5), set()),
        (range(6), {2, 5}),
        (range(9), {2, 5, 8}),
        ((10, 11, 15, 20, 30, 31, 40), {15, 31}),
    ],
    ids=["three", "five", "six", "nine", "gaps between labels"],
)
def test_every_third_repeat_is_held_out(labels, expected: set[int]):
    """Of six or more repeats the third, the sixth and so on are held out, with all their frames."""
    drawn = draw_frames(1, lay_out(exposures_s=(9e-4,), angles_deg=(0.0, 60.0), repeats=len(labels)))
    frames = frame_set(drawn)
    repeat = np.array(labels)[frames.design.repeat]
    held = replace(frames, design=replace(frames.design, repeat=repeat)).held_out()
    np.testing.assert_array_equal(held, np.isin(repeat, list(expected)))


# How well they are predicted.


def split_frames(drawn: DrawnFrames) -> tuple[DrawnFrames, FrameSet, FrameParameters]:
    """Return the frames to fit, the frames that are held out, and where the fit of their centres starts."""
    held = frame_set(drawn).held_out()
    unseen = np.flatnonzero(held)
    return drawn.select(np.flatnonzero(~held)), frame_set(drawn).select(unseen), starting_spots(drawn).select(unseen)


def predict(drawn: DrawnFrames, effects: tuple[AppliedEffect, ...] = (), laws: tuple[str, ...] = ()) -> Prediction:
    """Return how well a model that was fitted to two thirds of the frames predicts the others."""
    fitted, frames, start = split_frames(drawn)
    return predict_frames(NestedModel("", fit_law(fitted, effects, laws)), frames, start)


def is_right(prediction: Prediction) -> bool:
    """Return whether a gap is that of noise alone."""
    return abs(prediction.gap - prediction.floor) < LARGEST_Z * prediction.deviation


def is_wrong(prediction: Prediction) -> bool:
    """Return whether a gap is well above that of noise alone."""
    return prediction.gap - prediction.floor > LEAST_EXCESS * prediction.deviation and prediction.left_open > 0


@cache
def plain_case() -> tuple[NestedModel, FrameSet, FrameParameters, Prediction]:
    """Return the model that was fitted to plain frames, the frames that are held out, and their prediction."""
    fitted, frames, start = split_frames(draw_frames(1, CONDITIONS))
    model = NestedModel("", fit_law(fitted))
    return model, frames, start, predict_frames(model, frames, start)


def test_the_gap_of_the_right_model_is_one():
    """Over 12 sets of plain frames the gap is 1 but for noise, with the deviation that it states."""
    z = []
    for seed in range(60, 72):
        prediction = predict(draw_frames(seed, CONDITIONS))
        assert is_right(prediction)
        z.append((prediction.gap - 1) / prediction.deviation)
    # About 290 blocks, of which the 8 coordinates of the four centres take 8: z is −0.33 on average. False-alarm rate
    # of the mean 6e-5, and 1e-4 for χ² of 12 on either side.
    assert abs(np.mean(z) + 0.33) < LARGEST_Z / np.sqrt(len(z))
    assert 1.9 < np.sum(np.square(np.array(z) + 0.33)) < 40


@pytest.mark.parametrize("name", DEPARTURES)
def test_effects_close_the_gap(name: str):
    """The gap is wide open without the effect that was drawn, and closed by it."""
    departure = DEPARTURES[name]
    drawn = draw_frames(41, CONDITIONS, departure.light, departure.camera)
    without, with_effect = predict(drawn), predict(drawn, (departure.start,))
    assert is_wrong(without) and is_right(with_effect)
    assert with_effect.score < without.score and with_effect.rms_dn < without.rms_dn
    # What noise leaves of the gap is 2 deviations at most, of at least 10 that were open.
    name = departure.start.effect.name
    chain = (NestedModel("", ForwardModel(BASELINE, SENSOR)), NestedModel(name, ForwardModel(BASELINE, SENSOR)))
    validated = ValidatedChain(chain, (without, with_effect))
    assert 0.8 < validated.closed <= 1 and validated.share_of(name) == pytest.approx(validated.closed)
    assert validated.refuted() == () and ValidatedChain(chain, (with_effect, without)).refuted() == (name,)


def follow_angle(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] on the brightness that follows the fibre angle by 5 %."""
    return 1 + 0.05 * np.cos(2 * conditions.angle)


def drift(conditions: Conditions) -> np.ndarray:
    """Return a factor [frame] on the brightness that rises by 8 % with the order of acquisition."""
    return 1 + 0.08 * conditions.order


@pytest.mark.parametrize(("factor", "law"), [(follow_angle, "angle_reflectance"), (drift, "laser_drift")])
def test_laws_close_the_gap(factor, law: str):
    """Brightness is predicted by the law: without it the gap is open, with it it is closed."""
    drawn = draw_frames(42, CONDITIONS, peak_factor=factor(CONDITIONS))
    without, with_law = predict(drawn), predict(drawn, laws=(law,))
    assert is_wrong(without) and is_right(with_law)
    assert with_law.score < without.score


def test_scatter_of_the_brightness_is_no_gap_once_it_is_known():
    """Brightness that scatters by 1 % is predicted by no law. A model that knows of the scatter expects the gap."""
    factor = 1 + 0.01 * np.random.default_rng(9).standard_normal(len(CONDITIONS))
    drawn = draw_frames(43, CONDITIONS, peak_factor=factor)
    assert is_wrong(predict(drawn))
    fitted, frames, start = split_frames(drawn)
    model = fit_law(fitted)
    known = predict_frames(NestedModel("", model, FrameScatter(brightness_sd=0.01)), frames, start)
    # Twelve frames: their mean square scatters by 40 %.
    assert known.left_open == 0 and known.floor > 1.5
    assert known.score < predict_frames(NestedModel("", model), frames, start).score - 25


def test_the_score_of_frames_that_scatter_is_exact():
    """A model with rows and scatter of brightness has the −2 ln p of the multivariate normal distribution."""
    drawn = draw_frames(44, lay_out(exposures_s=(9e-4,), repeats=6), DrawnLight(), DrawnCamera())
    fitted, frames, start = split_frames(drawn)
    model = fit_law(fitted)
    frames = frames.select(np.array([0]))
    start = start.select(np.array([0]))
    alone = predict_frames(NestedModel("", model), frames, start)
    by_rows = predict_frames(NestedModel("", model, FrameScatter(row_variance=0.3)), frames, start)
    by_frame = predict_frames(NestedModel("", model, FrameScatter(brightness_sd=0.02)), frames, start)
    peak, sigma = (np.exp(v[0]) for v in (alone.spots.log_peak, alone.spots.log_sigma))
    y, x = np.mgrid[: frames.readings.shape[1], : frames.readings.shape[2]].astype(float)
    x, y = x + frames.left[0] - alone.spots.x[0], y + frames.top[0] - alone.spots.y[0]
    free = replace(model, law=None)
    grid = PixelGrid(x[:1] + alone.spots.x[0], y[:, :1] + alone.spots.y[0], 10**4, 10**4)
    at = FrameConditions(grid, alone.spots.x[0], alone.spots.y[0], 9e-4, 9e-4, 9e-4, 0.0, 0.5, peak, sigma)
    expected = free.expected(at)
    residual, weight = frames.readings[0] - expected.mean, 1 / expected.variance
    spot = expected.mean - free.sensor.black_level_dn
    # Woodbury for one row and one frame: ln det and quadratic form of V + c 1 1'.
    rows = np.log1p(0.3 * weight.sum(1)) - 0.3 * (residual * weight).sum(1) ** 2 / (1 + 0.3 * weight.sum(1))
    assert by_rows.score - alone.score == pytest.approx(rows.sum(), rel=2e-3)
    information = 0.02**2 * np.sum(spot**2 * weight)
    frame = np.log1p(information) - 0.02**2 * np.sum(spot * residual * weight) ** 2 / (1 + information)
    assert by_frame.score - alone.score == pytest.approx(frame, rel=2e-2, abs=0.02)


def test_centres_are_common_to_a_site():
    """A frame whose spot lies 1 px beside the others of its site is not predicted."""
    model, frames, start, prediction = plain_case()
    assert is_right(prediction)
    left = frames.left.copy()
    left[0] += 1
    moved = predict_frames(model, replace(frames, left=left), start)
    assert is_wrong(moved)


def test_the_start_does_not_matter():
    """Centres are fitted from starts 2 px off, and the brightness and width of the start are not used."""
    model, frames, start, prediction = plain_case()
    other = FrameParameters(start.log_peak + 1.0, start.log_sigma - 0.5, start.x + 2.0, start.y - 2.0)
    distant = predict_frames(model, frames, other)
    # The fit of centres ends within 0.01 of the least −2 ln L of each site, of some 300 that the gap adds up.
    assert distant.gap == pytest.approx(prediction.gap, abs=1e-3)
    assert distant.score == pytest.approx(prediction.score, abs=0.1)


def test_a_prediction_states_the_misfit_in_dn():
    """A pedestal that the model lacks is the rms of the block means."""
    model, _, _, _ = plain_case()
    drawn = draw_frames(1, CONDITIONS, DrawnLight(pedestal_dn=0.6), DrawnCamera())
    _, frames, start = split_frames(drawn)
    prediction = predict_frames(model, frames, start)
    # Blocks of 33 to 64 pixels whose noise of 1 to 9 DN is taken off on average; few per cent of 0.6 DN are left.
    assert prediction.rms_dn == pytest.approx(0.6, rel=0.2)
