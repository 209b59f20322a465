"""Learned shapes of the light, and light.nc, the file that holds them.

The light of a spot is S(u, v) = B(u, v) + s(u, v) times its peak, with u = (x − x₀)/σ and v = (y − y₀)/σ. σ is the
width of the spot. B is the declared shape with peak 1, such as a Gaussian. s is the learned shape, a tensor product of
uniform cubic B-splines (de Boor, A Practical Guide to Splines, ch. IX), 0 beyond two steps from the last nodes. A
second one with nodes closer together, the finer layer, may be added to it.
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
# Cubic splines need at least this many nodes along an axis.
FEWEST_NODES = 4
# Rows and columns of zeros around the coefficients: each point inside a shape then has four nodes along each axis.
PADDING = 3


@dataclass(frozen=True, eq=False)
class LightShape:
    """A learned shape s(u, v), which is added to the declared shape."""

    step: float  # distance of the nodes [σ]
    # Coefficients of the splines [row, column], relative to the peak of the spot; the middle node is the centre.
    coefficients: np.ndarray
    finer: "LightShape | None" = None  # shape with nodes closer together, which is added; None for none

    def __call__(self, u, v) -> np.ndarray:
        """Return s [1] at u, v [σ], arrays that broadcast."""
        u, v = np.asarray(u, float), np.asarray(v, float)
        values = np.empty(np.broadcast_shapes(u.shape, v.shape))
        padded = np.pad(self.coefficients, PADDING)
        if u.ndim == v.ndim == 3 and u.shape[1] == v.shape[2] == 1 and len(u) == len(v):
            # Pixels of unturned frames [frame, row, column]: u depends on the column alone, v on the row.
            fill_spline_of_frames(padded, 1 / self.step, u[:, 0], v[:, :, 0], values)
        else:
            u_of_point, v_of_point = (np.ravel(np.broadcast_to(places, values.shape)) for places in (u, v))
            fill_spline(padded, 1 / self.step, u_of_point, v_of_point, values.reshape(-1))
        return values if self.finer is None else values + self.finer(u, v)


@compiled
def cubic_weights(fraction):
    """Return the values of the cubic B-splines of nodes −1, 0, 1 and 2 at the place `fraction` beyond node 0.

    `fraction` is in steps of the nodes, from 0 to 1; the four values sum to 1.
    """
    remainder = 1.0 - fraction
    return (
        remainder * remainder * remainder / 6,
        (3 * fraction * fraction * fraction - 6 * fraction * fraction + 4) / 6,
        (3 * remainder * remainder * remainder - 6 * remainder * remainder + 4) / 6,
        fraction * fraction * fraction / 6,
    )


@compiled
def fill_spline(padded, steps_per_sigma, u, v, values):
    """Write the values [point] of a spline at u, v [point] in σ into `values`.

    `padded` [row, column] are the coefficients with `PADDING` on every side; they are square, with the centre in the
    middle. `steps_per_sigma` [1/σ] is 1/distance of the nodes. A value is Σ over rows and columns of row weight ·
    column weight · coefficient, with the weights of the four nearest nodes along each axis (`cubic_weights`). It is 0
    from two steps beyond the last nodes on.
    """
    nodes = padded.shape[0] - 2 * PADDING
    middle = (nodes - 1) / 2
    for k in range(u.size):
        # Place of the point in steps, from the first node.
        x, y = u[k] * steps_per_sigma + middle, v[k] * steps_per_sigma + middle
        values[k] = 0.0
        # The spline of a node is 0 from two steps on.
        if not (-2.0 < x < nodes + 1.0 and -2.0 < y < nodes + 1.0):
            continue
        column, row = math.floor(x), math.floor(y)
        column_weights, row_weights = cubic_weights(x - column), cubic_weights(y - row)
        # Index of the first of the four nearest nodes in a padded row; q counts the four nearest rows.
        first = column + PADDING - 1
        for q in range(4):
            line = padded[row + PADDING - 1 + q]
            values[k] += row_weights[q] * (
                column_weights[0] * line[first]
                + column_weights[1] * line[first + 1]
                + column_weights[2] * line[first + 2]
                + column_weights[3] * line[first + 3]
            )


@compiled
def fill_spline_of_frames(padded, steps_per_sigma, u, v, values):
    """Write the values [frame, row, column] of a spline at u [frame, column], v [frame, row] in σ into `values`.

    `padded` and `steps_per_sigma` are those of `fill_spline`, whose weighted sum over rows is here taken once for all
    pixels of a row.
    """
    nodes = padded.shape[0] - 2 * PADDING
    middle = (nodes - 1) / 2
    # Weights of the nodes of each pixel of a row, and index of the first of them in the sums over rows of nodes.
    weights, first = np.zeros((u.shape[1], 4)), np.zeros(u.shape[1], np.int64)
    sums = np.zeros(padded.shape[1])
    for frame in range(u.shape[0]):
        for k in range(u.shape[1]):
            x = u[frame, k] * steps_per_sigma + middle
            is_inside = -2.0 < x < nodes + 1.0
            column = math.floor(x) if is_inside else 0
            first[k] = column + PADDING - 1
            for p, weight in enumerate(cubic_weights(x - column)):
                weights[k, p] = weight if is_inside else 0.0
        for line in range(v.shape[1]):
            y = v[frame, line] * steps_per_sigma + middle
            sums[:] = 0.0
            if -2.0 < y < nodes + 1.0:
                row = math.floor(y)
                for q, weight in enumerate(cubic_weights(y - row)):
                    sums += weight * padded[row + PADDING - 1 + q]
            for k in range(u.shape[1]):
                i = first[k]
                values[frame, line, k] = (
                    weights[k, 0] * sums[i]
                    + weights[k, 1] * sums[i + 1]
                    + weights[k, 2] * sums[i + 2]
                    + weights[k, 3] * sums[i + 3]
                )


def read_light(path: str | Path) -> LightShape:
    """Return the one shape of a light.nc. Raises `InputError` as `read_lights` does, and if there is more than one."""
    shapes = read_lights(path)
    if len(shapes) > 1:
        raise InputError(
            f"{Path(path).name}: holds {len(shapes)} lights, one for each pose; an instrument has one, so name a"
            " light.nc of frames that share theirs"
        )
    return shapes[0]


def read_lights(path: str | Path) -> tuple[LightShape, ...]:
    """Return the shapes of a light.nc, one for each pose of the sample if frames do not share their light.

    Raises `InputError` if there is no file, if it holds no shape, or if a shape cannot be used.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path.name}: is no file; name a light.nc, as a verdict writes it")
    try:
        with store.read(path) as ds:
            # The finer layer first, if there is one: step [σ] and coefficients [shape, row, column]. Missing
            # coefficients of the other layer are a KeyError.
            layers = [
                (float(ds[step_name]), np.array(ds[name].values, float))
                for step_name, name in (("fine_step", "fine_coefficients"), ("step", "coefficients"))
                if name in ds or name == "coefficients"
            ]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path.name}: holds no shape of a light; name a light.nc, as a verdict writes it") from None
    # Shape k of a layer gets shape k of the layer before it as its finer layer, the first layer gets None. Coefficients
    # that are a single number, which has no length, are reported below.
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
    # No shape is None here; type checkers do not know.
    return tuple(shape for shape in shapes if shape is not None)
