"""The sensor: photons to electrons to digital numbers, pixel by pixel."""

from __future__ import annotations

import functools

import numpy as np
from scipy import special

from rig.settings import Sensor

_TILE_PX = 256


def clip_levels_e(sensor: Sensor, seed: int, rows: range, columns: range) -> np.ndarray | None:
    """Electrons [e-] at which each pixel of a window stops to gather; None when nothing clips before the converter.

    The map belongs to the chip: a pixel has the same level in every frame and in every window.
    """
    if sensor.clip_level_e is None:
        return None
    # ASSUME: wells scatter from pixel to pixel; drivers of whole rows scatter from row to row, and every
    # `clip_row_period_px`-th row is read over a path of its own (the regular stripes).
    relative = sensor.clip_pixel_scatter * _pixel_scores(seed, rows, columns, sensor.clip_screen_sigma)
    regular = np.array([row % sensor.clip_row_period_px == 0 for row in rows], dtype=float)
    per_row = sensor.clip_row_scatter * _row_scores(seed, rows, sensor.clip_screen_sigma)
    per_row += sensor.clip_row_step * regular
    return sensor.clip_level_e * (1.0 + per_row[:, None] + relative)


def expose(
    sensor: Sensor,
    photons: np.ndarray,
    exposure_s: float,
    levels_e: np.ndarray | None,
    rng: np.random.Generator,
) -> np.ndarray:
    """One exposure of a window: mean photons a pixel to digital numbers [DN]."""
    dark_e = sensor.dark_current_e_per_s * exposure_s
    electrons = rng.poisson(sensor.quantum_efficiency * photons + dark_e).astype(float)
    if levels_e is not None:
        np.minimum(electrons, levels_e, out=electrons)
    # Clip, then read noise: the well is in the pixel, the amplifier behind it.
    electrons += sensor.read_noise_e * rng.standard_normal(photons.shape)
    return digitise(sensor, electrons)


def dark_frame(sensor: Sensor, shape: tuple[int, int], exposure_s: float, rng: np.random.Generator) -> np.ndarray:
    """A frame without light [DN]: the same law as `expose`, made for many pixels.

    Dark electrons are rare; dropping a Poisson number of them on random pixels is the same as one Poisson draw a pixel.
    """
    electrons = rng.standard_normal(shape, dtype=np.float32)
    electrons *= np.float32(sensor.read_noise_e)
    pixels = shape[0] * shape[1]
    mean_e = sensor.dark_current_e_per_s * exposure_s
    if mean_e < 1.0:
        hits = rng.integers(0, pixels, size=rng.poisson(mean_e * pixels))
        np.add.at(electrons.reshape(-1), hits, np.float32(1.0))
    else:
        electrons += rng.poisson(mean_e, size=shape).astype(np.float32)
    return digitise(sensor, electrons)


def digitise(sensor: Sensor, electrons: np.ndarray) -> np.ndarray:
    """Gain, black level, one rounding to nearest, the converter's range. Changes `electrons`; returns uint16."""
    electrons *= electrons.dtype.type(sensor.gain_dn_per_e)
    electrons += electrons.dtype.type(sensor.black_level_dn)
    np.rint(electrons, out=electrons)
    np.clip(electrons, 0, 2**sensor.bit_depth - 1, out=electrons)
    return electrons.astype(np.uint16)


def _screened_normal(uniform: np.ndarray, screen_sigma: float) -> np.ndarray:
    """Standard normal scores cut at ±`screen_sigma`: the maker screens out chips with worse pixels."""
    low = special.ndtr(-screen_sigma)
    return special.ndtri(low + (1.0 - 2.0 * low) * uniform)


def _row_scores(seed: int, rows: range, screen_sigma: float) -> np.ndarray:
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, 0)))
    return _screened_normal(rng.random(rows.stop), screen_sigma)[rows.start :]


def _pixel_scores(seed: int, rows: range, columns: range, screen_sigma: float) -> np.ndarray:
    scores = np.empty((len(rows), len(columns)))
    for tile_y in range(rows.start // _TILE_PX, (rows.stop - 1) // _TILE_PX + 1):
        for tile_x in range(columns.start // _TILE_PX, (columns.stop - 1) // _TILE_PX + 1):
            top, left = tile_y * _TILE_PX, tile_x * _TILE_PX
            y0, y1 = max(rows.start, top), min(rows.stop, top + _TILE_PX)
            x0, x1 = max(columns.start, left), min(columns.stop, left + _TILE_PX)
            tile = _tile(seed, tile_y, tile_x, screen_sigma)
            part = tile[y0 - top : y1 - top, x0 - left : x1 - left]
            scores[y0 - rows.start : y1 - rows.start, x0 - columns.start : x1 - columns.start] = part
    return scores


@functools.lru_cache(maxsize=64)
def _tile(seed: int, tile_y: int, tile_x: int, screen_sigma: float) -> np.ndarray:
    # A tile is drawn as a whole, so that a window sees the same pixels wherever it lies.
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, 1, tile_y, tile_x)))
    return _screened_normal(rng.random((_TILE_PX, _TILE_PX)), screen_sigma)
