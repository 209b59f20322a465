"""light.nc: learned shapes of the light, as a verdict writes them beside model.yaml; an instrument may name one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck import store
from spotcheck.errors import InputError
from spotcheck.old_engine.model.light_shape import LightShape

# The name of the file beside model.yaml.
LIGHT = "light.nc"
# Points along each axis of the map, which is there to be looked at: finer than a screen shows.
POINTS = 201
# Splines of four pieces need as many nodes.
FEWEST = 4


def written_light(
    shapes: Sequence[LightShape],
    path: str | Path,
    *,
    title: str,
    dataset: str,
    code: str,
    inputs: Sequence[str | Path] = (),
    poses: Mapping[str, tuple[str, Sequence[float]]] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write shapes, as fine and as large as each other, to a netCDF file: step and coefficients, maps of s(u, v),
    under which conditions each was seen (`poses`: unit and a value for each), and `attributes` that describe them."""
    first = shapes[0]
    step, side = float(first.step), len(first.coefficients)
    nodes = step * (np.arange(side) - (side - 1) / 2)
    at = np.linspace(-first.reach, first.reach, POINTS)
    ds = xr.Dataset(attrs={"title": title, "dataset": dataset} | dict(attributes or {}))
    for name, places, text in (
        ("node_v", nodes, "node below the spot's centre, over sigma_g"),
        ("node_u", nodes, "node to the right of the spot's centre, over sigma_g"),
        ("v", at, "place below the spot's centre, over sigma_g"),
        ("u", at, "place to the right of the spot's centre, over sigma_g"),
    ):
        ds[name] = (name, places, {"units": "1", "long_name": text})
    text = "coefficients of cubic B-splines of the light beside the declared shape, over that one's peak"
    every = np.array([own.coefficients for own in shapes])
    ds["coefficients"] = (("light", "node_v", "node_u"), every, {"units": "1", "long_name": text})
    ds["step"] = ((), step, {"units": "1", "long_name": "distance of nodes, over sigma_g"})
    text = "light beside the declared shape, over that one's peak"
    maps = np.array([own(at[None, :], at[:, None]) for own in shapes]).astype("f4")
    ds["s"] = (("light", "v", "u"), maps, {"units": "1", "long_name": text})
    for name, (units, values) in (poses or {}).items():
        text = f"{name} of the frames of this light"
        ds[name] = ("light", np.array(values, float), {"units": units, "long_name": text})
    store.write(ds, path, code=code, inputs=inputs)


def no_light(
    path: str | Path, why: str, *, title: str, dataset: str, code: str, inputs: Sequence[str | Path] = ()
) -> None:
    """Write a file that says why it holds no shape."""
    ds = xr.Dataset(attrs={"title": title, "dataset": dataset, "skipped": why})
    store.write(ds, path, code=code, inputs=inputs)


def read_light(path: str | Path) -> LightShape:
    """The one shape of a file. Raises `InputError` where there is none, more than one, or none that can be used."""
    shapes = read_lights(path)
    if len(shapes) > 1:
        raise InputError(
            f"{Path(path).name}: holds {len(shapes)} lights, one for each pose; an instrument has one, so name a"
            " light.nc of frames that share theirs"
        )
    return shapes[0]


def read_lights(path: str | Path) -> tuple[LightShape, ...]:
    """The shapes of a file. Raises `InputError` where there is none, or none that can be used."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path.name}: is no file; name a light.nc, as a verdict writes it")
    try:
        with store.read(path) as ds:
            step, coefficients = float(ds["step"]), np.array(ds["coefficients"].values, float)
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path.name}: holds no shape of a light; name a light.nc, as a verdict writes it") from None
    square = coefficients.ndim == 3 and coefficients.shape[1] == coefficients.shape[2] >= FEWEST
    if not (square and len(coefficients) and np.isfinite(coefficients).all() and np.isfinite(step) and step > 0):
        raise InputError(
            f"{path.name}: step and coefficients make no shape; they must be numbers, the step above 0 and as many rows"
            " as columns"
        )
    return tuple(LightShape(step, own) for own in coefficients)
