"""model.yaml: the extended model in one file, which `spotcheck simulate` runs as it is.

It holds the numbers of the baseline, the effects that a verdict added, and where the spots lie. What the instrument
fixes (photon budget, top hat, sensor) stays in instrument.yaml; learned shapes of the light are in light.nc beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spotcheck.dataset.manifest import Frame, parse_number
from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation, read_keys
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.model.effects import vocabulary
from spotcheck.model.light import ExposureLaw
from spotcheck.model.light_shape import LIGHT, LightShape, read_lights
from spotcheck.sensor import SensorModel

# Rounding in the file may carry a value beyond a bound by this part of it.
SLACK = 1e-6


@dataclass(frozen=True)
class Site:
    """Keys that identify a spot. None: not recorded."""

    angle_deg: float | None  # fibre angle [deg]
    exposure_s: float | None  # exposure [s], only without a law: then every frame has a spot of its own
    repeat: int  # repeat of the condition
    conditions: tuple[tuple[str, float | None], ...]  # declared conditions by name, sorted


@dataclass(frozen=True)
class Spot:
    """A spot of the model."""

    x_px: float  # column of the centre [px of the sensor]
    y_px: float  # row of the centre [px of the sensor]
    peak_dn: float | None = None  # peak [DN], only without a law
    sigma_px: float | None = None  # width σ_g [px], only without a law
    light: int | None = None  # which of several learned shapes of the light it has, from 0; None: there is one at most


@dataclass(frozen=True)
class ExtendedModel:
    """The extended model of a file."""

    law: ExposureLaw | None  # law of the exposure; None: each spot has its own peak and width
    longest_s: float  # exposure [s] at which the law's peak is given
    reference_s: float  # exposure [s] at which the spread law leaves the width
    rows: int  # rows of the sensor's frame
    columns: int  # columns of the sensor's frame
    effects: tuple[AppliedEffect, ...]  # effects in the order in which they were added
    spots: Mapping[Site, Spot]  # spots by site
    lights: tuple[LightShape, ...] = ()  # learned shapes of the light; none: that of the instrument

    def light_of(self, spot: Spot | None) -> LightShape | None:
        """Return the learned shape of a spot's light, the first one for a spot that is unknown."""
        return self.lights[(spot and spot.light) or 0] if self.lights else None


def site_of(frame: Frame, conditions: Sequence[str], has_law: bool) -> Site:
    """Return what identifies the spot of a frame of the manifest."""
    values = tuple((name, parse_number(frame.extra[name])) for name in sorted(conditions))
    return Site(frame.angle_deg, None if has_law else frame.exposure_s, frame.repeat or 0, values)


def scales_of(
    model: ExtendedModel, baseline: Baseline, sensor: SensorModel, crop_px: int, exposures_s: Sequence[float]
) -> EffectScales:
    """Return the scales from which bounds of effects derive, for a simulation at `exposures_s`."""
    law = model.law
    if law is not None:
        exponent = law.p1 / baseline.propagation(model.reference_s, law.p1, law.p2)
        sigma, peak = baseline.sigma(model.longest_s, law.p1, law.p2), law.peak_dn
    else:
        exponent, sigma = 0.0, np.median([spot.sigma_px for spot in model.spots.values()])
        # No reading lies above full scale, however bright the light of a spot is.
        peak = min(max(spot.peak_dn or 0.0 for spot in model.spots.values()), sensor.full_scale_dn)
    return EffectScales(
        sigma_px=float(sigma), peak_dn=float(baseline.plateau(peak)), full_scale_dn=min(sensor.full_scale_dn, 65535.0),
        crop_px=float(crop_px), shortest_s=float(min(exposures_s, default=1.0)), longest_s=model.longest_s,
        read_noise_e=sensor.read_noise_e, gain_dn_per_e=sensor.gain_dn_per_e, width_exponent=float(exponent),
    )  # fmt: skip


def check_bounds(model: ExtendedModel, scales: EffectScales, name: str) -> None:
    """Raise `InputError` for the first value outside its bounds; `name` is the name of the file."""
    for applied in model.effects:
        bounds = applied.effect.bounds(scales)
        for parameter, value, (low, high) in zip(applied.effect.parameters, applied.values, bounds, strict=True):
            if value < low - SLACK * abs(low) or value > high + SLACK * abs(high):
                unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                what = f"{name}: {parameter.name} of {applied.effect.name} is {value:g}{unit}"
                raise InputError(f"{what}; it must be from {low:g} to {high:g}")


def reason_without_model(path: Path) -> str:
    """Return why a file holds no model; "" if it holds one."""
    return str(read_keys(path).get("why_not", ""))


def read_model(path: Path) -> ExtendedModel:
    """Read the model of a file. Raises `InputError` for everything that is wrong except bounds (`check_bounds`)."""
    content = read_keys(path)
    if "why_not" in content:
        raise InputError(f"{path.name}: holds no model: {content['why_not']}")
    if breach := find_violation(content, "model"):
        raise InputError(f"{path.name}: {breach}")
    law, spots = content.get("law"), _spots(path, content)
    if law is None and not spots:
        raise InputError(f"{path.name}: has neither law nor spots; give p1_px, p2_px and peak_dn under `law:`")
    effects = tuple(_applied(keys, f"{path.name}: effects.{k}") for k, keys in enumerate(content["effects"]))
    names = [applied.effect.name for applied in effects]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path.name}: effect {twice[0]} stands twice; keep one of them")
    lights = _lights(path, content.get("light"), effects)
    for k, spot in enumerate(spots.values()):
        if len(lights) > 1 and spot.light not in range(len(lights)):
            raise InputError(f"{path.name}: spots.{k}.light must say which of {len(lights)} lights it has, from 0 on")
    law = law and ExposureLaw(float(law["p1_px"]), float(law["p2_px"]), float(law["peak_dn"]))
    longest_s, reference_s = (float(content["exposure"][key]) for key in ("longest_s", "reference_s"))
    rows, columns = (int(content["frame"][key]) for key in ("rows_px", "columns_px"))
    return ExtendedModel(law, longest_s, reference_s, rows, columns, effects, spots, lights)


def _spots(path: Path, content: Mapping[str, Any]) -> dict[Site, Spot]:
    spots = {}
    for k, keys in enumerate(content.get("spots", ())):
        conditions = tuple(sorted(keys.get("conditions", {}).items()))
        site = Site(keys.get("angle_deg"), keys.get("exposure_s"), int(keys["repeat"]), conditions)
        spot = Spot(keys["x_px"], keys["y_px"], keys.get("peak_dn"), keys.get("sigma_px"), keys.get("light"))
        if "law" not in content and None in (spot.peak_dn, spot.sigma_px):
            raise InputError(f"{path.name}: spots.{k} lacks peak_dn or sigma_px, which every spot needs without a law")
        if "law" in content and {"exposure_s", "peak_dn", "sigma_px"} & set(keys):
            raise InputError(f"{path.name}: spots.{k} has exposure_s, peak_dn or sigma_px, which the law gives")
        if site in spots:
            raise InputError(f"{path.name}: spots.{k} stands twice; keep one of them")
        spots[site] = spot
    return spots


def _lights(path: Path, file: str | None, effects: Sequence[AppliedEffect]) -> tuple[LightShape, ...]:
    """Return the learned shapes of a file, which an effect without steps stands for."""
    learned = [applied.effect.name for applied in effects if not applied.effect.stages]
    if learned and file is None:
        raise InputError(f"{path.name}: key light is missing; {learned[0]} needs the file of its shape ({LIGHT})")
    if file is not None and not learned:
        raise InputError(f"{path.name}: key light names {file}, but no effect stands for its shape; drop the key")
    return () if file is None else read_lights(path.parent / file)


def _applied(keys: Mapping[str, Any], where: str) -> AppliedEffect:
    """Return the effect of an entry under `effects`; `where` is the name of the entry."""
    effect = vocabulary().get(keys["name"])
    if effect is None:
        raise InputError(f"{where}.name is {keys['name']}, which is no effect; known are {', '.join(vocabulary())}")
    try:
        return effect.apply(keys["parameters"], keys.get("form"))
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
