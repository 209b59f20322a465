"""Peaks of residual maps: periods of stripes and places of copies of the spot, from which effects may start."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.residuals import ResidualImages

# Most frames whose residuals are added up.
MOST_FRAMES = 32
# Light below this part of the brightest one of a frame counts as none.
FAINT_SHARE = 0.02
# Width [1/frame] of the rings of equal wave number whose median power is the background.
RING_WIDTH = 3
# Longest wave [σ]: longer ones look like the spot itself; largest wave number [1/px].
LONGEST_WAVE, LARGEST_NUMBER = 1.6, 0.48
# Distances of copies: nearer ones look like the spot itself [σ], farther ones leave the frame [frame].
NEAREST_COPY, FARTHEST_COPY = 1.3, 0.48
# Numbers of peaks, and the windows within which a peak is the highest [bins, px].
WAVES, COPIES = 2, 3
WAVE_WINDOW, COPY_WINDOW = 5, 9


def find_peaks(
    images: ResidualImages,
) -> tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]:
    """Return stripes (period [px], direction [deg]) and copies (dx, dy [px]), the strongest first."""
    frames, rows, columns = images.residual.shape
    chosen = np.linspace(0, frames - 1, min(MOST_FRAMES, frames)).astype(int)
    power = np.zeros((rows, columns // 2 + 1))
    score, information = np.zeros((rows, columns)), np.zeros((rows, columns))
    for f in chosen:
        residual, weight = images.residual[f].astype(float), images.weight[f].astype(float)
        spot = images.spot[f].astype(float)
        spot[spot < FAINT_SHARE * spot.max()] = 0.0
        window = spot * weight
        noise = np.sum(window**2 / np.maximum(weight, 1e-300))
        power += np.abs(np.fft.rfft2(residual * window)) ** 2 / noise
        score += _correlate(residual * weight, spot)
        information += _correlate(weight, spot**2)
    sigma = float(np.exp(np.median(images.spots.log_sigma)))
    return _find_waves(power, columns, sigma), _find_copies(score, information, sigma)


def _correlate(image: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Return the cyclic correlation of an image with a pattern by the displacement of the pattern."""
    return np.fft.irfft2(np.fft.rfft2(image) * np.conj(np.fft.rfft2(pattern)), image.shape)


def _find_waves(power: np.ndarray, columns: int, sigma: float) -> tuple[tuple[float, float], ...]:
    rows = len(power)
    ky, kx = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :]
    number = np.hypot(kx, ky)
    ring = np.floor(number * min(rows, columns) / RING_WIDTH).astype(int)
    background = ndimage.median(power, ring, np.arange(ring.max() + 1))[ring]
    is_allowed = (number > 1 / (LONGEST_WAVE * sigma)) & (number < LARGEST_NUMBER)
    ratio = np.where(is_allowed, power / np.maximum(background, 1e-300), 0.0)
    is_peak = (ratio == ndimage.maximum_filter(ratio, WAVE_WINDOW)) & (ratio > 0)
    waves = []
    for flat in np.argsort(-np.where(is_peak, ratio, 0.0).ravel())[:WAVES]:
        i, j = (int(k) for k in np.unravel_index(flat, ratio.shape))
        last = ratio.shape[1] - 1
        x = kx[0, j] + _vertex(power[i, max(j - 1, 0)], power[i, j], power[i, min(j + 1, last)]) / columns
        y = ky[i, 0] + _vertex(power[(i - 1) % rows, j], power[i, j], power[(i + 1) % rows, j]) / rows
        waves.append((float(1 / np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)))))
    return tuple(waves)


def _vertex(before: float, here: float, after: float) -> float:
    """Return the place of the vertex of a parabola through three neighbours, within half a bin of the middle."""
    curvature = before - 2 * here + after
    return float(np.clip((before - after) / (2 * curvature), -0.5, 0.5)) if curvature < 0 else 0.0


def _find_copies(score: np.ndarray, information: np.ndarray, sigma: float) -> tuple[tuple[float, float], ...]:
    rows, columns = score.shape
    z = np.fft.fftshift(score / np.sqrt(np.maximum(information, 1e-12 * information.max() + 1e-300)))
    dy, dx = np.mgrid[:rows, :columns] - np.array([rows // 2, columns // 2])[:, None, None]
    distance = np.hypot(dx, dy)
    is_allowed = (distance > NEAREST_COPY * sigma) & (distance < FARTHEST_COPY * min(rows, columns))
    z = np.where(is_allowed, z, -np.inf)
    peaks = np.where(z == ndimage.maximum_filter(z, COPY_WINDOW), z, -np.inf).ravel()
    highest: Sequence[int] = [flat for flat in np.argsort(-peaks)[:COPIES] if np.isfinite(peaks[flat])]
    return tuple((float(dx.ravel()[flat]), float(dy.ravel()[flat])) for flat in highest)
