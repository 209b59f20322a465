"""One pass over the pixels: score and information against plain sums, and the law of a pixel against every outcome."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from spotcheck.fitting.reading_kernel import build_reading_law
from spotcheck.fitting.spot_score import EQUAL, LIKELIHOOD, VARIANCE, score_spot
from spotcheck.model import spot
from spotcheck.model.baseline import jacobian
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw

pytestmark = pytest.mark.filterwarnings("error")
# A black level of 1000 DN would let nothing be faint but for its electrons: the spots below stand on 300 e- and more.
BRIGHT = SensorModel(0.5, 2.0, black_level_dn=20.0)
FULL = replace(BRIGHT, full_scale_dn=300.0)
WELL = replace(BRIGHT, full_well_e=560.0)
FAINT = SensorModel(0.11, 13.0)
OFFSET = 170.0
# Amplitude, x, y, widths, orientation [rad], offset, in an image of 40 rows and 50 columns.
SPOTS = {
    "usual": (200.0, 24.3, 18.6, 6.5, 4.8, 0.5, OFFSET),
    "round": (200.0, 24.3, 18.6, 5.0, 5.0, 0.0, OFFSET),
    "at the border": (200.0, -0.5, 39.5, 6.5, 4.8, 0.5, OFFSET),
    "beyond the border": (900.0, -9.0, 47.0, 6.5, 4.8, 2.5, OFFSET),
    "narrow": (200.0, 24.3, 18.6, 0.5, 0.5, 0.0, OFFSET),
    "long": (200.0, 24.3, 18.6, 300.0, 0.7, 0.8, OFFSET),
    "wide": (200.0, 24.3, 18.6, 300.0, 200.0, 2.9, OFFSET),
}
ROWS, COLUMNS = 40, 50
# Share of the largest below which a derivative counts as 0: that by the orientation of a round spot.
NOTHING = 1e-4


def theta_of(amplitude, x, y, major, minor, orientation, offset):
    """θ of a spot: the inverse of its covariance R diag(σ²) Rᵀ, element by element."""
    cos, sin, p, q = np.cos(orientation), np.sin(orientation), major**-2, minor**-2
    return np.array([amplitude, x, y, p * cos**2 + q * sin**2, (p - q) * cos * sin, p * sin**2 + q * cos**2, offset])


def mean_of(*natural, top_hat=False):
    """Mean reading without clips [pixels]; complex arguments give derivatives."""
    x, y = np.arange(COLUMNS, dtype=float)[None, :], np.arange(ROWS, dtype=float)[:, None]
    light = spot.elliptical_gaussian(x, y, *natural[:6])
    return np.ravel((spot.top_hat(light, natural[0]) if top_hat else light) + natural[6])


def holed(image):
    """The image with a tenth of its pixels masked, one row and one column among them."""
    out = np.array(image, dtype=float)
    out[np.random.default_rng(3).random(out.shape) < 0.05] = np.nan
    out[5], out[:, 7] = np.nan, np.nan
    return out


def seen(natural, sensor, top_hat=False):
    """A random frame of a spot with masked pixels."""
    light = (mean_of(*natural, top_hat=top_hat) - sensor.black_level_dn).reshape(ROWS, COLUMNS)
    return holed(draw(light, 0.0, sensor, np.random.default_rng(1)))


def assert_is_sum(image, natural, weighting, sensor, top_hat, score, weight, rtol):
    """One pass equals Σ s ∂µ and Σ w ∂µ ∂µᵀ, each within `rtol` of the sum of its terms' sizes."""
    got_score, got_information, chi2, used = score_spot(
        image, theta_of(*natural), weighting, build_reading_law(sensor), top_hat
    )
    assert np.isfinite(got_score).all() and np.isfinite(got_information).all() and np.isfinite(chi2)
    known = np.isfinite(image).ravel()
    slopes = jacobian(lambda *p: mean_of(*p, top_hat=top_hat), natural)[:, known]
    chart = jacobian(theta_of, natural)
    size = np.abs(score[known] * slopes).sum(axis=1)
    size = np.maximum(size, NOTHING * size.max())
    np.testing.assert_array_less(np.abs(chart @ got_score - slopes @ score[known]), rtol * size)
    want = (slopes * weight[known]) @ slopes.T
    # Terms of an off-diagonal sum are as large as the root of both diagonals.
    size = np.sqrt(np.diag(want))
    size = np.maximum(size, NOTHING * size.max())
    np.testing.assert_array_less(np.abs(chart @ got_information @ chart.T - want), rtol * np.outer(size, size))
    return chi2, used


@pytest.mark.parametrize("top_hat", [False, True])
@pytest.mark.parametrize("natural", SPOTS.values(), ids=SPOTS)
def test_equal_weights(natural, top_hat):
    """Jᵀ(y − µ), JᵀJ and Σ(y − µ)², with any black level and gain."""
    image = seen(SPOTS["usual"], BRIGHT)
    residual = image.ravel() - mean_of(*natural, top_hat=top_hat)
    chi2, used = assert_is_sum(image, natural, EQUAL, None, top_hat, residual, np.ones(residual.size), 1e-10)
    assert chi2 == pytest.approx(np.nansum(residual**2), rel=1e-10) and used == np.isfinite(image).sum()


@pytest.mark.parametrize("top_hat", [False, True])
@pytest.mark.parametrize("natural", SPOTS.values(), ids=SPOTS)
def test_likelihood_of_bright_light(natural, top_hat):
    """Poisson shifted by read noise and rounding: (y − µ)/v and 1/v in DN, v = K(µ − black) + K²σ² + 1/12."""
    image = seen(SPOTS["usual"], BRIGHT)
    mean = mean_of(*natural, top_hat=top_hat)
    variance = 0.5 * (mean - 20) + 0.5**2 * 2**2 + 1 / 12
    residual = image.ravel() - mean
    chi2, used = assert_is_sum(image, natural, LIKELIHOOD, BRIGHT, top_hat, residual / variance, 1 / variance, 1e-10)
    assert chi2 == pytest.approx(np.nansum(residual**2 / variance), rel=1e-10)
    assert used == np.isfinite(image).sum()


@pytest.mark.parametrize("weighting", [LIKELIHOOD, VARIANCE])
@pytest.mark.parametrize("sensor", [FULL, WELL, FAINT], ids=["full scale", "full well", "faint"])
@pytest.mark.parametrize("top_hat", [False, True])
def test_an_image_is_the_sum_of_its_pixels(weighting, sensor, top_hat):
    """Whatever the regime of a pixel, which the tests below take one by one: each has its own place in the sums."""
    natural = (250.0 if sensor is WELL else 300.0, 24.3, 18.6, 6.5, 4.8, 0.5, 0.0 if sensor is FAINT else 60.0)
    image, theta, law = seen(natural, sensor, top_hat), theta_of(*natural), build_reading_law(sensor)
    parts = []
    for j, k in np.ndindex(image.shape):
        # The coordinates of this pixel are 0.
        own = theta - [0, k, j, 0, 0, 0, 0]
        parts.append(score_spot(image[j : j + 1, k : k + 1], own, weighting, law, top_hat))
    want = [sum(part[i] for part in parts) for i in range(4)]
    size = np.sqrt(np.diag(want[1]))
    got = score_spot(image, theta, weighting, law, top_hat)
    np.testing.assert_allclose(got[0] / size, want[0] / size, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(got[1] / np.outer(size, size), want[1] / np.outer(size, size), rtol=1e-10, atol=1e-12)
    # Five to six deviations below the well, where nothing is cut yet, χ² takes in a pixel or not by its row.
    if sensor is not WELL or weighting == VARIANCE:
        assert got[2] == pytest.approx(want[2], rel=1e-10) and got[3] == want[3]


tables = cache(build_reading_law)


def pixel(y, electrons, sensor, weighting=LIKELIHOOD):
    """Score [1/e-], information [1/e-²], χ² and its pixels of one reading y."""
    law = tables(sensor)
    theta = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.0, law.gain * electrons + law.black_level])
    score, information, chi2, used = score_spot(np.array([[float(y)]]), theta, weighting, law, False)
    return score[6] * law.gain, information[6, 6] * law.gain**2, chi2, used


# Deviations between light and full scale, up to far beyond it.
@pytest.mark.parametrize("a", [5.5, 3.0, 1.0, 0.0, -1.0, -4.0, -9.0])
def test_a_pixel_at_full_scale_is_a_chance_to_be_clipped(a):
    """Score d ln Q/dν by differences of scipy's ln Q, the width of the law held; information E[score²] by quadrature.

    The deviation a is that of full scale from the light: 300 DN are reached from 299.5.
    """
    top = (299.5 - FULL.black_level_dn) / FULL.gain_dn_per_e
    variance = (a / 2 - np.sqrt(a * a / 4 + top + 4 + 1 / 3)) ** 2
    electrons, sd = variance - 4 - 1 / 3, np.sqrt(variance)
    assert (top - electrons) / sd == pytest.approx(a, abs=1e-9)
    h = 1e-3 * sd
    want = (norm.logsf((top - electrons - h) / sd) - norm.logsf((top - electrons + h) / sd)) / (2 * h)
    score, information, _, used = pixel(300, electrons, FULL)
    # 1e-6 from the differences.
    assert score == pytest.approx(want, rel=1e-5) and used == 0
    z = np.linspace(a - 45, a, 200_001)
    inside = np.trapezoid(z * z * norm.pdf(z), z)
    hazard = np.exp(norm.logpdf(a) - norm.logsf(a))
    assert information == pytest.approx((inside + norm.sf(a) * hazard**2) / variance, rel=1e-6)
    below = pixel(290, electrons, FULL)
    assert below[:2] == pytest.approx(((270 / 0.5 - electrons) / variance, information), rel=1e-12)


@pytest.mark.parametrize("electrons", [440.0, 500.0, 545.0, 560.0, 600.0, 680.0])
def test_the_score_at_the_well_is_that_of_its_density(electrons):
    """Normal electrons, cut at the well, under read noise: ∂ ln ρ/∂ν by quadrature and differences, width held."""
    noise = WELL.read_noise_e**2 + 1 / 12 / WELL.gain_dn_per_e**2
    sd, well = np.sqrt(electrons), WELL.full_well_e
    n = np.linspace(well - 12 * sd, well, 20_001)

    def log_density(signal, mean):
        seen = np.trapezoid(norm.pdf(n, mean, sd) * norm.pdf(signal, n, np.sqrt(noise)), n)
        return np.log(seen + norm.sf(well, mean, sd) * norm.pdf(signal, well, np.sqrt(noise)))

    h = 1e-3 * sd
    for y in (270, 285, 295, 299, 300, 301, 303):
        signal = (y - WELL.black_level_dn) / WELL.gain_dn_per_e
        want = (log_density(signal, electrons + h) - log_density(signal, electrons - h)) / (2 * h)
        # 1e-4 of a deviation: steps of the quadrature and the differences.
        assert pixel(y, electrons, WELL)[0] * sd == pytest.approx(want * sd, abs=1e-4, rel=1e-4), y


def test_a_black_level_far_too_high():
    """Below its table the law is that of read noise alone, where black does not clip, and nothing where it does."""
    own = replace(FAINT, black_level_dn=40.0)
    score, information, chi2, used = pixel(20, -150.0, own)
    floor = 13.0**2 + 1 / 12 / 0.11**2
    residual = (20 - 40) / 0.11 + 150
    want = residual / floor, 1 / floor, residual**2 / floor, 1
    assert (score, information, chi2, used) == pytest.approx(want, rel=1e-12)
    assert pixel(0, -400.0, FAINT)[:2] == pytest.approx((0, 0), abs=1e-6)
