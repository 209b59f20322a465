"""How well one image can tell a spot: Cramér–Rao bounds of a design, under the law that the spot fit uses."""

from typing import NamedTuple

import numpy as np

from spotcheck.fitting import fisher
from spotcheck.model import spot
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor, dark_signal


class SpotBounds(NamedTuple):
    """Smallest standard errors that an unbiased fit of one image can have, by the names and in the units of `SpotFits`:
    DN, px, degrees. Infinite where the image does not tell a parameter.

    Examples
    --------
    >>> import spotcheck
    >>> sensor = spotcheck.SensorModel(0.11, 13.0, black_level_dn=40, full_scale_dn=1023)
    >>> bounds = spotcheck.spot_bounds(sensor, (50, 50), amplitude=600, sigma_major=6.5)
    >>> round(bounds.x_centre, 4), bounds.orientation
    (0.0062, inf)
    """

    amplitude: float
    x_centre: float
    y_centre: float
    sigma_major: float
    sigma_minor: float
    orientation: float
    offset: float
    sigma_mean: float


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
    """Cramér–Rao bounds on the parameters of a spot, all seven of them free, in one image.

    The information of each pixel is that of the sensor's law, with noise, rounding and clipping (Eqs. 34, 37 and 38 of
    the paper); `fit_spots` reaches these bounds. Errors of a mean over n images are smaller by √n.

    Parameters
    ----------
    sensor : gain, read noise, black level and full scale, and dark current where there is an exposure.
    shape : rows and columns of the image.
    amplitude : peak of the Gaussian above its offset [DN]; K η times the photons on the brightest pixel.
    sigma_major, sigma_minor : standard deviations along the long and the short axis [px]; without the second the spot
        is round.
    orientation : of the long axis, from +x (right) towards +y (down) [degree].
    offset : reading under the Gaussian [DN]; by default that without light: black level, and dark current during
        `exposure_s`.
    x_centre, y_centre : column and row of the centre [px]; by default the middle of the image.
    exposure_s : exposure time [s], for dark current alone.
    top_hat : the Gaussian is cut to a plateau at exp(−1/4) of its peak.

    Returns
    -------
    SpotBounds
        Standard errors by name. Of a round spot the orientation is infinite, and both widths are along fixed axes.

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
        light = spot.elliptical_gaussian(x, y, amplitude, x0, y0, major, minor, orientation)
        return ((spot.top_hat(light, amplitude) if top_hat else light) + offset - black) / gain

    theta = (amplitude, x0, y0, sigma_major, minor, np.radians(orientation), offset)
    matrix = fisher.of_mean(mean_e, theta, lambda mean: fisher.reading_information(mean, sensor))
    # A turn of a round spot changes nothing; its slopes are 0 but for rounding.
    told = np.array([k for k in range(7) if k != 5 or minor < sigma_major])
    covariance = np.full((7, 7), np.inf)
    covariance[np.ix_(told, told)] = _inverse(matrix[np.ix_(told, told)])
    error = np.sqrt(np.diag(covariance))
    error[5] = np.degrees(error[5])
    mean = np.sqrt((covariance[3, 3] + covariance[4, 4] + 2 * covariance[3, 4]) / 4)
    return SpotBounds._make([*error.tolist(), float(mean)])


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """I⁻¹, infinite where the matrix is singular. Scaled by its diagonal first: units differ by powers of ten."""
    diagonal = np.diag(matrix)
    if (diagonal > 0).all():
        scale = 1 / np.sqrt(diagonal)
        scaled = matrix * np.outer(scale, scale)
        if np.linalg.eigvalsh(scaled)[0] > 1e-12:
            return np.linalg.inv(scaled) * np.outer(scale, scale)
    return np.full(matrix.shape, np.inf)
