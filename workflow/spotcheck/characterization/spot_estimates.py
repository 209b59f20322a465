"""Gain, noise floor and saturation level of a sensor from images of spots.

The noise comes from differences of neighbouring pixels, or from differences of two frames of the same pixels.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from spotcheck.characterization.frame_pairs import EMPTY_TALLY, convert_to_curve, tally_differences
from spotcheck.characterization.missing_codes import find_missing_codes
from spotcheck.characterization.noise_curve import (
    MIN_COUNT,
    GainEstimate,
    NoiseCurve,
    fit_gain,
    measure_noise_correlation,
    measure_noise_curve,
)
from spotcheck.sensor import SensorModel

# Signals below this part of saturation have their full noise.
FULL_NOISE_PART = 0.9
# Signals above this part of saturation are saturated. Their noise is lost if less than this part of shot noise is left.
SATURATED_PART, LOST_NOISE_PART = 0.9, 0.5
# Number of frames that are tested for missing codes and for correlated noise.
TESTED_FRAMES = 5
# Width of the rim of a frame, as a part of its sides: a spot lies within.
RIM = 0.05
# Saturation of a spot: histogram bins of this width in ln level; least ratio of the fullest bin to the mean bin of the
# spot's flank; range of the flank, as parts of the brightest level; end of the bins in ln of parts of it.
BIN_WIDTH, MIN_PEAK_RATIO, FLANK, BINS_END = 0.04, 4.0, (0.25, 0.6), 0.15
# Saturation of a sensor: least number and least part of the spots that agree with their median within a part of it.
MIN_AGREEING, MIN_AGREEING_PART, AGREEMENT = 2, 0.6, 0.05


@dataclass(frozen=True)
class SpotEstimates:
    """What images of spots show of the sensor."""

    gain: GainEstimate | None  # gain and noise floor; None if the noise does not grow with the light
    method: str  # how they were measured, as a phrase; "" if there is no gain
    saturation: tuple[float, float] | None  # level over black [DN] and standard error; None if frames do not saturate
    saturated_variance: float  # temporal variance of a saturated pixel [DN²]; NaN without pairs
    level_dn: float  # level from which light was counted [DN]: black level, or median of the rims of all frames
    lowest_dn: float  # lowest such level of all frames [DN]

    @property
    def is_noise_lost(self) -> bool:
        """Whether saturated pixels have lost their noise: then the sensor saturates, and it is no plateau of light."""
        if self.gain is None or self.saturation is None:
            return False
        return self.saturated_variance < self.gain.floor + LOST_NOISE_PART * self.gain.gain * self.saturation[0]


def estimate_from_spots(
    crops: Iterable[np.ndarray],
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]],
    black_dn: float | None,
    full_scale_dn: float,
    response_bend: float = 0.0,
) -> SpotEstimates:
    """Return gain, noise floor and saturation from spots, by the method with the smaller relative error of the gain.

    Parameters
    ----------
    crops : images of spots [rows, columns] in DN.
    pairs : pairs of images [rows, columns] in DN of the same pixels, by what the two frames are. Their differences do
        not contain the grain of the material, which those of neighbouring pixels do.
    black_dn : black level [DN]. If it is None, light is counted from the level of each frame's rim; the floor is then
        the noise of a dark pixel with the shot noise of stray light.
    full_scale_dn : largest possible reading [DN].
    response_bend : response curvature of the data sheet, which is corrected.
    """
    nonlinear = SensorModel(1.0, 0.0, full_scale_dn=full_scale_dn, response_bend=response_bend)
    curves, saturations, levels, tested = list[NoiseCurve](), list[float](), list[float](), list[np.ndarray]()
    for crop in crops:
        level = measure_rim(crop) if black_dn is None else black_dn
        sensor = replace(nonlinear, black_level_dn=level)
        image = sensor.linearize(crop)
        saturation = find_saturation(image, level)
        curve = measure_noise_curve(image, _limit_readings(sensor, saturation))
        levels.append(level)
        saturations.append(saturation)
        if curve.level.size:
            curves.append(curve._replace(level=curve.level - level))
        if len(tested) < TESTED_FRAMES:
            tested.append(crop)
    curves_by_method = {}
    if curves:
        method = f"differences of neighbouring pixels in {_count(len(curves), 'frame')}"
        pooled = NoiseCurve(*(np.concatenate(parts) for parts in zip(*curves, strict=True)))
        curves_by_method[method + _describe_faults(tested, full_scale_dn)] = pooled
    level = float(np.median(levels)) if levels else black_dn or 0.0
    sensor = replace(nonlinear, black_level_dn=level)
    saturated = np.zeros(2)
    for kind, images in pairs.items():
        curve, count, saturated_of_kind = _compare_pairs(images, sensor)
        curves_by_method[f"differences of {_count(count, 'pair')} of {kind}"] = curve
        saturated += saturated_of_kind
    fits = ((method, fit_gain(curve, 0.0)) for method, curve in curves_by_method.items())
    gains = {method: gain for method, gain in fits if gain is not None}
    best = min(gains, key=lambda method: gains[method].gain_stderr / gains[method].gain, default="")
    return SpotEstimates(
        gain=gains.get(best),
        method=best,
        saturation=find_common_saturation(saturations),
        saturated_variance=float(saturated[1] / saturated[0]) if saturated[0] else np.nan,
        level_dn=level,
        lowest_dn=min(levels, default=level),
    )


def _compare_pairs(
    pairs: Iterable[tuple[np.ndarray, np.ndarray]], sensor: SensorModel
) -> tuple[NoiseCurve, int, np.ndarray]:
    """Return the noise over light of pairs of images, the number of pairs, and the sums of `_sum_saturated`."""
    black_dn, tally, count, saturated = sensor.black_level_dn, EMPTY_TALLY, 0, np.zeros(2)
    for pair in pairs:
        first, second = (sensor.linearize(image) for image in pair)
        saturations = [find_saturation(image, black_dn) for image in (first, second)]
        tally = tally + tally_differences(first, second, black_dn, _limit_readings(sensor, *saturations))
        saturated += _sum_saturated(first, second, black_dn + SATURATED_PART * float(np.mean(saturations)))
        count += 1
    curve = convert_to_curve(tally, black_dn)
    return curve._replace(level=curve.level - black_dn), count, saturated


def _limit_readings(sensor: SensorModel, *saturations: float) -> float:
    """Return the linearized reading [DN] up to which noise is complete in images of these saturations (NaN: none)."""
    limits = [sensor.black_level_dn + FULL_NOISE_PART * level for level in saturations if np.isfinite(level)]
    return float(min([sensor.without_curvature().full_scale_dn, *limits]))


def _describe_faults(images: Sequence[np.ndarray], full_scale_dn: float) -> str:
    """Return what makes differences of neighbouring pixels unreliable, to be appended to the method; "" if nothing.

    Noise counts as correlated only if it is in most images: by chance it seems so in a single one.
    """
    missing = find_missing_codes(images)
    correlations = [measure_noise_correlation(image, full_scale_dn) for image in images]
    text = f"; {len(missing)} codes are never read, as a look-up table skips them" if missing else ""
    if sum(correlation.is_white for correlation in correlations) <= len(correlations) / 2:
        range_px = int(np.median([correlation.range_px for correlation in correlations]))
        text += f"; pixels share noise over {range_px} px, as in compressed frames, so it is not that of single pixels"
    return text


def _sum_saturated(first: np.ndarray, second: np.ndarray, limit_dn: float) -> np.ndarray:
    """Return the number of pixels above a limit [DN] in both images, and that number times their variance [DN²].

    The variance is estimated from the median squared difference, as some of the pixels are not saturated.
    """
    both = np.minimum(first, second) > limit_dn
    if not both.any():
        return np.zeros(2)
    variance = float(np.median((second - first)[both] ** 2)) / 2 / chi2.median(1)
    return both.sum() * np.array([1.0, variance])


def _count(number: int, noun: str) -> str:
    """Return a number with its noun in singular or plural."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def measure_rim(frame: np.ndarray) -> float:
    """Return the median reading [DN] of the rim of a frame [rows, columns]."""
    rows, columns = (max(1, round(RIM * side)) for side in frame.shape)
    is_rim = np.ones(frame.shape, bool)
    is_rim[rows:-rows, columns:-columns] = False
    return float(np.nanmedian(frame[is_rim]))


def find_saturation(image: np.ndarray, black_dn: float) -> float:
    """Return the level over black [DN] at which the readings of a spot saturate; NaN if they do not.

    A Gaussian spot has equally many pixels in each step of ln level. A step near the top with many more is saturation.

    Parameters
    ----------
    image : image of the spot [rows, columns] in DN; NaN pixels do not count.
    black_dn : black level [DN].
    """
    level = image[np.isfinite(image)] - black_dn
    top = float(np.quantile(level, 0.999)) if level.size else 0.0
    if top <= 0:
        return np.nan
    log_level = np.log(level[level > FLANK[0] * top] / top)
    flank_start, flank_end = np.log(FLANK)
    edges = np.arange(flank_start, BINS_END, BIN_WIDTH)
    count, _ = np.histogram(log_level, edges)
    flank = count[edges[1:] <= flank_end]
    fullest = int(np.argmax(count))
    if flank.sum() < MIN_COUNT or count[fullest] < MIN_PEAK_RATIO * flank.mean() or edges[fullest] < flank_end:
        return np.nan
    near = np.abs(log_level - edges[fullest] - BIN_WIDTH / 2) < 1.5 * BIN_WIDTH
    return float(top * np.exp(np.median(log_level[near])))


def find_common_saturation(saturations: Sequence[float]) -> tuple[float, float] | None:
    """Return the level [DN] at which most spots saturate and its standard error.

    It is None if fewer than two spots saturate (NaN: no saturation), or if their levels differ, as those of plateaus of
    the light do.
    """
    known = np.array([level for level in saturations if np.isfinite(level)])
    if len(known) < MIN_AGREEING:
        return None
    middle = float(np.median(known))
    agreeing = known[np.abs(known - middle) < AGREEMENT * middle]
    if len(agreeing) < max(MIN_AGREEING, MIN_AGREEING_PART * len(known)):
        return None
    return float(agreeing.mean()), float(agreeing.std(ddof=1) / np.sqrt(len(agreeing)))
