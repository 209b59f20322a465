"""Tests of fitted effects: gain, robust Wald test and consistency over the spot, and the covariance they rest on.

Unknowns of a fit are the four spot parameters of each frame (ln peak, ln σ, x, y), then the fitted parameters of sensor
and effects. The coefficients of a free light shape, if there is one, have been eliminated. Targets are the unknowns
under test; all others are nuisance parameters. Granular light is a random field in the light that neighbouring pixels
share. The dispersion is the factor by which it increases the variance of a score. Frames of a condition have the same
exposure and settings. Frames of a site have the same angle, settings and repeat, so that they share one granular field.
A batch is a slice of the frames. A column is the pair of derivatives of mean and variance of the readings by an
unknown. A `JointFit` has the fitted `model`, its `pixels`, the normal `equations` and the `deviance`, −2 ln L.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.criteria import CELL_MISFIT, CELL_SLACK, MIN_GAIN, MIN_GAIN_AT_ONE_SITE
from spotcheck.discrepancy.evaluation import (
    RINGS,
    SECTORS,
    Evaluation,
    differentiate_readings,
    divide_spot,
    evaluate,
    map_batches,
    rounded_parameter,
)
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.normal_equations import assemble, information_beside, invert_information, solve_positive
from spotcheck.discrepancy.projected_changes import Absorbed
from spotcheck.model.effect import AppliedEffect, EffectScales
from spotcheck.sensor import ROUNDING_VARIANCE

# Fewest sites for which a cluster of the covariance is a sector of a site; with fewer, it is a block of a frame with
# sides of BLOCK_PX.
MANY_SITES, BLOCK_PX = 8, 16
# Factors by which cluster labels keep the coordinates of pixels and the frames apart; sensors are smaller [px].
ROW_FACTOR, FRAME_FACTOR, ROW_FRAME_FACTOR = 10_000, 10**8, 10**6
# Least part of the information that a cell of the consistency test must have to count.
LEAST_CELL_SHARE = 1e-4
# Wald z² above which no fit without the effect is made. It is also the gain above which a fit to thinned pixels is
# enough, although it knows the gain to 10 % only.
CERTAIN = 1e4
# Effort of a fit without an effect: its −2 ln L must be known to about 1.
WITHOUT_TOLERANCE, WITHOUT_ITERATIONS = 0.3, 12
# Factor by which the nodes of a free shape move apart for the error that their distance causes, and effort of the fits.
COARSER, COARSE_TOLERANCE, COARSE_ITERATIONS = 1.4, 0.1, 12
# Added to the badness of an effect without evidence: more than any inconsistency.
NO_EVIDENCE = 1e3
# Smallest denominator of a ratio that may be 0.
TINY = 1e-300

# Function that returns the cluster of each pixel: integers that broadcast to [frame, h, w] (model, evaluation, batch).
Labels = Callable[[JointModel, Evaluation, slice], np.ndarray]


@dataclass(frozen=True)
class EffectTest:
    """Evidence for one fitted effect."""

    # Drop of −2 ln L by the effect over its dispersion, possibly extrapolated from thinned pixels; the Wald z² if that
    # is above `CERTAIN`.
    gain: float
    wald: float  # z² of the effect's strength under the cluster-robust covariance
    heterogeneity: float  # Cochran's Q of the strength over cells of the spot
    cells: int  # number of cells
    limit: float  # largest Q of a consistent effect
    is_negligible: bool  # whether the strength is too small to matter to a user
    least_gain: float = MIN_GAIN  # least gain of an effect in this model

    @property
    def passes(self) -> bool:
        """Whether the effect is kept."""
        return self.has_evidence and self.heterogeneity <= self.limit and not self.is_negligible

    @property
    def has_evidence(self) -> bool:
        """Whether the effect is significant by its gain and by the robust Wald test."""
        return self.gain >= self.least_gain and self.wald >= MIN_GAIN

    @property
    def badness(self) -> float:
        """Rank for removal: the largest goes first, so that effects without evidence precede inconsistent ones."""
        return self.heterogeneity / self.limit + (0.0 if self.has_evidence else NO_EVIDENCE)


@dataclass(frozen=True)
class CellComparison:
    """Cochran's Q of an effect's strength over cells of the spot, before a decision on it."""

    q: float  # Cochran's Q
    count: int  # number of cells
    dispersion: float  # variance of the effect's score over that of independent readings

    def limit(self, gain: float) -> float:
        """Return the largest Q of a consistent effect that lowers −2 ln L by `gain`."""
        freedom = max(self.count - 1, 0)
        return self.count - 1 + float(max(CELL_SLACK * np.sqrt(2 * freedom), CELL_MISFIT * gain))


@dataclass(frozen=True)
class ClusterSums:
    """Sums over the pixels of each cluster [cluster, target], after projection on the nuisance parameters."""

    score: np.ndarray  # derivative of ln L by each target
    information: np.ndarray  # Fisher information on each target
    field_information: np.ndarray  # the same with each pixel times the part of its variance due to granular light


def estimate_covariance(fit: JointFit) -> np.ndarray:
    """Return the cluster-robust covariance of the fitted parameters of sensor and effects [fitted, fitted].

    It allows for misfit that is common to a cluster of pixels. I is the information on the parameters beside the spots,
    and G_c the score of the pixels of cluster c. The sandwich estimate is I⁻¹ (Σ_c G_c G_c') I⁻¹. It is made for three
    divisions into clusters: sectors of a site, since its frames may share a field; cells of the spot, since all sites
    share a misfit of the shape; and rows of a frame. The standard error of each parameter is the largest of these and
    of the model-based one. Correlations are those of the first division. The variance of a parameter without
    information is infinite.

    References
    ----------
    Cameron & Miller (2015), A practitioner's guide to cluster-robust inference.
    """
    count = len(fit.model.free)
    if count == 0:
        return np.zeros((0, 0))
    targets = np.arange(count) + SPOT_PARAMETERS * fit.equations.frame_count
    information = information_beside(fit.equations.information, targets)
    model_based = invert_information(information)
    sandwiches = []
    for sums in sum_by_clusters(fit, targets, (label_sites, label_cells, label_rows)):
        scores = sums.score - sums.score.mean(axis=0)
        small_sample_factor = len(scores) / max(len(scores) - 1, 1)
        sandwiches.append(model_based @ (scores.T @ scores * small_sample_factor) @ model_based)
    largest = np.max([np.diag(estimate) for estimate in (*sandwiches, model_based)], axis=0)
    inflation = np.sqrt(largest / np.maximum(np.diag(sandwiches[0]), TINY))
    covariance = sandwiches[0] * inflation[:, None] * inflation
    # The pseudo-inverse would give a variance of 0 to parameters on which the pixels carry no information, such as the
    # brightness of a ghost outside the crops.
    is_unknown = np.diag(information) <= 0
    covariance[is_unknown], covariance[:, is_unknown] = 0.0, 0.0
    covariance[is_unknown, is_unknown] = np.inf
    for k, parameter in enumerate(fit.model.free):
        # Readings follow such a parameter in whole steps: within a step its value is not known.
        if parameter.effect and rounded_parameter(fit.model.effect_named(parameter.effect)) == parameter.name:
            covariance[k, k] += ROUNDING_VARIANCE
    return covariance


def add_error_of_nodes(covariance: np.ndarray, fit: JointFit) -> np.ndarray:
    """Return a covariance [fitted, fitted] with the error that the nodes of a free shape cause by their distance.

    The error of a parameter is its change when the nodes lie `COARSER` times farther apart. All sites, sectors and
    conditions share it, so that no division into clusters shows it. Both fits are to the same thinned pixels, so that
    noise cancels. Without a free shape the covariance is returned as it is.
    """
    model = fit.model
    if model.grid is None or not model.effect_names:
        return covariance
    thin = thin_pixels(fit.pixels)
    fine = fit_jointly(model, thin, tolerance=COARSE_TOLERANCE, iterations=COARSE_ITERATIONS).model
    start = fine.with_free_shape(replace(model.grid, step=COARSER * model.grid.step))
    coarse = fit_jointly(start, thin, tolerance=COARSE_TOLERANCE, iterations=COARSE_ITERATIONS).model
    change = [coarse.value_of(parameter) - fine.value_of(parameter) for parameter in model.free]
    return covariance + np.diag(np.square(change))


def assess_effect(
    fit: JointFit, name: str, covariance: np.ndarray, scales: EffectScales, known_gain: float | None = None
) -> EffectTest:
    """Test one effect of a fit.

    Parameters
    ----------
    fit : JointFit
        Fit with the effect.
    name : str
        Name of the effect.
    covariance : array [fitted, fitted]
        Result of `estimate_covariance`.
    scales : EffectScales
        Typical sizes of the dataset, on which the negligible strength of an effect depends.
    known_gain : float, optional
        Drop of −2 ln L by the effect, if a fit without it exists.
    """
    wald = square_z(fit.model, name, covariance)
    cells = compare_cells(fit, name)
    gain = measure_gain(fit, name, wald, cells.dispersion) if known_gain is None else known_gain
    is_nothing = is_negligible(fit.model.effect_named(name), scales)
    return EffectTest(gain, wald, cells.q, cells.count, cells.limit(gain), is_nothing, least_gain(fit.model))


def square_z(model: JointModel, name: str, covariance: np.ndarray) -> float:
    """Return the Wald z² of the strength of an effect for a covariance [fitted, fitted].

    An effect that vanishes at infinity has no finite z: z² is infinite, or 0 if nothing is known of the strength.
    """
    position = position_of_strength(model, name)
    variance = max(covariance[position, position], TINY)
    distance = distance_from_nothing(model.effect_named(name))
    if np.isfinite(distance):
        return float(distance**2 / variance)
    return np.inf if np.isfinite(variance) else 0.0


def position_of_strength(model: JointModel, name: str) -> int:
    """Return the position of an effect's strength (its first parameter) among the fitted parameters `model.free`."""
    strength = model.effect_named(name).effect.parameters[0].name
    return next(k for k, p in enumerate(model.free) if (p.effect, p.name) == (name, strength))


def compare_cells(fit: JointFit, name: str) -> CellComparison:
    """Compare the strengths of a fitted effect between the cells of the spot; see `label_cells`.

    The errors are model-based: the cluster-robust ones would include the misfit that all cells share.
    """
    target = SPOT_PARAMETERS * fit.equations.frame_count + position_of_strength(fit.model, name)
    (sums,) = sum_by_clusters(fit, np.array([target]), (label_cells,))
    score, information, field_information = sums.score[:, 0], sums.information[:, 0], sums.field_information[:, 0]
    effect_dispersion = fit.pixels.dispersion_of(field_information.sum() / max(information.sum(), TINY))
    is_used = information > LEAST_CELL_SHARE * information.sum()
    # The score of a cell has the variance dispersion × information: divided by the dispersion, information/dispersion.
    dispersion = fit.pixels.dispersion_of(field_information[is_used] / information[is_used])
    score, information = score[is_used] / dispersion, information[is_used] / dispersion
    q = float(np.sum(score**2 / information) - score.sum() ** 2 / max(information.sum(), TINY))
    return CellComparison(q, int(is_used.sum()), float(effect_dispersion))


def least_gain(model: JointModel) -> float:
    """Return the least drop of −2 ln L with which an effect of a model is reported."""
    is_alone = model.grid is not None and model.design.sites == 1
    return MIN_GAIN_AT_ONE_SITE if is_alone else MIN_GAIN


def measure_gain(fit: JointFit, name: str, wald: float, dispersion: float) -> float:
    """Return the drop of −2 ln L by an effect, over its dispersion.

    A finite z² (`wald`) above `CERTAIN` is returned in its place. Otherwise a refit without the effect gives the drop.
    The refit is made to thinned pixels if their result cannot change the decision, else to all pixels.
    """
    if CERTAIN < wald < np.inf:
        return wald
    without = fit.model.without_effect(name)

    def gain_on(pixels: Pixels, deviance: float) -> float:
        """Return the gain extrapolated from some pixels, at which the model with the effect has −2 ln L `deviance`."""
        refit = fit_jointly(without, pixels, tolerance=WITHOUT_TOLERANCE, iterations=WITHOUT_ITERATIONS)
        return (refit.deviance - deviance) / dispersion * fit.pixels.count / pixels.count

    # An effect with wald < MIN_GAIN is removed whatever its gain, so that a rough one is enough.
    if wald < MIN_GAIN or wald == np.inf:
        thinned = thin_pixels(fit.pixels)
        gain = gain_on(thinned, assemble(fit.model, thinned).deviance)
        if gain > CERTAIN or wald < MIN_GAIN:
            return gain
    return gain_on(fit.pixels, fit.deviance)


def distance_from_nothing(applied: AppliedEffect) -> float:
    """Return the distance of the strength from the value at which the effect vanishes, in the unit of the strength.

    It is infinite for a clip, and NaN if that value depends on the dataset.
    """
    return abs(applied.values[0] - applied.effect.vanishes_at)


def is_negligible(applied: AppliedEffect, scales: EffectScales) -> bool:
    """Return whether the strength of an effect is too small to matter to a user."""
    least = applied.effect.parameters[0].negligible
    return bool(distance_from_nothing(applied) < (least(scales) if callable(least) else least))


# Sums over clusters of pixels


def sum_by_clusters(fit: JointFit, targets: np.ndarray, labels: Sequence[Labels]) -> list[ClusterSums]:
    """Return the sums of scores and information over clusters, for each division of the pixels into clusters.

    Parameters
    ----------
    fit : JointFit
        Fit with the targets.
    targets : array [target]
        Positions of fitted parameters among the unknowns. Their columns are projected on all other unknowns, but not on
        each other.
    labels : sequence of functions
        Divisions of the pixels: each returns the cluster of each pixel.
    """
    model, equations, information = fit.model, fit.equations, fit.equations.information
    others = np.setdiff1d(np.arange(equations.size), targets)
    # Steps of the unknowns that reproduce the column of each target best; 0 for the targets themselves.
    steps = np.zeros((equations.size, len(targets)))
    steps[others] = solve_positive(information[np.ix_(others, others)], information[np.ix_(others, targets)])
    # The same steps of the coefficients of a free shape [coefficient, target].
    coefficients = None
    if equations.shape is not None:
        moves = steps.copy()
        moves[targets, np.arange(len(targets))] = -1.0
        coefficients = equations.shape.solve_coefficients(np.zeros((1, 1)), moves)
    absorbed = Absorbed(steps, coefficients)

    def sum_batch(batch: slice) -> list[tuple[np.ndarray, ...]]:
        """Return, for each division, the clusters of a batch and their three sums; see `_merge`."""
        evaluation = evaluate(model, fit.pixels, batch)
        fitted = differentiate_readings(model, evaluation)
        columns = [fitted[target - SPOT_PARAMETERS * equations.frame_count] for target in targets]
        is_used, terms = evaluation.weight > 0, []
        for column in absorbed.subtract_from(columns, model, evaluation, batch, fitted):
            per_pixel = evaluation.information_per_pixel(column)
            terms.append((evaluation.score_per_pixel(column), per_pixel, evaluation.field_share * per_pixel))
        divisions = []
        for label in labels:
            label_of_pixel = np.broadcast_to(label(model, evaluation, batch), is_used.shape)[is_used]
            clusters, index = np.unique(label_of_pixel, return_inverse=True)
            sums = (np.stack([np.bincount(index, term[is_used], len(clusters)) for term in of_targets], 1)
                    for of_targets in zip(*terms, strict=True))  # fmt: skip
            divisions.append((clusters, *sums))
        return divisions

    batches = map_batches(sum_batch, fit.pixels)
    return [_merge([divisions[k] for divisions in batches]) for k in range(len(labels))]


def _merge(batches: Sequence[tuple[np.ndarray, ...]]) -> ClusterSums:
    """Add the sums of the same cluster over batches.

    Each batch has the labels of its clusters [cluster] and the sums of score, information and field information
    [cluster, target].
    """
    labels, *sums = (np.concatenate(arrays) for arrays in zip(*batches, strict=True))
    clusters, index = np.unique(labels, return_inverse=True)
    totals = [np.zeros((len(clusters), terms.shape[1])) for terms in sums]
    for total, terms in zip(totals, sums, strict=True):
        np.add.at(total, index, terms)
    return ClusterSums(*totals)


def label_cells(model: JointModel, evaluation: Evaluation, batch: slice) -> np.ndarray:
    """Return the cell of each pixel [frame, h, w]: sector × ring × condition."""
    sector, ring = divide_spot(evaluation.conditions)
    condition = model.design.condition[batch][:, None, None]
    return sector + SECTORS * (ring + RINGS * condition)


def label_sites(model: JointModel, evaluation: Evaluation, batch: slice) -> np.ndarray:
    """Return the cluster of each pixel [frame, h, w]: site × sector, or block of a frame if sites are few."""
    if model.design.sites >= MANY_SITES:
        return model.design.site[batch][:, None, None] * SECTORS + divide_spot(evaluation.conditions)[0]
    pixels = evaluation.conditions.pixels
    block = (pixels.y // BLOCK_PX) * ROW_FACTOR + pixels.x // BLOCK_PX
    return (np.arange(batch.start, batch.stop)[:, None, None] * FRAME_FACTOR + block).astype(np.int64)


def label_rows(model: JointModel, evaluation: Evaluation, batch: slice) -> np.ndarray:
    """Return the cluster of each pixel [frame, h, 1]: row of a frame."""
    frame = np.arange(batch.start, batch.stop)[:, None, None]
    return (frame * ROW_FRAME_FACTOR + evaluation.conditions.pixels.y).astype(np.int64)
