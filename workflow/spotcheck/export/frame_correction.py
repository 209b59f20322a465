"""Convert readings to electrons of the light, with their variance.

The correction inverts the model of the sensor step by step: subtract black level and pixel offset, invert the detected
effects on well and response, divide by the gain, subtract the dark current, and divide by the relative gain of the
pixel. Bad and clipped pixels become NaN.

An effect is a deviation of the sensor from a linear one that the verdict detected. Light is counted in DN: it is the
signal above the black level of a linear sensor without full well. The well limits the charge of a pixel. The converter
stands for everything behind it: response and range of the readings.
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

# Points of the response curve, and its largest light in units of the largest reading.
CURVE_POINTS, MAX_LIGHT = 8192, 1.5
# A signal is clipped where the slope of the response curve [1] is smaller.
MIN_SLOPE = 0.5
# Least slope of the well in a divisor.
MIN_WELL_SLOPE = 1e-12
# A signal is clipped if it is closer to the full well than this many standard deviations of the read noise.
WELL_MARGIN = 3.0
# Largest reading [DN] of a sensor without a full scale: that of 16-bit files.
DEFAULT_FULL_SCALE_DN = 65535.0


@dataclass(frozen=True)
class ResponseCurve:
    """Signal of the sensor as a function of light, up to where the slope falls below `MIN_SLOPE`."""

    light: np.ndarray  # light [DN], shape (points,), ascending from 0
    signal: np.ndarray  # mean reading above the black level [DN], shape (points,)
    slope: np.ndarray  # derivative of the signal by the light [1], shape (points,)
    converter_slope: np.ndarray  # derivative of the signal by gain × charge [1], shape (points,)
    clipping_signal: float  # smallest signal that counts as clipped [DN]


@dataclass(frozen=True)
class CorrectedFrame:
    """Frame in electrons, NaN for bad and clipped pixels."""

    electrons: np.ndarray  # electrons of the light [e-], shape (rows, columns)
    variance: np.ndarray  # variance of the electrons [e-²], shape (rows, columns)
    clipped_count: int  # number of clipped pixels


def compute_response_curve(sensor: SensorModel, effects: Sequence[AppliedEffect]) -> ResponseCurve:
    """Return the response curve of a sensor with the detected effects on well and response.

    The full well of the data sheet sets the clipping signal only. The dark current is no part of the curve.

    Parameters
    ----------
    sensor : SensorModel
        Gain, read noise, black level, curvature, full well and full scale.
    effects : sequence of AppliedEffect
        Detected effects on well and response.
    """
    gain = sensor.gain_dn_per_e
    full_scale = sensor.full_scale_dn if np.isfinite(sensor.full_scale_dn) else DEFAULT_FULL_SCALE_DN
    light = np.linspace(0.0, MAX_LIGHT * full_scale, CURVE_POINTS)
    # The full well of the data sheet cuts the curve off and leaves lower signals unchanged: it is one of `limits`.
    without_well = replace(sensor, full_well_e=np.inf)
    # The baseline describes the spot. It is arbitrary here, since only the stages of the sensor count.
    baseline = Baseline(laser_px=0.0, photon_budget="free", top_hat=False, longest_s=1.0)
    model = ForwardModel(baseline, without_well, effects=tuple(effects))
    # Distribution of the readings of one pixel. Its functions give the signal step by step, without noise.
    distribution = model.distribution()
    # Charge behind the well, times the gain [DN].
    charge_dn = distribution.charge_signal(light / gain)
    if distribution.charge_levels:
        # The well can differ between pixels: a share [1] of them is full at each level [DN]. This is their mean.
        charge_dn = sum(share * np.minimum(charge_dn, level) for share, level in distribution.charge_levels)
    signal = distribution.converter_signal(charge_dn) - sensor.black_level_dn
    well_slope, slope = np.gradient(charge_dn, light), np.gradient(signal, light)
    margin = WELL_MARGIN * float(np.sqrt((gain * sensor.read_noise_e) ** 2 + ROUNDING_VARIANCE))
    # Smallest signals that count as clipped, for each reason [DN].
    limits = [sensor.full_scale_dn - sensor.black_level_dn]
    # The first point that is too flat; `argmax` gives 0 if there is none.
    first_flat = int(np.argmax(slope < MIN_SLOPE))
    if slope[first_flat] < MIN_SLOPE:
        # Read noise is added behind the well, so it scatters the signals of full pixels around the limit.
        has_well = any(Stage.WELL in applied.effect.stages for applied in effects)
        limits.append(float(signal[first_flat]) - (margin if has_well else 0.0))
    if np.isfinite(sensor.full_well_e):
        limits.append(float(np.interp(gain * sensor.full_well_e, light, signal)) - margin)
    usable = slice(first_flat or CURVE_POINTS)
    # Chain rule: the slopes of well and converter multiply.
    converter_slope = slope[usable] / np.maximum(well_slope[usable], MIN_WELL_SLOPE)
    return ResponseCurve(light[usable], signal[usable], slope[usable], converter_slope, min(limits))


def correct_frame(
    image: np.ndarray,
    sensor: SensorModel,
    curve: ResponseCurve,
    maps: PixelMaps | None = None,
    exposure_s: float | None = None,
) -> CorrectedFrame:
    """Return a frame in electrons of the light.

    The variance adds up shot noise, read noise, rounding and the errors of the maps as EMVA 1288 does, each divided by
    the slope of the response that it passes. The shot noise is taken from the reading instead of its mean. Errors of
    gain and black level are excluded, as all pixels share them.

    Parameters
    ----------
    image : array [rows, columns]
        Readings [DN], NaN where a pixel is bad.
    sensor : SensorModel
        Gain, read noise, dark current and black level.
    curve : ResponseCurve
        Response of the same sensor.
    maps : PixelMaps, optional
        Offset [DN] and relative gain [1] of each pixel, with the standard errors of one pixel; without them all pixels
        are alike.
    exposure_s : float, optional
        Exposure time [s]; without it no dark current is subtracted.
    """
    maps = PixelMaps(np.zeros(()), np.ones(())) if maps is None else maps
    gain = sensor.gain_dn_per_e
    signal = image - sensor.black_level_dn - maps.offset_dn
    is_clipped = (signal >= curve.clipping_signal) | (image >= sensor.full_scale_dn)
    light = np.interp(signal, curve.signal, curve.light)
    # Readings below black continue the first segment of the curve, where `interp` would give 0.
    light = np.where(signal < curve.signal[0], (signal - curve.signal[0]) / curve.slope[0], light)
    slope, converter_slope = (np.interp(light, curve.light, values) for values in (curve.slope, curve.converter_slope))
    # Electrons of light and dark current without a full well [e-].
    unlimited_e = light / gain
    electrons = (unlimited_e - sensor.dark_current_e_per_s * (exposure_s or 0.0)) / maps.gain
    # Read noise is added behind the well; rounding and offsets are added behind the converter.
    variance = np.maximum(unlimited_e, 0.0) + (sensor.read_noise_e * converter_slope / slope) ** 2
    variance += (ROUNDING_VARIANCE + maps.offset_stderr_dn**2) / (gain * slope) ** 2
    variance = variance / maps.gain**2 + (electrons * maps.gain_stderr / maps.gain) ** 2
    is_invalid = is_clipped | np.isnan(electrons)
    electrons, variance = (np.where(is_invalid, np.nan, values) for values in (electrons, variance))
    return CorrectedFrame(electrons, variance, clipped_count=int(np.count_nonzero(is_clipped)))
