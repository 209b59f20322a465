"""Models of the frames' brightness and width, fitted: the laws of the chain, and scatter of sites and frames.

ln peak and ln σ_g of each frame are those of the chain's `spot_state`, so an effect that acts on exposure, width or
brightness counts by what it does. What all frames' ln peak have in common is the light's own.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.evidence import components as mixed
from spotcheck.discrepancy.evidence.components import Component, Estimated
from spotcheck.discrepancy.evidence.influence import FrameNumbers
from spotcheck.discrepancy.nuisance.fit import Free, changed, free_of, values_of
from spotcheck.discrepancy.observe.design import Design, view_of
from spotcheck.discrepancy.observe.pixels import Model, Numbers
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Law, View, bounds_context, spot_state
from spotcheck.model.effect import Context, Place, Present
from spotcheck.model.sensor import SensorModel

# Places of effects that act on a frame's brightness and width alone.
PLACES = (Place.EXPOSURE, Place.WIDTH, Place.BRIGHTNESS)
# Standard error of what all frames' ln σ_g have in common: the learned shape may be wider or narrower than the declared
# one by some tenth, and only the declared one's width is the law's.
COMMON_WIDTH = 0.1
# Steps of a fit to the laws; it ends where a step gains less than ENOUGH in −2 ln L, or its damping passes STIFF.
STEPS, ENOUGH, STIFF = 40, 1e-5, 1e8
# Rounds of fitting laws and components in turn, and the gain in −2 ln L that ends them.
ROUNDS, SETTLED = 8, 1e-3
# A variance [1] of ln peak or ln σ_g beside which nothing else counts: where fits begin, once with either set aside.
LOOSE = 1.0
# Fits whose rows differ by less than this [χ²] are one.
SAME = 1.0
# Relative step of slopes by p1 and by the reference width, of the latter.
NUDGE = 1e-3


class Rows(NamedTuple):
    """What is fitted [row]: steps between the frames' ln peak, steps between their ln σ_g, and their mean ln σ_g; known
    covariance, components, rows from numbers [row, 2 × frame] (ln peak of all frames, then ln σ_g), and the part that
    each cell of the spot brings [row, cell]."""

    values: np.ndarray
    known: np.ndarray
    components: tuple[Component, ...]
    lift: np.ndarray
    influence: np.ndarray


class Problem(NamedTuple):
    """Rows, design and view of the frames, the model with the effects that act on brightness and width, and what bounds
    depend on."""

    rows: Rows
    design: Design
    view: View
    model: Model
    context: Context


class Mean(NamedTuple):
    """A model of the rows: its effects' free parameters behind p1 and the width at the reference exposure [px], and
    which of these two are free."""

    problem: Problem
    model: Model
    free: tuple[Free, ...]
    law_free: tuple[int, ...]
    law: tuple[float, float]


class Account(NamedTuple):
    """A model of the rows fitted: parameters, slopes of the rows by them, residuals, components and the likelihood."""

    mean: Mean
    theta: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray
    components: tuple[Component, ...]
    found: Estimated

    @property
    def deviance(self) -> float:
        """−2 ln L but for constants."""
        return self.found.at.deviance

    @property
    def present(self) -> tuple[Present, ...]:
        """Effects with their fitted values."""
        return changed(self.mean.model, self.mean.free, [*self.theta[len(self.mean.law_free) :]]).present

    @property
    def law(self) -> Law:
        """p1 and p2 [px]; the peak is 1."""
        return _law(self.mean, self.theta)

    def variance(self, of: str, shared: str) -> float:
        """A component's variance; 0 where it is not fitted."""
        pairs = zip(self.components, self.found.weights.tau, strict=True)
        return next((float(tau) for own, tau in pairs if (own.of, own.shared) == (of, shared)), 0.0)


def problem_of(
    numbers: FrameNumbers,
    design: Design,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    present: Sequence[Present] = (),
    common_width: float = COMMON_WIDTH,
) -> Problem:
    """Rows and model of a set of frames, with a straight line through the widths for a start."""
    lines = np.stack([np.log(design.exposure_s / design.reference_s), np.ones(len(design.site))], 1)
    widths = np.exp(numbers.values[1]) - baseline.laser_px
    p1, reference = np.linalg.lstsq(lines, widths, rcond=None)[0]
    law = Law(float(p1), float(reference - p1 * np.log(design.reference_s)), float(np.exp(numbers.values[0].max())))
    shortest, longest = float(design.exposures.min()), float(design.exposures.max())
    context = bounds_context(law, baseline, sensor, crop_px, shortest, longest, design.reference_s)
    own = tuple(p for p in present if p.effect.place in PLACES)
    model = Model(baseline, sensor, own, Numbers(*numbers.values))
    return Problem(rows_of(numbers, design, common_width), design, view_of(design), model, context)


def rows_of(numbers: FrameNumbers, design: Design, common_width: float = COMMON_WIDTH) -> Rows:
    """Rows of a set of frames, of which each component's members are those that a design can tell apart."""
    frames = len(design.site)
    apart = np.linalg.svd(np.eye(frames) - 1 / frames)[0][:, : frames - 1].T
    whole = np.concatenate([apart, np.full((1, frames), frames**-0.5)])
    lift = linalg.block_diag(apart, whole)
    each = np.arange(4 * frames).reshape(frames, 4)[:, :2].T.ravel()
    known = lift @ numbers.covariance[np.ix_(each, each)] @ lift.T
    known[-1, -1] += frames * common_width**2
    sites = (design.site[:, None] == np.unique(design.site)).astype(float)
    parts = {"brightness": lift[:, :frames], "width": lift[:, frames:]}
    components = []
    for of, part in parts.items():
        if 1 < sites.shape[1] < frames:
            components.append(Component(of, "site", part @ sites))
        components.append(Component(of, "frame", part))
    values = lift @ numbers.values[:2].ravel()
    return Rows(values, known, tuple(components), lift, lift @ numbers.influence[each])


def mean_of(problem: Problem, present: Sequence[Present], start: Account | None = None) -> Mean:
    """The model with some effects. What an effect replaces of the baseline is held."""
    model = problem.model._replace(present=tuple(present))
    held = {name for own in present for name in own.effect.replaces}
    single = problem.design.exposures.size < 2
    law_free = tuple(k for k, name in enumerate(Law._fields[:2]) if name not in held and not (single and k == 0))
    if start is not None:
        law = _pair(start.mean, start.theta)
    else:
        # A start that `problem_of` made; where one exposure leaves p1 open, none.
        sigma = np.exp(model.numbers.log_width) - model.baseline.laser_px
        over = np.log(problem.design.exposure_s / problem.design.reference_s)
        p1 = 0.0 if single else float(np.polyfit(over, sigma, 1)[0])
        law = (p1, float(np.mean(sigma - p1 * over)))
    return Mean(problem, model, free_of(model, problem.context), law_free, law)


def _pair(mean: Mean, theta: np.ndarray) -> tuple[float, float]:
    """p1 and the width at the reference exposure [px]."""
    law = list(mean.law)
    for place, value in zip(mean.law_free, theta, strict=False):
        law[place] = float(value)
    return law[0], law[1]


def _law(mean: Mean, theta: np.ndarray) -> Law:
    p1, reference = _pair(mean, theta)
    return Law(p1, reference - p1 * np.log(mean.problem.view.reference_s), 1.0)


def predicted(mean: Mean, theta: np.ndarray) -> np.ndarray:
    """The rows under parameters; NaN where the law has no width."""
    problem = mean.problem
    present = changed(mean.model, mean.free, [*theta[len(mean.law_free) :]]).present
    with np.errstate(all="ignore"):
        peak, sigma = spot_state(problem.view, mean.model.baseline, _law(mean, theta), present)
        logs = [np.broadcast_to(np.log(own), problem.view.exposure_s.shape).ravel() for own in (peak, sigma)]
    return problem.rows.lift @ np.concatenate(logs)


def slopes_of(mean: Mean, theta: np.ndarray) -> np.ndarray:
    """Slopes of the rows [row, parameter] by central differences, one-sided at a bound."""
    low, high, nudge = _box(mean)
    out = np.empty((len(mean.problem.rows.values), len(theta)))
    for k in range(len(theta)):
        ends = np.repeat(theta[None], 2, 0)
        ends[:, k] = max(theta[k] - nudge[k], low[k]), min(theta[k] + nudge[k], high[k])
        below, above = (predicted(mean, end) for end in ends)
        out[:, k] = (above - below) / (ends[1, k] - ends[0, k])
    return out


def _box(mean: Mean) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest values of the parameters, and the steps of their slopes."""
    step = NUDGE * abs(mean.law[1])
    law = [(-np.inf, np.inf, step)] * len(mean.law_free)
    rows = law + [(own.low, own.high, own.nudge) for own in mean.free]
    low, high, nudge = np.array(rows).reshape(-1, 3).T
    return low, high, nudge


def settle(mean: Mean, theta: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, float]:
    """Parameters that fit the rows best under a covariance with that Cholesky factor, and χ² there (Levenberg and
    Marquardt, within bounds)."""
    low, high, _ = _box(mean)

    def whitened(rows):
        return linalg.solve_triangular(factor, rows, lower=True, check_finite=False)

    theta = np.clip(theta, low, high)
    rest = whitened(mean.problem.rows.values - predicted(mean, theta))
    now, damping = float(rest @ rest), 1e-6
    slopes = whitened(slopes_of(mean, theta))
    for _ in range(STEPS if len(theta) else 0):
        pull, inner = slopes.T @ rest, slopes.T @ slopes
        free = ~(((theta <= low) & (pull < 0)) | ((theta >= high) & (pull > 0)))
        diagonal = np.maximum(np.diag(inner), 1e-300)
        step = np.zeros(len(theta))
        scale = np.sqrt(diagonal[free])
        damped = inner[np.ix_(free, free)] / np.outer(scale, scale) + damping * np.eye(free.sum())
        step[free] = linalg.lstsq(damped, pull[free] / scale, check_finite=False)[0] / scale
        tried = np.clip(theta + step, low, high)
        then_rest = whitened(mean.problem.rows.values - predicted(mean, tried))
        then = float(then_rest @ then_rest)
        if np.isfinite(then) and then <= now:
            gained, theta, rest, now, damping = now - then, tried, then_rest, then, damping / 10
            if gained < ENOUGH:
                break
            slopes = whitened(slopes_of(mean, theta))
        else:
            damping = max(damping * 10, 1e-4)
            if damping > STIFF:
                break
    return theta, now


def start_of(mean: Mean) -> np.ndarray:
    """Parameters at which a model stands."""
    return np.array([*(mean.law[k] for k in mean.law_free), *values_of(mean.model, mean.free)])


def beginnings(rows: Rows) -> list[np.ndarray]:
    """Components from which fits begin: about the known errors; and so large in brightness, or in width, that the other
    says all. A law that is wrong for one of the two is otherwise made right for it, and wrong for the other."""
    tau = mixed.begun(rows.known, rows.components)
    of = np.array([own.of for own in rows.components])
    return [tau, *(np.where(of == own, LOOSE, tau) for own in np.unique(of))]


def first_account(problem: Problem) -> Account:
    """The best fit of what is present, by restricted likelihood, from all beginnings."""
    rows, mean, found = problem.rows, mean_of(problem, problem.model.present), []
    for tau in beginnings(rows):
        theta, _ = settle(mean, start_of(mean), mixed.weights_at(rows.known, rows.components, tau).factor)
        found.append((theta, tau))
    every = [
        account(mean, rows.components, restricted=True, start=own)
        for own in apart(mean, found, linalg.cholesky(rows.known, lower=True))
    ]
    return min(every, key=lambda own: own.deviance)


Start = tuple[np.ndarray, np.ndarray]


def apart(mean: Mean, starts: Sequence[Start], factor: np.ndarray) -> list[Start]:
    """Of parameters, each with components, those whose rows differ under a covariance with that Cholesky factor."""
    kept, seen = list[Start](), list[np.ndarray]()
    for start in starts:
        rows = linalg.solve_triangular(factor, predicted(mean, start[0]), lower=True)
        if np.isfinite(rows).all() and not any(np.sum((rows - other) ** 2) < SAME for other in seen):
            kept.append(start)
            seen.append(rows)
    return kept


def account(mean: Mean, components: tuple[Component, ...], *, restricted: bool, start: "Account | Start") -> Account:
    """Fit laws and components in turn, by restricted likelihood or by full, from parameters with as many components, or
    from where the model stands and an account left the components."""
    rows = mean.problem.rows
    if isinstance(start, Account):
        # Scoring leaves 0 as easily as any other value.
        theta, tau = start_of(mean), np.array([start.variance(own.of, own.shared) for own in components])
    else:
        theta, tau = start
    weights, last = mixed.weights_at(rows.known, components, tau), np.inf
    for _ in range(ROUNDS):
        theta, _ = settle(mean, theta, weights.factor)
        slopes, rest = slopes_of(mean, theta), rows.values - predicted(mean, theta)
        found = mixed.estimate(rows.known, components, slopes, rest, weights.tau, restricted=restricted)
        weights = found.weights
        if last - found.at.deviance < SETTLED:
            break
        last = found.at.deviance
    return Account(mean, theta, slopes, rest, components, found)
