"""Covariance of spots by granular light, which neighbouring pixels and the frames of a site share."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.evaluation import evaluate
from spotcheck.discrepancy.fields import FieldEstimate, correlated_area
from spotcheck.discrepancy.frames import FrameSet
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.residuals import place_on_sensor, whole_crops
from spotcheck.discrepancy.spot_numbers import covariance_of_spots
from spotcheck.discrepancy.validation import has_field

# Part of a spot's covariance that the field may have at most: what is left of noise keeps it positive.
LARGEST_SHARE = 0.99


def covariance_by_field(fit: JointFit, frames: FrameSet, grains: FieldEstimate) -> np.ndarray:
    """Return the covariance that granular light adds to the spots of a fit.

    Parameters
    ----------
    fit : JointFit
        Fit whose readings have the variance of the field in single pixels.
    frames : FrameSet
        Frames of the fit.
    grains : FieldEstimate
        Field that is new at each site.

    Returns
    -------
    ndarray
        Covariance of ln peak, ln σ, x, y of frame after frame [4F, 4F].

    Notes
    -----
    A field of relative variance V, whose Gaussian correlation covers a pixels, gives the scores of two frames of a site
    the covariance a V Σ g h' with g = (derivative of the mean reading by the spot) · (by ln light) / (variance of the
    reading) of one and h that of the other, smoothed by the correlation. Of a single frame the part V Σ g g' of pixels
    with themselves is in the fit already.
    """
    count = len(frames.left)
    out = np.zeros((count, 4, count, 4))
    grain_px = grains.grain_px if grains.grain_px > 0 else 0.0
    area, is_in_model = correlated_area(grain_px), has_field(fit.model)
    in_fit = covariance_of_spots(fit)
    for site in np.unique(fit.model.design.site):
        members = np.flatnonzero(fit.model.design.site == site)
        model = replace(fit.model, spots=fit.model.spots.select(members), design=fit.model.design.select(members))
        at = evaluate(model, whole_crops(frames.select(members)), slice(0, len(members)))
        slopes, by_light = at.moments.mean_slope * at.slopes, at.moments.mean_slope * at.light.spot
        field = 0.0 if is_in_model else grains.variance * by_light**2
        weight = at.weight / (1 + field * at.weight)
        flat = (slopes * np.sqrt(weight)).reshape(4, len(members), -1)
        information = np.einsum("afp,bfp->fab", flat, flat, optimize=True)
        left, top = frames.left[members], frames.top[members]
        scores = np.array([place_on_sensor(slope * weight * by_light, left, top) for slope in slopes])
        grained = np.array([ndimage.gaussian_filter(score, (0, grain_px, grain_px)) for score in scores])
        products = [
            grains.variance * np.einsum("afhw,bghw->fagb", scores, other, optimize=True)
            for other in (scores, area * grained)
        ]
        for f, first in enumerate(members):
            for g, second in enumerate(members):
                of_pixels, of_field = (
                    solve_positive(information[g], solve_positive(information[f], product[f, :, g]).T).T
                    for product in products
                )
                if f == g:
                    covariance = in_fit[4 * first : 4 * first + 4, 4 * first : 4 * first + 4]
                    of_field = of_field - share_in_fit(covariance, of_pixels) * of_pixels
                out[first, :, second] = of_field
    return out.reshape(4 * count, 4 * count)


def share_in_fit(covariance: np.ndarray, of_field: np.ndarray) -> float:
    """Return the part of the field's covariance of a spot that the fit's covariance has, both [4, 4]: all of it, or
    less where the fit's estimate of the field is smaller."""
    largest = float(np.linalg.eigvals(solve_positive(covariance, of_field)).real.max())
    return LARGEST_SHARE / largest if largest > LARGEST_SHARE else 1.0
