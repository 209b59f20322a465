"""Learned shapes of the light beside the declared one, and light.nc, the file that holds them.

S(u, v) = B(u, v) + s(u, v) with u = (x − x₀)/σ, v = (y − y₀)/σ. B is the declared shape with peak 1. s is a tensor
product of uniform cubic B-splines (de Boor, A Practical Guide to Splines, ch. IX), 0 beyond the last nodes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from spotcheck import store
from spotcheck.errors import InputError

# Name of the file beside model.yaml.
LIGHT = "light.nc"
# Cubic splines need as many nodes along an axis.
FEWEST_NODES = 4


@dataclass(frozen=True, eq=False)
class LightShape:
    """The light beside the declared shape."""

    step: float  # distance of the nodes [σ]
    coefficients: np.ndarray  # of the splines [row, column], in peaks of the declared shape; the middle is the centre

    def __call__(self, u, v) -> np.ndarray:
        """Return s [1] at u, v [σ], arrays that broadcast."""
        middle = (len(self.coefficients) - 1) / 2
        places = [np.asarray(place, float) / self.step + middle for place in np.broadcast_arrays(v, u)]
        return ndimage.map_coordinates(self.coefficients, places, order=3, mode="grid-constant", prefilter=False)


def read_light(path: str | Path) -> LightShape:
    """Return the one shape of a file. Raises `InputError` as `read_lights`, and if there is more than one."""
    shapes = read_lights(path)
    if len(shapes) > 1:
        raise InputError(
            f"{Path(path).name}: holds {len(shapes)} lights, one for each pose; an instrument has one, so name a"
            " light.nc of frames that share theirs"
        )
    return shapes[0]


def read_lights(path: str | Path) -> tuple[LightShape, ...]:
    """Return the shapes of a file. Raises `InputError` if it holds none, or none that can be used."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path.name}: is no file; name a light.nc, as a verdict writes it")
    try:
        with store.read(path) as ds:
            step, coefficients = float(ds["step"]), np.array(ds["coefficients"].values, float)
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path.name}: holds no shape of a light; name a light.nc, as a verdict writes it") from None
    is_square = coefficients.ndim == 3 and coefficients.shape[1] == coefficients.shape[2] >= FEWEST_NODES
    if not (is_square and len(coefficients) and np.isfinite(coefficients).all() and np.isfinite(step) and step > 0):
        raise InputError(
            f"{path.name}: step and coefficients make no shape; they must be numbers, the step above 0 and as many rows"
            " as columns"
        )
    return tuple(LightShape(step, shape) for shape in coefficients)
