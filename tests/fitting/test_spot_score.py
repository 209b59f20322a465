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
from tests.reference.exact_law import moments, reading_law
from tests.reference.numpy_chain import draw
from tests.reference.numpy_kernel import one_pixel, tables_of

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


@pytest.mark.parametrize("sensor", [FULL, WELL, FAINT], ids=["full scale", "full well", "faint"])
@pytest.mark.parametrize("top_hat", [False, True])
def test_likelihood_of_clipped_and_faint_light(sensor, top_hat):
    """Σ s ∂µ and Σ i ∂µ ∂µᵀ of score and information of each pixel by the kernel's plain numpy version, in DN.

    Over a spot these take in the faint table, full scale and the well at once.
    """
    natural = (250.0 if sensor is WELL else 300.0, 24.3, 18.6, 6.5, 4.8, 0.5, 0.0 if sensor is FAINT else 60.0)
    image, kernel = seen(natural, sensor, top_hat), tables_of(sensor)
    readings = np.nan_to_num(image.ravel())
    electrons = kernel.signal(mean_of(*natural, top_hat=top_hat))
    own = [one_pixel(float(y), float(nu), kernel) for y, nu in zip(readings, electrons, strict=True)]
    score, weight = (np.array([getattr(pixel, name) for pixel in own]) for name in ("score", "information"))
    gain = sensor.gain_dn_per_e
    assert_is_sum(image, natural, LIKELIHOOD, sensor, top_hat, score / gain, weight / gain**2, 1e-10)


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


def pixels(readings, electrons, sensor):
    """Score and information of each reading [2, reading]."""
    return np.array([pixel(y, electrons, sensor)[:2] for y in readings]).T


def slope_of(electrons, sensor, step):
    """∂P(y | ν)/∂ν of every reading, by central differences of fourth order."""
    ends = [reading_law(electrons + k * step, sensor) for k in (-2, -1, 1, 2)]
    return np.array([1, -8, 8, -1]) @ ends / (12 * step)


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


# Light [e-] and the largest expected score that is allowed, in deviations of it: what skewness leaves where a normal
# law is clipped. Over a spot its sign changes, and 100 such pixels shift a parameter by a tenth of its error.
CLIPPED = {
    "full scale": (FULL, (480.0, 520.0, 545.0, 559.0, 575.0, 600.0, 640.0), 0.01),
    "paper's full scale": (replace(FAINT, full_scale_dn=1023.0), (8800.0, 9100.0, 9300.0, 9500.0, 9800.0), 0.003),
    "full well": (WELL, (440.0, 480.0, 520.0, 545.0, 560.0, 590.0, 620.0), 0.01),
}


@pytest.mark.parametrize(("sensor", "light", "most"), CLIPPED.values(), ids=CLIPPED)
def test_the_expected_score_near_a_clip_is_0(sensor, light, most):
    """Over every reading with its exact probability; the information is E[score²] and the slope of E[score]."""
    for electrons in light:
        law, slope = reading_law(electrons, sensor), slope_of(electrons, sensor, 0.1 * np.sqrt(electrons))
        readings = np.flatnonzero(law)
        law, slope = law[readings], slope[readings]
        score, information = pixels(readings, electrons, sensor)
        expected = law @ information
        assert abs(law @ score) < most * np.sqrt(expected), electrons
        # Of the information without a clip; at the well, where noise hides which pixels were cut, 10 % are too much.
        share = 1 / (electrons + sensor.read_noise_e**2)
        assert law @ score**2 == pytest.approx(expected, abs=(0.1 if sensor is WELL else 0.015) * share), electrons
        assert slope @ score == pytest.approx(law @ score**2, abs=0.005 * share), electrons


@pytest.mark.parametrize(("sensor", "light", "most"), CLIPPED.values(), ids=CLIPPED)
def test_the_score_of_random_readings_near_a_clip_is_0_on_average(sensor, light, most):
    """20 000 readings of the numpy chain for each light: within 4.5 standard errors of 0 beside the allowance above.

    False alarm 7e-6 each, 1e-4 over all 19.
    """
    rng = np.random.default_rng(8)
    for electrons in light:
        drawn = draw(np.full(20_000, electrons * sensor.gain_dn_per_e), 0.0, sensor, rng)
        values, count = np.unique(drawn, return_counts=True)
        score, information = pixels(values, electrons, sensor)
        sd = np.sqrt(count @ information / drawn.size)
        assert abs(count @ score) / drawn.size < (most + 4.5 / np.sqrt(drawn.size)) * sd, electrons


TABLES = {
    "paper": FAINT,
    "paper, black level 40": replace(FAINT, black_level_dn=40.0),
    "quiet": SensorModel(0.5, 2.0, black_level_dn=2.0),
    "many DN an electron": SensorModel(8.0, 1.0, black_level_dn=100.0),
    "counting": SensorModel(1.0, 0.0),
    "coarse": SensorModel(0.05, 0.5, black_level_dn=2.0),
    "full scale in the table": SensorModel(4.0, 1.5, black_level_dn=10.0, full_scale_dn=60.0),
}


@pytest.mark.parametrize("sensor", TABLES.values(), ids=TABLES)
def test_levels_of_the_faint_table(sensor):
    """Score ∂ ln P/∂ν of each reading, Σ (∂P)²/P, and χ² by mean and variance, all from sums over every count."""
    own = build_reading_law(sensor)
    # From −5 read noises on; below, nearly all readings are 0 and differences of their chance have no digits.
    lowest = max(np.ceil((-5 * sensor.read_noise_e - own.lowest_level) / own.step), 0)
    for k in np.unique(np.linspace(lowest, own.inverse_information.size - 2, 7).astype(int)):
        electrons = own.lowest_level + k * own.step
        if abs(electrons) < own.step / 2:
            continue  # Light of 0 is where both halves of the law meet: no slope by differences.
        law = reading_law(electrons, sensor)
        slope = slope_of(electrons, sensor, min(own.step, abs(electrons)) / 20)
        # The table's last reading also stands for all above it, unless that is full scale.
        readings = np.flatnonzero(law[: own.probability.shape[1] - (sensor.full_scale_dn == np.inf)] > 1e-13)
        got = np.array([pixel(y, electrons, sensor) for y in readings]).T
        want = slope[readings] / law[readings]
        # Differences have rounding errors of 1e-16 / 1e-3 of a probability, and fourth-order ones.
        likely = law[readings] > 1e-7
        np.testing.assert_allclose(got[0][likely], want[likely], rtol=1e-4, atol=1e-4 * np.abs(want[likely]).max())
        np.testing.assert_allclose(got[1], np.sum(want * slope[readings]), rtol=1e-4, atol=1e-12)
        mean, variance, _ = moments(law)
        np.testing.assert_allclose(got[2], (readings - mean) ** 2 / max(variance, 1 / 12), rtol=1e-5, atol=1e-5)


BETWEEN = [*list(TABLES.values())[:5], SensorModel(2.0, 0.3, black_level_dn=100.0)]


@pytest.mark.parametrize("sensor", BETWEEN)
def test_between_levels_of_the_faint_table(sensor):
    """By cubics: an expected score below 1e-3 of its deviation up to the end, an information within 2 %.

    In the first step from 0, where the chance of a single electron decides, of the information its order alone.
    """
    own, rng = build_reading_law(sensor), np.random.default_rng(2)
    near = rng.uniform(0.0, 2 * own.step, 4)
    for electrons in [*rng.uniform(own.lowest_level / 2, own.highest_level + 3 * own.step, 12), *near]:
        if -own.step < electrons < 0 or (electrons < 0 and sensor.read_noise_e == 0):
            continue  # Levels on either side of 0 hold two laws, without and with electrons.
        law = reading_law(electrons, sensor)
        readings = np.flatnonzero(law > 1e-15)
        law, (score, information) = law[readings], pixels(readings, electrons, sensor)
        assert abs(law @ score) < 1e-3 * np.sqrt(law @ information), electrons
        share = 0.5 if 0 < electrons < own.step else 0.02
        assert law @ score**2 == pytest.approx(law @ information, rel=share), electrons


@pytest.mark.parametrize(("sensor", "light", "_"), CLIPPED.values(), ids=CLIPPED)
def test_variances_near_a_clip(sensor, light, _):
    """Those of every reading with its exact probability, to 4 % of the variance without a clip; never below 1/12."""
    for electrons in light:
        want = max(moments(reading_law(electrons, sensor))[1], 1 / 12)
        got = pixel(100, electrons, sensor, VARIANCE)[1] / sensor.gain_dn_per_e**2
        free = sensor.gain_dn_per_e**2 * (electrons + sensor.read_noise_e**2)
        assert got == pytest.approx(want, abs=0.04 * free), electrons


@pytest.mark.parametrize("sensor", TABLES.values(), ids=TABLES)
def test_variances_of_faint_light(sensor):
    """Those of every reading, at levels of the table and between them: 1 % and at least 1/12."""
    own, rng = build_reading_law(sensor), np.random.default_rng(4)
    for electrons in rng.uniform(max(own.lowest_level, -5 * sensor.read_noise_e), own.highest_level, 8):
        want = max(moments(reading_law(electrons, sensor))[1], 1 / 12)
        got = pixel(1, electrons, sensor, VARIANCE)[1] / sensor.gain_dn_per_e**2
        assert got == pytest.approx(want, rel=0.01), electrons


def test_a_black_level_far_too_high():
    """Below its table the law is that of read noise alone, where black does not clip, and nothing where it does."""
    own = replace(FAINT, black_level_dn=40.0)
    score, information, chi2, used = pixel(20, -150.0, own)
    floor = 13.0**2 + 1 / 12 / 0.11**2
    residual = (20 - 40) / 0.11 + 150
    want = residual / floor, 1 / floor, residual**2 / floor, 1
    assert (score, information, chi2, used) == pytest.approx(want, rel=1e-12)
    assert pixel(0, -400.0, FAINT)[:2] == pytest.approx((0, 0), abs=1e-6)
