"""Small frames of a beam that is no Gaussian, drawn by numpy alone, and the engine's start on them."""

import numpy as np
from scipy import stats

from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Context
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Lights, Model, Numbers

SIDE, GAIN, NOISE, BLACK, FULL = 72, 0.11, 6.0, 12.0, 1023
SENSOR = SensorModel(GAIN, NOISE, black_level_dn=BLACK, full_scale_dn=FULL)
EXPOSURES, WIDTHS, PEAKS = (1e-4, 3e-4, 9e-4), (5.6, 6.4, 7.2), (90.0, 260.0, 700.0)
CONTEXT = Context(6.4, 700.0, FULL, SIDE, EXPOSURES[0], NOISE, GAIN, 0.0, EXPOSURES[-1])
STEP, REACH, PENALTY = 0.3, 5.1, 1.0


def beam(u, v):
    """A Gaussian with three lobes, of peak 1: 4 % of the peak off a Gaussian."""
    r2 = u * u + v * v
    return np.exp(-r2 / 2) * (1 + 0.03 * (u**3 - 3 * u * v * v) * np.exp(-r2 / 8))


def gaussian(u, v):
    """The declared beam, of peak 1."""
    return np.exp(-(u * u + v * v) / 2)


def field(rng: np.random.Generator, grain: float) -> np.ndarray:
    """A normal field [row, column] of mean 0 and variance 1, which correlates as exp(−d²/2 grain²)."""
    ky, kx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None, :]
    # Noise smoothed with s correlates as exp(−d²/4 s²).
    kernel = np.exp(-((np.pi * grain) ** 2) * (kx * kx + ky * ky))
    smooth = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * kernel).real
    return smooth / np.sqrt(np.mean(kernel**2))


def waves(x, y, stripes, turn: float) -> np.ndarray:
    """Factor [row, column] of stripes (depth, period [px], direction [deg]) at places, their phase `turn` [rad]."""
    depth, period, direction = stripes
    angle = np.deg2rad(direction)
    return 1 + depth * np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period + turn)


def drawn(
    seed: int, sites: int = 4, pedestal=0.0, clip=np.inf, read=NOISE, shape=beam, speckle=(0.0, 1.0), prnu=0.0,
    rows=0.0, stripes=(0.0, 9.0, 30.0), stay="sensor", spread=1.0, uneven=0.0, skewed=False,
):  # fmt: skip
    """Frames [frame, row, column], and of each exposure, peak, width and centre (up to `spread` px from the middle).

    `pedestal` [DN] of light, a `clip` [DN] of the signal with its noise, the light's `shape` (u, v [σ]); `speckle`, a
    field of each site (contrast, grain [px]), `skewed` by the gamma law of summed speckle patterns or else normal;
    levels of the clip that differ by `uneven` parts from pixel to pixel; `prnu` of the sensor's pixels; offsets of rows
    [DN rms] anew in each frame; `stripes` (depth, period [px], direction [deg]) that stay on the "sensor", with the
    "spot", or have a phase of their own at each "site".
    """
    rng, others = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    frames, known = [], []
    gains = 1 + prnu * others.standard_normal(x.shape)
    levels = clip * (1 + uneven * others.standard_normal(x.shape)) if uneven else clip
    for _ in range(sites):
        x0, y0 = SIDE / 2 + spread * rng.uniform(-1, 1, 2)
        grains = speckle[0] * field(others, speckle[1]) if speckle[0] else np.zeros(x.shape)
        if skewed:
            grains = stats.gamma.ppf(stats.norm.cdf(grains / speckle[0]), speckle[0] ** -2.0) * speckle[0] ** 2 - 1
        factor = gains * (1 + grains)
        turn = others.uniform(0, 2 * np.pi) if stay == "site" else 1.0
        off = (x0, y0) if stay == "spot" else (0.0, 0.0)
        factor = factor * waves(x - off[0], y - off[1], stripes, turn)
        for t, width, peak in zip(EXPOSURES, WIDTHS, PEAKS, strict=True):
            peak = peak * rng.uniform(0.95, 1.05)
            light = peak * shape((x - x0) / width, (y - y0) / width) * factor
            electrons = rng.poisson((np.maximum(light, 0.0) + pedestal) / GAIN)
            signal = np.minimum(GAIN * (electrons + read * rng.standard_normal(x.shape)), levels) + BLACK
            signal = signal + rows * others.standard_normal((SIDE, 1))
            frames.append(np.clip(np.rint(signal), 0, FULL))
            known.append((t, peak, width, x0, y0))
    return np.array(frames), np.array(known)


def started(images: np.ndarray, known: np.ndarray) -> tuple[list[Frame], Model]:
    """Frames as the engine takes them, and a model without a learned shape, near the truth as a spot fit leaves it."""
    one = np.ones((1, 1, 1))
    x, y = np.arange(float(SIDE))[None, None, :], np.arange(float(SIDE))[None, :, None]
    frames = [
        Frame(image, View(x, y, one, one, t * one, one, one, 0 * one, 0 * one, 9e-4, 9e-4, 0.0, 0.0, SIDE, 1.0))
        for image, t in zip(images, known[:, 0], strict=True)
    ]
    rng = np.random.default_rng(5)
    off = 1 + 0.01 * rng.standard_normal((2, len(known)))
    numbers = Numbers(
        np.log(known[:, 1] * off[0]), np.log(known[:, 2] * off[1]), known[:, 3] + 0.05, known[:, 4] - 0.05
    )
    baseline = Baseline(0.0, "free", False, 9e-4)
    return frames, Model(
        baseline, SENSOR, (), numbers, lights=Lights.common(light_shape.empty(STEP, REACH), len(frames))
    )


def designed(known: np.ndarray) -> Design:
    """The design of frames that `drawn` drew: each site at all exposures, all of one angle."""
    frames, each = len(known), len(EXPOSURES)
    which = np.arange(frames)
    angle = np.zeros(frames)
    return Design(which // each, which % each, angle, known[:, 0], np.linspace(0, 1, frames), angle.astype(str))


def fitted(seed: int, **kinds: float) -> tuple[list[Frame], Fitted, np.ndarray]:
    """Frames, the engine's fit of shape and numbers, and the truth of each frame."""
    images, known = drawn(seed, **kinds)
    frames, model = started(images, known)
    return frames, fit(frames, model, PENALTY), known
