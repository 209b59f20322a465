"""Flats and darks without any spot: where a straight line fails, and which effects of the vocabulary make up for it.

The baseline is linear: over its dark a flat reads R times its light, with K times that in variance. Effects act as on
spots, in the same chain: a flat is a spot of endless width. They are fitted to some levels, and compared on others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from spotcheck.estimate.photon_transfer import Transfer, light_of
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Law, View, bounds_context, moments
from spotcheck.model.effect import Context, Effect, Place, Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel

# Wider than any sensor [px].
ENDLESS = 1e9
# Levels with more clipped pixels than this are left out: how light varies over the frame would count.
MOST_CLIPPED = 1e-3
# Every so many levels one is kept unseen.
EVERY = 3
# χ² that an effect more must bring on the unseen levels, and within which rivals are tied.
EARNS, TIED = 10.0, 8.0
MOST = 3
# Sets that grow by one effect more.
BEAM = 3
# Factor by which R and K may differ from what a plain look says: where noise hardly shows, a fit would take K anywhere.
ASTRAY = 10.0


class Series(NamedTuple):
    """Levels of light over their darks: light (photons, or exposure) as a part of the largest; signal [DN] and excess
    of variance [DN²] with errors; which are kept unseen; exposure [s] of the largest; baseline and sensor."""

    light: np.ndarray
    signal: np.ndarray
    signal_error: np.ndarray
    excess: np.ndarray
    excess_error: np.ndarray
    unseen: np.ndarray
    longest_s: float
    baseline: Baseline
    sensor: SensorModel
    timed: bool


class FlatFit(NamedTuple):
    """Effects with values and standard errors; R·light at the brightest level [DN] and K [DN/e-]; χ² of the levels that
    chose them and of those that were kept unseen."""

    present: tuple[Present, ...]
    errors: tuple[tuple[float, ...], ...]
    peak: float
    gain: float
    gain_error: float
    chi2: float
    unseen: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(own.effect.name for own in self.present)


def series_of(found: Transfer, full_scale_dn: float) -> Series | None:
    """The levels that can be looked at; None where there are too few."""
    # Without darks there is no signal, and without noise that grows no gain.
    if np.isnan(found.quantities["gain"].value):
        return None
    good = np.array([own.at_full <= MOST_CLIPPED for own in found.flats], bool) & (found.signal > 0)
    if np.count_nonzero(good) < 2 * EVERY:
        return None
    flats = [own for own, kept in zip(found.flats, good, strict=True) if kept]
    light = light_of(flats)
    exposure = np.array([own.exposure_s for own in flats])
    if not np.isfinite(light).all() or np.ptp(light) == 0:
        return None
    # A lamp that shines alike all the time: then a constant error of the exposure would show.
    timed = bool(np.isfinite(exposure).all()) and float(np.std(light / exposure) / np.mean(light / exposure)) < 0.02
    longest = float(exposure.max()) if timed else 1.0
    gain, dark = found.quantities["gain"].value, found.quantities["dark_noise"].value
    black = found.quantities["dark_offset"].value
    sensor = SensorModel(gain, max(dark, 0.1), 0.0, np.inf, black, full_scale_dn)
    order = np.argsort(np.argsort(light, kind="stable"), kind="stable")
    return Series(
        light / light.max(),
        found.signal[good],
        np.maximum([own.mean_error for own in flats], 1e-6),
        found.excess[good],
        found.excess_error[good],
        order % EVERY == EVERY - 1,
        longest,
        Baseline(0.0, "linear", False, longest),
        sensor,
        timed,
    )


def foretold(series: Series, present: Sequence[Present], peak: float, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """Signal [DN] and excess of variance [DN²] of every level under effects."""
    count = len(series.light)

    def single(values: np.ndarray | float) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, float), (count,)).reshape(-1, 1, 1).copy()

    zero = single(0.0)
    view = View(zero, zero, zero, zero, single(series.light * series.longest_s), zero, single(0.5), zero, zero,
                series.longest_s, series.longest_s, 0.0, 0.0, 1.0, 1.0)  # fmt: skip
    sensor = series.sensor._replace(gain_dn_per_e=gain)
    noise = np.sqrt(max((series.sensor.gain_dn_per_e * series.sensor.read_noise_e) ** 2, 1e-9)) / gain
    sensor = sensor._replace(read_noise_e=float(noise))
    at = moments(view, series.baseline, Law(0.0, ENDLESS, peak), present, sensor)
    dark = (gain * noise) ** 2 + ROUNDING_VARIANCE
    return at.mean.ravel() - sensor.black_level_dn, at.variance.ravel() - dark


def context_of(series: Series) -> Context:
    """What bounds of effects depend on."""
    shortest = float(series.light.min() * series.longest_s)
    base = Law(0.0, ENDLESS, float(series.signal.max()))
    return bounds_context(base, series.baseline, series.sensor, 1.0, shortest, series.longest_s, series.longest_s)


def fitted(series: Series, present: Sequence[Present]) -> FlatFit:
    """The best fit of effects, R and K to the levels that may choose them, from the effects' values."""
    context = context_of(series)
    moving = [[k for k, p in enumerate(own.effect.parameters) if p.name not in own.effect.idle.get(own.form, ())]
              for own in present]  # fmt: skip
    bounds = np.array(
        [own.effect.bounds(context)[k] for own, ks in zip(present, moving, strict=True) for k in ks]
    ).reshape(-1, 2)
    scale = np.where(np.isfinite(np.ptp(bounds, axis=1)), np.ptp(bounds, axis=1), 1.0)
    chosen = ~series.unseen

    def effects(point: np.ndarray) -> tuple[Present, ...]:
        values, out = iter(point[2:]), []
        for own, ks in zip(present, moving, strict=True):
            numbers = list(own.values)
            for k in ks:
                numbers[k] = float(next(values))
            out.append(own._replace(values=tuple(numbers)))
        return tuple(out)

    def pulls(point: np.ndarray) -> np.ndarray:
        signal, excess = foretold(series, effects(point), float(np.exp(point[0])), float(np.exp(point[1])))
        return np.stack(
            [(series.signal - signal) / series.signal_error, (series.excess - excess) / series.excess_error]
        )

    start = [own.values[k] for own, ks in zip(present, moving, strict=True) for k in ks]
    slope = float(np.median(series.signal / series.light))
    first = np.array([np.log(slope), np.log(series.sensor.gain_dn_per_e), *start])
    low = np.concatenate([first[:2] - np.log(ASTRAY), bounds[:, 0]])
    high = np.concatenate([first[:2] + np.log(ASTRAY), bounds[:, 1]])
    first = np.clip(first, low, high)
    best = least_squares(
        lambda p: pulls(p)[:, chosen].ravel(),
        first,
        bounds=(low, high),
        x_scale=np.concatenate([[0.01, 0.01], scale / 50]),
    )
    rest = pulls(best.x)
    covariance = np.linalg.pinv(best.jac.T @ best.jac)
    count = rest[:, chosen].size - len(first)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0) * max(2 * best.cost / max(count, 1), 1.0))
    spread = iter(errors[2:])
    own_errors = tuple(tuple(float(next(spread)) if k in ks else np.nan for k in range(len(own.values)))
                       for own, ks in zip(present, moving, strict=True))  # fmt: skip
    gain = float(np.exp(best.x[1]))
    return FlatFit(effects(best.x), own_errors, float(np.exp(best.x[0])), gain, gain * float(errors[1]),
                   float((rest[:, chosen] ** 2).sum()), float((rest[:, series.unseen] ** 2).sum()))  # fmt: skip


def shown(series: Series) -> dict[str, Effect]:
    """Effects of the vocabulary by name that the levels can show: an error of the exposure only where light goes with
    it."""
    return {
        name: effect
        for name, effect in vocabulary().items()
        if not effect.flats and (series.timed or effect.place is not Place.EXPOSURE)
    }


def best_of(series: Series, names: Sequence[str]) -> FlatFit:
    """The best fit of a set of effects over their forms and starts."""
    context, effects = context_of(series), [vocabulary()[name] for name in names]
    trials: list[tuple[Present, ...]] = [()]
    for effect in effects:
        trials = [(*before, own) for before in trials for own in _starts(effect, context)]
    return min((fitted(series, own) for own in trials), key=lambda fit: fit.chi2)


def _starts(effect: Effect, context: Context) -> list[Present]:
    return [Present(effect, form, values) for form in effect.forms for values in list(effect.starts(context))[:2]]


def explanations(series: Series) -> list[FlatFit]:
    """The best set and those that cannot be told from it, best first (the baseline alone where no effect earns its
    place on unseen levels). Sets grow from the best ones of a size less."""
    names = list(shown(series))
    ahead = [fitted(series, ())]
    kept: list[FlatFit] = ahead[:1]
    for _ in range(MOST):
        sets = {frozenset((*own.names, name)) for own in ahead[:BEAM] for name in names if name not in own.names}
        tried = [best_of(series, sorted(own, key=names.index)) for own in sorted(sets, key=sorted)]
        ahead = sorted(tried, key=lambda fit: fit.unseen)
        if not ahead or ahead[0].unseen > kept[0].unseen - EARNS:
            break
        kept = [fit for fit in ahead if fit.unseen < ahead[0].unseen + TIED]
    return kept
