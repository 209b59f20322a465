"""Estimators of other packages, one small function each: (image [e-], start) → both widths [px] and whether it says
that it converged (None: it says nothing).

Packages are imported inside the functions, so that a missing one costs its own row only. Where a package accepts a
start, it gets the same one as all others.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tests.validation.benchmarks.spots import MAJOR, MINOR, X, Y, mean_image, slopes

Answer = tuple[float, float, bool | None]
# Migrad and Poisson logarithms need a mean above 0.
LEAST_E = 1e-9


def _answer(theta, converged: bool | None = True) -> Answer:
    low, high = sorted((abs(float(theta[MAJOR])), abs(float(theta[MINOR]))))
    return high, low, converged


def _curve_fit(image, start, sigma=None) -> np.ndarray:
    from scipy.optimize import curve_fit

    return curve_fit(
        lambda _, *theta: mean_image(theta).ravel(),
        None,
        image.ravel(),
        p0=start,
        sigma=sigma,
        jac=lambda _, *theta: slopes(theta).reshape(7, -1).T,
    )[0]


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


def _astropy(fitter_name: str, image, start) -> Answer:
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


def astropy_levmar(image, start) -> Answer:
    """MINPACK through the older interface."""
    return _astropy("LevMarLSQFitter", image, start)


def astropy_lm(image, start) -> Answer:
    """MINPACK through `least_squares`."""
    return _astropy("LMLSQFitter", image, start)


def astropy_trf(image, start) -> Answer:
    """Trust region reflective, the fitter that astropy recommends."""
    return _astropy("TRFLSQFitter", image, start)


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


def _picasso(image, start, mle: bool, tolerance: float, most: int) -> Answer:
    from picasso.fitting import gaussfit

    theta, _, states, _ = gaussfit.fit_spots(
        gaussfit.ROTATED, image[None], start[None, [0, 1, 2, 3, 4, 6, 5]], mle, tolerance, most
    )
    return _answer(theta[0], bool(states[0] == gaussfit.FIT_STATE_CONVERGED))


def picasso_lsq(image, start) -> Answer:
    """Least squares on the schedule of its own pipeline."""
    return _picasso(image, start, False, 1e-2, 200)


def picasso_lsq_tight(image, start) -> Answer:
    """Least squares to the optimum."""
    return _picasso(image, start, False, 1e-9, 200)


def picasso_mle(image, start) -> Answer:
    """Poisson likelihood on the schedule of its own pipeline."""
    return _picasso(image, start, True, 1e-5, 100)


def picasso_mle_tight(image, start) -> Answer:
    """Poisson likelihood to the optimum."""
    return _picasso(image, start, True, 1e-9, 100)


def picasso_mle_loose(image, start) -> Answer:
    """Poisson likelihood as `fit_spots` runs when nothing is said."""
    return _picasso(image, start, True, 1e-2, 20)


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
    shape = galsim.hsm.FindAdaptiveMom(
        galsim.Image(image - border.mean()),
        guess_sig=float(np.sqrt(start[MAJOR] * start[MINOR])),
        guess_centroid=centre,
        strict=False,
    )
    # |g| = (1 − q)/(1 + q) for the ratio q of the axes
    g = abs(shape.observed_shape.g)
    ratio = (1 + g) / (1 - g)
    return shape.moments_sigma * ratio**0.5, shape.moments_sigma / ratio**0.5, shape.moments_status == 0


class Peer(NamedTuple):
    """An estimator: its name, its package, what it estimates by, how many parameters it finds, function, a remark."""

    name: str
    package: str
    kind: str
    parameters: int
    fit: Callable[..., Answer]
    remark: str = ""


LEAST_SQUARES, LIKELIHOOD, MOMENTS = "least squares", "likelihood", "moments"
PEERS = (
    Peer("scipy curve_fit", "scipy", LEAST_SQUARES, 7, scipy_unweighted, "analytic Jacobian"),
    Peer("scipy, weights of data", "scipy", LEAST_SQUARES, 7, scipy_data_weights, "1/√data, analytic Jacobian"),
    Peer("scipy, reweighted", "scipy", LIKELIHOOD, 7, scipy_reweighted, "3 fits with 1/√model, analytic Jacobian"),
    Peer("lmfit", "lmfit", LEAST_SQUARES, 7, lmfit_model, "Model, leastsq"),
    Peer("astropy LevMar", "astropy", LEAST_SQUARES, 7, astropy_levmar, "Gaussian2D + Const2D"),
    Peer("astropy LM", "astropy", LEAST_SQUARES, 7, astropy_lm, "Gaussian2D + Const2D"),
    Peer("astropy TRF", "astropy", LEAST_SQUARES, 7, astropy_trf, "Gaussian2D + Const2D"),
    Peer("iminuit", "iminuit", LIKELIHOOD, 7, iminuit_poisson, "Migrad, strategy 0, analytic gradient"),
    Peer("picasso lsq", "picassosr", LEAST_SQUARES, 7, picasso_lsq, "its CPU default, tolerance 1e-2"),
    Peer("picasso lsq, tight", "picassosr", LEAST_SQUARES, 7, picasso_lsq_tight, "tolerance 1e-9"),
    Peer("picasso mle", "picassosr", LIKELIHOOD, 7, picasso_mle, "its CPU default, tolerance 1e-5"),
    Peer("picasso mle, tight", "picassosr", LIKELIHOOD, 7, picasso_mle_tight, "tolerance 1e-9"),
    Peer("picasso mle, loose", "picassosr", LIKELIHOOD, 7, picasso_mle_loose, "default of fit_spots, tolerance 1e-2"),
    Peer("laserbeamsize", "laserbeamsize", MOMENTS, 5, laserbeamsize_moments, "ISO 11146; takes no start"),
    Peer("galsim hsm", "galsim", MOMENTS, 6, galsim_moments, "adaptive moments, mean of the border taken off"),
)
INTEGRATED_PEER = Peer(
    "picasso gaussmle", "picassosr", LIKELIHOOD, 6, picasso_integrated, "pixel-integrated, own start, tolerance 1e-3"
)
