"""From a reading back to the electrons of the light, and the variance of that.

Black level and the pixel's offset are taken off, what a verdict found of well and response is turned round, gain and
dark current are taken off, and the pixel's gain divided by. What cannot be turned round is NaN: bad pixels, and those
that are clipped.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps

# Points of the curve between light and signal, and how far beyond full scale it goes.
POINTS, BEYOND = 8192, 1.5
# A signal is clipped where it follows the light by less than this, and nearer to a well than so many noises.
FOLLOWS, NOISES = 0.5, 3.0


class Curve(NamedTuple):
    """Signal [DN above black] over light [DN that a linear sensor would add]; slope of the signal in the light, and the
    part of it that the response has; the signal from which on it is clipped [DN]."""

    light: np.ndarray
    signal: np.ndarray
    slope: np.ndarray
    response: np.ndarray
    clipped: float


class Corrected(NamedTuple):
    """Electrons of the light [e-] and their variance [e-²], both [rows, columns] with NaN where a pixel is bad or
    clipped; how many are clipped."""

    electrons: np.ndarray
    variance: np.ndarray
    clipped: int


def curve_of(sensor: SensorModel, effects: Sequence[AppliedEffect]) -> Curve:
    """Return what full well, and effects on well and response, make of the light."""
    gain, read = sensor.gain_dn_per_e, (sensor.gain_dn_per_e * sensor.read_noise_e) ** 2
    top = sensor.full_scale_dn if np.isfinite(sensor.full_scale_dn) else 65535.0
    light = np.linspace(0.0, BEYOND * top, POINTS)
    endless = replace(sensor, full_well_e=np.inf)
    distribution = ForwardModel(Baseline(0.0, "free", False, 1.0), endless, None, tuple(effects)).distribution()
    charge = distribution.charge_signal(light / gain)
    if distribution.charge_levels:
        charge = sum(share * np.minimum(charge, level) for share, level in distribution.charge_levels)
    signal = distribution.converter_signal(charge) - sensor.black_level_dn
    well, slope = np.gradient(charge, light), np.gradient(signal, light)
    margin = NOISES * float(np.sqrt(read + ROUNDING_VARIANCE))
    ends = [sensor.full_scale_dn - sensor.black_level_dn]
    if (slope < FOLLOWS).any():
        has_well = any(Stage.WELL in applied.effect.stages for applied in effects)
        ends.append(float(signal[np.argmax(slope < FOLLOWS)]) - (margin if has_well else 0.0))
    if np.isfinite(sensor.full_well_e):
        ends.append(float(np.interp(gain * sensor.full_well_e, light, signal)) - margin)
    last = int(np.argmax(slope < FOLLOWS)) or POINTS
    response = slope[:last] / np.maximum(well[:last], 1e-12)
    return Curve(light[:last], signal[:last], slope[:last], response, min(ends))


def corrected(
    image: np.ndarray, sensor: SensorModel, curve: Curve, maps: PixelMaps | None = None, exposure_s: float | None = None
) -> Corrected:
    """A frame [rows, columns] in DN, NaN where a pixel is bad, in electrons of the light.

    The variance is that of shot and read noise, rounding and the maps' errors (EMVA 1288 linear model), with the
    reading itself in the place of its mean; the errors of gain and black level, which all pixels share, are not in it.
    """
    offset = 0.0 if maps is None else maps.offset_dn
    share = 1.0 if maps is None else maps.gain
    uncertain = (0.0, 0.0) if maps is None else (maps.offset_stderr_dn**2, maps.gain_stderr**2)
    signal = image - sensor.black_level_dn - offset
    clipped = (signal >= curve.clipped) | (image >= sensor.full_scale_dn)
    light = np.interp(signal, curve.signal, curve.light)
    # Noise below black goes on straight.
    below = signal < curve.signal[0]
    light = np.where(below, (signal - curve.signal[0]) / curve.slope[0], light)
    slope, response = (np.interp(light, curve.light, own) for own in (curve.slope, curve.response))
    gain = sensor.gain_dn_per_e
    charge = light / gain
    electrons = (charge - sensor.dark_current_e_per_s * (exposure_s or 0.0)) / share
    variance = np.maximum(charge, 0.0) + (sensor.read_noise_e * response / slope) ** 2
    variance += (ROUNDING_VARIANCE + uncertain[0]) / (gain * slope) ** 2
    variance = variance / share**2 + electrons**2 * uncertain[1]
    bad = clipped | np.isnan(electrons)
    return Corrected(np.where(bad, np.nan, electrons), np.where(bad, np.nan, variance), int(np.count_nonzero(clipped)))
