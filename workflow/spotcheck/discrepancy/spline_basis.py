"""Sums over pixels of the spline basis of a free light shape, compiled.

Coefficient (row j, column i) of the shape has the number j · nodes + i. A pixel at (u, v) [σ] sees 16 of them. Points
are flat arrays over the pixels of all frames of a batch, and over the copies of the spot if there are several.
"""

import math

from spotcheck.model.light_shape import cubic_weights
from spotcheck.sensor.codes import compiled

# Coefficients that lie more than so many rows or columns apart share no pixel.
NEIGHBOURS = 3


@compiled
def add_products(per_step, nodes, u, v, factor, values, out):
    """Add Σ factor · basis · values to out [coefficient, k]; values [point, k]."""
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if factor[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        of_column, of_row = cubic_weights(x - column), cubic_weights(y - row)
        for k in range(values.shape[1]):
            value = factor[n] * values[n, k]
            for q in range(4):
                index = (row + q - 1) * nodes + column - 1
                for p in range(4):
                    out[index + p, k] += value * of_row[q] * of_column[p]


@compiled
def add_values(per_step, nodes, u, v, factor, coefficients, out):
    """Add factor · Σ basis · coefficients to out [point, k]; coefficients [coefficient, k]."""
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if factor[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        of_column, of_row = cubic_weights(x - column), cubic_weights(y - row)
        for q in range(4):
            for p in range(4):
                tap = factor[n] * of_row[q] * of_column[p]
                index = (row + q - 1) * nodes + column + p - 1
                for k in range(coefficients.shape[1]):
                    out[n, k] += tap * coefficients[index, k]


@compiled
def add_information(per_step, nodes, u, v, weight, band):
    """Add Σ weight · basis · basis' to band [(NEIGHBOURS + 1) (2 NEIGHBOURS + 1), coefficient].

    Row dj (2 NEIGHBOURS + 1) + di + NEIGHBOURS of the band holds, for coefficient k, the information with the one dj
    rows and di columns further.
    """
    middle = (nodes - 1) / 2
    for n in range(u.size):
        x, y = u[n] * per_step + middle, v[n] * per_step + middle
        if weight[n] == 0.0 or not (1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0):
            continue
        column, row = math.floor(x), math.floor(y)
        of_column, of_row = cubic_weights(x - column), cubic_weights(y - row)
        for q in range(4):
            for p in range(4):
                tap = weight[n] * of_row[q] * of_column[p]
                index = (row + q - 1) * nodes + column + p - 1
                for dq in range(4 - q):
                    for other in range(4):
                        if dq > 0 or other >= p:
                            band[dq * (2 * NEIGHBOURS + 1) + other - p + NEIGHBOURS, index] += (
                                tap * of_row[q + dq] * of_column[other]
                            )
