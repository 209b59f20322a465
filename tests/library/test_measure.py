"""What a frame says of its own spot about any expectation, and dark pixels that a camera's rounding keeps silent."""

import numpy as np
import pytest
from scipy.stats import norm, poisson

from spotcheck.discrepancy.measure import about_scene
from spotcheck.discrepancy.pixels import AWAKE, CERTAIN, Scene, awake
from spotcheck.model.spot import TOP_HAT_LEVEL

SIDE = 64
# Amplitude [DN], centre [px], curvatures [px⁻²], offset [DN].
THETA = np.array([40.0, 30.3, 33.1, 9.0**-2, 0.0, 9.0**-2, 0.0])
# A camera that rounds its noise away: K σ = 0.14 DN.
GAIN, READ = 0.09, 1.6


def light_of(theta: np.ndarray, cut: float) -> np.ndarray:
    """Light [DN] of a spot [row, column], its profile cut at `cut`."""
    amplitude, x0, y0, a, b, c, offset = theta
    dy, dx = np.mgrid[:SIDE, :SIDE] - np.array([y0, x0])[:, None, None]
    return amplitude * np.minimum(np.exp(-(a * dx**2 + 2 * b * dx * dy + c * dy**2) / 2), cut) + offset


def slopes_of(cut: float) -> np.ndarray:
    """Slopes of the light [7, row, column] by central differences of a whole spot; on the plateau only brightness and
    offset move it."""
    out = []
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-5 * max(abs(THETA[k]), 1e-3)
        out.append((light_of(THETA + step, 2.0) - light_of(THETA - step, 2.0)) / (2 * step[k]))
    slopes = np.array(out)
    flat = slopes[0] > cut
    slopes[1:6, flat] = 0.0
    slopes[0, flat] = cut
    return slopes


@pytest.mark.parametrize("top_hat", [False, True])
def test_score_and_information_by_central_differences(top_hat):
    """Σ s ρ r/v and Σ s sᵀ ρ²/v of slopes s, with gaps and certain pixels left out; central differences are good to
    1e-6."""
    rng = np.random.default_rng(1)
    slopes = slopes_of(TOP_HAT_LEVEL if top_hat else 2.0)
    mean, variance, follows = (rng.uniform(*ends, (SIDE, SIDE)) for ends in ((0, 50), (0.05, 3), (0.2, 1)))
    image = mean + rng.normal(size=mean.shape)
    image[rng.random(image.shape) < 0.02] = np.nan
    own = np.isfinite(image) & (variance >= CERTAIN)
    by_light = (slopes * follows)[:, own]
    score, information = about_scene(image, Scene(mean, variance, mean, mean), follows, THETA, top_hat)
    assert score == pytest.approx(by_light @ ((image - mean) / variance)[own], rel=1e-5, abs=1e-4)
    want = by_light / variance[own] @ by_light.T
    scale = np.sqrt(np.outer(want.diagonal(), want.diagonal()))
    assert information / scale == pytest.approx(want / scale, abs=1e-6)


def law_of_a_reading(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [DN] and variance [DN²] of a rounded reading under a light [DN], black at 0, summed over electrons."""
    levels = np.linspace(0, light.max() + 1, 600)
    electrons = np.arange(int(levels[-1] / GAIN + 10 * np.sqrt(levels[-1] / GAIN) + 10))
    codes = np.arange(int(GAIN * electrons[-1]) + 6)
    above = norm.sf(codes[1:] - 0.5, GAIN * electrons[:, None], GAIN * READ)
    first, second = above.sum(axis=1), (above * (2 * codes[1:] - 1)).sum(axis=1)
    chance = poisson.pmf(electrons, levels[:, None] / GAIN)
    mean, square = chance @ first, chance @ second
    return np.interp(light, levels, mean), np.interp(light, levels, square - mean**2)


def test_a_halo_that_the_model_has_is_no_frames_pedestal():
    """400 frames of spot and halo, rounded with 0.14 DN of noise: every score over its error has mean 0 and variance 1,
    each within 4.5 standard errors: a false alarm in 10,000 for the fourteen numbers."""
    rng = np.random.default_rng(2)
    halo = light_of(np.array([2.0, 30.3, 33.1, 24.0**-2, 0.0, 24.0**-2, 0.0]), 2.0)
    light = light_of(THETA, 2.0) + halo
    mean, variance = law_of_a_reading(light)
    nudged = law_of_a_reading(light + 1e-2)[0]
    follows = (nudged - mean) / 1e-2
    z = []
    for _ in range(400):
        electrons = rng.poisson(light / GAIN) + READ * rng.normal(size=light.shape)
        image = np.maximum(np.rint(GAIN * electrons), 0.0)
        score, information = about_scene(image, Scene(mean, variance, light, light), follows, THETA, False)
        z.append(score / np.sqrt(information.diagonal()))
    z = np.array(z)
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(400)
    assert np.abs(z.var(axis=0) - 1).max() < 4.5 * np.sqrt(2 / 400)


def dark_scene(variance: float = 0.01) -> Scene:
    """Nothing but pixels that read 0 every time."""
    zero = np.zeros((32, 32))
    return Scene(zero, np.full((32, 32), variance), zero, zero)


def test_what_repeats_its_number_stays_silent():
    """As it is, and with every twelfth pixel one code higher (as a variance near `CERTAIN` brings about)."""
    image = np.zeros((32, 32))
    assert awake(image, dark_scene(), 1.0, 8).variance.max() < CERTAIN
    image.flat[::12] = 1.0
    assert awake(image, dark_scene(), 1.0, 8).variance.max() < CERTAIN


def test_dark_pixels_that_all_read_more_are_heard():
    """A block of 64 px speaks from 8 √(0.12 · 64) = 22.2 DN in all, and the others stay silent; so does a pixel with
    light, and one that is missing says nothing."""
    image = np.zeros((32, 32))
    image[8:16, 8:16] = 1.0
    image[0, 0] = AWAKE * np.sqrt(64 * CERTAIN) - 0.1
    image[10, 10] = np.nan
    scene = dark_scene()
    light = scene.light.copy()
    light[11, 11] = 5.0
    heard = awake(image, scene._replace(light=light), 1.0, 8).variance >= CERTAIN
    want = np.zeros((32, 32), bool)
    want[8:16, 8:16] = True
    want[10, 10] = want[11, 11] = False
    assert (heard == want).all()
    image[0, 0] += 0.2
    assert (awake(image, scene, 1.0, 8).variance[:8, :8] == CERTAIN).all()


def test_lit_pixels_that_scatter_are_heard():
    """Where a model stops noise at a level: a block of 64 px speaks from a sum of squares of 4 · 0.12 · (64 + 8) = 34.6
    DN² on, though its mean is right; every sixth pixel one code lower, as a variance near `CERTAIN` brings, stays
    silent, and so do the other blocks."""
    scene = dark_scene()._replace(light=np.full((32, 32), 90.0), mean=np.full((32, 32), 100.0))
    image = np.full((32, 32), 100.0)
    image.flat[::6] = 99.0
    assert awake(image, scene, 1.0, 8).variance.max() < CERTAIN
    image[8:16, 8:16] = 100 + np.resize([1.0, -1.0], (8, 8))
    heard = awake(image, scene, 1.0, 8).variance >= CERTAIN
    assert heard[8:16, 8:16].all() and heard.sum() == 64


def test_pixels_beyond_the_last_block_stay_silent():
    """Blocks of 8 px leave two rows and columns of 34."""
    scene = Scene(*(np.pad(own, (0, 2), mode="edge") for own in dark_scene()))
    heard = awake(np.full((34, 34), 3.0), scene, 1.0, 8).variance >= CERTAIN
    assert heard[:32, :32].all()
    assert not heard[32:].any()
    assert not heard[:, 32:].any()
