"""Models of the frames' brightness and width, fitted: the laws of the chain, and scatter of sites and frames.

ln peak and ln σ_g of each frame are those of the chain's `spot_state`, so an effect that acts on exposure, width or
brightness counts by what it does. What all frames' ln peak have in common is the light's own.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence import components as mixed
from spotcheck.old_engine.evidence.components import Component, Estimated
from spotcheck.old_engine.evidence.influence import FrameNumbers
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Law, View, bounds_context, spot_state
from spotcheck.old_engine.model.effect import Context, Place, Present
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.nuisance.parameters import NUDGE, Free, changed, free_of, values_of
from spotcheck.old_engine.observe.design import Design, view_of
from spotcheck.old_engine.observe.pixels import Model, Numbers

# Places of effects that act on a frame's brightness and width alone.
PLACES = (Place.EXPOSURE, Place.WIDTH, Place.BRIGHTNESS)
# Steps of a fit to the laws at most; the gain, relative to χ², that ends it.
STEPS, ENOUGH = 40, 1e-7
# Rounds of fitting laws and components in turn, and the gain in −2 ln L that ends them.
ROUNDS, SETTLED = 8, 1e-3
# Part of the mean variance of a component's rows at which its scoring begins: any start above 0 will do.
START = 0.3
# A variance [1] of ln peak or ln σ_g beside which nothing else counts: where fits begin, once with either set aside.
LOOSE = 1.0
# Fits whose rows differ by less than this [χ²] are one.
SAME = 1.0


class Problem(NamedTuple):
    """What is fitted [row]: steps between the frames' ln peak, steps between their ln σ_g, and their mean ln σ_g; known
    covariance, components, rows from numbers [row, 2 × frame] (ln peak of all frames, then ln σ_g), and the part that
    each cell of the spot brings [row, cell]. Then design and view of the frames, the model with the effects that act on
    brightness and width, what bounds depend on, and p1 and the width at the reference exposure [px] to begin with."""

    values: np.ndarray
    known: np.ndarray
    components: tuple[Component, ...]
    lift: np.ndarray
    influence: np.ndarray
    design: Design
    view: View
    model: Model
    context: Context
    law: tuple[float, float]


class Mean(NamedTuple):
    """A model of the rows: its effects' free parameters behind p1 and the width at the reference exposure [px], and
    which of these two are free."""

    problem: Problem
    model: Model
    free: tuple[Free, ...]
    law_free: tuple[int, ...]
    law: tuple[float, float]

    def at(self, theta: np.ndarray) -> tuple[Law, tuple[Present, ...]]:
        """Law, of a peak of 1, and effects under parameters."""
        own, count = list(self.law), len(self.law_free)
        for place, value in zip(self.law_free, theta[:count], strict=True):
            own[place] = float(value)
        law = Law(own[0], own[1] - own[0] * np.log(self.problem.view.reference_s), 1.0)
        return law, changed(self.model, self.free, [*theta[count:]]).present


class Account(NamedTuple):
    """A model of the rows fitted: parameters, slopes of the rows by them, residuals, and components."""

    mean: Mean
    theta: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray
    found: Estimated

    @property
    def deviance(self) -> float:
        """−2 ln L but for constants."""
        return self.found.deviance

    @property
    def present(self) -> tuple[Present, ...]:
        """Effects with their fitted values."""
        return self.mean.at(self.theta)[1]

    @property
    def law(self) -> Law:
        """p1 and p2 [px]; the peak is 1."""
        return self.mean.at(self.theta)[0]

    @property
    def law_errors(self) -> tuple[float, float]:
        """Standard errors of p1 and p2 [px], without `COMMON_WIDTH`: the light's shape, declared or in its gauge, says
        how wide a spot is."""
        inverse, design = self.found.inverse, self.mean.problem.design
        covariance = np.linalg.pinv(self.slopes.T @ inverse @ self.slopes)
        common = covariance @ self.slopes.T @ inverse[:, -1]
        covariance -= len(design.site) * criteria.COMMON_WIDTH.value**2 * np.outer(common, common)
        # Parameters are p1 and the width at the reference exposure t: p2 is that less p1 ln t.
        turn = np.zeros((2, len(covariance)))
        each = np.array([[1.0, 0.0], [-np.log(design.reference_s), 1.0]])
        turn[:, : len(self.mean.law_free)] = each[:, list(self.mean.law_free)]
        p1, p2 = np.sqrt(np.maximum(np.diag(turn @ covariance @ turn.T), 0.0))
        return float(p1), float(p2)


def problem_of(
    numbers: FrameNumbers,
    design: Design,
    baseline: Baseline,
    sensor: SensorModel,
    crop_px: float,
    present: Sequence[Present] = (),
) -> Problem:
    """Rows and model of a set of frames, with a straight line through the widths for a start."""
    frames = len(design.site)
    # The members of each component are those that a design can tell apart.
    steps = np.linalg.svd(np.eye(frames) - 1 / frames)[0][:, : frames - 1].T
    lift = linalg.block_diag(steps, np.concatenate([steps, np.full((1, frames), frames**-0.5)]))
    each = np.arange(4 * frames).reshape(frames, 4)[:, :2].T.ravel()
    known = lift @ numbers.covariance[np.ix_(each, each)] @ lift.T
    known[-1, -1] += frames * criteria.COMMON_WIDTH.value**2
    sites = (design.site[:, None] == np.unique(design.site)).astype(float)
    shared = {"site": sites, "frame": np.eye(frames)} if 1 < sites.shape[1] < frames else {"frame": np.eye(frames)}
    parts = {"brightness": lift[:, :frames], "width": lift[:, frames:]}
    every = [Component(of, by, part @ own) for of, part in parts.items() for by, own in shared.items()]
    over = np.log(design.exposure_s / design.reference_s)
    widths = np.exp(numbers.values[1]) - baseline.laser_px
    p1, reference = np.linalg.lstsq(np.stack([over, np.ones(frames)], 1), widths, rcond=None)[0]
    law = Law(float(p1), float(reference - p1 * np.log(design.reference_s)), float(np.exp(numbers.values[0].max())))
    ends = float(design.exposures.min()), float(design.exposures.max())
    context = bounds_context(law, baseline, sensor, crop_px, *ends, design.reference_s)
    own = tuple(p for p in present if p.effect.place in PLACES)
    model = Model(baseline, sensor, own, Numbers(*numbers.values))
    return Problem(lift @ numbers.values[:2].ravel(), known, tuple(every), lift, lift @ numbers.influence[each],
                   design, view_of(design), model, context, (float(p1), float(reference)))  # fmt: skip


def mean_of(problem: Problem, present: Sequence[Present], start: Account | None = None) -> Mean:
    """The model with some effects. What an effect replaces of the baseline is held; so is p1 of one exposure, at 0."""
    model = problem.model._replace(present=tuple(present))
    held = {name for own in present for name in own.effect.replaces}
    held |= {"p1"} if problem.design.exposures.size < 2 else set()
    law_free = tuple(k for k, name in enumerate(Law._fields[:2]) if name not in held)
    law = problem.law
    if start is not None:
        law = start.law.p1, start.law.p2 + start.law.p1 * float(np.log(problem.view.reference_s))
    return Mean(problem, model, free_of(model, problem.context), law_free, law)


def predicted(mean: Mean, theta: np.ndarray) -> np.ndarray:
    """The rows under parameters; NaN where the law has no width."""
    view = mean.problem.view
    with np.errstate(all="ignore"):
        logs = [np.log(own) for own in spot_state(view, mean.model.baseline, *mean.at(theta))]
    return mean.problem.lift @ np.concatenate([np.broadcast_to(own, view.exposure_s.shape).ravel() for own in logs])


def slopes_of(mean: Mean, theta: np.ndarray) -> np.ndarray:
    """Slopes of the rows [row, parameter] by central differences, one-sided at a bound."""
    low, high, nudge = _box(mean)
    out = np.empty((len(mean.problem.values), len(theta)))
    for k in range(len(theta)):
        ends = np.repeat(theta[None], 2, 0)
        ends[:, k] = max(theta[k] - nudge[k], low[k]), min(theta[k] + nudge[k], high[k])
        below, above = (predicted(mean, end) for end in ends)
        out[:, k] = (above - below) / (ends[1, k] - ends[0, k])
    return out


def _box(mean: Mean) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest values of the parameters, and the steps of their slopes."""
    rows = [(-np.inf, np.inf, NUDGE * abs(mean.law[1]))] * len(mean.law_free)
    low, high, nudge = np.array(rows + [(own.low, own.high, own.nudge) for own in mean.free]).reshape(-1, 3).T
    return low, high, nudge


def settle(mean: Mean, theta: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, float]:
    """Parameters that fit the rows best under a covariance with that Cholesky factor, and χ² there."""
    low, high, _ = _box(mean)

    def white(rows: np.ndarray) -> np.ndarray:
        return linalg.solve_triangular(factor, rows, lower=True, check_finite=False)

    def rest(own: np.ndarray) -> np.ndarray:
        return white(mean.problem.values - predicted(mean, own))

    theta = np.clip(theta, low, high)
    first = rest(theta)
    if not theta.size or not np.isfinite(first).all():
        return theta, float(first @ first)
    found = optimize.least_squares(
        rest, theta, lambda own: white(-slopes_of(mean, own)), (low, high), x_scale="jac", ftol=ENOUGH, max_nfev=STEPS
    )
    return found.x, 2 * float(found.cost)


Start = tuple[np.ndarray, np.ndarray]


def beginnings(problem: Problem) -> list[np.ndarray]:
    """Components from which fits begin: about the known errors; and so large in brightness, or in width, that the other
    says all. A law that is wrong for one of the two is otherwise made right for it, and wrong for the other."""
    known = np.diag(problem.known)[:, None]
    tau = START * np.array([np.sum(own.members**2 * known) / np.sum(own.members**2) for own in problem.components])
    of = np.array([own.of for own in problem.components])
    return [tau, *(np.where(of == own, LOOSE, tau) for own in np.unique(of))]


def starts_of(means: Sequence[Mean], components: Sequence[np.ndarray]) -> list[Start]:
    """The best fits of means of the same parameters at some components, each with these; of such as make the same rows
    the first."""
    problem, kept, seen, first = means[0].problem, list[Start](), list[np.ndarray](), None
    for tau in components:
        factor = mixed.factor_of(problem.known, problem.components, tau)
        first = factor if first is None else first
        theta, _ = min((settle(mean, start_of(mean), factor) for mean in means), key=lambda own: own[1])
        rows = linalg.solve_triangular(first, predicted(means[0], theta), lower=True, check_finite=False)
        if np.isfinite(rows).all() and not any(np.sum((rows - other) ** 2) < SAME for other in seen):
            kept.append((theta, tau))
            seen.append(rows)
    return kept


def start_of(mean: Mean) -> np.ndarray:
    """Parameters at which a model stands."""
    return np.array([*(mean.law[k] for k in mean.law_free), *values_of(mean.model, mean.free)])


def first_account(problem: Problem) -> Account:
    """The best fit of what is present, by restricted likelihood, from all beginnings."""
    mean = mean_of(problem, problem.model.present)
    every = [
        account(mean, problem.components, restricted=True, start=own) for own in starts_of([mean], beginnings(problem))
    ]
    return min(every, key=lambda own: own.deviance)


def account(mean: Mean, components: tuple[Component, ...], *, restricted: bool, start: Start) -> Account:
    """Fit laws and components in turn, by restricted likelihood or by full, from parameters with as many components."""
    problem, (theta, tau) = mean.problem, start
    factor, last = mixed.factor_of(problem.known, components, tau), np.inf
    for _ in range(ROUNDS):
        theta, _ = settle(mean, theta, factor)
        slopes, rest = slopes_of(mean, theta), problem.values - predicted(mean, theta)
        found = mixed.estimate(problem.known, components, slopes, rest, tau, restricted=restricted)
        tau, factor = found.tau, found.factor
        if last - found.deviance < SETTLED:
            break
        last = found.deviance
    return Account(mean, theta, slopes, rest, found)
