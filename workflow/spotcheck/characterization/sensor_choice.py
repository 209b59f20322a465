"""Choice of the sensor values that the analysis uses, and sensor.nc.

A value comes from the data sheet (instrument.yaml) if that gives it, otherwise from flats and darks, otherwise from the
noise of spots. Flats are frames of uniform light, darks are frames without light. A value that no source gives, or that
contradicts another, is unknown (NaN), and the reason is stored. A `SourceValue` has the value of one source, its
standard error `stderr`, its `origin` in words, and the sentence of a `contradiction`, "" if there is none.

A spot's noise floor is its variance without light [DN²]. The rim of an image is its outer pixels, which the spot hardly
reaches. The texture of the light, such as speckle, looks like noise and raises the gain that spots give.
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

# Name of a quantity of the sensor → (unit, meaning).
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
# Quantity → name of the same quantity in the photon transfer of flats and darks, after EMVA 1288.
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
# Origin of a black level that neither a data sheet nor dark frames give.
DARK_PIXELS = "dark pixels of the spot frames, an upper limit because of stray light"
# Reason why a quantity is unknown if no source gives it.
NO_SOURCE = "not in instrument.yaml, no flats and darks in pairs, and no frame shows noise that grows with its light"
# Quantity → source → value, for all of `QUANTITIES` and the sources that give a value.
SourceTable = dict[str, dict[str, SourceValue]]


def choose_sensor_values(
    dataset: Dataset,
    full_scale: FullScale,
    crops: Iterable[np.ndarray],
    darks: DarkLevels = NO_DARKS,
    measured: Mapping[str, Quantity] | None = None,
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]] | None = None,
    highest_dn: float = np.nan,
) -> xr.Dataset:
    """Return the content of sensor.nc: the value in use of each sensor quantity, and the values of all sources.

    Parameters
    ----------
    dataset : dataset with its data sheet.
    full_scale : largest possible reading.
    crops : images of spots [rows, columns] in DN.
    darks : levels of the dark frames.
    measured : quantities of the photon transfer of flats and darks by name; None or empty without flats and darks.
    pairs : pairs of images [rows, columns] in DN of the same pixels, by a phrase that says what the two frames are;
        None without pairs.
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
    if black_contradiction := check_black_level(instrument, stated_black, darks.darkest_dn):
        contradictions.append(black_contradiction)
        sheet_value = values["black_level_dn"][SHEET]
        values["black_level_dn"][SHEET] = sheet_value._replace(contradiction=black_contradiction.sentence)
    # Light in the spots is counted from the black level of data sheet or darks; without one (NaN), from the rims.
    black_dn = _choose_source(values["black_level_dn"]).value
    known_black_dn = None if np.isnan(black_dn) else black_dn
    spots = estimate_from_spots(crops, pairs or {}, known_black_dn, full_scale.reading, instrument.sensor.response_bend)
    _add_spots(values, spots, has_black_level=known_black_dn is not None, is_top_hat=instrument.model.top_hat)
    if not values["black_level_dn"] and np.isfinite(darks.dark_pixels[0]):
        values["black_level_dn"][SPOTS] = SourceValue(*darks.dark_pixels, DARK_PIXELS)
    contradictions += compare_sources(instrument, *(_select_source(values, source) for source in SOURCES))
    gain = _choose_source(values["gain_dn_per_e"]).value
    used_black_dn = _choose_source(values["black_level_dn"], instrument.sensor.black_level_dn).value
    contradictions += check_sensor_keys(dataset, gain, used_black_dn, full_scale.reading, highest_dn)
    return _build_dataset(dataset, values, full_scale, contradictions, remarks)


def _read_sheet(instrument: Instrument) -> SourceTable:
    """Return a new table with the values that the data sheet gives; defaults are left out."""
    values: SourceTable = {name: {} for name in QUANTITIES}
    for name in QUANTITIES:
        value, origin = getattr(instrument.sensor, name, None), instrument.get_source(f"sensor.{name}")
        if origin != DEFAULT and value is not None:
            # An error of 0 means that none is stated.
            stderr = getattr(instrument.sensor, f"{name}_stderr", 0.0) or np.nan
            values[name][SHEET] = SourceValue(float(value), stderr, origin)
    return values


def _add_flats_and_darks(
    values: SourceTable, dataset: Dataset, darks: DarkLevels, measured: Mapping[str, Quantity]
) -> list[str]:
    """Add the values of flats and darks to the table, and return remarks on those that cannot be used.

    Parameters
    ----------
    values : table with the values of the data sheet.
    dataset : dataset, for the exposures of its frames.
    darks : levels of the dark frames.
    measured : quantities of the photon transfer by name.
    """
    for name, emva_name in EMVA_NAMES.items():
        quantity = measured.get(emva_name)
        if quantity is not None and np.isfinite(quantity.value):
            # Noise can make a measured dark current negative.
            value = max(quantity.value, 0.0) if name == "dark_current_e_per_s" else quantity.value
            values[name][FLATS] = SourceValue(value, quantity.stderr, "photon transfer of flats and darks")
    current_sources, black_sources = values["dark_current_e_per_s"], values["black_level_dn"]
    has_current = FLATS in current_sources or SHEET in current_sources
    exposures_s = {
        kind: [frame.exposure_s for frame in dataset.frames if frame.kind == kind and frame.exposure_s is not None]
        for kind in KINDS
    }
    # Darks that last too long contain an unknown dark current: neither their noise nor their level can be used.
    if not has_current and (reason := describe_long_darks(exposures_s["dark"], exposures_s["spot"], "spots")):
        had_noise = values["read_noise_e"].pop(FLATS, None) is not None
        black_sources.pop(FLATS, None)
        return [reason] if had_noise or SHEET not in black_sources else []
    # The mean level of the darks replaces that of photon transfer if some darks contain light, or if the level at
    # exposure 0 is unknown for want of a dark current.
    if len(darks.levels) and (darks.remark or not has_current):
        black_sources[FLATS] = _average_darks(darks.levels)
    remarks = [darks.remark] if darks.remark and SHEET not in black_sources else []
    if remarks and not len(darks.levels):
        # All dark frames contain light.
        black_sources.pop(FLATS, None)
        current_sources.pop(FLATS, None)
    if FLATS not in current_sources and SHEET in current_sources and exposures_s["dark"]:
        remarks += _subtract_dark_current(values, dataset.instrument, min(exposures_s["dark"]))
    return remarks


def _average_darks(levels: Sequence[float]) -> SourceValue:
    """Return the mean of the levels of dark frames [DN]; its standard error is NaN with a single frame."""
    count = len(levels)
    error = float(np.std(levels, ddof=1) / np.sqrt(count)) if count > 1 else np.nan
    return SourceValue(float(np.mean(levels)), error, f"mean of {count} dark frame{'s' if count > 1 else ''}")


def _subtract_dark_current(values: SourceTable, instrument: Instrument, exposure_s: float) -> list[str]:
    """Subtract the dark current of the data sheet from the black level and the read noise of flats and darks.

    `exposure_s` is the shortest exposure of the darks [s], for which both are measured. If they are smaller than the
    dark current of this exposure explains, both are removed from the table and a remark is returned.
    """
    rate = values["dark_current_e_per_s"][SHEET].value
    electrons, gain = rate * exposure_s, _choose_source(values["gain_dn_per_e"]).value
    black, noise = (values[name].get(FLATS) for name in ("black_level_dn", "read_noise_e"))
    contradictory = []
    if black is not None and np.isfinite(gain):
        values["black_level_dn"][FLATS] = black._replace(value=black.value - gain * electrons)
        if black.value < gain * electrons:
            contradictory.append(f"a level of {black.value:.4g} DN")
    if noise is not None:
        # The dark current has the variance of its electrons. The error of the variance σ² is 2 σ times that of σ.
        variance = noise.value**2 - electrons
        values["read_noise_e"][FLATS] = noise._replace(value=float(np.sqrt(max(variance, 0.0))))
        if variance < -MAX_PULL * 2 * noise.value * noise.stderr:
            contradictory.append(f"a noise of {noise.value:.4g} e-")
    if not contradictory:
        return []
    for name in ("black_level_dn", "read_noise_e"):
        values[name].pop(FLATS, None)
    return [
        f"{describe_key(instrument, 'dark_current_e_per_s')}, which is {electrons:.4g} e- in"
        f" darks of {exposure_s:g} s, but these have {' and '.join(contradictory)} only"
    ]


def _add_spots(values: SourceTable, spots: SpotEstimates, has_black_level: bool, is_top_hat: bool) -> None:
    """Add gain, full well and read noise from spots to the table.

    Full well and read noise are converted to electrons by the gain of the best source. Without any gain they are not
    added.

    Parameters
    ----------
    values : table with the values of the other sources.
    spots : estimates from spots in DN. `gain` has gain and noise floor, and `low`, the lower end of the interval of the
        gain. `saturation` is the reading over black at which spots saturate, with its error. `is_noise_lost` says that
        saturated pixels have much less than shot noise. `zero_level_dn` is the reading from which light was counted:
        that of the rims if the black level is unknown.
    has_black_level : whether the black level is known from another source.
    is_top_hat : whether the light itself has a plateau. A plateau of the readings then counts as saturation of the
        sensor only if `is_noise_lost`.
    """
    if spots.gain is not None:
        # Texture that was not detected raises the gain. The error therefore reaches down to the lower end of the gain's
        # interval, which allows for texture and is `INTERVAL_SD` standard errors away.
        error = max(spots.gain.gain_stderr, (spots.gain.gain - spots.gain.low) / INTERVAL_SD)
        values["gain_dn_per_e"][SPOTS] = SourceValue(spots.gain.gain, error, spots.method)
    gain = _choose_source(values["gain_dn_per_e"])
    if np.isnan(gain.value):
        return
    relative_gain_error = np.nan_to_num(gain.stderr) / gain.value
    if spots.saturation is not None and (spots.is_noise_lost or not is_top_hat):
        well, error = np.array(spots.saturation) / gain.value
        stderr = float(np.hypot(error, well * relative_gain_error))
        values["full_well_e"][SPOTS] = SourceValue(float(well), stderr, "saturation of spots")
    if spots.gain is not None:
        floor, floor_error = max(spots.gain.floor - ROUNDING_VARIANCE, 0.0), spots.gain.floor_stderr
        noise = float(np.sqrt(floor)) / gain.value
        # Propagated error of σ = √floor/K. It diverges as the floor approaches 0. Its limit is √floor_error/K, the
        # noise of a floor of one standard error.
        error = min(floor_error / (2 * np.sqrt(floor)) if floor > 0 else np.inf, np.sqrt(floor_error)) / gain.value
        if not has_black_level:
            # Light was counted from the rims, which may contain light themselves. In the extreme case their whole
            # reading L is light. The floor then contains its shot noise K L, and without it is `dark_floor`. The error
            # covers this case.
            dark_floor = max(floor - gain.value * max(spots.zero_level_dn, 0.0), 0.0)
            error = float(np.hypot(error, noise - np.sqrt(dark_floor) / gain.value))
        stderr = float(np.hypot(error, noise * relative_gain_error))
        values["read_noise_e"][SPOTS] = SourceValue(noise, stderr, spots.method)


def convert_to_electrons(spots: SpotEstimates) -> dict[str, SourceValue]:
    """Return gain, full well and read noise that spots alone give without a known black level, by name in `QUANTITIES`.

    The result is empty if the spots give no gain.
    """
    values: SourceTable = {name: {} for name in QUANTITIES}
    _add_spots(values, spots, has_black_level=False, is_top_hat=False)
    return {name: sources[SPOTS] for name, sources in values.items() if SPOTS in sources}


def _select_source(values: SourceTable, source: str) -> dict[str, SourceValue]:
    """Return the values of one source (one of `SOURCES`) by quantity; quantities that it does not give are left out."""
    return {name: sources[source] for name, sources in values.items() if source in sources}


def _choose_source(sources: Mapping[str, SourceValue], default: float | None = None) -> SourceValue:
    """Return the value of the best source that nothing contradicts.

    If every source is contradicted, the best one is used in spite of it, provided that there is a default. In all other
    cases the value is the default, or NaN if that is None.
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
    """Return the value of a quantity in use; if it is unknown, NaN with the reason as its origin.

    Parameters
    ----------
    name : name of the quantity.
    sources : value of each source that gives one.
    default : value without a source; None if there is none.
    contradiction : sentence of the contradiction that makes the quantity unknown; "" if there is none.
    """
    if name in ONLY_FROM_SHEET:
        # A full well that is unknown or not given counts as infinite.
        no_value = SourceValue(np.inf, np.nan, contradiction or "none given")
        return no_value if contradiction else sources.get(SHEET, no_value)
    # A contradicted black level was replaced by that of the next source.
    if contradiction and name != "black_level_dn":
        return SourceValue(np.nan, np.nan, f"unknown: {contradiction}")
    value = _choose_source(sources, default)
    if np.isnan(value.value):
        return value._replace(origin=f"unknown: {NO_SOURCE}")
    return value


def _build_dataset(
    dataset: Dataset,
    values: SourceTable,
    full_scale: FullScale,
    contradictions: Sequence[Contradiction],
    remarks: Sequence[str],
) -> xr.Dataset:
    """Return the content of sensor.nc.

    Parameters
    ----------
    dataset : dataset with its data sheet.
    values : values of all sources.
    full_scale : largest possible reading.
    contradictions : each makes its `affected_names` unknown; of several, the last one gives the reason.
    remarks : faults of the dark frames, which are also appended to the origin of the black level.
    """
    # Name of each affected quantity → sentence.
    sentences = {name: fault.sentence for fault in contradictions for name in fault.affected_names}
    # sensor.nc has the attributes of other results, such as the title, but no axes.
    ds = xr.Dataset(attrs=store.make_grid(dataset).attrs)
    for name, (units, long_name) in QUANTITIES.items():
        stated_or_default = getattr(dataset.instrument.sensor, name, None)
        chosen = _choose_value(name, values[name], stated_or_default, sentences.get(name, ""))
        if name == "full_scale_dn":
            chosen = SourceValue(float(full_scale.reading), np.nan, full_scale.source)
        if name == "black_level_dn" and remarks:
            chosen = chosen._replace(origin="; ".join([chosen.origin, *remarks]))
        ds[name] = ((), chosen.value, {"units": units, "long_name": long_name, "source": chosen.origin})
        ds[f"{name}_stderr"] = ((), chosen.stderr, {"units": units, "long_name": f"standard error of {long_name}"})
    # `store.write` adds a remark on infinite values unless this attribute explains them.
    ds["full_well_e"].attrs["infinite"] = "no pixel is ever full"
    ds["source"] = ("source", np.array(SOURCES, object), {"units": "1", "long_name": "where a number comes from"})
    for name, (units, long_name) in QUANTITIES.items():
        table = np.array([values[name].get(source, (np.nan, np.nan))[:2] for source in SOURCES])
        for index, suffix, prefix in ((0, "by", ""), (1, "by_stderr", "standard error of ")):
            attributes = {"units": units, "long_name": f"{prefix}{long_name} by each source"}
            ds[f"{name}_{suffix}"] = ("source", table[:, index], attributes)
    return store.add_remarks(ds, [*remarks, *(contradiction.sentence for contradiction in contradictions)])


def read_standard_errors(ds: xr.Dataset) -> tuple[float, float, float]:
    """Return the standard errors of gain [DN/e-], read noise [e-] and black level [DN] in the content of sensor.nc.

    Unknown ones (NaN) are returned as 0.
    """
    names = ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    gain, noise, black = (float(np.nan_to_num(ds[f"{name}_stderr"])) for name in names)
    return gain, noise, black


def read_sources(ds: xr.Dataset) -> dict[str, str]:
    """Return the source (one of `SOURCES`) of each quantity in the content of sensor.nc; defaults are left out."""
    sources = {}
    for name in QUANTITIES:
        has_value = ds[f"{name}_by"].values == float(ds[name])
        if has_value.any():
            sources[name] = str(ds["source"].values[has_value.argmax()])
    return sources


def read_sensor_model(ds: xr.Dataset) -> SensorModel | None:
    """Return the sensor model in the content of sensor.nc; None if gain or read noise is unknown."""
    values = {name: float(ds[name]) for name in QUANTITIES}
    if not np.isfinite([values["gain_dn_per_e"], values["read_noise_e"]]).all():
        return None
    return SensorModel(**values)
