"""The search on levels of flats: the same steps and criteria as on pixels, with a misfit that stays as noise.

Stated errors of levels are often too small: they come from the drift between frames of one level, where a lamp drifts
more from level to level. What means miss beyond their errors is taken for light, so that noise is foretold for the
light that was there; what the noise misses all the same widens its errors.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from spotcheck.old_engine import criteria
from spotcheck.old_engine.model.effect import Effect, Present
from spotcheck.old_engine.nuisance.parameters import NUDGE, SENSOR, Free, changed, free_of, values_of
from spotcheck.old_engine.observe.flats import Series, foretold
from spotcheck.old_engine.observe.pixels import Model
from spotcheck.old_engine.search.forward import Found, held
from spotcheck.old_engine.search.holds import Holding

# Factor by which K may differ from what a plain look says: where noise hardly shows, a fit would take it anywhere.
ASTRAY = 10.0
# Rounds of a fit and of the width of errors, the relative change of these that ends them; steps of each fit, and the
# part of χ² that a last step gains.
ROUNDS, SETTLED, STEPS, ENOUGH = 6, 0.01, 50, 1e-6
# A smooth misfit is a polynomial of up to this order in a level's place among the levels, or of up to a third of their
# number; what goes beyond is scatter.
SMOOTH = 4
# How far means may be off by what no model has, in their median stated error: 0, then steps of √2.
OFF = np.array([0.0, *2.0 ** np.arange(-3, 11, 0.5)])
# Where light moves the mean by less than this part of what it should, its scatter does not show.
FLAT = 0.1
# A direction of which a fit leaves less than this part tells nothing.
LEAST = 1e-3
# Cells of levels by their light, for means and for variances.
CELLS = 3


class Wide(NamedTuple):
    """By what the errors of levels exceed the stated ones: factors on those of means and of variances, and how far
    means are off [DN] by what no model has, the same at every level."""

    mean: float = 1.0
    off_dn: float = 0.0
    variance: float = 1.0


class LevelFit(NamedTuple):
    """A model fitted to the levels that may choose it: ln R and its free parameters, what is left [2, level], slopes of
    what is foretold [parameter, 2, level], widths of errors, and −2 ln L."""

    model: Model
    free: tuple[Free, ...]
    rest: np.ndarray
    slopes: np.ndarray
    wide: Wide
    deviance: float


class Standard(NamedTuple):
    """Residuals and slopes [..., 2, level] under errors of some width: errors [2, level], and by how much a variance
    follows what its mean is off, since the light was [DN]."""

    errors: np.ndarray
    follows: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values in their errors."""
        first, second = values[..., 0, :], values[..., 1, :]
        return np.stack([first / self.errors[0], (second - self.follows * first) / self.errors[1]], -2)


def standard_of(series: Series, by_light: np.ndarray, wide: Wide) -> Standard:
    """`by_light` [2, level]: slopes of mean and variance by ln light.

    A mean is off by light that has the variance (s² − 1) e² beside its stated e², and by what no model has, which has
    d²: so it tells of the light by their parts of the whole.
    """
    (mean, variance), (first, second) = by_light, series.errors
    along = mean * variance / (mean**2 + (FLAT * series.values[0].max() * series.light) ** 2)
    light, whole = (wide.mean**2 - 1) * first**2, (wide.mean * first) ** 2 + wide.off_dn**2
    beside = along**2 * light * (1 - light / whole)
    errors = np.sqrt(np.stack([whole, (second * wide.variance) ** 2 + beside]))
    return Standard(errors, along * light / whole)


def widths(series: Series, rest: np.ndarray, by_light: np.ndarray, lost: float) -> Wide:
    """The likeliest widths for what is left, `lost` parameters fitted in each half."""
    seen = ~series.unseen
    count, (mean, _), (first, _) = max(seen.sum() - lost, 1.0), rest[:, seen], series.errors[:, seen]
    off = np.median(first) * OFF[:, None]
    scale = np.maximum((mean**2 / (first**2 + off**2)).sum(1) / count, 1.0)
    whole = scale[:, None] * (first**2 + off**2)
    best = int(np.argmin((mean**2 / whole + np.log(whole)).sum(1)))
    out = Wide(float(scale[best] ** 0.5), float((scale[best] ** 0.5 * off[best])[0]))
    own = standard_of(series, by_light, out)(rest)[1, seen]
    return out._replace(variance=float(np.sqrt(max(own @ own / count, 1.0))))


def fit_levels(
    series: Series, present: Sequence[Present], near: LevelFit | None = None, rounds: int = ROUNDS
) -> LevelFit:
    """The likeliest R, K and effects, from the effects' values and from R and K of a fit that is near."""
    model = (near or series).model._replace(present=tuple(present))
    gain = series.model.sensor.gain_dn_per_e
    free = (Free(SENSOR, 0, gain / ASTRAY, gain * ASTRAY, NUDGE * gain), *free_of(model, series.context))
    low, high, step = np.array([(-np.inf, np.inf, NUDGE), *((own.low, own.high, own.nudge) for own in free)]).T
    seen, wide = ~series.unseen, near.wide if near else Wide()

    def at(point: np.ndarray) -> Model:
        return changed(model._replace(numbers=model.numbers._replace(log_peak=point[:1])), free, point[1:].tolist())

    def slopes(point: np.ndarray) -> np.ndarray:
        out = []
        for k in range(len(point)):
            ends = np.repeat(point[None], 2, 0)
            ends[:, k] = max(point[k] - step[k], low[k]), min(point[k] + step[k], high[k])
            below, above = (foretold(series, at(end)) for end in ends)
            out.append((above - below) / (ends[1, k] - ends[0, k]))
        return np.array(out)

    point = np.clip(np.concatenate([model.numbers.log_peak, values_of(model, free)]), low, high)
    for _ in range(rounds):
        own = standard_of(series, slopes(point)[0], wide)

        def pulls(point: np.ndarray, own: Standard = own) -> np.ndarray:
            return own(series.values - foretold(series, at(point)))[:, seen].ravel()

        def by(point: np.ndarray, own: Standard = own) -> np.ndarray:
            return -own(slopes(point))[..., seen].reshape(len(point), -1).T

        point = least_squares(
            pulls, point, by, (low, high), x_scale=step / NUDGE, ftol=ENOUGH, max_nfev=STEPS
        ).x  # fmt: skip
        rest, along = series.values - foretold(series, at(point)), slopes(point)
        before, wide = wide, widths(series, rest, along[0], len(point) / 2)
        if np.allclose(before, wide, rtol=SETTLED):
            break
    fit = LevelFit(at(point), free, rest, along, wide, 0.0)
    return fit._replace(deviance=deviance_of(series, fit, seen))


def deviance_of(series: Series, fit: LevelFit, which: np.ndarray, most: float = np.inf) -> float:
    """−2 ln L of some levels but for constants, under the errors that the fit has left; none counts more than `most`
    for what it misses."""
    own = standard_of(series, fit.slopes[0], fit.wide)
    return float((np.minimum(own(fit.rest) ** 2, most) + 2 * np.log(own.errors / series.errors))[:, which].sum())


def smooth_of(count: int) -> np.ndarray:
    """Orthonormal smooth functions [level, order] of a level's place among so many."""
    place = np.linspace(-1, 1, count)
    return np.linalg.qr(np.polynomial.legendre.legvander(place, min(SMOOTH, count // 3)))[0]


def scatter_of(series: Series, fit: LevelFit) -> Wide:
    """Widths of errors by what is left beyond all that is smooth."""
    seen = ~series.unseen
    smooth = smooth_of(int(seen.sum()))
    errors = standard_of(series, fit.slopes[0], fit.wide).errors[:, seen]
    rough, z = np.zeros(fit.rest.shape), fit.rest[:, seen] / errors
    rough[:, seen] = (z - z @ smooth @ smooth.T) * errors
    return widths(series, rough, fit.slopes[0], smooth.shape[1])


def errors_of(series: Series, fit: LevelFit) -> np.ndarray:
    """Standard errors of ln R and of the free parameters, as wide as what is left asks for."""
    rows = standard_of(series, fit.slopes[0], fit.wide)(fit.slopes)[..., ~series.unseen].reshape(len(fit.slopes), -1)
    return np.sqrt(np.diag(np.linalg.pinv(rows @ rows.T)))


def taken_by(series: Series, fit: LevelFit, own: Standard) -> np.ndarray:
    """Orthonormal columns of what a fit takes of standardised levels [2 × level, parameter]."""
    return np.linalg.qr(own(fit.slopes)[..., ~series.unseen].reshape(len(fit.slopes), -1).T)[0]


def strength_at(fit: LevelFit, k: int) -> int:
    """Place of the strength of an effect of a number among slopes."""
    return 1 + next(j for j, own in enumerate(fit.free) if (own.effect, own.parameter) == (k, 0))


def holding_of(series: Series, fit: LevelFit, rest: LevelFit, k: int) -> Holding:
    """Whether low, middle and high levels, means and variances, ask for the same strength of an effect; `rest` is the
    fit without it. Beside few levels what a fit takes of each cell counts: Q = Uᵀ C⁺ U, C the scores' covariance."""
    # What stays is left with and without: an effect that moves a misfit from means to variances has explained nothing.
    size = float(np.median(series.errors[0]))
    narrow = min(fit.wide, rest.wide, key=lambda wide: (wide.mean * size) ** 2 + wide.off_dn**2)
    narrow = narrow._replace(variance=min(fit.wide.variance, rest.wide.variance))
    seen, own = ~series.unseen, standard_of(series, fit.slopes[0], narrow)
    z, rows = own(fit.rest)[:, seen].ravel(), own(fit.slopes)[..., seen].reshape(len(fit.slopes), -1)
    at, count = strength_at(fit, k), int(seen.sum())
    others = np.delete(rows, at, 0)
    speaks = rows[at] - others.T @ np.linalg.lstsq(others.T, rows[at], rcond=None)[0]
    cell = np.add.outer(CELLS * np.arange(2), np.arange(count) * CELLS // count).ravel()
    split = speaks * (cell == np.arange(2 * CELLS)[:, None])
    taken = taken_by(series, fit, own)
    left = split - split @ taken @ taken.T
    information = float(speaks @ speaks)
    values, turned = np.linalg.eigh(left @ left.T)
    told = values > LEAST * information
    q = float(((turned.T @ split @ z)[told] ** 2 / values[told]).sum())
    effect, value = fit.model.present[k].effect, fit.model.present[k].values[0]
    wald = (value - effect.neutral) ** 2 * information if np.isfinite(effect.neutral) else np.inf
    lost = own(rest.rest)[:, seen].ravel()
    z2 = float(min(lost @ lost - z @ z, wald))
    return Holding(q, int(told.sum()) + 1, z2, float(errors_of(series, fit)[at]))


def in_place(series: Series, now: LevelFit, effect: Effect, k: int | None = None) -> LevelFit:
    """The likeliest fit with an effect more, in the place of that of a number, over all forms and starts."""
    rest = now.model.present if k is None else now.model.without(k).present
    starts = effect.starts(series.context)
    ways = [(*rest, Present(effect, form, values)) for form in effect.forms for values in starts]
    best = min((fit_levels(series, own, now, rounds=1) for own in ways), key=lambda fit: fit.deviance)
    return fit_levels(series, best.model.present, best)


def matters(series: Series, fit: LevelFit) -> bool:
    """Whether the last effect of a fit is more than nothing."""
    own = fit.model.present[-1]
    return own.effect.excess(own.values[0], series.context) >= 1


def search_levels(series: Series, effects: Sequence[Effect]) -> tuple[LevelFit, LevelFit, list[Found]]:
    """The fit of a straight line, that with all that was found, and what was found. Sets of effects grow from the best
    of a size less: two effects together may look like a third that is not there."""

    def others(now: LevelFit) -> list[Effect]:
        return [e for e in effects if e.name not in names_of(now)]

    def without(now: LevelFit, k: int) -> LevelFit:
        return fit_levels(series, now.model.without(k).present, now)

    def found_of(now: LevelFit) -> list[Found]:
        out = []
        for k, own in enumerate(now.model.present):
            rest, tried = without(now, k), [in_place(series, now, e, k) for e in others(now)]
            tried = [fit for fit in tried if fit.deviance < now.deviance + criteria.RIVAL.value]
            near = {names_of(fit)[-1]: max(fit.deviance - now.deviance, 0.0) for fit in tried}
            # What something negligible does as well is nothing that matters.
            gain = rest.deviance - now.deviance if all(matters(series, fit) for fit in tried) else 0.0
            out.append(Found(own, gain, holding_of(series, now, rest, k), near))
        return out

    plain = now = fit_levels(series, ())
    ahead = [plain]
    for _ in range(int(criteria.MOST.value)):
        fits = [own for fit in ahead for own in (in_place(series, fit, e) for e in others(fit)) if matters(series, own)]
        fits.sort(key=lambda fit: -fit.deviance)
        # In another order an effect may have taken another form.
        likeliest = {frozenset(names_of(fit)): fit for fit in fits}
        ahead = list(likeliest.values())[: -1 - int(criteria.REFITTED.value) : -1]
        if not ahead or ahead[0].deviance > now.deviance - criteria.GAIN.value:
            break
        now = ahead[0]
    return plain, *held(now, found_of, without)


def names_of(fit: LevelFit) -> list[str]:
    """Names of the effects."""
    return [own.effect.name for own in fit.model.present]
