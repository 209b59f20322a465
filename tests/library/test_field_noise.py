"""Covariance of spots under granular light, against the scatter of spots that were fitted to drawn frames."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.field_noise import covariance_by_field
from spotcheck.discrepancy.fields import FieldEstimate
from spotcheck.discrepancy.frames import LightField, select_pixels
from spotcheck.discrepancy.joint_fit import fit_jointly
from spotcheck.discrepancy.residuals import measure_residuals
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.discrepancy.spot_numbers import numbers_of_fit
from tests.library.drawn_frames import DrawnLight, draw_frames, lay_out
from tests.library.models_of_frames import frame_set, starting_model

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
    frames = replace(frames, light_field=LightField(variance, 1.0))
    start = first.model.with_free_shape(ShapeGrid()) if has_shape else first.model
    fit = fit_jointly(start, select_pixels(frames, first.model.spots))
    numbers = numbers_of_fit(fit, covariance_by_field(fit, frames, grains))
    assert np.linalg.eigvalsh(numbers.covariance)[0] > 0
    site = drawn.conditions.site
    for parameter, values in ((0, fit.model.spots.log_peak - np.log(drawn.peak_dn)),
                              (1, fit.model.spots.log_sigma - np.log(drawn.sigma_px))):  # fmt: skip
        covariance = numbers.covariance_of(parameter)
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
    plain = numbers_of_fit(fit).covariance
    assert np.mean(np.diag(numbers.covariance)[::4]) > 3 * np.mean(np.diag(plain)[::4])
