"""Joint fits of spots, sensor and effects on frames that numpy drew: derivatives, errors, the pixels that are used."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy import frames as frames_module
from spotcheck.discrepancy.candidates import list_starts, screen_candidates
from spotcheck.discrepancy.evidence import estimate_covariance
from spotcheck.discrepancy.frames import FrameParameters, Pixels, select_pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.normal_equations import assemble, invert_information
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import DrawnCamera, DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import (
    DEPARTURES,
    SCALES,
    SENSOR,
    apply_effect,
    fit_drawn,
    frame_set,
    starting_model,
    true_spots,
)

# Bound on the distance of one estimate from its truth in standard errors: two-sided 6.8e-6 for a normal estimate.
LARGEST_Z = 4.5
# Two angles are enough where nothing depends on the angle, and halve the time.
FEW_ANGLES_DEG = (0.0, 60.0)


# Derivatives.

EFFECTS_OF_MODELS = {
    "coordinates": apply_effect("beam_ellipticity", ratio=1.04, direction=30.0),
    "added light": apply_effect("scatter_halo", "exponential", fraction=0.01, radius=12.0),
    "clip of the charge": apply_effect("saturation", "sharp", level=600.0),
    "pedestal of light": apply_effect("dark_offset", "light", level=1.2),
    "pedestal of the black level": apply_effect("dark_offset", "electronic", level=1.2),
    "bent response": apply_effect("nonlinearity", q=0.03),
}


def move_parameter(model: JointModel, index: int, change: float) -> JointModel:
    """Return a model with one of its unknowns changed, in the order of the normal equations."""
    count = 4 * len(model.spots.x)
    if index >= count:
        parameter = model.free[index - count]
        return model.with_value(parameter, model.value_of(parameter) + change)
    rows = model.spots.as_rows().copy()
    rows[index % 4, index // 4] += change
    return replace(model, spots=FrameParameters(*rows))


@pytest.mark.parametrize("applied", EFFECTS_OF_MODELS.values(), ids=EFFECTS_OF_MODELS)
def test_gradient_and_information_are_those_of_the_deviance(applied: AppliedEffect):
    """The score of spots, read noise and effect agrees with central differences of −2 ln L, away from the optimum. The
    Fisher information is a covariance of scores: symmetric, with positive eigenvalues."""
    light, camera = DrawnLight(ratio=1.03, direction_deg=20.0, pedestal_dn=1.0), DrawnCamera(clip_dn=600.0, bend=0.02)
    drawn = draw_frames(7, lay_out(angles_deg=FEW_ANGLES_DEG, repeats=1), light, camera)
    model = starting_model(drawn, applied)
    pixels = select_pixels(frame_set(drawn), model.spots)
    equations = assemble(model, pixels)
    deviation = np.sqrt(np.diag(equations.information))
    # All four parameters of the first frame, two of the last one, then sensor and effect.
    count = 4 * equations.frame_count
    for index in (0, 1, 2, 3, count - 4, count - 3, *range(count, equations.size)):
        step = 0.01 / deviation[index]
        above, below = (assemble(move_parameter(model, index, sign * step), pixels).deviance for sign in (1, -1))
        numerical = -(above - below) / (4 * step)
        # The package takes forward differences with relative steps of 1e-5 and 1e-6: the score half a step further on,
        # off by some 1e-4 of the score or of its standard deviation.
        tolerance = 1e-3 * (abs(numerical) + deviation[index])
        assert abs(equations.gradient[index] - numerical) < tolerance, index
    correlation = equations.information / deviation[:, None] / deviation
    # Sums of 5e4 products in two orders differ by some 1e-14.
    np.testing.assert_allclose(correlation, correlation.T, rtol=0, atol=1e-12)
    # An eigenvalue below 1e-4 would be a parameter that the frames cannot tell from others.
    assert np.linalg.eigvalsh(correlation).min() > 1e-4


@pytest.mark.parametrize(
    "applied",
    [
        apply_effect("saturation", "sharp", level=2000.0),
        apply_effect("ghost_reflection", fraction=0.05, dx=300.0, dy=0.0),
    ],
    ids=["clip above the light", "ghost outside the crops"],
)
def test_parameters_without_information_have_no_finite_error(applied: AppliedEffect):
    """A strength that changes no pixel is not known at all, and the errors of the other parameters are as without."""
    _, fit = plain_fit()
    unseen = fit_jointly(fit.model.with_effect(applied, SCALES), fit.pixels, iterations=0)
    covariance = estimate_covariance(unseen)
    assert np.isinf(covariance[1, 1])
    np.testing.assert_allclose(covariance[0, 0], estimate_covariance(fit)[0, 0], rtol=1e-6)


# Fits.


@cache
def plain_fit() -> tuple[DrawnFrames, JointFit]:
    """Return 24 frames without an effect, and their fit."""
    drawn = draw_frames(1, lay_out())
    return drawn, fit_drawn(drawn)


def test_spots_lie_within_their_errors():
    """All 96 parameters of the spots are off by what their standard errors say, no more and no less."""
    drawn, fit = plain_fit()
    assert fit.has_converged
    covariance = invert_information(fit.equations.information)
    count = 4 * len(drawn.x)
    errors = np.sqrt(np.diag(covariance)[:count]).reshape(-1, 4).T
    z = (fit.model.spots.as_rows() - true_spots(drawn).as_rows()) / errors
    # False-alarm rate of the bound over 96 parameters: 6.5e-4.
    assert np.abs(z).max() < LARGEST_Z
    # z' R⁻¹ z with all correlations is χ² distributed: false-alarm rate 2e-4.
    offsets = (fit.model.spots.as_rows() - true_spots(drawn).as_rows()).T.ravel()
    chi2 = offsets @ np.linalg.solve(covariance[:count, :count], offsets)
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], count)
    assert low < chi2 < high


def test_read_noise_is_fitted():
    """A read noise that the data sheet understates is found within its error, and the dispersion is 1."""
    drawn = draw_frames(4, lay_out(angles_deg=FEW_ANGLES_DEG), camera=DrawnCamera(read_noise_e=8.0))
    fit = fit_drawn(drawn)
    error = np.sqrt(invert_information(fit.equations.information)[-1, -1])
    assert abs(fit.model.forward.sensor.read_noise_e - 8.0) < LARGEST_Z * error
    # The mean of n squared standardised residuals has the standard deviation √(2/n); 48 spot parameters are fitted.
    count = fit.pixels.count
    assert abs(fit.equations.dispersion - (1 - 48 / count)) < LARGEST_Z * np.sqrt(2 / count)


def test_every_read_noise_has_a_table():
    """A read noise at which the first light of a table would lie below 0 by rounding has a table, as all others."""
    dark, bright = replace(SENSOR, read_noise_e=5.968185566605789).mean([0.0, 100.0])
    assert dark < bright


def test_a_fit_without_steps_has_not_converged():
    """Without an iteration the start is returned, and reported as not converged."""
    drawn, fit = plain_fit()
    start = starting_model(drawn)
    unfitted = fit_jointly(start, fit.pixels, iterations=0)
    assert not unfitted.has_converged and unfitted.iterations == 0
    np.testing.assert_array_equal(unfitted.model.spots.as_rows(), start.spots.as_rows())
    # From the optimum no step is needed.
    assert fit_jointly(fit.model, fit.pixels, iterations=0).has_converged


def test_distant_starts_lead_to_the_same_fit():
    """Spots that start 30 % too bright, 15 % too narrow and 3 px off end where near starts do."""
    drawn, fit = plain_fit()
    start = starting_model(drawn)
    rows = true_spots(drawn).as_rows() + np.array([0.3, -0.15, 3.0, -3.0])[:, None]
    distant = fit_jointly(replace(start, spots=FrameParameters(*rows)), fit.pixels)
    assert distant.has_converged
    # Two converged fits are each within the tolerance of the decrement, 0.1, of the least −2 ln L.
    assert abs(distant.deviance - fit.deviance) < 0.2


@pytest.mark.parametrize(("option", "far", "near"), [("rival", 1e5, -1e6), ("target", -1e9, 1.0)])
def test_a_fit_ends_early_when_its_result_is_decided(option: str, far: float, near: float):
    """A fit ends, and says so, when a step promises less than 1 % of its lead over a rival, or cannot reach a target.

    A rival ahead of the optimum and a target behind it change nothing.
    """
    drawn, fit = plain_fit()
    start = starting_model(drawn)
    early = fit_jointly(start, fit.pixels, **{option: fit.deviance + far})
    assert not early.has_converged and early.iterations < fit.iterations
    if option == "rival":
        # What a step promises is what is left to the optimum but for the curvature of ln L, here less than a factor 2.
        assert early.deviance - fit.deviance < 0.02 * far
    assert fit_jointly(start, fit.pixels, **{option: fit.deviance + near}).deviance == fit.deviance


def test_parameters_stay_within_their_bounds():
    """A pedestal that frames with a lower black level would make negative stays at its bound 0, in a converged fit."""
    drawn = draw_frames(3, lay_out(angles_deg=FEW_ANGLES_DEG), camera=DrawnCamera(black_dn=drawing.BLACK - 0.5))
    fit = fit_drawn(drawn, apply_effect("dark_offset", "light", level=1.0))
    assert fit.has_converged
    assert fit.model.effect_named("dark_offset").parameters["level"] == 0.0


# Effects.


@pytest.mark.parametrize("name", DEPARTURES)
def test_effects_have_their_values(name: str):
    """Each parameter of a fitted effect is within 4.5 of its robust standard errors of the truth."""
    departure = DEPARTURES[name]
    drawn = draw_frames(21, lay_out(), departure.light, departure.camera)
    fit = fit_drawn(drawn, departure.start)
    assert fit.has_converged
    covariance = estimate_covariance(fit)
    errors = np.sqrt(np.diag(covariance))
    information = invert_information(fit.equations.information)
    for index, parameter in enumerate(fit.model.free):
        if not parameter.effect:
            continue
        # False-alarm rate 6.8e-6 for each parameter.
        assert abs(fit.model.value_of(parameter) - departure.truth[parameter.name]) < LARGEST_Z * errors[index]
        # The robust error is the largest of four, so that it is at least the model's own. Where the model is right all
        # four estimate the same: with some 10² clusters each is known to 10 %, and twice the model's would be a fault.
        own_error = np.sqrt(information[4 * len(drawn.x) + index, 4 * len(drawn.x) + index])
        assert 0.99 < errors[index] / own_error < 2, parameter.name


def test_errors_of_effects_describe_their_scatter():
    """Over 16 sets of frames the fitted values scatter about the truth by their standard errors."""
    light, camera = DrawnLight(ratio=1.02, direction_deg=30.0, pedestal_dn=0.6), DrawnCamera(bend=0.1)
    starts = [DEPARTURES[name].start for name in ("ellipse", "pedestal", "bend")]
    truth = {"ratio": 1.02, "direction": 30.0, "level": 0.6, "q": 0.1, "read_noise_e": drawing.READ_NOISE_E}
    conditions = lay_out(angles_deg=FEW_ANGLES_DEG, repeats=1)
    z = []
    for seed in range(100, 116):
        fit = fit_drawn(draw_frames(seed, conditions, light, camera), *starts)
        errors = np.sqrt(np.diag(estimate_covariance(fit)))
        values = np.array([fit.model.value_of(parameter) for parameter in fit.model.free])
        z.append((values - [truth[parameter.name] for parameter in fit.model.free]) / errors)
    squares = np.sum(np.square(z), axis=0)
    # False-alarm rate 1e-4 for each of the five parameters on either side; robust errors are up to 1.3 times as large
    # as those of the model, since they are the largest of four estimates.
    assert np.all(squares < stats.chi2.ppf(1 - 1e-4, len(z)))
    assert np.all(squares > stats.chi2.ppf(1e-4, len(z)) / 1.3**2)


def test_score_test_foretells_the_gain():
    """For a weak effect the score test promises the drop of −2 ln L that a fit then finds."""
    drawn = draw_frames(22, lay_out(), camera=DrawnCamera(bend=0.03))
    plain = fit_drawn(drawn)
    candidates = screen_candidates(plain, list_starts([vocabulary()["nonlinearity"]], SCALES))
    assert len(candidates) == 1
    gain = plain.deviance - fit_drawn(drawn, candidates[0].start).deviance
    # A quadratic expansion of ln L: for an effect of some 10 standard errors that bends the light of a few per cent, it
    # is off by a few per cent. The score is less by the 1 that noise alone is expected to give.
    assert gain > 25
    assert abs(candidates[0].score + 1 - gain) < 0.1 * gain
    # So it does before the spots have converged, since what these can still do is taken off. One step leaves them off
    # by more than a standard error on average, which changes the score by some 10 %. Without taking it off the score
    # would be four times the gain.
    unfinished = fit_jointly(starting_model(drawn), plain.pixels, iterations=1)
    assert unfinished.deviance - plain.deviance > 4 * len(drawn.x)
    (candidate,) = screen_candidates(unfinished, list_starts([vocabulary()["nonlinearity"]], SCALES))
    assert abs(candidate.score + 1 - gain) < 0.25 * gain


# Pixels of fits.


def places_of(pixels: Pixels, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column on the sensor of the used pixels of a frame."""
    y, x = np.broadcast_arrays(pixels.y[frame], pixels.x[frame])
    used = pixels.is_used[frame]
    return y[used].astype(int), x[used].astype(int)


@pytest.mark.parametrize("most_pixels", [frames_module.MOST_PIXELS, 8_000], ids=["dense", "strided"])
def test_each_pixel_is_taken_once(most_pixels: int, monkeypatch: pytest.MonkeyPatch):
    """Selected pixels are distinct, have the readings of their places, and leave out masked ones.

    Spots in the middle, at an edge and beyond a corner of the crop; with few pixels allowed, rows and columns are
    strided near the spot as well.
    """
    monkeypatch.setattr(frames_module, "MOST_PIXELS", most_pixels)
    drawn = draw_frames(5, lay_out(angles_deg=FEW_ANGLES_DEG, repeats=1))
    readings = drawn.readings.copy()
    readings[:, 30:33, 40] = np.nan
    frames = replace(frame_set(drawn), readings=readings)
    spots = true_spots(drawn)
    x, y = spots.x.copy(), spots.y.copy()
    x[1], x[2], y[2] = drawn.left[1] + 2.0, drawn.left[2] - 5.0, drawn.top[2] + drawing.SIDE + 3.0
    pixels = select_pixels(frames, replace(spots, x=x, y=y))
    for frame in range(len(frames)):
        row, column = places_of(pixels, frame)
        assert len(set(zip(row, column, strict=True))) == len(row)
        at_places = readings[frame, row - drawn.top[frame], column - drawn.left[frame]]
        np.testing.assert_array_equal(at_places, pixels.readings[frame][pixels.is_used[frame]])
    assert pixels.count <= most_pixels
    # The rows of the grid stand for all rows of the crop, which sums over columns rely on.
    np.testing.assert_allclose(pixels.row_share.sum(axis=(1, 2)), drawing.SIDE)


def test_pixels_are_dense_near_the_spot():
    """Each pixel within 3 σ along both axes is taken, and of the others a few in each frame but all over the frames."""
    drawn = draw_frames(5, lay_out())
    spots = true_spots(drawn)
    pixels = select_pixels(frame_set(drawn), spots)
    taken = np.zeros(drawn.readings.shape, bool)
    for frame in range(len(drawn.x)):
        row, column = places_of(pixels, frame)
        taken[frame, row - drawn.top[frame], column - drawn.left[frame]] = True
    reach = 3.0 * drawn.sigma_px[:, None]
    near_x = np.abs(drawn.left[:, None] + np.arange(drawing.SIDE) - drawn.x[:, None]) < reach
    near_y = np.abs(drawn.top[:, None] + np.arange(drawing.SIDE) - drawn.y[:, None]) < reach
    near = near_y[:, :, None] & near_x[:, None, :]
    assert taken[near].all()
    # Every fourth row and column beyond 3.2 σ of the widest spot, 47 of 72 px: 53² … 54² of 72² px in all.
    count = taken.sum(axis=(1, 2))
    assert count.min() >= 53**2 and count.max() <= 54**2
    # Together the frames show every row and every column also at the edges, where no frame is dense.
    assert taken[:, :, :4].any(axis=(0, 2)).all() and taken[:, :4, :].any(axis=(0, 1)).all()


def test_thinned_pixels_are_the_same_at_every_call():
    """The subset is deterministic, of the size asked for, and a part of the pixels."""
    drawn, fit = plain_fit()
    first, second = thin_pixels(fit.pixels, 10_000), thin_pixels(fit.pixels, 10_000)
    for name in ("x", "y", "readings", "is_used", "row_share"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    # Whole rows and columns are kept: rounding to one of 20 changes the number by 5 %, and some of them are fillers.
    assert abs(first.count - 10_000) < 1_000
    for frame in range(len(drawn.x)):
        all_places = set(zip(*places_of(fit.pixels, frame), strict=True))
        row, column = places_of(first, frame)
        places = list(zip(row, column, strict=True))
        assert len(set(places)) == len(places) and set(places) <= all_places
        at_places = drawn.readings[frame, row - drawn.top[frame], column - drawn.left[frame]]
        np.testing.assert_array_equal(at_places, first.readings[frame][first.is_used[frame]])
    np.testing.assert_allclose(first.row_share.sum(axis=(1, 2)), drawing.SIDE)
    # A larger subset than there are pixels is all of them.
    assert thin_pixels(fit.pixels, 10**7).count == fit.pixels.count
