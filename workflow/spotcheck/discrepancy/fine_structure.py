"""Structure of the light that is finer than the nodes of its free shape, from residuals that all sites share.

Without it such structure passes for noise that grows with the light, as that of a bent response does.
"""

from dataclasses import replace

import numpy as np

from spotcheck.discrepancy.evaluation import evaluate, sum_batches
from spotcheck.discrepancy.joint_fit import JointFit, fit_jointly
from spotcheck.discrepancy.shape_grid import STEP
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.light_shape import LightShape

# Distance of the nodes, and bounds of the rings in which the structure has one variance [σ].
FINE_STEP, RINGS = STEP / 2, (0.0, 0.75, 1.5, 2.25, 3.0, 4.0)
# Number of estimates: splines smooth the values at the nodes, so that each estimate adds what the one before left.
PASSES = 3
# Effort of the fits of the spots beside the structure.
TOLERANCE, ITERATIONS = 0.1, 8


def add_fine_structure(fit: JointFit) -> JointFit:
    """Return a fit with the structure between the nodes of its free shape; as it is if sites do not share any."""
    if fit.model.design.sites == 1:
        return fit
    nodes = 2 * int(RINGS[-1] / FINE_STEP) + 1
    for _ in range(PASSES):
        learned, structure = fit.model.forward.baseline.learned, estimate_structure(fit, nodes)
        assert learned is not None
        if not structure.any():
            break
        total = structure if learned.finer is None else learned.finer.coefficients + structure
        model = fit.model.with_learned(replace(learned, finer=LightShape(FINE_STEP, total)))
        fit = fit_jointly(model, fit.pixels, tolerance=TOLERANCE, iterations=ITERATIONS)
    return fit


def estimate_structure(fit: JointFit, nodes: int) -> np.ndarray:
    """Return the light that residuals show about each node [row, column, peak].

    With score U and information I of the light about a node, it is U/I times the part that is no noise, T/(T + 1/I). T
    is the variance of the structure in a ring about the centre, by the products of U/I of two halves of the sites.
    """
    site = fit.model.design.site
    half = np.isin(site, np.unique(site)[::2]).astype(int)
    middle = (nodes - 1) // 2

    def of_batch(part: slice) -> tuple[np.ndarray, np.ndarray]:
        at = evaluate(fit.model, fit.pixels, part, with_slopes=False)
        u, v, factor = ShapeSums(fit.model, at).strongest
        column, row = (np.rint(place / FINE_STEP).astype(int) + middle for place in (u, v))
        is_inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < nodes)
        cell = ((half[part][:, None] * nodes + row) * nodes + column)[is_inside]
        score, information = (
            np.bincount(cell, (values.reshape(factor.shape) * weight)[is_inside], 2 * nodes**2)
            for values, weight in ((at.light_score, factor), (at.light_information, factor**2))
        )
        return score, information

    score, information = (sums.reshape(2, nodes, nodes) for sums in sum_batches(of_batch, fit.pixels))
    size = np.divide(score, information, out=np.zeros_like(score), where=information > 0)
    both = information.sum(axis=0)
    weight = np.divide(information[0] * information[1], both, out=np.zeros_like(both), where=both > 0)
    place = np.arange(nodes) - middle
    ring = np.digitize(FINE_STEP * np.hypot(place[:, None], place[None, :]), RINGS) - 1
    number = len(RINGS) - 1
    power, total = (np.bincount(ring.ravel(), values.ravel(), number + 1)[:number]
                    for values in (weight * size[0] * size[1], weight))  # fmt: skip
    variance = np.append(np.maximum(power / np.maximum(total, 1e-300), 0.0), 0.0)[ring]
    return np.divide(variance * score.sum(axis=0), variance * both + 1)
