"""Laws of brightness and width across frames: generalised least squares beside REML variances of frame and site.

Observations are z = (ln peak, ln σ_g) of all frames with their covariance C from the joint fit. Their covariance is
V = C + components of frame and site in brightness and width, estimated beside a saturated mean (one mean for each cell
of angle and exposure), so that no missing law can hide in them. Sets of laws are compared by χ² at this one V.
"""

import copy
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special, stats

from spotcheck.discrepancy.candidates import SPOT_STAGES
from spotcheck.discrepancy.criteria import CELL_MISFIT, CELL_SLACK, LAW_TIE, MIN_GAIN, MIN_Z, VARIANT_TIE
from spotcheck.discrepancy.evidence import is_negligible
from spotcheck.discrepancy.frames import Design
from spotcheck.discrepancy.mixed_model import Interval, fit_reml
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.discrepancy.spot_numbers import SpotNumbers
from spotcheck.model.conditions import FrameConditions, PixelGrid
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, Need, RandomStep
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw

# Most laws in one set, and sets that are extended by one more law.
MOST_LAWS, BEAM = 4, 5
# Degrees of freedom beside the saturated mean without which no component is estimated.
LEAST_FREE = 4
# Drop of −2 ln L without which a variance component is left out: that gives better errors.
COMPONENT_GAIN = 6.0
# Most steps of a fit of laws, and the promised drop of χ² at which it has converged.
ITERATIONS, TOLERANCE = 40, 1e-4
# Most halvings of a step of such a fit.
MOST_HALVINGS = 12
# Relative step of differences, and the scale of parameters near 0.
DIFFERENCE, LEAST_SCALE = 1e-6, 1e-2
# Part of the range of a parameter that one step may cross.
LARGEST_STEP = 0.3
# Range of the degrees of freedom of Student's t.
LEAST_FREEDOM, LARGEST_FREEDOM = 2.0, 1e5
# Factor of the design that the lack of fit of a law is tested over.
FACTORS = {Need.ANGLES: "angle", Need.EXPOSURES: "exposure", Need.THREE_EXPOSURES: "exposure", Need.ORDER: "order"}


def is_law(effect: Effect) -> bool:
    """Return whether an effect is a law of brightness or width across frames."""
    steps = [step for steps in effect.variants.values() for step in steps]
    return bool(steps) and all(step.stage in SPOT_STAGES and not isinstance(step, RandomStep) for step in steps)


def spot_conditions(design: Design) -> FrameConditions:
    """Return the conditions of frames for what does not depend on pixels; arrays [frame, 1, 1]."""
    nowhere = np.zeros((len(design.site), 1, 1))
    exposure_s, angle, order = (v[:, None, None] for v in (design.exposure_s, design.angle, design.order))
    grid = PixelGrid(nowhere, nowhere, 1, 1)
    return FrameConditions(grid, nowhere, nowhere, exposure_s, design.longest_s, design.reference_s, angle, order)


@dataclass(frozen=True)
class LawFit:
    """A fitted set of laws."""

    law: ExposureLaw  # p1, p2 and the peak at the longest exposure
    effects: tuple[AppliedEffect, ...]  # the laws beside it
    names: tuple[tuple[str, str], ...]  # (effect, parameter) of each fitted parameter; effect "" for the exposure law
    covariance: np.ndarray  # of the fitted parameters
    chi2: float  # r' V⁻¹ r
    jacobian: np.ndarray  # derivatives of the observations by the parameters [2F, parameter]
    residual: np.ndarray  # observations less their means [2F]
    has_converged: bool  # whether the promised drop of χ² is below the tolerance


@dataclass(frozen=True)
class NamedLaw:
    """A law that the frames show."""

    applied: AppliedEffect  # with its values
    intervals: dict[str, Interval]  # of its parameters
    z: float  # normal equivalent of its test
    gain: float  # drop of χ² by it beside the others
    reasons: tuple[str, ...]  # against naming it; empty: it is named


class LawSearch:
    """Laws of the numbers of a set of frames."""

    def __init__(self, numbers: SpotNumbers, forward: ForwardModel, scales: EffectScales) -> None:
        self.numbers, self.scales = numbers, scales
        self.forward = replace(forward, effects=())
        self.design, self.frames = numbers.design, len(numbers.spots.x)
        self.observations, self.noise = numbers.observations, numbers.covariance_of(0, 1)
        self.conditions = spot_conditions(self.design)
        self.levels = _one_hot(self.design.exposure_s)
        self.factors = {
            "angle": _one_hot(self.design.angle),
            "exposure": self.levels,
            "order": np.stack([(self.design.order - 0.5) ** k for k in range(1, 5)], 1),
        }
        self.components = self._needed_components()
        self.variances = fit_reml(self.observations, self.saturated_mean, self.noise, self.components)
        self._whiten()

    def _whiten(self) -> None:
        """Set the inverse of the covariance of the observations, and its root."""
        total = self.noise + sum(
            (v * m for v, m in zip(self.variances.variance, self.components.values(), strict=True)),
            np.zeros_like(self.noise),
        )
        self.inverse = np.linalg.inv(total)
        self.whitening = np.linalg.cholesky(self.inverse).T

    def with_numbers(self, numbers: SpotNumbers) -> "LawSearch":
        """Return the search on other numbers of the same frames, beside the same variances of frames and sites."""
        other = copy.copy(self)
        other.numbers, other.observations, other.noise = numbers, numbers.observations, numbers.covariance_of(0, 1)
        other._whiten()
        return other

    # Variance components.

    @cached_property
    def saturated_mean(self) -> np.ndarray:
        """Columns [2F, k] of a mean that no law can add to."""
        keys = np.stack([self.design.angle, self.design.exposure_s], 1)
        cell = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        is_repeated = np.median(np.bincount(cell)) >= 2
        mean = _one_hot(cell) if is_repeated else np.hstack([self.factors["angle"], self.factors["exposure"]])
        slow = np.zeros((self.frames, 0))
        if self.design.has_order and self.frames - np.linalg.matrix_rank(mean) > LEAST_FREE:
            slow = self.factors["order"][:, :2]
        zero = np.zeros_like(mean)
        return np.block([[mean, zero, slow], [zero, mean, np.zeros_like(slow)]])

    @property
    def can_estimate(self) -> bool:
        """Whether repeated cells leave enough degrees of freedom for variance components."""
        return 2 * self.frames - np.linalg.matrix_rank(self.saturated_mean) >= LEAST_FREE

    def all_components(self) -> dict[str, np.ndarray]:
        """Return the covariance [2F, 2F] of each component at a variance of 1."""
        site = _one_hot(self.design.site)
        same_site, identity, zero = site @ site.T, np.eye(self.frames), np.zeros((self.frames, self.frames))
        out = {
            "frame brightness": np.block([[identity, zero], [zero, zero]]),
            "frame width": np.block([[zero, zero], [zero, identity]]),
        }
        if same_site.sum() > self.frames:
            out["site brightness"] = np.block([[same_site, zero], [zero, zero]])
            out["site width"] = np.block([[zero, zero], [zero, same_site]])
        # If errors of the numbers are understated, ln peak and ln σ scatter along their common ridge.
        out["frame noise"] = np.block([[identity, identity], [identity, identity]]) * self.noise
        return out

    def _needed_components(self) -> dict[str, np.ndarray]:
        """Return the components that −2 ln L speaks for; that of the frames' brightness stays, since others that are
        free beside it would halve it by chance."""
        if not self.can_estimate:
            return {}
        kept = self.all_components()
        while True:
            full = fit_reml(self.observations, self.saturated_mean, self.noise, kept).deviance
            gains = {
                name: self.deviance_of({key: kept[key] for key in kept if key != name}) - full
                for name in kept
                if name != "frame brightness"
            }
            least = min(gains, key=lambda name: gains[name], default=None)
            if least is None or gains[least] > COMPONENT_GAIN:
                return kept
            kept.pop(least)

    def deviance_of(self, components: dict[str, np.ndarray]) -> float:
        """Return −2 ln L of the numbers under some components beside the saturated mean."""
        return fit_reml(self.observations, self.saturated_mean, self.noise, components).deviance

    # Fits.

    def fit(self, effects: Sequence[Effect]) -> LawFit:
        """Return the best fit of a set of laws over their variants and starting points; of variants that tie, the
        first."""
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
        replaced = {name for applied in effects for name in applied.effect.replaces}
        names = [("", "peak_dn"), ("", "p2")]
        if self.levels.shape[1] > 1 and "p1" not in replaced:
            names.append(("", "p1"))
        names += [(applied.effect.name, parameter.name) for applied in effects
                  for parameter in applied.effect.parameters_of(applied.variant)]  # fmt: skip
        model = replace(self.forward, law=self._start(), effects=effects)
        if replaced:
            broadening = float(np.exp(np.mean(self.numbers.spots.log_sigma)) - self.forward.baseline.laser_px)
            model = replace(model, law=replace(self._start(), p1=0.0, p2=broadening))
        has_converged = False
        for _ in range(ITERATIONS):
            mean, jacobian = self._linearize(model, names)
            whitened = self.whitening @ jacobian
            step = np.linalg.lstsq(whitened, self.whitening @ (self.observations - mean), rcond=1e-10)[0]
            has_converged = bool(np.sum((whitened @ step) ** 2) < TOLERANCE)
            model = self._descend(model, names, step)
            if has_converged:
                break
        mean, jacobian = self._linearize(model, names)
        residual, whitened = self.observations - mean, self.whitening @ jacobian
        chi2 = self._chi2_of(model)
        covariance = invert_information(whitened.T @ whitened)
        assert model.law is not None
        return LawFit(model.law, model.effects, tuple(names), covariance, chi2, jacobian, residual, has_converged)

    def _descend(self, model: ForwardModel, names: Sequence[tuple[str, str]], step: np.ndarray) -> ForwardModel:
        """Return the model after the largest of a step, its half, its quarter … that does not raise χ², or as it is."""
        chi2 = self._chi2_of(model)
        for halvings in range(MOST_HALVINGS):
            moved = self._move(model, names, step / 2**halvings)
            if self._chi2_of(moved) <= chi2:
                return moved
        return model

    def _chi2_of(self, model: ForwardModel) -> float:
        """Return χ² of the numbers under a model; infinite outside its domain."""
        chi2 = float(np.sum((self.whitening @ (self.observations - self.mean_of(model))) ** 2))
        return chi2 if np.isfinite(chi2) else np.inf

    def _start(self) -> ExposureLaw:
        """Return p1, p2 and the peak from a straight line through the widths."""
        baseline, design = self.forward.baseline, self.design
        broadening = np.exp(self.numbers.spots.log_sigma) - baseline.laser_px
        if self.levels.shape[1] > 1:
            p1, p2 = np.polyfit(np.log(design.exposure_s), broadening, 1)
        else:
            p1, p2 = 0.0, float(np.mean(broadening))
        law = ExposureLaw(float(p1), float(p2), 1.0)
        peak = replace(self.forward, law=law).spot(self.conditions).peak_dn
        return replace(law, peak_dn=float(np.exp(np.mean(self.numbers.spots.log_peak - np.log(np.ravel(peak))))))

    def mean_of(self, model: ForwardModel, conditions: FrameConditions | None = None) -> np.ndarray:
        """Return ln peak, then ln σ_g of all frames under a model with a law [2F]; NaN outside its domain."""
        with np.errstate(all="ignore"):
            spot = model.spot(conditions or self.conditions)
            parts = [
                np.log(np.broadcast_to(part, (self.frames, 1, 1)).ravel()) for part in (spot.peak_dn, spot.sigma_px)
            ]
        return np.concatenate(parts)

    def _linearize(self, model: ForwardModel, names: Sequence[tuple[str, str]]) -> tuple[np.ndarray, np.ndarray]:
        mean = self.mean_of(model)
        columns = []
        for name in names:
            value = _value_of(model, name)
            step = DIFFERENCE * max(abs(value), self._scale_of(model, name))
            columns.append((self.mean_of(_with_value(model, name, value + step)) - mean) / step)
        jacobian = np.stack(columns, 1)
        return np.nan_to_num(mean), np.nan_to_num(jacobian)

    def _scale_of(self, model: ForwardModel, name: tuple[str, str]) -> float:
        if not name[0]:
            return 1.0
        low, high = self._bounds_of(model, name)
        return LEAST_SCALE * (high - low) if np.isfinite(high - low) else 1.0

    def _bounds_of(self, model: ForwardModel, name: tuple[str, str]) -> tuple[float, float]:
        applied = next(applied for applied in model.effects if applied.effect.name == name[0])
        return dict(zip(applied.parameters, applied.effect.bounds(self.scales), strict=True))[name[1]]

    def _move(self, model: ForwardModel, names: Sequence[tuple[str, str]], step: np.ndarray) -> ForwardModel:
        """Return the model after a step, shortened so that no parameter of an effect crosses much of its range."""
        part = 1.0
        for name, change in zip(names, step, strict=True):
            if name[0]:
                low, high = self._bounds_of(model, name)
                if np.isfinite(high - low) and abs(change) > LARGEST_STEP * (high - low):
                    part = min(part, LARGEST_STEP * (high - low) / abs(change))
        for name, change in zip(names, step, strict=True):
            value = _value_of(model, name) + part * change
            if name == ("", "peak_dn"):
                value = _value_of(model, name) * np.exp(np.clip(part * change / _value_of(model, name), -1, 1))
            if name[0]:
                value = float(np.clip(value, *self._bounds_of(model, name)))
            model = _with_value(model, name, float(value))
        return model

    # Selection.

    def select(self, effects: Sequence[Effect]) -> tuple[tuple[Effect, ...], list[tuple[Effect, ...]], dict]:
        """Return the set of laws with the least χ² + MIN_GAIN per law, its rivals, and the fit of each set tried.

        All sets of one and two laws are tried, larger ones as extensions of the best.
        """
        fits: dict[tuple[str, ...], LawFit] = {(): self.fit(())}
        sets: dict[tuple[str, ...], tuple[Effect, ...]] = {(): ()}

        def cost(names: tuple[str, ...]) -> float:
            return fits[names].chi2 + MIN_GAIN * len(names)

        best_of_size: list[tuple[str, ...]] = [()]
        for size in range(1, MOST_LAWS + 1):
            if size <= 2:
                tried = list(itertools.combinations(effects, size))
            else:
                tried = [
                    (*sets[names], effect) for names in best_of_size for effect in effects if effect.name not in names
                ]
            keys = []
            for laws in tried:
                names = tuple(sorted(effect.name for effect in laws))
                keys.append(names)
                if names not in fits:
                    fits[names], sets[names] = self.fit(laws), laws
            best_of_size = sorted(set(keys), key=cost)[:BEAM]
            if not best_of_size or (size > 1 and cost(best_of_size[0]) > min(map(cost, fits))):
                break
        best = min(fits, key=cost)
        limit = fits[best].chi2 + LAW_TIE
        rivals = [sets[names] for names, fit in fits.items()
                  if names != best and len(names) == len(best) and fit.chi2 < limit]  # fmt: skip
        return sets[best], rivals, fits

    def judge(self, applied: AppliedEffect, fit: LawFit, gain: float) -> NamedLaw:
        """Return what speaks for and against one law of a fitted set; `gain` is the drop of χ² by it."""
        rows = [k for k, name in enumerate(fit.names) if name[0] == applied.effect.name]
        weights = self.inverse @ fit.jacobian @ fit.covariance[:, rows[0]]
        dof = self.degrees_of_freedom(weights, fit.covariance[rows[0], rows[0]])
        quantile = float(stats.t.ppf(0.975, dof))
        errors = np.sqrt(np.diag(fit.covariance)[rows])
        intervals = {
            fit.names[k][1]: Interval.around(applied.parameters[fit.names[k][1]], error, quantile)
            for k, error in zip(rows, errors, strict=True)
        }
        distance = applied.values[0] - applied.effect.vanishes_at
        z = float(np.sqrt(max(gain, 0.0)))
        if np.isfinite(distance):
            z = min(z, upper_tail_z(float(stats.t.logsf(abs(distance) / errors[0], dof))))
        reasons = []
        if z < MIN_Z:
            reasons.append("z below the least")
        if is_negligible(applied, self.scales):
            reasons.append("negligible")
        for factor in {FACTORS[need] for need in applied.effect.needs if need in FACTORS}:
            excess, freed = self.lack_of_fit(fit, factor)
            if freed > 0 and excess - freed > max(CELL_SLACK * np.sqrt(2 * freed), CELL_MISFIT * max(gain, 0.0)):
                reasons.append(f"lack of fit over {factor}: {excess:.0f} on {freed}")
        return NamedLaw(applied, intervals, z, gain, tuple(reasons))

    def degrees_of_freedom(self, weights: np.ndarray, variance: float) -> float:
        """Return Satterthwaite's degrees of freedom of a weighted sum of the observations [2F] with a variance, since
        the variance components are estimates."""
        if not self.components:
            return LARGEST_FREEDOM
        gradient = np.array([weights @ matrix @ weights for matrix in self.components.values()])
        spread = float(gradient @ self.variances.covariance @ gradient)
        return float(np.clip(2 * variance**2 / max(spread, 1e-300), LEAST_FREEDOM, LARGEST_FREEDOM))

    def lack_of_fit(self, fit: LawFit, factor: str) -> tuple[float, int]:
        """Return the drop of χ² when the means of a factor's levels are freed, and its degrees of freedom."""
        columns = self.factors[factor]
        zero = np.zeros_like(columns)
        freed = np.block([[columns, zero], [zero, columns]]) if factor == "exposure" else np.block([[columns], [zero]])
        residual = self.whitening @ fit.residual

        def explained(matrix: np.ndarray) -> tuple[float, int]:
            left, singular, _ = np.linalg.svd(self.whitening @ matrix, full_matrices=False)
            used = singular > 1e-9 * singular[0]
            return float(np.sum((left[:, used].T @ residual) ** 2)), int(used.sum())

        with_levels, rank = explained(np.hstack([fit.jacobian, freed]))
        alone, rank_alone = explained(fit.jacobian)
        return with_levels - alone, rank - rank_alone


@dataclass(frozen=True)
class FoundLaws:
    """The best set of laws of some frames."""

    fit: LawFit  # its fit
    laws: tuple[NamedLaw, ...]  # its laws
    rivals: Mapping[tuple[str, ...], float]  # sets that the frames cannot tell from it: how much larger χ² is


def find_laws(search: LawSearch, effects: Sequence[Effect]) -> FoundLaws:
    """Return the best set of laws, and the sets that the frames cannot tell from it."""
    best, rivals, fits = search.select(effects)
    names = tuple(sorted(effect.name for effect in best))
    fit = fits[names]
    laws = []
    for applied in fit.effects:
        rest = tuple(name for name in names if name != applied.effect.name)
        gain = fits[rest].chi2 - fit.chi2 if rest in fits else np.nan
        laws.append(search.judge(applied, fit, gain))
    keys = [tuple(sorted(effect.name for effect in effects)) for effects in rivals]
    return FoundLaws(fit, tuple(laws), {key: fits[key].chi2 - fit.chi2 for key in keys})


def upper_tail_z(log_p: float) -> float:
    """Return the normal z of the logarithm of an upper-tail probability."""
    return float(-special.ndtri_exp(log_p)) if np.isfinite(log_p) and log_p > -690 else 37.0


def _one_hot(values: np.ndarray) -> np.ndarray:
    """Return indicators [frame, level] of the distinct values."""
    return (values[:, None] == np.unique(values)[None]).astype(float)


def _value_of(model: ForwardModel, name: tuple[str, str]) -> float:
    if not name[0]:
        return getattr(model.law, name[1])
    return next(applied for applied in model.effects if applied.effect.name == name[0]).parameters[name[1]]


def _with_value(model: ForwardModel, name: tuple[str, str], value: float) -> ForwardModel:
    if not name[0]:
        assert model.law is not None
        return replace(model, law=replace(model.law, **{name[1]: value}))
    effects = tuple(a.with_value(name[1], value) if a.effect.name == name[0] else a for a in model.effects)
    return replace(model, effects=effects)
