"""Laws of brightness and width across frames: generalised least squares with REML variances of frames and sites.

The law of the exposure is σ_g = p1 ln(t / 1 s) + p2 + σ_laser [px], with the exposure t and the laser's own width
σ_laser on the sensor; the peak follows from σ_g and t, up to a constant factor. Further laws are effects, such as a
reflectance that follows the fibre angle. The frames of a site share angle, declared conditions and repeat.

Observations are z = (ln peak of F frames, ln σ_g of F frames) [2F]. Their total covariance V is the covariance C of the
joint fit plus the variance components, which are scatter from frame to frame and from site to site. These are estimated
beside a saturated mean, which is free for each angle and exposure, so that no missing law increases them. Sets of laws
are compared by χ² = r' V⁻¹ r of the residuals r with the same V.
"""

import copy
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from spotcheck.discrepancy.candidates import SPOT_STAGES
from spotcheck.discrepancy.criteria import CELL_MISFIT, CELL_SLACK, CONFIDENCE, LAW_TIE, MIN_GAIN, MIN_Z, VARIANT_TIE
from spotcheck.discrepancy.evidence import is_negligible
from spotcheck.discrepancy.frames import LOG_PEAK, LOG_SIGMA, Design
from spotcheck.discrepancy.mixed_model import Interval, fit_reml
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.discrepancy.spot_components import LEAST_FREE, build_components, build_factors, build_saturated_mean
from spotcheck.discrepancy.spot_measurements import SpotMeasurements
from spotcheck.model.conditions import FrameConditions, PixelGrid
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, Need, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw

# All sets of up to EXHAUSTIVE_SIZE laws are tried; the BEAM best sets of a size are extended, up to MOST_LAWS laws.
EXHAUSTIVE_SIZE, BEAM, MOST_LAWS = 2, 5, 4
# Drop of −2 ln L below which a variance component is left out: the errors of the others are then better.
COMPONENT_GAIN = 6.0
# Most steps of a fit of laws, and the promised drop of χ² at which it has converged.
ITERATIONS, TOLERANCE = 40, 1e-4
# Most trials of a step of such a fit, each with half the step of the one before.
MOST_HALVINGS = 12
# Relative singular values below which columns count as dependent: in a step of a fit, and in the rank of a test.
STEP_RCOND, RANK_RCOND = 1e-10, 1e-9
# Step of finite differences relative to the parameter, and the least value that counts for it, relative to the range.
DIFFERENCE, LEAST_SCALE = 1e-6, 1e-2
# Part of the range of a parameter that one step may cross.
LARGEST_STEP = 0.3
# Range of the degrees of freedom of Student's t.
LEAST_FREEDOM, LARGEST_FREEDOM = 2.0, 1e5
# Logarithm of the least probability that is converted to z, and the z of all below it.
LEAST_LOG_P, LARGEST_Z = -690.0, 37.0
# Factor of the design over which the lack of fit of a law is tested.
FACTORS = {Need.ANGLES: "angle", Need.EXPOSURES: "exposure", Need.THREE_EXPOSURES: "exposure", Need.ORDER: "order"}


class LawParameter(NamedTuple):
    """A fitted parameter of a set of laws."""

    effect: str  # name of the effect; "" for the law of the exposure
    name: str  # name of the parameter, or of the field of `ExposureLaw`


PEAK = LawParameter("", "peak_dn")
# Sorted names of the effects of a set of laws.
LawNames = tuple[str, ...]


def is_law(effect: Effect) -> bool:
    """Return whether an effect changes only brightness and width of frames, and follows a formula, not chance."""
    steps = [step for steps in effect.variants.values() for step in steps]
    return bool(steps) and all(step.stage in SPOT_STAGES and not isinstance(step, RandomStep) for step in steps)


def spot_conditions(design: Design) -> FrameConditions:
    """Return the conditions of frames for stages that do not depend on pixels, as arrays [frame, 1, 1].

    Pixels and centres are placeholders at 0 px.
    """
    nowhere = np.zeros((len(design.site), 1, 1))
    exposure_s, angle, order = (v[:, None, None] for v in (design.exposure_s, design.angle, design.order))
    grid = PixelGrid(nowhere, nowhere, 1, 1)
    return FrameConditions(grid, nowhere, nowhere, exposure_s, design.longest_s, design.reference_s, angle, order)


def predict_spots(model: ForwardModel, conditions: FrameConditions) -> np.ndarray:
    """Return ln peak [ln DN] and ln σ_g [ln px] of frames under a model with a law [2, frame]; NaN if negative."""
    with np.errstate(all="ignore"):
        spot, shape = model.spot(conditions), conditions.exposure_s.shape
        return np.log([np.broadcast_to(values, shape).ravel() for values in (spot.peak_dn, spot.sigma_px)])


@dataclass(frozen=True)
class LawFit:
    """A fitted set of laws."""

    law: ExposureLaw  # p1, p2 and the peak at the longest exposure
    effects: tuple[AppliedEffect, ...]  # the other laws of the set
    names: tuple[LawParameter, ...]  # fitted parameters
    covariance: np.ndarray  # covariance of the fitted parameters [parameter, parameter]
    chi2: float  # r' V⁻¹ r
    jacobian: np.ndarray  # derivatives of the observations by the parameters [2F, parameter]
    residual: np.ndarray  # r, observations less their means [2F]
    has_converged: bool  # whether the promised drop of χ² is below the tolerance


@dataclass(frozen=True)
class NamedLaw:
    """A law of the best set, with the tests that decide whether it is named in the verdict."""

    applied: AppliedEffect  # the law with its fitted values
    intervals: dict[str, Interval]  # 95 % intervals of its parameters by name, in their units
    z: float  # the smaller of √gain and the normal equivalent of the t test of its strength
    gain: float  # drop of χ² by it beside the other laws of the set
    reasons: tuple[str, ...]  # reasons against naming it; empty if it is named


class LawSearch:
    """Search for laws in the spot parameters of a set of F frames.

    Attributes
    ----------
    measurements, design, frame_count : spot parameters of the frames with their covariance; conditions; number F.
    forward : baseline and sensor, without effects.
    observations, noise : z [2F] and its covariance C by the joint fit [2F, 2F].
    factors, saturated_mean : columns that depend on angle, exposure and order, by `spot_components`.
    components, variances : needed variance components by name, as covariances [2F, 2F]; estimates of their variances.
    inverse, whitening : V⁻¹, and a matrix W with W'W = V⁻¹ [2F, 2F].
    """

    def __init__(self, measurements: SpotMeasurements, forward: ForwardModel, scales: EffectScales) -> None:
        """Estimate the variance components; `scales` give bounds and starting values of effects."""
        self.measurements, self.scales = measurements, scales
        self.forward = replace(forward, effects=())
        self.design, self.frame_count = measurements.design, len(measurements.spots.x)
        self.observations, self.noise = measurements.observations, measurements.covariance_of(LOG_PEAK, LOG_SIGMA)
        self.conditions = spot_conditions(self.design)
        self.factors = build_factors(self.design)
        self.saturated_mean = build_saturated_mean(self.design, self.factors)
        self.components = self._select_components()
        self.variances = fit_reml(self.observations, self.saturated_mean, self.noise, self.components)
        self._whiten()

    def _whiten(self) -> None:
        """Set `inverse` and `whitening` from noise and variance components."""
        estimates = zip(self.variances.variance, self.components.values(), strict=True)
        total = self.noise + sum(variance * component for variance, component in estimates)
        self.inverse = np.linalg.inv(total)
        self.whitening = np.linalg.cholesky(self.inverse).T

    def with_measurements(self, measurements: SpotMeasurements) -> "LawSearch":
        """Return the search on other spot parameters of the same frames, with the same variance components."""
        other = copy.copy(self)
        other.measurements, other.observations = measurements, measurements.observations
        other.noise = measurements.covariance_of(LOG_PEAK, LOG_SIGMA)
        other._whiten()
        return other

    @property
    def can_estimate(self) -> bool:
        """Whether the saturated mean leaves enough degrees of freedom for variance components."""
        return 2 * self.frame_count - np.linalg.matrix_rank(self.saturated_mean) >= LEAST_FREE

    def _select_components(self) -> dict[str, np.ndarray]:
        """Return the needed variance components, after removing the one with the least gain again and again.

        "frame brightness" always stays: with other free components beside it, chance would halve it.
        """
        if not self.can_estimate:
            return {}
        components = build_components(self.design, self.noise)
        while True:
            deviance = self.deviance_of(components)
            gains = {
                name: self.deviance_of({key: components[key] for key in components if key != name}) - deviance
                for name in components
                if name != "frame brightness"
            }
            weakest = min(gains, key=lambda name: gains[name], default=None)
            if weakest is None or gains[weakest] > COMPONENT_GAIN:
                return components
            components.pop(weakest)

    def deviance_of(self, components: dict[str, np.ndarray]) -> float:
        """Return −2 ln L (REML) of the observations with some variance components beside the saturated mean."""
        return fit_reml(self.observations, self.saturated_mean, self.noise, components).deviance

    def fit(self, effects: Sequence[Effect]) -> LawFit:
        """Return the best fit of a set of laws over their variants and starting points.

        A later variant must lower χ² by more than `VARIANT_TIE` to replace an earlier one.
        """
        best: LawFit | None = None
        for variants in itertools.product(*(effect.variants for effect in effects)):
            choices = [[AppliedEffect(effect, variant, tuple(start)) for start in effect.starts(self.scales)]
                       for effect, variant in zip(effects, variants, strict=True)]  # fmt: skip
            fit = min((self._fit_from(start) for start in itertools.product(*choices)), key=lambda fit: fit.chi2)
            if best is None or fit.chi2 < best.chi2 - VARIANT_TIE:
                best = fit
        assert best is not None
        return best

    def _fit_from(self, effects: tuple[AppliedEffect, ...]) -> LawFit:
        """Fit the law of the exposure and effects from their starting values, by Gauss–Newton steps.

        p1 is fixed with a single exposure. An effect may replace it; it is then 0, and p2 starts at the mean width.
        """
        replaced = {name for applied in effects for name in applied.effect.replaces}
        names = [PEAK, LawParameter("", "p2")]
        if self.factors["exposure"].shape[1] > 1 and "p1" not in replaced:
            names.append(LawParameter("", "p1"))
        names += [LawParameter(applied.effect.name, parameter.name) for applied in effects
                  for parameter in applied.effect.parameters_of(applied.variant)]  # fmt: skip
        law = self._guess_law()
        if replaced:
            mean_sigma_px = np.exp(np.mean(self.measurements.spots.log_sigma))
            law = replace(law, p1=0.0, p2=float(mean_sigma_px - self.forward.baseline.laser_px))
        model = replace(self.forward, law=law, effects=effects)
        has_converged = False
        for _ in range(ITERATIONS):
            mean, jacobian = self.linearize(model, names)
            whitened = self.whitening @ jacobian
            step = np.linalg.lstsq(whitened, self.whitening @ (self.observations - mean), rcond=STEP_RCOND)[0]
            has_converged = bool(np.sum((whitened @ step) ** 2) < TOLERANCE)
            before, model = model, self._descend(model, names, step)
            # Where no step lowers χ² the next one would be the same.
            if has_converged or model is before:
                break
        mean, jacobian = self.linearize(model, names)
        residual, whitened = self.observations - mean, self.whitening @ jacobian
        chi2 = self._chi2_of(model)
        covariance = invert_information(whitened.T @ whitened)
        assert model.law is not None
        return LawFit(model.law, model.effects, tuple(names), covariance, chi2, jacobian, residual, has_converged)

    def _descend(self, model: ForwardModel, names: Sequence[LawParameter], step: np.ndarray) -> ForwardModel:
        """Return the model after the first of a step [parameter], its half, its quarter … that does not raise χ².

        The model is returned as it is if all of them raise χ².
        """
        chi2 = self._chi2_of(model)
        for halvings in range(MOST_HALVINGS):
            moved = self._move(model, names, step / 2**halvings)
            if self._chi2_of(moved) <= chi2:
                return moved
        return model

    def _chi2_of(self, model: ForwardModel) -> float:
        """Return χ² of the observations under a model; infinite where the model gives no finite mean."""
        chi2 = float(np.sum((self.whitening @ (self.observations - self.mean_of(model))) ** 2))
        return chi2 if np.isfinite(chi2) else np.inf

    def _guess_law(self) -> ExposureLaw:
        """Return a start of the exposure law.

        p1 and p2 [px] are a least-squares line through σ_g − σ_laser over ln t (p1 = 0 with a single exposure). The
        peak [DN] then fits the mean of ln peak.
        """
        baseline, design = self.forward.baseline, self.design
        broadening_px = np.exp(self.measurements.spots.log_sigma) - baseline.laser_px
        if self.factors["exposure"].shape[1] > 1:
            p1, p2 = np.polyfit(np.log(design.exposure_s), broadening_px, 1)
        else:
            p1, p2 = 0.0, float(np.mean(broadening_px))
        law = ExposureLaw(float(p1), float(p2), peak_dn=1.0)
        log_peak, _ = predict_spots(replace(self.forward, law=law), self.conditions)
        return replace(law, peak_dn=float(np.exp(np.mean(self.measurements.spots.log_peak - log_peak))))

    def mean_of(self, model: ForwardModel) -> np.ndarray:
        """Return the mean of the observations under a model with a law [2F]; NaN where peak or σ_g is negative."""
        return predict_spots(model, self.conditions).ravel()

    def linearize(
        self, model: ForwardModel, names: Sequence[LawParameter], conditions: FrameConditions | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean [2F] and forward-difference derivatives [2F, parameter] of the observations; 0 instead of NaN."""
        conditions = conditions or self.conditions
        mean = predict_spots(model, conditions).ravel()
        columns = []
        for parameter in names:
            value, (low, high) = value_of(model, parameter), self._bounds_of(model, parameter)
            step = DIFFERENCE * max(abs(value), LEAST_SCALE * (high - low) if np.isfinite(high - low) else 1.0)
            moved = predict_spots(with_value(model, parameter, value + step), conditions).ravel()
            columns.append((moved - mean) / step)
        return np.nan_to_num(mean), np.nan_to_num(np.stack(columns, 1))

    def _bounds_of(self, model: ForwardModel, parameter: LawParameter) -> tuple[float, float]:
        """Return the lowest and the highest value of a parameter; infinite for the law of the exposure."""
        if not parameter.effect:
            return -np.inf, np.inf
        applied = next(applied for applied in model.effects if applied.effect.name == parameter.effect)
        return dict(zip(applied.parameters, applied.effect.bounds(self.scales), strict=True))[parameter.name]

    def _move(self, model: ForwardModel, names: Sequence[LawParameter], step: np.ndarray) -> ForwardModel:
        """Return the model after a step [parameter].

        The whole step is shortened until no parameter crosses more than `LARGEST_STEP` of its range.
        """
        low, high = np.array([self._bounds_of(model, parameter) for parameter in names]).T
        # Parameters of the law of the exposure have an infinite range.
        fraction = min(1.0, float(np.min(LARGEST_STEP * (high - low) / np.maximum(np.abs(step), 1e-300))))
        for parameter, change, bounds in zip(names, fraction * step, zip(low, high, strict=True), strict=True):
            old = value_of(model, parameter)
            # A logarithmic step of at most a factor e keeps the peak above 0.
            value = old * np.exp(np.clip(change / old, -1, 1)) if parameter == PEAK else old + change
            model = with_value(model, parameter, float(np.clip(value, *bounds)))
        return model

    def select(self, effects: Sequence[Effect]) -> tuple[LawNames, list[LawNames], dict[LawNames, LawFit]]:
        """Return the best set of laws, its rivals, and the fits of all sets tried.

        The best set has the least χ² + `MIN_GAIN` per law. Rivals are sets of as many laws whose χ² is less than
        `LAW_TIE` larger.
        """
        fits: dict[LawNames, LawFit] = {(): self.fit(())}
        sets: dict[LawNames, tuple[Effect, ...]] = {(): ()}

        def cost(names: LawNames) -> float:
            """Return χ² + `MIN_GAIN` per law of a set that was tried."""
            return fits[names].chi2 + MIN_GAIN * len(names)

        best_of_size: list[LawNames] = []
        for size in range(1, MOST_LAWS + 1):
            if size <= EXHAUSTIVE_SIZE:
                candidates = list(itertools.combinations(effects, size))
            else:
                candidates = [
                    (*sets[names], effect) for names in best_of_size for effect in effects if effect.name not in names
                ]
            names_of_size = set()
            for laws in candidates:
                names = tuple(sorted(effect.name for effect in laws))
                names_of_size.add(names)
                if names not in fits:
                    fits[names], sets[names] = self.fit(laws), laws
            best_of_size = sorted(names_of_size, key=cost)[:BEAM]
            # Pairs are tried even if no single law helps, since a law may need another one beside it.
            if not best_of_size or (size > 1 and cost(best_of_size[0]) > min(map(cost, fits))):
                break
        best = min(fits, key=cost)
        limit = fits[best].chi2 + LAW_TIE
        others = [names for names in fits if names != best and len(names) == len(best)]
        return best, [names for names in others if fits[names].chi2 < limit], fits

    def judge(self, applied: AppliedEffect, fit: LawFit, gain: float) -> NamedLaw:
        """Test one law of a fitted set; `gain` is the drop of χ² by it."""
        rows = [k for k, parameter in enumerate(fit.names) if parameter.effect == applied.effect.name]
        # The first parameter of an effect is its strength. Its estimate is a weighted sum of the observations.
        weights = self.inverse @ fit.jacobian @ fit.covariance[:, rows[0]]
        dof = self.degrees_of_freedom(weights, fit.covariance[rows[0], rows[0]])
        quantile = float(stats.t.ppf((1 + CONFIDENCE) / 2, dof))
        errors = np.sqrt(np.diag(fit.covariance)[rows])
        intervals = {
            fit.names[k].name: Interval.around(applied.parameters[fit.names[k].name], error, quantile)
            for k, error in zip(rows, errors, strict=True)
        }
        distance = applied.values[0] - applied.effect.vanishes_at
        z = float(np.sqrt(max(gain, 0.0)))
        if np.isfinite(distance):
            z = min(z, upper_tail_z(float(stats.t.logsf(abs(distance) / errors[0], dof))))
        reasons = []
        if not z >= MIN_Z:
            reasons.append("z below the least")
        if is_negligible(applied, self.scales):
            reasons.append("negligible")
        for factor in dict.fromkeys(FACTORS[need] for need in applied.effect.needs if need in FACTORS):
            drop, freedom = self.lack_of_fit(fit, factor)
            if freedom > 0 and drop - freedom > max(CELL_SLACK * np.sqrt(2 * freedom), CELL_MISFIT * max(gain, 0.0)):
                reasons.append(f"lack of fit over {factor}: {drop:.0f} on {freedom}")
        return NamedLaw(applied, intervals, z, gain, tuple(reasons))

    def degrees_of_freedom(self, weights: np.ndarray, variance: float) -> float:
        """Return Satterthwaite's degrees of freedom, 2 variance²/(its error)², of a weighted sum of the observations.

        The `variance` of the sum has an error, since the variance components are estimates. `weights` are [2F].
        """
        if not self.components:
            return LARGEST_FREEDOM
        gradient = np.array([weights @ matrix @ weights for matrix in self.components.values()])
        spread = float(gradient @ self.variances.covariance @ gradient)
        return float(np.clip(2 * variance**2 / max(spread, 1e-300), LEAST_FREEDOM, LARGEST_FREEDOM))

    def lack_of_fit(self, fit: LawFit, factor: str) -> tuple[float, int]:
        """Return the drop of χ² when the columns of a factor are added to a fit, and its degrees of freedom.

        They are added to ln peak; those of the exposure to ln σ_g as well, since both follow the exposure.
        """
        columns = self.factors[factor]
        zero = np.zeros_like(columns)
        added = np.block([[columns, zero], [zero, columns]]) if factor == "exposure" else np.block([[columns], [zero]])
        residual = self.whitening @ fit.residual

        def explain(matrix: np.ndarray) -> tuple[float, int]:
            """Return the part of χ² that the columns of a matrix [2F, k] explain, and their rank."""
            left, singular, _ = np.linalg.svd(self.whitening @ matrix, full_matrices=False)
            used = singular > RANK_RCOND * singular[0]
            return float(np.sum((left[:, used].T @ residual) ** 2)), int(used.sum())

        with_factor, rank = explain(np.hstack([fit.jacobian, added]))
        without, rank_without = explain(fit.jacobian)
        return with_factor - without, rank - rank_without


@dataclass(frozen=True)
class FoundLaws:
    """The best set of laws of some frames."""

    fit: LawFit  # fit of the best set
    laws: tuple[NamedLaw, ...]  # its laws with their tests
    rivals: Mapping[LawNames, float]  # excess of χ² of each set that fits about as well, by its names


def find_laws(search: LawSearch, effects: Sequence[Effect]) -> FoundLaws:
    """Return the best set of laws with the test of each, and its rivals."""
    effect_by_name = {effect.name: effect for effect in effects}
    best, rivals, fits = search.select(effects)
    fit, laws = fits[best], []
    for applied in fit.effects:
        others = tuple(name for name in best if name != applied.effect.name)
        # A search of larger sets does not try every set without one of their laws.
        without = fits.get(others) or search.fit([effect_by_name[name] for name in others])
        laws.append(search.judge(applied, fit, without.chi2 - fit.chi2))
    return FoundLaws(fit, tuple(laws), {names: fits[names].chi2 - fit.chi2 for names in rivals})


def upper_tail_z(log_p: float) -> float:
    """Return the normal z of an upper-tail probability, given as its natural logarithm; NaN if that is NaN."""
    if np.isnan(log_p):
        return np.nan
    return float(-special.ndtri_exp(log_p)) if log_p > LEAST_LOG_P else LARGEST_Z


def value_of(model: ForwardModel, parameter: LawParameter) -> float:
    """Return the value of a parameter of the laws of a model, in its unit."""
    if not parameter.effect:
        return getattr(model.law, parameter.name)
    applied = next(applied for applied in model.effects if applied.effect.name == parameter.effect)
    return applied.parameters[parameter.name]


def with_value(model: ForwardModel, parameter: LawParameter, value: float) -> ForwardModel:
    """Return the model with another value of a parameter of its laws."""
    if not parameter.effect:
        assert model.law is not None
        return replace(model, law=replace(model.law, **{parameter.name: value}))
    effects = tuple(
        a.with_value(parameter.name, value) if a.effect.name == parameter.effect else a for a in model.effects
    )
    return replace(model, effects=effects)
