"""Write model.yaml and light.nc, which `model_file` and `light_shape` read.

model.yaml holds the extended model: the exposure law, the effects with their parameters, and the spots, each identified
by its site. light.nc holds learned light shapes s(u, v), which are added to the declared shape and divided by its peak;
u and v are places to the right of the spot's centre and below it, in widths σ_g of the spot. A shape is a sum of cubic
B-splines on a square of nodes. A finer layer, with nodes closer together, may be added to it.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.io import store
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.light_shape import LIGHT, LightShape
from spotcheck.model.model_file import ExtendedModel, Site, Spot

# Points along each axis of the map of a light shape, which is for display only.
POINTS = 201


def model_text(model: ExtendedModel, dataset: str, status: str) -> str:
    """Return the content of model.yaml; numbers have nine significant digits.

    Parameters
    ----------
    model : ExtendedModel
        The extended model.
    dataset : str
        Name of the dataset from which the model was fitted.
    status : str
        Status of the verdict on this dataset.
    """
    return "\n".join(_model_lines(model, dataset, status)) + "\n"


def no_model_text(dataset: str, reason: str) -> str:
    """Return the content of the model.yaml of a dataset for which there is no model, with the reason."""
    return f"schema: 1\ndataset: {_quote(dataset)}\nwhy_not: {_quote(reason)}\n"


def _model_lines(model: ExtendedModel, dataset: str, status: str) -> Iterator[str]:
    """Yield the lines of model.yaml; arguments as for `model_text`."""
    yield "# The baseline of instrument.yaml with what the verdict added: `spotcheck simulate --model` runs this file."
    yield "# Positions and lengths in px of the sensor, x to the right, y down; directions in deg from +x towards +y."
    yield "schema: 1"
    yield f"dataset: {_quote(dataset)}"
    yield f"status: {status}"
    yield f"frame: {{rows_px: {model.rows}, columns_px: {model.columns}}}"
    yield f"exposure: {{longest_s: {model.longest_s:.9g}, reference_s: {model.reference_s:.9g}}}"
    if model.lights:
        yield f"light: {LIGHT}"
    if model.law is not None:
        yield "law:"
        yield f"  p1_px: {model.law.p1:.9g}"
        yield f"  p2_px: {model.law.p2:.9g}"
        yield f"  peak_dn: {model.law.peak_dn:.9g}  # at the longest exposure, before effects"
    yield "effects:" if model.effects else "effects: []"
    for applied in model.effects:
        yield from _effect_lines(applied)
    yield "spots:" if model.spots else "spots: []"
    for site, spot in model.spots.items():
        yield f"  - {{{', '.join(_spot_entries(site, spot))}}}"


def _effect_lines(applied: AppliedEffect) -> Iterator[str]:
    """Yield the lines of an effect under the key `effects`: name, variant (`form`, if it has a text) and parameters."""
    effect = applied.effect
    yield f"  - name: {effect.name}  # {effect.sentence}"
    if applied.variant.value:
        yield f"    form: {applied.variant.value}"
    yield "    parameters:"
    for parameter in effect.parameters_of(applied.variant):
        unit = "" if parameter.unit == "1" else f"  # {parameter.unit}"
        yield f"      {parameter.name}: {applied.parameters[parameter.name]:.9g}{unit}"


def _spot_entries(site: Site, spot: Spot) -> Iterator[str]:
    """Yield the entries "key: value" of the line of a spot, first those of its site.

    Values that are None, which stands for unknown, have no entry.
    """
    # The entries of a site identify it when the file is read, so they keep all digits.
    identity = {"angle_deg": site.angle_deg, "exposure_s": site.exposure_s, "repeat": site.repeat}
    yield from (f"{key}: {value!r}" for key, value in identity.items() if value is not None)
    conditions = ", ".join(f"{name}: {value!r}" for name, value in site.conditions if value is not None)
    if conditions:
        yield f"conditions: {{{conditions}}}"
    yield from (f"{key}: {value:.9g}" for key, value in vars(spot).items() if value is not None)


def _quote(text: str) -> str:
    """Return a text as a JSON string, which is valid YAML."""
    return json.dumps(text, ensure_ascii=False)


@dataclass(frozen=True)
class LightFile:
    """Path, provenance and description of a light.nc."""

    path: str | Path  # file to write
    dataset: str  # name of the dataset from which the shape was learned
    code: str  # digest of the code that learned the shape
    inputs: Sequence[str | Path] = ()  # files from which the shape was learned
    # Further netCDF attributes of a file with a shape, such as `described`.
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def fixed_attributes(self) -> dict[str, Any]:
        """NetCDF attributes that every light.nc has, with or without a shape."""
        return {"title": f"The light's shape, learned from {self.dataset}", "dataset": self.dataset}


def write_light(shapes: Sequence[LightShape], file: LightFile) -> None:
    """Write learned light shapes: the coefficients of their splines, and maps of s(u, v) for display.

    There is at least one shape. All shapes have the same nodes, and so have their finer layers. A finer layer is
    written for all shapes if any has one, with zeros for the others.
    """
    step, node_count = float(shapes[0].step), len(shapes[0].coefficients)
    # Places along an axis in σ_g: nodes of the splines, and points of the maps.
    nodes = step * (np.arange(node_count) - (node_count - 1) / 2)
    points = np.linspace(nodes[0], nodes[-1], POINTS)
    ds = xr.Dataset(attrs=file.fixed_attributes | dict(file.attributes))

    def add(name: str, dims: str | tuple[str, ...], values: Any, long_name: str) -> None:
        """Add a variable without unit to `ds`."""
        ds[name] = (dims, values, {"units": "1", "long_name": long_name})

    add("node_v", "node_v", nodes, "node below the spot's centre, over sigma_g")
    add("node_u", "node_u", nodes, "node to the right of the spot's centre, over sigma_g")
    add("v", "v", points, "place below the spot's centre, over sigma_g")
    add("u", "u", points, "place to the right of the spot's centre, over sigma_g")
    coefficients = np.array([shape.coefficients for shape in shapes])
    text = "coefficients of cubic B-splines of the light beside the declared shape, over that one's peak"
    add("coefficients", ("light", "node_v", "node_u"), coefficients, text)
    add("step", (), step, "distance of nodes, over sigma_g")
    finer_layers = [shape.finer for shape in shapes if shape.finer is not None]
    if finer_layers:
        zeros = np.zeros_like(finer_layers[0].coefficients)
        fine_coefficients = np.array([zeros if shape.finer is None else shape.finer.coefficients for shape in shapes])
        text = "coefficients of cubic B-splines of structure between the nodes, which is added, over the same peak"
        add("fine_coefficients", ("light", "fine_v", "fine_u"), fine_coefficients, text)
        add("fine_step", (), float(finer_layers[0].step), "distance of nodes of that structure, over sigma_g")
    maps = np.array([shape(points[None, :], points[:, None]) for shape in shapes]).astype("f4")
    add("s", ("light", "v", "u"), maps, "light beside the declared shape, over that one's peak")
    store.write(ds, file.path, code=file.code, inputs=file.inputs)


def write_no_light(reason: str, file: LightFile) -> None:
    """Write a light.nc without a shape; its attribute `skipped` holds the reason. `file.attributes` are not written."""
    ds = xr.Dataset(attrs=file.fixed_attributes | {"skipped": reason})
    store.write(ds, file.path, code=file.code, inputs=file.inputs)
