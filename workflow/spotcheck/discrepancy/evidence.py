"""Tests of fitted effects: gain, robust Wald test and consistency over the spot, and the covariance they rest on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.criteria import CELL_MISFIT, CELL_SLACK, MIN_GAIN, MIN_GAIN_AT_ONE_SITE
from spotcheck.discrepancy.evaluation import (
    Evaluation,
    columns_of,
    evaluate,
    map_batches,
    rounded_parameter,
    subtract_absorbed,
)
from spotcheck.discrepancy.frames import Design, Pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.normal_equations import assemble, invert_information, solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.sensor import ROUNDING_VARIANCE

# Sites from which on the scores of a site and sector are the clusters of the covariance; with fewer, blocks of pixels.
MANY_SITES, BLOCK_PX = 8, 16
# Sectors of the spot, and the radius [σ] that divides its information into two rings of about the same.
SECTORS, RING_RADIUS = 8, 1.2
# Part of the information below which a cell of the consistency test is left out.
LEAST_CELL_SHARE = 1e-4
# Wald z² beyond which the gain is not measured by a fit without the effect, and gain beyond which that of thinned
# pixels, known to some 10 %, leaves no doubt.
CERTAIN = 1e4
# Effort of a fit without an effect: its drop must be known to about 1.
WITHOUT_TOLERANCE, WITHOUT_ITERATIONS = 0.3, 12

Labels = Callable[[JointModel, Evaluation, slice], np.ndarray]


@dataclass(frozen=True)
class EffectTest:
    """Evidence for one fitted effect."""

    # Drop of −2 ln L by the effect over its dispersion, maybe scaled from thinned pixels; Wald's z² if above `CERTAIN`.
    gain: float
    wald: float  # z² of the effect's strength under the cluster-robust covariance
    heterogeneity: float  # Cochran's Q of the strength over cells of the spot
    cells: int  # number of cells
    limit: float  # largest Q of a consistent effect
    is_negligible: bool  # whether a user would call the strength nothing
    least_gain: float = MIN_GAIN  # drop that the model asks for

    @property
    def passes(self) -> bool:
        """Whether the effect is kept."""
        return self.has_evidence and self.heterogeneity <= self.limit and not self.is_negligible

    @property
    def has_evidence(self) -> bool:
        """Whether likelihood and robust Wald test both speak for the effect."""
        return self.gain >= self.least_gain and self.wald >= MIN_GAIN

    @property
    def badness(self) -> float:
        """The effect with the largest badness is removed first: those without evidence before inconsistent ones."""
        return self.heterogeneity / self.limit + (0.0 if self.has_evidence else 1e3)


@dataclass(frozen=True)
class CellComparison:
    """Cochran's Q of an effect's strength over cells of the data, without a verdict on it."""

    q: float  # Cochran's Q
    count: int  # number of cells
    dispersion: float  # variance of the effect's score over that of independent readings

    def limit(self, gain: float) -> float:
        """Return the largest Q of a consistent effect that lowers −2 ln L by `gain`."""
        freedom = max(self.count - 1, 0)
        return self.count - 1 + float(max(CELL_SLACK * np.sqrt(2 * freedom), CELL_MISFIT * gain))


@dataclass(frozen=True)
class ClusterSums:
    """Sums over the pixels of each cluster for some unknowns [cluster, target]."""

    score: np.ndarray  # derivative of ln L by the unknowns, beside all others
    information: np.ndarray  # Fisher information on them
    field_information: np.ndarray  # the same, times the part of the variance that a granular field has


def estimate_covariance(fit: JointFit) -> np.ndarray:
    """Return the covariance [free, free] of the fitted parameters of sensor and effects.

    It is robust against misfit that is common to a cluster of pixels: with the information I of the parameters beside
    the spots, and the score G_c that the pixels of a cluster c give, the sandwich is I⁻¹ (Σ_c G_c G_c') I⁻¹. Clusters
    are sectors of a site (its frames may share a field), cells of the spot (a misfit of the shape is common to all
    sites), and rows of a frame. The standard error of each parameter is the largest of these and of the model-based
    one; correlations are those of the first division. The variance of a parameter without information is infinite.

    References
    ----------
    Cameron & Miller (2015), A practitioner's guide to cluster-robust inference.
    """
    count = len(fit.model.free)
    if count == 0:
        return np.zeros((0, 0))
    targets = np.arange(count) + 4 * fit.equations.frames
    information = information_beside(fit, targets)
    model_based = invert_information(information)
    estimates = []
    for sums in sum_by_clusters(fit, targets, (label_sites, label_cells, label_rows)):
        scores = sums.score - sums.score.mean(axis=0)
        factor = len(scores) / max(len(scores) - 1, 1)
        estimates.append(model_based @ (scores.T @ scores * factor) @ model_based)
    largest = np.max([np.diag(estimate) for estimate in (*estimates, model_based)], axis=0)
    inflation = np.sqrt(largest / np.maximum(np.diag(estimates[0]), 1e-300))
    covariance = estimates[0] * inflation[:, None] * inflation
    # The pseudo-inverse would give a variance of 0 to parameters that the pixels say nothing about, such as the
    # brightness of a ghost outside the crops.
    unknown = np.diag(information) <= 0
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    for k, parameter in enumerate(fit.model.free):
        if parameter.effect and rounded_parameter(fit.model.effect_named(parameter.effect)) == parameter.name:
            covariance[k, k] += ROUNDING_VARIANCE
    return covariance


def assess_effect(
    fit: JointFit, name: str, covariance: np.ndarray, scales: EffectScales, known_gain: float | None = None
) -> EffectTest:
    """Test one effect of a fit; `known_gain` is the drop of −2 ln L by it if a fit without it exists."""
    applied, position = fit.model.effect_named(name), position_of_strength(fit.model, name)
    distance = distance_from_nothing(applied)
    variance = max(covariance[position, position], 1e-300)
    wald = distance**2 / variance if np.isfinite(distance) else (np.inf if np.isfinite(variance) else 0.0)
    cells = compare_cells(fit, name)
    gain = measure_gain(fit, name, wald, cells.dispersion) if known_gain is None else known_gain
    is_nothing = is_negligible(applied, scales)
    return EffectTest(gain, wald, cells.q, cells.count, cells.limit(gain), is_nothing, least_gain(fit.model))


def position_of_strength(model: JointModel, name: str) -> int:
    """Return the position of an effect's strength among the fitted parameters of sensor and effects."""
    strength = model.effect_named(name).effect.parameters[0].name
    return next(k for k, p in enumerate(model.free) if (p.effect, p.name) == (name, strength))


def compare_cells(fit: JointFit, name: str) -> CellComparison:
    """Compare what the cells of the data say of the strength of an effect of a fit.

    The model-based information is used, so that misfit common to all cells is no reason against an effect.
    """
    target = 4 * fit.equations.frames + position_of_strength(fit.model, name)
    (sums,) = sum_by_clusters(fit, np.array([target]), (label_cells,))
    score, information, of_field = sums.score[:, 0], sums.information[:, 0], sums.field_information[:, 0]
    of_effect = fit.pixels.dispersion_of(of_field.sum() / max(information.sum(), 1e-300))
    used = information > LEAST_CELL_SHARE * information.sum()
    # A granular field widens the score of a cell. Over its dispersion the score has the variance `known`.
    dispersion = fit.pixels.dispersion_of(of_field[used] / information[used])
    score, known = score[used] / dispersion, information[used] / dispersion
    q = float(np.sum(score**2 / known) - score.sum() ** 2 / max(known.sum(), 1e-300))
    return CellComparison(q, int(used.sum()), float(of_effect))


def least_gain(model: JointModel) -> float:
    """Return the drop of −2 ln L that a name needs."""
    is_alone = model.grid is not None and model.design.sites == 1
    return MIN_GAIN_AT_ONE_SITE if is_alone else MIN_GAIN


def measure_gain(fit: JointFit, name: str, wald: float, dispersion: float) -> float:
    """Return the drop of −2 ln L by an effect over its dispersion: `wald`, or that of thinned pixels, if it leaves no
    doubt; else that of all pixels."""
    if CERTAIN < wald < np.inf:
        return wald
    without = fit.model.without_effect(name)

    def gain_on(pixels: Pixels, deviance: float) -> float:
        refit = fit_jointly(without, pixels, tolerance=WITHOUT_TOLERANCE, iterations=WITHOUT_ITERATIONS)
        return (refit.deviance - deviance) / dispersion * fit.pixels.count / pixels.count

    # Without a significant strength the drop decides nothing.
    if wald < MIN_GAIN or wald == np.inf:
        thin = thin_pixels(fit.pixels)
        gain = gain_on(thin, assemble(fit.model, thin).deviance)
        if gain > CERTAIN or wald < MIN_GAIN:
            return gain
    return gain_on(fit.pixels, fit.deviance)


def distance_from_nothing(applied: AppliedEffect) -> float:
    """Return how far the strength is from where the effect vanishes; infinite for a clip, NaN if nobody knows."""
    return abs(applied.values[0] - applied.effect.vanishes_at)


def is_negligible(applied: AppliedEffect, scales: EffectScales) -> bool:
    """Return whether a user would call the strength of an effect nothing."""
    low = applied.effect.parameters[0].negligible
    return bool(distance_from_nothing(applied) < (low(scales) if callable(low) else low))


# Sums over clusters of pixels


def sum_by_clusters(fit: JointFit, targets: np.ndarray, labels: Sequence[Labels]) -> list[ClusterSums]:
    """Return the sums of the targets for each division into clusters.

    Targets are numbers of unknowns behind the spots; their columns are projected off all other unknowns, but not off
    each other.
    """
    model, equations = fit.model, fit.equations
    others = np.setdiff1d(np.arange(equations.size), targets)
    absorbed = solve_positive(
        equations.information[np.ix_(others, others)], equations.information[np.ix_(others, targets)]
    )
    coefficients = np.zeros((equations.size, len(targets)))
    coefficients[others] = absorbed
    of_shape = None
    if equations.shape is not None:
        cross = equations.shape.cross
        of_shape = equations.shape.factor.back_solve(cross[:, targets] - cross[:, others] @ absorbed)

    def of_batch(part: slice) -> list[tuple[np.ndarray, ...]]:
        at = evaluate(model, fit.pixels, part)
        fitted = columns_of(model, at)
        used = at.weight > 0
        light = None if of_shape is None else ShapeSums(model, at).values(of_shape)
        projected = [subtract_absorbed(at, part, fitted[target - 4 * equations.frames], coefficients[:, k], fitted,
                                       None if light is None else light[k])
                     for k, target in enumerate(targets)]  # fmt: skip
        informations = [at.information_per_pixel(column) for column in projected]
        values = ([at.score_per_pixel(column) for column in projected], informations,
                  [at.field_share * information for information in informations])  # fmt: skip
        out = []
        for label in labels:
            keys, index = np.unique(np.broadcast_to(label(model, at, part), used.shape)[used], return_inverse=True)
            sums = (np.stack([np.bincount(index, row[used], len(keys)) for row in rows], 1) for rows in values)
            out.append((keys, *sums))
        return out

    parts = map_batches(of_batch, fit.pixels)
    return [_merge([part[k] for part in parts]) for k in range(len(labels))]


def _merge(parts: Sequence[tuple[np.ndarray, ...]]) -> ClusterSums:
    """Return sums over the batches by cluster."""
    keys, index = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    out = []
    for k in (1, 2, 3):
        rows = np.concatenate([part[k] for part in parts])
        total = np.zeros((len(keys), rows.shape[1]))
        np.add.at(total, index, rows)
        out.append(total)
    return ClusterSums(*out)


def label_cells(model: JointModel, at: Evaluation, part: slice) -> np.ndarray:
    """Return the cell of each pixel: sector × ring × condition."""
    sector, ring = divide_spot(at)
    condition = model.design.condition[part][:, None, None]
    return sector + SECTORS * (ring + 2 * condition)


def label_sites(model: JointModel, at: Evaluation, part: slice) -> np.ndarray:
    """Return the cluster of each pixel: site × sector, or blocks of a frame if sites are few."""
    design: Design = model.design
    if design.sites >= MANY_SITES:
        return design.site[part][:, None, None] * SECTORS + divide_spot(at)[0]
    pixels = at.conditions.pixels
    block = (pixels.y // BLOCK_PX) * 10_000 + pixels.x // BLOCK_PX
    return (np.arange(part.start, part.stop)[:, None, None] * 10**8 + block).astype(np.int64)


def label_rows(model: JointModel, at: Evaluation, part: slice) -> np.ndarray:
    """Return the cluster of each pixel: row of a frame."""
    frame = np.arange(part.start, part.stop)[:, None, None]
    return (frame * 10**6 + at.conditions.pixels.y).astype(np.int64)


def divide_spot(at: Evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Return sector 0 … 7 of 45° and ring 0 or 1 of each pixel about the centre of its spot."""
    conditions = at.conditions
    dx, dy = conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0
    turn = (np.arctan2(dy, dx) + np.pi) / (2 * np.pi)
    sector = np.minimum((turn * SECTORS).astype(int), SECTORS - 1)
    return sector, (np.hypot(dx, dy) > RING_RADIUS * conditions.sigma_px).astype(int)


def information_beside(fit: JointFit, targets: np.ndarray) -> np.ndarray:
    """Return the Fisher information of unknowns beside all others [target, target]."""
    matrix = fit.equations.information
    others = np.setdiff1d(np.arange(fit.equations.size), targets)
    cross = matrix[np.ix_(others, targets)]
    return matrix[np.ix_(targets, targets)] - cross.T @ solve_positive(matrix[np.ix_(others, others)], cross)
