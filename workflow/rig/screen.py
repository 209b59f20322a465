"""A quick forecast of a trial, to screen many settings: the mean image of each site, without any noise.

A mean image is a Gaussian through the mean response of clipped speckle; what is measured on it follows, but for
scale, from one number, the peak over the clip level. So a table over that number forecasts a whole grid.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy import special

from rig import exposure, material, measure, papersim, photons, speckle
from rig.plan import Site
from rig.settings import Settings

_SIGMA_PX = 10.0
_RATIOS = np.geomspace(0.05, 150.0, 60)
# A Gaussian fitted to the top hat is wider than the Gaussian under it.
_TOP_HAT_WIDENS = 1.043
# Noise lifts the maximum of a simulated plateau by about this much; half-cut read noise adds up over a crop.
_NOISE_ABOVE_PLATEAU_DN = 25.0
_DARK_DN = 0.6
# Of the pixels above half the maximum, about this part clips.
_CLIPPED_PART = 0.6
_DARK_SUM_DN = _DARK_DN * measure.CROP_PX**2


def forecast(settings: Settings, sites: list[Site]) -> float:
    """Summed distance of the forecast statistics from the published ranges; smaller is better."""
    widths, amplitudes, contrasts, sums = _tables(settings, sites)
    laser = papersim.laser_sigma_px(settings)
    logs = np.log([0.0001, 0.0005, 0.0009])
    p1, p2 = np.polyfit(logs, widths.mean(axis=(0, 2)) - laser, 1)
    simulated = _TOP_HAT_WIDENS * (p1 * logs + p2 + laser)
    # The simulated peak's fall against the two longer exposures, and where a measured maximum will lie.
    peaks = ((p1 * logs + p2) / (p1 * logs + p2 + laser)) ** 2
    fall = 1.0 - peaks / peaks[1:].mean()
    plateau = _expected_maximum(settings)
    w, a, c = widths.mean(axis=2), amplitudes.mean(axis=2), contrasts.mean(axis=2)
    w_sd, a_sd, c_sd = (table.std(axis=2, ddof=1) for table in (widths, amplitudes, contrasts))
    top = (plateau - _NOISE_ABOVE_PLATEAU_DN) * (1.0 - fall) / papersim.TOP_HAT
    # The top hat keeps exp(-1/4) (1 + 1/4) of the Gaussian's volume.
    simulated_sums = 2.5 * math.pi * papersim.TOP_HAT * top * (p1 * logs + p2 + laser) ** 2 + _DARK_SUM_DN
    sums_off = np.abs(simulated_sums - sums.mean(axis=2)) / sums.std(axis=2, ddof=1)
    rows = (
        (float(np.sort(sums_off, axis=None)[-2]), 0.0, 0.9, 1.0),
        (p1, 2.2, 2.75, 0.5),
        (p2, 33.5, 35.6, 2.0),
        (c.max(), 7.1, 11.0, 2.0),
        (c_sd.min(), 0.0, 1.0, 1.0),
        (c_sd.max(), 1.15, 2.4, 1.0),
        (c_sd[:, 0].mean() / c_sd[:, 1:].mean(), 1.58, 2.6, 0.3),
        (a[:, 0].min(), 800.0, 878.0, 80.0),
        (a[:, 0].max(), 885.0, 955.0, 80.0),
        (a[:, 1:].min(), 960.0, 1022.0, 70.0),
        (a[:, 1:].max(), 1030.0, 1094.0, 70.0),
        (a_sd[:, 0].max(), 118.0, 220.0, 100.0),
        (a_sd[:, 1:].max(), 0.0, 48.0, 50.0),
        (w_sd.min(), 0.0, 2.3, 3.0),
        (w_sd.max(), 2.6, 5.2, 3.0),
        (np.abs(w[:3] - simulated).max(), 0.0, 1.9, 1.0),
        (simulated[0] - w[3, 0], 2.4, 4.3, 1.0),
        (plateau * fall[0], 22.0, 41.0, 20.0),
        (plateau * 0.5 * (fall[1] - fall[2]), 0.0, 5.5, 5.0),
        (plateau, 804.0, 830.0, 10.0),
        (_expected_peak_share(settings), 0.028, 0.033, 0.02),
        ((w[2] - w[1]).min(), 0.1, 99.0, 1.0),
        ((w[2] - w[3]).min(), 0.1, 99.0, 1.0),
    )
    misses = [max(low - value, value - high, 0.0) / scale for value, low, high, scale in rows]
    return float(sum(misses)) + 0.3 * sum(miss > 0.0 for miss in misses)


def _expected_maximum(settings: Settings) -> float:
    """Maximum of a frame that clips [DN]: the best of some hundred pixels, in a row of the regular stripes."""
    sensor = settings.sensor
    assert sensor.clip_level_e is not None
    best = sensor.clip_screen_sigma * sensor.clip_pixel_scatter * 0.95 + sensor.clip_row_scatter + sensor.clip_row_step
    return sensor.clip_level_e * sensor.gain_dn_per_e * (1.0 + best)


def _expected_peak_share(settings: Settings) -> float:
    """Part of the plateau's pixels within 2 % of the maximum: some of those in the rows of the regular stripes."""
    sensor = settings.sensor
    cut, screen = 0.02 / max(sensor.clip_pixel_scatter, 1e-6), sensor.clip_screen_sigma
    tail = special.ndtr(cut - screen) - special.ndtr(-screen)
    return _CLIPPED_PART * tail / (1.0 - 2.0 * special.ndtr(-screen)) / sensor.clip_row_period_px


def _tables(settings: Settings, sites: list[Site]) -> np.ndarray:
    """Width [px], amplitude [DN], contrast and sum [DN] of each frame, [quantity, angle, exposure, repeat]."""
    sensor = settings.sensor
    assert sensor.clip_level_e is not None
    level = sensor.clip_level_e * (1.0 + sensor.clip_row_step / sensor.clip_row_period_px)
    k, quantum = settings.sensor.gain_dn_per_e, settings.sensor.quantum_efficiency
    table = _response_table(_effective_patterns(settings.speckle.patterns))
    angles = sorted({site.shots[0].angle_deg or 0.0 for site in sites})
    exposures = sorted({shot.exposure_s or 0.0 for shot in sites[0].shots})
    out = np.empty((4, len(angles), len(exposures), len(sites) // len(angles)))
    filled = dict.fromkeys(angles, 0)
    per_second = photons.reflected_photons(settings, 1.0) * quantum / level
    for site in sites:
        rng = exposure.generator(settings, exposure.SITE, site.index, 0)
        spot = material.illuminate(settings, site, rng)
        long, short = spot.sigmas_px
        ratio = per_second * spot.relative_light / (2.0 * math.pi * long * short) * np.array(exposures)
        looked_up = [np.interp(np.log(ratio), np.log(_RATIOS), column) for column in table.T]
        i, j = angles.index(spot.angle_deg), filled[spot.angle_deg]
        filled[spot.angle_deg] += 1
        out[0, i, :, j] = looked_up[0] * 0.5 * (long + short)
        out[1, i, :, j] = looked_up[1] * level * k
        out[2, i, :, j] = looked_up[2] / math.sqrt(long * short)
        out[3, i, :, j] = looked_up[3] * level * k * long * short + _DARK_SUM_DN
    return out


@functools.cache
def _effective_patterns(patterns: int) -> float:
    """Patterns that would give the contrast left after averaging over the pixels."""
    settings = Settings()
    field = speckle.pattern((512, 512), speckle.pupil_cutoff_per_px(settings) / 2.0, 1, np.random.default_rng(1))
    return patterns / float(field.reshape(256, 2, 256, 2).mean(axis=(1, 3)).var())


@functools.cache
def _response_table(n: float) -> np.ndarray:
    """Columns over `_RATIOS`: width over σ, amplitude over the level, contrast times σ [px], sum over level and σ²."""
    axis = np.arange(measure.CROP_PX) - measure.CROP_PX / 2.0
    shape = np.exp(-0.5 * (axis**2 + axis[:, None] ** 2) / _SIGMA_PX**2)
    rows = []
    for ratio in _RATIOS:
        light = np.maximum(ratio * shape, 1e-12)
        # Mean and mean square of min(I S, 1) with S of the gamma law of n added patterns.
        cut = np.minimum(n / light, 700.0)
        mean = light * special.gammainc(n + 1.0, cut) + special.gammaincc(n, cut)
        square = light**2 * (n + 1.0) / n * special.gammainc(n + 2.0, cut) + special.gammaincc(n, cut)
        fit = measure.fit_gaussian(mean)
        background = _DARK_DN / 770.0  # of a typical level
        average = mean.mean() + background
        contrast = math.sqrt(max(square.mean() + 2.0 * background * mean.mean() - average**2, 0.0)) / average
        rows.append((fit.sigma_px / _SIGMA_PX, fit.amplitude, contrast * _SIGMA_PX, mean.sum() / _SIGMA_PX**2))
    return np.array(rows)
