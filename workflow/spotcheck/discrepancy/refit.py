"""Joint refits: the base model's own parameters together with any effects, on the cells.

What is minimised is −2 ln L of independent normal cell means, with the variance that the model itself predicts. Every
derivative is a difference of the one forward model.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.cells import Cells, Setting, pooled
from spotcheck.discrepancy.pixels import CERTAIN
from spotcheck.model.chain import Free, Law, Moments, View, bounds_context, granular_variance, light, moments
from spotcheck.model.effect import Context, Effect, Present

ITERATIONS = 25
# Converged when −2 ln L can fall no further than this.
ENOUGH = 0.02
# Every so many steps all slopes are taken anew.
RENEWED = 4
# A step that closes less than this part of the distance to a better fit will not get there.
CREEP = 0.03
# Relative steps of the differences.
TINY = 1e-5
# Peak [DN] of a spot that is free, least and most, and its least width [px].
LEAST_DN, MOST_DN, LEAST_PX = 1e-3, 1e8, 0.2
NO_WAVE = np.zeros((0, 2))


class Latent(NamedTuple):
    """Free numbers that random effects bring: a gain of every condition, a centre of every condition; and the relative
    variance a cell mean has on top (speckle, pixel gains), as (µ² × this). `scatter` is the variance of each gain about
    1 (infinite: not known), which keeps a law of the brightness from hiding in them. `known` is the whole variance of
    each cell mean [DN²], where it is not to follow the model of a fit."""

    gain: bool = False
    centre: bool = False
    scatter: np.ndarray | float = np.inf
    relative: np.ndarray | float = 0.0
    absolute: np.ndarray | float = 0.0
    known: np.ndarray | None = None


NOTHING = Latent()


class Told(NamedTuple):
    """What something beside the cells tells of an effect's parameters: place of the effect in `present`, the values of
    those that its form has, and their information (inverse of the covariance)."""

    effect: int
    values: np.ndarray
    information: np.ndarray


class Model(NamedTuple):
    """Effects with their values, the base, and the centres' shifts [place, (x, y)] in px (by condition with a latent
    centre); gains [condition] of a latent brightness; amplitudes [place, (cos, sin)] of fringes whose phase is free."""

    present: tuple[Present, ...]
    base: Law | Free
    shift: np.ndarray
    gain: np.ndarray
    wave: np.ndarray


class Refit(NamedTuple):
    """A model at its optimum: −2 ln L over a constant, χ², the covariance of its parameters (effects' first, as listed,
    then p1, p2, peak), residual [condition, row, column] in DN, and the variance of each [DN²]."""

    model: Model
    score: float
    chi2: float
    covariance: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    moments: Moments
    freedom: int


def plain(cells: Cells) -> Model:
    """The base model as it was measured."""
    return Model((), cells.base, np.zeros((int(cells.place.max()) + 1, 2)), np.ones(len(cells.place)), NO_WAVE)


class Problem:
    """The data of one fit with what has been evaluated at the base point.

    Where the data are an expectation, `scatter` [DN²] is the variance that they lack.
    """

    def __init__(
        self,
        cells: Cells,
        setting: Setting,
        start: Model | None = None,
        mask: np.ndarray | None = None,
        scatter: np.ndarray | float = 0.0,
    ):
        self.cells, self.setting = cells, setting
        self.scatter = np.broadcast_to(scatter, cells.pixels.shape)
        self.used = cells.pixels > 0 if mask is None else mask & (cells.pixels > 0)
        self.start = start or plain(cells)
        self.at_start = self.evaluate(self.start)
        self.mean_start = pooled(self.at_start.mean)
        self.variance_start = pooled(self.at_start.variance)
        self.context = self._context()

    def evaluate(self, model: Model) -> Moments:
        """Moments at the points of every cell."""
        view = self._view(model)
        base = model.base
        if np.any(model.gain != 1):
            gain = model.gain[:, None, None]
            # A gain acts on the peak of every view; the law's own peak is one number.
            return moments(view, self.setting.baseline, base, model.present, self.setting.sensor, gain)
        return moments(view, self.setting.baseline, base, model.present, self.setting.sensor)

    def light(self, model: Model) -> np.ndarray:
        """Light [DN] of every cell, which black and full scale do not cut."""
        own, beside = light(
            self._view(model), self.setting.baseline, model.base, model.present, model.gain[:, None, None]
        )
        return pooled(own + beside)

    def granular(self, model: Model) -> np.ndarray:
        """Variance [DN²] of pixels from grain to grain, mean over every cell."""
        own = granular_variance(
            self._view(model), self.setting.baseline, model.base, model.present, self.setting.sensor
        )
        return pooled(own)

    def _view(self, model: Model) -> View:
        """The cells' view with the model's centres and waves."""
        view = self.cells.view
        where = self.cells.place if len(model.shift) == int(self.cells.place.max()) + 1 else slice(None)
        shift = model.shift[where]
        view = view._replace(x0=view.x0 + shift[:, 0, None, None], y0=view.y0 + shift[:, 1, None, None])
        if len(model.wave):
            wave = model.wave[self.cells.place]
            view = view._replace(wave_cos=wave[:, 0, None, None], wave_sin=wave[:, 1, None, None])
        return view

    def residual(self, at: Moments) -> np.ndarray:
        """Residual of each cell from the model [DN]: measured at the base, minus the model's change."""
        return self.cells.residual - (pooled(at.mean) - self.mean_start)

    def variance(self, at: Moments, latent: Latent) -> np.ndarray:
        """Variance of each cell mean [DN²]: the base's own, scaled by the model's change of the noise.

        Where a level stops noise and all, readings repeat one number: more certain than `CERTAIN` they do not count.
        """
        if latent.known is not None:
            return latent.known
        out = self.cells.variance * (np.maximum(pooled(at.variance), CERTAIN) / self.variance_start)
        light = pooled(at.mean) - self.setting.sensor.black_level_dn
        return out + latent.relative * light**2 + latent.absolute

    def _context(self) -> Context:
        view = self.cells.view
        crop = float(view.x.shape[-1] * view.rows_each)
        shortest = float(view.exposure_s.min())
        return bounds_context(self.cells.base, self.setting.baseline, self.setting.sensor, crop, shortest,
                              view.longest_s, view.reference_s)  # fmt: skip


def refit(
    problem: Problem,
    effects: Sequence[tuple[Effect, str]],
    start: Model,
    latent: Latent = NOTHING,
    target: float = np.inf,
    fixed: bool = False,
    told: Sequence[Told] = (),
) -> Refit:
    """Fit effects (with their forms) from `start`, whose `present` holds their first values, by damped Gauss–Newton.

    With `fixed` effects and law keep their values, and only what no frame can foretell is fitted: centres, and what is
    free in every frame or random. A fit that creeps far above `target`, the
    −2 ln L of a better one, is given up. What is `told` pulls, but is no part of the score that comes back.
    """
    chart = _Chart(problem, effects, start, latent, fixed)
    point = chart.point(start)
    at = problem.evaluate(chart.model(point))
    variance = problem.variance(at, latent)
    known, information = chart.told(() if fixed else told)

    def strain(at: np.ndarray) -> float:
        return float((at - known) @ information @ (at - known))

    value = _score(problem, problem.residual(at), variance) + strain(point)
    damping = 1e-3
    matrix = np.eye(len(point))
    used = problem.used
    raw = None
    for iteration in range(ITERATIONS):
        # The base's own slopes hardly change from step to step; an effect's may.
        current = raw is None or iteration % RENEWED == 0
        raw = chart.slopes(point, at, None if current else raw)
        weight = np.sqrt(1 / variance[used])
        slopes = raw[:, used] * weight
        rest = problem.residual(at)[used] * weight
        matrix, pull = slopes @ slopes.T + information, slopes @ rest + information @ (known - point)
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        normal, force = matrix / np.outer(scale, scale), pull / scale
        better = False
        for _ in range(8):
            damped = normal + damping * np.eye(len(force))
            # What nothing seen depends on stays where it is.
            step = np.zeros_like(point)
            free = np.diag(matrix) > 0
            step[free] = _solved(damped, force, free) / scale[free]
            trial = chart.bounded(point + step)
            held = (trial == point) & (step != 0)
            if held.any():
                # What lies at a bound stays there, and the others go where they would without it.
                step[held] = 0.0
                free &= ~held
                step[free] = _solved(damped, force, free) / scale[free]
                trial = chart.bounded(point + step)
            at_trial = problem.evaluate(chart.model(trial))
            variance_trial = problem.variance(at_trial, latent)
            fresh = _score(problem, problem.residual(at_trial), variance_trial) + strain(trial)
            if np.isfinite(fresh) and fresh <= value:
                better = True
                break
            damping = max(damping * 6, 1e-3)
        if not better:
            if current:
                break
            # Far from where they were taken, slopes lead nowhere.
            raw, damping = None, 1e-3
            continue
        gain, value = value - fresh, fresh
        point, at, variance = trial, at_trial, variance_trial
        damping = max(damping / 8, 1e-9)
        if gain < max(ENOUGH, CREEP * (value - target)):
            break
    model = chart.model(point)
    residual = problem.residual(at)
    chi2 = float(np.sum((residual**2 / variance)[problem.used]))
    score = value - strain(point)
    return Refit(model, score, chi2, _inverse(matrix), residual, variance, at, len(point))


def _solved(matrix: np.ndarray, force: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The free ones of the numbers that a matrix takes to a force."""
    return np.linalg.lstsq(matrix[np.ix_(free, free)], force[free], rcond=1e-12)[0]


def basis(problem: Problem, fit: Refit, effects: Sequence[tuple[Effect, str]], latent: Latent = NOTHING) -> np.ndarray:
    """Orthonormal directions [direction, used cell], in standard deviations, that the fit's own numbers span."""
    chart = _Chart(problem, effects, fit.model, latent, False)
    slopes = chart.slopes(chart.point(fit.model), fit.moments)[:, problem.used] / np.sqrt(fit.variance[problem.used])
    _, size, right = np.linalg.svd(
        slopes / np.linalg.norm(slopes, axis=1, keepdims=True).clip(1e-300), full_matrices=False
    )
    return right[size > 1e-7 * size[0]]


def screened(problem: Problem, fit: Refit, span: np.ndarray, effect: Effect, form: str) -> list[tuple[float, tuple]]:
    """Starts of an effect with the fall of χ² that each promises, to first order and beside the fit's own numbers; best
    first."""
    rest = (fit.residual / np.sqrt(fit.variance))[problem.used]
    out = []
    for values in effect.starts(problem.context):
        model = fit.model._replace(present=(*fit.model.present, Present(effect, form, values)))
        change = pooled(problem.evaluate(model).mean - fit.moments.mean)[problem.used]
        change = change / np.sqrt(fit.variance[problem.used])
        change = change - span.T @ (span @ change)
        size = float(change @ change)
        pull = float(change @ rest)
        out.append((pull * pull / size if size > 1e-12 else 0.0, values))
    return sorted(out, key=lambda item: -item[0])


def promised(problem: Problem, fit: Refit, span: np.ndarray, effect: Effect) -> float:
    """The largest fall of χ² that any form and start of an effect promises."""
    return max((own for form in effect.forms for own, _ in screened(problem, fit, span, effect, form)), default=0.0)


def moving(effect: Effect, form: str) -> list[int]:
    """Indices of the parameters that a fit of this form moves; those of a granular field are told by the noise."""
    if effect.component == "grain":
        return []
    idle = effect.idle.get(form, ())
    return [k for k, p in enumerate(effect.parameters) if p.name not in idle]


def _score(problem: Problem, residual: np.ndarray, variance: np.ndarray) -> float:
    used = problem.used
    square = residual[used] ** 2 + problem.scatter[used]
    return float(np.sum(square / variance[used] + np.log(variance[used] / problem.cells.variance[used])))


def _inverse(matrix: np.ndarray) -> np.ndarray:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)


class _Chart:
    """The free numbers of a fit as one vector, and back."""

    def __init__(self, problem: Problem, effects, start: Model, latent: Latent, fixed: bool):
        self.problem, self.latent, self.fixed = problem, latent, fixed
        self.effects, self.start = tuple(effects), start
        self.free = isinstance(start.base, Free)
        cells = problem.cells
        self.conditions = len(cells.place)
        self.by_condition = latent.centre
        self.groups = np.arange(self.conditions) if latent.centre else cells.place
        self.places = int(self.groups.max()) + 1
        replaced = {name for effect, _ in effects for name in effect.replaces}
        one = len(np.unique(cells.view.exposure_s)) == 1
        self.law = (
            []
            if fixed
            else [name for name in ("p1", "p2", "peak") if name not in replaced and not (name == "p1" and one)]
        )
        self.inner = [moving(effect, form) for effect, form in self.effects]
        waves = any(effect.spectral and form == "site" for effect, form in self.effects)
        self.waves = int(cells.place.max()) + 1 if waves else 0
        self.count = 0 if fixed else sum(len(own) for own in self.inner)
        bounds = [
            effect.bounds(problem.context)[own] for (effect, _), own in zip(self.effects, self.inner, strict=True)
        ]
        self.bounds = np.concatenate([np.zeros((0, 2)), *bounds])

    def point(self, model: Model) -> np.ndarray:
        """The vector of a model."""
        own = (
            []
            if self.fixed
            else [p.values[k] for p, moving in zip(model.present, self.inner, strict=True) for k in moving]
        )
        if isinstance(model.base, Free):
            # Where light stops at a level, what is seen follows the logarithm of the peak.
            base = [*np.log(np.maximum(model.base.amplitude.ravel(), LEAST_DN)), *model.base.sigma.ravel()]
        else:
            base = [getattr(model.base, name) for name in self.law]
        shift = model.shift
        if len(shift) != self.places:
            shift = shift[self.problem.cells.place]
        gains: Sequence[float] = model.gain.tolist() if self.latent.gain and not self.free else []
        wave = model.wave if len(model.wave) == self.waves else np.zeros((self.waves, 2))
        return np.array([*own, *base, *shift.ravel(), *gains, *wave.ravel()], float)

    def told(self, told: Sequence[Told]) -> tuple[np.ndarray, np.ndarray]:
        """Values [parameter] that are told, and their information [parameter, parameter] (0: nothing is told)."""
        count = len(self.point(self.start))
        values, information = np.zeros(count), np.zeros((count, count))
        first = np.cumsum([0, *(len(own) for own in self.inner)])
        for own in told:
            at = slice(first[own.effect], first[own.effect + 1])
            values[at], information[at, at] = own.values, own.information
        if self.latent.gain and not self.free:
            gains = np.arange(self.conditions) + count - self.conditions - 2 * self.waves
            values[gains], information[gains, gains] = 1.0, 1 / np.broadcast_to(self.latent.scatter, self.conditions)
        return values, information

    def model(self, point: np.ndarray) -> Model:
        """The model of a vector."""
        at = 0
        present = []
        for (effect, form), moving, before in zip(self.effects, self.inner, self.start.present, strict=True):
            values = list(before.values)
            if not self.fixed:
                for k in moving:
                    values[k] = float(point[at])
                    at += 1
            present.append(Present(effect, form, tuple(values)))
        n = self.conditions
        base: Law | Free
        if isinstance(self.start.base, Free):
            base = Free(np.exp(point[at : at + n])[:, None, None], point[at + n : at + 2 * n][:, None, None])
            at += 2 * n
        else:
            base = self.start.base._replace(**{name: float(v) for name, v in zip(self.law, point[at:], strict=False)})
            at += len(self.law)
        shift = point[at : at + 2 * self.places].reshape(-1, 2)
        at += 2 * self.places
        gain = self.start.gain
        if self.latent.gain and not self.free:
            gain = point[at : at + n]
            at += n
        wave = point[at:].reshape(-1, 2) if self.waves else self.start.wave
        return Model(tuple(present), base, shift, gain, wave)

    def bounded(self, point: np.ndarray) -> np.ndarray:
        """A vector with effects within their bounds and a base that has light and width."""
        out = point.copy()
        out[: self.count] = np.clip(out[: self.count], self.bounds[: self.count, 0], self.bounds[: self.count, 1])
        if self.free:
            middle = self.count + self.conditions
            out[self.count : middle] = np.clip(out[self.count : middle], np.log(LEAST_DN), np.log(MOST_DN))
            out[middle : middle + self.conditions] = np.maximum(out[middle : middle + self.conditions], LEAST_PX)
        return out

    def slopes(self, point: np.ndarray, at: Moments, before: np.ndarray | None = None) -> np.ndarray:
        """∂ cell mean/∂ vector [parameter, condition, row, column]; with those of a step `before`, only the effects'
        own are taken anew."""
        problem, mean = self.problem, at.mean
        out = np.zeros((len(point), *problem.cells.residual.shape)) if before is None else before

        def change(trial: np.ndarray, h: float) -> np.ndarray:
            return pooled(problem.evaluate(self.model(trial)).mean - mean) / h

        shared = self.count + (0 if self.free else len(self.law))
        for k in range(shared if before is None else self.count):
            h = self._step(k, point)
            trial = point.copy()
            trial[k] += h
            out[k] = change(trial, h)
        if before is not None:
            return out
        n, k = self.conditions, shared
        index = np.arange(n)
        # Numbers of a condition or a place act there alone: one evaluation serves all of them.
        if self.free:
            for _ in range(2):
                own = slice(k, k + n)
                h = TINY * np.maximum(np.abs(point[own]), 1e-3)
                trial = point.copy()
                trial[own] += h
                out[k + index, index] = change(trial, 1.0) / h[:, None, None]
                k += n
        for axis in range(2):
            trial = point.copy()
            trial[k + axis : k + 2 * self.places : 2] += 1e-3
            slope = change(trial, 1e-3)
            out[k + axis + 2 * self.groups, index] = slope
        k += 2 * self.places
        if self.latent.gain and not self.free:
            trial = point.copy()
            trial[k : k + n] += 1e-5
            out[k + index, index] = change(trial, 1e-5)
            k += n
        for axis in range(2 if self.waves else 0):
            trial = point.copy()
            trial[k + axis : k + 2 * self.waves : 2] += 1e-5
            out[k + axis + 2 * problem.cells.place, index] = change(trial, 1e-5)
        return out

    def _step(self, k: int, point: np.ndarray) -> float:
        if k >= self.count:
            return TINY * max(abs(point[k]), 1e-3)
        low, high = self.bounds[k]
        flat = [(e, j) for (e, _), own in zip(self.effects, self.inner, strict=True) for j in own]
        if flat[k][0].parameters[flat[k][1]].unit == "deg":
            return 1e-3
        span = min(high - low, max(abs(point[k]), 1e-3 * min(high - low, 1e6)))
        h = 1e-4 * span
        return -h if point[k] + h > high else h
