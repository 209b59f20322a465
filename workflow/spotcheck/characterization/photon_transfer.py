"""Photon transfer: gain and all other quantities of EMVA 1288 from levels of flats and darks.

Flats are frames of uniform light, darks are frames without light. A level is all flats or darks of one light and one
exposure, with its `mean` [DN], temporal `variance` [DN²], their errors, and the number of its `frames`. The gain is the
slope of the temporal variance of the flats over their mean, both less those of a dark. The analysis follows EMVA 1288
Release 4.0 Linear. Each quantity has a standard error, or the reason why it is unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import theilslopes

from spotcheck.characterization.contradictions import check_levels
from spotcheck.characterization.derived_quantities import set_dark_electrons, set_dark_quantities, set_light_quantities
from spotcheck.characterization.emva_quantities import QUANTITIES, QuantityTable
from spotcheck.characterization.levels import Level, collect_field, measure_light
from spotcheck.characterization.line_fits import MIN_POINTS, fit_line, fit_through_zero
from spotcheck.characterization.noise_curve import is_sharpened

# Largest signal of the levels to which the gain is fitted, as a part of saturation (section 8.2).
MAX_GAIN_SIGNAL = 0.7
# A dark contains light if it is above the line through all darks by more than this part of full scale.
MAX_STRAY_LIGHT = 1e-3
# If the noise is largest at the brightest flat, this flat is at saturation only if this part of its pixels is clipped.
MIN_CLIPPED_PART = 1e-3
# Largest signals of the ranges whose gains and intercepts are compared, as parts of saturation.
RANGE_LIMITS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0)
# A gain is significant from this number of standard errors on.
MIN_SIGNIFICANCE = 3.0
# Least standard error of a variance over dark [DN²].
MIN_VARIANCE_ERROR = 1e-6

# Quantities that do not depend on the temporal noise of a pixel.
NOISE_FREE = (
    "dark_offset", "responsivity", "saturation_dn", "saturation_photons", "linearity_error", "linearity_lowest",
    "linearity_highest", "prnu", "prnu_column", "prnu_row", "prnu_pixel",
)  # fmt: skip

NO_SHOT_NOISE = "the noise of the flats does not grow with their light"
ALL_SATURATED = "every flat is saturated"


@dataclass(frozen=True)
class Transfer:
    """Photon transfer of flats and darks."""

    flats: list[Level]  # flat levels of two frames or more, by mean
    darks: list[Level]  # dark levels without stray light, by exposure
    signal: np.ndarray  # mean of a flat less that of its dark [DN], [flat]; empty if no dark has two frames
    excess: np.ndarray  # temporal variance of a flat less that of its dark [DN²], [flat]; empty like `signal`
    excess_error: np.ndarray  # standard error of the excess variance [DN²], [flat]; empty like `signal`
    is_in_gain_fit: np.ndarray  # True for the flats to which the gain was fitted [flat]; empty like `signal`
    saturation: int | None  # index of the flat at saturation; None if no flat shows it
    quantities: QuantityTable  # all quantities, in the order of `QUANTITIES`
    remarks: list[str]  # sentences on what could not be used


@dataclass(frozen=True)
class RangeFit:
    """Gain and response line of the levels up to a part of saturation."""

    limit: float  # largest signal, as a part of saturation
    levels: int  # number of levels
    gain: float  # gain from these levels [DN/e-]
    gain_error: float  # standard error of the gain [DN/e-]
    intercept: float  # signal at no light, by the straight line of signal over light [DN]
    intercept_error: float  # standard error of the intercept [DN]


def analyse_photon_transfer(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Return the photon transfer of levels of flats and darks.

    Levels may contradict each other in their exposures or photon numbers, or give a quantum efficiency above 1. Each
    contradiction makes the quantities that depend on it unknown, and adds a remark.

    Parameters
    ----------
    levels : levels in any order.
    full_scale_dn : largest reading of the converter [DN].
    """
    transfer = _analyse_levels(levels, full_scale_dn)
    quantities = transfer.quantities
    for contradiction in check_levels(levels, transfer.flats, transfer.signal, quantities["quantum_efficiency"]):
        transfer.remarks.append(contradiction.sentence)
        quantities.set_unknown(contradiction.affected_names, contradiction.reason)
    if reason := _describe_shared_noise([*transfer.flats, *transfer.darks]):
        advice = "record flats and darks without noise reduction, sharpening, compression or resampling"
        transfer.remarks.append(f"{reason}; {advice}")
        quantities.set_unknown([name for name in QUANTITIES if name not in NOISE_FREE], reason)
    return replace(transfer, quantities=QuantityTable({name: quantities[name] for name in QUANTITIES}))


def _describe_shared_noise(levels: Sequence[Level]) -> str:
    """Return a phrase if the noise of more than half of the levels is not that of single pixels; "" otherwise.

    By chance, a level of 400 pixels seems to share noise once in 200 cases, and larger ones never. Levels of white
    noise seem sharpened once in 10,000 datasets.
    """
    noisy = [level for level in levels if level.frames > 1 and level.variance > 0]
    if is_sharpened([level.block_noise for level in noisy if level.block_noise is not None]):
        return (
            "the frames are sharpened: neighbouring pixels differ by more noise than means of pixels have, so that it"
            " is not that of single pixels"
        )
    all_ranges_px = [level.noise_range_px for level in noisy]
    ranges_px = [range_px for range_px in all_ranges_px if range_px]
    if len(ranges_px) <= len(all_ranges_px) / 2:
        return ""
    range_px = int(np.median(ranges_px))
    return (
        f"pixels share their noise over {range_px} px in {len(ranges_px)} of {len(all_ranges_px)} levels, so that it is"
        " not that of single pixels"
    )


def _analyse_levels(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Return the photon transfer of levels without a check of exposures and photon numbers for contradictions.

    All quantities are in its table, in any order. If the gain cannot be determined, those that need it are unknown.
    """
    remarks: list[str] = []
    darks = _select_darks([level for level in levels if level.kind == "dark"], full_scale_dn, remarks)
    flats = _select_flats([level for level in levels if level.kind == "flat"], remarks)
    # Only these have a temporal variance.
    repeated_darks = [dark for dark in darks if dark.frames > 1]
    quantities = QuantityTable()
    set_dark_quantities(quantities, darks, repeated_darks, remarks)
    if not flats or not repeated_darks:
        quantities.fill_unknown("there are no flats in pairs" if not flats else "there are no dark frames in pairs")
        empty = np.zeros(0)
        return Transfer(flats, darks, empty, empty, empty, empty.astype(bool), None, quantities, remarks)
    # Signal and excess variance of each flat over the dark of the nearest exposure.
    paired_darks = [_find_nearest_dark(repeated_darks, flat.exposure_s) for flat in flats]
    pairs = list(zip(flats, paired_darks, strict=True))
    signal = np.array([flat.mean - dark.mean for flat, dark in pairs])
    excess = np.array([flat.variance - dark.variance for flat, dark in pairs])
    error = np.maximum([np.hypot(flat.variance_error, dark.variance_error) for flat, dark in pairs], MIN_VARIANCE_ERROR)
    # Result without a gain: no flat is in its fit, and none is at saturation.
    transfer = Transfer(flats, darks, signal, excess, error, np.zeros(len(flats), bool), None, quantities, remarks)
    if all(flat.is_saturated for flat in flats):
        remarks.append(ALL_SATURATED)
        quantities.fill_unknown(ALL_SATURATED)
        return transfer
    if not (excess > MIN_SIGNIFICANCE * error).any():
        quantities.fill_unknown(NO_SHOT_NOISE)
        return transfer
    # Saturation is at the flat with the largest temporal noise (8.3), unless it is the brightest and not clipped.
    noisiest = int(np.argmax(excess))
    is_saturated = noisiest < len(flats) - 1 or flats[noisiest].at_full >= MIN_CLIPPED_PART
    is_in_gain_fit = (signal > 0) & (np.arange(len(flats)) <= noisiest)
    if is_saturated:
        is_in_gain_fit &= signal <= MAX_GAIN_SIGNAL * signal[noisiest]
        transfer = replace(transfer, saturation=noisiest)
    else:
        remarks.append("the noise still grows at the brightest flat: saturation lies above it")
    if not is_in_gain_fit.any():
        has_signal = (signal > 0).any()
        quantities.fill_unknown(f"no flat lies {'below 70 % of saturation' if has_signal else 'above its dark'}")
        return transfer
    # Fit of the gain: excess variance = K signal.
    fit_error = _include_shared_dark(signal, error, is_in_gain_fit, paired_darks)
    gain, gain_error = fit_through_zero(signal[is_in_gain_fit], excess[is_in_gain_fit], fit_error)
    if not gain > MIN_SIGNIFICANCE * gain_error:
        quantities.fill_unknown(NO_SHOT_NOISE)
        # Noise that does not grow with the light shows no saturation either.
        return replace(transfer, saturation=None)
    quantities.set("gain", gain, gain_error)
    set_dark_electrons(quantities, repeated_darks)
    set_light_quantities(quantities, flats, paired_darks, signal, is_in_gain_fit, noisiest, is_saturated)
    return replace(transfer, is_in_gain_fit=is_in_gain_fit)


def _select_darks(darks: list[Level], full_scale_dn: float, remarks: list[str]) -> list[Level]:
    """Return the dark levels without stray light, by exposure, and append a remark on the others to `remarks`.

    A line describes the mean reading over exposure: its slope is the median of the slopes of all pairs of levels
    (Theil 1950, Sen 1968), its intercept the median of the offsets. Outliers do not shift it if they are fewer than a
    third of the levels. Two levels or one are all kept, since no outlier can be found among them.
    """
    darks = sorted(darks, key=lambda dark: dark.exposure_s)
    if len(darks) < MIN_POINTS:
        return darks
    exposure_s, mean = np.nan_to_num(collect_field(darks, "exposure_s")), collect_field(darks, "mean")
    offset = mean - (theilslopes(mean, exposure_s).slope if np.ptp(exposure_s) else 0.0) * exposure_s
    is_dark = offset <= np.median(offset) + MAX_STRAY_LIGHT * full_scale_dn
    if not is_dark.all():
        remarks.append(f"{np.count_nonzero(~is_dark)} of {len(darks)} dark levels hold light and are left out")
    return [dark for dark, is_kept in zip(darks, is_dark, strict=True) if is_kept]


def _select_flats(flats: list[Level], remarks: list[str]) -> list[Level]:
    """Return the flat levels of two frames or more, by mean, and append a remark on the others to `remarks`."""
    noisy_flats = [flat for flat in flats if flat.frames > 1]
    count = len(flats) - len(noisy_flats)
    if count:
        remarks.append(
            f"{count} flat level{'s have' if count > 1 else ' has'} a single frame, and noise needs two of one light"
        )
    return sorted(noisy_flats, key=lambda flat: flat.mean)


def _find_nearest_dark(darks: Sequence[Level], exposure_s: float) -> Level:
    """Return the dark level with the exposure nearest to `exposure_s` [s]; unknown exposures (NaN) count as 0."""
    return min(darks, key=lambda dark: abs(np.nan_to_num(dark.exposure_s) - np.nan_to_num(exposure_s)))


def _include_shared_dark(
    signal: np.ndarray, error: np.ndarray, is_in_gain_fit: np.ndarray, darks: Sequence[Level]
) -> np.ndarray:
    """Return standard errors [DN²], [fitted flat], of the fitted points; a dark that all of them share correlates them.

    The error s of the variance of a shared dark moves all points together. In the numerator Σ x y of the slope through
    the origin, this adds the variance s² (Σ x)². Independent errors e of all points add e² Σ x². The shared error is
    therefore replaced by independent ones of e² = s² (Σ x)²/Σ x². With different darks the errors are unchanged.

    Parameters
    ----------
    signal, error : signal x [DN] and standard error of the excess variance [DN²] of each flat [flat].
    is_in_gain_fit : True for the flats to which the gain is fitted [flat].
    darks : dark level of each flat [flat].
    """
    used_darks = [dark for dark, is_used in zip(darks, is_in_gain_fit, strict=True) if is_used]
    if len({id(dark) for dark in used_darks}) > 1 or len(used_darks) < 2:
        return error[is_in_gain_fit]
    x, shared_error = signal[is_in_gain_fit], used_darks[0].variance_error
    independent_variance = np.maximum(error[is_in_gain_fit] ** 2 - shared_error**2, 0.0)
    return np.sqrt(independent_variance + shared_error**2 * x.sum() ** 2 / (x @ x))


def fit_ranges(transfer: Transfer) -> list[RangeFit]:
    """Return gain and response line of the levels up to each of `RANGE_LIMITS`.

    They are the same in all ranges if the sensor is linear. Ranges of fewer than three levels are left out. The list is
    empty if no flat shows saturation or no gain was found.
    """
    if transfer.saturation is None or not transfer.is_in_gain_fit.any():
        return []
    light, signal_error = measure_light(transfer.flats), collect_field(transfer.flats, "mean_error")
    is_unsaturated = (transfer.signal > 0) & (np.arange(len(transfer.flats)) <= transfer.saturation)
    ranges = []
    for limit in RANGE_LIMITS:
        is_in_range = is_unsaturated & (transfer.signal <= limit * transfer.signal[transfer.saturation])
        if len(np.unique(light[is_in_range])) < MIN_POINTS:
            continue
        signal = transfer.signal[is_in_range]
        gain, gain_error = fit_through_zero(signal, transfer.excess[is_in_range], transfer.excess_error[is_in_range])
        # All levels have the same weight, as in linear regression: individual weights would hide curvature.
        mean_error = np.full(len(signal), float(np.mean(signal_error[is_in_range])))
        line = fit_line(light[is_in_range], signal, mean_error)
        ranges.append(RangeFit(limit, len(signal), gain, gain_error, line.intercept, line.intercept_error))
    return ranges
