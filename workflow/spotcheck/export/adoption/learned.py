"""What the results of a dataset say of each key of instrument.yaml: value, standard error, and where it comes from.

Numbers of the sensor come from transfer.nc, sensor.nc and verdict.json, the light's shape from light.nc, bad pixels
from what fits left out, and effects from the verdict by what they say of themselves (`Effect.instrument_keys`).
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spotcheck.characterization.sensor_choice import (
    EMVA_NAMES,
    FLATS,
    ONLY_FROM_SHEET,
    QUANTITIES,
    SPOTS,
    read_sensor_model,
)
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset.instrument import BadPixels, Instrument
from spotcheck.export.adoption.bad import bad_in
from spotcheck.io import store
from spotcheck.io.plus_minus import plus_minus
from spotcheck.io.schema import read_schema
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.light_shape import LIGHT, read_lights
from spotcheck.sensor import SensorModel

# Steps of the derivative by which errors of an effect become those of a key, in its standard errors.
STEP = 1e-3
# Numbers of the dark that are proportional to 1/K; and of light, which hang on how the response bends.
IN_ELECTRONS, OF_A_LINE = ("read_noise_e", "dark_current_e_per_s"), ("quantum_efficiency",)
NO_KEY = "no key of an instrument file holds it"


class Learned(NamedTuple):
    """Of a key of instrument.yaml: what was learned, a number or what the key holds; its standard error (NaN: none is
    known) and unit; where it comes from; `overrules`: whether it was found against what the data sheet states."""

    key: str
    value: Any
    stderr: float
    unit: str
    origin: str
    overrules: bool = False


class Left(NamedTuple):
    """What was learned and no key takes: what it is, in words and numbers, and why it is left."""

    what: str
    said: str
    why: str


def learned_of(results: Path, given: Instrument) -> tuple[list[Learned], list[Left]]:
    """All that a folder of results says of its instrument, of each key the best source, and what no key takes."""
    verdict, sensor = _verdict(results), _sensor(results)
    # What comes later knows better.
    found = {own.key: own for own in (*_by_end(results), *_by_numbers(results), *_by_sheet(verdict))}
    camera = _camera(found, sensor, verdict)
    effects, left = _by_effects(verdict, camera)
    found |= {own.key: own for own in effects}
    if verdict.get("levels") and (effects or left):
        gain = verdict["levels"]["gain_dn_per_e"]
        if left:
            why = f"it holds beside {' and '.join(own.what for own in left)}, and no key holds that"
            left.append(Left("gain", number(_of(gain, "value"), _of(gain, "stderr"), "DN/e-"), why))
        else:
            found |= {own.key: own for own in _beside(found, _of(gain, "value"), _of(gain, "stderr"))}
            left += [_of_a_line(found.pop(f"sensor.{name}")) for name in OF_A_LINE if f"sensor.{name}" in found]
    for own in (_by_light(results, verdict), _by_pixels(results, given, sensor)):
        if isinstance(own, Learned):
            found[own.key] = own
        elif own is not None:
            left.append(own)
    return list(found.values()), left


def _verdict(results: Path) -> Mapping[str, Any]:
    """The verdict; empty where there is none, as after `spotcheck transfer` alone."""
    path = results / "verdict.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _sensor(results: Path) -> SensorModel | None:
    """The sensor that the results rest on; None where there is none."""
    if not (results / "sensor.nc").is_file():
        return None
    with store.read(results / "sensor.nc") as ds:
        return read_sensor_model(ds)


def _by_end(results: Path) -> Iterator[Learned]:
    """Where the readings of frames stop, where they show it."""
    if (results / "frames.nc").is_file():
        with store.read(results / "frames.nc") as table:
            own = table["full_scale"]
            if str(own.attrs["source"]).startswith("where"):
                yield Learned("sensor.full_scale_dn", int(own), np.nan, "DN", f"{own.attrs['source']} (frames.nc)")


def _by_numbers(results: Path) -> Iterator[Learned]:
    """Numbers of the sensor by spots, and by flats and darks, which know better."""
    names = [name for name in EMVA_NAMES if name not in ONLY_FROM_SHEET]
    if (results / "sensor.nc").is_file():
        with store.read(results / "sensor.nc") as ds:
            for source in (SPOTS, FLATS):
                for name in names:
                    value, error = (float(ds[f"{name}_by{part}"].sel(source=source)) for part in ("", "_stderr"))
                    yield from _number(name, value, error, f"{source} (sensor.nc)")
    elif (results / "transfer.nc").is_file():
        with store.read(results / "transfer.nc") as ds:
            quantities = read_quantities(ds)
        for name in names:
            own = quantities[EMVA_NAMES[name]]
            yield from _number(name, own.value, own.stderr, f"{FLATS} (transfer.nc)")


def _number(name: str, value: float, stderr: float, origin: str) -> Iterator[Learned]:
    if np.isfinite(value):
        # A dark current below 0 by chance is none.
        yield Learned(f"sensor.{name}", max(value, 0.0), stderr, QUANTITIES[name][0], origin)


def _by_sheet(verdict: Mapping[str, Any]) -> Iterator[Learned]:
    """Numbers of the sheet as the verdict's fit of all frames moved them."""
    for own in verdict.get("sheet") or ():
        origin = "data sheet and all frames together (verdict.json)"
        key = f"sensor.{own['name']}"
        yield Learned(key, own["found"], _of(own, "stderr"), own["unit"], origin, own["contradicts"])


def _camera(found: Mapping[str, Learned], sensor: SensorModel | None, verdict: Mapping[str, Any]) -> SensorModel | None:
    """The sensor with what was learned of it; None where its gain is unknown."""
    if sensor is None:
        gain = (verdict.get("levels") or {}).get("gain_dn_per_e", {}).get("value")
        if gain is None:
            return None
        sensor = SensorModel(gain, 0.0)
    names = [field.name for field in fields(SensorModel) if f"sensor.{field.name}" in found]
    return replace(sensor, **{name: found[f"sensor.{name}"].value for name in names})


def _by_effects(verdict: Mapping[str, Any], camera: SensorModel | None) -> tuple[list[Learned], list[Left]]:
    """Keys that the verdict's effects determine, and effects that no key holds."""
    found: list[Learned] = []
    left = []
    for own in verdict.get("effects", ()):
        effect = vocabulary().get(own["name"])
        if effect is None or not effect.stages:
            continue
        numbers, rivals, keys = own["parameters"], own["candidates"][1:], []
        if camera is not None and not rivals:
            # No key holds an effect that lacks a constant of its variant.
            with suppress(ValueError):
                applied = effect.apply({name: _of(one, "value") for name, one in numbers.items()}, own["form"])
                errors = {name: _known(one["stderr"], 0.0) for name, one in numbers.items()}
                keys = list(_keys(applied, errors, camera))
        found += keys
        if not keys:
            told = ((name, one) for name, one in numbers.items() if one["value"] is not None)
            said = ", ".join(
                f"{name} {number(_of(one, 'value'), _of(one, 'stderr'), one['unit'])}" for name, one in told
            )
            why = f"it may as well be {' or '.join(rivals)}" if rivals else NO_KEY
            left.append(Left(own["name"], f"{own['form']}: {said}" if own["form"] else said, why))
    return found, left


def _keys(applied: AppliedEffect, errors: Mapping[str, float], camera: SensorModel) -> Iterator[Learned]:
    """What an effect says of keys, with the errors that its parameters' errors make."""
    moved = [applied.with_value(name, applied.parameters[name] + STEP * error) for name, error in errors.items()]
    for key, value in applied.instrument_keys(camera).items():
        changes = [(other.instrument_keys(camera).get(key, np.nan) - value) / STEP for other in moved]
        stderr = float(np.hypot.reduce(changes)) or np.nan
        # A converter stops at a whole number.
        own = round(value) if key == "sensor.full_scale_dn" else value
        yield Learned(key, own, stderr, _unit(key), f"{applied.effect.name} (verdict.json)", True)


def _beside(found: Mapping[str, Learned], gain: float, stderr: float) -> Iterator[Learned]:
    """The gain that levels of flats have beside the effects that were found, and what is in electrons: DN over it."""
    key = "sensor.gain_dn_per_e"
    if key not in found:
        return
    ratio = found[key].value / gain
    yield found[key]._replace(value=gain, stderr=stderr, origin=f"{FLATS}, beside what else was found (verdict.json)")
    for name in IN_ELECTRONS:
        if own := found.get(f"sensor.{name}"):
            yield own._replace(value=own.value * ratio, stderr=own.stderr * ratio, origin=f"{own.origin}, by that gain")


def _of_a_line(own: Learned) -> Left:
    """What photon transfer says of light as if the response were straight."""
    why = "it is of a straight response; flats with the new instrument file tell it"
    return Left(own.key, number(own.value, own.stderr, own.unit), why)


def _unit(key: str) -> str:
    """Unit of a key, which stands in what the schema says of it."""
    section, _, name = key.partition(".")
    found = re.search(r"\[(.+?)\]", read_schema("instrument")["properties"][section]["properties"][name]["description"])
    return found[1] if found else "1"


def _by_light(results: Path, verdict: Mapping[str, Any]) -> Learned | Left | None:
    """The light's learned shape, by the file that holds it."""
    if not verdict.get("light"):
        return None
    lights = read_lights(results / LIGHT)
    words = verdict["light"]["words"]
    if len(lights) > 1:
        return Left("light", words, f"it differs from pose to pose ({len(lights)} shapes), and an instrument has one")
    return Learned("light.profile", results / LIGHT, np.nan, "", f"{words} (light.nc)", True)


def _by_pixels(results: Path, given: Instrument, sensor: SensorModel | None) -> Learned | None:
    """Pixels that fits left out in frame after frame, beside those that are known to be bad."""
    if sensor is None or not all((results / name).is_file() for name in ("fits.nc", "crops.nc")):
        return None
    with store.read(results / "fits.nc") as fits, store.read(results / "crops.nc") as crops:
        bad, frames = bad_in(fits, crops, sensor)
    if bad == BadPixels():
        return None
    known = given.bad_pixels
    own = BadPixels(
        known.mask,
        tuple(sorted({*known.columns, *bad.columns})),
        tuple(sorted({*known.rows, *bad.rows})),
        tuple(sorted({*known.pixels, *bad.pixels})),
    )
    return Learned("bad_pixels", own, np.nan, "", f"left out of {frames} fits (fits.nc)", True)


def number(value: float, stderr: float, unit: str) -> str:
    """A number as a person writes it; the unit 1 is none."""
    return plus_minus(value, stderr, "" if unit == "1" else unit)


def _of(told: Mapping[str, Any], part: str) -> float:
    return _known(told[part], np.nan)


def _known(value: float | None, default: float) -> float:
    return default if value is None else float(value)
