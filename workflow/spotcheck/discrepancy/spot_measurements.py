"""Spot parameters of a fit with their covariance, to which laws across frames are fitted.

The spot parameters of a frame are ln peak, ln σ, x and y, with the peak in DN, the width σ_g and the centre in px. A
law makes brightness and width depend on the conditions of a frame, such as its exposure.
"""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Design, FrameParameters
from spotcheck.discrepancy.joint_fit import JointFit
from spotcheck.discrepancy.normal_equations import invert_information


@dataclass(frozen=True)
class SpotMeasurements:
    """Spot parameters of F frames with their covariance."""

    design: Design  # conditions of the frames
    spots: FrameParameters  # spot parameters of the frames
    covariance: np.ndarray  # covariance of ln peak, ln σ, x, y of frame after frame [4F, 4F]
    # Variance of each spot parameter by granular light, which `covariance` contains; mean over the frames.
    field_variance: tuple[float, ...] = (0.0,) * SPOT_PARAMETERS

    @property
    def observations(self) -> np.ndarray:
        """ln peak, then ln σ_g of all frames [2F]."""
        return np.concatenate([self.spots.log_peak, self.spots.log_sigma])

    def covariance_of(self, *parameters: int) -> np.ndarray:
        """Return the covariance [nF, nF] of n spot parameters of all frames, one parameter after the other.

        Parameters are numbered: 0 ln peak, 1 ln σ, 2 x, 3 y.
        """
        first = SPOT_PARAMETERS * np.arange(len(self.spots.x))
        index = np.concatenate([first + parameter for parameter in parameters])
        return self.covariance[np.ix_(index, index)]


def measure_spots(fit: JointFit, by_field: np.ndarray | None = None) -> SpotMeasurements:
    """Return the spot parameters of a fit with their covariance.

    Parameters
    ----------
    fit : JointFit
        Fit of the spots of F frames.
    by_field : array [4F, 4F] or None
        Covariance that granular light adds; None without granular light.
    """
    covariance = covariance_of_spots(fit)
    if by_field is None:
        return SpotMeasurements(fit.model.design, fit.model.spots, covariance)
    field_variance = tuple(np.diag(by_field).reshape(-1, SPOT_PARAMETERS).mean(axis=0))
    return SpotMeasurements(fit.model.design, fit.model.spots, covariance + by_field, field_variance)


def covariance_of_spots(fit: JointFit) -> np.ndarray:
    """Return the covariance of ln peak, ln σ, x, y of frame after frame [4F, 4F], from the Fisher information of a fit.

    It contains the uncertainty that the fitted parameters of sensor and effects add, and that of a free light shape.
    ln peak and ln σ have no unit, x and y are in px.
    """
    # The spot parameters are the first unknowns of the normal equations, which hold after elimination of the shape.
    count = SPOT_PARAMETERS * fit.equations.frame_count
    return invert_information(fit.equations.information)[:count, :count]
