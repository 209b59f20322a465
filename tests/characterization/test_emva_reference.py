"""Photon transfer beside the package `emva1288` (1.0.2, the standard's reference implementation, Release 4.0) on the
same frames: 204 real ones of a CCD, and frames of a simulated sensor."""

import numpy as np
import pytest
from PIL import Image

from spotcheck.characterization.characterise import characterise_sensor
from spotcheck.characterization.levels import measure_levels
from spotcheck.characterization.photon_transfer import analyse_photon_transfer
from spotcheck.dataset.folder import load
from tests.conftest import SHARED
from tests.samples.example_datasets import flats, levels
from tests.validation.generators.real.emva import reference

CCD = SHARED / "data" / "emva-ccd"


def ours(folder):
    found = load(folder)
    return analyse_photon_transfer(measure_levels(found, 4095.0), 4095.0).quantities


@pytest.fixture(scope="module")
def ccd():
    if not CCD.exists():
        pytest.skip("emva-ccd: the real frames are not on this machine")
    return ours(CCD), reference(CCD, 14667.0)


# Ours → (theirs, factor to our unit).
EQUAL = {
    "gain": ("K", 1.0),
    "responsivity": ("R", 1.0),
    "quantum_efficiency": ("QE", 0.01),
    "saturation_photons": ("u_p_sat", 1.0),
    "full_well": ("u_e_sat", 1.0),
    "snr_max": ("SNR_max", 1.0),
    "linearity_lowest": ("LE_min", 1.0),
    "linearity_highest": ("LE_max", 1.0),
}
# These agree within the stated standard error, for the reason given.
CLOSE = {
    "dark_noise_dn": ("sigma_y_dark", 1.0),  # the line over exposure is weighted by the errors of its points
    "dark_noise": ("sigma_d", 1.0),
    "dark_current": ("u_I_mean", 1.0),
    "dark_current_by_variance": ("u_I_var", 1.0),
    "threshold": ("u_e_min", 1.0),  # theirs is σ/K + ½, the limit of ½ + √(σ²/K² + ¼) for large noise
    "dynamic_range": ("DR", 1.0),
    "prnu": ("PRNU1288", 1.0),  # two frames' covariance in place of variance less noise; other half level
}


@pytest.mark.parametrize("name", EQUAL)
def test_equal_to_the_package_on_a_real_sensor(ccd, name):
    """To a part in 10⁶: the same estimator."""
    own, other = ccd
    key, factor = EQUAL[name]
    assert own[name].value == pytest.approx(other[key] * factor, rel=1e-6)


@pytest.mark.parametrize("name", CLOSE)
def test_close_to_the_package_on_a_real_sensor(ccd, name):
    """Within the standard error, or 2 % for PRNU, whose level differs."""
    own, other = ccd
    key, factor = CLOSE[name]
    assert abs(own[name].value - other[key] * factor) < max(own[name].stderr, 0.02 * own[name].value * (name == "prnu"))


def test_dsnu_differs_and_why(ccd):
    """The package takes the pattern of one pair of darks. On this sensor pairs scatter by far more than white noise
    would have them, for the noise of whole rows hangs together; ours is the mean over all darks, with that scatter as
    its error."""
    own, other = ccd
    found = load(CCD)
    images = [np.asarray(Image.open(CCD / f.file), float) for f in found.frames if f.kind == "dark"][:20]
    pairs = [(b - a).mean(axis=1).var() for a, b in zip(images[::2], images[1::2], strict=True)]
    white = [(b - a).var() / a.shape[1] for a, b in zip(images[::2], images[1::2], strict=True)]
    assert np.mean(pairs) > 3 * np.mean(white)
    totals = np.array([level.pattern.total for level in measure_levels(found, 4095.0) if level.kind == "dark"])
    one_pair = totals.std(ddof=1)
    theirs = (other["DSNU1288"] * own["gain"].value) ** 2
    assert abs(theirs - totals.mean()) < 3 * one_pair
    assert one_pair > 5 * np.sqrt(2 / 640 / 480) * 9.45 / 2


def test_what_is_said_of_the_real_sensor(ccd):
    """The figures of a first look by hand: K 0.280 DN/e-, dark noise 10.9 e-, full well some 14 ke-, dark level 14.7
    DN."""
    own, _ = ccd
    assert own["gain"].value == pytest.approx(0.280, abs=0.0005)
    assert own["dark_noise"].value == pytest.approx(10.9, abs=0.05)
    assert own["full_well"].value == pytest.approx(13.9e3, rel=0.015)
    assert own["dark_offset"].value == pytest.approx(14.7, abs=0.05)


def test_arrays_of_frames_in_both(tmp_path):
    """emva1288 1.0.2 on the same frames: where both have the same estimator, to a part in 10⁶; the noise without light,
    whose line over exposure is weighted here, within its standard error."""
    bright, dark, exposures, photons = levels()
    found = characterise_sensor(bright, dark, exposures, photons, bit_depth=12)
    other = reference(flats(tmp_path), 15000.0)
    for name in ("gain", "responsivity", "quantum_efficiency", "saturation_photons", "full_well", "snr_max"):
        key, factor = EQUAL[name]
        assert found[name].value == pytest.approx(other[key] * factor, rel=1e-6), name
    assert abs(found["dark_noise"].value - other["sigma_d"]) < found["dark_noise"].stderr
