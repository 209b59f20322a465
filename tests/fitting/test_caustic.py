"""The caustic against beams whose answer is known in closed form."""

import re

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from spotcheck.dataset.instrument import Instrument, Laser, Sensor
from spotcheck.fitting import caustic, hyperbola, scan_caustic
from spotcheck.fitting.scan_widths import WIDTH_PARAMETERS
from spotcheck.io import store

WAVELENGTH, PITCH = 632.8e-9, 3.75e-6
NAMES = list(hyperbola.QUANTITIES)


def tem00(z, waist, position, m2=1.0):
    """Radius [m] of a beam of a given waist and M² (ISO 11146-1), and what `beam` should return for it."""
    rayleigh = np.pi * waist**2 / (m2 * WAVELENGTH)
    radius = waist * np.sqrt(1 + ((z - position) / rayleigh) ** 2)
    return radius, np.array([waist, position, waist / rayleigh, rayleigh, m2])


@pytest.mark.parametrize("m2", [1.0, 1.7])
def test_exact_widths_give_the_beam_back(m2):
    z = np.linspace(-0.4, 0.6, 11)
    radius, truth = tem00(z, 120e-6, 0.07, m2)
    fit = hyperbola.fit_hyperbola(z, radius, np.full_like(z, 1e-8))
    values, _ = hyperbola.derive_beam_parameters(fit, WAVELENGTH)
    np.testing.assert_allclose(values, truth, rtol=1e-7)
    assert fit.scatter == 0.0
    np.testing.assert_allclose(fit.radius(z)[0], radius, rtol=1e-9)


def test_m2_agrees_with_the_diameter_form_of_the_standard():
    """ISO 11146-1 and the package laserbeamsize write M² = π/(8λ) √(4ac − b²) for d² = a + b z + c z²."""
    z = np.linspace(0.1, 0.9, 9)
    radius, _ = tem00(z, 90e-6, 0.4, 1.3)
    c, b, a = np.polyfit(z, (2 * radius) ** 2, 2)
    values, _ = hyperbola.derive_beam_parameters(hyperbola.fit_hyperbola(z, radius, np.full_like(z, 1e-8)), WAVELENGTH)
    assert values[4] == pytest.approx(np.pi / (8 * WAVELENGTH) * np.sqrt(4 * a * c - b * b), rel=1e-7)
    assert values[0] == pytest.approx(np.sqrt((4 * a * c - b * b) / c) / 4, rel=1e-7)


def test_slopes_of_the_derived_quantities_match_complex_steps():
    """The propagated covariance is J C Jᵀ with the exact Jacobian."""
    coefficients, origin = np.array([2.0e-8, -3.0e-9, 4.0e-6]), 0.3
    factor = np.random.default_rng(3).normal(size=(3, 3)) * coefficients[:, None] * 0.01
    covariance = factor @ factor.T
    fit = hyperbola.Hyperbola(origin, coefficients, covariance, 0.0, 1.0, 6)

    def derived(p):
        a, b, c = p
        root = np.sqrt(4 * a * c - b * b)
        theta = np.sqrt(c)
        return np.array(
            [root / (2 * theta), origin - b / (2 * c), theta, root / (2 * c), np.pi * root / (2 * WAVELENGTH)]
        )

    step = 1e-30
    slopes = np.array([np.imag(derived(coefficients + 1j * step * np.eye(3)[k])) / step for k in range(3)]).T
    _, own = hyperbola.derive_beam_parameters(fit, WAVELENGTH)
    np.testing.assert_allclose(own, slopes @ covariance @ slopes.T, rtol=1e-10)


@pytest.mark.parametrize(("stderr", "scatter"), [(3e-6, 0.0), (2e-8, 0.02)])
def test_noisy_widths_give_the_beam_back_within_its_intervals(stderr, scatter):
    """300 draws at a fixed seed. A true 68.27 % interval holds the truth in 205 ± 8 of them; a binomial test at 1e-3 a
    quantity (five of them, two cases: one false alarm in a hundred seeds) decides. Linearised errors and the estimated
    scatter may cost some coverage, so the probability tested may lie anywhere within 0.03 of the nominal one."""
    rng = np.random.default_rng(20240607)
    z = np.linspace(-0.35, 0.45, 12)
    radius, truth = tem00(z, 150e-6, 0.02, 1.2)
    inside = np.zeros(len(truth), int)
    pulls = []
    for _ in range(300):
        drawn = radius * (1 + scatter * rng.normal(size=z.size)) + stderr * rng.normal(size=z.size)
        fit = hyperbola.fit_hyperbola(z, drawn, np.full_like(z, stderr))
        values, covariance = hyperbola.derive_beam_parameters(fit, WAVELENGTH)
        error = np.sqrt(np.diag(covariance))
        inside += np.abs(values - truth) < hyperbola.compute_interval_half_width(error, fit.degrees)
        pulls.append((values - truth) / error)
    slack = 0.03
    low = stats.binom.ppf(5e-4, 300, hyperbola.LEVEL - slack)
    high = stats.binom.ppf(1 - 5e-4, 300, hyperbola.LEVEL + slack + (0.05 if scatter == 0 else 0.0))
    for name, count in zip(NAMES, inside, strict=True):
        assert low <= count <= high, (name, count, low, high)
    # No bias: the mean pull of 300 has a standard error of 0.06, and 0.25 leaves room for curvature.
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.25


def test_scatter_brings_chi_square_to_one():
    rng = np.random.default_rng(1)
    z = np.linspace(-0.3, 0.3, 20)
    radius, _ = tem00(z, 150e-6, 0.0)
    drawn = radius * (1 + 0.03 * rng.normal(size=z.size))
    fit = hyperbola.fit_hyperbola(z, drawn, np.full_like(z, 1e-8))
    assert fit.chi2_reduced > 100
    # 17 degrees of freedom: the estimate of 3 % scatters by 17 %, four of which are allowed.
    assert fit.scatter == pytest.approx(0.03, rel=0.7)
    model = fit.radius(z)[0] ** 2
    chi2 = np.sum(((drawn**2 - model) / (2 * fit.scatter * model)) ** 2) / fit.degrees
    assert chi2 == pytest.approx(1, rel=1e-3)


def test_no_waist_is_nan_not_a_number():
    z = np.linspace(0, 1, 6)
    fit = hyperbola.fit_hyperbola(z, np.sqrt(2e-8 - 1e-8 * z**2), np.full(6, 1e-9))
    values, covariance = hyperbola.derive_beam_parameters(fit, WAVELENGTH)
    assert np.isnan(values).all() and np.isnan(covariance).all()


def scan(z, sigma_px, stderr_px=0.01):
    """A fits file of a scan of round spots, and its instrument."""
    attrs = {"title": "scan", "dataset": "scan", "not_recorded": "exposure", "preferred": "likelihood"}
    ds = xr.Dataset(attrs=attrs)
    ds["z_m"] = ("z_m", np.asarray(z, float), {"units": "m", "long_name": "z_m"})
    ds["centring"] = ("centring", ["light", "maximum"], {"units": "1", "long_name": "centring"})
    ds["fit"] = ("fit", ["likelihood"], {"units": "1", "long_name": "fit"})
    dims = ("angle", "exposure", "repeat", "z_m", "centring", "fit")
    shape = (1, 1, 1, len(z), 2, 1)
    unknown = {"": np.zeros(len(z)), "_stderr": np.full(len(z), np.inf)}
    known = {"": sigma_px, "_stderr": np.full(len(z), stderr_px)}
    for name in (*WIDTH_PARAMETERS, "sigma_mean"):
        for suffix, values in (unknown if name == "orientation" else known).items():
            full = np.repeat(np.asarray(values, float), 2).reshape(shape)
            ds[f"{name}{suffix}"] = (dims, full, {"units": "pixel", "long_name": name})
    ds["status"] = (dims, np.zeros(shape, "i4"), store.status_attributes())
    laser, sensor = Laser(wavelength_m=WAVELENGTH), Sensor(pixel_pitch_m=PITCH)
    return ds, Instrument(conditions=("z_m",), laser=laser, sensor=sensor)


def test_file_keeps_the_contract_and_leaves_flagged_fits_out(tmp_path):
    z = np.linspace(-0.3, 0.5, 9)
    radius, truth = tem00(z, 120e-6, 0.1)
    sigma = radius / 2 / PITCH
    fits, instrument = scan(z, sigma)
    for name in (*WIDTH_PARAMETERS, "sigma_mean"):
        fits[name][0, 0, 0, 3] = 500.0
    fits["status"][0, 0, 0, 3] = store.flag("at_limit")
    found = scan_caustic.compute_caustic(fits, instrument)
    store.write(found, tmp_path / "caustic.nc", code="0")
    with store.read(tmp_path / "caustic.nc") as ds:
        own = ds.sel(estimator="fit")
        values = [float(own[name].sel(axis="mean")) for name in NAMES]
        np.testing.assert_allclose(values, truth, rtol=1e-6)
        assert int(own["positions"]) == 8 and own["beam"] == "stigmatic"
        # A round beam has no axes: those of the sensor, along which it is as wide.
        assert float(own["azimuth"]) == 0.0 and np.isinf(float(own["azimuth_stderr"]))
        np.testing.assert_allclose(own["m2"], truth[4], rtol=1e-6)
        assert np.isnan(own["beam_radius"].values.reshape(3, -1)[:, 3]).all()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"conditions": ()}, "declared condition z_m"),
        ({"laser": Laser()}, "laser.wavelength_m"),
        ({"sensor": Sensor()}, "sensor.pixel_pitch_m"),
    ],
)
def test_skipped_with_its_reason(change, reason):
    fits, instrument = scan(np.linspace(0, 1, 6), np.full(6, 10.0))
    given = {"conditions": ("z_m",), "laser": instrument.laser, "sensor": instrument.sensor} | change
    assert reason in scan_caustic.compute_caustic(fits, Instrument(**given)).attrs["skipped"]


def test_three_positions_are_too_few():
    fits, instrument = scan([0.0, 0.1, 0.2], [10.0, 9.0, 10.0])
    assert "3 have one" in scan_caustic.compute_caustic(fits, instrument).attrs["skipped"]


def test_a_beam_of_known_m2():
    """ISO 11146-1: w² = w0² (1 + (z − z0)²/z_R²), z_R = π w0²/(M² λ), θ = w0/z_R; exact radii give it back."""
    z, waist, length = np.linspace(-0.2, 0.5, 9), 120e-6, 0.055
    found = caustic.fit_caustic(z, waist * np.hypot(1, (z - 0.07) / length), 1e-8, wavelength_m=632.8e-9)
    want = (waist, 0.07, waist / length, length, np.pi * waist**2 / (length * 632.8e-9))
    assert (found[0], found[2], found[4], found[6], found[8]) == pytest.approx(want, rel=1e-7)
    radius, stderr = found.radius([0.07, 0.2])
    assert radius == pytest.approx(waist * np.hypot(1, [0, 0.13 / length]), rel=1e-7) and (stderr < 1e-8).all()
    assert found.degrees_of_freedom == 6 and repr(found).splitlines()[-1].startswith("m2 ")


def test_radii_without_errors():
    """Their scatter about the hyperbola is all that is known, and becomes the error; where they scatter more than
    stated errors allow, nearly the same."""
    z = np.linspace(-0.3, 0.3, 15)
    radius = 150e-6 * np.hypot(1, z / 0.1) * (1 + 0.02 * np.random.default_rng(2).standard_normal(15))
    none, small = (caustic.fit_caustic(z, radius, own, wavelength_m=1e-6) for own in (0.0, 1e-7))
    # 12 degrees of freedom: an estimate of 2 % scatters by 20 %, and three times that is allowed.
    assert none.scatter == pytest.approx(0.02, rel=0.6) and np.isnan(none.chi2_reduced) and small.chi2_reduced > 100
    assert (none.m2, none.m2_stderr) == pytest.approx((small.m2, small.m2_stderr), rel=1e-2)


BAD_BEAMS = {
    "few": ([0, 1, 2, 2], [1] * 4, 0.1, 1e-6, "z_m: has 3 different distances; a caustic needs 4 or more"),
    "lengths": ([0, 1, 2, 3], [1] * 3, 0.1, 1e-6, "z_m, radius_m, stderr_m: have the shapes (4,), (3,) and ();"),
    "radius": ([0, 1, 2, 3], [1, 1, 0, 1], 0.1, 1e-6, "radius_m: every number must be above 0, in metres"),
    "error": ([0, 1, 2, 3], [1] * 4, -0.1, 1e-6, "stderr_m: every number must be 0 or above, in metres"),
    "place": ([0, 1, np.nan, 3], [1] * 4, 0.1, 1e-6, "z_m: every number must be finite, in metres"),
    "wavelength": ([0, 1, 2, 3], [1] * 4, 0.1, 0.0, "wavelength_m: every number must be above 0, in metres"),
}


@pytest.mark.parametrize(("z", "radius", "stderr", "wavelength", "words"), BAD_BEAMS.values(), ids=BAD_BEAMS)
def test_radii_that_make_no_caustic(z, radius, stderr, wavelength, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        caustic.fit_caustic(z, radius, stderr, wavelength_m=wavelength)
