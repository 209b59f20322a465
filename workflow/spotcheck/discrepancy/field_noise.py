"""Covariance of fitted spot parameters by granular light.

Granular light is a random field that multiplies the light. Neighbouring pixels share it, and so do the frames of a
site. The spot parameters of a frame are ln peak, ln σ, x and y; F is the number of frames. A `FieldEstimate` has the
relative `variance` of the field and the standard deviation of its Gaussian correlation, `grain_px` [px].
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.evaluation import evaluate
from spotcheck.discrepancy.fields import FieldEstimate, correlated_area
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, FrameSet
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.residuals import place_on_sensor, select_all_pixels
from spotcheck.discrepancy.spot_measurements import covariance_of_spots
from spotcheck.discrepancy.validation import has_field

# Largest part of a spot's covariance that the field may have; the rest, by noise, keeps the covariance positive.
LARGEST_SHARE = 0.99


def covariance_by_field(fit: JointFit, frames: FrameSet, grains: FieldEstimate) -> np.ndarray:
    """Return the covariance that granular light adds to the spot parameters of a fit.

    Parameters
    ----------
    fit : JointFit
        Fit whose weights contain the variance of the field in single pixels.
    frames : FrameSet
        Frames of the fit.
    grains : FieldEstimate
        Field that is different at each site.

    Returns
    -------
    ndarray
        Covariance of ln peak, ln σ, x, y of frame after frame [4F, 4F].

    Notes
    -----
    The field has the relative variance V, and its Gaussian correlation covers a pixels. At a pixel of one frame, let
    g be (derivative of the mean reading by the spot parameters) × (by ln light) / (variance of the reading). Let h be
    the same of another frame of the site, smoothed by the correlation. The covariance of both frames' scores is
    a V Σ g h'. For a frame with itself, the covariance of the fit contains the part V Σ g g' already.
    """
    count = len(frames.left)
    covariance = np.zeros((count, SPOT_PARAMETERS, count, SPOT_PARAMETERS))
    grain_px = grains.grain_px if grains.grain_px > 0 else 0.0
    area, is_in_model = correlated_area(grain_px), has_field(fit.model)
    fit_covariance = covariance_of_spots(fit)
    for site in np.unique(fit.model.design.site):
        members = np.flatnonzero(fit.model.design.site == site)
        model = replace(fit.model, spots=fit.model.spots.select(members), design=fit.model.design.select(members))
        evaluation = evaluate(model, select_all_pixels(frames.select(members)), slice(0, len(members)))
        mean_slope = evaluation.moments.mean_slope
        slopes, by_log_light = mean_slope * evaluation.slopes, mean_slope * evaluation.light.spot
        # Weight of a reading by the noise and the field together.
        field_variance = 0.0 if is_in_model else grains.variance * by_log_light**2
        weight = evaluation.weight / (1 + field_variance * evaluation.weight)
        whitened = (slopes * np.sqrt(weight)).reshape(SPOT_PARAMETERS, len(members), -1)
        information = np.einsum("afp,bfp->fab", whitened, whitened, optimize=True)
        # g and a h of all frames of the site, at the same pixels of the sensor [spot parameter, frame, row, column].
        left, top = frames.left[members], frames.top[members]
        scores = np.array([place_on_sensor(slope * weight * by_log_light, left, top) for slope in slopes])
        smoothed = area * np.array([ndimage.gaussian_filter(score, (0, grain_px, grain_px)) for score in scores])
        # Covariances of scores [frame, parameter, frame, parameter]: by the field in single pixels, and by all of it.
        score_covariances = [
            grains.variance * np.einsum("afhw,bghw->fagb", scores, other, optimize=True) for other in (scores, smoothed)
        ]
        for f, first in enumerate(members):
            for g, second in enumerate(members):
                by_pixels, by_field = (
                    solve_positive(information[g], solve_positive(information[f], of_scores[f, :, g]).T).T
                    for of_scores in score_covariances
                )
                if f == g:
                    spot = slice(SPOT_PARAMETERS * first, SPOT_PARAMETERS * (first + 1))
                    by_field = by_field - share_in_fit(fit_covariance[spot, spot], by_pixels) * by_pixels
                covariance[first, :, second] = by_field
    return covariance.reshape(SPOT_PARAMETERS * count, SPOT_PARAMETERS * count)


def share_in_fit(fit_covariance: np.ndarray, by_pixels: np.ndarray) -> float:
    """Return the part, 0 to 1, of the covariance by the field in single pixels that the fit's covariance contains.

    Both are [4, 4], of one spot. The part is 1 unless the field's covariance exceeds that of the fit, whose weights
    then contain a weaker field.
    """
    largest_ratio = float(np.linalg.eigvals(solve_positive(fit_covariance, by_pixels)).real.max())
    return LARGEST_SHARE / largest_ratio if largest_ratio > LARGEST_SHARE else 1.0
