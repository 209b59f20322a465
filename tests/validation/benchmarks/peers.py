"""Estimators of other packages, one small function each: (image [e-], start) → both widths [px] and whether it says
that it converged (None: it says nothing).

Packages are imported inside the functions, so that a missing one costs its own row only. Where a package accepts a
start, it gets the same one as all others.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from tests.validation.benchmarks.spots import MAJOR, MINOR, X, Y, mean_image, slopes

Answer = tuple[float, float, bool | None]
Answers = tuple[np.ndarray, Sequence[bool | None]]
# Migrad and Poisson logarithms need a mean above 0.
LEAST_E = 1e-9


class Sample(NamedTuple):
    """Images [n, rows, columns] with the true widths [n, 2], their bounds [n, 2] and a start [n, 7] for those who take
    one."""

    images: np.ndarray
    widths: np.ndarray
    bounds: np.ndarray
    starts: np.ndarray


def _answer(theta, converged: bool | None = True) -> Answer:
    low, high = sorted((abs(float(theta[MAJOR])), abs(float(theta[MINOR]))))
    return high, low, converged


def _curve_fit(image, start, sigma=None) -> np.ndarray:
    from scipy.optimize import curve_fit

    def model(_, *theta):
        return mean_image(theta).ravel()

    def jacobian(_, *theta):
        return slopes(theta).reshape(7, -1).T

    return curve_fit(model, None, image.ravel(), p0=start, sigma=sigma, jac=jacobian)[0]


def scipy_unweighted(image, start) -> Answer:
    """Least squares with equal weights."""
    return _answer(_curve_fit(image, start))


def scipy_data_weights(image, start) -> Answer:
    """Least squares with the data as their own variance."""
    return _answer(_curve_fit(image, start, np.sqrt(np.maximum(image, 1.0)).ravel()))


def scipy_reweighted(image, start) -> Answer:
    """Least squares three times, each with the last model as variance: the likelihood's root."""
    for _ in range(3):
        start = _curve_fit(image, start, np.sqrt(np.maximum(mean_image(start), 1.0)).ravel())
    return _answer(start)


def lmfit_model(image, start) -> Answer:
    """Least squares through `Model`, with its numeric Jacobian."""
    import lmfit

    def spot(x, amplitude, x0, y0, major, minor, orientation, offset):
        return mean_image((amplitude, x0, y0, major, minor, orientation, offset)).ravel()

    model = lmfit.Model(spot)
    parameters = model.make_params(**dict(zip(model.param_names, start, strict=True)))
    result = model.fit(image.ravel(), parameters, x=0.0)
    return _answer([result.params[name].value for name in model.param_names], bool(result.success))


def astropy_fitter(image, start, fitter_name: str) -> Answer:
    """Least squares by one of the package's fitters: MINPACK, through the older interface or `least_squares`, or the
    trust region that it recommends."""
    from astropy.modeling import fitting, models

    amplitude, x0, y0, major, minor, orientation, offset = start
    model = models.Gaussian2D(amplitude, x0, y0, major, minor, orientation) + models.Const2D(offset)
    fitter = getattr(fitting, fitter_name)()
    x, y = np.broadcast_arrays(X, Y)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = fitter(model, x, y, image)
    found = fitter.fit_info
    low, high = sorted((abs(fitted.x_stddev_0.value), abs(fitted.y_stddev_0.value)))
    return high, low, found["ierr"] in (1, 2, 3, 4) if "ierr" in found else bool(found.success)


def iminuit_poisson(image, start) -> Answer:
    """Poisson likelihood by Migrad."""
    import iminuit

    def cost(theta):
        mean = np.maximum(mean_image(theta), LEAST_E)
        return float(np.sum(mean - image * np.log(mean)))

    def gradient(theta):
        mean = np.maximum(mean_image(theta), LEAST_E)
        return slopes(theta).reshape(7, -1) @ (1 - image / mean).ravel()

    minuit = iminuit.Minuit(cost, start, grad=gradient)
    minuit.errordef = iminuit.Minuit.LIKELIHOOD
    minuit.strategy = 0
    # First steps of about a bound: with those it is a little faster than with its own.
    minuit.errors = [10.0, 0.01, 0.01, 0.01, 0.01, 0.001, 0.1]
    minuit.migrad()
    return _answer(minuit.values, bool(minuit.valid))


def picasso_rotated(image, start, mle: bool, tolerance: float, most: int) -> Answer:
    """Poisson likelihood or least squares, up to a tolerance or a number of steps."""
    from picasso.fitting import gaussfit

    starts = start[None, [0, 1, 2, 3, 4, 6, 5]]
    theta, _, states, _ = gaussfit.fit_spots(gaussfit.ROTATED, image[None], starts, mle, tolerance, most)
    return _answer(theta[0], bool(states[0] == gaussfit.FIT_STATE_CONVERGED))


def picasso_integrated(image, start) -> Answer:
    """Poisson likelihood of a pixel-integrated spot along the axes."""
    from picasso import gaussmle

    most = 1000
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        theta, _, _, iterations = gaussmle.gaussmle(image[None].astype(np.float32), 1e-3, most)
    return float(theta[0, 4]), float(theta[0, 5]), bool(iterations[0] < most)


def laserbeamsize_moments(image, start) -> Answer:
    """Second moments in a rectangle that follows the spot."""
    import laserbeamsize

    # Diameters are four widths.
    major, minor = np.array(laserbeamsize.beam_size(image)[2:4], float) / 4
    return major, minor, None


def galsim_moments(image, start) -> Answer:
    """Moments weighted by the Gaussian that they give."""
    import galsim

    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    # Images of this package count pixels from 1.
    centre = galsim.PositionD(start[1] + 1, start[2] + 1)
    picture, width = galsim.Image(image - border.mean()), float(np.sqrt(start[MAJOR] * start[MINOR]))
    shape = galsim.hsm.FindAdaptiveMom(picture, guess_sig=width, guess_centroid=centre, strict=False)
    # |g| = (1 − q)/(1 + q) for the ratio q of the axes
    g = abs(shape.observed_shape.g)
    ratio = (1 + g) / (1 - g)
    return shape.moments_sigma * ratio**0.5, shape.moments_sigma / ratio**0.5, shape.moments_status == 0


def one_by_one(given: Sample, fit: Callable[..., Answer]) -> Answers:
    """Both widths of every image by an estimator of one image, and whether it says that it converged."""
    answers = []
    for image, start in zip(given.images, given.starts, strict=True):
        try:
            answers.append(fit(image, start))
        except RuntimeError:
            answers.append((np.nan, np.nan, False))
    return np.array([a[:2] for a in answers]), [a[2] for a in answers]


class Estimator(NamedTuple):
    """An estimator: its name and package, what it estimates by, how many parameters it finds, what fits a sample of
    images, a remark, and whether it integrates the spot over pixels."""

    name: str
    package: str
    kind: str
    parameters: int
    run: Callable[[Sample], Answers]
    remark: str = ""
    integrated: bool = False


def _peer(name: str, package: str, kind: str, parameters: int, fit: Callable[..., Answer], remark: str) -> Estimator:
    return Estimator(name, package, kind, parameters, partial(one_by_one, fit=fit), remark)


LEAST_SQUARES, LIKELIHOOD, MOMENTS = "least squares", "likelihood", "moments"
# Tolerances and largest numbers of steps: of picasso's pipeline on a CPU, of `fit_spots` by default, and tight ones.
_PICASSO = (
    ("lsq", LEAST_SQUARES, "its CPU default, tolerance 1e-2", 1e-2, 200),
    ("lsq, tight", LEAST_SQUARES, "tolerance 1e-9", 1e-9, 200),
    ("mle", LIKELIHOOD, "its CPU default, tolerance 1e-5", 1e-5, 100),
    ("mle, tight", LIKELIHOOD, "tolerance 1e-9", 1e-9, 100),
    ("mle, loose", LIKELIHOOD, "default of fit_spots, tolerance 1e-2", 1e-2, 20),
)
PEERS = (
    _peer("scipy curve_fit", "scipy", LEAST_SQUARES, 7, scipy_unweighted, "analytic Jacobian"),
    _peer("scipy, weights of data", "scipy", LEAST_SQUARES, 7, scipy_data_weights, "1/√data, analytic Jacobian"),
    _peer("scipy, reweighted", "scipy", LIKELIHOOD, 7, scipy_reweighted, "3 fits with 1/√model, analytic Jacobian"),
    _peer("lmfit", "lmfit", LEAST_SQUARES, 7, lmfit_model, "Model, leastsq"),
    *(_peer(f"astropy {name}", "astropy", LEAST_SQUARES, 7,
            partial(astropy_fitter, fitter_name=f"{name}LSQFitter"), "Gaussian2D + Const2D")
      for name in ("LevMar", "LM", "TRF")),
    _peer("iminuit", "iminuit", LIKELIHOOD, 7, iminuit_poisson, "Migrad, strategy 0, analytic gradient"),
    *(_peer(f"picasso {name}", "picassosr", kind, 7,
            partial(picasso_rotated, mle=kind == LIKELIHOOD, tolerance=tolerance, most=most), remark)
      for name, kind, remark, tolerance, most in _PICASSO),
    _peer("laserbeamsize", "laserbeamsize", MOMENTS, 5, laserbeamsize_moments, "ISO 11146; takes no start"),
    _peer("galsim hsm", "galsim", MOMENTS, 6, galsim_moments, "adaptive moments, mean of the border taken off"),
    _peer("picasso gaussmle", "picassosr", LIKELIHOOD, 6, picasso_integrated,
          "pixel-integrated, own start, tolerance 1e-3")._replace(integrated=True),
)  # fmt: skip
