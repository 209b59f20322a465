"""Peaks of residual maps: periods of stripes and places of copies of the spot, from which effects may start.

Stripes, such as interference fringes, multiply the light by a wave. Copies, such as ghosts, are weak images of the spot
at a fixed displacement. `ResidualImages` has images [frame, row, column]: the `residual` [DN], its `weight`,
1/variance, and the light of the `spot` [DN].
"""

import numpy as np
from scipy import ndimage

from spotcheck.discrepancy.residuals import ResidualImages

# Most frames whose residuals are added up.
MOST_FRAMES = 32
# Light below this part of the brightest pixel of a frame counts as none.
FAINT_SHARE = 0.02
# Width [1/side of the crop] of the rings of equal wave number whose median power is the background.
RING_WIDTH = 3
# Longest wave [σ]: longer ones look like the spot itself; and largest wave number [1/px], just below the Nyquist limit.
LONGEST_WAVE, LARGEST_NUMBER = 1.6, 0.48
# Distances of copies: nearer ones look like the spot itself [σ], farther ones leave the crop [side of the crop].
NEAREST_COPY, FARTHEST_COPY = 1.3, 0.48
# Most stripes and copies, and the sides of the windows in which a peak is the highest [bins of wave number, px].
WAVES, COPIES = 2, 3
WAVE_WINDOW, COPY_WINDOW = 5, 9


def find_peaks(
    images: ResidualImages,
) -> tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]:
    """Return stripes (period [px], direction [deg]) and copies (dx, dy [px]), each the strongest first.

    Stripes are peaks of the power spectrum of the relative residuals. Copies are peaks of the score test of a copy of
    the spot, by its displacement. Neither is tested for significance: they are starting points only.
    """
    frames, rows, columns = images.residual.shape
    power = np.zeros((rows, columns // 2 + 1))
    score, information = np.zeros((rows, columns)), np.zeros((rows, columns))
    for frame in np.linspace(0, frames - 1, min(MOST_FRAMES, frames)).astype(int):
        residual, weight = images.residual[frame].astype(float), images.weight[frame].astype(float)
        spot = images.spot[frame].astype(float)
        spot[spot < FAINT_SHARE * spot.max()] = 0.0
        window = spot * weight
        noise = np.sum(window**2 / np.maximum(weight, 1e-300))
        power += np.abs(np.fft.rfft2(residual * window)) ** 2 / noise
        score += _correlate(residual * weight, spot)
        information += _correlate(weight, spot**2)
    sigma = float(np.exp(np.median(images.spots.log_sigma)))
    return _find_waves(power, columns, sigma), _find_copies(score, information, sigma)


def _correlate(image: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Return the cyclic correlation [row, column] of an image with a pattern, by the displacement of the pattern."""
    return np.fft.irfft2(np.fft.rfft2(image) * np.conj(np.fft.rfft2(pattern)), image.shape)


def _find_waves(power: np.ndarray, columns: int, sigma: float) -> tuple[tuple[float, float], ...]:
    """Return period [px] and direction [deg] of the strongest waves in a power spectrum.

    `power` [row, column] is as by `rfft2` of crops with `columns` columns; `sigma` is the width of the spot [px].
    """
    rows = len(power)
    ky, kx = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :]
    wave_number = np.hypot(kx, ky)
    # A peak must stand out of the power at the same wave number: misfit of the spot has power in all directions.
    ring = np.floor(wave_number * min(rows, columns) / RING_WIDTH).astype(int)
    background = ndimage.median(power, ring, np.arange(ring.max() + 1))[ring]
    is_allowed = (wave_number > 1 / (LONGEST_WAVE * sigma)) & (wave_number < LARGEST_NUMBER)
    ratio = np.where(is_allowed, power / np.maximum(background, 1e-300), 0.0)
    is_peak = (ratio == ndimage.maximum_filter(ratio, WAVE_WINDOW)) & (ratio > 0)
    waves = []
    for position in np.argsort(-np.where(is_peak, ratio, 0.0).ravel())[:WAVES]:
        i, j = (int(k) for k in np.unravel_index(position, ratio.shape))
        last = ratio.shape[1] - 1
        # Neighbours along y are cyclic; along x the spectrum of a real image ends at wave numbers 0 and 1/2.
        x = kx[0, j] + _find_vertex(power[i, max(j - 1, 0)], power[i, j], power[i, min(j + 1, last)]) / columns
        y = ky[i, 0] + _find_vertex(power[(i - 1) % rows, j], power[i, j], power[(i + 1) % rows, j]) / rows
        waves.append((float(1 / np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)))))
    return tuple(waves)


def _find_vertex(before: float, middle: float, after: float) -> float:
    """Return the position [bins] of the maximum of the parabola through three neighbours, from the middle one.

    It is limited to half a bin, and 0 if the parabola has no maximum.
    """
    curvature = before - 2 * middle + after
    return float(np.clip((before - after) / (2 * curvature), -0.5, 0.5)) if curvature < 0 else 0.0


def _find_copies(score: np.ndarray, information: np.ndarray, sigma: float) -> tuple[tuple[float, float], ...]:
    """Return displacements (dx, dy) [px] of the strongest copies; `sigma` is the width of the spot [px].

    `score` and `information` [row, column] of a copy's brightness are by displacement, which is cyclic.
    """
    rows, columns = score.shape
    z = np.fft.fftshift(score / np.sqrt(np.maximum(information, 1e-12 * information.max() + 1e-300)))
    dy, dx = np.mgrid[:rows, :columns] - np.array([rows // 2, columns // 2])[:, None, None]
    distance = np.hypot(dx, dy)
    is_allowed = (distance > NEAREST_COPY * sigma) & (distance < FARTHEST_COPY * min(rows, columns))
    z = np.where(is_allowed, z, -np.inf)
    peaks = np.where(z == ndimage.maximum_filter(z, COPY_WINDOW), z, -np.inf).ravel()
    highest = [position for position in np.argsort(-peaks)[:COPIES] if np.isfinite(peaks[position])]
    return tuple((float(dx.ravel()[position]), float(dy.ravel()[position])) for position in highest)
