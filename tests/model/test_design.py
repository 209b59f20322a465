"""A dataset drawn for a design: frames of the law, seeds, effects of a model file, and what cannot be drawn."""

import re
from pathlib import Path

import numpy as np
import pytest

from spotcheck.dataset import frames
from spotcheck.dataset.folder import load
from spotcheck.errors import InputError
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.io import store
from spotcheck.model.design import simulate_dataset
from spotcheck.sensor import SensorModel
from tests.samples.example_datasets import CAMERA, LAW, design, levels


def test_a_dataset_and_its_images(there):
    """What it holds in one line; pixels as they are on disk."""
    dataset = load("my-flats")
    assert repr(dataset) == "<Dataset my-flats: 40 darks, 40 flats>"
    image = frames.read_image(dataset, dataset.frames[3])
    assert np.array_equal(image, levels()[1][1, 1])


def test_simulated_frames_are_those_of_the_law(there):
    """Fitted widths are p1 ln t + p2, peaks t/σ² of that at the longest exposure; 18 spots and two numbers each within
    4.5 standard errors (false alarm 2.4e-4), with 4e-4 px for widths of light that is sampled."""
    drawn = load("my-frames")
    fits = fit_spots((frames.read_image(drawn, spot) for spot in drawn.spots), CAMERA, circular=True)
    t = np.array([spot.exposure_s for spot in drawn.spots])
    width = 1.2 * np.log(t) + 14
    peak = 600 * (t / width**2) / (9e-4 / (1.2 * np.log(9e-4) + 14) ** 2)
    assert (np.abs(fits.sigma_mean - width) < 4.5 * fits.sigma_mean_stderr + 4e-4).all()
    assert (np.abs(fits.amplitude - peak) < 4.5 * fits.amplitude_stderr).all()


def test_equal_seeds_give_equal_folders(there, tmp_path):
    """The camera of instrument.yaml is the one that is given; another seed draws other frames."""
    drawn = {
        name: simulate_dataset("design", tmp_path / name, **LAW, **options)
        for name, options in {"a": {"seed": 4}, "b": {"seed": 4, "sensor": CAMERA}, "c": {"seed": 5}}.items()
    }
    a, b, c = (np.stack([frames.read_image(own, spot) for spot in own.spots]) for own in drawn.values())
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    with store.read(tmp_path / "a" / "expected.nc") as ds:
        expected = ds["mean_reading"].transpose("angle", "repeat", "exposure", "y", "x").values.reshape(18, 48, 48)
    # 18 means over a crop, of 120 DN and 8 e- of noise at most, each within 4.5 standard errors (false alarm 1e-4).
    miss = (a[:, 24:72, 24:72] - expected).mean(axis=(1, 2))
    assert np.abs(miss).max() < 4.5 * np.sqrt(0.11 * 120 + 0.11**2 * 64) / 48


def test_a_model_file_is_simulated(there, tmp_path):
    """Effects of a model.yaml are in the frames: a pedestal of 30 DN."""
    (tmp_path / "model.yaml").write_text(
        "schema: 1\nframe: {rows_px: 96, columns_px: 96}\nexposure: {longest_s: 9.0e-4, reference_s: 3.0e-4}\n"
        "law: {p1_px: 1.2, p2_px: 14, peak_dn: 600}\n"
        "effects:\n  - name: dark_offset\n    form: electronic\n    parameters: {level: 30}\n",
        encoding="utf-8",
    )
    drawn = simulate_dataset("design", tmp_path / "out", model=tmp_path / "model.yaml", seed=1)
    corner = [frames.read_image(drawn, spot)[:20, :20].mean() for spot in drawn.spots]
    # 50 DN, 400 pixels of 0.9 DN rms: 4.5 standard errors are 0.2 DN.
    np.testing.assert_allclose(corner, 50, atol=0.25)


BAD_DRAWS = {
    "nothing": ({}, {}, "simulate_dataset: p1_px, p2_px or peak_dn is missing; give all three, or a model.yaml"),
    "both": ({}, LAW | {"model": "m.yaml"}, "simulate_dataset: a model has p1_px, p2_px and peak_dn of its own; give"),
    "no file": ({}, {"model": "m.yaml"}, "m.yaml: is no file"),
    "sheet": (
        {"sensor": "{bit_depth: 10}"},
        LAW,
        "instrument.yaml: key sensor.gain_dn_per_e is missing; give",
    ),
    "scale": (
        {},
        LAW | {"sensor": SensorModel(0.1, 5.0)},
        "sensor: full_scale_dn is infinite; give the",
    ),
    "widths": (
        {},
        LAW | {"p2_px": 1.0},
        "simulate_dataset: peak_dn is 600 and the least width -10.0524 px; both",
    ),
    "free": (
        {"more": "model: {photon_budget: free}\n"},
        LAW,
        "simulate_dataset: p1_px, p2_px and peak_dn are a law",
    ),
    "times": ({"exposures": ("",)}, LAW, "simulate_dataset: p1_px, p2_px and peak_dn are a law"),
}


@pytest.mark.parametrize(("made", "options", "words"), BAD_DRAWS.values(), ids=BAD_DRAWS)
def test_what_cannot_be_simulated(made, options, words, tmp_path):
    with pytest.raises(InputError, match=re.escape(words)):
        simulate_dataset(design(tmp_path / "design", **made), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_dataset_is_not_overwritten(there):
    """Least of all the measured one."""
    before = Path("my-frames/manifest.csv").read_bytes()
    with pytest.raises(InputError, match=r"my-frames: holds a dataset; name another folder"):
        simulate_dataset("my-frames", "my-frames", **LAW)
    assert Path("my-frames/manifest.csv").read_bytes() == before
