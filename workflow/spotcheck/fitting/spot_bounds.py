"""Cramér–Rao bounds on the parameters of a spot in one image, under the distribution that the spot fit uses."""

from typing import NamedTuple

import numpy as np

from spotcheck.fitting import fisher
from spotcheck.fitting.spotfit import invert_information
from spotcheck.model import spot
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor, dark_signal

# Index of the orientation among the parameters of a spot.
ORIENTATION = 5
# Smaller eigenvalues of an information matrix with a diagonal of 1 are rounding errors.
LEAST_EIGENVALUE = 1e-12


class SpotBounds(NamedTuple):
    """Smallest standard errors that an unbiased fit of one image can have; infinite if a parameter is undetermined.

    Examples
    --------
    >>> import spotcheck
    >>> sensor = spotcheck.SensorModel(0.11, 13.0, black_level_dn=40, full_scale_dn=1023)
    >>> bounds = spotcheck.spot_bounds(sensor, (50, 50), amplitude=600, sigma_major=6.5)
    >>> round(bounds.x_centre, 4), bounds.orientation
    (0.0062, inf)
    """

    amplitude: float  # peak of the Gaussian above its offset [DN]
    x_centre: float  # column of the centre [px]
    y_centre: float  # row of the centre [px]
    sigma_major: float  # standard deviation along the long axis [px]
    sigma_minor: float  # standard deviation along the short axis [px]
    orientation: float  # direction of the long axis [deg]
    offset: float  # reading under the Gaussian [DN]
    sigma_mean: float  # mean of both widths [px]


def spot_bounds(
    sensor: SensorModel,
    shape: tuple[int, int],
    *,
    amplitude: float,
    sigma_major: float,
    sigma_minor: float | None = None,
    orientation: float = 0.0,
    offset: float | None = None,
    x_centre: float | None = None,
    y_centre: float | None = None,
    exposure_s: float = 0.0,
    top_hat: bool = False,
) -> SpotBounds:
    """Return Cramér–Rao bounds on the seven free parameters of a spot in one image (Eqs. 34, 37 and 38 of the paper).

    The information of each pixel includes noise, rounding and clipping of the sensor. `fit_spots` reaches these bounds.
    Errors of a mean over n images are smaller by √n.

    Parameters
    ----------
    sensor : SensorModel
        Gain, read noise, black level and full scale, and dark current if there is an exposure.
    shape : tuple of int
        Rows and columns of the image.
    amplitude : float
        Peak of the Gaussian above its offset [DN]; K η times the photons on the brightest pixel.
    sigma_major, sigma_minor : float
        Standard deviations along the long and the short axis [px]; without the second the spot is round.
    orientation : float
        Direction of the long axis, from +x (right) towards +y (down) [degree].
    offset : float, optional
        Reading under the Gaussian [DN]; by default the black level plus dark current during `exposure_s`.
    x_centre, y_centre : float, optional
        Column and row of the centre [px]; by default the middle of the image.
    exposure_s : float
        Exposure time [s], for dark current alone.
    top_hat : bool
        Whether the Gaussian is cut to a plateau at exp(−1/4) of its peak.

    Returns
    -------
    SpotBounds
        Standard errors by name. That of the orientation of a round spot is infinite; its widths are those along fixed
        axes.

    Raises
    ------
    ValueError
        An amplitude or a width that is not above 0, a short axis that is longer than the long one, an empty image.

    Examples
    --------
    >>> import spotcheck
    >>> sensor = spotcheck.SensorModel(0.11, 13.0, black_level_dn=40, full_scale_dn=1023)
    >>> bounds = spotcheck.spot_bounds(sensor, (50, 50), amplitude=600, sigma_major=6.5, sigma_minor=4.8)
    >>> print(f"one image tells the width to {bounds.sigma_mean:.4f} px")
    one image tells the width to 0.0040 px
    """
    minor = sigma_major if sigma_minor is None else sigma_minor
    rows, columns = shape
    for name, value in (("amplitude", amplitude), ("sigma_major", sigma_major), ("sigma_minor", minor)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name}: is {value!r}; it must be a number above 0")
    if minor > sigma_major:
        raise ValueError(f"sigma_minor: is {minor!r}, longer than sigma_major, {sigma_major!r}; exchange the two")
    if rows < 1 or columns < 1:
        raise ValueError(f"shape: is {shape!r}; it must be the rows and columns of an image")
    gain, black = check_sensor(sensor).gain_dn_per_e, sensor.black_level_dn
    if offset is None:
        offset = black + dark_signal(sensor.dark_current_e_per_s * exposure_s, gain)
    x0 = (columns - 1) / 2 if x_centre is None else x_centre
    y0 = (rows - 1) / 2 if y_centre is None else y_centre
    x, y = np.arange(columns, dtype=float)[None, :], np.arange(rows, dtype=float)[:, None]

    def mean_e(amplitude, x0, y0, major, minor, orientation, offset):
        """Return the mean electrons [row, column] of the image; orientation in rad."""
        light = spot.elliptical_gaussian(x, y, amplitude, x0, y0, major, minor, orientation)
        return ((spot.top_hat(light, amplitude) if top_hat else light) + offset - black) / gain

    theta = (amplitude, x0, y0, sigma_major, minor, np.radians(orientation), offset)
    matrix = fisher.information_of_mean(mean_e, theta, lambda mean: fisher.reading_information(mean, sensor))
    # The orientation of a round spot has no information but rounding errors.
    determined = np.array([k for k in range(len(theta)) if k != ORIENTATION or minor < sigma_major])
    block = np.ix_(determined, determined)
    covariance = np.full(matrix.shape, np.inf)
    if _is_positive_definite(matrix[block]):
        covariance[block] = invert_information(matrix[block])
    stderr = np.sqrt(np.diag(covariance))
    stderr[ORIENTATION] = np.degrees(stderr[ORIENTATION])
    mean_stderr = np.sqrt((covariance[3, 3] + covariance[4, 4] + 2 * covariance[3, 4]) / 4)
    return SpotBounds._make([*stderr.tolist(), float(mean_stderr)])


def _is_positive_definite(matrix: np.ndarray) -> bool:
    """Return whether a symmetric matrix, scaled to a diagonal of 1, has only eigenvalues above rounding errors."""
    diagonal = np.diag(matrix)
    if not (diagonal > 0).all():
        return False
    scale = 1 / np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(matrix * np.outer(scale, scale))[0] > LEAST_EIGENVALUE)
