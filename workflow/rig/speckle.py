"""Speckle: light of random phase through the lens's pupil, as it falls on the chip."""

from __future__ import annotations

import numpy as np
from scipy import fft

from rig.settings import Settings


def pupil_cutoff_per_px(settings: Settings) -> float:
    """Highest spatial frequency of the *field* on the chip [cycles/px]: 1/(2 λ (1+M) f_a) for a round pupil."""
    optics = settings.optics
    magnification = optics.focal_length_m / optics.working_distance_m
    image_f_number = (1.0 + magnification) * optics.f_number
    return settings.sensor.pixel_pitch_m / (2.0 * settings.laser.wavelength_m * image_f_number)


def grain_px(settings: Settings) -> float:
    """Mean grain after Eq. 3, 1.2 (1+M) λ f_a, in pixels."""
    return 0.6 / pupil_cutoff_per_px(settings)


def pattern(shape: tuple[int, int], cutoff_per_sample: float, patterns: int, rng: np.random.Generator) -> np.ndarray:
    """Intensity of `patterns` independent speckle fields added, mean 1, sampled at points (float32).

    The rough surface gives every point the same strength and a phase of its own; the pupil passes the frequencies
    below its cutoff (`cutoff_per_sample`, cycles a sample). Contrast 1/√patterns; the field is periodic.
    """
    fy = fft.fftfreq(shape[0])[:, None]
    fx = fft.fftfreq(shape[1])[None, :]
    pupil = (fx**2 + fy**2) < cutoff_per_sample**2
    # Each field keeps this part of the surface's light; dividing by it leaves the mean over all surfaces at 1.
    passed = np.count_nonzero(pupil) / pupil.size
    total = np.zeros(shape, dtype=np.float32)
    for _ in range(patterns):
        phase = rng.random(shape, dtype=np.float32) * np.float32(2.0 * np.pi)
        field = fft.ifft2(fft.fft2(np.exp(1j * phase, dtype=np.complex64)) * pupil)
        total += field.real**2 + field.imag**2
    return total / np.float32(passed * patterns)


def field_on_pixels(settings: Settings, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Relative irradiance on the pixels of a window, mean 1: the pattern averaged over each pixel's area.

    Averaging over the light-sensitive area (fill factor 1) lowers the contrast a little below 1/√patterns. A field of
    `field_px`² is made and repeated: it must be wider than the spot, so that no pixel that light reaches repeats.
    """
    n, side = settings.speckle.oversampling, settings.speckle.field_px
    if settings.speckle.patterns == 0:
        return np.ones(shape)
    fine = pattern((side * n, side * n), pupil_cutoff_per_px(settings) / n, settings.speckle.patterns, rng)
    coarse = fine.reshape(side, n, side, n).mean(axis=(1, 3)).astype(float)
    repeats = (-(-shape[0] // side), -(-shape[1] // side))
    return np.tile(coarse, repeats)[: shape[0], : shape[1]]
