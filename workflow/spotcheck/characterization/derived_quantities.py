"""EMVA 1288 quantities that follow from levels of flats and darks once the gain is known.

Symbols and section numbers are those of EMVA 1288 Release 4.0 Linear. Release 3.1 gives DSNU and PRNU as one number
each, Release 4.0 splits them into columns, rows and pixels; both are computed.
"""

from collections.abc import Sequence

import numpy as np

from spotcheck.characterization.emva_quantities import Quantity, QuantityTable, divide
from spotcheck.characterization.levels import Level, collect, measure_light
from spotcheck.characterization.line_fits import MIN_POINTS, extrapolate_to_zero, fit_line, fit_through_zero
from spotcheck.sensor import ROUNDING_VARIANCE

# Least dark variance [DN²]: below it rounding hides the noise (section 8.2).
MIN_DARK_VARIANCE = 0.24
# Darks of which more than this part of the pixels reads 0 have lost part of their noise.
MAX_PART_AT_ZERO = 5e-3
# Signals between which linearity is assessed, as parts of saturation (section 8.4).
LINEARITY_RANGE = (0.05, 0.95)
# From this number of darks on, their scatter is used as an estimate of the error of a pattern variance.
MIN_DARKS_FOR_SCATTER = 6

NO_PHOTONS = "photons_per_px is not given for the flats"


def set_dark_quantities(
    quantities: QuantityTable, darks: Sequence[Level], noisy_darks: Sequence[Level], remarks: list[str]
) -> None:
    """Enter offset and noise [DN] without light at the shortest exposure (section 8.1).

    `noisy_darks` are the darks of two frames or more, which have a temporal variance. Faults of the darks are appended
    to `remarks`.
    """
    if not darks:
        return
    part_at_zero = max(dark.at_zero for dark in darks)
    if part_at_zero > MAX_PART_AT_ZERO:
        remarks.append(f"{100 * part_at_zero:.2g} % of the pixels of a dark read 0: part of the noise is cut off")
    quantities.set("dark_offset", *_at_no_exposure(darks, "mean"))
    if not noisy_darks:
        return
    variance, error = _at_no_exposure(noisy_darks, "variance")
    if variance < MIN_DARK_VARIANCE:
        remarks.append(
            f"the noise of the darks, {np.sqrt(max(variance, 0.0)):.2g} DN, is below that of rounding: the dark noise"
            " given here is an upper limit"
        )
    noise = np.sqrt(max(variance, MIN_DARK_VARIANCE))
    quantities.set("dark_noise_dn", noise, error / (2 * noise))


def _at_no_exposure(darks: Sequence[Level], column: str) -> tuple[float, float]:
    """Return "mean" or "variance" of the darks at exposure 0 with its standard error."""
    return extrapolate_to_zero(*(collect(darks, name) for name in ("exposure_s", column, f"{column}_error")))


def set_dark_electrons(quantities: QuantityTable, noisy_darks: Sequence[Level]) -> None:
    """Enter dark noise [e-] and dark current [e-/s]; gain and dark noise [DN] must be known."""
    gain, noise_dn = quantities["gain"], quantities["dark_noise_dn"]
    unrounded_dn = np.sqrt(max(noise_dn.value**2 - ROUNDING_VARIANCE, 0.0))
    noise = unrounded_dn / gain.value
    noise_error = noise_dn.value * noise_dn.stderr / max(unrounded_dn, 1e-9) / gain.value
    quantities.set("dark_noise", noise, np.hypot(noise_error, noise * gain.stderr / gain.value))
    darks = [dark for dark in noisy_darks if np.isfinite(dark.exposure_s)]
    exposures = collect(darks, "exposure_s")
    if len(np.unique(exposures)) < MIN_POINTS:
        names = ("dark_current", "dark_current_by_variance")
        quantities.set_unknown(names, "fewer than three exposures of darks")
        return
    # The mean grows by K μ_I t, the variance by K² μ_I t.
    for name, column, power in (("dark_current", "mean", 1), ("dark_current_by_variance", "variance", 2)):
        line = fit_line(exposures, collect(darks, column), collect(darks, f"{column}_error"))
        current = line.slope / gain.value**power
        error = np.hypot(line.slope_error / gain.value**power, power * current * gain.stderr / gain.value)
        quantities.set(name, current, error)


def set_light_quantities(
    quantities: QuantityTable,
    flats: Sequence[Level],
    darks: Sequence[Level],
    signal: np.ndarray,
    fitted: np.ndarray,
    noisiest: int,
    is_saturated: bool,
) -> None:
    """Enter sensitivity, linearity, non-uniformity and saturation (sections 8.2 to 8.4).

    Parameters
    ----------
    quantities : table in which gain and dark noise [DN] are known.
    flats, darks : each flat, by mean, and its dark [flat]; a dark may serve several flats.
    signal : means of the flats over dark [DN], [flat].
    fitted : True for the flats to which the gain was fitted [flat].
    noisiest : index of the flat with the largest noise.
    is_saturated : whether that is saturation; otherwise saturation lies above all flats.
    """
    _set_sensitivity(quantities, flats, signal, fitted)
    _set_linearity(quantities, flats, signal, noisiest)
    half = int(np.argmin(np.abs(signal - signal[noisiest] / 2)))
    _set_nonuniformity(quantities, flats[half], float(signal[half]), darks)
    if is_saturated:
        _set_saturation(quantities, flats, signal, noisiest)
    else:
        quantities.fill_unknown("no flat is saturated")


def _set_sensitivity(quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, fitted: np.ndarray) -> None:
    """Enter responsivity, quantum efficiency and sensitivity thresholds (section 8.2)."""
    ratio, ratio_error = divide(quantities["dark_noise_dn"], quantities["gain"])
    # The threshold μ is the signal that equals its noise: μ² = σ² + μ, so μ = ½ + √(σ² + ¼).
    root = np.sqrt(ratio**2 + 0.25)
    quantities.set("threshold", 0.5 + root, ratio * ratio_error / root)
    photons = collect(flats, "photons")
    use = fitted & (photons > 0)
    if not use.any():
        quantities.set_unknown(("responsivity", "quantum_efficiency", "threshold_photons"), NO_PHOTONS)
        return
    quantities.set("responsivity", *fit_through_zero(photons[use], signal[use], collect(flats, "mean_error")[use]))
    quantities.set("quantum_efficiency", *divide(quantities["responsivity"], quantities["gain"]))
    quantities.set("threshold_photons", *divide(quantities["threshold"], quantities["quantum_efficiency"]))


def _set_saturation(quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, saturation: int) -> None:
    """Enter saturation, full well, largest signal-to-noise ratio and dynamic range (section 8.3).

    The gain and the sensitivity must be known.
    """
    # Saturation lies between the neighbours of the noisiest level: a uniform distribution over half a step to each
    # side.
    quantities.set("saturation_dn", flats[saturation].mean, _step_error(signal, saturation))
    photons = collect(flats, "photons")
    efficiency = quantities["quantum_efficiency"]
    if photons[saturation] > 0 and np.isfinite(efficiency.value):
        # The definition of the standard. With a curved response it exceeds μ_y.sat/K.
        quantities.set("saturation_photons", photons[saturation], _step_error(photons, saturation))
        photons_at_end = quantities["saturation_photons"]
        electrons = photons_at_end.value * efficiency.value
        relative = np.hypot(photons_at_end.stderr / photons_at_end.value, efficiency.stderr / efficiency.value)
        quantities.set("full_well", electrons, electrons * relative)
    else:
        is_given = np.isfinite(efficiency.value)
        reason = "photons_per_px is not given for the flat at saturation" if is_given else NO_PHOTONS
        quantities.set_unknown(["saturation_photons"], reason)
        signal_at_end = Quantity("", "", float(signal[saturation]), quantities["saturation_dn"].stderr, "DN")
        quantities.set("full_well", *divide(signal_at_end, quantities["gain"]))
    well = quantities["full_well"]
    quantities.set("snr_max", np.sqrt(well.value), well.stderr / (2 * np.sqrt(well.value)))
    quantities.set("dynamic_range", *divide(well, quantities["threshold"]))


def _step_error(values: np.ndarray, at: int) -> float:
    """Return the standard deviation of a uniform distribution over half a step to each side of an ascending value."""
    steps = np.abs(np.diff(values[max(at - 1, 0) : at + 2]))
    return float(np.mean(steps) / np.sqrt(12)) if steps.size else 0.0


def _set_linearity(quantities: QuantityTable, flats: Sequence[Level], signal: np.ndarray, saturation: int) -> None:
    """Enter mean, lowest and highest deviation [%] from the line of least relative squares between 5 and 95 % of
    saturation (section 8.4)."""
    light = measure_light(flats)
    low, high = (part * signal[saturation] for part in LINEARITY_RANGE)
    use = (signal >= low) & (signal <= high) & np.isfinite(light) & (np.arange(len(signal)) <= saturation)
    if len(np.unique(light[use])) < MIN_POINTS:
        quantities.set_unknown(
            ("linearity_error", "linearity_lowest", "linearity_highest"),
            "fewer than three levels of different light between 5 and 95 % of saturation",
        )
        return
    x, y = light[use], signal[use]
    slope, offset = np.polyfit(x, y, 1, w=1 / y)
    deviation = 100 * (y / (slope * x + offset) - 1)
    noise = 100 * collect(flats, "mean_error")[use] / y
    mean_error = np.sqrt(np.mean(noise**2) / len(deviation))
    quantities.set("linearity_error", np.mean(np.abs(deviation)), mean_error)
    lowest, highest = np.argmin(deviation), np.argmax(deviation)
    quantities.set("linearity_lowest", deviation[lowest], noise[lowest])
    quantities.set("linearity_highest", deviation[highest], noise[highest])


def _set_nonuniformity(quantities: QuantityTable, flat: Level, signal: float, darks: Sequence[Level]) -> None:
    """Enter DSNU of all darks and PRNU of a flat near half of saturation with a `signal` over dark [DN] (section 8.3).

    The stated error of a pattern variance assumes white noise. With enough darks their scatter replaces it if larger,
    since noise may be correlated over many pixels.
    """
    gain, to_percent = quantities["gain"].value, (100 / signal) ** 2
    different_darks = list({id(dark): dark for dark in darks}.values())
    for suffix, part in {"": "total", "_column": "column", "_row": "row", "_pixel": "pixel"}.items():
        variances, errors = np.array([_pattern_variance(dark, part) for dark in different_darks]).T
        single_error = float(np.sqrt(np.mean(errors**2)))
        if len(variances) >= MIN_DARKS_FOR_SCATTER:
            single_error = max(single_error, float(variances.std(ddof=1)))
        dark_variance, dark_error = float(variances.mean()), single_error / np.sqrt(len(variances))
        _set_root(quantities, f"dsnu{suffix}", dark_variance / gain**2, dark_error / gain**2)
        flat_variance, flat_error = _pattern_variance(flat, part)
        error = float(np.sqrt(max(flat_error, single_error) ** 2 + dark_error**2))
        _set_root(quantities, f"prnu{suffix}", (flat_variance - dark_variance) * to_percent, error * to_percent)


def _pattern_variance(level: Level, part: str) -> tuple[float, float]:
    """Return the variance of a part of the pattern [DN²] and its standard error under white noise.

    The error is √(2/n) (s² + v/2) for n columns, rows or pixels whose means have the temporal variance v.
    """
    rows, columns = level.shape
    count, averaged = {"column": (columns, rows), "row": (rows, columns)}.get(part, (rows * columns, 1))
    variance = float(getattr(level.pattern, part))
    return variance, float(np.sqrt(2 / count) * (max(variance, 0.0) + level.variance / averaged / 2))


def _set_root(quantities: QuantityTable, name: str, variance: float, error: float) -> None:
    """Enter the root of a variance; a variance below 0 gives 0 with the root of its error as the error."""
    if not np.isfinite(variance):
        quantities.set_unknown([name], "a pattern needs frames of more than one row and column")
        return
    value = np.sqrt(max(variance, 0.0))
    quantities.set(name, value, min(error / (2 * value) if value > 0 else np.inf, np.sqrt(error)))
