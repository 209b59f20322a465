"""The light's shape, every frame's brightness, width and centre, and effects, fitted to all pixels at once.

Fisher's scoring on χ² + Σ ln variance + λ cᵀPc. The shape is common to all frames, in the coordinates of the spot; what
it shares with the frames' numbers (all brighter, all wider, all moved) is the shape's: the numbers' steps sum to 0.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from spotcheck.discrepancy.nuisance import normal
from spotcheck.discrepancy.observe.pixels import Expectation, Expected, Frame, Model, Numbers, told
from spotcheck.model.effect import Context
from spotcheck.model.light_shape import LightShape

NUMBERS = len(Numbers._fields)
# The dear matrices of the normal equations are made at so many first steps, then at every so many, and kept between.
RENEWED, AGAIN = 2, 3
# A step that gains less than this in −2 ln L ends the fit; one that loses is halved so many times.
ENOUGH, HALVINGS = 0.5, 4
# The farthest that a step may change logs of peak and width, and a centre [σ]; of a parameter it is its own size.
FARTHEST = (0.5, 0.3, 1.0, 1.0)
# The farthest for the shape [peaks], and part of the median coefficient's information that every coefficient gets on
# top in a step: where all frames are clipped they tell next to nothing, and a straight line leads far off.
FARTHEST_SHAPE, HELD = 0.3, 1e-3
# Part of a parameter's value, or of its start, by which slopes are taken.
NUDGE = 1e-3
# In place of an effect: the sensor, and which of its numbers may be free.
SENSOR, SENSOR_NUMBERS = -1, ("gain_dn_per_e", "read_noise_e", "black_level_dn")


class Free(NamedTuple):
    """One free parameter: of which effect (or `SENSOR`), which one, its bounds, the step of its slope; and the centre
    and precision (one over the variance) of what is known of it beforehand."""

    effect: int
    parameter: int
    low: float
    high: float
    nudge: float
    centre: float = 0.0
    precision: float = 0.0


class Sums(NamedTuple):
    """Of all pixels under a model: −2 ln L but for constants; G [coefficient, 4, 7], X [coefficient, number] and
    D [number, number] of the normal equations, and the scores of both parts."""

    deviance: float
    gram: np.ndarray
    joined: np.ndarray
    dense: np.ndarray
    shape: np.ndarray
    others: np.ndarray


class Fitted(NamedTuple):
    """The model, its free parameters, −2 ln L with the penalty, the factored normal equations, the penalty, and how
    many steps were taken."""

    model: Model
    free: tuple[Free, ...]
    total: float
    schur: normal.Schur
    penalty: float
    steps: int

    @property
    def covariance(self) -> np.ndarray:
        """Of the numbers' steps and, behind them, of the effects' free parameters."""
        return np.linalg.inv(self.schur.left)


def free_of(model: Model, context: Context) -> tuple[Free, ...]:
    """The parameters of a model's effects that a fit may change."""
    out = []
    for e, own in enumerate(model.present):
        starts = np.abs(np.array([*own.effect.starts(context), own.values], float))
        bounds = own.effect.bounds(context)
        for p, parameter in enumerate(own.effect.parameters):
            # A strength that means do not tell, noise does.
            if p == 0 or parameter.name not in own.effect.idle.get(own.form, ()):
                scale = max(abs(own.values[p]), float(np.median(starts[:, p])), 1e-12)
                scale = 1.0 if parameter.unit == "deg" else scale
                out.append(Free(e, p, float(bounds[p, 0]), float(bounds[p, 1]), NUDGE * scale))
    return tuple(out)


def changed(model: Model, free: Sequence[Free], values: Sequence[float]) -> Model:
    """A model with other values of its free parameters, kept within their bounds."""
    every = [list(own.values) for own in model.present]
    sensor = model.sensor
    for own, value in zip(free, values, strict=True):
        value = float(np.clip(value, own.low, own.high))
        if own.effect == SENSOR:
            sensor = sensor._replace(**{SENSOR_NUMBERS[own.parameter]: value})
        else:
            every[own.effect][own.parameter] = value
    present = tuple(own._replace(values=tuple(v)) for own, v in zip(model.present, every, strict=True))
    return model._replace(present=present, sensor=sensor)


def values_of(model: Model, free: Sequence[Free]) -> np.ndarray:
    """Values of the free parameters."""
    return np.array([_value(model, own) for own in free])


def _value(model: Model, own: Free) -> float:
    if own.effect == SENSOR:
        return float(getattr(model.sensor, SENSOR_NUMBERS[own.parameter]))
    return model.present[own.effect].values[own.parameter]


def sums_of(
    frames: Sequence[Frame], model: Model, free: Sequence[Free] = (), *, curved: bool, workers: int = 2
) -> Sums:
    """All sums under a model; with `curved` false only the deviance and the scores."""
    ready, others = Expectation(frames, model), nudged_of(frames, model, free)

    def part(which: np.ndarray) -> Sums:
        return _part(frames, model, ready, others, which, curved)

    return Sums(*shared(part, len(frames), workers))


def shared(part: Callable[[np.ndarray], Sequence[Any]], frames: int, workers: int) -> list[Any]:
    """Sums of what several threads make of some frames each."""
    with ThreadPoolExecutor(workers) as pool:
        done = list(pool.map(part, np.array_split(np.arange(frames), min(workers, frames))))
    return [sum(own[1:], own[0]) for own in zip(*done, strict=True)]


def nudged(model: Model, own: Free) -> tuple[Model, float]:
    """The model with a free parameter a small step off, and that step: away from a bound, or nothing would change."""
    value = _value(model, own)
    step = -own.nudge if value + own.nudge > own.high else own.nudge
    return changed(model, [own], [value + step]), step


Nudged = list[tuple[Expectation, float]]


def nudged_of(frames: Sequence[Frame], model: Model, free: Sequence[Free]) -> Nudged:
    """The model with each free parameter a small step off, and that step."""
    steps = (nudged(model, own) for own in free)
    return [(Expectation(frames, other), step) for other, step in steps]


def changes_of(frame: Frame, k: int, seen: Expected, nudged: Nudged) -> list[tuple[np.ndarray, np.ndarray]]:
    """Slopes of mean and variance [pixel] by each free parameter."""
    then = [(other.of(frame, k), step) for other, step in nudged]
    return [((o.mean - seen.mean).ravel() / step, (o.variance - seen.variance).ravel() / step) for o, step in then]


def _part(
    frames: Sequence[Frame], model: Model, ready: Expectation, nudged: Nudged, which: np.ndarray, curved: bool
) -> Sums:
    """The sums of some frames."""
    learned = model.baseline.learned
    assert learned is not None
    side, few, last = len(learned.coefficients), NUMBERS * len(frames), NUMBERS * len(frames) + len(nudged)
    size = side * side
    gram, joined = np.zeros((size, 4, 7)), np.zeros((size, last if curved else 0))
    dense, shape, others = np.zeros((last, last)), np.zeros((size, 1)), np.zeros(last)
    deviance = 0.0
    behind = np.zeros((size, len(nudged)))
    for k in which:
        frame = frames[k]
        seen = ready.of(frame, k)
        tells = told(frame, seen)
        deviance += tells.deviance
        own, peak = slice(NUMBERS * k, NUMBERS * (k + 1)), np.exp(model.numbers.log_peak[k])
        slopes = ready.by_numbers(frame, k, seen)
        u, v = (np.ascontiguousarray(part).ravel() for part in (seen.u, seen.v))
        others[own] = slopes @ tells.light
        normal.project(u, v, learned.step, side, (peak * tells.light)[None], shape)
        changes = changes_of(frame, k, seen, nudged)
        for c, (mean, variance) in enumerate(changes):
            others[few + c] += tells.score(mean, variance).sum()
        if curved:
            normal.gather(u, v, learned.step, side, peak**2 * tells.sure_light, gram)
            block = np.zeros((size, NUMBERS))
            normal.project(u, v, learned.step, side, slopes * (peak * tells.sure_light), block)
            joined[:, own] = block
            dense[own, own] = (slopes * tells.sure_light) @ slopes.T
            lights = [tells.with_light(*change) for change in changes]
            for c, light in enumerate(lights):
                dense[own, few + c] = dense[few + c, own] = slopes @ light
                for d in range(c + 1):
                    shared = tells.information(changes[c], changes[d]).sum()
                    dense[few + c, few + d] += shared
                    dense[few + d, few + c] = dense[few + c, few + d]
            if lights:
                normal.project(u, v, learned.step, side, peak * np.stack(lights), behind)
    if curved:
        joined[:, few:] = behind
    return Sums(deviance, gram, joined, dense, shape, others)


def contrasts(frames: int, more: int = 0) -> np.ndarray:
    """Orthonormal steps of all frames' numbers [number, step] that sum to 0 over the frames; `more` numbers behind them
    are free."""
    apart = np.linalg.svd(np.eye(frames) - 1 / frames)[0][:, : frames - 1]
    both = np.kron(apart, np.eye(NUMBERS))
    out = np.zeros((NUMBERS * frames + more, both.shape[1] + more))
    out[: len(both), : both.shape[1]] = both
    out[len(both) :, both.shape[1] :] = np.eye(more)
    return out


def fit(
    frames: Sequence[Frame],
    model: Model,
    penalty: float,
    free: Sequence[Free] = (),
    steps: int = 8,
    workers: int = 2,
    tilt: np.ndarray | float = 0.0,
) -> Fitted:
    """Fit shape, numbers and free parameters from a start; `tilt` [parameter] is added to the parameters' scores: see
    `sheet.taken_up`."""
    learned = model.baseline.learned
    assert learned is not None
    side = len(learned.coefficients)
    rough = penalty * normal.roughness(side)
    basis = contrasts(len(frames), len(free))
    known = np.array([own.precision for own in free])
    centre, behind = np.array([own.centre for own in free]), np.arange(NUMBERS * len(frames), len(basis))

    def matrices(sums: Sums, held: float = 0.0) -> normal.Schur:
        band, dense = normal.banded(sums.gram, side) + rough, sums.dense.copy()
        band[0] += held * np.median(band[0])
        dense[behind, behind] += known
        return normal.schur(band, sums.joined @ basis, basis.T @ dense @ basis)

    solved: normal.Schur | None = None
    best, total, taken = model, np.inf, 0
    shape = numbers = np.zeros(0)
    halved = 0
    for taken in range(1, steps + 2):
        renewed = taken <= RENEWED or taken % AGAIN == 0
        sums = sums_of(frames, model, free, curved=renewed, workers=workers)
        assert model.baseline.learned is not None
        flat = model.baseline.learned.coefficients.ravel()
        bent = normal.product(rough, flat)
        off = centre - values_of(model, free)
        now = sums.deviance + float(flat @ bent) + float(known @ off**2) + 2 * float(np.sum(tilt * off))
        sums.others[behind] += known * off + tilt
        if not now <= total and halved < HALVINGS:
            halved += 1
            shape, numbers = shape / 2, numbers / 2
            model = stepped(best, shape, numbers, free)
            continue
        if renewed or solved is None:
            solved = matrices(sums, HELD)
        done = total - now < ENOUGH or taken > steps
        if now <= total:
            best, total = model, now
        if done:
            break
        change, moved = solved.solve(sums.shape[:, 0] - bent, basis.T @ sums.others)
        shape, numbers = change, basis @ moved
        part = min(bold(numbers, free), FARTHEST_SHAPE / max(np.abs(change).max(), FARTHEST_SHAPE))
        shape, numbers, halved = part * shape, part * numbers, 0
        model = stepped(best, shape, numbers, free)
    # Scores and errors need the matrices of the model that was found, or what shape takes exceeds what there is.
    sums = sums_of(frames, best, free, curved=True, workers=workers)
    return Fitted(best, tuple(free), total, matrices(sums), penalty, taken)


def bold(numbers: np.ndarray, free: Sequence[Free]) -> float:
    """Which part of a step may be taken at once: beyond, its straight line leads nowhere."""
    last = len(numbers) - len(free)
    reach = np.concatenate([np.tile(FARTHEST, last // NUMBERS), [own.nudge / NUDGE for own in free]])
    return float(min(1.0, 1 / max(np.max(np.abs(numbers) / reach, initial=0.0), 1e-300)))


def stepped(model: Model, shape: np.ndarray, numbers: np.ndarray, free: Sequence[Free]) -> Model:
    """A model after a step of the shape's coefficients, of the frames' numbers (centres in σ) and of parameters."""
    learned = model.baseline.learned
    assert learned is not None
    own, last = model.numbers, NUMBERS * len(model.numbers.x)
    step = numbers[:last].reshape(-1, NUMBERS).T
    width = np.exp(own.log_width)
    moved = Numbers(own.log_peak + step[0], own.log_width + step[1], own.x + width * step[2], own.y + width * step[3])
    grown = LightShape(learned.step, learned.coefficients + shape.reshape(learned.coefficients.shape))
    model = model._replace(baseline=model.baseline._replace(learned=grown), numbers=moved)
    return changed(model, free, values_of(model, free) + numbers[last:])
