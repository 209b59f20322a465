"""Collect from the results of a dataset the learned value of each key of instrument.yaml, its error and its source.

Sensor parameters come from transfer.nc, sensor.nc and verdict.json, the light shape from light.nc, and bad pixels from
the fits. Detected effects set keys through `Effect.instrument_keys`.

A key is "section.name" of instrument.yaml, such as sensor.gain_dn_per_e. The data sheet is what the dataset's own
instrument.yaml states. A verdict, stored in verdict.json, is the judgement of a dataset. Its `effects` are the detected
deviations from the baseline model. Each has its variant (`form`), parameters, and `candidates`: itself and the effects
that explain the frames as well. Its `levels`, which only datasets of flats and darks have, holds the gain fitted
together with the effects. Its `light` describes the learned light shape in words, its `sheet` lists the revised sensor
parameters. The vocabulary is the known effects by name. A learned light shape is the profile of the light that the
frames show, in light.nc.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spotcheck.characterization.sensor_choice import EMVA_NAMES, FLATS, ONLY_FROM_SHEET, SPOTS, read_sensor_model
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.crops.full_scale import FROM_FRAMES
from spotcheck.dataset.instrument import BadPixels, Instrument
from spotcheck.export.bad_pixels import find_bad_pixels
from spotcheck.io import provenance, store
from spotcheck.io.number_text import quantity_text
from spotcheck.io.schema import read_schema
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.light_shape import LIGHT, read_lights
from spotcheck.sensor import SensorModel

# Digits of the SHA-256 of a source that are written.
DIGEST_DIGITS = 16
# Step of the numerical derivative of a key by a parameter of an effect, in standard errors of the parameter.
DERIVATIVE_STEP = 1e-3
# Sensor parameters in electrons, which are proportional to 1/gain as they are measured in DN.
IN_ELECTRONS = ("read_noise_e", "dark_current_e_per_s")
# Sensor parameters that photon transfer derives from the light; they are wrong if the response is not linear.
OF_LINEAR_RESPONSE = ("quantum_efficiency",)
NEEDS_LINEAR_RESPONSE = "it assumes a linear response; run flats with the new instrument file to measure it"


@dataclass(frozen=True)
class LearnedValue:
    """Value of a key of instrument.yaml that follows from results."""

    key: str  # "section.name" such as sensor.gain_dn_per_e, or "bad_pixels"
    value: Any  # number, `BadPixels`, or path of the light shape
    stderr: float  # standard error in the unit of the value; NaN if it is unknown
    unit: str  # "1" or "" if it has none
    source: str  # method and file, in words
    overrules: bool = False  # whether it replaces a stated value whatever the standard errors
    is_from_spots: bool = False  # whether spot frames alone give it


class UnusedResult(NamedTuple):
    """Result that no key of instrument.yaml can hold."""

    name: str  # name of the effect, key, "gain" or "light"
    text: str  # its numbers, in words
    reason: str  # why no key holds it


def collect_learned_values(results: Path, instrument: Instrument) -> tuple[list[LearnedValue], list[UnusedResult]]:
    """Return the learned value of each key from its most accurate source, and the results that no key can hold.

    Keys without a learned value are left out.

    Parameters
    ----------
    results : Path
        Results folder of a dataset; files that do not exist are skipped.
    instrument : Instrument
        Data sheet of the dataset; its bad pixels are kept.
    """
    verdict, sensor = read_verdict(results), read_sensor(results)
    # Later sources are more accurate and replace earlier ones.
    sources = (*_read_full_scale(results), *_read_sensor_parameters(results), *_read_revised_sheet(verdict))
    values = {value.key: value for value in sources}
    from_effects, unused = _convert_effects(verdict, _update_sensor(sensor, values, verdict))
    values |= {value.key: value for value in from_effects}
    # The gain of flats was fitted together with the effects: it is valid only in a file that holds all of them.
    if verdict.get("levels") and (from_effects or unused):
        gain, stderr = (_to_float(verdict["levels"]["gain_dn_per_e"][name]) for name in ("value", "stderr"))
        if unused:
            reason = f"it is valid only with {' and '.join(result.name for result in unused)}, which no key holds"
            unused.append(UnusedResult("gain", quantity_text(gain, stderr, "DN/e-"), reason))
        else:
            values |= {value.key: value for value in _replace_gain(values, gain, stderr)}
            linear_keys = [f"sensor.{name}" for name in OF_LINEAR_RESPONSE]
            for quantity in (values.pop(key) for key in linear_keys if key in values):
                # Photon transfer assumes a linear response, which an effect of the verdict contradicts.
                text = quantity_text(quantity.value, quantity.stderr, quantity.unit)
                unused.append(UnusedResult(quantity.key, text, NEEDS_LINEAR_RESPONSE))
    for result in (_read_light(results, verdict), _collect_bad_pixels(results, instrument, sensor)):
        if isinstance(result, LearnedValue):
            values[result.key] = result
        elif result is not None:
            unused.append(result)
    return list(values.values()), unused


def read_verdict(results: Path) -> dict[str, Any]:
    """Return the contents of verdict.json; an empty dict if there is none, for example after `spotcheck transfer`."""
    path = results / "verdict.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def read_sensor(results: Path) -> SensorModel | None:
    """Return the sensor of sensor.nc; None if there is no such file, or if its gain or read noise is unknown."""
    if not (results / "sensor.nc").is_file():
        return None
    with store.read(results / "sensor.nc") as ds:
        return read_sensor_model(ds)


def digest_sources(results: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the first digits of the SHA-256 of each file of `names` that a results folder has, by name."""
    paths = {name: results / name for name in names}
    return {name: provenance.file_digest(path)[:DIGEST_DIGITS] for name, path in paths.items() if path.is_file()}


def _read_full_scale(results: Path) -> Iterator[LearnedValue]:
    """Yield the full scale [DN] if clipped frames show it; nothing if it comes from elsewhere."""
    if (results / "frames.nc").is_file():
        with store.read(results / "frames.nc") as table:
            full_scale, source = int(table["full_scale"]), str(table["full_scale"].attrs["source"])
        # The source starts with this word only if clipped frames show the value.
        if source.startswith(FROM_FRAMES):
            yield LearnedValue("sensor.full_scale_dn", full_scale, np.nan, "DN", f"{source} (frames.nc)")


def _read_sensor_parameters(results: Path) -> Iterator[LearnedValue]:
    """Yield the sensor parameters from spots, then those from flats and darks, which are more accurate.

    Both are in sensor.nc: the variables read_noise_e_by and read_noise_e_by_stderr have the read noise from each source
    and its standard error, and other parameters likewise. If there is no sensor.nc, the parameters from flats and darks
    are read from transfer.nc, in which they have the names of EMVA 1288 (`EMVA_NAMES`).
    """
    # No frames give the others.
    names = [name for name in EMVA_NAMES if name not in ONLY_FROM_SHEET]
    estimates, file = [], "sensor.nc"
    if (results / "sensor.nc").is_file():
        with store.read(results / "sensor.nc") as ds:
            for source in (SPOTS, FLATS):
                for name in names:
                    value, stderr = (float(ds[f"{name}_{suffix}"].sel(source=source)) for suffix in ("by", "by_stderr"))
                    estimates.append((name, value, stderr, source))
    elif (results / "transfer.nc").is_file():
        file = "transfer.nc"
        with store.read(results / "transfer.nc") as ds:
            quantities = read_quantities(ds)
        for name in names:
            quantity = quantities[EMVA_NAMES[name]]
            estimates.append((name, quantity.value, quantity.stderr, FLATS))
    for name, value, stderr, source in estimates:
        if np.isfinite(value):
            # Noise can make the estimate of a dark current negative.
            key, value, source_text = f"sensor.{name}", max(value, 0.0), f"{source} ({file})"
            yield LearnedValue(key, value, stderr, _read_unit(key), source_text, is_from_spots=source == SPOTS)


def _read_revised_sheet(verdict: Mapping[str, Any]) -> Iterator[LearnedValue]:
    """Yield the sensor parameters that the verdict fitted to all frames together, with the stated value as a prior.

    A parameter replaces the stated value if it contradicts it. `found`, the fitted value, is never missing.
    """
    for entry in verdict.get("sheet") or ():
        key, stderr = f"sensor.{entry['name']}", _to_float(entry["stderr"])
        source = f"{entry['source']} and all frames together (verdict.json)"
        yield LearnedValue(key, entry["found"], stderr, entry["unit"], source, overrules=entry["contradicts"])


def _update_sensor(
    sensor: SensorModel | None, values: Mapping[str, LearnedValue], verdict: Mapping[str, Any]
) -> SensorModel | None:
    """Return the sensor of sensor.nc with all learned values in place of its own.

    Without sensor.nc (None) it starts from the gain of `levels` in verdict.json; None if that is missing too. Its read
    noise is then 0 unless it was learned.
    """
    if sensor is None:
        gain = (verdict.get("levels") or {}).get("gain_dn_per_e", {}).get("value")
        if gain is None:
            return None
        sensor = SensorModel(gain_dn_per_e=gain, read_noise_e=0.0)
    names = [field.name for field in fields(SensorModel) if f"sensor.{field.name}" in values]
    return replace(sensor, **{name: values[f"sensor.{name}"].value for name in names})


def _convert_effects(
    verdict: Mapping[str, Any], sensor: SensorModel | None
) -> tuple[list[LearnedValue], list[UnusedResult]]:
    """Return the values of keys that the detected effects set, and the effects that set none.

    An effect sets no key if rivals explain the frames as well, or if the sensor is unknown (None).
    """
    learned, unused = list[LearnedValue](), list[UnusedResult]()
    for entry in verdict.get("effects", ()):
        effect = vocabulary().get(entry["name"])
        # An effect without stages is a learned light shape, which `_read_light` reads.
        if effect is None or not effect.stages:
            continue
        # The first candidate is the effect itself; the others explain the frames as well.
        parameters, rivals, keys = entry["parameters"], entry["candidates"][1:], []
        if sensor is not None and not rivals:
            # `apply` refuses an effect if the verdict lacks the value of a parameter: no key is set then.
            with suppress(ValueError):
                values = {name: _to_float(parameter["value"]) for name, parameter in parameters.items()}
                errors = {name: _to_float(parameter["stderr"], 0.0) for name, parameter in parameters.items()}
                keys = list(_derive_keys(effect.apply(values, entry["form"]), errors, sensor))
        learned += keys
        if not keys:
            stated = {name: parameter for name, parameter in parameters.items() if parameter["value"] is not None}
            numbers = ", ".join(f"{name} {quantity_text(**parameter)}" for name, parameter in stated.items())
            text = f"{entry['form']}: {numbers}" if entry["form"] else numbers
            if rivals:
                reason = f"it may as well be {' or '.join(rivals)}"
            elif sensor is None:
                reason = "the gain of the sensor is unknown"
            else:
                reason = "no key of an instrument file holds it"
            unused.append(UnusedResult(entry["name"], text, reason))
    return learned, unused


def _derive_keys(applied: AppliedEffect, errors: Mapping[str, float], sensor: SensorModel) -> Iterator[LearnedValue]:
    """Yield the values of keys that an effect sets, with standard errors propagated from its parameters to first order.

    `errors` are the standard errors of the parameters by name; parameters count as uncorrelated.
    """
    # The effect with one parameter changed at a time, by a part of its standard error.
    varied_effects = [
        applied.with_value(name, applied.parameters[name] + DERIVATIVE_STEP * error) for name, error in errors.items()
    ]
    for key, value in applied.instrument_keys(sensor).items():
        # Derivative by each parameter, times its standard error.
        changes = [
            (other.instrument_keys(sensor).get(key, np.nan) - value) / DERIVATIVE_STEP for other in varied_effects
        ]
        # A key whose value does not depend on the parameters has no known error: 0 becomes NaN.
        stderr = float(np.hypot.reduce(changes)) or np.nan
        # Full scale is an integer.
        value = round(value) if key == "sensor.full_scale_dn" else value
        source = f"{applied.effect.name} (verdict.json)"
        yield LearnedValue(key, value, stderr, _read_unit(key), source, overrules=True)


def _replace_gain(values: Mapping[str, LearnedValue], gain: float, stderr: float) -> Iterator[LearnedValue]:
    """Yield the gain of flats [DN/e-] that was fitted together with the effects, and quantities in electrons by it.

    Nothing is yielded if `values`, the learned values by key, contain no gain that could be replaced. The error of the
    gain is not propagated to the quantities in electrons.
    """
    previous = values.get("sensor.gain_dn_per_e")
    if previous is None:
        return
    source = f"{FLATS}, beside what else was found (verdict.json)"
    yield replace(previous, value=gain, stderr=stderr, source=source, is_from_spots=False)
    ratio = previous.value / gain
    for name in IN_ELECTRONS:
        if quantity := values.get(f"sensor.{name}"):
            source = f"{quantity.source}, by that gain"
            yield replace(quantity, value=quantity.value * ratio, stderr=quantity.stderr * ratio, source=source)


def _read_unit(key: str) -> str:
    """Return the unit of a key "section.name": the text in square brackets in its description in the schema, or "1"."""
    section, _, name = key.partition(".")
    description = read_schema("instrument")["properties"][section]["properties"][name]["description"]
    match = re.search(r"\[(.+?)\]", description)
    return match[1] if match else "1"


def _read_light(results: Path, verdict: Mapping[str, Any]) -> LearnedValue | UnusedResult | None:
    """Return the path of light.nc as a learned value if it holds one light shape; None if the verdict learned none.

    The result is unused if the file holds a shape for each pose, that is each orientation of the sample.
    """
    if not verdict.get("light"):
        return None
    count = len(read_lights(results / LIGHT))
    description = verdict["light"]["words"]
    if count > 1:
        reason = f"it differs from pose to pose ({count} shapes), and an instrument has one"
        return UnusedResult("light", description, reason)
    return LearnedValue("light.profile", results / LIGHT, np.nan, "", f"{description} (light.nc)", overrules=True)


def _collect_bad_pixels(results: Path, instrument: Instrument, sensor: SensorModel | None) -> LearnedValue | None:
    """Return the declared bad pixels together with those that many fits left out.

    None if fits left out none, or without a sensor or one of the files.
    """
    if sensor is None or not all((results / name).is_file() for name in ("fits.nc", "crops.nc")):
        return None
    with store.read(results / "fits.nc") as fits, store.read(results / "crops.nc") as crops:
        bad, count = find_bad_pixels(fits, crops, sensor)
    if bad == BadPixels():
        return None
    declared = instrument.bad_pixels
    names = ("columns", "rows", "pixels")
    merged: dict[str, Any] = {name: tuple(sorted({*getattr(declared, name), *getattr(bad, name)})) for name in names}
    source = f"left out of {count} fits (fits.nc)"
    return LearnedValue("bad_pixels", replace(declared, **merged), np.nan, "", source, overrules=True)


def _to_float(value: float | None, missing: float = np.nan) -> float:
    """Return a number of verdict.json as a float, or `missing` if it is None."""
    return missing if value is None else float(value)
