"""Sums over pixels of the spline basis of a free light shape, compiled.

The basis functions are products of cubic B-splines along u and v. The coefficient of node (row j, column i) of the
nodes × nodes grid has the number j · nodes + i. At a pixel at (u, v) [σ from the centre] only the 4 × 4 splines of the
nearest nodes differ from 0. Points are pixels of several frames; all arrays over points are flat. `per_step` is the
number of nodes per σ. Points outside the grid are left out. The indices q and p count the splines along rows and
columns that differ from 0 at a point.
"""

import math

from spotcheck.model.light_shape import cubic_weights
from spotcheck.sensor.codes import compiled

# Coefficients that lie more than so many rows or columns apart share no pixel.
NEIGHBOURS = 3
# Splines along an axis that differ from 0 at a point.
SPLINES = NEIGHBOURS + 1


@compiled
def add_products(per_step, nodes, u, v, factor, values, sums):
    """Add Σ over points of factor · basis · values to `sums` [coefficient, k].

    u, v, factor [point]; values [point, k].
    """
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if factor[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        column_weights, row_weights = cubic_weights(x - column), cubic_weights(y - row)
        for k in range(values.shape[1]):
            value = factor[n] * values[n, k]
            for q in range(SPLINES):
                index = (row + q - 1) * nodes + column - 1
                for p in range(SPLINES):
                    sums[index + p, k] += value * row_weights[q] * column_weights[p]


@compiled
def add_values(per_step, nodes, u, v, factor, coefficients, values):
    """Add factor · Σ over coefficients of basis · coefficients to `values` [point, k].

    u, v, factor [point]; coefficients [coefficient, k].
    """
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if factor[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        column_weights, row_weights = cubic_weights(x - column), cubic_weights(y - row)
        for q in range(SPLINES):
            for p in range(SPLINES):
                value = factor[n] * row_weights[q] * column_weights[p]
                index = (row + q - 1) * nodes + column + p - 1
                for k in range(coefficients.shape[1]):
                    values[n, k] += value * coefficients[index, k]


@compiled
def add_information(per_step, nodes, u, v, weight, band):
    """Add Σ over points of weight · basis · basis' to `band` [coefficient, (NEIGHBOURS + 1) (2 NEIGHBOURS + 1)].

    u, v, weight [point]. The matrix is symmetric: for coefficient k, column dj (2 NEIGHBOURS + 1) + di + NEIGHBOURS of
    the band holds the information with the coefficient dj rows and di columns further, dj ≥ 0.
    """
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if weight[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        column_weights, row_weights = cubic_weights(x - column), cubic_weights(y - row)
        for q in range(SPLINES):
            for p in range(SPLINES):
                product = weight[n] * row_weights[q] * column_weights[p]
                of_coefficient = band[(row + q - 1) * nodes + column + p - 1]
                for dq in range(SPLINES - q):
                    factor = product * row_weights[q + dq]
                    for p_other in range(p if dq == 0 else 0, SPLINES):
                        of_coefficient[dq * (2 * NEIGHBOURS + 1) + p_other - p + NEIGHBOURS] += (
                            factor * column_weights[p_other]
                        )
