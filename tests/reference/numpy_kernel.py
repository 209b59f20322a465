"""The approximation that `spotcheck.fitting.reading_kernel` states, in plain numpy, which it must equal.

Mean electrons ν, variance of read noise and rounding n = σ² + 1/(12 K²) [e-²], signal of a reading z = (y − black)/K:

- faint light: between two levels of the table of P(y | ν), P is the cubic with their values and slopes;
- below the table: read noise alone, and the probability of being clipped at black;
- bright light: (z − ν)/(ν + n) and 1/(ν + n), the Poisson distribution shifted by n;
- near full scale: a normal reading of variance ν + n, and at full scale the probability of being clipped;
- near the full well: normal electrons of variance ν, cut at the well, plus normal noise of variance n.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import norm

from spotcheck.sensor import SensorModel
from spotcheck.sensor.faint import FaintTable, tabulate_between_codes, tabulate_faint_light
from spotcheck.sensor.pixel_maps import PixelMaps

ROUNDING_DN2 = 1 / 12
# Standard deviations from a clip beyond which it is left out.
FAR = 6.0
# A reading that is less probable scores by the normal law.
UNLIKELY = 1e-12
# The table gives way to the bright law where variance and information are off by less than this part, and the mean by
# less than a thousandth of a standard deviation.
VARIANCE_PART, MEAN_PART = 0.02, 1e-3
# Chances below this have no part in the information of a level.
IMPROBABLE = 1e-250


@dataclass(frozen=True)
class Pixel:
    """What one reading contributes."""

    score: float  # ∂ ln P/∂ν [1/e-]
    information: float  # Fisher information on ν [1/e-²]
    chi2: float  # squared residual over its variance; NaN next to a clip


@dataclass(frozen=True)
class Tables:
    """Numbers of a sensor, and its table as far as it is needed."""

    sensor: SensorModel  # without curvature
    noise: float  # n [e-²]
    faint: FaintTable
    inverse: np.ndarray  # 1/I of each level [e-²]
    count: int  # levels of the table that are used
    highest: float  # mean electrons of the last of them [e-]

    def signal(self, reading: float) -> float:
        """Return z [e-]."""
        return (reading - self.sensor.black_level_dn) / self.sensor.gain_dn_per_e


def tables_of(sensor: SensorModel, faint: FaintTable | None = None, rounding: float | None = None) -> Tables:
    """Return the tables of a sensor; `rounding` is the variance of rounding [e-²] where it is not 1/12 of its DN²."""
    sensor = sensor.without_curvature()
    gain, noise = sensor.gain_dn_per_e, sensor.read_noise_e**2
    rounding = ROUNDING_DN2 / gain**2 if rounding is None else rounding
    faint = tabulate_faint_light(sensor) if faint is None else faint
    possible = np.where(faint.probability > IMPROBABLE, faint.probability, np.inf)
    inverse = 1 / np.maximum(np.sum(faint.slope**2 / possible, axis=1), 1e-12)
    if noise == 0:
        inverse[0] = max(2 * inverse[1] - inverse[2], 1e-9)
    # From which level on a reading is Poisson, shifted: mean, variance and information.
    nu = faint.levels
    variance = np.maximum(faint.variance, ROUNDING_DN2)
    mean_off = np.abs(faint.mean - gain * nu - sensor.black_level_dn) > MEAN_PART * np.sqrt(variance)
    plain = np.maximum(nu, 0.0) + noise + rounding
    variance_off = np.abs(variance / gain**2 - plain) > VARIANCE_PART * plain
    information_off = plain > (1 + VARIANCE_PART) * inverse
    last = np.flatnonzero(mean_off | variance_off | information_off | (nu < 1))[-1] + 1
    count = int(min(max(last + 1, 2), nu.size))
    return Tables(sensor, noise + rounding, faint, inverse, count, float(nu[count - 1]))


def hazard(a: float) -> float:
    """Return φ(a)/Q(a) of the standard normal distribution."""
    return float(np.exp(norm.logpdf(a) - log_ndtr(-a)))


def censored_information(a: float) -> float:
    """Return the information on the mean of a normal number of variance 1 that is cut a above its mean."""
    return max(float(norm.cdf(a) - norm.pdf(a) * (a - hazard(a))), 0.0)


def one_pixel(reading: float, electrons: float, tables: Tables) -> Pixel:
    """Return score, information and χ² of a reading [DN] for its mean electrons."""
    if electrons >= tables.highest:
        return bright(reading, electrons, tables)
    if electrons < tables.faint.lowest_e:
        return below_the_table(reading, electrons, tables)
    return faint_light(reading, electrons, tables)


def faint_light(reading: float, electrons: float, tables: Tables) -> Pixel:
    """By cubics between two levels of the table."""
    faint, step = tables.faint, tables.faint.step_e
    place = (electrons - faint.lowest_e) / step
    low = min(int(place), tables.count - 2)
    f, pair = place - low, slice(low, low + 2)

    def line(values: np.ndarray) -> float:
        return float((1 - f) * values[pair][0] + f * values[pair][1])

    information = 1 / line(tables.inverse)
    chi2 = (reading - line(faint.mean)) ** 2 / line(np.maximum(faint.variance, ROUNDING_DN2))
    code = int(reading + 0.5)
    if code < faint.probability.shape[1]:
        value, slope = faint.probability[pair, code], step * faint.slope[pair, code]
        # Hermite's cubic and its derivative.
        chance = (
            value[0] * (1 + 2 * f) * (1 - f) ** 2 + slope[0] * f * (1 - f) ** 2
            + value[1] * f**2 * (3 - 2 * f) - slope[1] * f**2 * (1 - f)
        )  # fmt: skip
        rise = (
            6 * f * (1 - f) * (value[1] - value[0]) + slope[0] * (1 - f) * (1 - 3 * f) + slope[1] * f * (3 * f - 2)
        )  # fmt: skip
        if chance <= 0.1 * value.min() or chance <= UNLIKELY:
            # The cubic dips: straight lines instead.
            chance, rise = (1 - f) * value[0] + f * value[1], (1 - f) * slope[0] + f * slope[1]
        if chance > UNLIKELY:
            return Pixel(float(rise / chance / step), information, chi2)
    score = (tables.signal(reading) - electrons) / (max(electrons, 0.0) + tables.noise)
    return Pixel(score, information, chi2)


def below_the_table(reading: float, electrons: float, tables: Tables) -> Pixel:
    """Read noise alone, clipped at black."""
    sd, residual = np.sqrt(tables.noise), tables.signal(reading) - electrons
    # Standard deviations from the mean down to where a reading becomes 0.
    a = (electrons - tables.signal(0.5)) / sd
    if a > FAR and reading > 0:
        return Pixel(residual / tables.noise, 1 / tables.noise, residual**2 / tables.noise)
    score = -hazard(a) / sd if reading <= 0 else residual / tables.noise
    return Pixel(score, max(censored_information(a) / tables.noise, 1e-12), np.nan)


def bright(reading: float, electrons: float, tables: Tables) -> Pixel:
    """Poisson, shifted; near full scale or the well as these have it."""
    sensor, variance = tables.sensor, electrons + tables.noise
    signal, well = tables.signal(reading), sensor.full_well_e
    if np.isfinite(well) and (electrons > well - FAR * np.sqrt(well) or signal > well - FAR * np.sqrt(tables.noise)):
        return at_the_well(signal, electrons, tables)
    residual, sd = signal - electrons, np.sqrt(variance)
    a = (tables.signal(sensor.full_scale_dn - 0.5) - electrons) / sd
    if a > FAR and reading < sensor.full_scale_dn:
        return Pixel(residual / variance, 1 / variance, residual**2 / variance)
    score = hazard(a) / sd if reading >= sensor.full_scale_dn else residual / variance
    return Pixel(score, censored_information(a) / variance, np.nan)


def at_the_well(signal: float, electrons: float, tables: Tables) -> Pixel:
    """∂ ln ρ/∂ν of ρ = ∫ N(n; ν, ν) N(z; n, noise) dn below the well + P(n > well) N(z; well, noise), widths held."""
    well, noise, sd = tables.sensor.full_well_e, tables.noise, np.sqrt(electrons)
    total = electrons + noise
    information = censored_information((well - electrons) / sd) / total
    # Electrons given the reading.
    middle, width = electrons + (signal - electrons) * electrons / total, np.sqrt(electrons * noise / total)
    free = norm.pdf(signal, electrons, np.sqrt(total))
    at_well = norm.pdf(signal, well, np.sqrt(noise))
    density = free * norm.cdf(well, middle, width) + at_well * norm.sf(well, electrons, sd)
    if density * np.sqrt(2 * np.pi) < 1e-280:
        return Pixel((signal - electrons) / total, information, np.nan)
    slope = free * norm.cdf(well, middle, width) * (signal - electrons) / total
    slope -= free * norm.pdf((well - middle) / width) * noise / total / width
    slope += at_well * norm.pdf((well - electrons) / sd) / sd
    return Pixel(float(slope / density), information, np.nan)


def one_pixel_on_maps(reading: float, electrons: float, sensor: SensorModel, maps: PixelMaps, place) -> Pixel:
    """As `one_pixel` at a place (row, column) of maps: ν is multiplied by the pixel's gain, the black level is higher
    by its offset, and what either is uncertain by is noise."""
    sensor = sensor.without_curvature()
    rounding, gain = ROUNDING_DN2 / sensor.gain_dn_per_e**2, float(maps.gain[place])
    offset_variance = (maps.offset_stderr_dn / sensor.gain_dn_per_e) ** 2
    own, offset = gain * electrons, float(maps.offset_dn[place])
    uneven = maps.gain_stderr**2 * own**2
    between = tables_of(*tabulate_between_codes(sensor, offset_variance), rounding)
    if own < between.highest:
        signal = (reading - sensor.black_level_dn - offset) / sensor.gain_dn_per_e
        finer = max(between.sensor.gain_dn_per_e * signal + between.sensor.black_level_dn, 0.0)
        low = np.floor(finer)
        before, after, here = (one_pixel(y, own, between) for y in (low, low + 1, finer))
        share = 1 / (1 + uneven * before.information)
        score = before.score + (finer - low) * (after.score - before.score)
        pixel = Pixel(share * score, share * before.information, share * here.chi2)
    else:
        shifted = replace(sensor, black_level_dn=sensor.black_level_dn + offset)
        plain = tables_of(sensor)
        pixel = bright(reading, own, replace(plain, sensor=shifted, noise=plain.noise + offset_variance + uneven))
    return Pixel(gain * pixel.score, gain**2 * pixel.information, pixel.chi2)


def reading_variance(electrons: float, tables: Tables) -> float:
    """Return the variance [DN²] of a reading, which equal weights state their errors by; at least that of rounding."""
    sensor = tables.sensor
    gain = sensor.gain_dn_per_e
    if electrons < tables.highest:
        levels = tables.faint.levels[: tables.count]
        variance = np.interp(electrons, levels, np.maximum(tables.faint.variance[: tables.count], ROUNDING_DN2))
        return float(max(variance, ROUNDING_DN2))
    # A normal number cut at full scale or the well.
    normal = gain**2 * (electrons + tables.noise)
    top = min(sensor.full_scale_dn, sensor.black_level_dn + gain * sensor.full_well_e)
    b = (top - sensor.black_level_dn - gain * electrons) / np.sqrt(normal)
    if b > FAR:
        return float(max(normal, ROUNDING_DN2))
    mean = b * norm.sf(b) - norm.pdf(b)
    square = norm.cdf(b) - b * norm.pdf(b) + b**2 * norm.sf(b)
    return float(max(normal * max(square - mean**2, 0.0), ROUNDING_DN2))
