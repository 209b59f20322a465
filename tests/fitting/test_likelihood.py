"""The joint fit of p1, p2, peak and centres: returns what the frames were drawn from, within its errors."""

from dataclasses import replace

import numpy as np
import pytest

from spotcheck.fitting.likelihood import SiteFrame, fit_baseline
from spotcheck.model.baseline import Baseline
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import SENSOR, gaussian

EXPOSURES = (1e-4, 5e-4, 9e-4)
# Widths of 4.5 … 5.8 px, a peak below full scale.
TRUTH = np.array([0.6, 10.0, 700.0])
SIDE = 44


def model(budget="spot_area", top_hat=False, laser=0.4) -> Baseline:
    """A baseline with a laser of its own width."""
    return Baseline(laser, budget, top_hat, EXPOSURES[-1])


def light(own: Baseline, t: float, x: float, y: float) -> np.ndarray:
    """Light of the truth, written out: width p1 ln t + p2 + laser; peak by the budget; cut at exp(−1/4)."""
    p1, p2, peak = TRUTH
    spread, longest = (p1 * np.log(s) + p2 for s in (t, EXPOSURES[-1]))
    sigma, sigma_longest = spread + own.laser_px, longest + own.laser_px
    if own.photon_budget == "linear":
        peak = peak * (t / sigma**2) / (EXPOSURES[-1] / sigma_longest**2)
    else:
        peak = peak * (spread / sigma) ** 2 / (longest / sigma_longest) ** 2
    image = gaussian(SIDE, peak, x, y, sigma)
    return np.minimum(image, np.exp(-0.25) * peak) if own.top_hat else image


def drawn(own: Baseline, sensor, seed: int, sites: int = 4) -> tuple[list[SiteFrame], np.ndarray]:
    """Frames of several sites at every exposure, crops at places of their own, and the true centres on the sensor."""
    rng = np.random.default_rng(seed)
    frames, centres = [], []
    for site in range(sites):
        x, y = SIDE / 2 + rng.uniform(-2, 2, 2)
        centres.append((x + 100, y + 200))
        for k, t in enumerate(EXPOSURES):
            # The crop of every frame lies elsewhere; the spot stays where it is on the sensor.
            pixels = draw(light(own, t, x - k, y + k), t, sensor, rng).astype(float)
            frames.append(SiteFrame(site, t, 100 + k, 200 - k, lambda pixels=pixels: pixels))
    return frames, np.array(centres)


def fitted(own, sensor, seed, start=TRUTH * [0.8, 1.03, 0.95], **more):
    """Fit of drawn frames, started beside the truth, with the true centres as well."""
    frames, centres = drawn(own, sensor, seed, **more)
    return fit_baseline(frames, own, sensor, np.array(start), centres + 0.3), centres


@pytest.fixture(scope="module")
def pulls() -> np.ndarray:
    """(p1, p2, peak) − truth over their errors, in 24 sets of frames."""
    fits = [fitted(model("linear"), SENSOR, seed)[0] for seed in range(24)]
    assert all(f.has_converged for f in fits)
    return np.array([(f.value - TRUTH) / f.stderr for f in fits])


@pytest.mark.parametrize("k", range(3))
def test_pulls_have_mean_0_and_width_1(pulls, k):
    """Four standard errors of 24 pulls, 0.82 for the mean and 0.58 for the width: false alarm 6e-5 each."""
    assert abs(pulls[:, k].mean()) < 4 / np.sqrt(24)
    assert abs(pulls[:, k].std(ddof=1) - 1) < 4 / np.sqrt(48)


CASES = {
    "spot area": (model(), SENSOR),
    "linear": (model("linear"), SENSOR),
    "top hat": (model(top_hat=True), SENSOR),
    "no laser": (model(laser=0.0), SENSOR),
    "full well": (model(), replace(SENSOR, full_well_e=5500.0)),
    "converter's zero": (model(), replace(SENSOR, black_level_dn=0.0)),
    "quiet sensor": (model(), replace(SENSOR, read_noise_e=1.0)),
}


@pytest.mark.parametrize(("own", "sensor"), CASES.values(), ids=CASES)
def test_recovers_the_truth(own, sensor):
    """p1, p2, peak within 4 standard errors, centres within 0.05 px (their own error is below 0.01 px)."""
    fit, centres = fitted(own, sensor, 5)
    assert fit.has_converged
    assert (np.abs(fit.value - TRUTH) < 4 * fit.stderr).all()
    assert np.abs(fit.centres - centres).max() < 0.05


def test_errors_shrink_with_the_number_of_sites():
    """Four times the sites, half the error; 5 % for the random light of each set."""
    few, many = (fitted(model(), SENSOR, 1, sites=n)[0].stderr for n in (2, 8))
    np.testing.assert_allclose(few / many, 2.0, rtol=0.05)


def test_gaps_are_left_out():
    """A column of NaN in every frame costs little and shifts nothing."""
    frames, centres = drawn(model(), SENSOR, 2)

    def holed(pixels):
        out = pixels.copy()
        out[:, 20] = np.nan
        return out

    frames = [replace(f, read_pixels=lambda f=f: holed(f.read_pixels())) for f in frames]
    fit = fit_baseline(frames, model(), SENSOR, TRUTH, centres)
    assert fit.has_converged and (np.abs(fit.value - TRUTH) < 4 * fit.stderr).all()


STARTS = [(3.0, 40.0, 700.0), (-0.5, 6.0, 300.0), (0.0, 12.0, 5000.0), (0.6, 10.0, 20.0), (0.6, 10.0, 0.01)]


@pytest.mark.parametrize("start", [*STARTS, (2.0, 60.0, 100.0)])
def test_never_converged_away_from_the_maximum(start):
    """From far away it either finds the truth or says that it did not converge."""
    fit, _ = fitted(model("linear"), SENSOR, 3, start=start)
    if fit.has_converged:
        # 5 standard errors: false alarm 6e-7, were the data not fixed.
        assert (np.abs(fit.value - TRUTH) < 5 * fit.stderr).all()
