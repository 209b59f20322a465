"""EMVA 1288 quantities that follow from levels of flats and darks once the gain is known.

Flats are frames of uniform light, darks are frames without light. A level is all flats or darks of one light and one
exposure, with its mean reading [DN], temporal variance [DN²], standard errors of both, and photons per pixel. The
signal of a flat is its mean reading less that of its dark. A table has the quantities by name; `set` enters a value
with its standard error. Symbols and section numbers are those of EMVA 1288 Release 4.0 Linear. Release 3.1 gives the
non-uniformities DSNU and PRNU as one number each, Release 4.0 splits them into columns, rows and pixels; both are
computed.
"""

from collections.abc import Sequence

import numpy as np

from spotcheck.characterization.emva_quantities import Quantity, QuantityTable, divide
from spotcheck.characterization.levels import Level, collect_field, measure_light
from spotcheck.characterization.line_fits import MIN_POINTS, extrapolate_to_zero, fit_line, fit_through_zero
from spotcheck.sensor import ROUNDING_VARIANCE

# Least dark variance [DN²]: below it rounding hides the noise (section 8.2).
MIN_DARK_VARIANCE = 0.24
# Largest part of a dark's pixels that may read 0. Above it, clipping at 0 has removed part of the noise.
MAX_PART_AT_ZERO = 5e-3
# Signals between which linearity is assessed, as parts of saturation (section 8.4).
LINEARITY_RANGE = (0.05, 0.95)
# From this number of darks on, their scatter is used as an estimate of the error of a pattern variance.
MIN_DARKS_FOR_SCATTER = 6
# Least dark noise [DN] in a divisor, which keeps its relative error finite.
MIN_NOISE_DN = 1e-9
# Suffix of the names of DSNU and PRNU → field of `PatternVariances`.
PATTERN_FIELDS = {"": "total", "_column": "column", "_row": "row", "_pixel": "pixel"}

NO_PHOTONS = "photons_per_px is not given for the flats"


def set_dark_quantities(
    quantities: QuantityTable, darks: Sequence[Level], repeated_darks: Sequence[Level], remarks: list[str]
) -> None:
    """Enter `dark_offset` and `dark_noise_dn`, mean [DN] and noise [DN] of darks at exposure 0 (section 8.1).

    Parameters
    ----------
    quantities : table to which the quantities are added.
    darks : all dark levels; without any, nothing is entered.
    repeated_darks : the dark levels of two frames or more, which have a temporal variance.
    remarks : list to which sentences on faults of the darks are appended.
    """
    if not darks:
        return
    part_at_zero = max(dark.at_zero for dark in darks)
    if part_at_zero > MAX_PART_AT_ZERO:
        remarks.append(f"{100 * part_at_zero:.2g} % of the pixels of a dark read 0: part of the noise is cut off")
    quantities.set("dark_offset", *_extrapolate_to_no_exposure(darks, "mean"))
    if not repeated_darks:
        return
    variance, error = _extrapolate_to_no_exposure(repeated_darks, "variance")
    if variance < MIN_DARK_VARIANCE:
        remarks.append(
            f"the noise of the darks, {np.sqrt(max(variance, 0.0)):.2g} DN, is below that of rounding: the dark noise"
            " given here is an upper limit"
        )
    noise = np.sqrt(max(variance, MIN_DARK_VARIANCE))
    # σ = √v has the error δv/(2 σ).
    quantities.set("dark_noise_dn", noise, error / (2 * noise))


def _extrapolate_to_no_exposure(darks: Sequence[Level], field: str) -> tuple[float, float]:
    """Return the field "mean" [DN] or "variance" [DN²] of dark levels at exposure 0, and its standard error.

    With fewer than three exposures, it is the value at the shortest exposure.
    """
    return extrapolate_to_zero(*(collect_field(darks, name) for name in ("exposure_s", field, f"{field}_error")))


def set_dark_electrons(quantities: QuantityTable, repeated_darks: Sequence[Level]) -> None:
    """Enter `dark_noise` [e-], and `dark_current` and `dark_current_by_variance` [e-/s].

    Gain and dark noise [DN] must be in the table. `repeated_darks` are the dark levels of two frames or more. With
    fewer than three exposures, the dark current is unknown.
    """
    gain, noise_dn = quantities["gain"], quantities["dark_noise_dn"]
    unrounded_dn = np.sqrt(max(noise_dn.value**2 - ROUNDING_VARIANCE, 0.0))
    noise = unrounded_dn / gain.value
    noise_error = noise_dn.value * noise_dn.stderr / max(unrounded_dn, MIN_NOISE_DN) / gain.value
    quantities.set("dark_noise", noise, np.hypot(noise_error, noise * gain.stderr / gain.value))
    darks = [dark for dark in repeated_darks if np.isfinite(dark.exposure_s)]
    exposures_s = collect_field(darks, "exposure_s")
    if len(np.unique(exposures_s)) < MIN_POINTS:
        quantities.set_unknown(("dark_current", "dark_current_by_variance"), "fewer than three exposures of darks")
        return
    # In the exposure t, the mean grows by K μ_I t and the variance by K² μ_I t.
    for name, field, gain_power in (("dark_current", "mean", 1), ("dark_current_by_variance", "variance", 2)):
        line = fit_line(exposures_s, collect_field(darks, field), collect_field(darks, f"{field}_error"))
        current = line.slope / gain.value**gain_power
        error = np.hypot(line.slope_error / gain.value**gain_power, gain_power * current * gain.stderr / gain.value)
        quantities.set(name, current, error)


def set_light_quantities(
    quantities: QuantityTable,
    flats: Sequence[Level],
    darks: Sequence[Level],
    signal: np.ndarray,
    is_in_gain_fit: np.ndarray,
    noisiest: int,
    is_saturated: bool,
) -> None:
    """Enter sensitivity, linearity, non-uniformity and saturation (sections 8.2 to 8.4).

    Parameters
    ----------
    quantities : table with gain and dark noise [DN], to which the quantities are added.
    flats : flat levels, in ascending order of their means [flat].
    darks : the dark level of each flat [flat]; a dark may belong to several flats.
    signal : means of the flats less those of their darks [DN], [flat].
    is_in_gain_fit : True for the flats to which the gain was fitted [flat].
    noisiest : index of the flat with the largest temporal noise.
    is_saturated : whether the noisiest flat is at saturation; if not, saturation lies above all flats and is unknown.
    """
    _set_sensitivity(quantities, flats, signal, is_in_gain_fit)
    _set_linearity(quantities, flats, signal, noisiest)
    half_saturated = int(np.argmin(np.abs(signal - signal[noisiest] / 2)))
    _set_nonuniformity(quantities, flats[half_saturated], float(signal[half_saturated]), darks)
    if is_saturated:
        _set_saturation(quantities, flats, signal, noisiest)
    else:
        quantities.fill_unknown("no flat is saturated")


def _set_sensitivity(
    quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, is_in_gain_fit: np.ndarray
) -> None:
    """Enter `responsivity`, `quantum_efficiency`, `threshold` and `threshold_photons` (section 8.2).

    Arguments are those of `set_light_quantities`. Without photon numbers only the threshold [e-] is known.
    """
    # Dark noise in electrons with the noise of rounding, which also limits the detection of light.
    noise, noise_error = divide(quantities["dark_noise_dn"], quantities["gain"])
    # The threshold μ [e-] is the signal that equals its noise: μ² = σ² + μ, so μ = ½ + √(σ² + ¼).
    root = np.sqrt(noise**2 + 0.25)
    quantities.set("threshold", 0.5 + root, noise * noise_error / root)
    photons = collect_field(flats, "photons")
    is_used = is_in_gain_fit & (photons > 0)
    if not is_used.any():
        quantities.set_unknown(("responsivity", "quantum_efficiency", "threshold_photons"), NO_PHOTONS)
        return
    signal_error = collect_field(flats, "mean_error")[is_used]
    quantities.set("responsivity", *fit_through_zero(photons[is_used], signal[is_used], signal_error))
    quantities.set("quantum_efficiency", *divide(quantities["responsivity"], quantities["gain"]))
    quantities.set("threshold_photons", *divide(quantities["threshold"], quantities["quantum_efficiency"]))


def _set_saturation(quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, saturated: int) -> None:
    """Enter `saturation_dn`, `saturation_photons`, `full_well`, `snr_max` and `dynamic_range` (section 8.3).

    `signal` [flat] is in DN, `saturated` is the index of the flat at saturation. Gain, quantum efficiency and threshold
    must be in the table; the efficiency may be unknown.
    """
    # Saturation lies between the neighbours of the noisiest level.
    quantities.set("saturation_dn", flats[saturated].mean, _estimate_step_error(signal, saturated))
    photons = collect_field(flats, "photons")
    efficiency = quantities["quantum_efficiency"]
    has_efficiency = np.isfinite(efficiency.value)
    if photons[saturated] > 0 and has_efficiency:
        # The definition of the standard. With a curved response it exceeds μ_y.sat/K.
        quantities.set("saturation_photons", photons[saturated], _estimate_step_error(photons, saturated))
        end_photons = quantities["saturation_photons"]
        electrons = end_photons.value * efficiency.value
        relative_error = np.hypot(end_photons.stderr / end_photons.value, efficiency.stderr / efficiency.value)
        quantities.set("full_well", electrons, electrons * relative_error)
    else:
        reason = "photons_per_px is not given for the flat at saturation" if has_efficiency else NO_PHOTONS
        quantities.set_unknown(["saturation_photons"], reason)
        end_signal = Quantity("", "", float(signal[saturated]), quantities["saturation_dn"].stderr, "DN")
        quantities.set("full_well", *divide(end_signal, quantities["gain"]))
    well = quantities["full_well"]
    # The noise of N electrons is √N, and so is their signal-to-noise ratio.
    quantities.set("snr_max", np.sqrt(well.value), well.stderr / (2 * np.sqrt(well.value)))
    quantities.set("dynamic_range", *divide(well, quantities["threshold"]))


def _estimate_step_error(values: np.ndarray, index: int) -> float:
    """Return the standard error of an ascending value that is only known to lie between its two neighbours.

    It is the standard deviation of a uniform distribution over half a step to each side; 0 for a single value.
    """
    steps = np.abs(np.diff(values[max(index - 1, 0) : index + 2]))
    return float(np.mean(steps) / np.sqrt(12)) if steps.size else 0.0


def _set_linearity(quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, noisiest: int) -> None:
    """Enter `linearity_error`, `linearity_lowest` and `linearity_highest` (section 8.4).

    They are mean (of absolute values), lowest and highest relative deviation [%] of the signal from a straight line.
    The line has the least relative squares between 5 and 95 % of the signal of the flat `noisiest`, which is
    saturation or the brightest flat. `signal` [flat] is in DN.
    """
    light = measure_light(flats)
    low, high = (part * signal[noisiest] for part in LINEARITY_RANGE)
    # Flats after the noisiest one are saturated.
    is_used = (signal >= low) & (signal <= high) & np.isfinite(light) & (np.arange(len(signal)) <= noisiest)
    if len(np.unique(light[is_used])) < MIN_POINTS:
        names = ("linearity_error", "linearity_lowest", "linearity_highest")
        quantities.set_unknown(names, "fewer than three levels of different light between 5 and 95 % of saturation")
        return
    x, y = light[is_used], signal[is_used]
    slope, offset = np.polyfit(x, y, 1, w=1 / y)
    deviation = 100 * (y / (slope * x + offset) - 1)
    deviation_error = 100 * collect_field(flats, "mean_error")[is_used] / y
    mean_error = np.sqrt(np.mean(deviation_error**2) / len(deviation))
    quantities.set("linearity_error", np.mean(np.abs(deviation)), mean_error)
    for name, index in (("linearity_lowest", np.argmin(deviation)), ("linearity_highest", np.argmax(deviation))):
        quantities.set(name, deviation[index], deviation_error[index])


def _set_nonuniformity(quantities: QuantityTable, flat: Level, signal: float, darks: Sequence[Level]) -> None:
    """Enter `dsnu` [e-] of all darks and `prnu` [%] of a flat near half of saturation, with parts (section 8.3).

    The parts are those by columns, rows and pixels: `dsnu_column`, `prnu_pixel` and so on.
    DSNU is the rms of the dark pattern. PRNU² is the variance of the flat's pattern less that of the darks, relative to
    the `signal` of the flat over its dark [DN]. `darks` may hold a level several times.
    """
    gain, to_percent_squared = quantities["gain"].value, (100 / signal) ** 2
    different_darks = list({id(dark): dark for dark in darks}.values())
    for suffix, field in PATTERN_FIELDS.items():
        variances, errors = np.array([_estimate_pattern_variance(dark, field) for dark in different_darks]).T
        single_error = float(np.sqrt(np.mean(errors**2)))
        # These errors assume white noise. The scatter of the darks is larger if noise is correlated over many pixels.
        if len(variances) >= MIN_DARKS_FOR_SCATTER:
            single_error = max(single_error, float(variances.std(ddof=1)))
        dark_variance, dark_error = float(variances.mean()), single_error / np.sqrt(len(variances))
        _set_root(quantities, f"dsnu{suffix}", dark_variance / gain**2, dark_error / gain**2)
        flat_variance, flat_error = _estimate_pattern_variance(flat, field)
        # The variance of the flat has at least the error of a single dark.
        error = float(np.sqrt(max(flat_error, single_error) ** 2 + dark_error**2))
        variance = (flat_variance - dark_variance) * to_percent_squared
        _set_root(quantities, f"prnu{suffix}", variance, error * to_percent_squared)


def _estimate_pattern_variance(level: Level, field: str) -> tuple[float, float]:
    """Return a field of the `PatternVariances` of a level [DN²] and its standard error under white noise.

    The error is √(2/n) (s² + v/2) for the variance s² of n columns, rows or pixels whose means have the temporal
    variance v in one frame. The total counts as a variance of pixels.
    """
    rows, columns = level.shape
    count, pixels_per_mean = {"column": (columns, rows), "row": (rows, columns)}.get(field, (rows * columns, 1))
    variance = float(getattr(level.pattern, field))
    return variance, float(np.sqrt(2 / count) * (max(variance, 0.0) + level.variance / pixels_per_mean / 2))


def _set_root(quantities: QuantityTable, name: str, variance: float, error: float) -> None:
    """Enter the root of a variance, with the standard error that follows from the `error` of the variance.

    A variance below 0 gives 0 with the root of its error as the error. A variance of NaN leaves the quantity unknown.
    """
    if not np.isfinite(variance):
        quantities.set_unknown([name], "a pattern needs frames of more than one row and column")
        return
    value = np.sqrt(max(variance, 0.0))
    # The linear propagation error/(2 value) exceeds √error for values near 0, where it does not apply.
    quantities.set(name, value, min(error / (2 * value) if value > 0 else np.inf, np.sqrt(error)))
