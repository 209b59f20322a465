"""Frames whose pixels share their noise or are sharpened give no gain; sound ones keep it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, median_filter, uniform_filter

import spotcheck
from spotcheck.characterization.noise_curve import measure_pair_correlation
from spotcheck.characterization.spot_estimates import estimate_from_spots

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


@pytest.mark.parametrize(("radius_px", "amount"), [(1.0, 0.8), (0.7, 1.5), (1.5, 1.0)])
def test_sharpened_frames_leave_the_gain_unknown(radius_px, amount):
    """An unsharp mask multiplies the noise of a pixel, and keeps that of means."""
    quantities = characterise(lambda image: image + amount * (image - gaussian_filter(image, radius_px)))
    for name in ("gain", "dark_noise", "full_well"):
        assert np.isnan(quantities[name].value) and "sharpened" in quantities[name].why
    assert sum("without noise reduction, sharpening" in remark for remark in quantities.remarks) == 1


def test_sharpened_spots_give_no_gain():
    """As they are, the same spots give the gain from pairs and from neighbours."""
    y, x = np.mgrid[:120, :120]
    light = 900 * np.exp(-((x - 61) ** 2 + (y - 58) ** 2) / 2 / 14**2)
    rng = np.random.default_rng(4)
    spots = [30 + GAIN * (rng.poisson(light / GAIN) + rng.normal(0, 9, light.shape)) for _ in range(4)]
    sharp = [image + 0.8 * (image - gaussian_filter(image, 1)) for image in spots]
    for images, is_known in ((spots, True), (sharp, False)):
        pairs = {"repeats": [tuple(np.rint(images[:2])), tuple(np.rint(images[2:]))]}
        found = estimate_from_spots(map(np.rint, images), pairs, 30.0, 4095.0)
        assert (found.gain is not None) == is_known and ("sharpened" in found.method) != is_known
        if found.gain:
            assert found.gain.gain == pytest.approx(GAIN, rel=0.1)


@pytest.mark.parametrize("row_noise_dn", [0.0, 4.0])
def test_white_noise_and_noise_of_rows_give_the_gain(row_noise_dn):
    gain = characterise(lambda image: image, row_noise_dn)["gain"]
    assert abs(gain.value - GAIN) < 4 * gain.stderr < 0.02


def test_frames_without_noise_share_none():
    assert measure_pair_correlation(np.full((40, 40), 5.0), np.full((40, 40), 5.0)) == (0, True)
