"""The spot fit: an elliptical Gaussian with free centre, two widths, orientation, amplitude and offset.

Maximum likelihood by the distribution of a reading (`estimate.reading_kernel`): shot, dark and read noise, gain,
rounding; clipped pixels by the probability of being clipped; NaN pixels are left out. With equal weights it is the
paper's estimator, unweighted least squares, and needs no sensor.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.fitted import NAMES, SpotFits
from spotcheck.fitting.reading_kernel import Law, law_of
from spotcheck.fitting.scoring import EQUAL, LIKELIHOOD, VARIANCE, one_pass
from spotcheck.fitting.search import NARROWEST, chart_of, constrained, least_squares, theta_of, to_the_root
from spotcheck.fitting.start import find_start
from spotcheck.io.store import flag
from spotcheck.model import spot
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor
from spotcheck.sensor.pixel_maps import PixelMaps

WEIGHTINGS = {"likelihood": LIKELIHOOD, "equal": EQUAL}
# A spot has an orientation when its axes differ by more than noise makes of a round one: this χ² of 2 degrees of
# freedom is exceeded by one round spot in 1000.
ROUND = 13.8
# A width or an amplitude known to no better than this part of itself was not measured.
KNOWN = 0.5


class Design(NamedTuple):
    """What is fitted: which of the seven are free, the values of the others (orientation in rad), ties and shapes."""

    free: np.ndarray
    held: np.ndarray
    circular: bool
    top_hat: bool

    @property
    def shaped(self) -> bool:
        """With all seven free the search runs in the inverse covariance, where a round spot is no special point."""
        return not bool(self.free.all())


def fit_spots(
    images: np.ndarray | Iterable[np.ndarray],
    sensor: SensorModel | None = None,
    *,
    weighting: str = "likelihood",
    top_hat: bool = False,
    integrated: bool = False,
    fixed: Mapping[str, float] | None = None,
    circular: bool = False,
    maps: PixelMaps | None = None,
) -> SpotFits:
    """Fit one elliptical Gaussian spot on a constant offset in each image, by maximum likelihood.

    No start values are needed. The likelihood is that of the readings under the sensor's own law: shot and read noise,
    rounding, and clipped pixels by the probability of being clipped. The fit reaches the Cramér–Rao bound, which
    `spot_bounds` gives.

    Parameters
    ----------
    images : one image [rows, columns] in DN, or several, of one size or of many. Pixels that are NaN or masked are left
        out. Readings need not be whole: a mean of n frames has their gain over n and their read noise times √n. A
        single image gives a single spot: plain numbers in place of arrays.
    sensor : gain, read noise, black level, full scale and bend of the response; dark current is part of the fitted
        offset.
    weighting : "likelihood", or "equal" for unweighted least squares, with the errors that the sensor's noise causes.
        It does without a sensor: errors are then those of white noise as large as the residuals, which is too small
        where light brings shot noise (by a factor of two to three for a bright spot), and χ² is NaN.
    top_hat : fit the Gaussian under a plateau at exp(−1/4) of its peak (Eqs. 39–40 of the paper).
    integrated : light is integrated over each pixel and not sampled at its centre: amplitude and widths are those of
        the light before, to 2e-3/σ⁴ of the peak for a width of σ px.
    fixed : parameters by name that are held at a value, such as `{"offset": 40.0}`; their standard error is 0.
    circular : fit one width for both axes.
    maps : offsets and gains of the images' pixels, which enter the likelihood of every reading with what they are
        uncertain by; equal weights take all pixels for alike.

    Returns
    -------
    SpotFits
        Values and standard errors by name, covariance, χ² and status of each spot; centres count from the centre of
        the image's first pixel. Where `status` is "not_converged" every value is NaN. A spot that is round within its
        noise has an orientation with infinite standard error.

    Raises
    ------
    ValueError
        An image that is not two-dimensional, a likelihood without a sensor, or options that exclude each other.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> y, x = np.mgrid[:48, :64]
    >>> photons = 900 * np.exp(-(((x - 31.3) / 7) ** 2 + ((y - 22.6) / 5) ** 2) / 2)
    >>> fit = spotcheck.fit_spots(sensor.draw(photons, rng=1), sensor)
    >>> fit
    fitted spot: ok, χ² per degree of freedom 1.02
    amplitude           454.0 ± 1.6 DN
    x_centre         31.313 ± 0.018 pixel
    y_centre         22.608 ± 0.013 pixel
    sigma_major       6.980 ± 0.015 pixel
    sigma_minor       4.977 ± 0.011 pixel
    orientation       179.91 ± 0.24 degree
    offset           19.962 ± 0.057 DN
    sigma_mean      5.9790 ± 0.0095 pixel
    >>> print(f"{fit.sigma_major:.2f} ± {fit.sigma_major_stderr:.2f} px")
    6.98 ± 0.01 px
    """
    if weighting not in WEIGHTINGS:
        raise ValueError(f"weighting: {weighting!r} is none of {', '.join(WEIGHTINGS)}")
    if weighting == "likelihood" and sensor is None:
        raise ValueError("sensor: the likelihood needs a gain and a read noise; without them use equal weights")
    design = _design(dict(fixed or {}), circular, top_hat, integrated)
    law, shapes, outcomes = law_of(None if sensor is None else check_sensor(sensor), maps), [], []
    between: dict[tuple[int, ...], Law] = {}
    single = getattr(images, "ndim", None) == 2
    each: Iterable[np.ndarray] = [np.asanyarray(images)] if single else images
    for number, image in enumerate(each):
        pixels, own = _pixels(image, number), law
        if weighting == "likelihood" and maps is None and not np.array_equal(pixels, np.rint(pixels), equal_nan=True):
            if pixels.shape not in between:
                between[pixels.shape] = _law_between(sensor, pixels.shape)
            own = between[pixels.shape]
        if sensor is not None:
            pixels = sensor.linearize(pixels)
        if maps is not None:
            pixels = _on_maps(pixels, maps, number)
        shapes.append(pixels.shape)
        outcomes.append(_search(pixels, own, WEIGHTINGS[weighting], sensor is not None, design))
    size = int(design.free.sum())
    points, covariance, chi2 = (
        np.array([outcome[k] for outcome in outcomes]).reshape(len(outcomes), *shape)
        for k, shape in enumerate(((7,), (size, size), ()))
    )
    fits = _natural(points, covariance, chi2, np.array(shapes).reshape(-1, 2), design, integrated)
    return fits[0] if single else fits


def _pixels(image: np.ndarray, number: int) -> np.ndarray:
    """An image as the compiled code takes it, NaN where it is masked."""
    if np.ma.isMaskedArray(image):
        image = np.ma.filled(image.astype(float), np.nan)
    pixels = np.asarray(image, dtype=float)
    if pixels.ndim != 2:
        raise ValueError(f"images: number {number} has the shape {pixels.shape}; each must be [rows, columns]")
    return np.ascontiguousarray(pixels)


def _law_between(sensor: SensorModel | None, shape: tuple[int, ...]) -> Law:
    """The law of readings between whole numbers: that of pixels whose offsets are known to be such."""
    return law_of(sensor, PixelMaps(np.zeros(shape), np.ones(shape)))


def _on_maps(pixels: np.ndarray, maps: PixelMaps, number: int) -> np.ndarray:
    """The image, NaN where the maps know nothing of a pixel."""
    if pixels.shape != np.shape(maps.gain) or pixels.shape != np.shape(maps.offset_dn):
        raise ValueError(f"maps: have the shape {np.shape(maps.gain)}, but image {number} has {pixels.shape}")
    return np.where(np.isfinite(maps.offset_dn) & np.isfinite(maps.gain), pixels, np.nan)


def _design(held: dict[str, float], circular: bool, top_hat: bool, integrated: bool) -> Design:
    if unknown := set(held) - set(NAMES[:7]):
        raise ValueError(f"fixed: {', '.join(sorted(unknown))} is none of {', '.join(NAMES[:7])}")
    if circular and {"sigma_minor", "orientation"} & set(held):
        raise ValueError("fixed: a circular spot has one width, sigma_major, and no orientation")
    if integrated and (top_hat or "amplitude" in held):
        raise ValueError("integrated: not together with a top hat or a fixed amplitude")
    for name, value in held.items():
        if not np.isfinite(value) or (name.startswith("sigma") and value < NARROWEST):
            raise ValueError(f"fixed: {name} is {value!r}; a finite number, and for a width at least {NARROWEST} px")
    free = np.array([name not in held for name in NAMES[:7]])
    values = np.array([held.get(name, 0.0) for name in NAMES[:7]], dtype=float)
    values[5] = np.radians(values[5])
    if circular:
        free[4:6] = False
    if integrated:
        values[3:5] = np.sqrt(values[3:5] ** 2 + spot.PIXEL_VARIANCE)
    return Design(free, values, circular, top_hat)


def _search(pixels: np.ndarray, law: Law, weighting: int, known_noise: bool, design: Design):
    """Point [7], covariance of the free parameters and χ² per degree of freedom of one image; NaN without a root."""
    free, shaped, circular, flat = design.free, design.shaped, design.circular, design.top_hat
    size = int(free.sum())
    nothing = np.full(7, np.nan), np.full((size, size), np.nan), np.nan
    point, found = find_start(pixels, law, flat)
    if not found:
        return nothing
    if shaped:
        point = constrained(point, free, circular, design.held)
        point = least_squares(pixels, point, law, flat, free, shaped, circular)
    point, information, chi2, used, good = to_the_root(pixels, point, weighting, law, flat, free, shaped, circular)
    if not good:
        return nothing
    covariance, freedom = _inverse(information), max(used - size, 1)
    if weighting == EQUAL and known_noise:
        chart = chart_of(point, free, shaped, circular)
        _, spread, chi2, used = one_pass(pixels, theta_of(point, shaped), VARIANCE, law, flat)
        covariance, freedom = covariance @ (chart.T @ spread @ chart) @ covariance, max(used - size, 1)
    elif weighting == EQUAL:
        covariance, chi2 = covariance * chi2 / freedom, np.nan
    return point, covariance, chi2 / freedom


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse of a positive definite matrix, scaled by its diagonal first: its units differ by many powers of ten."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)


def _natural(points, covariance, chi2, shapes, design: Design, integrated: bool) -> SpotFits:
    """From points of the search to parameters by name."""
    count, free = len(points), design.free
    if design.shaped:
        value, slopes = points.copy(), np.broadcast_to(np.eye(7), (count, 7, 7)).copy()
        if design.circular:
            slopes[:, 4, 3] = 1.0
        round_ = np.zeros(count, bool)
    else:
        value, slopes = _widths(points)
        round_ = _is_round(points, covariance)
    if integrated:
        _without_pixel(value, slopes)
    slopes = slopes[:, :, free]
    own = slopes @ covariance @ slopes.transpose(0, 2, 1)
    mean = (own[:, 3, 3] + own[:, 4, 4] + 2 * own[:, 3, 4]) / 4
    variance = np.concatenate([np.einsum("nii->ni", own), mean[:, None]], axis=1)
    stderr = np.sqrt(np.maximum(variance, 0.0))
    if design.circular:
        round_[:] = np.isfinite(value[:, 0])
    own[round_, 5, :] = own[round_, :, 5] = 0.0
    own[round_, 5, 5] = stderr[round_, 5] = np.inf
    value = np.append(value, value[:, 3:5].mean(axis=1, keepdims=True), axis=1)
    value[:, 5] = np.degrees(value[:, 5]) % 180.0
    stderr[:, 5] = np.degrees(stderr[:, 5])
    own[:, 5, :] = np.degrees(own[:, 5, :])
    own[:, :, 5] = np.degrees(own[:, :, 5])
    return SpotFits(value, stderr, own, chi2, _flags(value, stderr, shapes))


def _widths(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude, centre, widths, orientation [rad], offset of θ [n, 7], and their derivatives [n, 7, 7]."""
    a, b, c = theta[:, 3], theta[:, 4], theta[:, 5]
    half, mean = (a - c) / 2, (a + c) / 2
    spread = np.hypot(half, b)
    orientation = np.arctan2(-b, -half) / 2
    u, v = np.cos(orientation), np.sin(orientation)
    curvature = np.stack([mean - spread, mean + spread])
    value = theta.copy()
    value[:, 3:5], value[:, 5] = curvature.T**-0.5, orientation
    slopes = np.broadcast_to(np.eye(7), (len(theta), 7, 7)).copy()
    along, across = np.stack([u * u, 2 * u * v, v * v]), np.stack([v * v, -2 * u * v, u * u])
    slopes[:, 3, 3:6] = (-0.5 * curvature[0] ** -1.5 * along).T
    slopes[:, 4, 3:6] = (-0.5 * curvature[1] ** -1.5 * across).T
    turn = np.stack([-u * v, u * u - v * v, u * v])
    slopes[:, 5, 3:6] = (turn / -np.maximum(2 * spread, 1e-300)).T
    return value, slopes


def _is_round(theta: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Whether (a − c)/2 and b are 0 within their errors, which makes the spot round [n]."""
    form = np.zeros((2, 7))
    form[0, 3], form[0, 5], form[1, 4] = 0.5, -0.5, 1.0
    ellipse = theta @ form.T
    known = np.isfinite(theta[:, 0])
    out = np.zeros(len(theta), bool)
    out[known] = (
        np.einsum(
            "ni,ni->n",
            ellipse[known],
            np.linalg.solve(form @ covariance[known] @ form.T, ellipse[known][..., None])[..., 0],
        )
        < ROUND
    )
    return out


def _without_pixel(value: np.ndarray, slopes: np.ndarray) -> None:
    """Take the pixel's own width off, in place: σ² − 1/12 along each axis, the peak raised as the area shrinks."""
    seen = value[:, 3:5].copy()
    own = np.sqrt(np.maximum(seen**2 - spot.PIXEL_VARIANCE, 1e-6))
    raised = np.prod(seen, axis=1) / np.prod(own, axis=1)
    # d ln A = d ln(σ seen) − d ln(σ own), with σ own dσ own = σ seen dσ seen
    for k in (0, 1):
        share = 1 / seen[:, k] - seen[:, k] / own[:, k] ** 2
        slopes[:, 0, :] += (value[:, 0] * share)[:, None] * slopes[:, 3 + k, :]
    slopes[:, 0, :] *= raised[:, None]
    slopes[:, 3:5, :] *= (seen / own)[:, :, None]
    value[:, 0] *= raised
    value[:, 3:5] = own


def _flags(value: np.ndarray, stderr: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Flags [n]: no root; or an amplitude, width or centre outside what the image can tell."""
    amplitude, x, y, major, minor = value[:, :5].T
    rows, columns = shapes.T
    with np.errstate(invalid="ignore"):
        trusted = (amplitude > 0) & (minor > 0.3) & (major < shapes.max(axis=1))
        trusted &= (x >= -0.5) & (x <= columns - 0.5) & (y >= -0.5) & (y <= rows - 0.5)
        trusted &= np.all(stderr[:, [0, 3, 4]] <= KNOWN * np.abs(value[:, [0, 3, 4]]), axis=1)
    return np.where(np.isnan(amplitude), flag("not_converged"), np.where(trusted, 0, flag("at_limit")))


def model_image(value: np.ndarray, side: int, top_hat: bool = False) -> np.ndarray:
    """Fitted spot [side, side] in DN for values in the order of `PARAMETERS`, centre relative to the crop."""
    amplitude, x, y, major, minor, orientation, offset, _ = value
    pixel = np.arange(side, dtype=float)
    light = spot.elliptical_gaussian(
        pixel[None, :], pixel[:, None], amplitude, x, y, major, minor, np.radians(orientation)
    )
    return (spot.top_hat(light, amplitude) if top_hat else light) + offset
