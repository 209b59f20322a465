"""Choice of the sensor values that the analysis uses, and sensor.nc.

A value comes from the data sheet if that gives it, otherwise from flats and darks, otherwise from the noise of spots.
A value that none of them gives, or that contradicts another, is unknown, and the reason is stored.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import xarray as xr

from spotcheck.characterization.contradictions import (
    MAX_PULL,
    Contradiction,
    SourceValue,
    check_black_level,
    check_sensor_keys,
    compare_sources,
    describe_key,
    describe_long_darks,
)
from spotcheck.characterization.dark_frames import NO_DARKS, DarkLevels
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.noise_curve import INTERVAL_SD
from spotcheck.characterization.spot_estimates import SpotEstimates, estimate_from_spots
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import DEFAULT, Instrument
from spotcheck.dataset.manifest import KINDS
from spotcheck.io import store
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Name → (unit, meaning).
QUANTITIES = {
    "gain_dn_per_e": ("DN/e-", "overall gain K"),
    "read_noise_e": ("e-", "read noise, rms"),
    "dark_current_e_per_s": ("e-/s", "dark current"),
    "quantum_efficiency": ("1", "quantum efficiency"),
    "full_well_e": ("e-", "full well"),
    "black_level_dn": ("DN", "reading without light"),
    "full_scale_dn": ("DN", "largest reading of the converter"),
    "response_bend": ("1", "bend of the response"),
}
# Sources of a value, best first.
SHEET, FLATS, SPOTS = SOURCES = ("data sheet", "flats and darks", "spots")
# Quantity → name of the same quantity in photon transfer.
EMVA_NAMES = {
    "gain_dn_per_e": "gain",
    "read_noise_e": "dark_noise",
    "dark_current_e_per_s": "dark_current",
    "quantum_efficiency": "quantum_efficiency",
    "full_well_e": "full_well",
    "black_level_dn": "dark_offset",
}
# Only the data sheet sets these: a full well in the frames is an effect for the analysis to find.
ONLY_FROM_SHEET = ("full_well_e",)


# Quantity → source → value, for the sources that give one.
SourceTable = dict[str, dict[str, SourceValue]]


def choose_sensor_values(
    dataset: Dataset,
    end: FullScale,
    crops: Iterable[np.ndarray],
    darks: DarkLevels = NO_DARKS,
    measured: Mapping[str, Quantity] | None = None,
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]] | None = None,
    highest_dn: float = np.nan,
) -> xr.Dataset:
    """Return sensor.nc: the value in use of each sensor quantity, and the values of all sources side by side.

    Parameters
    ----------
    dataset : dataset with its data sheet.
    end : largest possible reading.
    crops : images of spots [rows, columns] in DN.
    darks : levels of the dark frames.
    measured : quantities of photon transfer by name.
    pairs : pairs of images [rows, columns] in DN of the same pixels, by what the two frames are.
    highest_dn : largest reading of all frames [DN]; NaN if unknown.

    Returns
    -------
    xarray.Dataset
        Each quantity with `_stderr`, with its origin (or the reason why it is unknown) in the attribute `source`, and
        with `_by` and `_by_stderr` over `source`. The attribute `remarks` lists faults of the dark frames and all
        contradictions.
    """
    instrument, contradictions = dataset.instrument, list[Contradiction]()
    values = _read_sheet(instrument)
    remarks = _add_flats_and_darks(values, dataset, darks, measured or {})
    stated_black = _select_source(values, SHEET).get("black_level_dn")
    if too_high := check_black_level(instrument, stated_black, darks.darkest_dn):
        contradictions.append(too_high)
        sheet_value = values["black_level_dn"][SHEET]
        values["black_level_dn"][SHEET] = sheet_value._replace(contradiction=too_high.sentence)
    black_dn = _choose_source(values["black_level_dn"]).value
    known_black_dn = None if np.isnan(black_dn) else black_dn
    spots = estimate_from_spots(crops, pairs or {}, known_black_dn, end.reading, instrument.sensor.response_bend)
    _add_spots(values, spots, has_black_level=known_black_dn is not None, is_top_hat=instrument.model.top_hat)
    contradictions += compare_sources(instrument, *(_select_source(values, source) for source in SOURCES))
    gain = _choose_source(values["gain_dn_per_e"]).value
    used_black_dn = _choose_source(values["black_level_dn"], instrument.sensor.black_level_dn).value
    contradictions += check_sensor_keys(dataset, gain, used_black_dn, end.reading, highest_dn)
    return _build_dataset(dataset, values, end, contradictions, remarks)


def _read_sheet(instrument: Instrument) -> SourceTable:
    """Return the table with the values of the data sheet."""
    values: SourceTable = {name: {} for name in QUANTITIES}
    for name in QUANTITIES:
        value, source = getattr(instrument.sensor, name, None), instrument.get_source(f"sensor.{name}")
        if source != DEFAULT and value is not None:
            # An error of 0 means that none is stated.
            stderr = getattr(instrument.sensor, f"{name}_stderr", 0.0) or np.nan
            values[name][SHEET] = SourceValue(float(value), stderr, source)
    return values


def _add_flats_and_darks(
    values: SourceTable, dataset: Dataset, darks: DarkLevels, measured: Mapping[str, Quantity]
) -> list[str]:
    """Add the values of flats and darks, and return remarks on those that cannot be used."""
    for name, emva_name in EMVA_NAMES.items():
        quantity = measured.get(emva_name)
        if quantity is not None and np.isfinite(quantity.value):
            # Noise can make a measured dark current negative.
            value = max(quantity.value, 0.0) if name == "dark_current_e_per_s" else quantity.value
            values[name][FLATS] = SourceValue(value, quantity.stderr, "photon transfer of flats and darks")
    current, black = values["dark_current_e_per_s"], values["black_level_dn"]
    has_current = FLATS in current or SHEET in current
    exposures = {
        kind: [frame.exposure_s for frame in dataset.frames if frame.kind == kind and frame.exposure_s is not None]
        for kind in KINDS
    }
    if not has_current and (reason := describe_long_darks(exposures["dark"], exposures["spot"], "spots")):
        had_noise = values["read_noise_e"].pop(FLATS, None) is not None
        black.pop(FLATS, None)
        return [reason] if had_noise or SHEET not in black else []
    # Without a dark current the level at exposure 0 is unknown, and the black level is that of the darks themselves.
    if len(darks.levels) and (darks.remark or not has_current):
        black[FLATS] = _average_darks(darks.levels)
    remarks = [darks.remark] if darks.remark and SHEET not in black else []
    if remarks and not len(darks.levels):
        # All dark frames contain light.
        black.pop(FLATS, None)
        current.pop(FLATS, None)
    if FLATS not in current and SHEET in current and exposures["dark"]:
        remarks += _subtract_dark_current(values, dataset.instrument, min(exposures["dark"]))
    return remarks


def _average_darks(levels: Sequence[float]) -> SourceValue:
    """Return the mean level of dark frames [DN] with its standard error."""
    count = len(levels)
    error = float(np.std(levels, ddof=1) / np.sqrt(count)) if count > 1 else np.nan
    return SourceValue(float(np.mean(levels)), error, f"mean of {count} dark frame{'s' if count > 1 else ''}")


def _subtract_dark_current(values: SourceTable, instrument: Instrument, exposure_s: float) -> list[str]:
    """Subtract the dark current of the data sheet from black level and read noise of the shortest darks.

    If the darks contain less than that, both are dropped and a remark is returned.
    """
    rate = values["dark_current_e_per_s"][SHEET].value
    electrons, gain = rate * exposure_s, _choose_source(values["gain_dn_per_e"]).value
    level, noise = (values[name].get(FLATS) for name in ("black_level_dn", "read_noise_e"))
    exceeded = []
    if level is not None and np.isfinite(gain):
        values["black_level_dn"][FLATS] = level._replace(value=level.value - gain * electrons)
        if level.value < gain * electrons:
            exceeded.append(f"a level of {level.value:.4g} DN")
    if noise is not None:
        variance = noise.value**2 - electrons
        values["read_noise_e"][FLATS] = noise._replace(value=float(np.sqrt(max(variance, 0.0))))
        if variance < -MAX_PULL * 2 * noise.value * noise.stderr:
            exceeded.append(f"a noise of {noise.value:.4g} e-")
    if not exceeded:
        return []
    for name in ("black_level_dn", "read_noise_e"):
        values[name].pop(FLATS, None)
    return [
        f"{describe_key(instrument, 'dark_current_e_per_s')}, which is {electrons:.4g} e- in"
        f" darks of {exposure_s:g} s, but these have {' and '.join(exceeded)} only"
    ]


def _add_spots(values: SourceTable, spots: SpotEstimates, has_black_level: bool, is_top_hat: bool) -> None:
    """Add the values from spots, in electrons of the gain in use.

    Parameters
    ----------
    values : table with the values of the other sources.
    spots : estimates from spots [DN].
    has_black_level : whether the black level is known from another source.
    is_top_hat : whether the light itself has a plateau: saturation is then taken from its noise only.
    """
    if spots.gain is not None:
        # Undetected texture counts as gain: the error covers the lower end of the interval.
        error = max(spots.gain.gain_stderr, (spots.gain.gain - spots.gain.low) / INTERVAL_SD)
        values["gain_dn_per_e"][SPOTS] = SourceValue(spots.gain.gain, error, spots.method)
    gain = _choose_source(values["gain_dn_per_e"])
    if np.isnan(gain.value):
        return
    relative_error = np.nan_to_num(gain.stderr) / gain.value
    if spots.saturation is not None and (spots.is_noise_lost or not is_top_hat):
        well, error = np.array(spots.saturation) / gain.value
        stderr = float(np.hypot(error, well * relative_error))
        values["full_well_e"][SPOTS] = SourceValue(float(well), stderr, "saturation of spots")
    if spots.gain is not None:
        floor, floor_error = max(spots.gain.floor - ROUNDING_VARIANCE, 0.0), spots.gain.floor_stderr
        noise = float(np.sqrt(floor)) / gain.value
        # σ = √floor/K: a floor of 0 within its error gives a noise of 0 with the error √floor_stderr/K.
        error = min(floor_error / (2 * np.sqrt(floor)) if floor > 0 else np.inf, np.sqrt(floor_error)) / gain.value
        if not has_black_level:
            # The rim of a frame may contain light, whose shot noise is then part of the floor.
            dark_floor = max(floor - gain.value * max(spots.level_dn, 0.0), 0.0)
            error = float(np.hypot(error, noise - np.sqrt(dark_floor) / gain.value))
        stderr = float(np.hypot(error, noise * relative_error))
        values["read_noise_e"][SPOTS] = SourceValue(noise, stderr, spots.method)


def convert_to_electrons(spots: SpotEstimates) -> dict[str, SourceValue]:
    """Return the sensor values that spots alone give without a known black level, by name; empty without a gain."""
    values: SourceTable = {name: {} for name in QUANTITIES}
    _add_spots(values, spots, has_black_level=False, is_top_hat=False)
    return {name: sources[SPOTS] for name, sources in values.items() if SPOTS in sources}


def _select_source(values: SourceTable, source: str) -> dict[str, SourceValue]:
    """Return the values of one source by quantity."""
    return {name: sources[source] for name, sources in values.items() if source in sources}


def _choose_source(sources: Mapping[str, SourceValue], default: float | None = None) -> SourceValue:
    """Return the value of the best source that nothing contradicts.

    If every source is contradicted and there is a default, the best source is used all the same. Without a source it is
    the default, or NaN if that is None.
    """
    available = [sources[source] for source in SOURCES if source in sources]
    for value in available:
        if not value.contradiction:
            return value
    if available and default is not None:
        origin = f"{available[0].origin}, although frames contradict it: no other source gives a value"
        return available[0]._replace(origin=origin)
    return SourceValue(np.nan if default is None else float(default), np.nan, DEFAULT)


def _choose_value(
    name: str, sources: Mapping[str, SourceValue], default: float | None, contradiction: str
) -> SourceValue:
    """Return the value in use; it is unknown if a `contradiction` with another quantity says so ("": none)."""
    if name in ONLY_FROM_SHEET:
        no_value = SourceValue(np.inf, np.nan, contradiction or "none given")
        return no_value if contradiction else sources.get(SHEET, no_value)
    # A contradicted black level was replaced by that of the next source.
    if contradiction and name != "black_level_dn":
        return SourceValue(np.nan, np.nan, f"unknown: {contradiction}")
    value = _choose_source(sources, default)
    if np.isnan(value.value):
        reason = (
            "not in instrument.yaml, no flats and darks in pairs, and no frame shows noise that grows with its light"
        )
        return value._replace(origin=f"unknown: {reason}")
    return value


def _build_dataset(
    dataset: Dataset,
    values: SourceTable,
    end: FullScale,
    contradictions: Sequence[Contradiction],
    remarks: Sequence[str],
) -> xr.Dataset:
    """Return sensor.nc from the values of all sources."""
    sentences = {name: contradiction.sentence for contradiction in contradictions for name in contradiction.unknown}
    ds = store.make_grid(dataset).drop_vars([axis.name for axis in dataset.axes if axis.values is not None])
    for name, (units, long_name) in QUANTITIES.items():
        default = getattr(dataset.instrument.sensor, name, None)
        chosen = _choose_value(name, values[name], default, sentences.get(name, ""))
        if name == "full_scale_dn":
            chosen = SourceValue(float(end.reading), np.nan, end.source)
        if name == "black_level_dn" and remarks:
            chosen = chosen._replace(origin="; ".join([chosen.origin, *remarks]))
        ds[name] = ((), chosen.value, {"units": units, "long_name": long_name, "source": chosen.origin})
        ds[f"{name}_stderr"] = ((), chosen.stderr, {"units": units, "long_name": f"standard error of {long_name}"})
    ds["full_well_e"].attrs["infinite"] = "no pixel is ever full"
    ds["source"] = ("source", np.array(SOURCES, object), {"units": "1", "long_name": "where a number comes from"})
    for name, (units, long_name) in QUANTITIES.items():
        table = np.array([values[name].get(source, (np.nan, np.nan))[:2] for source in SOURCES])
        for suffix, column, text in (("by", 0, ""), ("by_stderr", 1, "standard error of ")):
            attributes = {"units": units, "long_name": f"{text}{long_name} by each source"}
            ds[f"{name}_{suffix}"] = ("source", table[:, column], attributes)
    return store.add_remarks(ds, [*remarks, *(contradiction.sentence for contradiction in contradictions)])


def read_standard_errors(ds: xr.Dataset) -> tuple[float, float, float]:
    """Return the standard errors of gain, read noise and black level in sensor.nc; 0 for those that are unknown."""
    gain, noise, black = (
        float(np.nan_to_num(ds[f"{name}_stderr"])) for name in ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    )
    return gain, noise, black


def read_sensor_model(ds: xr.Dataset) -> SensorModel | None:
    """Return the sensor model of sensor.nc; None if gain or read noise is unknown."""
    numbers = {name: float(ds[name]) for name in QUANTITIES}
    if not np.isfinite(numbers["gain_dn_per_e"]) or not np.isfinite(numbers["read_noise_e"]):
        return None
    return SensorModel(**numbers)
