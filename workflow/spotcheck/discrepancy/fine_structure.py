"""Structure of the light that is finer than the nodes of its free shape, from residuals that all sites share.

A free shape is a light shape whose values at nodes, in units of peak and σ of each spot, are fitted. A site is a set of
frames of the same angle, settings and repeat. If the fine structure is left out of the model, it looks like noise that
increases with the light, and a curved response of the sensor would be fitted to it. An `Evaluation` has the score of
the light of each pixel, the derivative of ln L (`light_score`), and the Fisher information on it (`light_information`).
"""

from dataclasses import replace

import numpy as np

from spotcheck.discrepancy.evaluation import evaluate, sum_batches
from spotcheck.discrepancy.joint_fit import JointFit, fit_jointly
from spotcheck.discrepancy.shape_grid import STEP
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.light_shape import LightShape

# Distance of the fine nodes, and bounds of the rings about the centre in which the structure has one variance [σ].
FINE_STEP, RING_BOUNDS = STEP / 2, (0.0, 0.75, 1.5, 2.25, 3.0, 4.0)
# Number of estimates. Splines smooth the values at the nodes, so that each estimate leaves a residual for the next one.
PASSES = 3
# Effort of the fit that follows each estimate: Newton decrement and most iterations.
TOLERANCE, ITERATIONS = 0.1, 8
# Smallest denominator of a ratio of sums that may be 0.
TINY = 1e-300


def add_fine_structure(fit: JointFit) -> JointFit:
    """Add the structure between the nodes of a fit's free shape, and refit; the fit is unchanged if sites share none.

    With a single site, structure of the light cannot be distinguished from noise.
    """
    if fit.model.design.sites == 1:
        return fit
    nodes = 2 * int(RING_BOUNDS[-1] / FINE_STEP) + 1
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
    """Return the light that residuals show about each fine node, in parts of the peak [row, column].

    There are `nodes` rows and columns. The light about a node has the score U and the information I, so that U/I is its
    estimate. It is shrunk by the factor T/(T + 1/I). T is the variance of the structure in a ring about the centre: the
    mean product of the estimates from two halves of the sites, which share no noise. The structure is 0 beyond the
    rings.
    """
    site = fit.model.design.site
    half_of_frame = np.isin(site, np.unique(site)[::2]).astype(int)
    middle = (nodes - 1) // 2

    def sum_batch(batch: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return score and information of each node of each half [half × row × column] of a batch of frames."""
        evaluation = evaluate(fit.model, fit.pixels, batch, with_slopes=False)
        # Place of each pixel in the shape [σ], and derivative of its light by the shape there [frame, pixel].
        u, v, factor = ShapeSums(fit.model, evaluation).strongest
        column, row = (np.rint(place / FINE_STEP).astype(int) + middle for place in (u, v))
        is_inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < nodes)
        node = ((half_of_frame[batch][:, None] * nodes + row) * nodes + column)[is_inside]
        score, information = (
            np.bincount(node, (values.reshape(factor.shape) * weight)[is_inside], 2 * nodes**2)
            for values, weight in ((evaluation.light_score, factor), (evaluation.light_information, factor**2))
        )
        return score, information

    score, information = (sums.reshape(2, nodes, nodes) for sums in sum_batches(sum_batch, fit.pixels))
    estimates = np.divide(score, information, out=np.zeros_like(score), where=information > 0)
    total = information.sum(axis=0)
    # Weight of the product of both estimates: proportional to the harmonic mean of their information.
    weight = np.divide(information[0] * information[1], total, out=np.zeros_like(total), where=total > 0)
    from_middle = np.arange(nodes) - middle
    ring = np.digitize(FINE_STEP * np.hypot(from_middle[:, None], from_middle[None, :]), RING_BOUNDS) - 1
    rings = len(RING_BOUNDS) - 1
    products, weights = (np.bincount(ring.ravel(), values.ravel(), rings + 1)[:rings]
                         for values in (weight * estimates[0] * estimates[1], weight))  # fmt: skip
    variance = np.append(np.maximum(products / np.maximum(weights, TINY), 0.0), 0.0)[ring]
    return np.divide(variance * score.sum(axis=0), variance * total + 1)
