"""The compiled kernel of the spot fit: score and Fisher information of a reading on its mean electrons, pixel by pixel.

It approximates `spotcheck.sensor.ReadingDistribution` with a negligible effect on fits (docs, "How a spot is fitted"):

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

# Distance to a clip in standard deviations beyond which it has no effect.
FAR = 6.0
# A reading less likely than this (7 standard deviations off) is scored by the normal law. The model does not explain
# it, and its exact score grows without bounds and would outweigh all others.
UNLIKELY = 1e-12
# The faint table ends where mean, variance and information of a reading equal those of the plain law: the mean to this
# fraction of a standard deviation, the others to this relative difference.
MEAN_TOLERANCE, PLAIN_TOLERANCE = 1e-3, 0.02

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
    step: float  # distance of the levels [e-]
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
    """Return the law without maps; `rounding` is the variance of the rounding [e-²]."""
    gain, read_variance = sensor.gain_dn_per_e, sensor.read_noise_e**2
    is_possible = table.probability > IMPROBABLE
    terms = table.slope**2 / np.where(is_possible, table.probability, 1.0)
    information = np.sum(np.where(is_possible, terms, 0.0), axis=1)
    # Between levels 1/I is nearly straight: ν + σ² where nothing clips.
    inverse = 1 / np.clip(information, 1e-12, None)
    if read_variance == 0:
        # Without light and noise every reading is certain and the sum above is 0/0; this is its limit.
        inverse[0] = max(2 * inverse[1] - inverse[2], 1e-9)
    # A reading that is certain has no variance; that of the rounding is the least.
    spread = np.maximum(table.variance, ROUNDING_VARIANCE)
    # Above the last level that differs from the plain law, that law is used, which is faster.
    variance = np.maximum(table.levels, 0.0) + read_variance + rounding
    bias = np.abs(table.mean - gain * table.levels - sensor.black_level_dn) / np.sqrt(spread)
    differs = (bias > MEAN_TOLERANCE) | (np.abs(spread / gain**2 / variance - 1) > PLAIN_TOLERANCE)
    differs |= variance > (1 + PLAIN_TOLERANCE) * inverse
    needed = max(int(np.flatnonzero(differs | (table.levels < 1.0))[-1]) + 2, 2)
    keep = slice(0, min(needed, len(variance)))
    return ReadingLaw(
        # All numbers are floats: an integer would be another type, for which everything is compiled again.
        float(gain),
        float(read_variance),
        float(rounding),
        float(sensor.black_level_dn),
        float(sensor.full_scale_dn),
        float(sensor.full_well_e),
        float(table.lowest_e),
        float(table.step_e),
        float(table.levels[keep][-1]),
        np.ascontiguousarray(table.probability[keep]),
        np.ascontiguousarray(table.slope[keep]) * table.step_e,
        inverse[keep],
        table.mean[keep],
        spread[keep],
    )


@compiled
def find_clipping_onset(law):
    """Return the mean electrons [e-] below which neither the full well nor full scale has an effect."""
    top = min((law.full_scale - 0.5 - law.black_level) / law.gain, law.full_well)
    if top == np.inf:
        return np.inf
    # ν + 6 √(ν + noise) = top
    noise = law.read_variance + law.rounding_variance
    return top - FAR * math.sqrt(max(top + noise + FAR * FAR / 4, 0.0)) + FAR * FAR / 2 if top > 0 else -np.inf


@compiled
def _normal_hazard(a):
    """Return φ(a)/Q(a), the hazard function of the standard normal distribution."""
    if a > 25.0:
        # Asymptotic series, accurate to 1e-11; φ and Q underflow for larger a.
        b = 1.0 / (a * a)
        return a + (1.0 - b * (2.0 - b * (10.0 - b * (74.0 - 706.0 * b)))) / a
    return math.exp(-a * a / 2) * INVERSE_SQRT_2PI / (0.5 * math.erfc(a * INVERSE_SQRT_2))


@compiled
def _score_bright(reading, electrons, law):
    """Return score [1/e-], information [1/e-²] and χ² (−1 next to a clip) of a reading above the faint table.

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
    sd = math.sqrt(variance)
    a = ((law.full_scale - 0.5 - law.black_level) / law.gain - electrons) / sd
    if a > FAR and reading < law.full_scale:
        return residual / variance, 1.0 / variance, residual * residual / variance
    hazard = _normal_hazard(a)
    pdf = math.exp(-a * a / 2) * INVERSE_SQRT_2PI
    information = (0.5 * math.erfc(-a * INVERSE_SQRT_2) - pdf * (a - hazard)) / variance
    score = hazard / sd if reading >= law.full_scale else residual / variance
    return score, max(information, 0.0), -1.0


@compiled
def _score_near_well(signal, electrons, law):
    """Return the same as `_score_bright` near the full well: electrons cut at the well, plus read noise.

    The density of the reading is that of electrons below the well with their noise, plus a peak at the well of weight
    P(n ≥ well). The derivative neglects the change of its width.
    """
    noise = law.read_variance + law.rounding_variance
    sd = math.sqrt(electrons)
    total = electrons + noise
    # Mean and standard deviation of the electrons given the reading.
    middle, width = (electrons * noise + signal * electrons) / total, math.sqrt(electrons * noise / total)
    u, w = (law.full_well - middle) / width, (law.full_well - electrons) / sd
    density = math.exp(-((signal - electrons) ** 2) / (2 * total)) / math.sqrt(total)
    below = density * 0.5 * math.erfc(-u * INVERSE_SQRT_2)
    peak = math.exp(-((signal - law.full_well) ** 2) / (2 * noise)) / math.sqrt(noise)
    above = peak * 0.5 * math.erfc(w * INVERSE_SQRT_2)
    slope = below * (signal - electrons) / total
    slope -= density * math.exp(-u * u / 2) * INVERSE_SQRT_2PI * (noise / total) / width
    slope += peak * math.exp(-w * w / 2) * INVERSE_SQRT_2PI / sd
    pdf = math.exp(-w * w / 2) * INVERSE_SQRT_2PI
    information = (0.5 * math.erfc(-w * INVERSE_SQRT_2) - pdf * (w - _normal_hazard(w))) / total
    if below + above < 1e-280:
        return (signal - electrons) / total, max(information, 0.0), -1.0
    return slope / (below + above), max(information, 0.0), -1.0


@compiled
def _score_faint(reading, electrons, law):
    """Return score, information and χ² of a reading from the faint table.

    Between two levels P is the cubic with their values and slopes; the score is the derivative of its logarithm.
    """
    at = (electrons - law.lowest_level) / law.step
    if at < 0.0:
        return _score_below_table(reading, electrons, law)
    i = min(int(at), law.inverse_information.size - 2)
    f = at - i
    y = int(reading + 0.5)
    information = 1 / ((1 - f) * law.inverse_information[i] + f * law.inverse_information[i + 1])
    residual = reading - (1 - f) * law.reading_mean[i] - f * law.reading_mean[i + 1]
    chi2 = residual * residual / ((1 - f) * law.reading_variance[i] + f * law.reading_variance[i + 1])
    if y < law.probability.shape[1]:
        p, q, s, t = law.probability[i, y], law.probability[i + 1, y], law.slope[i, y], law.slope[i + 1, y]
        rise = q - p
        chance = p + f * (s + f * (3 * rise - 2 * s - t + f * (s + t - 2 * rise)))
        slope = s + f * (2 * (3 * rise - 2 * s - t) + 3 * f * (s + t - 2 * rise))
        if chance > 0.1 * min(p, q) and chance > UNLIKELY:
            return slope / (chance * law.step), information, chi2
        # With many electrons where none is expected, the cubic can become negative.
        chance = (1 - f) * p + f * q
        if chance > UNLIKELY:
            return ((1 - f) * s + f * t) / (chance * law.step), information, chi2
    signal = (reading - law.black_level) / law.gain
    return (signal - electrons) / (max(electrons, 0.0) + law.read_variance + law.rounding_variance), information, chi2


@compiled
def _score_below_table(reading, electrons, law):
    """Return the same as `_score_faint` for a mean below the table, as with a black level that is stated too high.

    The reading has read noise alone, and the probability of being clipped at black.
    """
    variance = law.read_variance + law.rounding_variance
    sd = math.sqrt(variance)
    residual = (reading - law.black_level) / law.gain - electrons
    a = (electrons + (law.black_level - 0.5) / law.gain) / sd
    if a > FAR and reading > 0.0:
        return residual / variance, 1.0 / variance, residual * residual / variance
    hazard, pdf = _normal_hazard(a), math.exp(-a * a / 2) * INVERSE_SQRT_2PI
    information = (0.5 * math.erfc(-a * INVERSE_SQRT_2) - pdf * (a - hazard)) / variance
    return (-hazard / sd if reading <= 0.0 else residual / variance), max(information, 1e-12), -1.0


@compiled
def compute_pixel_information(electrons, law):
    """Return the information [1/e-²] of readings on their mean `electrons` [pixels]."""
    information = np.empty(electrons.size)
    for k in range(electrons.size):
        if electrons[k] < law.highest_level:
            _, information[k], _ = _score_faint(0.0, electrons[k], law)
        else:
            _, information[k], _ = _score_bright(law.black_level + law.gain * electrons[k], electrons[k], law)
    return information


@compiled
def score_row_equally(readings, mean, weight, score):
    """Fill weight 1 and score y − µ [DN] of a row, 0 for masked pixels; return Σ residual² [DN²] and its pixels."""
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        known = reading == reading
        weight[k] = 1.0 if known else 0.0
        score[k] = reading - mean[k] if known else 0.0
        total += score[k] * score[k]
        used += known
    return total, used


@compiled
def _score_row_plain(readings, electrons, law, weight, score):
    """Fill a row without pixels near a clip or in the faint table (shifted Poisson); return χ² and its pixels."""
    total, used = 0.0, 0
    noise, per_dn, dark = law.read_variance + law.rounding_variance, 1 / law.gain, law.black_level / law.gain
    for k in range(readings.size):
        reading = float(readings[k])
        known = reading == reading
        w = 1 / (electrons[k] + noise)
        residual = reading * per_dn - dark - electrons[k]
        weight[k] = w if known else 0.0
        score[k] = residual * w if known else 0.0
        total += residual * residual * w if known else 0.0
        used += known
    return total, used


@compiled
def _score_row_mixed(readings, electrons, law, weight, score):
    """Fill any other row without maps, pixel by pixel; return χ² and its pixels."""
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        if reading != reading:
            weight[k] = score[k] = 0.0
            continue
        if electrons[k] < law.highest_level:
            score[k], weight[k], chi2 = _score_faint(reading, electrons[k], law)
        else:
            score[k], weight[k], chi2 = _score_bright(reading, electrons[k], law)
        if chi2 >= 0.0:
            total += chi2
            used += 1
    return total, used


@compiled
def score_row_by_likelihood(readings, electrons, is_plain, row, maps, law, weight, score):
    """Fill `weight` with the information [1/e-²] and `score` [1/e-] of a row; return χ² and its number of pixels.

    `is_plain` says that no pixel is near a clip or in the faint table. The compiler knows whether there are maps.
    """
    if maps is None:
        if is_plain:
            return _score_row_plain(readings, electrons, law, weight, score)
        return _score_row_mixed(readings, electrons, law, weight, score)
    return _score_row_with_maps(readings, electrons, row, maps, law, weight, score)


@compiled
def _score_row_with_maps(readings, electrons, row, maps, law, weight, score):
    """Fill a row of pixels with individual offsets and gains; return χ² and its pixels.

    Mean electrons are the gain times the light above the black level of the pixel. Errors of the maps count as noise.

    # ASSUME: no reading is cut at black: darks that read 0 make no map.
    """
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        if reading != reading:
            weight[k] = score[k] = 0.0
            continue
        gain, offset = maps.gains[row, k], maps.offsets[row, k]
        mean_e = gain * electrons[k]
        gain_noise = maps.gain_variance * mean_e * mean_e
        if mean_e < maps.fine.highest_level:
            signal = (reading - law.black_level - offset) / law.gain
            pixel_score, information, chi2 = _score_faint_between(signal, mean_e, maps.fine)
            share = 1 / (1 + gain_noise * information)
            pixel_score, information, chi2 = share * pixel_score, share * information, share * chi2
        else:
            pixel_law = _shift_law(law, offset, maps.offset_variance + gain_noise)
            pixel_score, information, chi2 = _score_bright(reading, mean_e, pixel_law)
        score[k], weight[k] = gain * pixel_score, gain * gain * information
        if chi2 >= 0.0:
            total += chi2
            used += 1
    return total, used


@compiled
def _shift_law(law, offset, extra):
    """Return the law of a pixel with a higher black level by `offset` [DN] and `extra` variance of read noise [e-²]."""
    return ReadingLaw(
        law.gain, law.read_variance + extra, law.rounding_variance, law.black_level + offset, law.full_scale,
        law.full_well, law.lowest_level, law.step, law.highest_level, law.probability, law.slope,
        law.inverse_information, law.reading_mean, law.reading_variance, None,
    )  # fmt: skip


@compiled
def _score_faint_between(signal, electrons, fine):
    """Return the same as `_score_faint` for a signal [e-] that is no whole number of DN.

    The score is interpolated between two readings of the fine law, where it is nearly linear.
    """
    reading = max(fine.gain * signal + fine.black_level, 0.0)
    low = math.floor(reading)
    before, information, _ = _score_faint(low, electrons, fine)
    after, _, _ = _score_faint(low + 1.0, electrons, fine)
    _, _, chi2 = _score_faint(reading, electrons, fine)
    return before + (reading - low) * (after - before), information, chi2


@compiled
def compute_row_variances(readings, mean, electrons, law, weight, score):
    """Fill `weight` with the variance [DN²] of each reading with both clips and rounding; return χ² and its pixels."""
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        score[k] = 0.0
        if reading != reading:
            weight[k] = 0.0
            continue
        if electrons[k] < law.highest_level:
            at = max((electrons[k] - law.lowest_level) / law.step, 0.0)
            i = min(int(at), law.inverse_information.size - 2)
            variance = law.reading_variance[i] + (at - i) * (law.reading_variance[i + 1] - law.reading_variance[i])
        else:
            top = min(law.full_scale, law.black_level + law.gain * law.full_well)
            normal = law.gain**2 * (electrons[k] + law.read_variance + law.rounding_variance)
            variance = normal * _clipped_normal_variance((top - mean[k]) / math.sqrt(normal))
        # A clipped pixel has no variance; that of the rounding is the least.
        weight[k] = max(variance, ROUNDING_VARIANCE)
        total += (reading - mean[k]) ** 2 / weight[k]
        used += 1
    return total, used


@compiled
def _clipped_normal_variance(b):
    """Return the variance of a standard normal number that is cut at b."""
    if b > FAR:
        return 1.0
    pdf, above = math.exp(-b * b / 2) * INVERSE_SQRT_2PI, 0.5 * math.erfc(b * INVERSE_SQRT_2)
    first = b * above - pdf
    return max(b * b * above + (1 - above) - b * pdf - first * first, 0.0)
