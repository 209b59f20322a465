"""Learned shapes of the light beside the declared one, and light.nc, the file that holds them.

S(u, v) = B(u, v) + s(u, v) with u = (x − x₀)/σ, v = (y − y₀)/σ. B is the declared shape with peak 1. s is a tensor
product of uniform cubic B-splines (de Boor, A Practical Guide to Splines, ch. IX), 0 beyond the last nodes; another one
with nodes closer together may be added to it.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.sensor.codes import compiled

# Name of the file beside model.yaml.
LIGHT = "light.nc"
# Cubic splines need as many nodes along an axis.
FEWEST_NODES = 4


@dataclass(frozen=True, eq=False)
class LightShape:
    """The light beside the declared shape."""

    step: float  # distance of the nodes [σ]
    coefficients: np.ndarray  # of the splines [row, column], in peaks of the declared shape; the middle is the centre
    finer: "LightShape | None" = None  # structure between the nodes, which is added; None for none

    def __call__(self, u, v) -> np.ndarray:
        """Return s [1] at u, v [σ], arrays that broadcast."""
        u, v = np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float))
        out = np.empty(u.size)
        fill_spline(self.coefficients, 1 / self.step, np.ravel(u), np.ravel(v), out)
        out = out.reshape(u.shape)
        return out if self.finer is None else out + self.finer(u, v)


@compiled
def cubic_weights(fraction):
    """Return the values of the cubic B-splines of four neighbouring nodes, `fraction` of a step beyond the second."""
    rest = 1.0 - fraction
    return (
        rest * rest * rest / 6,
        (3 * fraction * fraction * fraction - 6 * fraction * fraction + 4) / 6,
        (3 * rest * rest * rest - 6 * rest * rest + 4) / 6,
        fraction * fraction * fraction / 6,
    )


@compiled
def fill_spline(coefficients, per_step, u, v, out):
    """Fill the values of a spline at u, v [point]; coefficients [row, column] about the middle."""
    nodes = coefficients.shape[0]
    middle = (nodes - 1) / 2
    for k in range(u.size):
        x, y = u[k] * per_step + middle, v[k] * per_step + middle
        out[k] = 0.0
        if not (-2.0 < x < nodes + 1.0 and -2.0 < y < nodes + 1.0):
            continue
        column, row = math.floor(x), math.floor(y)
        of_column, of_row = cubic_weights(x - column), cubic_weights(y - row)
        # Inside all four neighbours exist; without bounds the compiler unrolls the sums.
        if 1 <= column < nodes - 2 and 1 <= row < nodes - 2:
            for q in range(4):
                line = coefficients[row + q - 1]
                out[k] += of_row[q] * (
                    of_column[0] * line[column - 1]
                    + of_column[1] * line[column]
                    + of_column[2] * line[column + 1]
                    + of_column[3] * line[column + 2]
                )
            continue
        for q in range(max(0, 1 - row), min(4, nodes + 1 - row)):
            total = 0.0
            for p in range(max(0, 1 - column), min(4, nodes + 1 - column)):
                total += of_column[p] * coefficients[row + q - 1, column + p - 1]
            out[k] += of_row[q] * total


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
            layers = [
                (float(ds[step]), np.array(ds[name].values, float))
                for step, name in (("fine_step", "fine_coefficients"), ("step", "coefficients"))
                if name in ds or name == "coefficients"
            ]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path.name}: holds no shape of a light; name a light.nc, as a verdict writes it") from None
    shapes: list[LightShape | None] = [None] * len(np.atleast_1d(layers[-1][1]))
    for step, coefficients in layers:
        is_square = coefficients.ndim == 3 and coefficients.shape[1] == coefficients.shape[2] >= FEWEST_NODES
        is_usable = is_square and np.isfinite(coefficients).all() and np.isfinite(step) and step > 0
        if not (is_usable and 0 < len(coefficients) == len(shapes)):
            raise InputError(
                f"{path.name}: step and coefficients make no shape; they must be numbers, the step above 0 and as many"
                " rows as columns"
            )
        shapes = [LightShape(step, shape, finer) for shape, finer in zip(coefficients, shapes, strict=True)]
    return tuple(shape for shape in shapes if shape is not None)
