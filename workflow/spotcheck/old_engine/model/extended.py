"""model.yaml: the extended model in one file, which `spotcheck simulate` runs as it is.

It holds the baseline's numbers, the effects that a verdict added, and where the spots lie. What the instrument fixes
(photon budget, top hat, sensor) stays in instrument.yaml; shapes of the light that were learned are in light.nc beside.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spotcheck.errors import InputError
from spotcheck.manifest import Frame, number_in
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, Law, bounds_context
from spotcheck.old_engine.model.effect import Context, Effect, Parameter, Place, Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.light_file import LIGHT, read_lights
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.schema import breach_of, read_keys

# Rounding in the file may carry a value this part of a bound beyond it.
SLACK = 1e-6


class Site(NamedTuple):
    """What a spot is known by: fibre angle [deg], repeat and declared conditions; without a law also its exposure [s],
    as then every frame has a spot of its own. None: not recorded."""

    angle_deg: float | None
    exposure_s: float | None
    repeat: int
    conditions: tuple[tuple[str, float | None], ...]


class Spot(NamedTuple):
    """Centre of a spot [px of the sensor]; without a law also its peak [DN] and σ_g [px]; and which of several learned
    lights it has, from 0 on (None: there is one at most)."""

    x_px: float
    y_px: float
    peak_dn: float | None = None
    sigma_px: float | None = None
    light: int | None = None


class Extended(NamedTuple):
    """The extended model: the baseline's law (None: each spot has its own peak and width), the exposure [s] at which
    the law's peak is given and that at which the spread law keeps the width, rows and columns of the sensor's frame,
    the effects in order, the spots, and the light's learned shapes (none: the instrument's)."""

    law: Law | None
    longest_s: float
    reference_s: float
    rows: int
    columns: int
    present: tuple[Present, ...]
    spots: Mapping[Site, Spot]
    lights: tuple[LightShape, ...] = ()

    def light_of(self, spot: Spot | None) -> LightShape | None:
        """The learned shape of a spot's light; of one that is not known the first."""
        return self.lights[(spot and spot.light) or 0] if self.lights else None


def site_of(frame: Frame, conditions: Sequence[str], lawful: bool) -> Site:
    """What the spot of a frame of the manifest is known by."""
    own = tuple((name, number_in(frame.extra[name])) for name in sorted(conditions))
    return Site(frame.angle_deg, None if lawful else frame.exposure_s, frame.repeat or 0, own)


def context_of(
    model: Extended, baseline: Baseline, sensor: SensorModel, crop_px: int, exposures_s: Sequence[float]
) -> Context:
    """What the bounds of effects depend on, for a simulation at `exposures_s`."""
    spots = model.spots.values()
    base = model.law or Free(np.array([s.peak_dn for s in spots]), np.array([s.sigma_px for s in spots]))
    shortest = float(min(exposures_s, default=1.0))
    return bounds_context(base, baseline, sensor, float(crop_px), shortest, model.longest_s, model.reference_s)


def within_bounds(present: Present, context: Context) -> Present:
    """The same effect with every value moved to the nearest within its bounds.

    A verdict's values may lie outside by a little: the fit's bounds came from its first look, and a variance component
    has none.
    """
    low, high = present.effect.bounds(context).T
    return present._replace(values=tuple(np.clip(present.values, low, high).tolist()))


def check_bounds(model: Extended, context: Context, name: str) -> None:
    """Raise `InputError` for the first value outside its bounds; `name` is the file's."""
    for own in model.present:
        for parameter, value, (low, high) in zip(
            own.effect.parameters, own.values, own.effect.bounds(context), strict=True
        ):
            if value < low - SLACK * abs(low) or value > high + SLACK * abs(high):
                unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                raise InputError(
                    f"{name}: {parameter.name} of {own.effect.name} is {value:g}{unit}; it must be from {low:g} to"
                    f" {high:g}"
                )


def needed(effect: Effect, form: str) -> list[Parameter]:
    """Parameters that act in a form: inner ones that the form lacks do not."""
    idle = effect.idle.get(form, ())
    return [p for p in effect.parameters if not (p.inner and p.name in idle)]


# Writing.


def text_of(model: Extended, dataset: str, status: str) -> str:
    """The content of model.yaml; numbers to nine digits."""
    return "\n".join(_lines(model, dataset, status)) + "\n"


def no_model(dataset: str, why: str) -> str:
    """The content of model.yaml where there is no model, not even a baseline."""
    return f"schema: 1\ndataset: {_quoted(dataset)}\nwhy_not: {_quoted(why)}\n"


def _lines(model: Extended, dataset: str, status: str) -> Iterator[str]:
    yield "# The baseline of instrument.yaml with what the verdict added: `spotcheck simulate --model` runs this file."
    yield "# Positions and lengths in px of the sensor, x to the right, y down; directions in deg from +x towards +y."
    yield "schema: 1"
    yield f"dataset: {_quoted(dataset)}"
    yield f"status: {status}"
    yield f"frame: {{rows_px: {model.rows}, columns_px: {model.columns}}}"
    yield f"exposure: {{longest_s: {model.longest_s:.9g}, reference_s: {model.reference_s:.9g}}}"
    if model.lights:
        yield f"light: {LIGHT}"
    if model.law is not None:
        yield "law:"
        yield f"  p1_px: {model.law.p1:.9g}"
        yield f"  p2_px: {model.law.p2:.9g}"
        yield f"  peak_dn: {model.law.peak:.9g}  # at the longest exposure, before effects"
    yield "effects:" if model.present else "effects: []"
    for own in model.present:
        yield f"  - name: {own.effect.name}  # {own.effect.sentence}"
        if len(own.effect.forms) > 1:
            yield f"    form: {own.form}"
        yield "    parameters:"
        values = own.named()
        for parameter in needed(own.effect, own.form):
            unit = "" if parameter.unit == "1" else f"  # {parameter.unit}"
            yield f"      {parameter.name}: {values[parameter.name]:.9g}{unit}"
    yield "spots:" if model.spots else "spots: []"
    for site, spot in model.spots.items():
        inner = ", ".join(f"{name}: {value!r}" for name, value in site.conditions if value is not None)
        keys = {"angle_deg": site.angle_deg, "exposure_s": site.exposure_s, "repeat": site.repeat}
        parts = [f"{key}: {value!r}" for key, value in keys.items() if value is not None]
        parts += [f"conditions: {{{inner}}}"] if inner else []
        parts += [f"{key}: {value:.9g}" for key, value in spot._asdict().items() if value is not None]
        yield f"  - {{{', '.join(parts)}}}"


def _quoted(text: str) -> str:
    """A text as JSON has it, which is YAML as well."""
    return json.dumps(text, ensure_ascii=False)


# Reading.


def why_none(path: Path) -> str:
    """Why a file holds no model; empty where it holds one."""
    return str(read_keys(path).get("why_not", ""))


def read_model(path: Path) -> Extended:
    """The model of a file. Raises `InputError` for whatever is wrong with it but bounds (`check_bounds`)."""
    content = read_keys(path)
    if "why_not" in content:
        raise InputError(f"{path.name}: holds no model: {content['why_not']}")
    if breach := breach_of(content, "model"):
        raise InputError(f"{path.name}: {breach}")
    law = content.get("law")
    spots = {}
    for k, own in enumerate(content.get("spots", ())):
        site, spot = _spot(own)
        if law is None and None in (spot.peak_dn, spot.sigma_px):
            raise InputError(f"{path.name}: spots.{k} lacks peak_dn or sigma_px, which every spot needs without a law")
        if law is not None and {"exposure_s", "peak_dn", "sigma_px"} & set(own):
            raise InputError(f"{path.name}: spots.{k} has exposure_s, peak_dn or sigma_px, which the law gives")
        if site in spots:
            raise InputError(f"{path.name}: spots.{k} stands twice; keep one of them")
        spots[site] = spot
    if law is None and not spots:
        raise InputError(f"{path.name}: has neither law nor spots; give p1_px, p2_px and peak_dn under `law:`")
    present = tuple(_present(own, f"{path.name}: effects.{k}") for k, own in enumerate(content["effects"]))
    names = [own.effect.name for own in present]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path.name}: effect {twice[0]} stands twice; keep one of them")
    lights = _lights(path, content.get("light"), present)
    for k, spot in enumerate(spots.values()):
        if len(lights) > 1 and not 0 <= (-1 if spot.light is None else spot.light) < len(lights):
            raise InputError(f"{path.name}: spots.{k}.light must say which of {len(lights)} lights it has, from 0 on")
    frame, exposure = content["frame"], content["exposure"]
    return Extended(
        None if law is None else Law(float(law["p1_px"]), float(law["p2_px"]), float(law["peak_dn"])),
        float(exposure["longest_s"]),
        float(exposure["reference_s"]),
        int(frame["rows_px"]),
        int(frame["columns_px"]),
        present,
        spots,
        lights,
    )


def _lights(path: Path, file: str | None, present: Sequence[Present]) -> tuple[LightShape, ...]:
    """The learned shapes: those of a file, where an effect stands for them."""
    learned = [own.effect.name for own in present if own.effect.place is Place.SHAPE]
    if learned and file is None:
        raise InputError(
            f"{path.name}: key light is missing; {learned[0]} needs the file of its shape, such as {LIGHT}"
        )
    if file is None:
        return ()
    if not learned:
        raise InputError(
            f"{path.name}: key light names {file}, but no effect stands for its shape; add one, or drop it"
        )
    return read_lights(path.parent / file)


def _spot(own: dict[str, Any]) -> tuple[Site, Spot]:
    conditions = tuple(sorted(own.get("conditions", {}).items()))
    site = Site(own.get("angle_deg"), own.get("exposure_s"), int(own["repeat"]), conditions)
    return site, Spot(own["x_px"], own["y_px"], own.get("peak_dn"), own.get("sigma_px"), own.get("light"))


def _present(own: dict[str, Any], where: str) -> Present:
    """An effect of the file. Parameters that its form lacks are NaN: nothing may depend on them."""
    effect = vocabulary().get(own["name"])
    if effect is None:
        raise InputError(f"{where}.name is {own['name']}, which is no effect; known effects: {', '.join(vocabulary())}")
    form, given = own.get("form", effect.forms[0] if len(effect.forms) == 1 else None), own["parameters"]
    if form is None:
        raise InputError(f"{where}: {effect.name} lacks its form; it must be one of {', '.join(effect.forms)}")
    if form not in effect.forms:
        known = ", ".join(name for name in effect.forms if name)
        raise InputError(f"{where}.form is {form}; " + (f"it must be one of {known}" if known else "it has no forms"))
    names = [p.name for p in needed(effect, form)]
    if unknown := [name for name in given if name not in names]:
        raise InputError(f"{where}.parameters has no key {unknown[0]} in {effect.name}; its keys: {', '.join(names)}")
    if missing := [name for name in names if name not in given]:
        raise InputError(f"{where}.parameters.{missing[0]} is missing; {effect.name} needs {', '.join(names)}")
    return Present(effect, form, tuple(float(given.get(p.name, np.nan)) for p in effect.parameters))
