"""Covariance of spots, and of scores of effects, under granular light, against their scatter over drawn frames."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.analysis import find_light_field
from spotcheck.discrepancy.candidates import list_starts, measure_field_shares, project_starts
from spotcheck.discrepancy.field_noise import covariance_by_field
from spotcheck.discrepancy.fields import FieldEstimate
from spotcheck.discrepancy.frames import LightField, select_pixels
from spotcheck.discrepancy.joint_fit import fit_jointly
from spotcheck.discrepancy.residuals import measure_residuals
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.discrepancy.spot_measurements import measure_spots
from spotcheck.model.effects import vocabulary
from tests.samples.drawn_frames import DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import SCALES, frame_set, starting_model

CONTRAST, GRAIN_PX = 0.15, 1.0
# 60 sites: a variance has a relative error of √(2/60) or 0.18.
CONDITIONS = lay_out(repeats=15)


@pytest.mark.parametrize("has_shape", [False, True], ids=["declared shape", "free shape"])
def test_scatter_of_spots_under_granular_light_is_predicted(has_shape: bool):
    """Standardised means and differences of ln peak and ln σ of the frames of a site have the variance 1.

    The means are those of noise that the frames share, the differences of what they do not. χ² of 60 and 120 degrees of
    freedom: 3.5 standard errors, a false alarm in 2,000 for each of six. Beside a free shape brightness and width of
    all frames are known up to a factor, so that only the differences count.
    """
    drawn = draw_frames(3, CONDITIONS, DrawnLight(speckle_contrast=CONTRAST, grain_px=GRAIN_PX))
    frames = frame_set(drawn)
    model = replace(starting_model(drawn), free=())
    first = fit_jointly(model, select_pixels(frames, model.spots))
    grains = FieldEstimate(CONTRAST**2, 0.0, GRAIN_PX, ())
    variance = grains.variance * measure_residuals(first.model, frames).spot ** 2
    light_field = LightField(variance, dispersion=1.0, share=np.zeros_like(variance), mean_share=0.0)
    frames = replace(frames, light_field=light_field)
    start = first.model.with_free_shape(ShapeGrid()) if has_shape else first.model
    fit = fit_jointly(start, select_pixels(frames, first.model.spots))
    measurements = measure_spots(fit, covariance_by_field(fit, frames, grains))
    assert np.linalg.eigvalsh(measurements.covariance)[0] > 0
    site = drawn.conditions.site
    for parameter, values in ((0, fit.model.spots.log_peak - np.log(drawn.peak_dn)),
                              (1, fit.model.spots.log_sigma - np.log(drawn.sigma_px))):  # fmt: skip
        covariance = measurements.covariance_of(parameter)
        means, differences = [], []
        for number in np.unique(site):
            members = np.flatnonzero(site == number)
            whitening = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(members, members)]))
            # The first row of a rotation that turns (1, 1, 1) beside the noise of the site to the first axis.
            rotation = np.linalg.qr((whitening @ np.ones((len(members), 1))), mode="complete")[0].T
            standardised = rotation @ whitening @ values[members]
            means.append(standardised[0])
            differences += list(standardised[1:])
        for found in (differences,) if has_shape else (means, differences):
            # 8 % for the part of the field that the spots take with them.
            assert abs(np.var(found) - 1) < 3.5 * np.sqrt(2 / len(found)) + 0.08
    if has_shape:
        return
    # Without what the frames share, means scatter far more than the fit says.
    plain = measure_spots(fit).covariance
    assert np.mean(np.diag(measurements.covariance)[::4]) > 3 * np.mean(np.diag(plain)[::4])


def test_dispersion_of_an_effect_is_that_of_its_score():
    """The squared score over information and dispersion is 1 on average, for effects in dark and in bright pixels.

    With 30 draws it has a χ² distribution of 30 degrees of freedom: 0.33 to 2.2 has a false-alarm rate of 1e-4 on
    either side. The dispersion takes the change for constant over a grain, which is worth another factor of 1.5 for
    spots as small as these. The dispersion of the light, which is 8, is far off for smear and pedestal.
    """
    draws, names = 30, ("smear", "dark_offset", "nonlinearity")
    starts = [list_starts([vocabulary()[name]], SCALES)[0] for name in names]
    squares, dispersions = np.zeros((draws, 3)), np.zeros((draws, 3))
    for number in range(draws):
        drawn = draw_frames(number, lay_out(repeats=3), DrawnLight(speckle_contrast=CONTRAST, grain_px=GRAIN_PX))
        frames = frame_set(drawn)
        model = replace(starting_model(drawn), free=())
        first = fit_jointly(model, select_pixels(frames, model.spots))
        light_field = find_light_field(measure_residuals(first.model, frames), first)
        pixels = select_pixels(replace(frames, light_field=light_field), first.model.spots)
        fit = fit_jointly(first.model, pixels)
        changes = project_starts(fit, starts)
        squares[number] = changes.score**2 / changes.information
        dispersions[number] = pixels.dispersion_of(measure_field_shares(fit, starts, changes.absorbed()))
    ratio = np.mean(squares / dispersions, axis=0)
    assert np.all((ratio > 0.33 / 1.5) & (ratio < 2.2 * 1.5))
    assert np.all(np.mean(squares[:, :2], axis=0) / pixels.dispersion < 0.33)
