"""Models beside single frames: where their fits start, what they expect of each frame, and what the pictures show."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from spotcheck.discrepancy.frames import FrameParameters
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.pictures import sum_blocks, z_of_strongest
from spotcheck.discrepancy.starting_spots import fit_spots, load_spots, spots_by_moments
from spotcheck.io import store
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.light_shape import LightShape
from spotcheck.model.model_file import ExtendedModel, Site, Spot
from spotcheck.report.views import ViewedFrames, fit_declared, fit_extended, rms_residual
from tests.samples import drawn_frames as drawing
from tests.samples.drawn_frames import DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import (
    BASELINE,
    SENSOR,
    apply_effect,
    frame_set,
    starting_spots,
    true_spots,
)

CONDITIONS = lay_out(angles_deg=(0.0, 60.0), repeats=2)
LAW = ExposureLaw(drawing.P1, drawing.P2, drawing.PEAK)
# A hill of 15 % of the peak to one side of the light, half as wide.
HILL = LightShape(0.5, 0.15 * np.exp(-((np.arange(15)[:, None] - 7) ** 2 + (np.arange(15) - 9) ** 2) / 2))


def viewed(drawn: DrawnFrames) -> ViewedFrames:
    """Return drawn frames as the stage has them."""
    return ViewedFrames(frame_set(drawn), (), starting_spots(drawn), BASELINE, SENSOR)


def sites_of(drawn: DrawnFrames) -> list[Site]:
    """Return the site of each frame."""
    places = zip(np.rad2deg(drawn.conditions.angle).tolist(), drawn.conditions.repeat.tolist(), strict=True)
    return [Site(angle, None, repeat, ()) for angle, repeat in places]


def extended(drawn: DrawnFrames, *effects: AppliedEffect, **changes) -> ExtendedModel:
    """Return the true law and centres with effects."""
    spots = dict(zip(sites_of(drawn), map(Spot, drawn.x.tolist(), drawn.y.tolist()), strict=True))
    side = drawing.SENSOR_SIDE
    return replace(ExtendedModel(LAW, 9e-4, 3e-4, side, side, effects, spots), **changes)


@cache
def plain() -> DrawnFrames:
    """Return frames as the declared model has them."""
    return draw_frames(3, CONDITIONS)


# Spots of single frames.


def test_spots_of_frames_are_those_that_were_drawn():
    """Over 36 frames the squared errors follow χ² of 4 by the stated covariance (false-alarm rate 1e-4)."""
    drawn = draw_frames(4, lay_out(repeats=3))
    fitted = fit_spots(ForwardModel(BASELINE, SENSOR), frame_set(drawn), starting_spots(drawn))
    assert fitted.has_converged.all()
    errors = (fitted.spots.as_rows() - true_spots(drawn).as_rows()).T
    chi2 = np.einsum("fi,fij,fj->", errors, np.linalg.inv(fitted.covariance), errors)
    low, high = stats.chi2.ppf([5e-5, 1 - 5e-5], 4 * len(errors))
    # A fit ends within a decrement of 0.1 of its optimum, and errors are widened by the noise of χ².
    assert low - 0.1 * len(errors) < chi2 < high + 0.1 * len(errors)
    joint = fitted.joint_covariance
    np.testing.assert_array_equal(joint[4:8, 4:8], fitted.covariance[1])
    assert not joint[:4, 4:].any()


def test_a_frame_does_not_depend_on_the_others():
    """The spot of a frame is the same whatever frames are fitted beside it."""
    frames, start = frame_set(plain()), starting_spots(plain())
    whole = fit_spots(ForwardModel(BASELINE, SENSOR), frames, start).spots.as_rows()
    few = np.array([7, 2])
    alone = fit_spots(ForwardModel(BASELINE, SENSOR), frames.select(few), start.select(few)).spots.as_rows()
    np.testing.assert_array_equal(alone, whole[:, few])


def test_moments_are_near_enough_for_a_start():
    """Peak within a quarter, width within a tenth, centre within half a pixel; fits from there end at the same spot."""
    frames, truth = frame_set(plain()), true_spots(plain())
    # Readings contain the black level, which moments take for background.
    start = spots_by_moments(frames)
    for found, drawn, limit in zip(start.as_rows(), truth.as_rows(), (0.25, 0.1, 0.5, 0.5), strict=True):
        assert np.abs(found - drawn).max() < limit
    by_moments, by_truth = (fit_spots(ForwardModel(BASELINE, SENSOR), frames, s).spots for s in (start, truth))
    np.testing.assert_allclose(by_moments.as_rows(), by_truth.as_rows(), atol=5e-3)


def test_a_frame_without_light_has_a_start():
    """A frame that reads the same everywhere, and one that is masked, start somewhere in their crops."""
    frames = frame_set(plain()).select(np.arange(2))
    readings = np.stack([np.full_like(frames.readings[0], 12.0), np.full_like(frames.readings[0], np.nan)])
    start = spots_by_moments(replace(frames, readings=readings))
    assert np.isfinite(start.as_rows()).all()
    assert (start.x >= frames.left).all() and (start.x < frames.left + drawing.SIDE).all()


def fits_of(drawn: DrawnFrames, status: np.ndarray) -> tuple[xr.Dataset, list]:
    """Return fits over a grid of exposures and repeats with some flags, and the cell of each frame."""
    spots = true_spots(drawn)
    shape = (1, len(status), 1, 1)
    dims = ("exposure", "repeat", "centring", "fit")
    columns = {
        "amplitude": np.exp(spots.log_peak), "sigma_mean": np.exp(spots.log_sigma), "x_centre": spots.x,
        "y_centre": spots.y, "status": status,
    }  # fmt: skip
    fits = xr.Dataset({name: (dims, values.reshape(shape)) for name, values in columns.items()})
    fits = fits.assign_coords(centring=["light"], fit=["likelihood"]).assign_attrs(preferred="likelihood")
    return fits, [((0, k), None) for k in range(len(status))]


def test_starts_are_trusted_fits():
    """Of a fit that has not converged, the start comes from moments instead."""
    drawn = draw_frames(5, lay_out(exposures_s=(9e-4,), angles_deg=(0.0,), repeats=3))
    fits, cells = fits_of(drawn, np.array([0, store.flag("not_converged"), store.flag("clipped")]))
    frames, truth = frame_set(drawn), true_spots(drawn).as_rows()
    start, moments = load_spots(fits, frames, cells).as_rows(), spots_by_moments(frames).as_rows()
    np.testing.assert_allclose(start[:, [0, 2]], truth[:, [0, 2]])
    np.testing.assert_array_equal(start[:, 1], moments[:, 1])


# Models beside frames.


def left_over_noise(view, frames, number: int) -> float:
    """Return the rms of what a model leaves of a frame over the noise of shot, reading and rounding."""
    mean = view.predict_mean(frames, number)
    noise = drawing.GAIN * np.maximum(mean - drawing.BLACK, 0) + (drawing.GAIN * drawing.READ_NOISE_E) ** 2 + 1 / 12
    return float(np.sqrt(np.mean((frames.readings[number] - mean) ** 2 / noise)))


def test_the_declared_model_leaves_the_noise_of_plain_frames():
    """The rms of 5184 pixels scatters by 1 %; limits are five of that."""
    ready = viewed(plain())
    model = fit_declared(ready)
    for number in range(len(ready.frames)):
        assert left_over_noise(model, ready.frames, number) == pytest.approx(1, abs=0.05)


def test_the_extended_model_has_what_the_declared_one_lacks():
    """An ellipse of 6 % is left by the declared model, and by the extended one without it; not by the extended."""
    effect = apply_effect("beam_ellipticity", ratio=1.06, direction=30.0)
    drawn = draw_frames(6, CONDITIONS, DrawnLight(ratio=1.06, direction_deg=30.0))
    ready = viewed(drawn)
    declared = fit_declared(ready)
    views = fit_extended(ready, extended(drawn, effect), sites_of(drawn))
    # A scale that puts the ellipse along both axes leaves its area: the same law holds.
    for number in np.flatnonzero(drawn.conditions.exposure_s == 9e-4):
        assert left_over_noise(declared, ready.frames, number) > 1.3
        assert left_over_noise(views.without[0], ready.frames, number) > 1.3
        assert left_over_noise(views.model, ready.frames, number) == pytest.approx(1, abs=0.05)


def test_deviations_are_those_of_single_frames():
    """A frame 5 % brighter than the law, and a spot moved by 0.3 px; the others deviate by their errors alone.

    Limits of 5 standard errors: false-alarm rate 3e-5 in 48 numbers. Laws and centres are the true ones.
    """
    factor = np.ones(len(CONDITIONS))
    factor[4] = 1.05
    drawn = draw_frames(8, CONDITIONS, peak_factor=factor)
    model = extended(drawn)
    site = sites_of(drawn)[4]
    moved = replace(model, spots=model.spots | {site: replace(model.spots[site], x_px=model.spots[site].x_px - 0.3)})
    views = fit_extended(viewed(drawn), moved, sites_of(drawn))
    expected = {name: np.zeros(len(CONDITIONS)) for name in views.deviations}
    expected["brighter"] = factor - 1
    expected["right"][[s == site for s in sites_of(drawn)]] = 0.3
    for name, deviation in views.deviations.items():
        z = (deviation - expected[name]) / views.stderr[name]
        assert np.abs(z).max() < 5 and 0.3 < np.std(z) < 2, name


def test_without_a_law_effect_frames_lose_its_brightness():
    """What a law does to brightness goes with it; the spot of the frame itself is its own, with the law or not."""
    law = apply_effect("angle_reflectance", d=0.05, gamma0=0.0)
    ready = viewed(plain())
    with_law = fit_extended(ready, extended(plain(), law), sites_of(plain()))
    without = fit_extended(ready, extended(plain()), sites_of(plain()))
    removed, kept = (model.compute_log_spots(ready.frames)[0] for model in (with_law.without[0], with_law.model))
    factor = np.exp(removed - kept)
    # The law multiplies the peaks by a factor of the angle, which is known from how the deviations differ.
    by_law = (1 + without.deviations["brighter"]) / (1 + with_law.deviations["brighter"])
    np.testing.assert_allclose(factor, 1 / by_law, rtol=1e-9)
    assert np.ptp(factor) > 0.05
    means = [views.model.predict_mean(ready.frames, 0) for views in (with_law, without)]
    np.testing.assert_allclose(*means, rtol=1e-9)


def test_without_a_law_there_is_no_law_to_deviate_from():
    """Then brightness and width are NaN, and so are their errors; centres are those of each frame's spot."""
    model = extended(plain(), law=None)
    views = fit_extended(viewed(plain()), model, sites_of(plain()))
    assert np.isnan(views.deviations["brighter"]).all() and np.isnan(views.stderr["wider"]).all()
    assert np.isfinite(views.deviations["right"]).all()


def test_each_frame_has_its_own_light():
    """Of two learned lights a frame has that of its spot; without the effect of the light it has the declared one."""
    flat = LightShape(HILL.step, np.zeros_like(HILL.coefficients))
    lights = [0 if site.angle_deg == 0 else 1 for site in sites_of(plain())]
    spots = {site: Spot(0.0, 0.0, light=light) for site, light in zip(sites_of(plain()), lights, strict=True)}
    model = extended(plain(), apply_effect("beam_profile", power=0.02, order=1.0), spots=spots, lights=(flat, HILL))
    ready = viewed(plain())
    views, declared = fit_extended(ready, model, sites_of(plain())), fit_declared(ready)
    for number, light in enumerate(lights):
        left = left_over_noise(views.model, ready.frames, number)
        mean, without, plain_mean = (
            model.predict_mean(ready.frames, number) for model in (views.model, views.without[0], declared)
        )
        if light == 0:
            np.testing.assert_allclose(mean, plain_mean, atol=0.01)
        elif CONDITIONS.exposure_s[number] == max(drawing.EXPOSURES_S):
            assert left > 1.2
        np.testing.assert_allclose(without, round_light(ready, views.model.spots, number), atol=0.02)


def round_light(ready: ViewedFrames, spots: FrameParameters, number: int) -> np.ndarray:
    """Return the mean reading of a Gaussian with the spot of a frame."""
    frames = ready.frames
    y, x = np.mgrid[: drawing.SIDE, : drawing.SIDE]
    square = (x + frames.left[number] - spots.x[number]) ** 2 + (y + frames.top[number] - spots.y[number]) ** 2
    return drawing.BLACK + np.exp(spots.log_peak[number] - square / (2 * np.exp(2 * spots.log_sigma[number])))


def test_scatter_leaves_the_mean():
    """An effect that scatters from frame to frame takes no part in the mean of a frame, which has its own spot."""
    effect = apply_effect("power_fluctuation", rms=0.02)
    ready = viewed(plain())
    views = fit_extended(ready, extended(plain(), effect), sites_of(plain()))
    mean = fit_extended(ready, extended(plain()), sites_of(plain())).model.predict_mean(ready.frames, 3)
    np.testing.assert_array_equal(views.model.predict_mean(ready.frames, 3), mean)
    np.testing.assert_array_equal(views.without[0].predict_mean(ready.frames, 3), mean)


def test_the_rms_leaves_masked_pixels_out():
    """Of readings 2 DN off at a variance of 4 DN² the rms is 2 DN and 1 times the noise; without pixels it is NaN."""
    line = SimpleNamespace(variance=lambda mean: np.full(mean.shape, 4.0))
    measured = np.array([[12.0, 8.0], [np.nan, 12.0]])
    assert rms_residual(measured, np.full((2, 2), 10.0), line) == (2.0, 1.0)
    assert np.isnan(rms_residual(np.full((2, 2), np.nan), np.zeros((2, 2)), line)).all()


# Sums over blocks, and the strongest azimuthal order.


def test_sums_over_blocks_leave_out_masked_pixels():
    """Blocks of 5 px: pixels that are masked, and the two rows and columns that are left over, take no part."""
    frames = frame_set(plain()).select(np.arange(3))
    readings = frames.readings.copy()
    readings[1, :5, 3] = np.nan
    readings[2, 5:10, 5:10] = np.nan
    masked = replace(frames, readings=readings)
    spots = true_spots(plain()).select(np.arange(3))
    forward = ForwardModel(replace(BASELINE, photon_budget="free"), SENSOR)
    sums = sum_blocks(masked, JointModel(forward, spots, masked.design), 5)
    blocks = readings[:, :70, :70].reshape(3, 14, 5, 14, 5)
    np.testing.assert_allclose(sums.reading, np.nansum(blocks, axis=(2, 4)))
    np.testing.assert_array_equal(sums.pixels, np.isfinite(blocks).sum(axis=(2, 4)))
    assert sums.variance[2, 1, 1] == sums.residual[2, 1, 1] == 0
    # Residuals scatter by their variance: χ² of 587 blocks (one is masked) within five standard deviations.
    is_known = sums.pixels > 0
    chi2 = np.sum(sums.residual[is_known] ** 2 / sums.variance[is_known])
    assert abs(chi2 - is_known.sum()) < 5 * np.sqrt(2 * is_known.sum())


def test_z_of_the_strongest_order():
    """It is exceeded as often as a normal z: by noise in 1 % of rings at z = 2.58, by Bonferroni's bound or less."""
    power = np.random.default_rng(2).chisquare(2, (6, 100_000))
    share = np.mean(z_of_strongest(power) > stats.norm.isf(0.005))
    # 1000 of 100 000 are expected but for the 2.5 % of overlaps; ±5 standard deviations.
    assert 0.0080 < share < 0.0112
    # Beyond the range of exp, the asymptote goes on where the inverse ends.
    low, high = z_of_strongest(np.array([[1000.0, 1008.0]]))
    assert 30 < low < high < 33
