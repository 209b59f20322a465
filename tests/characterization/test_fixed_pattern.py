"""Pictures and spectra of what stays the same from frame to frame."""

import numpy as np
import pytest

from spotcheck.characterization.fixed_pattern import (
    MAX_SIDE,
    add_patterns,
    compute_spectrum,
    measure_pattern,
    select_levels,
)
from spotcheck.characterization.levels import measure_levels
from spotcheck.characterization.photon_transfer import analyse_photon_transfer
from spotcheck.characterization.transfer_data import build_transfer_dataset
from spotcheck.dataset.folder import load
from tests.samples.example_datasets import write_levels


def test_a_spectrum_of_white_noise_is_flat():
    """rms 3 at every frequency, within 2 % on average over 1024 lines (0.1 %) and 15 % at each (2.2 % each)."""
    spectrum = compute_spectrum(np.random.default_rng(0).normal(0, 3, (1024, 128)))
    assert spectrum.rms.shape == (65,)
    assert np.sqrt((spectrum.rms[1:-1] ** 2).mean()) == pytest.approx(3, rel=0.02)
    assert np.abs(spectrum.rms[1:-1] / 3 - 1).max() < 0.15


def test_stripes_are_a_peak():
    """An amplitude a at 1/8 cycles per px is a √(N/4) there, and nothing elsewhere."""
    x = np.arange(128)
    spectrum = compute_spectrum(np.tile(2 * np.cos(2 * np.pi * x / 8), (5, 1)))
    assert spectrum.frequency[16] == 1 / 8
    assert spectrum.rms[16] == pytest.approx(2 * np.sqrt(128 / 4))
    assert np.delete(spectrum.rms, 16).max() < 1e-9


@pytest.mark.parametrize("pixels", [127, 4099])
def test_frequencies_of_odd_and_averaged_spectra(pixels):
    """A cosine peaks at its frequency: an odd number of pixels has no frequency ½, and averaging keeps the mean."""
    cycles = pixels // 5
    spectrum = compute_spectrum(np.cos(2 * np.pi * cycles * np.arange(pixels) / pixels)[None])
    peak = spectrum.frequency[np.argmax(spectrum.rms)]
    assert peak == pytest.approx(cycles / pixels, abs=2 * spectrum.frequency[1])
    assert spectrum.frequency.max() < 0.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Flats and darks of 40 × 600 px: columns 20 px apart are 4 DN up without light, and 1 % of the light."""
    rng, photons = np.random.default_rng(1), 900.0 * np.arange(1, 11)
    stripe = (np.arange(600) % 20 == 0).astype(float)

    def pair(light: float) -> np.ndarray:
        electrons = np.minimum(rng.poisson(light * (1 + 0.01 * stripe), (2, 40, 600)), 8000)
        return np.rint(50 + 4 * stripe + 0.3 * electrons + rng.normal(0, 2, (2, 40, 600))).astype(np.uint16)

    base, bright, dark = tmp_path_factory.mktemp("pattern"), map(pair, photons), map(pair, np.zeros(10))
    text = "crop_px: 24\nsensor: {bit_depth: 12}\n"
    return write_levels(base, list(bright), list(dark), photons / 9e5, photons, text)


def test_pictures_of_dark_and_half(folder):
    """The stripes' rms without light, √(1/20 · 19/20) 4 DN, in the spectrum along rows and not along columns; blocks of
    3 px keep the picture below its largest size."""
    dataset = load(folder)
    found = analyse_photon_transfer(measure_levels(dataset, 4095.0), 4095.0)
    levels = select_levels(found)
    assert levels["dark"].kind == "dark" and abs(levels["flat"].mean - 50 - 0.3 * 4000) < 200
    pattern = measure_pattern(dataset, levels["dark"])
    assert pattern.side == 3 and max(pattern.image.shape) <= MAX_SIDE and abs(pattern.image.mean()) < 0.05
    along_rows = pattern.along_rows
    peak = along_rows.rms[np.argmin(np.abs(along_rows.frequency - 1 / 20))]
    assert peak > 3 * pattern.noise and pattern.along_columns.rms[1:].max() < 2.5 * pattern.noise
    assert np.sqrt((along_rows.rms[1:] ** 2).mean() - pattern.noise**2) == pytest.approx(4 * np.sqrt(19) / 20, rel=0.15)


def test_they_are_in_the_file(folder):
    dataset = load(folder)
    found = analyse_photon_transfer(measure_levels(dataset, 4095.0), 4095.0)
    ds = add_patterns(build_transfer_dataset(found, "T", "d"), dataset, found)
    assert ds["flat_picture"].shape == ds["dark_picture"].shape == (13, 200)
    assert float(ds["dark_shown_at"]) == pytest.approx(50.2, abs=0.2)
    assert ds["flat_along_rows"].sizes["flat_rows_frequency"] == 301
