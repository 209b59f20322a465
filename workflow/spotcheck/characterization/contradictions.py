"""Contradictions between the values of a sensor from three sources: data sheet, flats and darks, and spots.

Flats are frames of uniform light, darks are frames without light. A level is all flats or darks of one light and one
exposure. The data sheet is instrument.yaml. Each contradiction is a sentence with the keys, their values and the
correction. Quantities that depend on contradictory values become unknown.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.levels import Level
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.io.number_text import quantity_text

# Largest ratio of the shortest exposure of the darks to the longest of the frames from which they are subtracted. Above
# it, more than half of the dark current in the darks is not in the frames.
MAX_EXPOSURE_RATIO = 2.0
# Number of exposures of darks from which the dark current is determined and subtracted.
MIN_DARK_EXPOSURES = 3
# Two values contradict each other if they differ by more than this number of combined standard errors (one in 2e6 by
# chance), and by more than a factor.
MAX_PULL = 5.0
# The factor of each quantity: data sheets give typical values, and a dark current doubles with every 7 K.
MAX_FACTOR = {"gain_dn_per_e": 1.3, "read_noise_e": 1.5, "dark_current_e_per_s": 5.0, "quantum_efficiency": 1.3}
# Least factor for values from spots: grain of the material that counts as noise may double their gain.
MAX_FACTOR_SPOTS = 2.0
# A confusion of units explains a wrong value if the converted value agrees with the measured one within this factor.
MAX_FACTOR_SLIP = 1.2
# The likelihood of a reading depends on these: if two of their values contradict each other, neither is used.
LIKELIHOOD_QUANTITIES = ("gain_dn_per_e", "read_noise_e")
# A read noise from darks up to this [DN] is an upper limit, since rounding hides it (√(0.24 − 1/12), EMVA 1288).
MAX_HIDDEN_NOISE_DN = 0.4
# Photons are stated per second, not per frame, if the relative spread of signal/photons exceeds the first number, and
# that of signal/(photons × exposure) is smaller by the factor of the second number. Both need this number of flats.
MIN_PHOTON_SPREAD, MIN_SPREAD_RATIO, MIN_FLATS_FOR_SPREAD = 0.1, 5.0, 3
# Margin [DN], beside standard errors, of comparisons with the median or maximum of a frame.
READING_MARGIN_DN = 1.0
# Standard deviation of rounding to whole DN.
ROUNDING_DN = 12**-0.5

# Quantities of EMVA 1288 that are wrong if the darks last too long.
UNKNOWN_BY_LONG_DARKS = (
    *("dark_offset", "dark_noise_dn", "dark_noise", "threshold", "threshold_photons", "dynamic_range"),
    *(f"{name}{suffix}" for name in ("dsnu", "prnu") for suffix in ("", "_column", "_row", "_pixel")),
)
# Quantities of EMVA 1288 that are wrong if all photon numbers are wrong by the same factor.
UNKNOWN_BY_PHOTON_SCALE = ("responsivity", "quantum_efficiency", "saturation_photons", "threshold_photons")
# Quantities of EMVA 1288 that are wrong if photon numbers are wrong by different factors.
UNKNOWN_BY_PHOTONS = (
    *UNKNOWN_BY_PHOTON_SCALE,
    *("full_well", "snr_max", "dynamic_range", "linearity_error", "linearity_lowest", "linearity_highest"),
)


class Contradiction(NamedTuple):
    """A contradiction between values of a sensor."""

    sentence: str  # the values, why they contradict each other, and what to correct
    affected_names: tuple[str, ...] = ()  # names of the quantities that become unknown because of it
    reason: str = ""  # why these are unknown, in a few words; "" where `sentence` gives the reason


class SourceValue(NamedTuple):
    """A sensor value from one source: data sheet, flats and darks, or spots."""

    value: float  # in the unit of the quantity; NaN if unknown
    stderr: float  # standard error in the same unit; NaN if unknown
    origin: str  # how the value was obtained
    contradiction: str = ""  # sentence that says why the next source is used instead; "" if nothing contradicts it


# Name of a quantity → its value from one source. Quantities that the source does not give are missing.
SourceValues = Mapping[str, SourceValue]


def describe_long_darks(dark_exposures_s: Sequence[float], frame_exposures_s: Sequence[float], kind: str) -> str:
    """Return a sentence that the darks last too long to give the read noise and offset of other frames; "" if not.

    Darks of `MIN_DARK_EXPOSURES` different exposures are never too long, since they determine the dark current.

    Parameters
    ----------
    dark_exposures_s, frame_exposures_s : exposures of the darks and of the other frames [s], in any order and number;
        NaN if unknown. Without a known exposure of both, nothing is compared.
    kind : name of the other frames in the sentence, such as "flats".
    """
    # Different known exposures, ascending.
    darks_s, frames_s = (
        sorted({t for t in exposures_s if np.isfinite(t)}) for exposures_s in (dark_exposures_s, frame_exposures_s)
    )
    has_dark_current = len(darks_s) >= MIN_DARK_EXPOSURES
    if has_dark_current or not (darks_s and frames_s) or darks_s[0] <= MAX_EXPOSURE_RATIO * frames_s[-1]:
        return ""
    return (
        f"the darks last {_format_range(darks_s)} s and the {kind} {_format_range(frames_s)} s: how much of the darks'"
        f" level and noise is dark current is not known; take darks of the exposures of the {kind}, or of"
        f" {MIN_DARK_EXPOSURES} exposures"
    )


def _format_range(ascending: Sequence[float]) -> str:
    """Return "first to last" of ascending numbers as text, or a single number if the two are equal."""
    low, high = ascending[0], ascending[-1]
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def check_levels(
    levels: Sequence[Level], flats: Sequence[Level], signal: np.ndarray, efficiency: Quantity
) -> Iterator[Contradiction]:
    """Yield the contradictions in exposures and photon numbers of flats and darks, such as an efficiency above 1.

    Parameters
    ----------
    levels : all levels of flats and darks.
    flats : the levels of flats for which a dark exists.
    signal : mean of each of these flats minus the mean of its dark [DN], [flat]; empty if there are no darks.
    efficiency : quantum efficiency from these flats; NaN if unknown.
    """
    exposures_s = {kind: [level.exposure_s for level in levels if level.kind == kind] for kind in ("dark", "flat")}
    if sentence := describe_long_darks(exposures_s["dark"], exposures_s["flat"], "flats"):
        yield Contradiction(sentence, UNKNOWN_BY_LONG_DARKS, "the darks last much longer than the flats")
    if len(signal) and _are_photons_per_second(flats, signal):
        sentence = (
            "manifest.csv: photons_per_px looks like photons a second, since the flats follow photons_per_px times"
            " exposure_s; it must be photons on a pixel during the exposure"
        )
        yield Contradiction(sentence, UNKNOWN_BY_PHOTONS, "photons_per_px looks like photons a second")
    # An efficiency above 1 is impossible. NaN compares as False.
    elif efficiency.value - MAX_PULL * efficiency.stderr > 1:
        sentence = (
            f"the quantum efficiency would be {quantity_text(efficiency.value, efficiency.stderr)} electrons for a"
            " photon, and no more than 1 is possible: photons_per_px of manifest.csv is too small"
        )
        yield Contradiction(
            sentence, UNKNOWN_BY_PHOTON_SCALE, "photons_per_px is fewer than the electrons of the flats"
        )


def _are_photons_per_second(flats: Sequence[Level], signal: np.ndarray) -> bool:
    """Return whether the signal [flat] in DN follows photons × exposure much better than photons.

    The relative spread of signal/photons is compared with that of signal/(photons × exposure). False if fewer than
    `MIN_FLATS_FOR_SPREAD` flats have photons, exposure and signal above 0.
    """
    photons, exposure_s = (np.array([getattr(flat, name) for flat in flats]) for name in ("photons", "exposure_s"))
    is_positive = (photons > 0) & (exposure_s > 0) & (signal > 0)
    if np.count_nonzero(is_positive) < MIN_FLATS_FOR_SPREAD:
        return False
    ratios = [signal[is_positive] / light[is_positive] for light in (photons, photons * exposure_s)]
    photon_spread, product_spread = (float(ratio.std() / ratio.mean()) for ratio in ratios)
    return photon_spread > MIN_PHOTON_SPREAD and product_spread * MIN_SPREAD_RATIO < photon_spread


def differ_significantly(first: SourceValue, second: SourceValue, factor: float) -> bool:
    """Return whether two values differ by more than `MAX_PULL` combined standard errors and by more than a factor.

    Both values have the same unit. An unknown standard error (NaN) counts as 0. If the smaller value is 0 or negative,
    the standard errors alone decide.
    """
    error = float(np.hypot(np.nan_to_num(first.stderr), np.nan_to_num(second.stderr)))
    low, high = sorted((first.value, second.value))
    return high - low > MAX_PULL * error and high > factor * low


def describe_key(instrument: Instrument, name: str) -> str:
    """Return the start of a sentence, "FILE: sensor.NAME is VALUE", for the quantity `name` that the data sheet gives.

    FILE is instrument.yaml, or the instrument file that it includes.
    """
    return f"{instrument.get_file_name(f'sensor.{name}')}: sensor.{name} is {getattr(instrument.sensor, name):g}"


def compare_sources(
    instrument: Instrument, sheet: SourceValues, flats: SourceValues, spots: SourceValues
) -> Iterator[Contradiction]:
    """Yield the contradictions between the data sheet and the measured value of each quantity in `MAX_FACTOR`.

    The measured value is that of flats and darks, or that of spots if flats and darks give none. Only flats and darks
    make a quantity unknown: values from spots may be wrong themselves.

    Parameters
    ----------
    instrument : data sheet, for the names of its files.
    sheet, flats, spots : values of the data sheet, of flats and darks, and of spots.
    """
    for name, factor in MAX_FACTOR.items():
        phrase, measured = "flats and darks give", flats.get(name)
        if measured is None:
            factor, phrase, measured = max(factor, MAX_FACTOR_SPOTS), "the noise of the spots gives", spots.get(name)
        stated = sheet.get(name)
        if stated is None or measured is None or not differ_significantly(stated, measured, factor):
            continue
        gain = flats.get("gain_dn_per_e") or spots.get("gain_dn_per_e")
        # Rounding hides a read noise up to `MAX_HIDDEN_NOISE_DN`: the measured value is an upper limit, and a smaller
        # stated value does not contradict it.
        if name == "read_noise_e" and gain and stated.value < measured.value < MAX_HIDDEN_NOISE_DN / gain.value:
            continue
        measured_text = quantity_text(measured.value, measured.stderr)
        suggestion = _suggest_unit(name, stated, measured, gain)
        sentence = f"{describe_key(instrument, name)}, but {phrase} {measured_text}{suggestion}"
        yield Contradiction(sentence, (name,) if name in flats and name in LIKELIHOOD_QUANTITIES else ())


def _suggest_unit(name: str, stated: SourceValue, measured: SourceValue, gain: SourceValue | None) -> str:
    """Return the confusion of units that explains a wrong gain or read noise, as half a sentence; "" if none does.

    A stated gain may be in e-/DN instead of DN/e-, a stated read noise in DN instead of e-. `gain` [DN/e-] is the
    measured one; None if unknown.
    """
    if name == "gain_dn_per_e" and stated.value > 0:
        inverse_gain = 1 / stated.value
        if not differ_significantly(stated._replace(value=inverse_gain, stderr=0.0), measured, MAX_FACTOR_SLIP):
            return f"; {stated.value:g} e-/DN are {inverse_gain:.4g} DN/e-"
    if name == "read_noise_e" and gain:
        noise_e = stated.value / gain.value
        if not differ_significantly(stated._replace(value=noise_e, stderr=0.0), measured, MAX_FACTOR_SLIP):
            return f"; {stated.value:g} DN are {noise_e:.4g} e-"
    return ""


def check_black_level(instrument: Instrument, sheet: SourceValue | None, darkest_dn: float) -> Contradiction | None:
    """Return the contradiction of a stated black level that exceeds the level of a frame; None if there is none.

    Light only adds to a reading, so no frame can have a level below the black level.

    Parameters
    ----------
    instrument : data sheet, for the name of its file.
    sheet : black level of the data sheet [DN]; None if not given.
    darkest_dn : lowest level of any frame [DN]; NaN if there are no frames.
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
    """Yield the contradictions of full well, read noise and dark current of the data sheet with gain and readings.

    Parameters
    ----------
    dataset : dataset with its data sheet.
    gain, black_dn : gain [DN/e-] and black level [DN] in use. If the gain is NaN, nothing is checked.
    full_scale_dn : largest possible reading [DN].
    highest_dn : largest reading of all frames [DN]; NaN if unknown.
    """
    if not np.isfinite(gain):
        return
    instrument, sensor = dataset.instrument, dataset.instrument.sensor
    if sensor.full_well_e is not None:
        well_dn = black_dn + gain * sensor.full_well_e
        # A full well has shot noise of √full_well_e electrons.
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
