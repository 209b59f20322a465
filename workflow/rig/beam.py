"""A plain laser beam falling on the camera: the caustic w(z), for scans along the axis."""

from __future__ import annotations

import math

import numpy as np

from rig.material import Spot, place
from rig.plan import Site
from rig.settings import Settings


def radius_m(z_m: float, waist_m: float, focus_m: float, m2: float, wavelength_m: float) -> float:
    """Beam radius w(z) at 1/e² of the irradiance [m]: w0 √(1 + ((z − z0) M² λ / (π w0²))²)."""
    rayleigh_m = math.pi * waist_m**2 / (m2 * wavelength_m)
    return waist_m * math.hypot(1.0, (z_m - focus_m) / rayleigh_m)


def illuminate(settings: Settings, site: Site, rng: np.random.Generator) -> Spot:
    """The beam's cross-section at the site's `z_m` (0 when the plan has no such column)."""
    beam, pitch = settings.beam, settings.sensor.pixel_pitch_m
    normals = rng.standard_normal(4)
    x_px, y_px = place(settings, normals[:2])
    z_m = site.shots[0].other("z_m") or 0.0
    variances = []
    for waist, focus in ((beam.waist_x_m, beam.focus_x_m), (beam.waist_y_m, beam.focus_y_m)):
        # w is twice the standard deviation of a Gaussian irradiance.
        sigma_px = radius_m(z_m, waist, focus, beam.m2, settings.laser.wavelength_m) / 2.0 / pitch
        variances.append(sigma_px**2)
    axis = math.radians(beam.axis_deg)
    turn = np.array([[math.cos(axis), -math.sin(axis)], [math.sin(axis), math.cos(axis)]])
    peak = 1.0 + beam.peak_scatter * float(np.clip(normals[2], -2.0, 2.0))
    return Spot(x_px, y_px, turn @ np.diag(variances) @ turn.T, peak, site.shots[0].angle_deg or 0.0, 1.0, 1.0)


def photons(settings: Settings, spot: Spot) -> float:
    """Photons [1] that bring the peak pixel to the wanted part of full scale: the operator turns a neutral filter."""
    sensor = settings.sensor
    full_scale_dn = 2**sensor.bit_depth - 1
    peak_e = settings.beam.peak_fraction * (full_scale_dn - sensor.black_level_dn) / sensor.gain_dn_per_e
    area_px = 2.0 * math.pi * math.sqrt(float(np.linalg.det(spot.covariance_px2)))
    return peak_e / sensor.quantum_efficiency * area_px
