"""Trials of strengths of effects that search for upper limits.

A strength changes the mean readings by c. With c projected off all nuisance parameters, a score test estimates the part
s of this change that the frames show, with the standard error e. The strength is excluded if s + k e < 1, with the
quantile k of the confidence level. The limit is where s + k e = 1. It is found by trying strengths, since the change by
a clip or a blur is not linear in the strength.

A distance is that of the strength from where the effect vanishes, or 1/strength if it vanishes at infinity, as a clip.
The first parameter of an effect is its strength. A clip limits readings to a level, which is its strength.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import list_starts, value_is_one_sided
from spotcheck.discrepancy.criteria import CONFIDENCE
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales

# Largest factor between two tried distances, and the factor if the first estimate says nothing.
LARGEST_FACTOR, BLIND_FACTOR = 100.0, 8.0
# |ln(s + k e)| below which the limit is extrapolated; the second if the change is linear in the strength.
CLOSE, LINEAR_CLOSE = 0.03, 3.0
# Standard error of s above which the frames say nothing about it.
LARGEST_ERROR = 1e6
# Relative width of the bracket of a limit at which the search ends.
NARROW = 0.004
# Least s + k e, whose logarithm is taken; and least |ln| of the ratio of two distances from which a power is estimated.
LEAST_PART, LEAST_STEP = 1e-9, 0.02
# Powers of the distance that a change may follow, those that count as linear, and the power above which a change sets
# in at once, as that of a dead zone, so that it has no size that could be small.
POWER_RANGE, LINEAR_POWERS, SUDDEN_POWER = (0.5, 100.0), (0.9, 1.1), 16.0


@dataclass(frozen=True)
class Estimate:
    """Estimated part of the change by a strength that the frames show; NaN before it was measured."""

    size: float  # s
    error: float  # e: standard error of s with `inflation`; infinite if the frames say nothing
    quantile: float  # k
    inflation: float = 1.0  # factor for misfit that `error` contains

    @property
    def part(self) -> float:
        """s + k e: the strength is excluded if this is below 1."""
        return self.size + self.quantile * self.error

    @property
    def z(self) -> float:
        """s in standard errors; 0 if the frames say nothing."""
        return self.size / self.error if np.isfinite(self.error) else 0.0


NO_ESTIMATE = Estimate(np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Trial:
    """A strength of an effect on one side of where it vanishes, which is tried as its limit.

    A parameter of the effect may be a direction. The change is then a sine of it, so that a few directions tell its
    amplitude in any direction.
    """

    start: AppliedEffect  # effect with its variant and the values of its other parameters
    turned: tuple[AppliedEffect, ...]  # the same in other directions; () without a direction
    sign: int  # side: 1 for strengths above where the effect vanishes, −1 below
    is_one_sided: bool  # whether the effect has no other side
    distance: float  # distance that is tried
    farthest: float  # largest distance within the bounds of the strength
    estimate: Estimate = NO_ESTIMATE  # at `distance`
    power: float = np.nan  # power of the distance by which the change grows; NaN until two distances were tried
    inside: float = 0.0  # largest distance that was not excluded
    outside: float = np.inf  # least distance that was excluded
    before: tuple[float, float] = (np.nan, np.nan)  # distance and standard error of the previous try; NaN for none

    @property
    def quantile_level(self) -> float:
        """Probability below the quantile k: that of a one-sided or of a two-sided interval."""
        return CONFIDENCE if self.is_one_sided else (1 + CONFIDENCE) / 2

    @property
    def is_limited(self) -> bool:
        """Whether a limit exists: the frames say something, and the change does not set in at once at some distance."""
        is_sudden = np.isfinite(self.start.effect.vanishes_at) and self.power > SUDDEN_POWER
        return bool(np.isfinite(self.estimate.error)) and not is_sudden

    @property
    def is_linear(self) -> bool:
        """Whether the change is linear in the strength."""
        return LINEAR_POWERS[0] < self.power < LINEAR_POWERS[1]

    @property
    def excess(self) -> float:
        """ln(s + k e): above 0 if the strength is not excluded, NaN before it was tried."""
        return float(np.log(np.maximum(self.estimate.part, LEAST_PART)))

    @property
    def is_final(self) -> bool:
        """Whether no other distance need be tried."""
        is_close = abs(self.excess) < (LINEAR_CLOSE if self.is_linear else CLOSE)
        # The frames show the opposite change: the limit lies on the other side, where it is extrapolated to.
        is_opposite = self.estimate.part <= 0 and np.isfinite(self.power)
        is_narrow = self.outside < self.inside * (1 + NARROW)
        return is_close or is_opposite or is_narrow or (self.excess > 0 and self.distance >= self.farthest)

    @property
    def limit_distance(self) -> float:
        """Distance at which s + k e would be 1, extrapolated from the present one; negative on the other side."""
        part, power = self.estimate.part, np.nan_to_num(self.power, nan=1.0)
        return float(np.sign(part) * self.distance * abs(part) ** (1 / power))

    @property
    def limit(self) -> float:
        """Limit of the strength, in its unit; NaN if it is beyond the bounds."""
        return self.strength_at(self.limit_distance) if self.limit_distance < self.farthest else np.nan

    def applied(self) -> list[AppliedEffect]:
        """Return the effect with the tried strength in all its directions."""
        name, strength = self.start.effect.parameters[0].name, self.strength_at(self.distance)
        return [applied.with_value(name, strength) for applied in (self.start, *self.turned)]

    def strength_at(self, distance: float) -> float:
        """Return the strength at a distance; a negative distance lies on the other side."""
        zero = self.start.effect.vanishes_at
        return float(1 / distance if np.isinf(zero) else zero + self.sign * distance)

    def record(self, estimate: Estimate) -> "Trial":
        """Return the trial with the estimate at its distance, and the power and the bracket that follow from it."""
        trial, power = replace(self, estimate=estimate), self.power
        log_ratio = np.log(self.distance / self.before[0])
        error_before, error = np.minimum([self.before[1], estimate.error], LARGEST_ERROR)
        # The error of s is in inverse proportion to the change.
        if abs(log_ratio) > LEAST_STEP and min(error_before, error) < LARGEST_ERROR:
            power = float(np.clip(np.log(error_before / error) / log_ratio, *POWER_RANGE))
        if trial.excess > 0:
            return replace(trial, power=power, inside=max(self.inside, self.distance))
        return replace(trial, power=power, outside=min(self.outside, self.distance))

    def move(self) -> "Trial":
        """Return the trial at the next distance: where s + k e should be 1, within the bracket of the limit."""
        largest = np.log(LARGEST_FACTOR if np.isfinite(self.excess) else BLIND_FACTOR)
        log_factor = np.clip(self.excess / np.nan_to_num(self.power, nan=1.0), -largest, largest)
        distance = float(min(self.distance * np.exp(log_factor), self.farthest))
        if self.outside < np.inf and not self.inside < distance < self.outside:
            distance = float(np.sqrt(self.inside * self.outside)) if self.inside > 0 else self.outside / BLIND_FACTOR
        return replace(self, distance=distance, estimate=NO_ESTIMATE, before=(self.distance, self.estimate.error))

    def restart(self) -> "Trial":
        """Return the trial at its limit without a bracket, to be tried on other pixels."""
        distance = min(self.limit_distance, self.farthest)
        return replace(
            self, distance=distance, estimate=NO_ESTIMATE, inside=0.0, outside=np.inf, before=(np.nan, np.nan)
        )


def solve_trials(
    trials: Sequence[Trial], measure: Callable[[Sequence[Trial]], list[Estimate]], tries: int
) -> list[Trial]:
    """Return the trials at their limits: at distances where s + k e is about 1, or from which it is extrapolated.

    Parameters
    ----------
    trials : sequence of Trial
        Trials at their first distance, or after some tries.
    measure : callable
        Returns the estimate of each trial at its distance.
    tries : int
        Most distances that are tried for each.
    """
    latest_trials = list(trials)
    for _ in range(tries):
        active = [k for k, trial in enumerate(latest_trials) if not trial.is_final]
        if not active:
            break
        # A trial without an estimate is measured at its first distance.
        moved_trials = [
            latest_trials[k] if np.isnan(latest_trials[k].excess) else latest_trials[k].move() for k in active
        ]
        for k, trial, estimate in zip(active, moved_trials, measure(moved_trials), strict=True):
            latest_trials[k] = trial.record(estimate)
    return latest_trials


def list_trials(effects: Sequence[Effect], scales: EffectScales) -> list[Trial]:
    """Return a trial for each variant and starting point of effects, on each side of where they vanish.

    Starting points that differ in the strength alone give one trial. Effects without a strength at which they vanish
    give none.
    """
    starts = list_starts(effects, scales)
    trials, listed = [], set()
    for start in starts:
        effect, strength = start.effect, start.effect.parameters[0]
        key = (effect.name, start.variant, repr(start.values[1:]))
        if key in listed or np.isnan(effect.vanishes_at):
            continue
        listed.add(key)
        low, high = effect.bounds(scales)[0]
        is_clip = np.isinf(effect.vanishes_at)
        # Only the first variant of a clip is limited: with a knee, the level of the clip means something else.
        if is_clip and start.variant is not next(iter(effect.variants)):
            continue
        is_one_sided = is_clip or value_is_one_sided(start)
        turned = _turned_starts(start, starts)
        value = start.parameters[strength.name]
        distance = 1 / value if is_clip else abs(value - effect.vanishes_at)
        for sign in (1,) if is_one_sided else (1, -1):
            end = high if sign > 0 else low
            farthest = 1 / low if is_clip else abs(end - effect.vanishes_at)
            trials.append(Trial(start, turned, sign, is_one_sided, distance, float(farthest)))
    return trials


def _turned_starts(start: AppliedEffect, starts: Sequence[AppliedEffect]) -> tuple[AppliedEffect, ...]:
    """Return the starts that differ from `start` in a single direction; () without a parameter that is a direction.

    The change is a sine of the direction or of twice the direction. Starts cover one period evenly. If their number is
    even, the second half of them gives the changes of the first half with the other sign, and is left out.
    """
    for k, parameter in enumerate(start.effect.parameters):
        is_direction = parameter.low == -np.inf and parameter.high == np.inf
        if not is_direction or not np.isfinite(start.values[k]):
            continue
        # Values behind the strength, without the direction.
        others = np.delete(start.values[1:], k - 1)
        turned = [
            other for other in starts
            if other.effect is start.effect and other.variant is start.variant
            and other.values[k] != start.values[k]
            and np.array_equal(np.delete(other.values[1:], k - 1), others, equal_nan=True)
        ]  # fmt: skip
        if turned:
            count = len(turned) + 1
            return tuple(turned[: count // 2 - 1] if count % 2 == 0 else turned)
    return ()


def choose_farthest(trials: Sequence[Trial], of_variants: bool = False) -> dict[str, list[Trial]]:
    """Return the trial with the farthest limit on each side of each effect, by the effect's name.

    Trials that are limited come before others. With `of_variants` there is one for each variant and side.
    """
    groups: dict[tuple, list[Trial]] = {}
    for trial in trials:
        key = (trial.start.effect.name, trial.sign, trial.start.variant if of_variants else None)
        groups.setdefault(key, []).append(trial)
    chosen: dict[str, list[Trial]] = {}
    for (name, *_), group in groups.items():
        farthest = max(group, key=lambda trial: (trial.is_limited, trial.limit_distance))
        chosen.setdefault(name, []).append(farthest)
    return chosen


def add_directions(sizes: Sequence[float]) -> float:
    """Return the amplitude of a change that is a sine of the direction, from its sizes in evenly spaced directions.

    Twice the mean square of a sine is the square of its amplitude. A single size is returned as it is, with its sign.
    """
    return float(np.sqrt(2 * np.mean(np.square(sizes)))) if len(sizes) > 1 else float(sizes[0])
