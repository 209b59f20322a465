"""Photon transfer: gain, noise, full well, linearity and non-uniformity of a sensor, from levels of flats and darks.

After EMVA 1288 Release 4.0 Linear, with its symbols; each quantity has a standard error, or the reason why it is not
known. Release 3.1 differs in the pattern: it takes DSNU and PRNU as one number each, where 4.0 splits columns, rows and
pixels; here both are given.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.consistent import in_levels
from spotcheck.characterization.levels import Level
from spotcheck.io.plus_minus import plus_minus
from spotcheck.sensor import ROUNDING_VARIANCE

# Parts of saturation between which gain and responsivity (section 8.2), and linearity (section 8.4), are fitted.
SENSITIVE, LINEAR = (0.0, 0.7), (0.05, 0.95)
# Below this variance [DN²] rounding hides the noise (section 8.2).
LEAST_DARK = 0.24
# A dark level this part of full scale above the line through all holds light.
LIT = 1e-3
# Darks of which more pixels than this read 0 have lost part of their noise.
MOST_AT_ZERO = 5e-3
# Parts of saturation up to which gain and intercept are compared.
RANGES = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0)
LEAST_LEVELS = 3
# A gain is seen from this many standard errors on.
SEEN = 3.0
SILENT = "the noise of the flats does not grow with their light"


# Name → symbol of the standard, unit and meaning, in the order in which they are told.
QUANTITIES = {
    "gain": ("K", "DN/e-", "overall gain"),
    "dark_offset": ("μ_y.dark", "DN", "dark offset at the shortest exposure"),
    "dark_noise_dn": ("σ_y.dark", "DN", "noise without light, with rounding"),
    "dark_noise": ("σ_d", "e-", "noise without light"),
    "dark_current": ("μ_I", "e-/s", "dark current, by the mean"),
    "dark_current_by_variance": ("μ_I.var", "e-/s", "dark current, by the noise"),
    "responsivity": ("R", "DN/p", "responsivity"),
    "quantum_efficiency": ("η", "1", "quantum efficiency"),
    "saturation_dn": ("μ_y.sat", "DN", "reading at saturation"),
    "saturation_photons": ("μ_p.sat", "p", "photons at saturation"),
    "full_well": ("μ_e.sat", "e-", "saturation capacity (full well)"),
    "snr_max": ("SNR_max", "1", "largest signal-to-noise ratio"),
    "threshold_photons": ("μ_p.min", "p", "absolute sensitivity threshold, photons"),
    "threshold": ("μ_e.min", "e-", "absolute sensitivity threshold"),
    "dynamic_range": ("DR", "1", "dynamic range"),
    "linearity_error": ("LE", "%", "linearity error, mean"),
    "linearity_lowest": ("LE_min", "%", "linearity error, lowest"),
    "linearity_highest": ("LE_max", "%", "linearity error, highest"),
    "dsnu": ("DSNU", "e-", "dark signal non-uniformity"),
    "dsnu_column": ("DSNU_col", "e-", "dark signal non-uniformity of columns"),
    "dsnu_row": ("DSNU_row", "e-", "dark signal non-uniformity of rows"),
    "dsnu_pixel": ("DSNU_pix", "e-", "dark signal non-uniformity of pixels"),
    "prnu": ("PRNU", "%", "photo response non-uniformity"),
    "prnu_column": ("PRNU_col", "%", "photo response non-uniformity of columns"),
    "prnu_row": ("PRNU_row", "%", "photo response non-uniformity of rows"),
    "prnu_pixel": ("PRNU_pix", "%", "photo response non-uniformity of pixels"),
}


class Quantity(NamedTuple):
    """A measured number with its standard error (NaN: unknown), unit, symbol of the standard, and why it is not known
    ("" where it is)."""

    name: str
    symbol: str
    value: float
    stderr: float
    unit: str
    why: str = ""

    def __str__(self) -> str:
        if not np.isfinite(self.value):
            return f"{self.symbol} is unknown: {self.why}"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.symbol} = {plus_minus(self.value, self.stderr)}{unit}"


class Line(NamedTuple):
    """A straight line: slope and intercept with standard errors, χ² per degree of freedom."""

    slope: float
    slope_error: float
    intercept: float
    intercept_error: float
    chi2: float


class Transfer(NamedTuple):
    """What flats and darks show: usable levels by light (flats with a dark of their exposure, or the nearest), their
    signal and noise over dark [DN, DN²] with errors, which of them gain is fitted to, the index of saturation, all
    quantities by name, and remarks on what could not be used."""

    flats: list[Level]
    darks: list[Level]
    signal: np.ndarray
    excess: np.ndarray
    excess_error: np.ndarray
    fitted: np.ndarray
    saturation: int | None
    quantities: dict[str, Quantity]
    remarks: list[str]


def through_zero(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Slope of the line through 0 by least squares, and its standard error from the errors of y, or from what is left
    where that is more."""
    square = float(x @ x)
    slope = float(x @ y) / square
    rest = y - slope * x
    excess = float(np.mean(rest**2 / error**2)) * len(x) / max(len(x) - 1, 1)
    own = float(np.sqrt((x**2) @ error**2)) / square
    return slope, own * float(np.sqrt(max(excess, 1.0)))


def line(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> Line:
    """The weighted line through points with standard errors, which grow where it does not fit."""
    weight = 1 / error**2
    mean = float((weight * x).sum() / weight.sum())
    spread = float((weight * (x - mean) ** 2).sum())
    slope = float((weight * (x - mean) * y).sum() / spread)
    at_mean = float((weight * y).sum() / weight.sum())
    chi2 = float((weight * (y - at_mean - slope * (x - mean)) ** 2).sum()) / max(len(x) - 2, 1)
    scale = np.sqrt(max(chi2, 1.0)) if len(x) > 2 else 1.0
    intercept_error = float(np.sqrt(1 / weight.sum() + mean**2 / spread)) * scale
    return Line(slope, float(spread**-0.5) * scale, at_mean - slope * mean, intercept_error, chi2)


def transfer_of(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Everything that the levels allow; what contradictions among them make wrong is unknown."""
    found = _by_levels(levels, full_scale_dn)
    quantities, eta = dict(found.quantities), found.quantities.get("quantum_efficiency")
    known = eta if eta is not None and np.isfinite(eta.value) else None
    for own in in_levels(levels, found.flats, found.signal, known):
        found.remarks.append(own.sentence)
        quantities |= {name: unknown(name, own.why) for name in own.unknown if name in quantities}
    return found._replace(quantities=quantities)


def _by_levels(levels: Sequence[Level], full_scale_dn: float) -> Transfer:
    """Everything that the levels allow if they are what the manifest says."""
    remarks: list[str] = []
    darks, lit = _dark([own for own in levels if own.kind == "dark"], full_scale_dn)
    if lit:
        remarks.append(f"{lit} of {lit + len(darks)} dark levels hold light and are left out")
    paired = [own for own in levels if own.kind == "flat" and own.frames > 1]
    single = sum(own.kind == "flat" for own in levels) - len(paired)
    if single:
        remarks.append(
            f"{single} flat level{'s have' if single > 1 else ' has'} a single frame, and noise needs two of one light"
        )
    flats = sorted(paired, key=lambda own: own.mean)
    quantities: dict[str, Quantity] = {}
    noisy_darks = [own for own in darks if own.frames > 1]
    _dark_quantities(quantities, darks, noisy_darks, remarks)
    if not flats or not noisy_darks:
        why = "there are no flats in pairs" if not flats else "there are no dark frames in pairs"
        none = np.zeros(0)
        _unknown(quantities, why)
        return Transfer(flats, darks, none, none, none, none.astype(bool), None, quantities, remarks)
    own_dark = [_nearest(noisy_darks, flat.exposure_s) for flat in flats]
    signal = np.array([flat.mean - dark.mean for flat, dark in zip(flats, own_dark, strict=True)])
    excess = np.array([flat.variance - dark.variance for flat, dark in zip(flats, own_dark, strict=True)])
    error = np.array(
        [np.hypot(flat.variance_error, dark.variance_error) for flat, dark in zip(flats, own_dark, strict=True)]
    )
    error = np.maximum(error, 1e-6)
    top = saturation_of(excess)
    open_end = top == len(flats) - 1 and flats[top].at_full < 1e-3
    if all(own.at_full > 0.5 for own in flats):
        remarks.append("every flat is saturated")
        _unknown(quantities, "every flat is saturated")
        return Transfer(flats, darks, signal, excess, error, np.zeros(len(flats), bool), None, quantities, remarks)
    if not (excess > SEEN * error).any():
        _unknown(quantities, SILENT)
        return Transfer(flats, darks, signal, excess, error, np.zeros(len(flats), bool), None, quantities, remarks)
    limit = SENSITIVE[1] * signal[top]
    fitted = (signal > 0) & (signal <= limit) & (np.arange(len(flats)) <= top)
    if open_end:
        remarks.append("the noise still grows at the brightest flat: saturation lies above it")
        fitted = (signal > 0) & (np.arange(len(flats)) <= top)
    if not fitted.any():
        _unknown(quantities, "no flat lies below 70 % of saturation")
        return Transfer(flats, darks, signal, excess, error, fitted, top, quantities, remarks)
    gain, gain_error = through_zero(signal[fitted], excess[fitted], _with_shared(signal, error, fitted, own_dark))
    if not gain > SEEN * gain_error:
        _unknown(quantities, SILENT)
        return Transfer(flats, darks, signal, excess, error, np.zeros(len(flats), bool), None, quantities, remarks)
    _put(quantities, "gain", gain, gain_error)
    _dark_in_electrons(quantities, noisy_darks, gain, gain_error)
    _light_quantities(quantities, flats, signal, fitted, top, open_end)
    _pattern_quantities(quantities, flats, own_dark, signal, top)
    return Transfer(flats, darks, signal, excess, error, fitted, None if open_end else top, quantities, remarks)


class Range(NamedTuple):
    """Gain [DN/e-] and intercept [DN] of the line of response, with standard errors, of the levels up to a part of
    saturation; how many levels they are."""

    limit: float
    levels: int
    gain: float
    gain_error: float
    intercept: float
    intercept_error: float


def light_of(flats: Sequence[Level]) -> np.ndarray:
    """Light of every flat: photons where all have them, else the exposure [s]."""
    photons = np.array([own.photons for own in flats])
    return photons if np.isfinite(photons).all() and photons.any() else np.array([own.exposure_s for own in flats])


def by_range(found: Transfer) -> list[Range]:
    """How gain and intercept depend on the range that is fitted: on a linear sensor they do not."""
    if found.saturation is None or not found.fitted.any():
        return []
    light = light_of(found.flats)
    error = np.maximum([own.mean_error for own in found.flats], 1e-9)
    out = []
    for limit in RANGES:
        use = (found.signal > 0) & (found.signal <= limit * found.signal[found.saturation])
        use &= np.arange(len(found.flats)) <= found.saturation
        if np.count_nonzero(use) < LEAST_LEVELS or len(np.unique(light[use])) < LEAST_LEVELS:
            continue
        gain, gain_error = through_zero(found.signal[use], found.excess[use], found.excess_error[use])
        # As linear regression has it, every level alike: weights would hide the bend.
        own = line(light[use], found.signal[use], np.full(np.count_nonzero(use), float(np.mean(error[use]))))
        out.append(Range(limit, int(np.count_nonzero(use)), gain, gain_error, own.intercept, own.intercept_error))
    return out


def saturation_of(excess: np.ndarray) -> int:
    """Index of the level at which the noise is largest, the saturation point of the standard (section 8.3)."""
    return int(np.argmax(excess))


def _with_shared(signal: np.ndarray, error: np.ndarray, fitted: np.ndarray, darks: Sequence[Level]) -> np.ndarray:
    """Errors of the points of a fit through 0; a dark that all share moves them together, as much as this."""
    used = [dark for dark, own in zip(darks, fitted, strict=True) if own]
    if len({id(dark) for dark in used}) > 1 or len(used) < 2:
        return error[fitted]
    x, shared = signal[fitted], used[0].variance_error
    own = error[fitted] ** 2 - shared**2
    # The same variance of the slope, spread over the points: (Σx)² s² = Σ x² (extra).
    extra = shared**2 * x.sum() ** 2 / (x @ x)
    return np.sqrt(np.maximum(own, 0.0) + extra)


def _dark(darks: list[Level], full_scale_dn: float) -> tuple[list[Level], int]:
    """Dark levels without light in them, by exposure, and how many had some. Half of them at least are dark."""
    if len(darks) < LEAST_LEVELS:
        return sorted(darks, key=lambda own: own.exposure_s), 0
    exposure = np.array([np.nan_to_num(own.exposure_s) for own in darks])
    mean = np.array([own.mean for own in darks])
    # Medians of all slopes and offsets: neither is moved by less than a third of lit levels (Theil 1950, Sen 1968).
    first, second = np.triu_indices(len(darks), 1)
    apart = exposure[first] != exposure[second]
    rise = (mean[second] - mean[first])[apart] / (exposure[second] - exposure[first])[apart]
    slope = float(np.median(rise)) if rise.size else 0.0
    off = mean - slope * exposure
    good = off <= np.median(off) + LIT * full_scale_dn
    kept = [own for own, dark in zip(darks, good, strict=True) if dark]
    return sorted(kept, key=lambda own: own.exposure_s), int((~good).sum())


def _nearest(darks: Sequence[Level], exposure_s: float) -> Level:
    """The dark whose exposure is nearest."""
    return min(darks, key=lambda own: abs(np.nan_to_num(own.exposure_s) - np.nan_to_num(exposure_s)))


def _put(out: dict[str, Quantity], name: str, value: float, stderr: float) -> None:
    symbol, unit, _ = QUANTITIES[name]
    out[name] = Quantity(name, symbol, float(value), float(stderr), unit)


def unknown(name: str, why: str) -> Quantity:
    """A quantity that is not known, and why."""
    symbol, unit, _ = QUANTITIES[name]
    return Quantity(name, symbol, np.nan, np.nan, unit, why)


def _unknown(out: dict[str, Quantity], why: str) -> None:
    """What is not there yet stays unknown for one reason."""
    for name in QUANTITIES:
        out.setdefault(name, unknown(name, why))


def _dark_quantities(
    out: dict[str, Quantity], darks: Sequence[Level], noisy: Sequence[Level], remarks: list[str]
) -> None:
    """Offset and noise without light, at the shortest exposures (section 8.1)."""
    if not darks:
        return
    cut = max(own.at_zero for own in darks)
    if cut > MOST_AT_ZERO:
        remarks.append(f"{100 * cut:.2g} % of the pixels of a dark read 0: part of the noise is cut off")
    offset = _at_zero([(own.exposure_s, own.mean, own.mean_error) for own in darks])
    _put(out, "dark_offset", *offset)
    if noisy:
        variance, error = _at_zero([(own.exposure_s, own.variance, own.variance_error) for own in noisy])
        least = max(variance, LEAST_DARK)
        if variance < LEAST_DARK:
            remarks.append(
                f"the darks' noise of {np.sqrt(max(variance, 0.0)):.2g} DN is below that of rounding: their noise is at"
                " most what is given"
            )
        _put(out, "dark_noise_dn", np.sqrt(least), error / (2 * np.sqrt(least)))


def _at_zero(points: Sequence[tuple[float, float, float]]) -> tuple[float, float]:
    """Value and standard error at exposure 0: of the line where there are three exposures, else at the shortest."""
    x, y, error = np.array(points, float).T
    error = np.maximum(error, 1e-9)
    x = np.nan_to_num(x)
    if len(np.unique(x)) >= LEAST_LEVELS:
        own = line(x, y, error)
        return own.intercept, own.intercept_error
    short = x == x.min()
    weight = 1 / error[short] ** 2
    return float((weight * y[short]).sum() / weight.sum()), float(weight.sum() ** -0.5)


def _dark_in_electrons(out: dict[str, Quantity], darks: Sequence[Level], gain: float, gain_error: float) -> None:
    """Dark noise and dark current in electrons."""
    noise = out["dark_noise_dn"]
    variance = max(noise.value**2 - ROUNDING_VARIANCE, 0.0)
    own = np.sqrt(variance) / gain
    by_noise = noise.value * noise.stderr / max(np.sqrt(variance), 1e-9) / gain
    _put(out, "dark_noise", own, np.hypot(by_noise, own * gain_error / gain))
    exposures = np.array([own.exposure_s for own in darks])
    if len(np.unique(exposures[np.isfinite(exposures)])) < LEAST_LEVELS:
        why = "fewer than three exposures of darks"
        for name in ("dark_current", "dark_current_by_variance"):
            out[name] = unknown(name, why)
        return
    for name, column, power in (("dark_current", "mean", 1), ("dark_current_by_variance", "variance", 2)):
        values = np.array([getattr(own, column) for own in darks])
        errors = np.maximum([getattr(own, f"{column}_error") for own in darks], 1e-9)
        found = line(exposures, values, errors)
        current = found.slope / gain**power
        error = np.hypot(found.slope_error / gain**power, power * current * gain_error / gain)
        _put(out, name, current, float(error))


def _light_quantities(
    out: dict[str, Quantity], flats: Sequence[Level], signal: np.ndarray, fitted: np.ndarray, top: int, open_end: bool
) -> None:
    """Responsivity, quantum efficiency, saturation, sensitivity and linearity (sections 8.2 and 8.4)."""
    photons = np.array([own.photons for own in flats])
    given = np.isfinite(photons) & (photons > 0)
    errors = np.maximum([own.mean_error for own in flats], 1e-9)
    _linearity(out, light_of(flats), signal, errors, top)
    gain, noise = out["gain"], out["dark_noise_dn"]
    ratio, ratio_error = _ratio(noise, gain)
    # The signal that is as large as its noise: μ² = σ² + μ, so μ = ½ + √(σ² + ¼).
    least = 0.5 + np.sqrt(ratio**2 + 0.25)
    _put(out, "threshold", least, ratio * ratio_error / np.sqrt(ratio**2 + 0.25))
    use = fitted & given
    if use.any():
        _put(out, "responsivity", *through_zero(photons[use], signal[use], errors[use]))
        _put(out, "quantum_efficiency", *_ratio(out["responsivity"], gain))
        _put(out, "threshold_photons", *_ratio(out["threshold"], out["quantum_efficiency"]))
    else:
        for name in ("responsivity", "quantum_efficiency", "threshold_photons", "saturation_photons"):
            out[name] = unknown(name, "photons_per_px is not given for the flats")
    if open_end:
        for name in ("saturation_dn", "full_well", "saturation_photons", "snr_max", "dynamic_range"):
            out[name] = unknown(name, "no flat is saturated")
        return
    # Somewhere between the levels beside the noisiest one: a uniform law over half a step to each side.
    _put(out, "saturation_dn", flats[top].mean, _half_step(signal, top))
    if use.any() and given[top]:
        # As the standard has it; a response that bends makes it more than μ_y.sat/K.
        _put(out, "saturation_photons", photons[top], _half_step(photons, top))
        sat, eta = out["saturation_photons"], out["quantum_efficiency"]
        well = sat.value * eta.value
        well_error = well * np.hypot(sat.stderr / sat.value, eta.stderr / eta.value)
    else:
        in_dn = Quantity("", "", float(signal[top]), out["saturation_dn"].stderr, "DN")
        well, well_error = _ratio(in_dn, gain)
    _put(out, "full_well", well, well_error)
    _put(out, "snr_max", np.sqrt(well), well_error / (2 * np.sqrt(well)))
    _put(out, "dynamic_range", *_ratio(out["full_well"], out["threshold"]))


def _ratio(over: Quantity, under: Quantity) -> tuple[float, float]:
    """Quotient of two quantities with its standard error."""
    value = over.value / under.value
    return value, float(np.hypot(over.stderr / under.value, value * under.stderr / under.value))


def _half_step(values: np.ndarray, at: int) -> float:
    """Standard deviation of a uniform law over half a step to each side of one of ascending values."""
    steps = np.abs(np.diff(values[max(at - 1, 0) : at + 2]))
    return float(np.mean(steps) / np.sqrt(12)) if steps.size else 0.0


def _linearity(out: dict[str, Quantity], light: np.ndarray, signal: np.ndarray, error: np.ndarray, top: int) -> None:
    """Deviations from the line of least relative squares between 5 and 95 % of saturation: mean of their absolute
    values, lowest and highest [%] (section 8.4)."""
    low, high = (part * signal[top] for part in LINEAR)
    use = (signal >= low) & (signal <= high) & np.isfinite(light) & (np.arange(len(signal)) <= top)
    names = ("linearity_error", "linearity_lowest", "linearity_highest")
    if len(np.unique(light[use])) < LEAST_LEVELS:
        why = "fewer than three levels of different light between 5 and 95 % of saturation"
        out.update({name: unknown(name, why) for name in names})
        return
    x, y = light[use], signal[use]
    slope, offset = np.polyfit(x, y, 1, w=1 / y)
    off = 100 * (y / (slope * x + offset) - 1)
    noise = 100 * error[use] / y
    _put(out, names[0], np.mean(np.abs(off)), np.sqrt(np.mean(noise**2) / len(off)))
    for name, k in ((names[1], int(np.argmin(off))), (names[2], int(np.argmax(off)))):
        _put(out, name, off[k], noise[k])


def _pattern_quantities(
    out: dict[str, Quantity], flats: Sequence[Level], darks: Sequence[Level], signal: np.ndarray, top: int
) -> None:
    """DSNU of all darks, PRNU of the flat nearest to half of saturation (section 8.3). Noise may hang together over
    many pixels: where there are darks enough, their scatter says how well a pattern is known."""
    gain = out["gain"].value
    half = int(np.argmin(np.abs(signal - signal[top] / 2)))
    different = list({id(own): own for own in darks}.values())
    for suffix, field in {"": "total", "_column": "column", "_row": "row", "_pixel": "pixel"}.items():
        own = np.array([_of_pattern(level, field) for level in different])
        by_dark = float(own[:, 0].mean())
        one = float(np.sqrt(np.mean(own[:, 1] ** 2)))
        if len(own) >= 2 * LEAST_LEVELS:
            one = max(one, float(own[:, 0].std(ddof=1)))
        dark_error = one / np.sqrt(len(own))
        by_light, light_error = _of_pattern(flats[half], field)
        _root(out, f"dsnu{suffix}", by_dark / gain**2, dark_error / gain**2)
        scale = (100 / signal[half]) ** 2
        error = float(np.sqrt(max(light_error, one) ** 2 + dark_error**2))
        _root(out, f"prnu{suffix}", (by_light - by_dark) * scale, error * scale)


def _of_pattern(level: Level, field: str) -> tuple[float, float]:
    """Variance of a part of the pattern [DN²], and its standard error under white noise: of n numbers of variance s²
    under noise v it is √(2/n) (s² + v/2)."""
    rows, columns = level.shape
    n, lines = {"column": (columns, rows), "row": (rows, columns)}.get(field, (rows * columns, 1))
    own = float(getattr(level.spatial, field))
    return own, float(np.sqrt(2 / n) * (max(own, 0.0) + level.variance / lines / 2))


def _root(out: dict[str, Quantity], name: str, square: float, error: float) -> None:
    """√ of a variance; one that is below 0 by chance is 0, as uncertain as the root of its error."""
    if not np.isfinite(square):
        out[name] = unknown(name, "a pattern needs frames of more than one row and column")
        return
    value = np.sqrt(max(square, 0.0))
    own = min(error / (2 * value) if value > 0 else np.inf, np.sqrt(error))
    _put(out, name, value, float(own))
