"""Convert readings to electrons of the light, with their variance.

The correction inverts the model of the sensor step by step: subtract black level and pixel offset, invert the detected
effects on well and response, divide by the gain, subtract the dark current, and divide by the relative gain of the
pixel. Bad and clipped pixels become NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel
from spotcheck.model.stage import Stage
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps

# Points of the response curve, and its largest light in units of full scale.
CURVE_POINTS, MAX_LIGHT = 8192, 1.5
# A signal is clipped if the slope of the response curve is below the first number, or if it is closer to full well than
# this many standard deviations of the read noise.
MIN_SLOPE, WELL_MARGIN = 0.5, 3.0


@dataclass(frozen=True)
class ResponseCurve:
    """Signal of the sensor as a function of light."""

    light: np.ndarray  # signal of a linear sensor without full well [DN], shape (points,)
    signal: np.ndarray  # signal above black [DN], shape (points,)
    slope: np.ndarray  # derivative of the signal by the light, shape (points,)
    converter_slope: np.ndarray  # its factor behind the well, shape (points,)
    clipped: float  # smallest signal that counts as clipped [DN]


@dataclass(frozen=True)
class CorrectedFrame:
    """Frame in electrons, NaN for bad and clipped pixels."""

    electrons: np.ndarray  # electrons of the light [e-], shape (rows, columns)
    variance: np.ndarray  # variance of the electrons [e-²], shape (rows, columns)
    clipped: int  # number of clipped pixels


def compute_response_curve(sensor: SensorModel, effects: Sequence[AppliedEffect]) -> ResponseCurve:
    """Return the response curve of a sensor with full well and detected effects on well and response."""
    gain = sensor.gain_dn_per_e
    full_scale = sensor.full_scale_dn if np.isfinite(sensor.full_scale_dn) else 65535.0
    light = np.linspace(0.0, MAX_LIGHT * full_scale, CURVE_POINTS)
    # The full well of the data sheet is a limit below, and no part of the curve.
    without_well = replace(sensor, full_well_e=np.inf)
    model = ForwardModel(Baseline(0.0, "free", False, 1.0), without_well, None, tuple(effects))
    distribution = model.distribution()
    charge = distribution.charge_signal(light / gain)
    if distribution.charge_levels:
        charge = sum(share * np.minimum(charge, level) for share, level in distribution.charge_levels)
    signal = distribution.converter_signal(charge) - sensor.black_level_dn
    well_slope, slope = np.gradient(charge, light), np.gradient(signal, light)
    margin = WELL_MARGIN * float(np.sqrt((gain * sensor.read_noise_e) ** 2 + ROUNDING_VARIANCE))
    limits = [sensor.full_scale_dn - sensor.black_level_dn]
    # Index of the first point that is too flat; 0 if there is none.
    flat = int(np.argmax(slope < MIN_SLOPE))
    if slope[flat] < MIN_SLOPE:
        has_well = any(Stage.WELL in applied.effect.stages for applied in effects)
        limits.append(float(signal[flat]) - (margin if has_well else 0.0))
    if np.isfinite(sensor.full_well_e):
        limits.append(float(np.interp(gain * sensor.full_well_e, light, signal)) - margin)
    part = slice(flat or CURVE_POINTS)
    converter_slope = slope[part] / np.maximum(well_slope[part], 1e-12)
    return ResponseCurve(light[part], signal[part], slope[part], converter_slope, min(limits))


def correct_frame(
    image: np.ndarray,
    sensor: SensorModel,
    curve: ResponseCurve,
    maps: PixelMaps | None = None,
    exposure_s: float | None = None,
) -> CorrectedFrame:
    """Return a frame in electrons of the light.

    The variance is that of shot noise, read noise, rounding and the errors of the maps (EMVA 1288 linear model), where
    the reading replaces its mean. It excludes the errors of gain and black level, which all pixels share.

    Parameters
    ----------
    image : array [rows, columns]
        Readings [DN], NaN where a pixel is bad.
    sensor : SensorModel
        Gain, read noise, dark current and black level.
    curve : ResponseCurve
        Response of the same sensor.
    maps : PixelMaps, optional
        Offset [DN] and relative gain of each pixel; without them all pixels are alike.
    exposure_s : float, optional
        Exposure time [s]; without it no dark current is subtracted.
    """
    maps = PixelMaps(np.zeros(()), np.ones(())) if maps is None else maps
    gain = sensor.gain_dn_per_e
    signal = image - sensor.black_level_dn - maps.offset_dn
    clipped = (signal >= curve.clipped) | (image >= sensor.full_scale_dn)
    light = np.interp(signal, curve.signal, curve.light)
    # Noise below black is extrapolated linearly.
    light = np.where(signal < curve.signal[0], (signal - curve.signal[0]) / curve.slope[0], light)
    slope, converter_slope = (np.interp(light, curve.light, values) for values in (curve.slope, curve.converter_slope))
    charge = light / gain
    electrons = (charge - sensor.dark_current_e_per_s * (exposure_s or 0.0)) / maps.gain
    # Read noise is added behind the well; rounding and offsets are added behind the converter.
    variance = np.maximum(charge, 0.0) + (sensor.read_noise_e * converter_slope / slope) ** 2
    variance += (ROUNDING_VARIANCE + maps.offset_stderr_dn**2) / (gain * slope) ** 2
    variance = variance / maps.gain**2 + electrons**2 * maps.gain_stderr**2
    invalid = clipped | np.isnan(electrons)
    return CorrectedFrame(
        electrons=np.where(invalid, np.nan, electrons),
        variance=np.where(invalid, np.nan, variance),
        clipped=int(np.count_nonzero(clipped)),
    )
