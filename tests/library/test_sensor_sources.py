"""Where the sensor's quantities come from: data sheet, dark frames, neighbour differences, default."""

import numpy as np
import pytest

from spotcheck.estimate.sensor import resolve
from spotcheck.model.sensor import SensorModel
from spotcheck.model.spot import elliptical_gaussian
from tests.library.conftest import loaded
from tests.reference.numpy_chain import draw

TRUTH = SensorModel(0.25, 8.0, black_level_dn=60.0, full_scale_dn=4095)
FRAME = [np.full((40, 40), 60, np.uint16)]


def test_a_given_key_a_default_and_an_unknown(tmp_path):
    """Each quantity says which it is."""
    ds = resolve(loaded(tmp_path, FRAME, "crop_px: 24\nsensor: {black_level_dn: 5}"), 16, [])
    assert ds["black_level_dn"].attrs["source"] == "instrument.yaml"
    assert ds["dark_current_e_per_s"].attrs["source"] == "default"
    assert np.isnan(float(ds["gain_dn_per_e"])) and ds["gain_dn_per_e"].attrs["source"].startswith("unknown")


def test_dark_frames_replace_a_missing_black_level(tmp_path):
    """Their mean, with its standard error; a given key stands."""
    ds = resolve(loaded(tmp_path / "a", FRAME, "crop_px: 24"), 16, [], [59.0, 60.0, 61.0])
    assert float(ds["black_level_dn"]) == 60 and ds["black_level_dn"].attrs["source"] == "mean of 3 dark frames"
    assert float(ds["black_level_dn_stderr"]) == pytest.approx(1 / np.sqrt(3))
    ds = resolve(loaded(tmp_path / "b", FRAME, "crop_px: 24\nsensor: {black_level_dn: 5}"), 16, [], [60.0])
    assert float(ds["black_level_dn"]) == 5


@pytest.mark.parametrize("seed", range(6))
def test_gain_and_read_noise_of_a_camera_without_a_data_sheet(tmp_path, seed):
    """Twelve spots: K = 0.25 and 8 e- within four of their standard errors (false alarm of the file 8e-4), to 5 %."""
    rng = np.random.default_rng(seed)
    pixel = np.arange(100.0)
    crops = []
    for k in range(12):
        light = elliptical_gaussian(pixel[None], pixel[:, None], 400.0 + 200 * k, 50, 49, 17.0, 12.0, 0.4)
        crops.append(draw(light, 0.0, TRUTH, rng).astype(np.float32))
    text = "crop_px: 24\nsensor: {bit_depth: 12, black_level_dn: 60}"
    ds = resolve(loaded(tmp_path, FRAME, text), 16, crops)
    for name, truth in (("gain_dn_per_e", 0.25), ("read_noise_e", 8.0)):
        value, error = float(ds[name]), float(ds[f"{name}_stderr"])
        assert abs(value - truth) < 4 * error, (name, value, error)
    assert float(ds["gain_dn_per_e"]) == pytest.approx(0.25, rel=0.05)
