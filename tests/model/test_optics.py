"""Geometry, diffraction and the laser beam: Eqs. 1, 3–6 and 9–14 (as ranges of numbers, each tested below)."""

import math

import numpy as np
import pytest
from scipy import constants, integrate

from spotcheck.model import optics, photons

# Printed digits: half a unit of the last one.
PITCH, WAVELENGTH, FOCAL, DISTANCE = 5.5e-6, 650e-9, 50.2e-3, 0.25


def test_magnification():
    """Eq. 1: 50.2 mm over 250 mm is 0.2008, printed as 0.2; an object of the field's size fills the sensor."""
    m = optics.magnification(FOCAL, DISTANCE)
    assert m == pytest.approx(0.2008, rel=1e-12) and round(m, 1) == 0.2
    assert m * optics.field_of_view(16.896e-3, FOCAL, DISTANCE) == pytest.approx(16.896e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("side_mm", "field_mm", "angle_deg", "half"), [(16.896, 84.14, 19.1, 0.05), (22.528, 112.19, 25.29, 0.005)]
)
def test_field_and_viewing_angle(side_mm, field_mm, angle_deg, half):
    """Section 3.1.1's printed fields of view and angles; half the angle is seen under half the field."""
    field = optics.field_of_view(side_mm * 1e-3, FOCAL, DISTANCE)
    assert field * 1e3 == pytest.approx(field_mm, abs=0.005)
    angle = optics.viewing_angle(field, DISTANCE)
    assert math.degrees(angle) == pytest.approx(angle_deg, abs=half)
    assert DISTANCE * math.tan(angle / 2) == pytest.approx(field / 2, rel=1e-12)


def test_speckle_grain():
    """Eq. 3: 0.936 µm times the f-number; 10.296 µm at f/11, which is 1.872 px; one pixel at f/5.876."""
    assert optics.speckle_grain(0.2, WAVELENGTH, 1) * 1e6 == pytest.approx(0.936, abs=5e-4)
    grain = optics.speckle_grain(0.2, WAVELENGTH, 11)
    assert grain * 1e6 == pytest.approx(10.296, abs=5e-4)
    assert grain / PITCH == pytest.approx(1.872, abs=5e-4)
    assert optics.speckle_grain(0.2, WAVELENGTH, 5.876) / PITCH == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(("depth_mm", "f_number"), [(1.5, 9.1), (2.0, 12.1)])
def test_depth_of_focus(depth_mm, f_number):
    """Eq. 4 with a blur of one pixel: the printed interval of apertures, there and back."""
    found = optics.f_number_for_depth(depth_mm * 1e-3, PITCH, 0.2)
    assert round(found, 1) == f_number
    assert optics.depth_of_focus(PITCH, found, 0.2) == pytest.approx(depth_mm * 1e-3, rel=1e-12)
    # u f (1 + M)/M² by hand: 5.5 µm · 10 · 1.2/0.04.
    assert optics.depth_of_focus(PITCH, 10, 0.2) == pytest.approx(1.65e-3, rel=1e-12)


@pytest.mark.parametrize("regions", [1, 4, 25])
def test_contrast_of_summed_speckle(regions):
    """Eq. 5 against random draws: the sum of n independent exponential intensities has contrast 1/√n."""
    count = 200_000
    sums = np.random.default_rng(regions).exponential(size=(count, regions)).sum(axis=1)
    # Relative standard error of a contrast of a gamma law of shape n, by the delta method on mean and variance:
    # √((1 + 1/n)/2/count); 5 of them: false alarm 6e-7.
    error = math.sqrt((0.5 + 0.5 / regions) / count)
    assert sums.std() / sums.mean() == pytest.approx(optics.contrast_of_regions(regions), rel=5 * error)


def test_printed_increase_of_contrast():
    """Eq. 5 at 1.872 px a grain, counted along one line: the printed 37 %."""
    assert 100 * (optics.contrast_of_regions(1 / 1.872) - 1) == pytest.approx(37, abs=0.5)


def test_fraunhofer_number():
    """Eq. 6 at the printed slit, distance and wavelength: 1.664e-4."""
    assert optics.fraunhofer_number(5.2e-6, 0.25, 650e-9) == pytest.approx(1.664e-4, abs=5e-8)


def test_sigma_of_fwhm():
    """Eq. 10: a Gaussian of that σ falls to one half at half its FWHM."""
    sigma = optics.sigma_of_fwhm(76.6e-6)
    assert math.exp(-((38.3e-6) ** 2) / (2 * sigma**2)) == pytest.approx(0.5, rel=1e-12)


def test_laser_profile_holds_the_laser_power():
    """Eq. 9 integrated over the plane gives P_L, and falls to exp(−2) at r = w."""
    power, w = 1e-3, 65e-6
    # Over [0, 10 w]: what lies beyond is exp(−200) of the power.
    total, _ = integrate.quad(lambda r: 2 * np.pi * r * photons.laser_irradiance(r, power, w), 0, 10 * w)
    assert total == pytest.approx(power, rel=1e-9)
    ratio = photons.laser_irradiance(w, power, w) / photons.laser_irradiance(0.0, power, w)
    assert ratio == pytest.approx(math.exp(-2), rel=1e-12)


def test_peak_irradiance_and_beam_radius():
    """Eq. 11 is Eq. 9 on the axis; w_FWHM is where Eq. 9 gives half the peak at half the FWHM, and equals 2σ_la."""
    fwhm, power = 76.6e-6, 1e-3
    w = photons.beam_radius_of_fwhm(fwhm)
    assert photons.peak_irradiance(power, w) == pytest.approx(photons.laser_irradiance(0.0, power, w), rel=1e-12)
    half = photons.laser_irradiance(fwhm / 2, power, w) / photons.peak_irradiance(power, w)
    assert half == pytest.approx(0.5, rel=1e-12)
    assert w == pytest.approx(2 * optics.sigma_of_fwhm(fwhm), rel=1e-12)


def test_photons_on_a_pixel():
    """Eq. 12: photon energy times photon number is the energy that falls on the pixel."""
    irradiance, exposure, area = 3.7, 5e-4, PITCH**2
    count = photons.pixel_photons(irradiance, exposure, area, WAVELENGTH)
    energy = count * constants.h * constants.c / WAVELENGTH
    assert energy == pytest.approx(irradiance * exposure * area, rel=1e-12)


def test_losses_on_the_way_to_the_sensor():
    """Eq. 12, second line: each factor once, the aperture with the inverse square of its number."""
    got = photons.sensor_irradiance(100.0, 0.02, 3.0, 11, 0.9193)
    assert got == pytest.approx(100.0 * 0.02 * 3.0 * 0.9193 / 121, rel=1e-12)
    assert photons.sensor_irradiance(1.0, 1, 1, 2, 1) == 4 * photons.sensor_irradiance(1.0, 1, 1, 4, 1)


def test_scattering_factor_takes_the_exposure_out():
    """Eq. 13: with it, Eq. 12 grows with p_b² and no longer with t."""
    exposures, width = np.array([1e-4, 5e-4, 9e-4]), np.array([11.7, 15.7, 17.2])
    reduced = photons.sensor_irradiance(1.0, 1, photons.scattering_factor(exposures, width), 1, 1)
    counts = photons.pixel_photons(reduced, exposures, 1e-12, WAVELENGTH)
    np.testing.assert_allclose(counts / counts[0], (width / width[0]) ** 2, rtol=1e-12)


@pytest.mark.parametrize(("exposure", "printed"), [(1e-4, 4.97e7), (5e-4, 2.49e8), (9e-4, 4.48e8)])
def test_total_photons(exposure, printed):
    """Eq. 14 with Table 3 and ϱ_s = 1: the sum of Eq. 12 over all pixels, and the budget worked out by hand."""
    total = photons.total_photons(exposure, 1e-3, WAVELENGTH, 0.02, 1.0, 11, 0.9193)
    assert total == pytest.approx(printed, rel=2e-3)  # three digits
    w = 10 * PITCH
    r = np.hypot(*(np.mgrid[-60:61, -60:61] * PITCH))  # ± 6 w; beyond lies exp(−72)
    laser = photons.laser_irradiance(r, 1e-3, w)
    each = photons.pixel_photons(
        photons.sensor_irradiance(laser, 0.02, 1.0, 11, 0.9193), exposure, PITCH**2, WAVELENGTH
    )
    # Point samples of a Gaussian of σ = 5 px sum to its integral within 2 exp(−2π²·25).
    assert each.sum() == pytest.approx(total, rel=1e-9)
