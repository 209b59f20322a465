"""Fits of forward models to levels of flats, with a scatter of the levels beyond their stated errors.

A level is a set of flats of the same light. Its data are the mean and the variance in time of a reading, both less
those of darks. K is the gain [DN/e-], R the light of the lamp at the largest level [DN]. Published flats often differ
from any model by more than their stated errors, which come from the drift between the frames of one level. This scatter
is estimated as variance components (`LevelScatter`), in turn with the parameters. An effect that does not reduce the
scatter then gains little likelihood. `FlatLevels` has the data (`values`), their stated `errors`, and whether a level
`is_held_out` from fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from spotcheck.discrepancy.flat_levels import ExpectedLevels, FlatLevels, expect_levels
from spotcheck.discrepancy.normal_equations import invert_information
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.forward import ForwardModel

# Largest factor between K and its value from the straight line, since levels with little noise hardly determine K.
GAIN_RANGE = 10.0
# (most rounds of parameters and scatter, most steps of a fit of the parameters): for a final fit, and for one that only
# ranks candidates. Change of −2 ln L below which the rounds end.
EFFORT, RANKING_EFFORT, SETTLED = (8, 40), (2, 8), 0.05
# Relative decrease of χ² that ends a fit; step of differences as a part of a parameter's scale.
TOLERANCE, DIFFERENCE = 1e-5, 1e-3
# Residual [standard errors] at a point of parameters at which a model has no value.
NO_VALUE = 1e6
# Distance in scales of parameters within which a fit that ranks candidates reuses derivatives of another point.
NEARBY = 0.02
# Slope of a mean reading by the light far below which the scatter of the lamp does not reach the variance.
LEAST_SLOPE = 0.1
# Trial values of the scatter of the converter, in median errors of the means; largest factor on errors of variances.
CONVERTER_TRIALS, LARGEST_FACTOR = np.array([0.0, *2.0 ** np.arange(-3, 11, 0.5)]), 1e3
# Number of values that compare a model with the darks; see `ExpectedLevels.dark_misfit`.
DARK_VALUES = 3


@dataclass(frozen=True)
class LevelScatter:
    """Variance components by which the deviations of levels exceed their stated errors."""

    lamp: float = 1.0  # factor on the errors of means; the excess is fluctuating light, which also moves the variances
    converter_dn: float = 0.0  # further scatter of means, not by light, the same at all levels [DN]
    variance: float = 1.0  # factor on the errors of variances

    def standardize(self, levels: FlatLevels, slopes: np.ndarray) -> "Standardization":
        """Return the transformation of deviations to unit covariance.

        `slopes` [2, level] are the derivatives of mean and variance by the light (`ExpectedLevels.light_slopes`).
        """
        (mean_slope, variance_slope), (mean_error, variance_error) = slopes, levels.errors
        # Change of the variance with a change of the mean by light, regularized where the mean hardly responds [DN].
        variance_by_mean = mean_slope * variance_slope / (mean_slope**2 + LEAST_SLOPE**2)
        lamp_excess = (self.lamp**2 - 1) * mean_error**2
        mean_variance = (self.lamp * mean_error) ** 2 + self.converter_dn**2
        # Only the excess by the lamp moves the variance as well. Given the mean, its best estimate is taken off
        # (regression), and the part that remains unknown is added to the error of the variance.
        regression = variance_by_mean * lamp_excess / mean_variance
        lamp_variance = variance_by_mean**2 * lamp_excess * (1 - lamp_excess / mean_variance)
        conditional_variance = (self.variance * variance_error) ** 2 + lamp_variance
        return Standardization(np.sqrt(np.stack([mean_variance, conditional_variance])), regression)


@dataclass(frozen=True)
class Standardization:
    """Transformation of deviations of means and variances to unit covariance."""

    errors: np.ndarray  # errors of means [DN], and of variances at a given mean [DN²], [2, level]
    regression: np.ndarray  # expected deviation of the variance per deviation of the mean [level, DN]

    def apply(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations […, 2, level] of means [DN] and variances [DN²], transformed to unit covariance.

        The deviation of a variance that its mean lets expect is subtracted first.
        """
        mean, variance = deviations[..., 0, :], deviations[..., 1, :]
        return np.stack([mean / self.errors[0], (variance - self.regression * mean) / self.errors[1]], axis=-2)

    def invert(self, standardized: np.ndarray) -> np.ndarray:
        """Return the deviations [2, level] in DN and DN² of standardized ones [2, level]."""
        mean = self.errors[0] * standardized[0]
        return np.stack([mean, self.errors[1] * standardized[1] + self.regression * mean])


@dataclass(frozen=True)
class LevelFit:
    """A model fitted to the levels that are not held out. Parameters are ln R, K and those of the effects."""

    model: ForwardModel  # the fitted model
    names: tuple[tuple[str, str], ...]  # (effect, parameter) of each parameter; the effect is "" for ln R and K
    residual: np.ndarray  # measured less expected means [DN] and variances [DN²], of all levels [2, level]
    jacobian: np.ndarray  # derivatives of the expected values by the parameters [parameter, 2, level]
    dark_misfit: np.ndarray  # difference of model and darks in standard errors, as in `ExpectedLevels` [3]
    dark_jacobian: np.ndarray  # derivatives of it by the parameters [parameter, 3]
    slopes: np.ndarray  # derivatives of mean and variance by the light [2, level]
    scatter: LevelScatter  # scatter beyond the stated errors
    deviance: float  # −2 ln L of the levels that are not held out, and of the darks, without constants
    has_converged: bool  # whether parameters and scatter have converged

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(applied.effect.name for applied in self.model.effects)

    def applied(self, name: str) -> AppliedEffect:
        """Return the effect of a name with its fitted values."""
        return next(applied for applied in self.model.effects if applied.effect.name == name)

    def position(self, effect: str, parameter: str) -> int:
        """Return the position of a parameter in `names`."""
        return self.names.index((effect, parameter))


# Scatter


def estimate_scatter(levels: FlatLevels, residual: np.ndarray, slopes: np.ndarray, lost: float) -> LevelScatter:
    """Return the most likely scatter of the residuals of the levels that are not held out.

    The scatter of lamp and converter comes first, from the likelihood of the means. The factor on the errors of the
    variances follows, from the likelihood of the variances at given means.

    Parameters
    ----------
    levels : FlatLevels
        All levels.
    residual : array [2, level]
        Measured less expected means [DN] and variances [DN²].
    slopes : array [2, level]
        Derivatives of mean and variance by the light.
    lost : float
        Degrees of freedom that the fit took from the means, and as many from the variances.
    """
    is_searched = ~levels.is_held_out
    freedom = max(is_searched.sum() - lost, 1.0)
    error, square = levels.errors[0, is_searched], residual[0, is_searched] ** 2
    # One row for each trial of the converter; the factor on its variances is then the best one, at least 1.
    variance = error**2 + (np.median(error) * CONVERTER_TRIALS[:, None]) ** 2
    factor = np.maximum((square / variance).sum(axis=1, keepdims=True) / freedom, 1.0)
    variance = factor * variance
    # −2 ln L of the means with as many independent values as degrees of freedom.
    deviance = (square / variance).sum(axis=1) + freedom * np.log(variance).mean(axis=1)
    best = int(np.argmin(deviance))
    lamp = float(np.sqrt(factor[best, 0]))
    scatter = LevelScatter(lamp, lamp * float(np.median(error)) * float(CONVERTER_TRIALS[best]))
    standardization = scatter.standardize(levels, slopes)
    square = (residual[1] - standardization.regression * residual[0])[is_searched] ** 2
    stated_variance = levels.errors[1, is_searched] ** 2
    lamp_variance = standardization.errors[1, is_searched] ** 2 - stated_variance

    def variance_deviance(log_factor: float) -> float:
        """Return −2 ln L of the variances with a factor on their errors."""
        total = np.exp(2 * log_factor) * stated_variance + lamp_variance
        return float((square / total).sum() + freedom * np.log(total).mean())

    log_factor = minimize_scalar(variance_deviance, bounds=(0.0, np.log(LARGEST_FACTOR)), method="bounded").x
    # The bounded search never tries its end, a factor of 1.
    if variance_deviance(0.0) <= variance_deviance(log_factor):
        log_factor = 0.0
    return replace(scatter, variance=float(np.exp(log_factor)))


def deviance_of(levels: FlatLevels, fit: LevelFit, is_counted: np.ndarray, most: float = np.inf) -> float:
    """Return −2 ln L of the levels that are counted [level], without constants, under the scatter of a fit.

    Each squared standardized residual is limited to `most`.
    """
    standardization = fit.scatter.standardize(levels, fit.slopes)
    squares = np.minimum(standardization.apply(fit.residual) ** 2, most)
    return float((squares + 2 * np.log(standardization.errors / levels.errors))[:, is_counted].sum())


# Fits


def fit_levels(
    levels: FlatLevels, effects: Sequence[AppliedEffect], near: LevelFit | None = None, *, is_ranking: bool = False
) -> LevelFit:
    """Fit R, K and effects to the levels that are not held out, in turn with the scatter of the levels.

    Parameters
    ----------
    levels : FlatLevels
        All levels.
    effects : sequence of AppliedEffect
        Effects with the values from which the fit starts.
    near : LevelFit or None
        Fit from which R, K and the scatter start; None for the declared model and the scatter about it.
    is_ranking : bool
        Whether the fit only ranks candidates, for which fewer rounds and steps are enough.
    """
    rounds, steps = RANKING_EFFORT if is_ranking else EFFORT
    model = replace(near.model if near else levels.declared, effects=tuple(effects))
    problem = _LevelProblem(levels, model, nearby=NEARBY if is_ranking else 0.0)
    point = problem.start
    fit = problem.fit_at(point, near.scatter if near else None, has_converged=False)
    for _ in range(rounds):
        point, has_converged = problem.solve(point, fit.scatter.standardize(levels, fit.slopes), steps)
        before, fit = fit.deviance, problem.fit_at(point, None, has_converged)
        if abs(before - fit.deviance) < SETTLED:
            return fit
    return replace(fit, has_converged=False)


class _LevelProblem:
    """Least-squares problem of a model with effects.

    A point is a vector of ln R, K and the parameters of the effects [parameter]. `model` gives its `start`. `names` are
    (effect, parameter), `scales` typical sizes of the parameters, `low` and `high` their bounds. Derivatives are reused
    at points within `nearby`, a distance in scales of the parameters.
    """

    def __init__(self, levels: FlatLevels, model: ForwardModel, nearby: float) -> None:
        """Collect names, start, scales and bounds of the parameters: ln R, K, then those of the effects in order."""
        self.levels, self.model, self.nearby = levels, model, nearby
        gain, law = levels.declared.sensor.gain_dn_per_e, model.law
        assert law is not None
        names, start = [("", "log_light"), ("", "gain_dn_per_e")], [np.log(law.peak_dn), model.sensor.gain_dn_per_e]
        bounds, scales = [(-np.inf, np.inf), (gain / GAIN_RANGE, gain * GAIN_RANGE)], [1.0, gain]
        for applied in model.effects:
            # The largest starting value of a parameter is its scale.
            largest_starts = np.abs(applied.effect.starts(levels.scales)).max(axis=0)
            scale_of = dict(zip(applied.parameters, largest_starts, strict=True))
            bounds_of = dict(zip(applied.parameters, applied.effect.bounds(levels.scales), strict=True))
            for parameter in applied.effect.parameters_of(applied.variant):
                names.append((applied.effect.name, parameter.name))
                start.append(applied.parameters[parameter.name])
                bounds.append(tuple(bounds_of[parameter.name]))
                scales.append(scale_of[parameter.name])
        self.names, self.scales = tuple(names), np.array(scales)
        self.low, self.high = np.array(bounds).T
        self.start = np.clip(start, self.low, self.high)
        # Results that were computed before: expected levels by the bytes of a point; (point, derivatives there).
        self.expected: dict[bytes, ExpectedLevels] = {}
        self.derivatives: list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]] = []

    def model_at(self, point: np.ndarray) -> ForwardModel:
        """Return the model with the parameters of a point."""
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
        """Return the levels that the model of a point predicts."""
        key = point.tobytes()
        if key not in self.expected:
            self.expected[key] = expect_levels(self.levels, self.model_at(point))
        return self.expected[key]

    def differentiate(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the expected values [parameter, 2, level] and of the dark misfit [parameter, 3].

        The derivative by ln R follows from the slopes by the light; the others are forward differences, which point
        inwards at an upper bound.
        """
        scales = np.maximum(self.scales, np.abs(point))
        for other, derivatives in self.derivatives:
            if np.max(np.abs(point - other) / scales) <= self.nearby:
                return derivatives
        expected = self.expect(point)
        values, darks = [expected.light_slopes * expected.lamp_dn], [np.zeros(DARK_VALUES)]
        for k in range(1, len(point)):
            step = DIFFERENCE * max(self.scales[k], abs(point[k]))
            step = step if point[k] + step <= self.high[k] else -step
            moved = point.copy()
            moved[k] += step
            changed = self.expect(moved)
            values.append((changed.values - expected.values) / step)
            darks.append((changed.dark_misfit - expected.dark_misfit) / step)
        self.derivatives.insert(0, (point, (np.array(values), np.array(darks))))
        return self.derivatives[0][1]

    def solve(self, point: np.ndarray, standardization: Standardization, steps: int) -> tuple[np.ndarray, bool]:
        """Return the point of least squares, started from a point, and whether the fit has converged."""

        def residuals(point: np.ndarray) -> np.ndarray:
            """Return expected less measured data, standardized [datum]."""
            expected = self.expect(point)
            deviations = expected.values - self.levels.values
            misfit = standardize_data(self.levels, standardization, deviations, expected.dark_misfit)
            # The large residual makes the fit reject a point at which an effect has no value.
            return np.nan_to_num(misfit, nan=NO_VALUE, posinf=NO_VALUE, neginf=-NO_VALUE)

        def jacobian(point: np.ndarray) -> np.ndarray:
            """Return the derivatives of the residuals [datum, parameter]."""
            return standardize_data(self.levels, standardization, *self.differentiate(point)).T

        fit = least_squares(residuals, point, jacobian, (self.low, self.high), x_scale=self.scales, ftol=TOLERANCE,
                            xtol=TOLERANCE, gtol=None, max_nfev=steps)  # fmt: skip
        return fit.x, fit.status > 0

    def fit_at(self, point: np.ndarray, scatter: LevelScatter | None, has_converged: bool) -> LevelFit:
        """Return the record of a fit that ended at a point; without a scatter (None), it is estimated."""
        expected = self.expect(point)
        jacobian, dark_jacobian = self.differentiate(point)
        residual, slopes = self.levels.values - expected.values, expected.light_slopes
        # Means and variances each lose half of the parameters.
        scatter = scatter or estimate_scatter(self.levels, residual, slopes, len(self.names) / 2)
        fit = LevelFit(
            self.model_at(point), self.names, residual, jacobian, expected.dark_misfit, dark_jacobian, slopes, scatter,
            0.0, has_converged,
        )  # fmt: skip
        deviance = deviance_of(self.levels, fit, ~self.levels.is_held_out) + float(fit.dark_misfit @ fit.dark_misfit)
        return replace(fit, deviance=deviance)


def standardize_data(
    levels: FlatLevels, standardization: Standardization, deviations: np.ndarray, dark: np.ndarray
) -> np.ndarray:
    """Return all data of a fit as one vector of standardized deviations […, datum].

    First come the means, then the variances of all levels that are not held out, from `deviations` […, 2, level]. The
    darks follow, from `dark` […, 3], which is standardized already.
    """
    whitened = standardization.apply(deviations)[..., ~levels.is_held_out]
    return np.concatenate([whitened.reshape(*whitened.shape[:-2], -1), dark], axis=-1)


def standardized_jacobian(levels: FlatLevels, fit: LevelFit, standardization: Standardization) -> np.ndarray:
    """Return the derivatives of the standardized data of a fit by the parameters [parameter, datum]."""
    return standardize_data(levels, standardization, fit.jacobian, fit.dark_jacobian)


def standardized_residual(levels: FlatLevels, fit: LevelFit, standardization: Standardization) -> np.ndarray:
    """Return the standardized residuals of a fit, measured less expected [datum]."""
    return standardize_data(levels, standardization, fit.residual, -fit.dark_misfit)


def estimate_covariance(levels: FlatLevels, fit: LevelFit) -> np.ndarray:
    """Return the covariance of the parameters of a fit [parameter, parameter].

    The variance of a parameter on which the levels carry no information is infinite.
    """
    rows = standardized_jacobian(levels, fit, fit.scatter.standardize(levels, fit.slopes))
    covariance = invert_information(rows @ rows.T)
    is_unknown = np.sum(rows**2, axis=1) <= 0
    covariance[is_unknown, is_unknown] = np.inf
    return covariance
