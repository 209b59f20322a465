"""The light on the sensor: propagation, shape, top hat, baseline, and derivatives of it."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from spotcheck.model import baseline, propagation, spot
from spotcheck.model.baseline import Baseline, jacobian
from tests.samples.small_datasets import gaussian

P1, P2 = 2.48, 34.55
EXPOSURES = np.array([1e-4, 5e-4, 9e-4])
# 240 px, the paper's crop, as a row of x and a column of y about the middle.
X = np.arange(240.0)[None, :] - 120
Y = X.T


def test_beam_propagation():
    """Eq. 8 with the printed p1 and p2: 11.71, 15.70, 17.16 px; p2 is the width at one second."""
    got = propagation.beam_propagation(EXPOSURES, P1, P2)
    np.testing.assert_allclose(got, [11.71, 15.70, 17.16], atol=0.005)
    assert propagation.beam_propagation(1.0, P1, P2) == P2
    # e times the exposure adds p1.
    assert propagation.beam_propagation(math.e, P1, P2) == pytest.approx(P1 + P2, rel=1e-14)


def test_spot_sigma_adds_the_laser(instrument):
    """Eqs. 7 and 21: with Table 3 the laser adds 1.19 px in the image plane."""
    laser = propagation.laser_sigma_px(0.0502 / 0.25, (72.8e-6 + 80.4e-6) / 2 / math.sqrt(8 * math.log(2)), 5.5e-6)
    assert laser == pytest.approx(1.19, abs=0.005)
    np.testing.assert_allclose(propagation.spot_sigma(np.array([10.0, 0.0]), laser), [10 + laser, laser], rtol=1e-14)
    assert baseline.build_baseline(instrument, EXPOSURES).laser_px == pytest.approx(laser, rel=1e-12)


def test_contrast_of_the_published_spot(instrument):
    """Eqs. 7–8 give the published C_s of 5.2 … 3.5 for a Gaussian on 240 × 240 px, with the closed form of C_s."""
    model = baseline.build_baseline(instrument, EXPOSURES)
    for t, printed in ((1e-4, 5.2), (9e-4, 3.5)):
        sigma = model.sigma(t, P1, P2)
        image = gaussian(240, 1.0, 120, 120, sigma)
        # mean = 2πσ²/n, mean square = πσ²/n: C_s² = n/(4πσ²) − 1. Samples equal integrals; the border is 7 σ away.
        closed = math.sqrt(240**2 / (4 * math.pi * sigma**2) - 1)
        assert image.std() / image.mean() == pytest.approx(closed, rel=1e-5)
        assert closed == pytest.approx(printed, abs=0.06)  # printed digit, and the top hat that is left out here


@pytest.mark.parametrize(("sx", "sy", "rho"), [(3.0, 5.0, 0.0), (4.0, 4.0, 0.6), (2.5, 6.0, -0.3)])
def test_point_spread(sx, sy, rho):
    """Eq. 20 against scipy's bivariate normal density, and its integral over the plane."""
    law = multivariate_normal([0, 0], [[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]])
    want = law.pdf(np.stack(np.broadcast_arrays(X, Y), -1))
    got = spot.point_spread(X, Y, sx, sy, rho)
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-300)
    assert got.sum() == pytest.approx(1, abs=1e-9)  # σ ≥ 2 px across any direction: samples sum to the integral


def test_photon_distribution_has_the_printed_power():
    """Eq. 22 as printed, 1/M³; the change of variables from its first line would integrate to 1 with 1/M²."""
    m, sx = 0.2008, 6.0
    got = spot.photon_distribution(X, Y, sx, sx, 0.0, m)
    assert got.sum() == pytest.approx(m**-3, rel=1e-9)
    # The first line of it, q(x/M, y/M)/M², with the same width on the sensor, is normalised.
    assert (spot.point_spread(X / m, Y / m, sx / m, sx / m, 0.0) / m**2).sum() == pytest.approx(1, rel=1e-9)


def test_mean_photons_of_a_pixel():
    """Eqs. 26–27: µ_p,max f_θ at the centre of a pixel is the integral over it, up to the curvature of f_θ."""
    sx, sy, rho, m, peak = 5.0, 7.0, 0.4, 0.5, 1e4
    got = spot.pixel_mean_photons(X, Y, peak, sx, sy, rho, m)
    fine = (np.arange(5) - 2) / 5
    sampled = np.mean([spot.pixel_mean_photons(X + dx, Y + dy, peak, sx, sy, rho, m) for dx in fine for dy in fine], 0)
    # Integral less centre is f''/24 along each axis; at the peak f''/f = 1/(σ²(1 − ρ²)), here at most 1/21.
    assert np.abs(sampled - got).max() <= peak * m**-3 / (2 * np.pi * sx * sy * math.sqrt(1 - rho**2)) * (2 / 21 / 24)
    assert got.sum() == pytest.approx(peak / m**3, rel=1e-9)
    # Twice the light of the peak is twice the light everywhere.
    np.testing.assert_allclose(spot.pixel_mean_photons(X, Y, 2 * peak, sx, sy, rho, m), 2 * got, rtol=1e-14)


def test_circular_mean_photons():
    """Eq. 28 is Eq. 27 with one width and no correlation, and Eq. 26's sum over all pixels is µ_p,max/M³."""
    args = (1e4, 6.0)
    got = spot.circular_mean_photons(X, Y, *args, 0.2)
    np.testing.assert_allclose(got, spot.pixel_mean_photons(X, Y, 1e4, 6.0, 6.0, 0.0, 0.2), rtol=1e-11, atol=1e-290)
    assert got.sum() == pytest.approx(1e4 / 0.2**3, rel=1e-9)


def test_elliptical_gaussian_turns_from_x_towards_y():
    """A long axis at 30° puts light at (cos 30°, sin 30°), downwards to the right; moments give back both widths."""
    light = spot.elliptical_gaussian(X, Y, 50.0, 3.0, -2.0, 9.0, 5.0, math.radians(30), offset=0.0)
    weight = light / light.sum()
    dx, dy = X - (X * weight).sum(), Y - (Y * weight).sum()
    assert ((X * weight).sum(), (Y * weight).sum()) == pytest.approx((3.0, -2.0), abs=1e-9)
    u = np.array([math.cos(math.radians(30)), math.sin(math.radians(30))])
    along, across = dx * u[0] + dy * u[1], -dx * u[1] + dy * u[0]
    variances = (along**2 * weight).sum(), (across**2 * weight).sum(), (along * across * weight).sum()
    assert variances == pytest.approx((81.0, 25.0, 0.0), abs=1e-8)
    shifted = spot.elliptical_gaussian(X, Y, 50.0, 3.0, -2.0, 9.0, 5.0, math.radians(30), offset=7.0)
    np.testing.assert_allclose(shifted - light, 7.0, rtol=1e-12)


def test_top_hat_cuts_at_a_quarter():
    """Eqs. 39 and 40: light above exp(−1/4) of the peak equals it, light below stays, and the edge lies at w/√8."""
    sigma, amplitude = 12.0, 900.0
    light = gaussian(240, amplitude, 120, 120, sigma)
    cut = spot.top_hat(light, amplitude)
    level = amplitude * math.exp(-0.25)
    np.testing.assert_array_equal(cut[light <= level], light[light <= level])
    np.testing.assert_allclose(cut[light > level], level, rtol=1e-15)
    assert spot.top_hat_level(1.0) == pytest.approx(0.7788008, abs=5e-8)
    # A beam radius is 2σ; r_TH = √(1/8) of it encloses πw²/8 pixels, within the perimeter's width of one pixel.
    radius = 2 * sigma * math.sqrt(1 / 8)
    assert abs((light > level).sum() - math.pi * radius**2) < 2 * math.pi * radius


def model(budget="spot_area", top_hat=False) -> Baseline:
    """A baseline of the paper's numbers."""
    return Baseline(1.19, budget, top_hat, 9e-4)


def light_of(own: Baseline, exposure_s, p1, p2, peak, x0, y0):
    """Return the light [DN] of the baseline's law, whose peak at the longest exposure is `peak` [DN]."""
    here = peak * own.relative_peak(exposure_s, p1, p2)
    return own.declared_light(X, Y, here, x0, y0, own.sigma(exposure_s, p1, p2))


def test_peak_follows_the_spot_area():
    """Eq. 13 in Eq. 28 leaves (p_b/σ_g)²: 5.7 % and 1.2 % below the longest exposure, as the paper's plateau."""
    relative = model().relative_peak(EXPOSURES, P1, P2)
    np.testing.assert_allclose(100 * (relative - 1), [-5.7, -1.2, 0.0], atol=0.15)
    width = propagation.beam_propagation(EXPOSURES, P1, P2)
    law = (width / (width + 1.19)) ** 2
    np.testing.assert_allclose(relative, law / law[-1], rtol=1e-12)


def test_linear_budget_conserves_light():
    """`linear`: the sum over all pixels grows with the exposure."""
    sums = [light_of(model("linear"), t, P1, P2, 500.0, 0.0, 0.0).sum() for t in EXPOSURES]
    # 240 px hold all but exp(−120²/2/18.4²) = 6e-10 of the widest spot.
    np.testing.assert_allclose(np.array(sums) / sums[0], EXPOSURES / EXPOSURES[0], rtol=1e-8)


def test_closed_derivatives():
    """Complex step through the baseline against derivatives written out by hand, to rounding."""
    own, t, peak, x0, y0 = model("linear"), 5e-4, 700.0, 1.3, -0.4

    def light(p1, p2, peak, x0, y0):
        return light_of(own, t, p1, p2, peak, x0, y0)

    at = (P1, P2, peak, x0, y0)
    value, slopes = light(*at), jacobian(light, at)
    s, s_long = own.sigma(t, P1, P2), own.sigma(9e-4, P1, P2)
    dx, dy = X - x0, Y - y0
    # ln light = … + 2 ln σ(t_max) − 2 ln σ(t) − r²/2σ(t)²
    by_p2 = 2 / s_long - 2 / s + (dx**2 + dy**2) / s**3
    by_p1 = 2 * math.log(9e-4) / s_long + math.log(t) * ((dx**2 + dy**2) / s**3 - 2 / s)
    for got, relative in zip(slopes, (by_p1, by_p2, 1 / peak, dx / s**2, dy / s**2), strict=True):
        want = value * relative
        # 1e-11 of the largest: a few hundred roundings of 1e-16 in the products and the exponential.
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-11 * np.abs(want).max())


@pytest.mark.parametrize("budget", ["spot_area", "linear"])
def test_derivatives_with_top_hat(budget):
    """Complex step against central differences where the top hat cuts and where not."""
    own = model(budget, top_hat=True)

    def light(p1, p2, peak, x0, y0):
        return light_of(own, 1e-4, p1, p2, peak, x0, y0)

    at = np.array([P1, P2, 900.0, 0.3, 0.2])
    for k, step in enumerate((1e-5, 1e-5, 1e-3, 1e-5, 1e-5)):
        ends = [light(*(at + sign * step * (np.arange(5) == k))) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        exact = jacobian(light, at)[k]
        # At the rim of the plateau the derivative jumps; a rim pixel within one step of it may differ.
        away = np.abs(exact - numeric) <= 1e-6 * np.abs(exact).max() + 1e-7
        assert (~away).sum() <= 2
    assert light(*at).max() == pytest.approx(own.plateau(900.0 * own.relative_peak(1e-4, P1, P2)), rel=1e-12)


def test_without_optics_the_laser_counts_as_nothing():
    """And without exposures no law in t holds."""
    from spotcheck.dataset.instrument import Instrument

    assert baseline.build_baseline(Instrument(), EXPOSURES).laser_px == 0
    assert baseline.build_baseline(Instrument(), ()).photon_budget == "free"
