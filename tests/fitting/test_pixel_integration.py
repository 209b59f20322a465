"""Light that a pixel reads as the mean over it: model, fit and calibration against the closed form of a Gaussian."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from spotcheck.dataset.folder import load
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import fit_crops, select_preferred_fits
from spotcheck.fitting.likelihood import SiteFrame, fit_baseline
from spotcheck.fitting.width_law import WidthLaw, fit_simulated_widths
from spotcheck.model.baseline import Baseline, build_baseline
from spotcheck.model.conditions import PixelGrid
from spotcheck.model.forward import ForwardModel
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.effect_cases import applied, free_frame, of
from tests.samples.small_datasets import crops_of, folder, loaded

SIDE = 33
SENSOR = SensorModel(0.3, 4.0, black_level_dn=50.0, full_scale_dn=65535.0)
KEY = "optics: {pixel_integration: true}\n"
INTEGRATED = Baseline(0.0, "free", False, 1.0, pixel_integration=True)


def over_pixels(side: int, amplitude: float, x: float, y: float, sigma: float) -> np.ndarray:
    """Mean of a round Gaussian over every pixel, by error functions."""
    edges = np.arange(side + 1) - 0.5
    along, across = (np.diff(erf((edges - at) / (sigma * np.sqrt(2)))) / 2 for at in (x, y))
    return amplitude * 2 * np.pi * sigma**2 * across[:, None] * along


def light(baseline: Baseline, pixel: np.ndarray, middle: tuple[float, float], sigma: float, *cases) -> np.ndarray:
    """Return the light of a spot of 700 DN at columns and rows `pixel`."""
    grid = PixelGrid(pixel[None], pixel[:, None], 50, 50)
    frame = free_frame(700.0, sigma, grid, x0=middle[0], y0=middle[1])
    return ForwardModel(baseline, SENSOR, None, applied(cases)).light(frame).total


@pytest.mark.parametrize("sigma", [0.6, 0.9, 1.2, 2.0, 5.0])
def test_the_model_is_the_mean_over_a_pixel(sigma):
    """Baseline and model, to the 1.5e-5/σ⁶ of the peak that three points across a pixel miss."""
    pixel = np.arange(float(SIDE))
    exact = over_pixels(SIDE, 700.0, 16.3, 15.8, sigma)
    declared = INTEGRATED.declared_light(pixel[None], pixel[:, None], 700.0, 16.3, 15.8, sigma)
    for found in (declared, light(INTEGRATED, pixel, (16.3, 15.8), sigma)):
        assert np.abs(found - exact).max() < 1.5e-5 / sigma**6 * 700


def test_a_turned_ellipse_over_a_pixel():
    """Against a fine grid of points in every pixel, to 1e-5 of the peak."""
    ellipse, fine = of("beam_ellipticity", ratio=1.4, direction=35.0), 31
    found = light(INTEGRATED, np.arange(17.0), (8.2, 8.2), 1.2, ellipse)
    points = (np.arange(17 * fine) + 0.5) / fine - 0.5
    sampled = light(replace(INTEGRATED, pixel_integration=False), points, (8.2, 8.2), 1.2, ellipse)
    exact = sampled.reshape(17, fine, 17, fine).mean(axis=(1, 3))
    # The mean over points itself misses (1/fine)²/24 of the curvature 1/σ², 4e-5.
    assert np.abs(found - exact).max() < 5e-5 * 700


@pytest.mark.parametrize("sigma", [0.9, 1.2, 3.0])
def test_a_fit_gives_the_width_of_the_light(tmp_path, sigma):
    """Forty frames: the mean width within four standard errors of it and of 2e-3 of the truth with the key, at
    √(σ² + 1/12) without."""
    rng = np.random.default_rng(7)
    frames = [draw(over_pixels(64, 3000.0, 31.2 + 0.02 * k, 32.7, sigma), 1.0, SENSOR, rng) for k in range(40)]
    sheet = "sensor: {bit_depth: 16, gain_dn_per_e: 0.3, read_noise_e: 4, black_level_dn: 50}\ncrop_px: 33\n"
    dataset = loaded(tmp_path, frames, sheet + KEY)
    assert dataset.instrument.optics.pixel_integration
    crops = crops_of(dataset)
    for integrated, truth in ((True, sigma), (False, np.hypot(sigma, 12**-0.5))):
        widths = select_preferred_fits(fit_crops(crops, SENSOR, integrated=integrated))["sigma_mean"].values.ravel()
        error = widths.std(ddof=1) / np.sqrt(widths.size)
        assert abs(widths.mean() - truth) < 4 * error + 2e-3 * truth, (integrated, widths.mean(), error)


def test_calibration_gives_the_law_of_the_light():
    """Five sites at four exposures: p1 and p2 by the joint likelihood within 1e-3 px beside four standard errors."""
    rng, times = np.random.default_rng(9), (1e-4, 2e-4, 4e-4, 8e-4)
    baseline = replace(INTEGRATED, photon_budget="linear", longest_s=8e-4)
    p1, p2, peak, frames, centres = 0.25, 3.4, 2500.0, [], []
    for site in range(5):
        centres.append(16 + rng.uniform(-0.5, 0.5, 2))
        for t in times:
            width = p1 * np.log(t) + p2
            bright = peak * (t / width**2) / (8e-4 / (p1 * np.log(8e-4) + p2) ** 2)
            pixels = draw(over_pixels(SIDE, bright, *centres[-1], width), t, SENSOR, rng).astype(float)
            frames.append(SiteFrame(site, t, 0, 0, lambda pixels=pixels: pixels))
    found = fit_baseline(frames, baseline, SENSOR, np.array([0.2, 3.0, 2000.0]), np.array(centres))
    assert found.has_converged
    assert (np.abs(found.value[:2] - (p1, p2)) < 4 * found.stderr[:2] + 1e-3).all()
    assert abs(found.value[2] - peak) < 4 * found.stderr[2] + 1e-3 * peak
    widths = fit_simulated_widths(baseline, WidthLaw(p1, p2, peak), np.array(times), SIDE)
    assert widths == pytest.approx(p1 * np.log(times) + p2, rel=2e-3)


def test_the_key_goes_with_no_top_hat(tmp_path):
    """The fit of a top hat knows no pixels; without the key light is sampled."""
    with pytest.raises(InputError, match=r"keys optics\.pixel_integration and model\.top_hat are both true"):
        load(folder(tmp_path / "a", ["frames/a.tif,spot,0,1e-3,0"], KEY + "model: {top_hat: true}"))
    found = load(folder(tmp_path / "b", ["frames/a.tif,spot,0,1e-3,0"], ""))
    assert build_baseline(found.instrument, found.exposures).pixel_integration is False
