"""Light before the sensor: photon budget, spread, place, speckle."""

import math

import numpy as np
import pytest

from rig import exposure, material, photons, plan, speckle
from rig.settings import from_dict, replace

BASE = from_dict(
    {
        "seed": 3,
        "frame": {"width_px": 400, "height_px": 360, "window_px": 200},
        "pointing": {"border_px": 100, "wander_px": 20, "offset_x_px": 15},
        "speckle": {"patterns": 2},
    }
)


def site(angle_deg=0.0, index=0, exposures=(1e-4, 5e-4, 9e-4)):
    shots = (
        plan.Shot(index * len(exposures) + i, f"frames/{index}_{i}.tif", "spot", angle_deg, t, str(index))
        for i, t in enumerate(exposures)
    )
    return plan.Site(index, tuple(shots))


def test_photons_equal_the_closed_form_of_table_3():
    # 1 mW · 100 us · 650 nm / hc · 2 % · 1/11² · 91.93 %, worked out by hand.
    assert photons.reflected_photons(BASE, 1e-4) == pytest.approx(4.97e7, rel=2e-3)


def test_photons_are_linear_in_the_exposure_and_in_every_loss():
    one = photons.reflected_photons(BASE, 1e-4)
    assert photons.reflected_photons(BASE, 9e-4) == pytest.approx(9 * one, rel=1e-12)
    gain = 0.3 * BASE.material.specular_gain
    dimmer = replace(BASE, {"optics.lens_transmission": 0.5, "material.specular_gain": gain})
    assert photons.reflected_photons(dimmer, 1e-4) == pytest.approx(0.15 * one, rel=1e-12)
    stopped = replace(BASE, {"optics.f_number": 22.0})
    assert photons.reflected_photons(stopped, 1e-4) == pytest.approx(one / 4, rel=1e-12)


def test_the_lens_collects_its_solid_angle_of_a_lambertian_surface():
    """The part of cos θ light within the cone of a pupil of f/(2 f_a) at d_w is sin² of its half-angle."""
    optics = BASE.optics
    angle = np.arctan(optics.focal_length_m / (2 * optics.f_number * optics.working_distance_m))
    assert photons.lambertian_collection(BASE) == pytest.approx(np.sin(angle) ** 2, rel=2 * angle**2)
    # The paper's 1/f_a² is a factor of 99 more.
    assert 1 / optics.f_number**2 / photons.lambertian_collection(BASE) == pytest.approx(99.2, abs=0.05)


@pytest.mark.parametrize("spread_m", [120e-6, 280e-6, 400e-6])
def test_the_sum_of_light_does_not_depend_on_the_spread(spread_m):
    plain = replace(
        BASE,
        {"material.spread_along_m": spread_m, "material.spread_across_m": 0.8 * spread_m, "speckle.patterns": 0},
    )
    assert exposure.light(plain, site()).irradiance.sum() == pytest.approx(1.0, abs=1e-9)


def test_widths_add_as_variances_and_follow_the_fibres():
    along, across, pitch = 300e-6, 200e-6, 5.5e-6
    rig = replace(BASE, {"material.spread_along_m": along, "material.spread_across_m": across})
    scale = 0.0502 / 0.25 / pitch
    per_sigma = 2 * math.sqrt(2 * math.log(2))
    expected = [(72.8e-6 / per_sigma) ** 2 + along**2, (80.4e-6 / per_sigma) ** 2 + across**2]
    np.testing.assert_allclose(material.covariance(rig, 0.0, 1.0), np.diag(expected) * scale**2, rtol=1e-12)
    turned = material.covariance(rig, 90.0, 1.0)
    assert turned[1, 1] > turned[0, 0] > 0
    assert abs(turned[0, 1]) < 1e-9


def test_polarisation_acts_with_cos_2_gamma():
    rig = replace(
        BASE,
        {"material.reflectance_polarisation": 0.2, "laser.polarisation_deg": 30.0, "material.spread_polarisation": 0.1},
    )
    rng = np.random.default_rng
    spots = {a: material.illuminate(rig, site(a), rng(1)) for a in (30.0, 120.0, 75.0)}
    assert spots[30.0].relative_light == pytest.approx(1.2)
    assert spots[120.0].relative_light == pytest.approx(0.8)
    assert spots[75.0].relative_light == pytest.approx(1.0)


def test_site_factors_have_mean_one_and_the_stated_scatter():
    # Mean and log-scatter of 4000 draws; both tests at 4 standard errors: false alarm 1.3e-4 together.
    draws = np.array([material.unit_mean_lognormal(z, 0.4) for z in np.random.default_rng(4).standard_normal(4000)])
    assert draws.mean() == pytest.approx(1.0, abs=4 * math.sqrt(math.exp(0.16) - 1) / math.sqrt(4000))
    assert np.log(draws).std() == pytest.approx(0.4, abs=4 * 0.4 / math.sqrt(8000))


def test_exposures_of_a_site_share_place_and_speckle_and_sites_differ():
    lit = [exposure.light(BASE, site(index=i)) for i in (0, 0, 1)]
    np.testing.assert_array_equal(lit[0].irradiance, lit[1].irradiance)
    assert lit[0].spot.x_px == lit[1].spot.x_px
    assert abs(lit[0].spot.x_px - lit[2].spot.x_px) > 0.1
    assert not np.array_equal(lit[0].irradiance, lit[2].irradiance)
    budgets = [exposure.spot_photons(BASE, lit[0], shot) for shot in lit[0].site.shots]
    np.testing.assert_allclose(np.array(budgets) / budgets[0], [1, 5, 9], rtol=1e-12)


def test_the_spot_keeps_off_the_border():
    wild = replace(BASE, {"pointing.wander_px": 500.0})
    for index in range(20):
        spot = exposure.light(wild, site(index=index)).spot
        assert 100 <= spot.x_px <= 299
        assert 100 <= spot.y_px <= 259


def test_speckle_grain_follows_eq_3():
    """Autocorrelation of intensity |2 J1(v)/v|²: half width 0.5144 λ F, F = (1+M) f_a; Eq. 3 is 1.2 λ F."""
    cutoff = speckle.pupil_cutoff_per_px(BASE)
    assert speckle.grain_px(BASE) == pytest.approx(1.2 * 1.2008 * 650e-9 * 11 / 5.5e-6, rel=1e-9)
    oversampling = 8
    field = speckle.pattern((1024, 1024), cutoff / oversampling, 1, np.random.default_rng(5))
    spectrum = np.abs(np.fft.fft2(field - field.mean())) ** 2
    correlation = np.fft.ifft2(spectrum).real[0, :64]
    correlation /= correlation[0]
    first = int(np.argmax(correlation < 0.5))
    half = first - 1 + (correlation[first - 1] - 0.5) / (correlation[first - 1] - correlation[first])
    # About 3500 grains: the width of their mean correlation is known to about 1 %; allowed 5 %.
    assert half / oversampling == pytest.approx(0.5144 / 1.2 * speckle.grain_px(BASE), rel=0.05)


@pytest.mark.parametrize("patterns", [1, 2, 8])
def test_speckle_contrast_and_mean(patterns):
    # About 9000 independent grains: contrast to 1-2 % (exponential tails), mean to 1/sqrt(9000 N); 5 standard errors.
    field = speckle.pattern((256, 256), speckle.pupil_cutoff_per_px(BASE) / 2, patterns, np.random.default_rng(6))
    assert field.mean() == pytest.approx(1.0, abs=5 / math.sqrt(6000 * patterns))
    assert field.std() / field.mean() == pytest.approx(1 / math.sqrt(patterns), rel=0.07)


def test_one_pattern_is_negative_exponential():
    # P(I > x) = exp(-x); effective samples about 6000, so 5 standard errors are 0.032 at most.
    field = speckle.pattern((256, 256), speckle.pupil_cutoff_per_px(BASE) / 2, 1, np.random.default_rng(7)).ravel()
    for x in (0.2, 1.0, 3.0):
        assert np.mean(field > x) == pytest.approx(math.exp(-x), abs=5 * math.sqrt(0.25 / 6000))


def test_pixels_average_the_speckle():
    rig = replace(BASE, {"speckle.patterns": 1, "speckle.field_px": 128})
    field = speckle.field_on_pixels(rig, (128, 128), np.random.default_rng(8))
    assert 0.75 < field.std() / field.mean() < 0.97
    tiled = speckle.field_on_pixels(rig, (300, 140), np.random.default_rng(8))
    np.testing.assert_array_equal(tiled[:128, :128], field)
    np.testing.assert_array_equal(tiled[128:256, :12], tiled[:128, 128:])
