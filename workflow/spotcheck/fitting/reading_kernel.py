"""The compiled kernel of the spot fit: score and Fisher information of a reading on its mean electrons, pixel by pixel.

The score is ∂ ln P/∂ν [1/e-] with the mean electrons ν of a pixel, light and dark current together. Functions fill
`weight` and `score` of a row of pixels and return χ² with the number of pixels in it. NaN readings are masked: their
weight and score are 0. Readings next to a clip have weight and score but no part in χ².

The kernel approximates `spotcheck.sensor.ReadingDistribution` with a negligible effect on fits (docs, "How a spot is
fitted"):

- faint light: the tables of `sensor.faint`, between whose levels a probability is a cubic;
- bright light: a Poisson distribution that is shifted by the variance of read noise and rounding, σ² + 1/(12 K²);
- near full scale: a normal reading, and at full scale the probability of being clipped;
- near the full well: normal electrons cut at the well, plus normal read noise.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.sensor.faint import IMPROBABLE, FaintTable, tabulate_between_codes, tabulate_faint_light
from spotcheck.sensor.pixel_maps import PixelMaps

# Standard deviations from a clip (black, full scale, full well) beyond which it has no effect.
FAR = 6.0
# A reading less likely than this (7 standard deviations off) is scored by the normal law. The model does not explain
# it, and its exact score grows without bounds and would outweigh all others.
UNLIKELY = 1e-12
# The faint table ends where mean, variance and information of a reading equal those of the plain law, the shifted
# Poisson distribution: the mean to this fraction of a standard deviation, the others to this relative difference.
MEAN_TOLERANCE, PLAIN_TOLERANCE = 1e-3, 0.02
# Least information of a reading [1/e-²], so that its reciprocal is finite.
LEAST_INFORMATION = 1e-12

# 1/√(2π) and 1/√2.
INVERSE_SQRT_2PI, INVERSE_SQRT_2 = 0.3989422804014327, 0.7071067811865476

# Sums may be taken in any order and divisions need no check for 0: both let the compiler use vector instructions. NaN
# keeps its meaning, as it marks masked pixels.
compiled = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})


class KernelMaps(NamedTuple):
    """Maps of an image's pixels in the form of the compiled code."""

    offsets: np.ndarray  # excess of each pixel over the black level [row, column] in DN
    gains: np.ndarray  # relative gain of each pixel [row, column]
    offset_variance: float  # variance of the error of an offset [e-²]
    gain_variance: float  # variance of the error of a gain [1]
    fine: "ReadingLaw"  # law with finer DN, for faint readings less an offset (`tabulate_between_codes`)


class ReadingLaw(NamedTuple):
    """The distribution of a reading in the form of the compiled code: constants of the sensor and its faint table.

    A law with maps has another type for the compiler, so passes without maps are not slowed down by them.
    """

    gain: float  # K [DN/e-]
    read_variance: float  # variance of the read noise [e-²]
    rounding_variance: float  # variance of the rounding [e-²]
    black_level: float  # black level [DN]
    full_scale: float  # largest reading [DN]
    full_well: float  # full well [e-]
    lowest_level: float  # mean electrons of the first level of the table [e-]
    step: float  # distance between levels [e-]
    highest_level: float  # mean electrons of the last level [e-]
    probability: np.ndarray  # probability of each reading [level, reading]
    slope: np.ndarray  # its derivative by the mean electrons, times the step [level, reading]
    inverse_information: np.ndarray  # reciprocal of the Fisher information [level, e-²]
    reading_mean: np.ndarray  # mean reading [level, DN]
    reading_variance: np.ndarray  # variance of the reading [level, DN²]
    maps: KernelMaps | None = None  # maps of the image's pixels


def build_reading_law(sensor: SensorModel | None, maps: PixelMaps | None = None) -> ReadingLaw:
    """Return the law of `linearize`d readings of a sensor (`SensorModel.without_curvature`).

    Parameters
    ----------
    sensor : model of the sensor; without it the law is a placeholder that passes with equal weights do not use.
    maps : offsets and gains of an image's pixels.
    """
    if sensor is None:
        table, column = np.ones((2, 2)), np.ones(2)
        return ReadingLaw(1.0, 0.0, 0.0, 0.0, np.inf, np.inf, 0.0, 1.0, 0.0, table, table, column, column, column)
    sensor = sensor.without_curvature()
    plain = _tabulate_law(sensor, tabulate_faint_light(sensor), ROUNDING_VARIANCE / sensor.gain_dn_per_e**2)
    if maps is None:
        return plain
    offsets, gains = (np.ascontiguousarray(values, float) for values in (maps.offset_dn, maps.gain))
    offset_variance = (float(maps.offset_stderr_dn) / plain.gain) ** 2
    fine = _tabulate_law(*tabulate_between_codes(sensor, offset_variance), plain.rounding_variance)
    return plain._replace(maps=KernelMaps(offsets, gains, offset_variance, float(maps.gain_stderr) ** 2, fine))


def _tabulate_law(sensor: SensorModel, table: FaintTable, rounding: float) -> ReadingLaw:
    """Return the law without maps from a table of faint light; `rounding` is the variance of the rounding [e-²]."""
    gain, read_variance = sensor.gain_dn_per_e, sensor.read_noise_e**2
    is_possible = table.probability > IMPROBABLE
    terms = table.slope**2 / np.where(is_possible, table.probability, 1.0)
    information = np.sum(np.where(is_possible, terms, 0.0), axis=1)
    # Between levels 1/I is nearly straight: ν + σ² where nothing clips.
    inverse_information = 1 / np.clip(information, LEAST_INFORMATION, None)
    if read_variance == 0:
        # Without light and noise every reading is certain and the sum above is 0/0; this is its limit.
        inverse_information[0] = max(2 * inverse_information[1] - inverse_information[2], 1e-9)
    # A reading that is certain has no variance; that of the rounding is the least.
    reading_variance = np.maximum(table.variance, ROUNDING_VARIANCE)
    # Above the last level that differs from the plain law, that law is used, which is faster.
    plain_variance = np.maximum(table.levels, 0.0) + read_variance + rounding
    bias = np.abs(table.mean - gain * table.levels - sensor.black_level_dn) / np.sqrt(reading_variance)
    differs = (bias > MEAN_TOLERANCE) | (np.abs(reading_variance / gain**2 / plain_variance - 1) > PLAIN_TOLERANCE)
    differs |= plain_variance > (1 + PLAIN_TOLERANCE) * inverse_information
    # One level more, and at least two, to interpolate between; levels below one electron are always in the table.
    needed_levels = max(int(np.flatnonzero(differs | (table.levels < 1.0))[-1]) + 2, 2)
    kept = slice(0, min(needed_levels, len(plain_variance)))
    # In the order of the fields of `ReadingLaw`.
    constants = (gain, read_variance, rounding, sensor.black_level_dn, sensor.full_scale_dn, sensor.full_well_e)
    levels = (table.lowest_e, table.step_e, table.levels[kept][-1])
    probability, slope = np.ascontiguousarray(table.probability[kept]), np.ascontiguousarray(table.slope[kept])
    arrays = (probability, slope * table.step_e, inverse_information[kept], table.mean[kept], reading_variance[kept])
    # All numbers are floats: an integer would be another type, for which everything is compiled again.
    return ReadingLaw._make([*map(float, constants + levels), *arrays, None])


@compiled
def find_clipping_onset(law):
    """Return the mean electrons [e-] below which neither the full well nor full scale has an effect."""
    # Electrons from which on the signal is clipped.
    top = min((law.full_scale - 0.5 - law.black_level) / law.gain, law.full_well)
    if top == np.inf:
        return np.inf
    # The solution ν of ν + FAR √(ν + noise) = top.
    noise = law.read_variance + law.rounding_variance
    return top - FAR * math.sqrt(max(top + noise + FAR * FAR / 4, 0.0)) + FAR * FAR / 2 if top > 0 else -np.inf


@compiled
def _normal_hazard(a):
    """Return φ(a)/Q(a), the hazard function of the standard normal distribution: density over upper tail."""
    if a > 25.0:
        # Asymptotic series in 1/a², accurate to 1e-11; φ and Q underflow for larger a.
        b = 1.0 / (a * a)
        return a + (1.0 - b * (2.0 - b * (10.0 - b * (74.0 - 706.0 * b)))) / a
    return math.exp(-a * a / 2) * INVERSE_SQRT_2PI / (0.5 * math.erfc(a * INVERSE_SQRT_2))


@compiled
def _clipped_information(a):
    """Return the information on the mean of a standard normal number that is cut at a distance a above its mean.

    It is that of the numbers below, and of the probability of being clipped.
    """
    pdf = math.exp(-a * a / 2) * INVERSE_SQRT_2PI
    return max(0.5 * math.erfc(-a * INVERSE_SQRT_2) - pdf * (a - _normal_hazard(a)), 0.0)


@compiled
def _score_normal(residual, variance, a, is_clipped, direction):
    """Return score [1/e-], information [1/e-²] and χ² of a normal reading, which is clipped or not.

    `residual` is the reading less its mean [e-]. The clip is at a distance of `a` standard deviations from the mean, in
    the `direction` 1 (above) or −1 (below). χ² is −1 next to a clip: the pixel then has no part in χ².
    """
    if a > FAR and not is_clipped:
        return residual / variance, 1.0 / variance, residual * residual / variance
    score = direction * _normal_hazard(a) / math.sqrt(variance) if is_clipped else residual / variance
    return score, _clipped_information(a) / variance, -1.0


@compiled
def _score_bright(reading, electrons, law):
    """Return score [1/e-], information [1/e-²] and χ² of a reading [DN] with mean `electrons` above the faint table.

    The reading is Poisson, shifted by the variance of read noise and rounding; at full scale it is scored by the
    probability of being clipped.
    """
    variance = electrons + law.read_variance + law.rounding_variance
    signal = (reading - law.black_level) / law.gain
    residual = signal - electrons
    if electrons > law.full_well - FAR * math.sqrt(law.full_well) or signal > law.full_well - FAR * math.sqrt(
        law.read_variance + law.rounding_variance
    ):
        return _score_near_well(signal, electrons, law)
    # Distance of the mean from full scale in standard deviations.
    a = ((law.full_scale - 0.5 - law.black_level) / law.gain - electrons) / math.sqrt(variance)
    return _score_normal(residual, variance, a, reading >= law.full_scale, 1.0)


@compiled
def _score_near_well(signal, electrons, law):
    """Return the same as `_score_bright` near the full well, for a signal [e-] of mean `electrons`.

    The density of the signal is that of electrons below the well with read noise, plus a peak at the well that has the
    weight P(n ≥ well). The derivative neglects the change of the density's width with the mean.
    """
    noise = law.read_variance + law.rounding_variance
    sd = math.sqrt(electrons)
    total = electrons + noise
    # Mean and standard deviation of the electrons given the signal.
    middle, width = (electrons * noise + signal * electrons) / total, math.sqrt(electrons * noise / total)
    # Distance from the well in standard deviations, given the signal and without it.
    u, w = (law.full_well - middle) / width, (law.full_well - electrons) / sd
    # Density of the signal, times √(2π), without a well; the parts of electrons below the well and at it.
    density = math.exp(-((signal - electrons) ** 2) / (2 * total)) / math.sqrt(total)
    below = density * 0.5 * math.erfc(-u * INVERSE_SQRT_2)
    peak = math.exp(-((signal - law.full_well) ** 2) / (2 * noise)) / math.sqrt(noise)
    at_well = peak * 0.5 * math.erfc(w * INVERSE_SQRT_2)
    slope = below * (signal - electrons) / total
    slope -= density * math.exp(-u * u / 2) * INVERSE_SQRT_2PI * (noise / total) / width
    slope += peak * math.exp(-w * w / 2) * INVERSE_SQRT_2PI / sd
    information = _clipped_information(w) / total
    # Both parts underflow far from the mean: the reading is then scored by the normal law.
    if below + at_well < 1e-280:
        return (signal - electrons) / total, information, -1.0
    return slope / (below + at_well), information, -1.0


@compiled
def _score_faint(reading, electrons, law):
    """Return score [1/e-], information [1/e-²] and χ² of a reading [DN] of mean `electrons` from the faint table.

    Between two levels P is the cubic with their values and slopes; the score is the derivative of its logarithm.
    """
    position = (electrons - law.lowest_level) / law.step
    if position < 0.0:
        return _score_below_table(reading, electrons, law)
    # Level below the mean, and distance from it in steps.
    i = min(int(position), law.inverse_information.size - 2)
    f = position - i
    y = int(reading + 0.5)
    information = 1 / ((1 - f) * law.inverse_information[i] + f * law.inverse_information[i + 1])
    residual = reading - (1 - f) * law.reading_mean[i] - f * law.reading_mean[i + 1]
    chi2 = residual * residual / ((1 - f) * law.reading_variance[i] + f * law.reading_variance[i + 1])
    if y < law.probability.shape[1]:
        # Probabilities p, q of the reading at both levels, and their slopes s, t per step.
        p, q, s, t = law.probability[i, y], law.probability[i + 1, y], law.slope[i, y], law.slope[i + 1, y]
        rise = q - p
        probability = p + f * (s + f * (3 * rise - 2 * s - t + f * (s + t - 2 * rise)))
        slope = s + f * (2 * (3 * rise - 2 * s - t) + 3 * f * (s + t - 2 * rise))
        if probability > 0.1 * min(p, q) and probability > UNLIKELY:
            return slope / (probability * law.step), information, chi2
        # For a reading of many electrons where none is expected, the cubic can become negative: use straight lines.
        probability = (1 - f) * p + f * q
        if probability > UNLIKELY:
            return ((1 - f) * s + f * t) / (probability * law.step), information, chi2
    # An improbable reading is scored by the normal law.
    signal = (reading - law.black_level) / law.gain
    return (signal - electrons) / (max(electrons, 0.0) + law.read_variance + law.rounding_variance), information, chi2


@compiled
def _score_below_table(reading, electrons, law):
    """Return the same as `_score_faint` for a mean below the table, as with a black level that is stated too high.

    The reading has read noise alone, and the probability of being clipped at 0.
    """
    variance = law.read_variance + law.rounding_variance
    residual = (reading - law.black_level) / law.gain - electrons
    # Distance of the mean from the clip in standard deviations.
    a = (electrons + (law.black_level - 0.5) / law.gain) / math.sqrt(variance)
    score, information, chi2 = _score_normal(residual, variance, a, reading <= 0.0, -1.0)
    return score, max(information, LEAST_INFORMATION), chi2


@compiled
def compute_pixel_information(electrons, law):
    """Return the information [pixel] in 1/e-² of readings on their mean `electrons` [pixel]."""
    information = np.empty(electrons.size)
    for k in range(electrons.size):
        reading = 0.0 if electrons[k] < law.highest_level else law.black_level + law.gain * electrons[k]
        _, information[k], _ = _score_pixel(reading, electrons[k], law)
    return information


@compiled
def score_row_equally(readings, mean, weight, score):
    """Fill a row with the weight 1 and the score reading − mean [DN]; return Σ residual² [DN²] and its pixel count.

    All arrays are [column]; `readings` and `mean` are in DN.
    """
    squares, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        is_known = reading == reading  # False for NaN
        weight[k] = 1.0 if is_known else 0.0
        score[k] = reading - mean[k] if is_known else 0.0
        squares += score[k] * score[k]
        used += is_known
    return squares, used


@compiled
def _score_row_plain(readings, electrons, law, weight, score):
    """As `score_row_by_likelihood`, for a row without pixels near a clip or in the faint table (shifted Poisson)."""
    chi2, used = 0.0, 0
    noise, e_per_dn, black_e = law.read_variance + law.rounding_variance, 1 / law.gain, law.black_level / law.gain
    for k in range(readings.size):
        reading = float(readings[k])
        is_known = reading == reading  # False for NaN
        information = 1 / (electrons[k] + noise)
        residual = reading * e_per_dn - black_e - electrons[k]
        weight[k] = information if is_known else 0.0
        score[k] = residual * information if is_known else 0.0
        chi2 += residual * residual * information if is_known else 0.0
        used += is_known
    return chi2, used


@compiled
def score_row_by_likelihood(readings, electrons, is_plain, row, maps, law, weight, score):
    """Fill `weight` with the information [1/e-²] and `score` [1/e-] of a row; return χ² and its number of pixels.

    `readings` [DN], mean `electrons` [e-], `weight` and `score` are [column]. `is_plain` says that no pixel is near a
    clip or in the faint table. `row` is the index of the row in the maps. `maps` is `law.maps`, passed by itself so
    that the compiler knows whether there are maps.
    """
    if maps is None and is_plain:
        return _score_row_plain(readings, electrons, law, weight, score)
    total_chi2, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        if reading != reading:  # NaN
            weight[k] = score[k] = 0.0
            continue
        if maps is None:
            score[k], weight[k], chi2 = _score_pixel(reading, electrons[k], law)
        else:
            gain, offset = maps.gains[row, k], maps.offsets[row, k]
            score[k], weight[k], chi2 = _score_mapped_pixel(reading, electrons[k], gain, offset, maps, law)
        if chi2 >= 0.0:
            total_chi2 += chi2
            used += 1
    return total_chi2, used


@compiled
def _score_pixel(reading, electrons, law):
    """Return score [1/e-], information [1/e-²] and χ² (−1 next to a clip) of a reading [DN] of mean `electrons`."""
    if electrons < law.highest_level:
        return _score_faint(reading, electrons, law)
    return _score_bright(reading, electrons, law)


@compiled
def _score_mapped_pixel(reading, electrons, gain, offset, maps, law):
    """Return the same as `_score_pixel` for a pixel with a relative gain and an offset [DN] of its own.

    The mean electrons of the pixel are its gain times `electrons`, which are those of a pixel with the gain 1; score
    and information are on the latter. Errors of the maps count as noise.

    # ASSUME: no reading is clipped at 0, as no map is made from darks that read 0.
    """
    mean_e = gain * electrons
    gain_noise = maps.gain_variance * mean_e * mean_e
    if mean_e < maps.fine.highest_level:
        signal = (reading - law.black_level - offset) / law.gain
        score, information, chi2 = _score_faint_between(signal, mean_e, maps.fine)
        # The variance 1/information of the signal grows by that of the gain.
        share = 1 / (1 + gain_noise * information)
        score, information, chi2 = share * score, share * information, share * chi2
    else:
        score, information, chi2 = _score_bright(
            reading, mean_e, _shift_law(law, offset, maps.offset_variance + gain_noise)
        )
    return gain * score, gain * gain * information, chi2


@compiled
def _shift_law(law, offset, added_variance):
    """Return the law of a pixel whose black level is higher by `offset` [DN], with more read-noise variance [e-²]."""
    return ReadingLaw(
        law.gain, law.read_variance + added_variance, law.rounding_variance, law.black_level + offset, law.full_scale,
        law.full_well, law.lowest_level, law.step, law.highest_level, law.probability, law.slope,
        law.inverse_information, law.reading_mean, law.reading_variance, None,
    )  # fmt: skip


@compiled
def _score_faint_between(signal, electrons, fine):
    """Return the same as `_score_faint` for a signal [e-] that is no whole number of DN, by a law with finer DN.

    The score is interpolated between two readings of the law `fine`, where it is nearly linear.
    """
    fine_reading = max(fine.gain * signal + fine.black_level, 0.0)
    lower = math.floor(fine_reading)
    lower_score, information, _ = _score_faint(lower, electrons, fine)
    upper_score, _, _ = _score_faint(lower + 1.0, electrons, fine)
    _, _, chi2 = _score_faint(fine_reading, electrons, fine)
    return lower_score + (fine_reading - lower) * (upper_score - lower_score), information, chi2


@compiled
def compute_row_variances(readings, mean, electrons, law, weight, score):
    """Fill a row with the variance [DN²] of each reading as weight and with the score 0; return χ² and its pixel count.

    The variance includes both clips and rounding. `readings` and `mean` are in DN, `electrons` is the same mean in e-.
    """
    chi2, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        score[k] = 0.0
        if reading != reading:  # NaN
            weight[k] = 0.0
            continue
        if electrons[k] < law.highest_level:
            position = max((electrons[k] - law.lowest_level) / law.step, 0.0)
            i = min(int(position), law.inverse_information.size - 2)
            rise = law.reading_variance[i + 1] - law.reading_variance[i]
            variance = law.reading_variance[i] + (position - i) * rise
        else:
            top = min(law.full_scale, law.black_level + law.gain * law.full_well)
            unclipped_variance = law.gain**2 * (electrons[k] + law.read_variance + law.rounding_variance)
            variance = unclipped_variance * _clipped_normal_variance((top - mean[k]) / math.sqrt(unclipped_variance))
        # A clipped pixel has no variance; that of the rounding is the least.
        weight[k] = max(variance, ROUNDING_VARIANCE)
        chi2 += (reading - mean[k]) ** 2 / weight[k]
        used += 1
    return chi2, used


@compiled
def _clipped_normal_variance(a):
    """Return the variance of min(z, a), where z is a standard normal number and a the clip."""
    if a > FAR:
        return 1.0
    # Density at the clip, and probability of being clipped.
    pdf, tail = math.exp(-a * a / 2) * INVERSE_SQRT_2PI, 0.5 * math.erfc(a * INVERSE_SQRT_2)
    mean = a * tail - pdf
    # Mean square less the square of the mean; rounding may make the difference negative.
    return max(a * a * tail + (1 - tail) - a * pdf - mean * mean, 0.0)
