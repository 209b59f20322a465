"""Brightness, width and centre of the spots of a fit, with their covariance: what laws are fitted to."""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.frames import Design, FrameParameters
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import invert_information


@dataclass(frozen=True)
class SpotNumbers:
    """Brightness and width of F frames with their covariance."""

    design: Design  # conditions of the frames
    spots: FrameParameters  # spot of each frame
    covariance: np.ndarray  # of ln peak, ln σ, x, y of frame after frame [4F, 4F]
    field_variance: tuple[float, ...] = (0.0,) * 4  # part of the variances by granular light, mean over the frames

    @property
    def observations(self) -> np.ndarray:
        """ln peak, then ln σ_g of all frames [2F]."""
        return np.concatenate([self.spots.log_peak, self.spots.log_sigma])

    def covariance_of(self, *parameters: int) -> np.ndarray:
        """Return the covariance of parameters (0 … 3) of all frames, one parameter after the other."""
        frames = np.arange(len(self.spots.x))
        index = np.concatenate([4 * frames + parameter for parameter in parameters])
        return self.covariance[np.ix_(index, index)]


def numbers_of_fit(fit: JointFit, by_field: np.ndarray | None = None) -> SpotNumbers:
    """Return brightness and width of the spots of a fit.

    Parameters
    ----------
    fit : JointFit
        Fit of the spots.
    by_field : array [4F, 4F], optional
        What granular light adds to their covariance.
    """
    covariance = covariance_of_spots(fit)
    if by_field is None:
        return SpotNumbers(fit.model.design, fit.model.spots, covariance)
    of_field = tuple(np.diag(by_field).reshape(-1, 4).mean(axis=0))
    return SpotNumbers(fit.model.design, fit.model.spots, covariance + by_field, of_field)


def covariance_of_spots(fit: JointFit) -> np.ndarray:
    """Return the covariance of ln peak, ln σ, x, y of frame after frame [4F, 4F] by the information of a fit."""
    spots = 4 * fit.equations.frames
    return invert_information(fit.equations.information)[:spots, :spots]
