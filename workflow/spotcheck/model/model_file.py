"""Read model.yaml, which holds the extended model: `spotcheck simulate` runs it.

The extended model is the baseline with the effects that a verdict added. The file holds the parameters of the exposure
law, the effects, and the positions of the spots. Everything that the instrument fixes (photon budget, top hat, sensor)
stays in instrument.yaml; learned shapes of the light are in light.nc in the same folder. With an exposure law, peak and
width of a spot follow from the exposure; without it each spot has its own. The law of the width is σ_g = p_b plus the
laser's own width, with the beam propagation p_b = p1 ln(t/1 s) + p2 at an exposure t. The top hat cuts the Gaussian of
the spot to a plateau.
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
from spotcheck.sensor.codes import LARGEST_READING

# Values in the file are rounded, so they may exceed a bound by this share of it.
BOUND_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Site:
    """Keys that identify a spot, the light at one place on the sample. None: not recorded in the manifest."""

    angle_deg: float | None  # fibre angle [deg]
    exposure_s: float | None  # exposure [s]; None with a law, where frames of all exposures share a spot
    repeat: int  # repeat of the condition
    conditions: tuple[tuple[str, float | None], ...]  # name and value of each declared condition, sorted by name


@dataclass(frozen=True)
class Spot:
    """Position of a spot; without a law also its peak and width."""

    x_px: float  # column of the centre [px of the sensor]
    y_px: float  # row of the centre [px of the sensor]
    peak_dn: float | None = None  # peak of the Gaussian before the top hat [DN]; None with a law
    sigma_px: float | None = None  # width σ_g [px]; None with a law
    light: int | None = None  # index of its learned light shape; None if there is at most one


@dataclass(frozen=True)
class ExtendedModel:
    """The extended model, as model.yaml holds it."""

    law: ExposureLaw | None  # exposure law; None: each spot has its own peak and width
    longest_s: float  # exposure [s] at which the law's peak is given
    reference_s: float  # exposure [s] at which the effect spread_law leaves the width unchanged
    rows: int  # rows of the sensor's frame
    columns: int  # columns of the sensor's frame
    effects: tuple[AppliedEffect, ...]  # effects in the order in which they were added
    spots: Mapping[Site, Spot]  # spots by site
    lights: tuple[LightShape, ...] = ()  # learned shapes of the light; empty: the one of the instrument, if any

    def light_of(self, spot: Spot | None) -> LightShape | None:
        """Return the learned light shape of a spot, the first one for an unknown spot (None); None without shapes."""
        return self.lights[(spot and spot.light) or 0] if self.lights else None


def site_of(frame: Frame, conditions: Sequence[str], has_law: bool) -> Site:
    """Return the keys that identify the spot of a frame; `conditions` are the names of the declared conditions."""
    # `frame.extra` has the cells of the manifest in columns of declared conditions, as text.
    named_values = tuple((name, parse_number(frame.extra[name])) for name in sorted(conditions))
    return Site(frame.angle_deg, None if has_law else frame.exposure_s, frame.repeat or 0, named_values)


def scales_of(
    model: ExtendedModel, baseline: Baseline, sensor: SensorModel, crop_px: int, exposures_s: Sequence[float]
) -> EffectScales:
    """Return the scales from which effects derive their bounds, for a simulation at `exposures_s` [s].

    `crop_px` is the side of a crop [px]. `exposures_s` may be empty. Without a law, the width is the median over the
    spots, the peak that of the brightest spot, and the width does not depend on the exposure.
    """
    law = model.law
    if law is not None:
        # d ln p_b / d ln t = p1/p_b at the reference exposure.
        exponent = law.p1 / baseline.propagation(model.reference_s, law.p1, law.p2)
        sigma, peak = baseline.sigma(model.longest_s, law.p1, law.p2), law.peak_dn
    else:
        exponent, sigma = 0.0, np.median([spot.sigma_px for spot in model.spots.values()])
        # No reading lies above full scale, however bright the light of a spot is.
        peak = min(max(spot.peak_dn or 0.0 for spot in model.spots.values()), sensor.full_scale_dn)
    # `plateau` gives the brightest light, after the top hat. Full scale is infinite for a sensor without one.
    return EffectScales(
        sigma_px=float(sigma), peak_dn=float(baseline.plateau(peak)), crop_px=float(crop_px),
        full_scale_dn=min(sensor.full_scale_dn, float(LARGEST_READING)), width_exponent=float(exponent),
        shortest_s=float(min(exposures_s, default=1.0)), longest_s=model.longest_s,
        read_noise_e=sensor.read_noise_e, gain_dn_per_e=sensor.gain_dn_per_e,
    )  # fmt: skip


def check_bounds(model: ExtendedModel, scales: EffectScales, name: str) -> None:
    """Raise `InputError` for the first parameter of an effect outside its bounds; `name` is the name of the file."""
    for applied in model.effects:
        bounds = applied.effect.bounds(scales)
        for parameter, value, (low, high) in zip(applied.effect.parameters, applied.values, bounds, strict=True):
            if value < low - BOUND_TOLERANCE * abs(low) or value > high + BOUND_TOLERANCE * abs(high):
                unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                what = f"{name}: {parameter.name} of {applied.effect.name} is {value:g}{unit}"
                raise InputError(f"{what}; it must be from {low:g} to {high:g}")


def reason_without_model(path: Path) -> str:
    """Return why a model.yaml holds no model, as its key `why_not` says; "" if it holds one."""
    return str(read_keys(path).get("why_not", ""))


def read_model(path: Path) -> ExtendedModel:
    """Return the model of a file. Raises `InputError` for all mistakes but values out of bounds (`check_bounds`)."""
    content = read_keys(path)
    if "why_not" in content:
        raise InputError(f"{path.name}: holds no model: {content['why_not']}")
    if violation := find_violation(content, "model"):
        raise InputError(f"{path.name}: {violation}")
    law_keys, spots = content.get("law"), _read_spots(path, content)
    if law_keys is None and not spots:
        raise InputError(f"{path.name}: has neither law nor spots; give p1_px, p2_px and peak_dn under `law:`")
    effects = tuple(_apply_effect(keys, f"{path.name}: effects.{k}") for k, keys in enumerate(content["effects"]))
    names = [applied.effect.name for applied in effects]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path.name}: effect {repeated[0]} stands twice; keep one of them")
    lights = _read_light_shapes(path, content.get("light"), effects)
    for k, spot in enumerate(spots.values()):
        if len(lights) > 1 and spot.light not in range(len(lights)):
            raise InputError(f"{path.name}: spots.{k}.light must say which of {len(lights)} lights it has, from 0 on")
    law = law_keys and ExposureLaw(float(law_keys["p1_px"]), float(law_keys["p2_px"]), float(law_keys["peak_dn"]))
    longest_s, reference_s = (float(content["exposure"][key]) for key in ("longest_s", "reference_s"))
    rows, columns = (int(content["frame"][key]) for key in ("rows_px", "columns_px"))
    return ExtendedModel(law, longest_s, reference_s, rows, columns, effects, spots, lights)


def _read_spots(path: Path, content: Mapping[str, Any]) -> dict[Site, Spot]:
    """Return the spots of a model.yaml by site; `content` holds the keys of the file.

    Raises `InputError` if keys of a spot are missing or contradict the exposure law, or if two spots have one site.
    """
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


def _read_light_shapes(path: Path, file: str | None, effects: Sequence[AppliedEffect]) -> tuple[LightShape, ...]:
    """Return the learned light shapes in `file`, which lies beside the model.yaml `path`; () if `file` is None.

    A learned shape is also one of the effects: the one that acts at no stage, as the file holds all of it. Raises
    `InputError` if the model has only the file or only the effect, and as `read_lights` does.
    """
    learned_names = [applied.effect.name for applied in effects if not applied.effect.stages]
    if learned_names and file is None:
        raise InputError(f"{path.name}: key light is missing; {learned_names[0]} needs the file of its shape ({LIGHT})")
    if file is not None and not learned_names:
        raise InputError(f"{path.name}: key light names {file}, but no effect stands for its shape; drop the key")
    return () if file is None else read_lights(path.parent / file)


def _apply_effect(keys: Mapping[str, Any], where: str) -> AppliedEffect:
    """Return the effect of an entry under `effects`, whose `keys` are name, parameters and form (the variant).

    `where` names file and entry in messages. Raises `InputError` for an unknown effect, variant or parameter.
    """
    effect = vocabulary().get(keys["name"])
    if effect is None:
        raise InputError(f"{where}.name is {keys['name']}, which is no effect; known are {', '.join(vocabulary())}")
    try:
        return effect.apply(keys["parameters"], keys.get("form"))
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
