"""The composite: where a site lies, how much light it returns, how far it spreads along and across the fibres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig.errors import RigError
from rig.plan import Site
from rig.settings import Laser, Material, Settings

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))


@dataclass(frozen=True)
class Spot:
    """One site's spot on the chip: centre [px, frame coordinates], covariance [px²], brightness factor [1].

    `relative_light` multiplies the photons of an average site. x is the column, y the row, downwards.
    """

    x_px: float
    y_px: float
    covariance_px2: np.ndarray
    relative_light: float
    angle_deg: float
    site_reflectance: float
    site_spread: float

    @property
    def sigmas_px(self) -> tuple[float, float]:
        """Widths along the long and the short axis [px]."""
        short, long = np.linalg.eigvalsh(self.covariance_px2)
        return math.sqrt(long), math.sqrt(short)


def illuminate(settings: Settings, site: Site, rng: np.random.Generator) -> Spot:
    """Draw one site. The same draws are made whatever the settings, so that a setting changes only its own effect."""
    normals = rng.standard_normal(4)
    x_px, y_px = place(settings, normals[:2])
    material = settings.material
    # A blank angle: the sample lies as it is mounted.
    angle_deg = site.shots[0].angle_deg or 0.0
    turn = polarisation_term(settings.laser, material, angle_deg)
    reflectance = unit_mean_lognormal(normals[2], material.site_reflectance_scatter)
    # ASSUME: where more resin lies over the fibres, more light comes back and it has spread further: one draw
    # serves both, by a power law.
    spread = reflectance**material.site_spread_exponent
    spread *= unit_mean_lognormal(normals[3], material.site_spread_scatter)
    return Spot(
        x_px=x_px,
        y_px=y_px,
        covariance_px2=covariance(settings, angle_deg, spread * (1.0 + material.spread_polarisation * turn)),
        relative_light=reflectance * (1.0 + material.reflectance_polarisation * turn),
        angle_deg=angle_deg,
        site_reflectance=reflectance,
        site_spread=spread,
    )


def place(settings: Settings, normals: np.ndarray) -> tuple[float, float]:
    """Centre of the spot [px], kept off the border."""
    frame, pointing = settings.frame, settings.pointing
    centre = []
    for size, offset, normal in zip(
        (frame.width_px, frame.height_px), (pointing.offset_x_px, pointing.offset_y_px), normals, strict=True
    ):
        if 2.0 * pointing.border_px > size - 1:
            raise RigError(f"pointing.border_px: {pointing.border_px:g} leaves no room in {size} px")
        wanted = (size - 1) / 2.0 + offset + pointing.wander_px * normal
        centre.append(min(max(wanted, pointing.border_px), size - 1 - pointing.border_px))
    return centre[0], centre[1]


def polarisation_term(laser: Laser, material: Material, angle_deg: float) -> float:
    """cos 2γ with γ the angle between the fibres and the polarisation."""
    # ASSUME: carbon fibres act on the field along and across them differently, so that whatever follows the
    # polarisation has period 180° in γ.
    gamma = math.radians(angle_deg + material.fibre_zero_deg - laser.polarisation_deg)
    return math.cos(2.0 * gamma)


def covariance(settings: Settings, angle_deg: float, spread: float) -> np.ndarray:
    """Covariance of the spot's image [px²]: laser profile and spread in the material add as variances."""
    material, laser = settings.material, settings.laser
    px_per_m = settings.optics.focal_length_m / settings.optics.working_distance_m / settings.sensor.pixel_pitch_m
    beam = np.diag([(laser.fwhm_x_m / FWHM_PER_SIGMA) ** 2, (laser.fwhm_y_m / FWHM_PER_SIGMA) ** 2])
    axis = math.radians(angle_deg + material.fibre_zero_deg)
    along = np.array([math.cos(axis), math.sin(axis)])
    across = np.array([-math.sin(axis), math.cos(axis)])
    fibres = (material.spread_along_m * spread) ** 2 * np.outer(along, along)
    fibres += (material.spread_across_m * spread) ** 2 * np.outer(across, across)
    total = (beam + fibres) * px_per_m**2
    if np.linalg.det(total) <= 0.0:
        raise RigError("laser.fwhm_x_m, material.spread_along_m: the spot has no width")
    return total


def unit_mean_lognormal(normal: float, scatter: float) -> float:
    """A factor of mean 1 whose logarithm scatters by `scatter`: never negative, as a reflectance must be."""
    return math.exp(scatter * normal - 0.5 * scatter**2)
