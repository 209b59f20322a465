"""One site in front of the camera: its spot, its speckle, and a frame for each planned exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig import beam, material, photons, sensor, speckle
from rig.errors import RigError
from rig.plan import Shot, Site
from rig.settings import Settings

# Spawn keys below the seed: (0, ...) is the chip, (1, site, ...) a site, (2, frame, ...) a frame.
SITE, FRAME = 1, 2


@dataclass(frozen=True)
class Window:
    """The part of the frame that light can reach: rows and columns in frame coordinates [px]."""

    rows: range
    columns: range

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.rows.start, self.rows.stop), slice(self.columns.start, self.columns.stop)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.rows), len(self.columns)


@dataclass(frozen=True)
class LitSite:
    """A site with its light: irradiance is the part of the spot's photons that falls on each pixel [1/px]."""

    site: Site
    spot: material.Spot | None
    window: Window
    irradiance: np.ndarray


def light(settings: Settings, site: Site) -> LitSite:
    """Set up one site: everything that its exposures share."""
    if site.shots[0].kind != "spot":
        window = Window(range(settings.frame.height_px), range(settings.frame.width_px))
        return LitSite(site, None, window, np.zeros((0, 0)))
    place_rng, speckle_rng = (generator(settings, SITE, site.index, part) for part in (0, 1))
    source = beam if settings.source == "beam" else material
    spot = source.illuminate(settings, site, place_rng)
    side = settings.frame.window_px
    window = Window(
        _around(spot.y_px, side, settings.frame.height_px), _around(spot.x_px, side, settings.frame.width_px)
    )
    irradiance = gaussian(spot, window)
    irradiance *= speckle.field_on_pixels(settings, window.shape, speckle_rng)
    return LitSite(site, spot, window, irradiance)


def gaussian(spot: material.Spot, window: Window) -> np.ndarray:
    """Part of the spot's light on each pixel [1/px]: sampled at the pixel's centre, sum 1 whatever the spread."""
    # ASSUME: what the fibres send back is Gaussian on the chip; wide against a pixel, so a sample stands for the
    # pixel's mean.
    inverse = np.linalg.inv(spot.covariance_px2)
    dx = np.arange(window.columns.start, window.columns.stop) - spot.x_px
    dy = (np.arange(window.rows.start, window.rows.stop) - spot.y_px)[:, None]
    form = inverse[0, 0] * dx**2 + 2.0 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
    return np.exp(-0.5 * form) / (2.0 * math.pi * math.sqrt(np.linalg.det(spot.covariance_px2)))


def spot_photons(settings: Settings, lit: LitSite, shot: Shot) -> float:
    """Mean photons [1] of the whole spot in one frame."""
    if lit.spot is None:
        return 0.0
    if settings.source == "beam":
        return beam.photons(settings, lit.spot) * lit.spot.relative_light
    return photons.reflected_photons(settings, exposure_s(settings, shot)) * lit.spot.relative_light


def exposure_s(settings: Settings, shot: Shot) -> float:
    """True exposure [s]; a blank cell means that nobody wrote it down, not that there was none."""
    return settings.unrecorded_exposure_s if shot.exposure_s is None else shot.exposure_s


def window_frame(settings: Settings, lit: LitSite, shot: Shot) -> np.ndarray:
    """The lit window of one frame [DN]: just the pixels that the whole frame will show there."""
    levels = sensor.clip_levels_e(settings.sensor, settings.seed, lit.window.rows, lit.window.columns)
    light_photons = lit.irradiance * spot_photons(settings, lit, shot)
    rng = generator(settings, FRAME, shot.index, 0)
    return sensor.expose(settings.sensor, light_photons, exposure_s(settings, shot), levels, rng)


def whole_frame(settings: Settings, lit: LitSite, shot: Shot) -> np.ndarray:
    """One raw frame [DN, uint16]: dark everywhere but in the lit window."""
    shape = (settings.frame.height_px, settings.frame.width_px)
    rng = generator(settings, FRAME, shot.index, 1)
    if shot.kind == "flat":
        level = shot.other("photons_per_px")
        if level is None or level < 0:
            raise RigError(f"manifest.csv: row {shot.index + 1}: a flat needs photons_per_px, 0 or more")
        levels = sensor.clip_levels_e(settings.sensor, settings.seed, range(shape[0]), range(shape[1]))
        return sensor.expose(settings.sensor, np.full(shape, level), exposure_s(settings, shot), levels, rng)
    frame = sensor.dark_frame(settings.sensor, shape, exposure_s(settings, shot), rng)
    if lit.spot is not None:
        frame[lit.window.slices] = window_frame(settings, lit, shot)
    return frame


def _around(centre_px: float, side_px: int, size_px: int) -> range:
    start = round(centre_px) - side_px // 2
    return range(max(start, 0), min(start + side_px, size_px))


def generator(settings: Settings, *key: int) -> np.random.Generator:
    """The random numbers of one purpose: keys (0, ...) are the chip's, (SITE, n) a site's, (FRAME, n) a frame's."""
    return np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=key))
