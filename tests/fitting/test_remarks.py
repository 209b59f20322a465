"""What is odd about results is said: in files, by commands, in words that name the likely keys."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from spotcheck.cli import main
from spotcheck.fitting import scan_caustic
from spotcheck.fitting.crop_fits import TOO_HIGH, TOO_LOW, fit_crops, select_preferred_fits
from spotcheck.fitting.precision import summarize_precision
from spotcheck.io import store
from tests.fitting.test_precision import found as precision_file
from tests.samples.scans import INSTRUMENT, PITCH, fits_of_scan, radius_of, round_spots
from tests.samples.small_datasets import SENSOR, crops_of, gaussian, loaded, noisy

SHEET = "crop_px: 60\nsensor: {bit_depth: 10, black_level_dn: 40, dark_current_e_per_s: 70"


@pytest.mark.parametrize(
    ("gain", "noise", "words"),
    [(0.11, 13.0, ""), (9.1, 13.0, "too large"), (0.11, 300.0, "too large"), (1e-5, 13.0, "too low")],
)
def test_a_chi_square_far_from_one_is_flagged_and_said(tmp_path, gain, noise, words):
    """A spot of 0.11 DN/e- and 13 e-, fitted with that, with e-/DN for a gain, and with other noise."""
    frames = [noisy(gaussian(100, 900.0, 48.4, 51.7, 14.0), seed) for seed in (1, 2)]
    dataset = loaded(tmp_path, frames, SHEET + "}")
    fits = fit_crops(crops_of(dataset), replace(SENSOR, gain_dn_per_e=gain, read_noise_e=noise))
    own = select_preferred_fits(fits)
    flagged = (own["status"].values & store.flag("misfit")) > 0
    assert (flagged == bool(words)).all()
    chi2 = own["chi2_reduced"].values
    assert ((chi2 < TOO_LOW) | (chi2 > TOO_HIGH)).all() == bool(words)
    said = store.remarks_of(fits)
    assert len(said) == bool(words)
    for text in said:
        assert text.startswith("2 of 2 fits have a χ²") and words in text
        assert "sensor.gain_dn_per_e" in text and "sensor.read_noise_e" in text


def test_crops_that_no_fit_was_made_of_are_said_with_the_reason(tmp_path, capsys):
    """Without a gain the likelihood fits none, and a black frame is fitted by nobody: counted by their flags."""
    black = np.full((100, 100), 40, np.uint16)
    loaded(tmp_path / "d", [noisy(gaussian(100, 500.0, 48.4, 51.7, 6.0), 1), black], "crop_px: 60")
    files = {name: str(tmp_path / f"{name}.nc") for name in ("frames", "crops", "sensor", "fits")}
    folder = str(tmp_path / "d")
    main(["ingest", folder, "--output", files["frames"]])
    main(["crop", folder, "--frames", files["frames"], "--output", files["crops"]])
    main(["sensor", folder, "--crops", files["crops"], "--frames", files["frames"], "--output", files["sensor"]])
    with store.read(files["sensor"]) as sensor:
        unknown = sensor.load()
    unknown["gain_dn_per_e"] = unknown["gain_dn_per_e"] * np.nan
    unknown["gain_dn_per_e"].attrs |= {"units": "DN/e-", "long_name": "overall gain K"}
    store.write(unknown, files["sensor"], code="")
    capsys.readouterr()
    main(["fit", folder, "--crops", files["crops"], "--sensor", files["sensor"], "--output", files["fits"]])
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("0 of 4 crops fitted by likelihood: 2 × no light above the noise")
    assert "4 × gain or read noise is unknown" in first
    assert second == "2 of 4 crops fitted by least squares: 2 × no light above the noise"


@pytest.mark.parametrize(("wrong_by", "said"), [(1.0, False), (0.1, True), (0.5, True), (2.0, False)])
def test_a_beam_better_than_a_gaussian_is_impossible(tmp_path, wrong_by, said):
    """The pixel pitch off by a factor: M² goes with its square, and below 1 the keys are named."""
    z = np.linspace(-0.3, 0.5, 9)
    spots = round_spots(radius_of(z, 120e-6, 0.1) / 2 / PITCH * wrong_by)
    found = scan_caustic.compute_caustic(fits_of_scan(z, spots), INSTRUMENT)
    assert float(found["m2"].sel(estimator="fit", axis="mean")) == pytest.approx(wrong_by**2, rel=0.01)
    texts = store.remarks_of(found)
    assert len(texts) == said
    for text in texts:
        assert "sensor.pixel_pitch_m" in text and "laser.wavelength_m" in text and "z_m" in text


def test_exact_errors_and_infinities_are_said(tmp_path):
    """A standard error of 0 and an infinite number, once each; not where the variable says what infinity means."""
    ds = xr.Dataset(attrs={"title": "t", "dataset": "d"})
    for name, values in (
        ("width_stderr", [0.1, 0.0, np.nan]),
        ("ratio", [1.0, np.inf, np.inf]),
        ("p", [0.0, 1.0, 2.0]),
    ):
        ds[name] = ("n", np.array(values), {"units": "1", "long_name": name})
    ds["n"] = ("n", np.arange(3), {"units": "1", "long_name": "n"})
    ds["well"] = ((), np.inf, {"units": "e-", "long_name": "well", "infinite": "none"})
    store.write(store.add_remarks(ds, ["one", "one"]), tmp_path / "a.nc", code="")
    with store.read(tmp_path / "a.nc") as own:
        first, zero, infinite = store.remarks_of(own)
    assert first == "one" and infinite == "ratio is infinite in 2 of 3 places"
    assert zero.startswith("width_stderr is exactly 0 in 1 of 3 places")


def test_copies_of_a_frame_have_no_scatter_to_speak_of():
    """Repeats that are copies: the sentence does without them."""
    ds = precision_file(excess=(0.0, 1.0))
    assert (ds["ratio_measured"] == 0).all()
    assert "measured widths" not in summarize_precision(ds).lower() and "simulated widths" in summarize_precision(ds)
