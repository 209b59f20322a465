"""Random fields on the sensor: speckle in two kinds, and smooth Gaussian fields."""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy import fft

from rig.hidden.designs import FRAME_PX

_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@functools.lru_cache(maxsize=48)
def speckle(seed: int, site: int, grain_px: float, patterns: int) -> np.ndarray:
    """A pattern of mean 0 and variance 1 for one site; its autocovariance has the full width `grain_px` at half height.

    `patterns` ≥ 1: that many independent intensities |E|^2 of a smoothed complex Gaussian field, averaged. 0: a
    Gaussian field with the same autocovariance.
    """
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(site,))))
    scale = grain_px / _FWHM  # autocovariance exp(-r^2 / (2 scale^2))
    if patterns == 0:
        return smooth_normal(rng, scale / math.sqrt(2.0))
    total = np.zeros((FRAME_PX, FRAME_PX), dtype=np.float32)
    for _ in range(patterns):
        # |E|^2 of a field with autocorrelation exp(-r^2 / (4 scale^2)) has its square.
        total += smooth_normal(rng, scale) ** 2 + smooth_normal(rng, scale) ** 2
    return math.sqrt(patterns) * (total / (2.0 * patterns) - 1.0)


def smooth_normal(rng: np.random.Generator, scale_px: float) -> np.ndarray:
    """Normal noise smoothed with a Gaussian of rms `scale_px`, mean 0 and variance 1; it wraps round at the edges."""
    white = rng.standard_normal((FRAME_PX, FRAME_PX), dtype=np.float32)
    transfer = _transfer_function(scale_px)
    return fft.irfft2(fft.rfft2(white) * transfer, s=white.shape)


@functools.lru_cache(maxsize=8)
def _transfer_function(scale_px: float) -> np.ndarray:
    """Fourier transform of the Gaussian, scaled so that white noise keeps its variance."""
    fy, fx = fft.fftfreq(FRAME_PX), fft.rfftfreq(FRAME_PX)
    transfer = np.exp(-2.0 * (math.pi * scale_px) ** 2 * (fy[:, None] ** 2 + fx[None, :] ** 2))
    along = np.exp(-4.0 * (math.pi * scale_px * fy) ** 2).mean()  # mean square along one whole axis
    return (transfer / along).astype(np.float32)
