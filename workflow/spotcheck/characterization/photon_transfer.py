"""Photon transfer: gain and all other quantities of EMVA 1288 from levels of flats and darks.

The analysis follows EMVA 1288 Release 4.0 Linear. Each quantity has a standard error, or the reason why it is unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import theilslopes

from spotcheck.characterization.contradictions import check_levels
from spotcheck.characterization.derived_quantities import (
    set_dark_electrons,
    set_dark_quantities,
    set_light_quantities,
)
from spotcheck.characterization.emva_quantities import QUANTITIES, QuantityTable
from spotcheck.characterization.levels import Level, collect, measure_light
from spotcheck.characterization.line_fits import MIN_POINTS, fit_line, fit_through_zero

# Largest signal of the levels to which the gain is fitted, as a part of saturation (section 8.2).
MAX_GAIN_SIGNAL = 0.7
# Darks above the line through all of them by more than this part of full scale hold light.
MAX_STRAY_LIGHT = 1e-3
# Noise that grows up to a brightest flat of which less than this part of the pixels is clipped shows no saturation.
MAX_CLIPPED_PART = 1e-3
# Parts of saturation up to which gain and intercept are compared.
RANGE_LIMITS = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0)
# A gain is significant from this number of standard errors on.
MIN_SIGNIFICANCE = 3.0
# Least standard error of a variance over dark [DN²].
MIN_VARIANCE_ERROR = 1e-6

NO_SHOT_NOISE = "the noise of the flats does not grow with their light"
ALL_SATURATED = "every flat is saturated"


@dataclass(frozen=True)
class Transfer:
    """Photon transfer of flats and darks."""

    flats: list[Level]  # levels of light with two frames or more, by mean
    darks: list[Level]  # dark levels without stray light, by exposure
    signal: np.ndarray  # mean of a flat over that of its dark [DN], [flat]; empty without darks in pairs
    excess: np.ndarray  # temporal variance of a flat over that of its dark [DN²], [flat]; empty like `signal`
    excess_error: np.ndarray  # standard error of the excess variance [DN²], [flat]
    fitted: np.ndarray  # True for the flats to which the gain was fitted [flat]
    saturation: int | None  # index of the flat at saturation; None if no flat shows it
    quantities: QuantityTable  # all quantities, in the order of `QUANTITIES`
    remarks: list[str]  # sentences on what could not be used


@dataclass(frozen=True)
class RangeFit:
    """Gain and response line of the levels up to a part of saturation."""

    limit: float  # largest signal, as a part of saturation
    levels: int  # number of levels
    gain: float  # [DN/e-]
    gain_error: float  # standard error of the gain [DN/e-]
    intercept: float  # intercept of signal against light [DN]
    intercept_error: float  # standard error of the intercept [DN]


def analyse_photon_transfer(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Return the photon transfer of levels of flats and darks.

    Quantities that rest on contradictory levels are unknown, and a remark names the contradiction.

    Parameters
    ----------
    levels : levels in any order.
    full_scale_dn : largest reading of the converter [DN].
    """
    transfer = _analyse_levels(levels, full_scale_dn)
    quantities = transfer.quantities
    for contradiction in check_levels(levels, transfer.flats, transfer.signal, quantities["quantum_efficiency"]):
        transfer.remarks.append(contradiction.sentence)
        quantities.set_unknown(contradiction.unknown, contradiction.reason)
    return replace(transfer, quantities=QuantityTable({name: quantities[name] for name in QUANTITIES}))


def _analyse_levels(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Return the photon transfer of levels that are taken to be what the manifest says."""
    remarks: list[str] = []
    darks = _select_darks([level for level in levels if level.kind == "dark"], full_scale_dn, remarks)
    flats = _select_flats([level for level in levels if level.kind == "flat"], remarks)
    noisy_darks = [dark for dark in darks if dark.frames > 1]
    quantities = QuantityTable()
    set_dark_quantities(quantities, darks, noisy_darks, remarks)
    if not flats or not noisy_darks:
        quantities.fill_unknown("there are no flats in pairs" if not flats else "there are no dark frames in pairs")
        empty = np.zeros(0)
        return Transfer(flats, darks, empty, empty, empty, empty.astype(bool), None, quantities, remarks)
    paired_darks = [_find_nearest_dark(noisy_darks, flat.exposure_s) for flat in flats]
    pairs = list(zip(flats, paired_darks, strict=True))
    signal = np.array([flat.mean - dark.mean for flat, dark in pairs])
    excess = np.array([flat.variance - dark.variance for flat, dark in pairs])
    error = np.array([np.hypot(flat.variance_error, dark.variance_error) for flat, dark in pairs])
    error = np.maximum(error, MIN_VARIANCE_ERROR)
    no_flat = np.zeros(len(flats), bool)
    transfer = Transfer(flats, darks, signal, excess, error, no_flat, None, quantities, remarks)
    if all(flat.is_saturated for flat in flats):
        remarks.append(ALL_SATURATED)
        quantities.fill_unknown(ALL_SATURATED)
        return transfer
    if not (excess > MIN_SIGNIFICANCE * error).any():
        quantities.fill_unknown(NO_SHOT_NOISE)
        return transfer
    # Saturation is where the temporal noise is largest (section 8.3).
    noisiest = int(np.argmax(excess))
    is_saturated = noisiest < len(flats) - 1 or flats[noisiest].at_full >= MAX_CLIPPED_PART
    fitted = (signal > 0) & (np.arange(len(flats)) <= noisiest)
    if is_saturated:
        fitted &= signal <= MAX_GAIN_SIGNAL * signal[noisiest]
    else:
        remarks.append("the noise still grows at the brightest flat: saturation lies above it")
    saturation = noisiest if is_saturated else None
    if not fitted.any():
        is_lit = (signal > 0).any()
        quantities.fill_unknown(f"no flat lies {'below 70 % of saturation' if is_lit else 'above its dark'}")
        return replace(transfer, saturation=saturation)
    errors = _include_shared_dark(signal, error, fitted, paired_darks)
    gain, gain_error = fit_through_zero(signal[fitted], excess[fitted], errors)
    if not gain > MIN_SIGNIFICANCE * gain_error:
        quantities.fill_unknown(NO_SHOT_NOISE)
        return transfer
    quantities.set("gain", gain, gain_error)
    set_dark_electrons(quantities, noisy_darks)
    set_light_quantities(quantities, flats, paired_darks, signal, fitted, noisiest, is_saturated)
    return replace(transfer, fitted=fitted, saturation=saturation)


def _select_darks(darks: list[Level], full_scale_dn: float, remarks: list[str]) -> list[Level]:
    """Return the dark levels without stray light, by exposure, and append a remark on the others.

    At least half of the levels must be dark. A line in exposure describes them: median of all slopes, then median of
    the offsets, which fewer than a third of outliers do not shift (Theil 1950, Sen 1968).
    """
    darks = sorted(darks, key=lambda dark: dark.exposure_s)
    if len(darks) < MIN_POINTS:
        return darks
    exposure_s, mean = np.nan_to_num(collect(darks, "exposure_s")), collect(darks, "mean")
    offset = mean - (theilslopes(mean, exposure_s).slope if np.ptp(exposure_s) else 0.0) * exposure_s
    is_dark = offset <= np.median(offset) + MAX_STRAY_LIGHT * full_scale_dn
    if not is_dark.all():
        remarks.append(f"{np.count_nonzero(~is_dark)} of {len(darks)} dark levels hold light and are left out")
    return [dark for dark, use in zip(darks, is_dark, strict=True) if use]


def _select_flats(flats: list[Level], remarks: list[str]) -> list[Level]:
    """Return the levels of light with two frames or more, by mean, and append a remark on the others."""
    noisy = [flat for flat in flats if flat.frames > 1]
    single = len(flats) - len(noisy)
    if single:
        remarks.append(
            f"{single} flat level{'s have' if single > 1 else ' has'} a single frame, and noise needs two of one light"
        )
    return sorted(noisy, key=lambda flat: flat.mean)


def _find_nearest_dark(darks: Sequence[Level], exposure_s: float) -> Level:
    """Return the dark level with the nearest exposure; unknown exposures count as 0."""
    return min(darks, key=lambda dark: abs(np.nan_to_num(dark.exposure_s) - np.nan_to_num(exposure_s)))


def _include_shared_dark(
    signal: np.ndarray, error: np.ndarray, fitted: np.ndarray, darks: Sequence[Level]
) -> np.ndarray:
    """Return errors of the fitted points [DN²] that give a gain through 0 its correct error if all share one dark.

    A shared dark moves all points together: (Σx)² s² in the variance of the slope, which is spread over the points as
    independent errors of the same effect, Σ x² extra².
    """
    used = [dark for dark, use in zip(darks, fitted, strict=True) if use]
    if len({id(dark) for dark in used}) > 1 or len(used) < 2:
        return error[fitted]
    x, shared = signal[fitted], used[0].variance_error
    independent = np.maximum(error[fitted] ** 2 - shared**2, 0.0)
    return np.sqrt(independent + shared**2 * x.sum() ** 2 / (x @ x))


def fit_ranges(transfer: Transfer) -> list[RangeFit]:
    """Return gain and response line of the levels up to each of `RANGE_LIMITS`.

    They are the same in all ranges if the sensor is linear. Ranges of fewer than three levels are left out; the list is
    empty if no flat shows saturation.
    """
    if transfer.saturation is None or not transfer.fitted.any():
        return []
    light, errors = measure_light(transfer.flats), collect(transfer.flats, "mean_error")
    is_below = (transfer.signal > 0) & (np.arange(len(transfer.flats)) <= transfer.saturation)
    ranges = []
    for limit in RANGE_LIMITS:
        use = is_below & (transfer.signal <= limit * transfer.signal[transfer.saturation])
        count = int(np.count_nonzero(use))
        if len(np.unique(light[use])) < MIN_POINTS:
            continue
        signal = transfer.signal[use]
        gain, gain_error = fit_through_zero(signal, transfer.excess[use], transfer.excess_error[use])
        # All levels have the same weight, as in linear regression: individual weights would hide curvature.
        line = fit_line(light[use], signal, np.full(count, float(np.mean(errors[use]))))
        ranges.append(RangeFit(limit, count, gain, gain_error, line.intercept, line.intercept_error))
    return ranges
