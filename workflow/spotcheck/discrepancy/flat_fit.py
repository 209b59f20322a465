"""Fits of forward models to levels of flats, with the misfit of the levels as scatter.

Published flats often miss any model by more than their errors, which come from the drift between the frames of one
level. The misfit is estimated as variance components (`LevelScatter`), by turns with the fit: an effect that leaves the
misfit where it was gains little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from spotcheck.discrepancy.flat_levels import ExpectedLevels, FlatLevels, expect_levels
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel

# Factor by which K may differ from that of the straight line: where noise hardly shows, a fit would take it anywhere.
GAIN_RANGE = 10.0
# Most rounds of a fit and of its scatter, and most steps of one fit; the same if the fit only ranks candidates. The
# change of −2 ln L that ends the rounds.
EFFORT, RANKING_EFFORT, SETTLED = (8, 40), (2, 8), 0.05
# Relative decrease of χ² that ends a fit; step of differences as a part of a parameter's scale.
TOLERANCE, DIFFERENCE = 1e-5, 1e-3
# Misfit [standard errors] of a point at which a model has no value.
NO_VALUE = 1e6
# Distance in scales of parameters within which a fit that ranks candidates takes derivatives of a known point.
NEARBY = 0.02
# Slope of a reading by the light below which the lamp's scatter does not show.
LEAST_SLOPE = 0.1
# Trials for the error of the converter, in median errors of the means, and largest factor on errors of the variance.
CONVERTER_TRIALS, LARGEST_FACTOR = np.array([0.0, *2.0 ** np.arange(-3, 11, 0.5)]), 1e3


@dataclass(frozen=True)
class LevelScatter:
    """By what the deviations of levels exceed their stated errors."""

    lamp: float = 1.0  # factor on the errors of means; the excess is light, which the variance follows
    converter_dn: float = 0.0  # scatter of means that is no light, the same at all levels [DN]
    variance: float = 1.0  # factor on the errors of variances

    def standardize(self, levels: FlatLevels, slopes: np.ndarray) -> "Standardization":
        """Return the transformation of deviations to unit covariance; `slopes` are `ExpectedLevels.light_slopes`."""
        (mean, variance), (mean_error, variance_error) = slopes, levels.errors
        follows = mean * variance / (mean**2 + LEAST_SLOPE**2)
        lamp_excess = (self.lamp**2 - 1) * mean_error**2
        total = (self.lamp * mean_error) ** 2 + self.converter_dn**2
        share = follows * lamp_excess / total
        given_mean = (self.variance * variance_error) ** 2 + follows**2 * lamp_excess * (1 - lamp_excess / total)
        return Standardization(np.sqrt(np.stack([total, given_mean])), share)


@dataclass(frozen=True)
class Standardization:
    """Transformation of deviations of means and variances to unit covariance."""

    errors: np.ndarray  # of means [DN], and of variances given the means [DN²], [2, level]
    share: np.ndarray  # what a deviation of the mean adds to that of the variance [DN, level]

    def apply(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations […, 2, level] with unit covariance."""
        mean, variance = deviations[..., 0, :], deviations[..., 1, :]
        return np.stack([mean / self.errors[0], (variance - self.share * mean) / self.errors[1]], axis=-2)

    def invert(self, standardized: np.ndarray) -> np.ndarray:
        """Return the deviations of standardized ones [2, level]."""
        mean = self.errors[0] * standardized[0]
        return np.stack([mean, self.errors[1] * standardized[1] + self.share * mean])


@dataclass(frozen=True)
class LevelFit:
    """A model fitted to the levels that are not held out. Parameters are ln R, K and those of the effects."""

    model: ForwardModel  # the fitted model
    names: tuple[tuple[str, str], ...]  # (effect, parameter); effect "" for R and K
    residual: np.ndarray  # values less those expected [2, level]
    jacobian: np.ndarray  # derivatives of the expected values [parameter, 2, level]
    dark_misfit: np.ndarray  # as in `ExpectedLevels` [3]
    dark_jacobian: np.ndarray  # its derivatives [parameter, 3]
    slopes: np.ndarray  # derivatives of mean and variance by the light [2, level]
    scatter: LevelScatter  # misfit beyond the errors
    deviance: float  # −2 ln L of the levels that are not held out, without constants
    has_converged: bool  # whether the last fit has converged and the scatter has settled

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(applied.effect.name for applied in self.model.effects)

    def position(self, effect: str, parameter: str) -> int:
        """Return the number of a parameter."""
        return self.names.index((effect, parameter))


# Scatter


def estimate_scatter(levels: FlatLevels, residual: np.ndarray, slopes: np.ndarray, lost: float) -> LevelScatter:
    """Return the likeliest scatter of residuals [2, level] of the levels that are not held out.

    `lost` is the number of parameters that were fitted to the means, and to the variances. First the likelihood of the
    means gives the scatter of lamp and converter, then that of the variances given the means the factor on theirs.
    """
    searched = ~levels.is_held_out
    free = max(searched.sum() - lost, 1.0)
    error, square = levels.errors[0, searched], residual[0, searched] ** 2
    variance = error**2 + (np.median(error) * CONVERTER_TRIALS[:, None]) ** 2
    factor = np.maximum((square / variance).sum(axis=1, keepdims=True) / free, 1.0)
    variance = factor * variance
    deviance = (square / variance).sum(axis=1) + free * np.log(variance).mean(axis=1)
    best = int(np.argmin(deviance))
    lamp = float(np.sqrt(factor[best, 0]))
    scatter = LevelScatter(lamp, lamp * float(np.median(error)) * float(CONVERTER_TRIALS[best]))
    means = scatter.standardize(levels, slopes)
    deviation = (residual[1] - means.share * residual[0])[searched] ** 2
    stated = levels.errors[1, searched] ** 2
    common = means.errors[1, searched] ** 2 - stated

    def deviance_of(log_factor: float) -> float:
        total = np.exp(2 * log_factor) * stated + common
        return float((deviation / total).sum() + free * np.log(total).mean())

    log_factor = minimize_scalar(deviance_of, bounds=(0.0, np.log(LARGEST_FACTOR)), method="bounded").x
    if deviance_of(0.0) <= deviance_of(log_factor):
        log_factor = 0.0
    return replace(scatter, variance=float(np.exp(log_factor)))


def deviance_of(levels: FlatLevels, fit: LevelFit, which: np.ndarray, most: float = np.inf) -> float:
    """Return −2 ln L of some levels without constants, under the scatter of a fit; each squared deviation counts
    `most` at most."""
    standard = fit.scatter.standardize(levels, fit.slopes)
    squares = np.minimum(standard.apply(fit.residual) ** 2, most)
    return float((squares + 2 * np.log(standard.errors / levels.errors))[:, which].sum())


# Fits


def fit_levels(
    levels: FlatLevels, effects: Sequence[AppliedEffect], near: LevelFit | None = None, *, is_ranking: bool = False
) -> LevelFit:
    """Fit R, K and effects to the levels that are not held out, by turns with the scatter of levels.

    Parameters
    ----------
    levels : FlatLevels
        The levels.
    effects : sequence of AppliedEffect
        Effects with the values from which the fit starts.
    near : LevelFit or None
        Fit from which R, K and the scatter start; None for the declared model.
    is_ranking : bool
        Whether the fit only ranks candidates: fewer rounds and steps are enough.
    """
    rounds, steps = RANKING_EFFORT if is_ranking else EFFORT
    problem = _LevelProblem(levels, replace((near.model if near else levels.declared), effects=tuple(effects)),
                            NEARBY if is_ranking else 0.0)  # fmt: skip
    point, scatter = problem.start, near.scatter if near else LevelScatter()
    fit = problem.fit_at(point, scatter, has_converged=False)
    if near is None:
        fit = problem.with_scatter(fit)
    for _ in range(rounds):
        point, has_converged = problem.solve(point, fit.scatter.standardize(levels, fit.slopes), steps)
        before, fit = fit.deviance, problem.with_scatter(problem.fit_at(point, fit.scatter, has_converged))
        if abs(before - fit.deviance) < SETTLED:
            return fit
    return replace(fit, has_converged=False)


class _LevelProblem:
    """Least squares of a model with effects; a point holds ln R, K and the parameters of the effects."""

    def __init__(self, levels: FlatLevels, model: ForwardModel, nearby: float) -> None:
        self.levels, self.model, self.searched, self.nearby = levels, model, ~levels.is_held_out, nearby
        gain, law = levels.declared.sensor.gain_dn_per_e, model.law
        assert law is not None
        names, start = [("", "log_light"), ("", "gain_dn_per_e")], [np.log(law.peak_dn), model.sensor.gain_dn_per_e]
        bounds, scales = [(-np.inf, np.inf), (gain / GAIN_RANGE, gain * GAIN_RANGE)], [1.0, gain]
        for applied in model.effects:
            starts = dict(
                zip(applied.parameters, np.abs(applied.effect.starts(levels.scales)).max(axis=0), strict=True)
            )
            limits = dict(zip(applied.parameters, applied.effect.bounds(levels.scales), strict=True))
            for parameter in applied.effect.parameters_of(applied.variant):
                names.append((applied.effect.name, parameter.name))
                start.append(applied.parameters[parameter.name])
                bounds.append(tuple(limits[parameter.name]))
                scales.append(starts[parameter.name])
        self.names, self.scales = tuple(names), np.array(scales)
        self.low, self.high = np.array(bounds).T
        self.start = np.clip(start, self.low, self.high)
        self.expected: dict[bytes, ExpectedLevels] = {}
        self.derivatives: list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]] = []

    def model_at(self, point: np.ndarray) -> ForwardModel:
        """Return the model of a point."""
        assert self.model.law is not None
        values = dict(zip(self.names, map(float, point), strict=True))
        effects = []
        for applied in self.model.effects:
            for parameter in applied.effect.parameters_of(applied.variant):
                applied = applied.with_value(parameter.name, values[applied.effect.name, parameter.name])
            effects.append(applied)
        law = replace(self.model.law, peak_dn=float(np.exp(values["", "log_light"])))
        sensor = replace(self.model.sensor, gain_dn_per_e=values["", "gain_dn_per_e"])
        return replace(self.model, law=law, sensor=sensor, effects=tuple(effects))

    def expect(self, point: np.ndarray) -> ExpectedLevels:
        """Return what the model of a point reads."""
        key = point.tobytes()
        if key not in self.expected:
            self.expected[key] = expect_levels(self.levels, self.model_at(point))
        return self.expected[key]

    def differentiate(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the expected values [parameter, 2, level] and of the darks' misfit [parameter, 3]:
        by ln R through the slopes of readings, by others as differences. They are those of a nearby point if known."""
        scales = np.maximum(self.scales, np.abs(point))
        for other, known in self.derivatives:
            if np.max(np.abs(point - other) / scales) <= self.nearby:
                return known
        at = self.expect(point)
        values, darks = [at.light_slopes * at.lamp_dn], [np.zeros(3)]
        for k in range(1, len(point)):
            step = DIFFERENCE * max(self.scales[k], abs(point[k]))
            step = step if point[k] + step <= self.high[k] else -step
            moved = point.copy()
            moved[k] += step
            moved_at = self.expect(moved)
            values.append((moved_at.values - at.values) / step)
            darks.append((moved_at.dark_misfit - at.dark_misfit) / step)
        self.derivatives.insert(0, (point, (np.array(values), np.array(darks))))
        return self.derivatives[0][1]

    def solve(self, point: np.ndarray, standard: Standardization, steps: int) -> tuple[np.ndarray, bool]:
        """Return the point of least squares under a standardization, and whether its fit has converged."""

        def residuals(point: np.ndarray) -> np.ndarray:
            at = self.expect(point)
            misfit = standardize_data(self.levels, standard, at.values - self.levels.values, at.dark_misfit)
            # A point at which an effect has no value is refused by its size.
            return np.nan_to_num(misfit, nan=NO_VALUE, posinf=NO_VALUE, neginf=-NO_VALUE)

        def jacobian(point: np.ndarray) -> np.ndarray:
            return standardize_data(self.levels, standard, *self.differentiate(point)).T

        fit = least_squares(residuals, point, jacobian, (self.low, self.high), x_scale=self.scales, ftol=TOLERANCE,
                            xtol=TOLERANCE, gtol=None, max_nfev=steps)  # fmt: skip
        return fit.x, fit.status > 0

    def fit_at(self, point: np.ndarray, scatter: LevelScatter, has_converged: bool) -> LevelFit:
        """Return the fit of a point under a scatter."""
        at = self.expect(point)
        values, darks = self.differentiate(point)
        fit = LevelFit(
            self.model_at(point), self.names, self.levels.values - at.values, values, at.dark_misfit, darks,
            at.light_slopes, scatter, 0.0, has_converged,
        )  # fmt: skip
        return self.with_deviance(fit)

    def with_scatter(self, fit: LevelFit) -> LevelFit:
        """Return a fit with the scatter of its residuals."""
        scatter = estimate_scatter(self.levels, fit.residual, fit.slopes, len(self.names) / 2)
        return self.with_deviance(replace(fit, scatter=scatter))

    def with_deviance(self, fit: LevelFit) -> LevelFit:
        """Return a fit with its −2 ln L."""
        deviance = deviance_of(self.levels, fit, self.searched) + float(fit.dark_misfit @ fit.dark_misfit)
        return replace(fit, deviance=deviance)


def standardize_data(
    levels: FlatLevels, standard: Standardization, deviations: np.ndarray, dark: np.ndarray
) -> np.ndarray:
    """Return standardized deviations […, datum]: of the means, then of the variances of all levels that are not held
    out, from deviations […, 2, level], then of the darks […, 3]."""
    whitened = standard.apply(deviations)[..., ~levels.is_held_out]
    return np.concatenate([whitened.reshape(*whitened.shape[:-2], -1), dark], axis=-1)


def standardized_jacobian(levels: FlatLevels, fit: LevelFit, standard: Standardization) -> np.ndarray:
    """Return the derivatives of the standardized data of a fit by the parameters [parameter, datum]."""
    return standardize_data(levels, standard, fit.jacobian, fit.dark_jacobian)


def standardized_residual(levels: FlatLevels, fit: LevelFit, standard: Standardization) -> np.ndarray:
    """Return the standardized residuals of a fit [datum]."""
    return standardize_data(levels, standard, fit.residual, -fit.dark_misfit)


def estimate_covariance(levels: FlatLevels, fit: LevelFit) -> np.ndarray:
    """Return the covariance of the parameters; infinite variance for those on which the levels carry no information."""
    rows = standardized_jacobian(levels, fit, fit.scatter.standardize(levels, fit.slopes))
    covariance = invert_information(rows @ rows.T)
    unknown = np.sum(rows**2, axis=1) <= 0
    covariance[unknown, unknown] = np.inf
    return covariance
