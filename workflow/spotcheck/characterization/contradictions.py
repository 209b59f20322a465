"""Contradictions between numbers of the data sheet, of flats and darks, and of spots.

Each contradiction is a sentence with the keys, their values and the correction. Quantities that rest on a contradiction
become unknown.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.levels import Level
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.io.number_text import quantity_text

# Darks that last longer than the longest frame they serve by more than this factor contain unknown dark current: more
# than half of theirs.
MAX_EXPOSURE_RATIO = 2.0
# Number of exposures of darks from which the dark current is determined and subtracted.
MIN_DARK_EXPOSURES = 3
# Two numbers contradict each other if they differ by more than this number of standard errors (one in 2e6 by chance),
# and by more than a factor.
MAX_PULL = 5.0
# The factors: data sheets give typical values, and a dark current doubles with every 7 K.
MAX_FACTOR = {"gain_dn_per_e": 1.3, "read_noise_e": 1.5, "dark_current_e_per_s": 5.0, "quantum_efficiency": 1.3}
# Least factor for numbers from spots: grain of the material that counts as noise may double their gain.
MAX_FACTOR_SPOTS = 2.0
# The factor within which a slip of units explains a wrong number.
MAX_FACTOR_SLIP = 1.2
# The likelihood of a reading rests on these: if two values contradict each other, neither is used.
LIKELIHOOD_QUANTITIES = ("gain_dn_per_e", "read_noise_e")
# A read noise from darks up to this [DN] is an upper limit, since rounding hides it (√(0.24 − 1/12), EMVA 1288).
MAX_HIDDEN_NOISE_DN = 0.4
# Photons are stated per second, not per frame, if the relative spread of signal per photon exceeds the first number,
# and that of signal per photon and second is smaller by the second.
MIN_PHOTON_SPREAD, MIN_SPREAD_RATIO = 0.1, 5.0
# Margin [DN] of comparisons with readings of whole frames, beside standard errors: their medians are known to better.
READING_MARGIN_DN = 1.0
# Standard deviation of rounding to whole DN.
ROUNDING_DN = 12**-0.5

# Quantities of EMVA 1288 that are wrong if the darks last too long.
UNKNOWN_BY_LONG_DARKS = (
    *("dark_offset", "dark_noise_dn", "dark_noise", "threshold", "threshold_photons", "dynamic_range"),
    *(f"{name}{part}" for name in ("dsnu", "prnu") for part in ("", "_column", "_row", "_pixel")),
)
# Quantities of EMVA 1288 that are wrong if all photon numbers are wrong by the same factor.
UNKNOWN_BY_PHOTON_SCALE = ("responsivity", "quantum_efficiency", "saturation_photons", "threshold_photons")
# Quantities of EMVA 1288 that are wrong if photon numbers are wrong by different factors.
UNKNOWN_BY_PHOTONS = (
    *UNKNOWN_BY_PHOTON_SCALE,
    *("full_well", "snr_max", "dynamic_range", "linearity_error", "linearity_lowest", "linearity_highest"),
)


class Contradiction(NamedTuple):
    """Numbers that cannot all be right."""

    sentence: str  # the numbers, why they contradict each other, and what to correct
    unknown: tuple[str, ...] = ()  # names of the quantities that are unknown because of it
    reason: str = ""  # why these are unknown, in a few words


class SourceValue(NamedTuple):
    """A sensor value from one source: data sheet, flats and darks, or spots."""

    value: float  # in the unit of the quantity
    stderr: float  # standard error; NaN if unknown
    origin: str  # how the value was obtained
    contradiction: str = ""  # sentence that says why the next source is used instead; "" if nothing contradicts it


# Quantity → value of one source.
SourceValues = Mapping[str, SourceValue]


def describe_long_darks(dark_s: Sequence[float], frame_s: Sequence[float], kind: str) -> str:
    """Return why darks determine neither read noise nor offset of the frames they serve; "" if they do.

    Parameters
    ----------
    dark_s, frame_s : exposures of the darks and of the frames [s]; NaN if unknown.
    kind : what the frames are called in the sentence.
    """
    darks, served = (sorted({t for t in times if np.isfinite(t)}) for times in (dark_s, frame_s))
    if not darks or not served or len(darks) >= MIN_DARK_EXPOSURES or darks[0] <= MAX_EXPOSURE_RATIO * served[-1]:
        return ""
    return (
        f"the darks last {_format_range(darks)} s and the {kind} {_format_range(served)} s: how much of the darks'"
        f" level and noise is dark current is not known; take darks of the exposures of the {kind}, or of"
        f" {MIN_DARK_EXPOSURES} exposures"
    )


def _format_range(ascending: Sequence[float]) -> str:
    """Return the first and last of some numbers as text, or the number if they are equal."""
    low, high = ascending[0], ascending[-1]
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def check_levels(
    levels: Sequence[Level], flats: Sequence[Level], signal: np.ndarray, efficiency: Quantity
) -> Iterator[Contradiction]:
    """Yield the contradictions in exposures and photon numbers of flats and darks.

    Parameters
    ----------
    levels : all levels.
    flats : the levels of light with a dark.
    signal : their means over dark [DN], [flat]; empty if there are no darks.
    efficiency : quantum efficiency from these flats.
    """
    exposures = {kind: [level.exposure_s for level in levels if level.kind == kind] for kind in ("dark", "flat")}
    if sentence := describe_long_darks(exposures["dark"], exposures["flat"], "flats"):
        reason = "the darks last much longer than the flats"
        yield Contradiction(sentence, UNKNOWN_BY_LONG_DARKS, reason)
    if len(signal) and _are_photons_per_second(flats, signal):
        sentence = (
            "manifest.csv: photons_per_px looks like photons a second, since the flats follow photons_per_px times"
            " exposure_s; it must be photons on a pixel during the exposure"
        )
        reason = "photons_per_px looks like photons a second"
        yield Contradiction(sentence, UNKNOWN_BY_PHOTONS, reason)
    elif efficiency.value - MAX_PULL * efficiency.stderr > 1:
        sentence = (
            f"the quantum efficiency would be {quantity_text(efficiency.value, efficiency.stderr)} electrons for a"
            " photon, and no more than 1 is possible: photons_per_px of manifest.csv is too small"
        )
        reason = "photons_per_px is fewer than the electrons of the flats"
        yield Contradiction(sentence, UNKNOWN_BY_PHOTON_SCALE, reason)


def _are_photons_per_second(flats: Sequence[Level], signal: np.ndarray) -> bool:
    """Return whether the signal [flat] follows photons times exposure much better than photons."""
    photons, exposure_s = (np.array([getattr(flat, name) for flat in flats]) for name in ("photons", "exposure_s"))
    use = (photons > 0) & (exposure_s > 0) & (signal > 0)
    if np.count_nonzero(use) < 3:
        return False
    ratios = [signal[use] / light[use] for light in (photons, photons * exposure_s)]
    by_photons, by_both = (float(ratio.std() / ratio.mean()) for ratio in ratios)
    return by_photons > MIN_PHOTON_SPREAD and by_both * MIN_SPREAD_RATIO < by_photons


def differ_significantly(first: SourceValue, second: SourceValue, factor: float) -> bool:
    """Return whether two numbers differ by more than `MAX_PULL` standard errors and by more than a factor."""
    error = float(np.hypot(np.nan_to_num(first.stderr), np.nan_to_num(second.stderr)))
    low, high = sorted((first.value, second.value))
    return high - low > MAX_PULL * error and high > factor * low


def describe_key(instrument: Instrument, name: str) -> str:
    """Return file, key and value of a quantity of the data sheet as the start of a sentence."""
    return f"{instrument.get_file_name(f'sensor.{name}')}: sensor.{name} is {getattr(instrument.sensor, name):g}"


def compare_sources(
    instrument: Instrument, sheet: SourceValues, flats: SourceValues, spots: SourceValues
) -> Iterator[Contradiction]:
    """Yield the contradictions between the data sheet and flats and darks, or spots if there are no flats and darks.

    Only flats and darks make a quantity unknown: spots may be wrong themselves.
    """
    for name, factor in MAX_FACTOR.items():
        source, measured = "flats and darks give", flats.get(name)
        if measured is None:
            factor, source, measured = max(factor, MAX_FACTOR_SPOTS), "the noise of the spots gives", spots.get(name)
        stated = sheet.get(name)
        if stated is None or measured is None or not differ_significantly(stated, measured, factor):
            continue
        gain = flats.get("gain_dn_per_e") or spots.get("gain_dn_per_e")
        if name == "read_noise_e" and gain and stated.value < measured.value < MAX_HIDDEN_NOISE_DN / gain.value:
            continue
        number = quantity_text(measured.value, measured.stderr)
        suggestion = _suggest_unit(name, stated, measured, gain)
        sentence = f"{describe_key(instrument, name)}, but {source} {number}{suggestion}"
        unknown = (name,) if name in flats and name in LIKELIHOOD_QUANTITIES else ()
        yield Contradiction(sentence, unknown)


def _suggest_unit(name: str, stated: SourceValue, measured: SourceValue, gain: SourceValue | None) -> str:
    """Return the confusion of units that explains a wrong gain or read noise, as half a sentence; "" if none does."""
    if name == "gain_dn_per_e" and stated.value > 0:
        inverse = 1 / stated.value
        if not differ_significantly(stated._replace(value=inverse, stderr=0.0), measured, MAX_FACTOR_SLIP):
            return f"; {stated.value:g} e-/DN are {inverse:.4g} DN/e-"
    if name == "read_noise_e" and gain:
        electrons = stated.value / gain.value
        if not differ_significantly(stated._replace(value=electrons, stderr=0.0), measured, MAX_FACTOR_SLIP):
            return f"; {stated.value:g} DN are {electrons:.4g} e-"
    return ""


def check_black_level(instrument: Instrument, sheet: SourceValue | None, darkest_dn: float) -> Contradiction | None:
    """Return the contradiction of a black level on the data sheet that exceeds a frame's level; None if there is none.

    Light only adds to a reading. `darkest_dn` is the lowest level of any frame [DN].
    """
    if sheet is None or not sheet.value > darkest_dn + READING_MARGIN_DN + MAX_PULL * np.nan_to_num(sheet.stderr):
        return None
    return Contradiction(
        f"{describe_key(instrument, 'black_level_dn')}, but a frame reads {darkest_dn:.4g} DN in most of"
        " its pixels, and light only adds; it must be what the sensor reads without light",
        ("black_level_dn",),
    )


def check_sensor_keys(
    dataset: Dataset, gain: float, black_dn: float, full_scale_dn: float, highest_dn: float
) -> Iterator[Contradiction]:
    """Yield the contradictions of keys of the data sheet with each other and with the readings.

    Parameters
    ----------
    dataset : dataset with its data sheet.
    gain, black_dn : gain [DN/e-] and black level [DN] in use; without a gain (NaN) nothing is checked.
    full_scale_dn : largest possible reading [DN].
    highest_dn : largest reading of all frames [DN]; NaN if unknown.
    """
    if not np.isfinite(gain):
        return
    instrument, sensor = dataset.instrument, dataset.instrument.sensor
    if sensor.full_well_e is not None:
        well_dn = black_dn + gain * sensor.full_well_e
        if highest_dn > well_dn + READING_MARGIN_DN + MAX_PULL * gain * np.sqrt(sensor.full_well_e):
            sentence = (
                f"{describe_key(instrument, 'full_well_e')}, which is {well_dn:.4g} DN at a gain of {gain:.4g} DN/e-,"
                f" but frames read up to {highest_dn:g} DN; the well must be at least"
                f" {(highest_dn - black_dn) / gain:.5g} e-"
            )
            yield Contradiction(sentence, ("full_well_e",))
    if sensor.read_noise_e is not None and 0 < gain * sensor.read_noise_e < ROUNDING_DN:
        sentence = (
            f"{describe_key(instrument, 'read_noise_e')}, which is {gain * sensor.read_noise_e:.2g} DN at a gain of"
            f" {gain:.4g} DN/e-: rounding adds {ROUNDING_DN:.2g} DN and hides it"
        )
        yield Contradiction(sentence)
    longest_s = max((frame.exposure_s or 0.0 for frame in dataset.frames), default=0.0)
    dark_dn = gain * sensor.dark_current_e_per_s * longest_s
    if black_dn + dark_dn > full_scale_dn:
        sentence = (
            f"{describe_key(instrument, 'dark_current_e_per_s')}, which in {longest_s:g} s is {dark_dn:.4g} DN without"
            f" any light, above the full scale of {full_scale_dn:g} DN"
        )
        yield Contradiction(sentence)
