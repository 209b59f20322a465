"""Flats and darks whose pixels share their noise give no gain; sound ones keep it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, median_filter, uniform_filter

import spotcheck
from spotcheck.characterization.noise_curve import measure_pair_correlation

GAIN, LEVELS = 0.3, 8


def characterise(process, row_noise_dn=0.0):
    """Characterise a camera of 0.3 DN/e- and 9 e- read noise that processes its frames."""
    rng = np.random.default_rng(12)

    def pair(electrons):
        frames = []
        for _ in range(2):
            charge = rng.poisson(electrons, (80, 100)) + rng.normal(0, 9, (80, 100))
            rows = row_noise_dn * rng.normal(size=(80, 1))
            frames.append(np.clip(np.rint(process(GAIN * charge + 30 + rows)), 0, 4095))
        return frames

    electrons = np.linspace(800, 11000, LEVELS)
    darks = [pair(0) for _ in electrons]
    return spotcheck.characterise_sensor(
        [pair(light) for light in electrons], darks, 1e-3, electrons / 0.5, bit_depth=12
    )


@pytest.mark.parametrize(
    "process",
    [
        lambda image: uniform_filter(image, 3),
        lambda image: uniform_filter(image, (1, 2)),
        lambda image: gaussian_filter(image, 0.5),
        lambda image: median_filter(image, 3),
    ],
    ids=["mean of 3 x 3", "mean of two columns", "Gaussian", "median"],
)
def test_noise_reduction_leaves_the_gain_unknown(process):
    quantities = characterise(process)
    for name in ("gain", "dark_noise", "full_well"):
        assert np.isnan(quantities[name].value) and "pixels share their noise" in quantities[name].why
    # Means of readings are right.
    assert quantities["dark_offset"].value == pytest.approx(30, abs=0.3)
    assert sum("without noise reduction" in remark for remark in quantities.remarks) == 1


@pytest.mark.parametrize("row_noise_dn", [0.0, 4.0])
def test_white_noise_and_noise_of_rows_give_the_gain(row_noise_dn):
    gain = characterise(lambda image: image, row_noise_dn)["gain"]
    assert abs(gain.value - GAIN) < 4 * gain.stderr < 0.02


def test_frames_without_noise_share_none():
    assert measure_pair_correlation(np.full((40, 40), 5.0), np.full((40, 40), 5.0)) == (0, True)
