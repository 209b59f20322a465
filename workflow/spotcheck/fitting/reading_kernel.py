"""The compiled kernel of the spot fit: score and Fisher information of a reading on its mean electrons, pixel by pixel.

It approximates `spotcheck.sensor.ReadingDistribution` so closely that no fit can tell (docs, "How a spot is fitted"):

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

# Standardised distance to a clip beyond which it never acts.
FAR = 6.0
# A reading less likely than this (7 standard deviations off) scores by the normal law. It is not the model's: its exact
# score says by how many powers of ten, grows without bounds, and would outweigh all others.
UNLIKELY = 1e-12
# The faint table ends where mean, variance and information of a reading are those of the plain law, the latter two to
# this part.
PLAIN = 0.02

# Sums may be taken in any order and divisions need no check for 0: both let the compiler use vector instructions. NaN
# keeps its meaning, as it marks masked pixels.
compiled = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})


class Maps(NamedTuple):
    """Maps of an image's pixels for the compiled code."""

    offsets: np.ndarray  # how far each pixel reads above the black level [row, column, DN]
    gains: np.ndarray  # gain of each pixel [row, column, 1]
    offset_variance: float  # variance of the error of an offset [e-²]
    gain_variance: float  # variance of the error of a gain [1]
    fine: "Law"  # sensor with finer DN, for faint readings less an offset (`tabulate_between_codes`)


class Law(NamedTuple):
    """A sensor for the compiled code, with its table for faint light.

    With maps it is another type to the compiler, so that passes without them are as fast as if there were none.
    """

    gain: float  # K [DN/e-]
    read_variance: float  # variance of the read noise [e-²]
    rounding: float  # variance of the rounding [e-²]
    black: float  # black level [DN]
    full_scale: float  # largest reading [DN]
    full_well: float  # full well [e-]
    lowest: float  # mean electrons of the first level of the table [e-]
    step: float  # distance of the levels [e-]
    highest: float  # mean electrons of the last level [e-]
    probability: np.ndarray  # probability of each reading [level, reading]
    slope: np.ndarray  # its derivative by the mean electrons, times the step [level, reading]
    inverse: np.ndarray  # reciprocal of the Fisher information [level, e-²]
    mean: np.ndarray  # mean reading [level, DN]
    spread: np.ndarray  # variance of the reading [level, DN²]
    maps: Maps | None = None  # maps of the image's pixels


def law_of(sensor: SensorModel | None, maps: PixelMaps | None = None) -> Law:
    """Return a sensor for the compiled code, with the maps of an image's pixels.

    It is that of `linearize`d readings (`SensorModel.without_curvature`). Without a sensor it is a placeholder, which
    passes with equal weights do not use.
    """
    if sensor is None:
        table, column = np.ones((2, 2)), np.ones(2)
        return Law(1.0, 0.0, 0.0, 0.0, np.inf, np.inf, 0.0, 1.0, 0.0, table, table, column, column, column)
    sensor = sensor.without_curvature()
    plain = _law_of(sensor, tabulate_faint_light(sensor), ROUNDING_VARIANCE / sensor.gain_dn_per_e**2)
    if maps is None:
        return plain
    offsets, gains = (np.ascontiguousarray(values, float) for values in (maps.offset_dn, maps.gain))
    uncertain = (float(maps.offset_stderr_dn) / plain.gain) ** 2
    fine = _law_of(*tabulate_between_codes(sensor, uncertain), plain.rounding)
    return plain._replace(maps=Maps(offsets, gains, uncertain, float(maps.gain_stderr) ** 2, fine))


def _law_of(sensor: SensorModel, table: FaintTable, rounding: float) -> Law:
    gain, read_variance = sensor.gain_dn_per_e, sensor.read_noise_e**2
    likely = table.probability > IMPROBABLE
    information = np.sum(np.where(likely, table.slope**2 / np.where(likely, table.probability, 1.0), 0.0), axis=1)
    # Between levels 1/I is nearly straight: ν + σ² where nothing clips.
    inverse = 1 / np.clip(information, 1e-12, None)
    if read_variance == 0:
        # Without light and noise every reading is certain, and the sum above 0/0: the limit instead.
        inverse[0] = max(2 * inverse[1] - inverse[2], 1e-9)
    # A reading that is certain has no variance; rounding is the least that is left.
    spread = np.maximum(table.variance, ROUNDING_VARIANCE)
    # Above the last level where it matters, the table gives way to the plain law, which is faster.
    variance = np.maximum(table.levels, 0.0) + read_variance + rounding
    bias = np.abs(table.mean - gain * table.levels - sensor.black_level_dn) / np.sqrt(spread)
    matters = (bias > 1e-3) | (np.abs(spread / gain**2 / variance - 1) > PLAIN) | (variance > (1 + PLAIN) * inverse)
    needed = max(int(np.flatnonzero(matters | (table.levels < 1.0))[-1]) + 2, 2)
    keep = slice(0, min(needed, len(variance)))
    return Law(
        # Floats all: an integer among them would be a type of its own, and compiled again.
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
def normal_below(law):
    """Mean electrons below which neither the well nor full scale acts [e-]."""
    top = min((law.full_scale - 0.5 - law.black) / law.gain, law.full_well)
    if top == np.inf:
        return np.inf
    # ν + 6 √(ν + noise) = top
    noise = law.read_variance + law.rounding
    return top - FAR * math.sqrt(max(top + noise + FAR * FAR / 4, 0.0)) + FAR * FAR / 2 if top > 0 else -np.inf


@compiled
def _hazard(a):
    """φ(a)/Q(a) of the standard normal law."""
    if a > 25.0:
        # Its asymptotic series, to 1e-11; further off, φ and Q are too small for numbers.
        b = 1.0 / (a * a)
        return a + (1.0 - b * (2.0 - b * (10.0 - b * (74.0 - 706.0 * b)))) / a
    return math.exp(-a * a / 2) * 0.3989422804014327 / (0.5 * math.erfc(a * 0.7071067811865476))


@compiled
def _bright(reading, electrons, law):
    """Score [1/e-], information [1/e-²] and χ² (−1: next to a clip) of a reading above the faint table.

    Poisson, shifted by the variance of read noise and rounding; at full scale the probability of being clipped.
    """
    variance = electrons + law.read_variance + law.rounding
    signal = (reading - law.black) / law.gain
    residual = signal - electrons
    if electrons > law.full_well - FAR * math.sqrt(law.full_well) or signal > law.full_well - FAR * math.sqrt(
        law.read_variance + law.rounding
    ):
        return _at_well(signal, electrons, law)
    sd = math.sqrt(variance)
    a = ((law.full_scale - 0.5 - law.black) / law.gain - electrons) / sd
    if a > FAR and reading < law.full_scale:
        return residual / variance, 1.0 / variance, residual * residual / variance
    hazard = _hazard(a)
    pdf = math.exp(-a * a / 2) * 0.3989422804014327
    information = (0.5 * math.erfc(-a * 0.7071067811865476) - pdf * (a - hazard)) / variance
    score = hazard / sd if reading >= law.full_scale else residual / variance
    return score, max(information, 0.0), -1.0


@compiled
def _at_well(signal, electrons, law):
    """As `_bright` near the full well: the electrons, cut at the well, plus read noise.

    The reading's density is that of electrons below the well and their noise, plus a peak at the well of weight P(n ≥
    well); its width is left out of the derivative, as everywhere.
    """
    noise = law.read_variance + law.rounding
    sd = math.sqrt(electrons)
    total = electrons + noise
    # Mean and standard deviation of the electrons given the reading.
    middle, width = (electrons * noise + signal * electrons) / total, math.sqrt(electrons * noise / total)
    u, w = (law.full_well - middle) / width, (law.full_well - electrons) / sd
    density = math.exp(-((signal - electrons) ** 2) / (2 * total)) / math.sqrt(total)
    below = density * 0.5 * math.erfc(-u * 0.7071067811865476)
    peak = math.exp(-((signal - law.full_well) ** 2) / (2 * noise)) / math.sqrt(noise)
    above = peak * 0.5 * math.erfc(w * 0.7071067811865476)
    slope = below * (signal - electrons) / total
    slope -= density * math.exp(-u * u / 2) * 0.3989422804014327 * (noise / total) / width
    slope += peak * math.exp(-w * w / 2) * 0.3989422804014327 / sd
    pdf = math.exp(-w * w / 2) * 0.3989422804014327
    information = (0.5 * math.erfc(-w * 0.7071067811865476) - pdf * (w - _hazard(w))) / total
    if below + above < 1e-280:
        return (signal - electrons) / total, max(information, 0.0), -1.0
    return slope / (below + above), max(information, 0.0), -1.0


@compiled
def _faint(reading, electrons, law):
    """Score, information and χ² of a reading from the faint table.

    Between two levels P is the cubic with their values and slopes, and the score that of its logarithm.
    """
    at = (electrons - law.lowest) / law.step
    if at < 0.0:
        return _below(reading, electrons, law)
    i = min(int(at), law.inverse.size - 2)
    f = at - i
    y = int(reading + 0.5)
    information = 1 / ((1 - f) * law.inverse[i] + f * law.inverse[i + 1])
    residual = reading - (1 - f) * law.mean[i] - f * law.mean[i + 1]
    chi2 = residual * residual / ((1 - f) * law.spread[i] + f * law.spread[i + 1])
    if y < law.probability.shape[1]:
        p, q, s, t = law.probability[i, y], law.probability[i + 1, y], law.slope[i, y], law.slope[i + 1, y]
        rise = q - p
        chance = p + f * (s + f * (3 * rise - 2 * s - t + f * (s + t - 2 * rise)))
        slope = s + f * (2 * (3 * rise - 2 * s - t) + 3 * f * (s + t - 2 * rise))
        if chance > 0.1 * min(p, q) and chance > UNLIKELY:
            return slope / (chance * law.step), information, chi2
        # Many electrons where none is expected: the cubic of a higher power may dip below 0.
        chance = (1 - f) * p + f * q
        if chance > UNLIKELY:
            return ((1 - f) * s + f * t) / (chance * law.step), information, chi2
    signal = (reading - law.black) / law.gain
    return (signal - electrons) / (max(electrons, 0.0) + law.read_variance + law.rounding), information, chi2


@compiled
def _below(reading, electrons, law):
    """As `_faint` for a mean below its lowest level, where the black level was stated too high: read noise alone, and
    the probability of being clipped at black."""
    variance = law.read_variance + law.rounding
    sd = math.sqrt(variance)
    residual = (reading - law.black) / law.gain - electrons
    a = (electrons + (law.black - 0.5) / law.gain) / sd
    if a > FAR and reading > 0.0:
        return residual / variance, 1.0 / variance, residual * residual / variance
    hazard, pdf = _hazard(a), math.exp(-a * a / 2) * 0.3989422804014327
    information = (0.5 * math.erfc(-a * 0.7071067811865476) - pdf * (a - hazard)) / variance
    return (-hazard / sd if reading <= 0.0 else residual / variance), max(information, 1e-12), -1.0


@compiled
def pixel_information(electrons, law):
    """Information [1/e-²] on each of the mean `electrons` [pixels] in its reading."""
    out = np.empty(electrons.size)
    for k in range(electrons.size):
        if electrons[k] < law.highest:
            _, out[k], _ = _faint(0.0, electrons[k], law)
        else:
            _, out[k], _ = _bright(law.black + law.gain * electrons[k], electrons[k], law)
    return out


@compiled
def equal_weights(readings, mean, weight, score):
    """Equal weights along a row: weight 1 and score y − µ, 0 where masked; Σ residual² and its pixels."""
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
def _plain(readings, electrons, law, weight, score):
    """Along a row without a pixel near a clip or in the faint table: shifted Poisson law; χ² and its pixels."""
    total, used = 0.0, 0
    noise, per_dn, dark = law.read_variance + law.rounding, 1 / law.gain, law.black / law.gain
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
def _mixed(readings, electrons, law, weight, score):
    """Along any other row, pixel by pixel."""
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        if reading != reading:
            weight[k] = score[k] = 0.0
            continue
        if electrons[k] < law.highest:
            score[k], weight[k], chi2 = _faint(reading, electrons[k], law)
        else:
            score[k], weight[k], chi2 = _bright(reading, electrons[k], law)
        if chi2 >= 0.0:
            total += chi2
            used += 1
    return total, used


@compiled
def likelihood_weights(readings, electrons, plain, row, maps, law, weight, score):
    """Along a row by the sensor's law; whether there are maps is known to the compiler."""
    if maps is None:
        if plain:
            return _plain(readings, electrons, law, weight, score)
        return _mixed(readings, electrons, law, weight, score)
    return _on_maps(readings, electrons, row, maps, law, weight, score)


@compiled
def _on_maps(readings, electrons, row, maps, law, weight, score):
    """Along a row of pixels with offsets and gains of their own: as `_mixed` for mean electrons of gain times the light
    above a black level that is the pixel's. What the maps are uncertain by is noise of the pixel.

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
        uneven = maps.gain_variance * mean_e * mean_e
        if mean_e < maps.fine.highest:
            pull, information, chi2 = _faint_between((reading - law.black - offset) / law.gain, mean_e, maps.fine)
            share = 1 / (1 + uneven * information)
            pull, information, chi2 = share * pull, share * information, share * chi2
        else:
            pull, information, chi2 = _bright(reading, mean_e, _of_pixel(law, offset, maps.offset_variance + uneven))
        score[k], weight[k] = gain * pull, gain * gain * information
        if chi2 >= 0.0:
            total += chi2
            used += 1
    return total, used


@compiled
def _of_pixel(law, offset, extra):
    """The law of a pixel whose black level is higher by `offset` [DN], with more variance of read noise [e-²]."""
    return Law(law.gain, law.read_variance + extra, law.rounding, law.black + offset, law.full_scale, law.full_well,
               law.lowest, law.step, law.highest, law.probability, law.slope, law.inverse, law.mean, law.spread,
               None)  # fmt: skip


@compiled
def _faint_between(signal, electrons, fine):
    """As `_faint` for a signal [e-] that is no whole number of DN: the score is nearly straight between two of the fine
    law's readings."""
    reading = max(fine.gain * signal + fine.black, 0.0)
    low = math.floor(reading)
    before, information, _ = _faint(low, electrons, fine)
    after, _, _ = _faint(low + 1.0, electrons, fine)
    _, _, chi2 = _faint(reading, electrons, fine)
    return before + (reading - low) * (after - before), information, chi2


@compiled
def reading_variances(readings, mean, electrons, law, weight, score):
    """Along a row the variance [DN²] of each reading, both clips and the rounding included; χ² and its pixels."""
    total, used = 0.0, 0
    for k in range(readings.size):
        reading = float(readings[k])
        score[k] = 0.0
        if reading != reading:
            weight[k] = 0.0
            continue
        if electrons[k] < law.highest:
            at = max((electrons[k] - law.lowest) / law.step, 0.0)
            i = min(int(at), law.inverse.size - 2)
            variance = law.spread[i] + (at - i) * (law.spread[i + 1] - law.spread[i])
        else:
            top = min(law.full_scale, law.black + law.gain * law.full_well)
            normal = law.gain**2 * (electrons[k] + law.read_variance + law.rounding)
            variance = normal * _clipped_spread((top - mean[k]) / math.sqrt(normal))
        # A clipped pixel has no variance of its own; rounding is the least that is left.
        weight[k] = max(variance, ROUNDING_VARIANCE)
        total += (reading - mean[k]) ** 2 / weight[k]
        used += 1
    return total, used


@compiled
def _clipped_spread(b):
    """Variance of a standard normal number that is cut at b."""
    if b > FAR:
        return 1.0
    pdf, above = math.exp(-b * b / 2) * 0.3989422804014327, 0.5 * math.erfc(b * 0.7071067811865476)
    first = b * above - pdf
    return max(b * b * above + (1 - above) - b * pdf - first * first, 0.0)
