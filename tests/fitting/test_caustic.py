"""The caustic against beams whose answer is known in closed form."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from spotcheck.dataset.instrument import Laser, Sensor
from spotcheck.fitting import caustic, hyperbola, scan_caustic
from spotcheck.io import store
from tests.samples.scans import INSTRUMENT, PITCH, WAVELENGTH, fits_of_scan, radius_of, round_spots

NAMES = list(hyperbola.QUANTITIES)
Z = np.linspace(-0.3, 0.5, 9)


def beam(waist, position, m2=1.0):
    """`QUANTITIES` of a beam of a given waist and M² (ISO 11146-1): z_R = π w0²/(M² λ), θ = w0/z_R."""
    rayleigh = np.pi * waist**2 / (m2 * WAVELENGTH)
    return np.array([waist, position, waist / rayleigh, rayleigh, m2])


def fitted(z, radius, stderr):
    """The caustic, its `QUANTITIES` and their errors."""
    found = caustic.fit_caustic(z, radius, stderr, wavelength_m=WAVELENGTH)
    values, errors = (np.array([getattr(found, name + suffix) for name in NAMES]) for suffix in ("", "_stderr"))
    return found, values, errors


@pytest.mark.parametrize("m2", [1.0, 1.7])
def test_exact_radii_give_the_beam_back(m2):
    """Also between the points; no scatter is added to the stated errors."""
    radius = radius_of(Z, 120e-6, 0.07, m2)
    found, values, _ = fitted(Z, radius, 1e-8)
    np.testing.assert_allclose(values, beam(120e-6, 0.07, m2), rtol=1e-7)
    assert found.scatter == 0.0 and found.degrees_of_freedom == 6 and repr(found).splitlines()[-1].startswith("m2 ")
    between, stderr = found.radius([0.07, 0.2])
    np.testing.assert_allclose(between, radius_of(np.array([0.07, 0.2]), 120e-6, 0.07, m2), rtol=1e-7)
    # Close to the waist, as uncertain as the points or little more.
    assert (stderr < 2e-8).all()


@pytest.mark.parametrize(("stderr", "scatter"), [(3e-6, 0.0), (2e-8, 0.02)])
def test_noisy_widths_give_the_beam_back_within_its_intervals(stderr, scatter):
    """300 draws at a fixed seed. A true 68.27 % interval holds the truth in 205 ± 8 of them; a binomial test at 1e-3 a
    quantity (five of them, two cases: one false alarm in a hundred seeds) decides. Linearised errors and the estimated
    scatter may cost some coverage, so the probability tested may lie anywhere within 0.03 of the nominal one."""
    rng = np.random.default_rng(20240607)
    z = np.linspace(-0.35, 0.45, 12)
    radius, truth = radius_of(z, 150e-6, 0.02, 1.2), beam(150e-6, 0.02, 1.2)
    inside = np.zeros(len(truth), int)
    pulls = []
    for _ in range(300):
        drawn = radius * (1 + scatter * rng.normal(size=z.size)) + stderr * rng.normal(size=z.size)
        found, values, errors = fitted(z, drawn, stderr)
        inside += np.abs(values - truth) < hyperbola.compute_interval_half_width(errors, found.degrees_of_freedom)
        pulls.append((values - truth) / errors)
    slack = 0.03
    low = stats.binom.ppf(5e-4, 300, hyperbola.LEVEL - slack)
    high = stats.binom.ppf(1 - 5e-4, 300, hyperbola.LEVEL + slack + (0.05 if scatter == 0 else 0.0))
    for name, count in zip(NAMES, inside, strict=True):
        assert low <= count <= high, (name, count, low, high)
    # No bias: the mean pull of 300 has a standard error of 0.06, and 0.25 leaves room for curvature.
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.25


def test_no_waist_is_nan_not_a_number():
    z = np.linspace(0, 1, 6)
    _, values, errors = fitted(z, np.sqrt(2e-8 - 1e-8 * z**2), 1e-9)
    assert np.isnan(values).all() and np.isnan(errors).all()


def test_file_keeps_the_contract_and_leaves_flagged_fits_out(tmp_path):
    sigma = radius_of(Z, 120e-6, 0.1) / 2 / PITCH
    sigma[3] = 500.0
    fits = fits_of_scan(Z, round_spots(sigma))
    fits["status"][0, 0, 0, 3] = store.flag("at_limit")
    store.write(scan_caustic.compute_caustic(fits, INSTRUMENT), tmp_path / "caustic.nc", code="0")
    with store.read(tmp_path / "caustic.nc") as ds:
        found = ds.sel(estimator="fit")
        values = [float(found[name].sel(axis="mean")) for name in NAMES]
        np.testing.assert_allclose(values, beam(120e-6, 0.1), rtol=1e-6)
        assert int(found["positions"]) == 8 and found["beam"] == "stigmatic"
        # A round beam has no axes: those of the sensor, along which it is as wide.
        assert float(found["azimuth"]) == 0.0 and np.isinf(float(found["azimuth_stderr"]))
        np.testing.assert_allclose(found["m2"], 1.0, rtol=1e-6)
        assert np.isnan(found["beam_radius"].values.reshape(3, -1)[:, 3]).all()


@pytest.mark.parametrize(
    ("z", "change", "reason"),
    [
        (Z, {"conditions": ()}, "declared condition z_m"),
        (Z, {"laser": Laser()}, "laser.wavelength_m"),
        (Z, {"sensor": Sensor()}, "sensor.pixel_pitch_m"),
        (Z[:3], {}, "3 have one"),
    ],
)
def test_skipped_with_its_reason(z, change, reason):
    fits = fits_of_scan(z, round_spots(np.full(len(z), 10.0)))
    assert reason in scan_caustic.compute_caustic(fits, replace(INSTRUMENT, **change)).attrs["skipped"]


def test_radii_that_scatter():
    """Without errors, their scatter about the hyperbola is all that is known, and becomes the error; where they scatter
    more than stated errors allow, nearly the same. With the scatter, χ² per degree of freedom is 1."""
    z = np.linspace(-0.3, 0.3, 15)
    radius = 150e-6 * np.hypot(1, z / 0.1) * (1 + 0.02 * np.random.default_rng(2).standard_normal(15))
    none, small = (caustic.fit_caustic(z, radius, error, wavelength_m=1e-6) for error in (0.0, 1e-7))
    # 12 degrees of freedom: an estimate of 2 % scatters by 20 %, and three times that is allowed.
    assert none.scatter == pytest.approx(0.02, rel=0.6) and np.isnan(none.chi2_reduced) and small.chi2_reduced > 100
    assert (none.m2, none.m2_stderr) == pytest.approx((small.m2, small.m2_stderr), rel=1e-2)
    model = none.radius(z)[0] ** 2
    assert np.sum(((radius**2 - model) / (2 * none.scatter * model)) ** 2) / 12 == pytest.approx(1, rel=1e-3)


PLACES, RADII = [0, 1, 2, 3], [1] * 4
BAD_BEAMS = {
    "few": ([0, 1, 2, 2], RADII, 0.1, 1e-6, "z_m: has 3 different distances; a caustic needs 4 or more"),
    "lengths": (PLACES, [1] * 3, 0.1, 1e-6, "z_m, radius_m, stderr_m: have the shapes (4,), (3,) and ();"),
    "radius": (PLACES, [1, 1, 0, 1], 0.1, 1e-6, "radius_m: every number must be above 0, in metres"),
    "error": (PLACES, RADII, -0.1, 1e-6, "stderr_m: every number must be 0 or above, in metres"),
    "place": ([0, 1, np.nan, 3], RADII, 0.1, 1e-6, "z_m: every number must be finite, in metres"),
    "wavelength": (PLACES, RADII, 0.1, 0.0, "wavelength_m: every number must be above 0, in metres"),
}


@pytest.mark.parametrize(("z", "radius", "stderr", "wavelength", "words"), BAD_BEAMS.values(), ids=BAD_BEAMS)
def test_radii_that_make_no_caustic(z, radius, stderr, wavelength, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        caustic.fit_caustic(z, radius, stderr, wavelength_m=wavelength)
