"""The residual in the eyes of a person: by radius, by direction, by grey level; each condition alone and together."""

from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.cells import Cells, Setting, pooled
from spotcheck.model.chain import spot_state

# Bounds of the rings, in σ_g.
RINGS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, np.inf])
# Highest azimuthal order.
ORDERS = 4
# Bounds of the grey levels, as fractions of the brightest light of the set.
GREYS = np.array([-1, 0.005, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 2.0])


class Modes(NamedTuple):
    """z [level of grouping → array] of the residual on every mode; groups are `all`, `exposure`, `angle`, `condition`,
    and `grey`. The arrays are [group member, ring, order (1, cos 1, sin 1, …)] and [exposure, grey]."""

    all: np.ndarray
    exposure: np.ndarray
    angle: np.ndarray
    condition: np.ndarray
    grey: np.ndarray


def modes_of(
    cells: Cells,
    setting: Setting,
    residual: np.ndarray,
    variance: np.ndarray,
    used: np.ndarray,
    shared: np.ndarray | float = 0.0,
) -> Modes:
    """Standardised projections of a residual [condition, row, column]; blocks that are not `used` count nothing.
    `shared` [DN²] is what blocks that scatter together add to the variance of a sum, counted by block."""
    view = cells.view
    amplitude, sigma = spot_state(view, setting.baseline, cells.base, ())
    ones = np.ones((1, view.y.shape[1], view.x.shape[2]))
    dx, dy = pooled((view.x - view.x0) * ones), pooled((view.y - view.y0) * ones)
    shape = residual.shape
    sigma = np.broadcast_to(sigma, (shape[0], 1, 1))
    radius, azimuth = np.hypot(dx, dy), np.arctan2(dy, dx)
    ring = np.digitize(radius / sigma, RINGS) - 1
    weight = np.where(used, 1 / variance, 0.0)
    spread = weight * (1 + shared * weight)
    waves = [np.ones(shape)]
    for m in range(1, ORDERS + 1):
        waves += [np.cos(m * azimuth), np.sin(m * azimuth)]
    rings = len(RINGS) - 1
    pull, norm = np.zeros((shape[0], rings, len(waves))), np.zeros((shape[0], rings, len(waves)))
    index = np.broadcast_to(np.arange(shape[0])[:, None, None], shape)
    flat = (index * rings + ring).ravel()
    size = shape[0] * rings
    for k, wave in enumerate(waves):
        pull[:, :, k] = np.bincount(flat, (wave * weight * residual).ravel(), size).reshape(shape[0], rings)
        norm[:, :, k] = np.bincount(flat, (wave**2 * spread).ravel(), size).reshape(shape[0], rings)
    fraction = amplitude / np.max(amplitude) * np.exp(-(radius**2) / (2 * sigma**2))
    grey = np.digitize(np.broadcast_to(fraction, shape), GREYS) - 1
    exposures = np.unique(np.nan_to_num(view.exposure_s.ravel()), return_inverse=True)[1]
    greys = len(GREYS) - 1
    flat = (exposures[index] * greys + grey).ravel()
    size = (exposures.max() + 1) * greys
    grey_pull = np.bincount(flat, (weight * residual).ravel(), size)
    grey_norm = np.bincount(flat, spread.ravel(), size)
    return Modes(
        _grouped(pull, norm, np.zeros(shape[0], int)),
        _grouped(pull, norm, exposures),
        _grouped(pull, norm, cells.place),
        _grouped(pull, norm, np.arange(shape[0])),
        (grey_pull / np.sqrt(np.maximum(grey_norm, 1e-300))).reshape(-1, greys),
    )


def _grouped(pull: np.ndarray, norm: np.ndarray, group: np.ndarray) -> np.ndarray:
    total, total_norm = (np.zeros((group.max() + 1, *pull.shape[1:])) for _ in range(2))
    np.add.at(total, group, pull)
    np.add.at(total_norm, group, norm)
    return np.where(total_norm > 0, total / np.sqrt(np.maximum(total_norm, 1e-300)), 0.0)
