"""Small frames of a beam that is no Gaussian, drawn by numpy alone, and the engine's start on them."""

import numpy as np

from spotcheck.discrepancy.nuisance.fit import Fitted, fit
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame, Model, Numbers
from spotcheck.model import light_shape
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import View
from spotcheck.model.effect import Context
from spotcheck.model.sensor import SensorModel

SIDE, GAIN, NOISE, BLACK, FULL = 72, 0.11, 6.0, 12.0, 1023
SENSOR = SensorModel(GAIN, NOISE, black_level_dn=BLACK, full_scale_dn=FULL)
EXPOSURES, WIDTHS, PEAKS = (1e-4, 3e-4, 9e-4), (5.6, 6.4, 7.2), (90.0, 260.0, 700.0)
CONTEXT = Context(6.4, 700.0, FULL, SIDE, EXPOSURES[0], NOISE, GAIN, 0.0, EXPOSURES[-1])
STEP, REACH, PENALTY = 0.3, 5.1, 1.0


def beam(u, v):
    """A Gaussian with three lobes, of peak 1: 4 % of the peak off a Gaussian."""
    r2 = u * u + v * v
    return np.exp(-r2 / 2) * (1 + 0.03 * (u**3 - 3 * u * v * v) * np.exp(-r2 / 8))


def drawn(seed: int, sites: int = 4, pedestal=0.0, clip=np.inf, read=NOISE):
    """Frames [frame, row, column], and of each exposure, peak, width and centre; `pedestal` [DN] of light, a `clip`
    [DN] of the signal with its noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    frames, known = [], []
    for _ in range(sites):
        x0, y0 = SIDE / 2 + rng.uniform(-1, 1, 2)
        for t, width, peak in zip(EXPOSURES, WIDTHS, PEAKS, strict=True):
            peak = peak * rng.uniform(0.95, 1.05)
            electrons = rng.poisson((peak * beam((x - x0) / width, (y - y0) / width) + pedestal) / GAIN)
            signal = np.minimum(GAIN * (electrons + read * rng.standard_normal(x.shape)), clip) + BLACK
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
    baseline = Baseline(0.0, "free", False, 9e-4, light_shape.empty(STEP, REACH))
    return frames, Model(baseline, SENSOR, (), numbers)


def designed(known: np.ndarray) -> Design:
    """The design of frames that `drawn` drew: each site at all exposures, all of one angle."""
    frames, each = len(known), len(EXPOSURES)
    which = np.arange(frames)
    return Design(which // each, which % each, np.zeros(frames), known[:, 0], np.linspace(0, 1, frames))


def fitted(seed: int, **kinds: float) -> tuple[list[Frame], Fitted, np.ndarray]:
    """Frames, the engine's fit of shape and numbers, and the truth of each frame."""
    images, known = drawn(seed, **kinds)
    frames, model = started(images, known)
    return frames, fit(frames, model, PENALTY, workers=1), known
