"""How large effects that were not found could still be, and how many frames would halve that."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import stats

from spotcheck.old_engine.conclude.judgement import TIED_WITH_SHAPE, Limit
from spotcheck.old_engine.conclude.reach import ONE_SIDED, THERE, Reach, reach_of_pixels
from spotcheck.old_engine.evidence.laws import Laws
from spotcheck.old_engine.evidence.noise import noises_of
from spotcheck.old_engine.evidence.patterns import gathered, variances_of
from spotcheck.old_engine.evidence.pixels import Ready
from spotcheck.old_engine.evidence.scatter import Trial
from spotcheck.old_engine.evidence.stripes import Stripes, stripes_of
from spotcheck.old_engine.model.effect import Context, Effect, Place
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.search.forward import Outcome
from spotcheck.old_engine.search.holds import groups_of

# Part of a limit's law that lies beyond it.
BEYOND = 0.05
NOT_FOUND = "not found"
# Why an effect that was not found has no limit.
NO_SIZE = "stands in the place of the model's own law, and has no size that could be small"
NO_SHAPE = "not learned, as the declared shape will do: what is left of the mean image says how much there may be"
UNTOLD = "these frames do not tell"
# Why more frames would not halve a limit.
ALREADY, SHARED_BY_ALL, BRIGHTER = (
    "more frames would not: something is there, though it was not named",
    "more frames would not: the light's shape or errors of the data sheet set it",
    "more frames would not: a brighter spot would",
)


def limits_of(
    outcome: Outcome, laws: Laws, design: Design, effects: Sequence[Effect], context: Context
) -> tuple[Limit, ...]:
    """Of effects that were not found what frames leave room for (95 %), or why they do not tell."""
    tied = {own.effect.name for own in outcome.tied}
    asked = [effect for effect in effects if effect.name not in tied]
    reach = reach_of_pixels(outcome.frames, outcome.after, design, asked, context)
    reach |= {effect.name: own for effect, own in _of_fields(outcome, design, asked, context)}
    reach |= {effect.name: own for effect, own in _of_noise(outcome, design, asked, context)}
    scatters = {own.present.effect.name: of_scatter(own) for own in laws.scatters}
    # Another law than the model's has no size.
    own_laws = [own for own in laws.trials if not np.isnan(own.present.effect.neutral)]
    own_laws = [own for own in own_laws if own.present.effect.name not in scatters]
    reach |= {own.present.effect.name: of_law(own, context) for own in own_laws} | scatters
    return tuple(_limit(effect, reach.get(effect.name), effect.name in tied) for effect in effects)


def _limit(effect: Effect, reach: Reach | None, tied: bool) -> Limit:
    """A row of limits."""
    own = effect.parameters[0]
    if tied or reach is None:
        untold = NO_SHAPE if effect.place is Place.SHAPE else NO_SIZE if effect.place is Place.WIDTH else UNTOLD
        return Limit(effect.name, own.name, own.unit, TIED_WITH_SHAPE if tied else untold)
    if np.isnan(reach.low) and np.isnan(reach.high):
        return Limit(effect.name, own.name, own.unit, UNTOLD)
    return Limit(effect.name, own.name, own.unit, NOT_FOUND, reach.low, reach.high, reach.times, _why_no_more(reach))


def _why_no_more(reach: Reach) -> str:
    """Why no number of frames would halve a limit; "" where one would."""
    if np.isnan(reach.times):
        return BRIGHTER
    if reach.there:
        return ALREADY
    return SHARED_BY_ALL if np.isinf(reach.times) else ""


def of_law(own: Trial, context: Context) -> Reach:
    """Of a law of brightness or width, whose strength follows Student's law; its error falls with all frames."""
    effect = own.present.effect
    both = len(effect.signs(context)) > 1
    away = own.error * float(stats.t.isf(BEYOND / (1 + both), own.freedom))
    ends = own.value - away, max(own.value, effect.neutral) + away
    # What reaches the end of what an effect may be is not told.
    lowest, highest = effect.bounds(context)[0]
    low, high = ends[0] if both and ends[0] > lowest else np.nan, ends[1] if ends[1] < highest else np.nan
    there = abs(own.z) > THERE
    return Reach(float(low), float(high), np.inf if there else 4.0, there)


def of_scatter(own: Trial) -> Reach:
    """Of a scatter of frames' numbers."""
    variance = own.value**2
    # The trial's error is that of a root, and where that is less than it of the root of an error.
    error = 2 * own.error * own.value if own.value > 2 * own.error else (2 * own.error) ** 2
    return _of_variance(variance, error, own.freedom, 16.0)


def _of_variance(variance: float, error: float, freedom: float, times: float) -> Reach:
    """Of a scatter by its variance, which with the noise beneath it follows χ² as so many equal squares do. Where its
    error falls with the root of the number of frames, its root needs 16 `times` as many."""
    noise = max(error * np.sqrt(freedom / 2) - variance, 0.0)
    most = (variance + noise) * freedom / float(stats.chi2.isf(1 - BEYOND, freedom)) - noise
    there = variance > THERE * error
    return Reach(np.nan, float(np.sqrt(most)), np.inf if there else times, there)


def _of_fields(
    outcome: Outcome, design: Design, effects: Sequence[Effect], context: Context
) -> Iterator[tuple[Effect, Reach]]:
    """Of fields and rows that pixels share, and of stripes."""
    sites, rows = gathered(outcome.frames, design, Ready(outcome.frames, outcome.after, []))
    told, stripes = variances_of(sites, rows), stripes_of(sites, context.sigma_px)
    for effect in effects:
        own = told.get((effect.scatter.of, effect.scatter.shared)) if effect.scatter else None
        if own is not None:
            # What all frames show alike is a product of two of them.
            times = 4.0 if effect.scatter and effect.scatter.shared == "sensor" else 16.0
            yield effect, _of_variance(own.value, own.error, own.freedom, times)
        if effect.spectral and stripes is not None:
            yield effect, _of_stripes(stripes)


def _of_stripes(own: Stripes) -> Reach:
    """Of stripes: those that stand out most, less what noise has of a squared amplitude; the squares of all sites add
    up."""
    count, total = len(own.weight), float(own.weight.sum())
    square = float(own.weight @ np.abs(own.amplitude) ** 2) / total - 4 * count / total
    error = np.sqrt(16 * count / total**2 + 8 * max(square, 0.0) / total)
    high = float(np.sqrt(max(square, 0.0) + ONE_SIDED * error))
    return Reach(np.nan, high, np.inf if own.gain > 0 else 16.0, own.gain > 0)


def _of_noise(
    outcome: Outcome, design: Design, effects: Sequence[Effect], context: Context
) -> Iterator[tuple[Effect, Reach]]:
    """Of noise that dark pixels show beyond the stated one."""
    for own in noises_of(outcome.frames, groups_of(design), outcome.after.model, effects, context):
        there = own.gain > THERE**2
        yield own.own.effect, Reach(np.nan, own.own.values[0] + ONE_SIDED * own.error, np.inf if there else 4.0, there)
