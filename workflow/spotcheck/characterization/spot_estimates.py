"""Gain, noise floor and saturation level of a sensor from images of spots.

The noise comes from differences of neighbouring pixels, or from differences of two frames of the same pixels. A noise
curve is the temporal variance of a pixel over its level of light; its slope is the gain, and its value without light
is the noise floor. The rim of an image is its outer pixels, which the spot does not reach.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.stats import chi2

from spotcheck.characterization import noise_curve
from spotcheck.characterization.frame_pairs import EMPTY_TALLY, convert_to_curve, tally_differences
from spotcheck.characterization.missing_codes import find_missing_codes
from spotcheck.characterization.noise_curve import MIN_COUNT, GainEstimate, NoiseCurve
from spotcheck.io.number_text import count_text
from spotcheck.sensor import SensorModel

# Signals below this part of saturation have their full noise.
FULL_NOISE_PART = 0.9
# Signals above this part of saturation are saturated. Their noise is lost if less than this part of shot noise is left.
SATURATED_PART, LOST_NOISE_PART = 0.9, 0.5
# Largest number of frames that are tested for missing codes and for correlated noise.
TESTED_FRAMES = 5
# Width of the rim of an image, as a part of its side. The spot lies inside the rim and does not reach it.
RIM = 0.05
# The brightest level of a spot is this quantile of the levels, which hot pixels do not change.
BRIGHTEST_QUANTILE = 0.999
# Histogram of x = ln(level/brightest level), in which saturation is a peak: width of its bins in x; least ratio of the
# fullest bin to the mean bin of the spot's flank; range of the flank as parts of the brightest level; largest x.
BIN_WIDTH, MIN_PEAK_RATIO, FLANK, BINS_END = 0.04, 4.0, (0.25, 0.6), 0.15
# Distance from the peak up to which levels count as saturated, in widths of a bin.
PEAK_BINS = 1.5
# Saturation of a sensor: least number and least part of the saturating spots that agree with their median, and largest
# relative difference from the median for agreement.
MIN_AGREEING, MIN_AGREEING_PART, AGREEMENT = 2, 0.6, 0.05
# Reason why differences of neighbouring pixels give no gain although they grow with the light.
FINE_LIGHT = "neighbouring pixels differ by the light itself, which is finer than some pixels"
# Reason why sharpened images give no gain, and width of the rim that shows it, as a part of the side of an image.
SHARPENED = "the images are sharpened: neighbouring pixels differ by more noise than means of pixels have"
SHARP_RIM = 0.2


@dataclass(frozen=True)
class SpotEstimates:
    """Properties of the sensor that images of spots show."""

    gain: GainEstimate | None  # gain [DN/e-] and noise floor [DN²]; None if the noise does not grow with the light
    method: str  # how gain and floor were measured, as a phrase; without a gain, why it was refused, or ""
    saturation: tuple[float, float] | None  # level over black and standard error [DN]; None if spots do not saturate
    saturated_variance: float  # temporal variance of a saturated pixel [DN²]; NaN without pairs
    zero_level_dn: float  # level from which light was counted [DN]: black level, or median of the rims of all frames
    lowest_zero_level_dn: float  # lowest level from which light was counted in a frame [DN]

    @property
    def is_noise_lost(self) -> bool:
        """Whether saturated pixels have lost their noise: then the sensor saturates, and the light has no plateau."""
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
    """Return gain, noise floor and saturation from spots, by the method with the smallest relative error of the gain.

    Parameters
    ----------
    crops : images of spots [rows, columns] in DN.
    pairs : pairs of images [rows, columns] in DN of the same pixels, by a phrase that says what the two frames are,
        such as "repeats". Each kind of pairs is a method of its own, beside neighbouring pixels. Differences of pairs
        do not contain the grain of the material, which differences of neighbouring pixels contain.
    black_dn : black level [DN]. If it is None, light is counted from the rim of each crop, and in pairs from the median
        of all rims. The floor then also contains the shot noise of light on the rim.
    full_scale_dn : largest possible reading [DN].
    response_bend : response curvature of the data sheet [1], which is corrected.
    """
    # Sensor model for `linearize`, which needs no gain and read noise: these are placeholders.
    linearizer = SensorModel(
        gain_dn_per_e=1.0, read_noise_e=0.0, full_scale_dn=full_scale_dn, response_bend=response_bend
    )
    curves, spread_curves, tested_crops = list[NoiseCurve](), list[NoiseCurve](), list[np.ndarray]()
    saturations, zero_levels = list[float](), list[float]()
    for crop in crops:
        zero_level = measure_rim(crop) if black_dn is None else black_dn
        sensor = replace(linearizer, black_level_dn=zero_level)
        image = sensor.linearize(crop)
        saturation = find_saturation(image, zero_level)
        limit_dn = _limit_readings(sensor, saturation)
        for pixels, its_curves in ((image, curves), (noise_curve.spread_pixels(image), spread_curves)):
            curve = noise_curve.measure_noise_curve(pixels, limit_dn)
            its_curves.append(curve._replace(level=curve.level - zero_level))
        zero_levels.append(zero_level)
        saturations.append(saturation)
        # The readings as they are: only they show the codes of the converter.
        if len(tested_crops) < TESTED_FRAMES:
            tested_crops.append(crop)
    # Noise curves over light, of all crops together and of each kind of pairs.
    curves_by_method, neighbours, faults = {}, "", ""
    if frame_count := sum(curve.level.size > 0 for curve in curves):
        neighbours = f"differences of neighbouring pixels in {count_text(frame_count, 'frame')}"
        faults = _describe_faults(tested_crops, full_scale_dn)
        neighbours += faults
        curves_by_method[neighbours] = _pool(curves)
    zero_level = float(np.median(zero_levels)) if zero_levels else black_dn or 0.0
    sensor = replace(linearizer, black_level_dn=zero_level)
    saturated_sums = np.zeros(2)
    for phrase, image_pairs in pairs.items():
        curve, count, saturated_sums_of_kind = _compare_pairs(image_pairs, sensor)
        curves_by_method[f"differences of {count_text(count, 'pair')} of {phrase}"] = curve
        saturated_sums += saturated_sums_of_kind
    # The levels of these curves are over black.
    fits = ((method, noise_curve.fit_gain(curve, black_dn=0.0)) for method, curve in curves_by_method.items())
    gains = {method: gain for method, gain in fits if gain is not None}
    refusal = ""
    # Noise that pixels share changes with their distance as well, so that only white noise can be tested.
    if neighbours in gains and not faults:
        curve, spread_curve = curves_by_method[neighbours], _pool(spread_curves)
        if not noise_curve.is_gain_of_noise(gains[neighbours], curve, spread_curve):
            del gains[neighbours]
            refusal = FINE_LIGHT
    if noise_curve.is_sharpened([noise_curve.measure_block_noise(_cut_rim(crop)) for crop in tested_crops]):
        gains, refusal = {}, SHARPENED
    best_method = min(gains, key=lambda method: gains[method].gain_stderr / gains[method].gain, default="")
    return SpotEstimates(
        gain=gains.get(best_method),
        method=best_method or refusal,
        saturation=find_common_saturation(saturations),
        saturated_variance=float(saturated_sums[1] / saturated_sums[0]) if saturated_sums[0] else np.nan,
        zero_level_dn=zero_level,
        lowest_zero_level_dn=min(zero_levels, default=zero_level),
    )


def _pool(curves: Sequence[NoiseCurve]) -> NoiseCurve:
    """Return the bins of some noise curves, at least one, in a single curve."""
    return NoiseCurve(*(np.concatenate(columns) for columns in zip(*curves, strict=True)))


def _compare_pairs(
    pairs: Iterable[tuple[np.ndarray, np.ndarray]], sensor: SensorModel
) -> tuple[NoiseCurve, int, np.ndarray]:
    """Return the noise curve over light of pairs of images, the number of pairs, and the sums of `_sum_saturated`.

    `pairs` are images [rows, columns] in DN; `sensor` gives black level, full scale and response curvature. The levels
    of the curve are over black. A tally, see `frame_pairs`, is the sums over pixels from which a curve is computed.
    """
    black_dn, tally, count, saturated_sums = sensor.black_level_dn, EMPTY_TALLY, 0, np.zeros(2)
    for pair in pairs:
        first, second = (sensor.linearize(image) for image in pair)
        saturations = [find_saturation(image, black_dn) for image in (first, second)]
        tally = tally + tally_differences(first, second, black_dn, _limit_readings(sensor, *saturations))
        # The mean is NaN, and no pixel counts, unless both images saturate.
        saturated_sums += _sum_saturated(first, second, black_dn + SATURATED_PART * float(np.mean(saturations)))
        count += 1
    curve = convert_to_curve(tally, black_dn)
    return curve._replace(level=curve.level - black_dn), count, saturated_sums


def _limit_readings(sensor: SensorModel, *saturations: float) -> float:
    """Return the largest linearized reading [DN] with full noise in images that saturate at these levels.

    Levels are over black [DN]; NaN if an image does not saturate. Without any, the limit is full scale.
    """
    limits = [sensor.black_level_dn + FULL_NOISE_PART * level for level in saturations if np.isfinite(level)]
    return float(min([sensor.without_curvature().full_scale_dn, *limits]))


def _describe_faults(images: Sequence[np.ndarray], full_scale_dn: float) -> str:
    """Return faults of differences of neighbouring pixels, to be appended to the name of the method; "" without faults.

    `images` are [rows, columns] in DN. Noise counts as correlated only if it is correlated in half of the images or
    more: by chance it seems so in one.
    """
    missing_codes = find_missing_codes(images)
    correlations = [noise_curve.measure_noise_correlation(image, full_scale_dn) for image in images]
    text = f"; {len(missing_codes)} codes are never read, as a look-up table skips them" if missing_codes else ""
    if sum(correlation.is_white for correlation in correlations) <= len(correlations) / 2:
        range_px = int(np.median([correlation.range_px for correlation in correlations]))
        text += f"; pixels share noise over {range_px} px, as in compressed frames, so it is not that of single pixels"
    return text


def _cut_rim(image: np.ndarray) -> np.ndarray:
    """Return an image [rows, columns] in DN with NaN in place of its spot."""
    rows, columns = (max(1, round(SHARP_RIM * side)) for side in image.shape)
    rim = np.array(image, float)
    rim[rows:-rows, columns:-columns] = np.nan
    return rim


def _sum_saturated(first: np.ndarray, second: np.ndarray, limit_dn: float) -> np.ndarray:
    """Return two sums over the saturated pixels of two images [rows, columns]: their number, and their variances [DN²].

    Saturated pixels read more than `limit_dn` [DN] in both images. Their common variance is estimated from the median
    squared difference, since a minority of them is not saturated. Both sums are 0 if there are none.
    """
    is_saturated = np.minimum(first, second) > limit_dn
    if not is_saturated.any():
        return np.zeros(2)
    # A squared difference is 2 variance χ² with one degree of freedom.
    variance = float(np.median((second - first)[is_saturated] ** 2)) / 2 / chi2.median(1)
    return is_saturated.sum() * np.array([1.0, variance])


def measure_rim(image: np.ndarray) -> float:
    """Return the median reading [DN] of the rim of an image [rows, columns]; NaN pixels do not count.

    If all of the rim is NaN, it is that of the area that is not; NaN only if all pixels are.
    """
    rim_rows, rim_columns = (max(1, round(RIM * side)) for side in image.shape)
    is_rim = np.ones(image.shape, bool)
    is_rim[rim_rows:-rim_rows, rim_columns:-rim_columns] = False
    is_known = np.isfinite(image)
    if not (is_rim & is_known).any():
        is_rim = ~binary_erosion(is_known, iterations=max(rim_rows, rim_columns))
    return float(np.median(image[is_rim & is_known])) if is_known.any() else np.nan


def find_saturation(image: np.ndarray, black_dn: float) -> float:
    """Return the level over black [DN] at which the readings of a spot saturate; NaN if they do not.

    A Gaussian spot has equally many pixels in each step of ln level. A step near the top with many more is saturation.

    Parameters
    ----------
    image : image of the spot [rows, columns] in DN; NaN pixels do not count.
    black_dn : black level [DN].
    """
    level = image[np.isfinite(image)] - black_dn
    brightest = float(np.quantile(level, BRIGHTEST_QUANTILE)) if level.size else 0.0
    if brightest <= 0:
        return np.nan
    log_level = np.log(level[level > FLANK[0] * brightest] / brightest)
    flank_start, flank_end = np.log(FLANK)
    edges = np.arange(flank_start, BINS_END, BIN_WIDTH)
    counts, _ = np.histogram(log_level, edges)
    flank_counts = counts[edges[1:] <= flank_end]
    fullest = int(np.argmax(counts))
    has_no_peak = counts[fullest] < MIN_PEAK_RATIO * flank_counts.mean()
    if flank_counts.sum() < MIN_COUNT or has_no_peak or edges[fullest] < flank_end:
        return np.nan
    is_near_peak = np.abs(log_level - edges[fullest] - BIN_WIDTH / 2) < PEAK_BINS * BIN_WIDTH
    return float(brightest * np.exp(np.median(log_level[is_near_peak])))


def find_common_saturation(saturations: Sequence[float]) -> tuple[float, float] | None:
    """Return the level over black [DN] at which most saturating spots saturate, and its standard error.

    It is None if fewer than two spots saturate, or if their levels differ, as those of plateaus of the light do.
    `saturations` has the level of each spot [DN], NaN if it does not saturate.
    """
    known = np.array([level for level in saturations if np.isfinite(level)])
    if len(known) < MIN_AGREEING:
        return None
    median = float(np.median(known))
    agreeing = known[np.abs(known - median) < AGREEMENT * median]
    if len(agreeing) < max(MIN_AGREEING, MIN_AGREEING_PART * len(known)):
        return None
    return float(agreeing.mean()), float(agreeing.std(ddof=1) / np.sqrt(len(agreeing)))
