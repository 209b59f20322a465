"""A curved response that the data sheet states: its readings, its fits, and flats that show it."""

import re
from dataclasses import replace

import numpy as np
import pytest

import spotcheck
from spotcheck.cli import main
from spotcheck.cli.pipeline import judge_dataset
from spotcheck.dataset.instrument import read_instrument
from spotcheck.export.frame_correction import compute_response_curve, correct_frame
from spotcheck.sensor import SensorModel
from spotcheck.sensor.response import apply_curvature, remove_curvature
from tests.samples.example_datasets import write_levels

SENSOR = SensorModel(0.25, 8.0, black_level_dn=40.0, full_scale_dn=1023.0, response_bend=0.06)
LINEAR = replace(SENSOR, response_bend=0.0)


def readings(photons, rng, sensor=SENSOR):
    """Readings by the closed form: counts, noise, y − q y²/full scale, black level, one rounding, both clips."""
    signal = sensor.gain_dn_per_e * (rng.poisson(photons) + rng.normal(0, sensor.read_noise_e, np.shape(photons)))
    signal -= sensor.response_bend * signal**2 / sensor.full_scale_dn
    return np.clip(np.rint(signal + sensor.black_level_dn), 0, sensor.full_scale_dn)


@pytest.mark.parametrize("curvature", [1e-4, -1e-4, 0.0])
def test_removing_the_curvature_is_the_inverse_of_applying_it(curvature):
    """Also below black, and x − c x² written out; NaN stays NaN."""
    signal = np.linspace(-2000.0, 2000.0, 21)
    response = apply_curvature(signal, curvature)
    np.testing.assert_allclose(response, signal - curvature * signal**2, rtol=1e-14)
    np.testing.assert_allclose(remove_curvature(response, curvature), signal, rtol=1e-12, atol=1e-12)
    assert np.isnan(remove_curvature(np.array([np.nan]), curvature)).all()


@pytest.mark.parametrize("curvature", [1e-4, -1e-4])
def test_the_response_stays_constant_beyond_its_extremum(curvature):
    """At 1/(2c) the response is 1/(4c) and never turns back; a response that no signal reaches has that signal."""
    extremum, beyond = 0.5 / curvature, np.array([1.0, 1.5, 20.0]) / curvature
    np.testing.assert_allclose(apply_curvature(beyond, curvature), extremum / 2, rtol=1e-14)
    np.testing.assert_allclose(remove_curvature(np.array([0.5, 0.7, 9.0]) * extremum, curvature), extremum, rtol=1e-7)


def test_linearized_readings_belong_to_the_sensor_without_curvature():
    """Black level and full scale are linearized as readings are, and a linear sensor stays what it is."""
    own = SENSOR.without_curvature()
    assert own.response_bend == 0 and own.full_scale_dn == float(SENSOR.linearize(1023.0)) > 1023
    assert float(SENSOR.linearize(40.0)) == 40.0
    assert LINEAR.without_curvature() is LINEAR
    readings_dn = np.array([3, 700], np.uint16)
    np.testing.assert_array_equal(LINEAR.linearize(readings_dn), readings_dn)


@pytest.mark.parametrize("photons", [0.0, 20.0, 600.0, 2400.0, 4100.0])
def test_mean_variance_and_draws_of_a_curved_sensor(photons):
    """Of 200,000 pixels, from black to where full scale cuts half of them. Mean and variance to five errors (one false
    alarm in 1e5 over all) and of the table behind `mean` and `variance` 1e-4: all are exact."""
    rng, light = np.random.default_rng(3), np.full((400, 500), photons)
    mean, variance = SENSOR.mean(photons), SENSOR.variance(photons)
    for own in (readings(light, rng), SENSOR.draw(light, rng)):
        error = 5 * np.sqrt(own.var() / own.size)
        assert mean == pytest.approx(own.mean(), abs=error + 1e-3)
        assert variance == pytest.approx(own.var(), rel=6 * np.sqrt(2 / own.size) + 1e-4)
    whole = SENSOR.linearize(readings(light, rng))
    # Below black, and where full scale cuts, a mean of straightened readings is none of the signal's.
    if 20 < photons < 4000:
        slope = 1 - 2 * SENSOR.curvature * SENSOR.gain_dn_per_e * photons
        error = 5 * np.sqrt(whole.var() / whole.size)
        assert whole.mean() == pytest.approx(LINEAR.mean(photons), abs=error + 0.02)
        # Rounding happens behind the bend.
        expected = LINEAR.variance(photons) + (1 / slope**2 - 1) / 12
        assert whole.var() == pytest.approx(expected, rel=5 * np.sqrt(2 / whole.size) + 1e-3)


def test_a_spot_is_fitted_through_the_bend():
    """Over 60 draws of a spot with pixels at full scale the pulls of amplitude and width are standard normal, mean to
    four errors (1 in 16,000) and variance to four (of a χ² of 59); by a straight sensor the amplitude is 20 off."""
    rng, (y, x) = np.random.default_rng(11), np.mgrid[:40, :44]
    photons = 4300 * np.exp(-(((x - 21.3) / 5) ** 2 + ((y - 19.6) / 4) ** 2) / 2)
    images = [readings(photons, rng) for _ in range(60)]
    assert np.mean([np.max(image) == 1023 for image in images]) > 0.9
    fits = spotcheck.fit_spots(images, SENSOR)
    for name, truth in (("amplitude", 1075.0), ("sigma_major", 5.0), ("sigma_minor", 4.0)):
        pull = (getattr(fits, name) - truth) / getattr(fits, f"{name}_stderr")
        assert abs(pull.mean()) < 4 / np.sqrt(60), name
        assert pull.var(ddof=1) == pytest.approx(1, abs=4 * np.sqrt(2 / 59)), name
    assert fits.chi2_reduced.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / 1760 / 60) + 0.005)
    plain = spotcheck.fit_spots(images[:5], LINEAR)
    assert np.all((1075 - plain.amplitude) / plain.amplitude_stderr > 20)


def test_bounds_are_those_that_fits_reach():
    """A bend moves where full scale cuts, and nothing else of what a reading tells."""
    asked = {"amplitude": 700.0, "sigma_major": 5.0, "sigma_minor": 4.0}
    bend, plain = (spotcheck.spot_bounds(own, (40, 40), **asked) for own in (SENSOR, LINEAR))
    assert bend == pytest.approx(plain, rel=1e-6)
    rng, (y, x) = np.random.default_rng(12), np.mgrid[:40, :40]
    photons = 2800 * np.exp(-(((x - 19.5) / 5) ** 2 + ((y - 19.5) / 4) ** 2) / 2)
    widths = spotcheck.fit_spots([readings(photons, rng) for _ in range(80)], SENSOR).sigma_major
    assert widths.std(ddof=1) == pytest.approx(bend.sigma_major, rel=4 / np.sqrt(2 * 79))


def test_electrons_are_those_of_the_light():
    """Corrected frames of a sheet that states the bend: mean to five errors, and the variance that is stated."""
    light = np.full((200, 200), 2000.0)
    own = correct_frame(readings(light, np.random.default_rng(5)), SENSOR, compute_response_curve(SENSOR, []))
    assert own.electrons.mean() == pytest.approx(2000, abs=5 * np.sqrt(own.electrons.var() / light.size) + 0.5)
    assert own.variance.mean() == pytest.approx(own.electrons.var(), rel=5 * np.sqrt(2 / light.size) + 0.005)


@pytest.mark.slow
def test_what_flats_tell_of_the_response_is_adopted(tmp_path, capsys):
    """A bend that flats show goes into the instrument file with the gain that stands beside it. The same flats by that
    file are straight: no effect is named, and plain photon transfer tells the same gain."""
    rng, first, photons = np.random.default_rng(21), tmp_path / "flats", 500.0 * np.arange(25)
    camera = SensorModel(0.3, 9.0, black_level_dn=60.0, full_scale_dn=4095.0, response_bend=0.03)

    def pair(light: float) -> np.ndarray:
        return readings(np.full((2, 300, 400), light), rng, camera).astype(np.uint16)

    # The first flat is as dark as the darks, and still its photons count.
    bright, dark = [pair(light) for light in photons], [pair(0.0) for _ in photons]
    write_levels(first, bright, dark, 1e-3 * np.arange(1, 26), photons, "sensor: {bit_depth: 12}\n")
    judge_dataset(first, tmp_path / "results")
    main(["adopt", str(tmp_path / "results" / "flats"), "--to", str(tmp_path / "camera.yaml")])
    # Cells of the table are wrapped, so that the words of a reason stand in several lines.
    assert re.search("it assumes a.*linear.*response", capsys.readouterr().out, re.DOTALL)
    made = read_instrument(tmp_path / "camera.yaml").sensor
    # To four of the errors that the file states or a tenth of the bend, whichever is more.
    assert made.gain_dn_per_e == pytest.approx(0.3, abs=4 * made.gain_dn_per_e_stderr)
    assert made.read_noise_e == pytest.approx(9.0, abs=4 * made.read_noise_e_stderr)
    assert made.response_bend == pytest.approx(0.03, rel=0.1)
    before = spotcheck.characterise_dataset(first)["gain"]
    (first / "instrument.yaml").write_text("based_on: ../camera.yaml\n", encoding="utf-8")
    again, after = judge_dataset(first, tmp_path / "again"), spotcheck.characterise_dataset(first)["gain"]
    assert again["status"] == "consistent" and not again["effects"]
    assert before.value < 0.3 - 4 * before.stderr
    assert after.value == pytest.approx(0.3, abs=4 * after.stderr)
