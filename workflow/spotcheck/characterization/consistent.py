"""What cannot be true together: numbers of the data sheet, of flats and darks, and of spots, compared by physics.

Each contradiction is a sentence with keys and values and what would be right; what it makes wrong becomes unknown.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.levels import Level
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.io.plus_minus import plus_minus

# Darks that last this many times as long as the longest frame they serve hold dark current that it has not: more than
# half of theirs.
LONGER = 2.0
# Exposures of darks from which dark current is told, and taken off.
TELL_CURRENT = 3
# Two numbers contradict each other if they differ by more standard errors than SURELY (one in 2e6 by chance), and by
# more than this factor: data sheets are typical values, a dark current doubles with every 7 K, and grain of the
# material that is taken for noise may double a gain by spots.
SURELY = 5.0
FACTOR = {"gain_dn_per_e": 1.3, "read_noise_e": 1.5, "dark_current_e_per_s": 5.0, "quantum_efficiency": 1.3}
BY_SPOTS = 2.0
# What the likelihood of a reading rests on: of two values that contradict each other it takes neither.
SPOILED = ("gain_dn_per_e", "read_noise_e")
# A read noise by darks of no more than this [DN] is only an upper limit: rounding hides it (√(0.24 − 1/12), EMVA 1288).
HIDDEN_DN = 0.4
# Photons are counted by the second, not by the frame, where signal per photon spreads by more than this part, and by
# photon and second this many times less.
SPREADS, STEADIER = 0.1, 5.0
# A black level is too high where frames read less by more than this [DN] beside its own error: medians of whole frames
# are known to better.
BELOW_BLACK_DN = 1.0
# The standard deviation of rounding to whole DN.
ROUNDING_DN = 12**-0.5


class Contradiction(NamedTuple):
    """What cannot be true, in a sentence; the quantities that are unknown because of it, and why in a few words."""

    sentence: str
    unknown: tuple[str, ...] = ()
    why: str = ""


def spread_text(values: Sequence[float], unit: str) -> str:
    """A number or a range with its unit."""
    low, high = min(values), max(values)
    return f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}"


def too_long(darks: Sequence[float], served: Sequence[float], what: str) -> str:
    """Why darks tell no read noise and no offset of the frames they serve, by exposures [s]; "" where they do."""
    darks, served = (sorted({t for t in times if np.isfinite(t)}) for times in (darks, served))
    if not darks or not served or len(darks) >= TELL_CURRENT or darks[0] <= LONGER * served[-1]:
        return ""
    return (
        f"the darks last {spread_text(darks, 's')} and the {what} {spread_text(served, 's')}: how much of the darks'"
        f" level and noise is dark current is not known; take darks of the exposures of the {what}, or of"
        f" {TELL_CURRENT} exposures"
    )


IN_LONG_DARKS = (
    *("dark_offset", "dark_noise_dn", "dark_noise", "threshold", "threshold_photons", "dynamic_range"),
    *(f"{name}{part}" for name in ("dsnu", "prnu") for part in ("", "_column", "_row", "_pixel")),
)
BY_FEW_PHOTONS = ("responsivity", "quantum_efficiency", "saturation_photons", "threshold_photons")
BY_PHOTONS = (
    *("responsivity", "quantum_efficiency", "saturation_photons", "threshold_photons", "full_well", "snr_max"),
    *("dynamic_range", "linearity_error", "linearity_lowest", "linearity_highest"),
)


def in_levels(levels: Sequence[Level], flats: Sequence[Level], signal: np.ndarray, eta) -> list[Contradiction]:
    """What levels of flats and darks contradict: exposures, and photons counted by the second. `flats` are those with
    a `signal` over dark [DN]; `eta` is the quantum efficiency by them (a number with its error, or None)."""
    out = []
    exposures = {kind: [own.exposure_s for own in levels if own.kind == kind] for kind in ("dark", "flat")}
    if why := too_long(exposures["dark"], exposures["flat"], "flats"):
        out.append(Contradiction(why, IN_LONG_DARKS, "the darks last much longer than the flats"))
    photons, seconds = (np.array([getattr(own, name) for own in flats]) for name in ("photons", "exposure_s"))
    use = (
        (photons > 0) & (seconds > 0) & (signal > 0) if len(signal) == len(flats) and len(flats) else np.zeros(0, bool)
    )
    if use.sum() >= 3:
        by_photon, by_both = (_relative_spread(signal[use] / light[use]) for light in (photons, photons * seconds))
        if by_photon > SPREADS and by_both * STEADIER < by_photon:
            why = (
                "manifest.csv: photons_per_px looks like photons a second, since the flats follow photons_per_px times"
                " exposure_s; it must be photons on a pixel during the exposure"
            )
            return [*out, Contradiction(why, BY_PHOTONS, "photons_per_px looks like photons a second")]
    if eta is not None and eta.value - SURELY * eta.stderr > 1:
        why = (
            f"the quantum efficiency would be {plus_minus(eta.value, eta.stderr)} electrons for a photon, and no more"
            " than 1 is possible: photons_per_px of manifest.csv is too small"
        )
        short = "photons_per_px is fewer than the electrons of the flats"
        out.append(Contradiction(why, BY_FEW_PHOTONS, short))
    return out


def _relative_spread(values: np.ndarray) -> float:
    return float(values.std() / values.mean())


class Told(NamedTuple):
    """A number [in the unit of its key] and its standard error (NaN: none stated)."""

    value: float
    stderr: float


def differ(sheet: Told, other: Told, factor: float) -> bool:
    """Whether two numbers differ surely, and by more than a factor."""
    error = float(np.hypot(np.nan_to_num(sheet.stderr), np.nan_to_num(other.stderr)))
    low, high = sorted((sheet.value, other.value))
    return high - low > SURELY * error and high > factor * low


def stated(instrument: Instrument, name: str, value: float) -> str:
    """What a key of the sensor says, and in which file."""
    return f"{instrument.get_file_name(f'sensor.{name}')}: sensor.{name} is {value:g}"


def in_sources(
    instrument: Instrument, sheet: Mapping[str, Told], flats: Mapping[str, Told], spots: Mapping[str, Told]
) -> list[Contradiction]:
    """Keys of the data sheet that flats and darks, or else spots, contradict. Spots may be wrong themselves: what they
    contradict stands."""
    out = []
    for name, factor in FACTOR.items():
        own, source, other = sheet.get(name), "flats and darks give", flats.get(name)
        if other is None:
            factor, source, other = max(factor, BY_SPOTS), "the noise of the spots gives", spots.get(name)
        if own is None or other is None or not differ(own, other, factor):
            continue
        gain = flats.get("gain_dn_per_e") or spots.get("gain_dn_per_e")
        if name == "read_noise_e" and gain and own.value < other.value < HIDDEN_DN / gain.value:
            continue
        right = _right(name, own, other, gain)
        why = (
            f"{stated(instrument, name, own.value)}, but {source}"
            f" {plus_minus(other.value, np.nan_to_num(other.stderr))}{right}"
        )
        out.append(Contradiction(why, (name,) if name in flats and name in SPOILED else ()))
    return out


def _right(name: str, own: Told, other: Told, gain: Told | None) -> str:
    """Which slip would explain a wrong number, as half a sentence."""
    if name == "gain_dn_per_e" and own.value > 0 and not differ(Told(1 / own.value, 0.0), other, 1.2):
        return f"; {own.value:g} e-/DN are {1 / own.value:.4g} DN/e-"
    if name == "read_noise_e" and gain and not differ(Told(own.value / gain.value, 0.0), other, 1.2):
        return f"; {own.value:g} DN are {own.value / gain.value:.4g} e-"
    return ""


def black_too_high(instrument: Instrument, sheet: Told | None, darkest_dn: float) -> Contradiction | None:
    """Whether frames read less than the black level of the data sheet: light only adds."""
    if sheet is None or not sheet.value > darkest_dn + BELOW_BLACK_DN + SURELY * np.nan_to_num(sheet.stderr):
        return None
    return Contradiction(
        f"{stated(instrument, 'black_level_dn', sheet.value)}, but a frame reads {darkest_dn:.4g} DN in most of"
        " its pixels, and light only adds; it must be what the sensor reads without light",
        ("black_level_dn",),
    )


def in_numbers(dataset: Dataset, gain: float, black: Told, end_dn: float, highest_dn: float) -> list[Contradiction]:
    """What the keys of the data sheet contradict in each other, and in the highest reading [DN] (NaN: not known), at
    the gain and the black level that the chain runs on."""
    sheet, out = dataset.instrument, list[Contradiction]()
    given = sheet.sensor
    if not np.isfinite(gain):
        return out
    if given.full_well_e is not None:
        well_dn = black.value + gain * given.full_well_e
        if highest_dn > well_dn + BELOW_BLACK_DN + SURELY * gain * np.sqrt(given.full_well_e):
            why = (
                f"{stated(sheet, 'full_well_e', given.full_well_e)}, which is {well_dn:.4g} DN at a gain of"
                f" {gain:.4g} DN/e-, but frames read up to {highest_dn:g} DN; the well must be at least"
                f" {(highest_dn - black.value) / gain:.5g} e-"
            )
            out.append(Contradiction(why, ("full_well_e",)))
    if given.read_noise_e is not None and 0 < gain * given.read_noise_e < ROUNDING_DN:
        noise_dn = gain * given.read_noise_e
        why = (
            f"{stated(sheet, 'read_noise_e', given.read_noise_e)}, which is {noise_dn:.2g} DN"
            f" at a gain of {gain:.4g} DN/e-: rounding adds {ROUNDING_DN:.2g} DN and hides it"
        )
        out.append(Contradiction(why))
    longest = max((frame.exposure_s or 0.0 for frame in dataset.frames), default=0.0)
    dark_dn = gain * given.dark_current_e_per_s * longest
    if black.value + dark_dn > end_dn:
        why = (
            f"{stated(sheet, 'dark_current_e_per_s', given.dark_current_e_per_s)}, which in {longest:g} s is"
            f" {dark_dn:.4g} DN without any light, above the full scale of {end_dn:g} DN"
        )
        out.append(Contradiction(why))
    return out
