"""The law of one reading: P(y | ν) for ν mean electrons, exact where light is faint or its noise below a DN.

# ASSUME: light that is faint is far from where a response bends.

Faint light is tabulated: there the reading is skewed, clipped at black, or rounded
more coarsely than its noise. Above the table a reading is normal, to well within its noise, and its rounding counts as
1/12 DN² of variance. Fit, Fisher information and random draws all follow from this one table.
"""

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import gammaln, ndtr, xlogy

if TYPE_CHECKING:
    from spotcheck.old_engine.model.sensor import SensorModel

# Above this mean [e-] a Poisson law passes for normal.
FAINT_E = 32.0
# The table also covers all that black clips within this many read noises, and all that is finer than this noise [DN].
CLIP_REACH, FINE_DN = 6.0, 0.6
# A cap for converters whose step is many electrons: rounding then hides what the noise would tell.
LARGEST_TABLE_E = 2000.0
# Levels a unit of read noise, or an electron where that is smaller: see the test of interpolation.
LEVELS = 8
# Parts of a DN between which a reading less an offset is told: a score is straight over one, even without noise.
PARTS = 8
# A reading less likely than this is treated by the normal law: its exact slope would be 0/0.
IMPROBABLE = 1e-250


class FaintLaw(NamedTuple):
    """Table over mean electrons `lowest_e + i step_e` (below 0: a black level stated too high) and readings y.

    `probability` [level, y]; `slope` is ∂P/∂ν [1/e-]; `mean` [DN] and `variance` [DN²] of the reading. The last y also
    stands for all above it, which happens once in 1e12 unless full scale is there.
    """

    lowest_e: float
    step_e: float
    probability: np.ndarray
    slope: np.ndarray
    mean: np.ndarray
    variance: np.ndarray

    @property
    def levels(self) -> np.ndarray:
        """Mean electrons of the levels [e-]."""
        return self.lowest_e + self.step_e * np.arange(len(self.probability))

    @property
    def highest_e(self) -> float:
        """Mean electrons of the last level [e-]."""
        return self.lowest_e + self.step_e * (len(self.probability) - 1)


@lru_cache(maxsize=8)
def faint_law(sensor: "SensorModel", step_e: float | None = None) -> FaintLaw:
    """The table of a sensor, up to `FAINT_E` in steps of `step_e` [e-]; without a step, up to where readings become
    plain, in steps that the noise allows for interpolation."""
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    black_e = black / gain
    top = max(FAINT_E, CLIP_REACH * noise - black_e, (FINE_DN / gain) ** 2 - noise**2)
    top = FAINT_E if step_e else min(top, LARGEST_TABLE_E)
    step = step_e or max(noise, 1.0) / LEVELS
    # Further below, the reading is normal, or cut at black: simple enough for whoever asks.
    bottom = 0.0 if noise == 0 else CLIP_REACH * noise + 0.5 / gain
    negative = -step * np.arange(np.ceil(bottom / step), 0, -1)
    levels = np.concatenate([negative, step * np.arange(np.ceil(top / step) + 1)])
    highest = levels[-1]
    counts = np.arange(int(np.ceil(highest + 9 * np.sqrt(highest) + 12)) + 1)
    last = np.ceil(black + gain * (min(counts[-1], sensor.full_well_e) + 8 * noise)) + 1
    readings = np.arange(int(min(max(last, 1), sensor.full_scale_dn, 65535)) + 1)
    given_count = _interval(np.minimum(counts, sensor.full_well_e), sensor, readings)
    lit = levels[len(negative) :]
    weight = _poisson(counts, lit)
    shifted = np.concatenate([np.zeros((len(lit), 1)), weight[:, :-1]], axis=1)
    probability, slope = weight @ given_count, (shifted - weight) @ given_count
    if len(negative):
        below = _interval(negative, sensor, readings)
        # Read noise alone moves the reading: the normal law's own slope.
        h = 1e-4 * noise
        below_slope = (_interval(negative + h, sensor, readings) - _interval(negative - h, sensor, readings)) / (2 * h)
        probability, slope = np.concatenate([below, probability]), np.concatenate([below_slope, slope])
    mean = probability @ readings
    variance = probability @ readings.astype(float) ** 2 - mean**2
    return FaintLaw(float(levels[0]), step, probability, slope, mean, np.maximum(variance, 0.0))


@lru_cache(maxsize=8)
def fine_law(sensor: "SensorModel", extra_e2: float) -> tuple["SensorModel", FaintLaw]:
    """The law of a faint reading less an offset of its own that is no whole number: a sensor whose DN are `PARTS` times
    as fine, and its table, for read noise with `extra_e2` [e-²] more of variance.

    A pixel whose black level is higher by f reads y as often as another one reads y − f, were there such a number. So
    tables for black levels that differ by 1/`PARTS` interleave. The black level is put where it cuts nothing.
    """
    noise = float(np.sqrt(sensor.read_noise_e**2 + extra_e2))
    black = float(np.ceil(2 * CLIP_REACH * (sensor.gain_dn_per_e * noise + 1)))
    common = sensor._replace(read_noise_e=noise, full_scale_dn=np.inf)
    tables = [faint_law.__wrapped__(common._replace(black_level_dn=black + m / PARTS)) for m in range(PARTS)]
    size = min(table.probability.shape[1] for table in tables) - 1
    probability, slope = (
        # Reading y of the table for f = m/PARTS stands at PARTS y − m; nothing reads as little as 0.
        np.stack([getattr(table, name)[:, 1 : size + 1] for table in tables[::-1]], axis=2).reshape(
            len(tables[0].mean), -1
        )
        / PARTS
        for name in ("probability", "slope")
    )
    readings = PARTS * 1.0 - (PARTS - 1) + np.arange(probability.shape[1])
    mean = probability @ readings
    variance = probability @ readings**2 - mean**2
    # As if the first reading were 0.
    fine = common._replace(gain_dn_per_e=PARTS * sensor.gain_dn_per_e, black_level_dn=PARTS * black - readings[0])
    return fine, FaintLaw(tables[0].lowest_e, tables[0].step_e, probability, slope, mean - readings[0], variance)


def _poisson(counts: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """P(n | ν) [level, count]."""
    return np.exp(xlogy(counts[None, :], mean[:, None]) - mean[:, None] - gammaln(counts + 1.0)[None, :])


def _interval(electrons: np.ndarray, sensor: "SensorModel", readings: np.ndarray) -> np.ndarray:
    """P(y | signal) [signal, y]: read noise, gain, black level, one rounding, both clips; the last y takes the rest."""
    signal = sensor.gain_dn_per_e * electrons + sensor.black_level_dn
    if sensor.read_noise_e == 0:
        exact = np.clip(np.rint(signal), 0, readings[-1])
        return (exact[:, None] == readings[None, :]).astype(float)
    edges = (readings[:-1] + 0.5 - signal[:, None]) / (sensor.gain_dn_per_e * sensor.read_noise_e)
    # From both tails, so that small probabilities keep their digits.
    below, above = ndtr(edges), ndtr(-edges)
    inner = np.where(edges[:, 1:] < 0, below[:, 1:] - below[:, :-1], above[:, :-1] - above[:, 1:])
    return np.concatenate([below[:, :1], inner, above[:, -1:]], axis=1)
