"""Tables of the reading's distribution under faint light, for the compiled kernel of the spot fit.

The kernel treats bright light as normal. Under faint light a reading is skewed, clipped at black, or rounded more
coarsely than its noise: there it looks up the probability of a reading. The tables are those of `ReadingDistribution`.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from spotcheck.sensor.codes import CodeProbabilities
from spotcheck.sensor.distribution import ReadingDistribution
from spotcheck.sensor.model import SensorModel

# A Poisson distribution of this mean [e-] passes for normal.
FAINT_E = 32.0
# The table also covers everything that black clips within this many read noises, and noise finer than this [DN].
CLIP_REACH, FINE_DN = 6.0, 0.6
# Limit for converters whose step is many electrons: rounding then hides what the noise would show.
LARGEST_TABLE_E = 2000.0
# Levels for each unit of read noise, or for each electron where that is smaller.
LEVELS = 8
# Parts of a DN in which a reading less an offset is tabulated: a score is straight over one, even without noise.
PARTS = 8
# A reading less likely than this is treated as normal: its exact slope would be 0/0.
IMPROBABLE = 1e-250


@dataclass(frozen=True)
class FaintTable:
    """Probability of readings at uniform levels of mean electrons, also below 0."""

    lowest_e: float  # mean electrons of the first level [e-]
    step_e: float  # distance of the levels [e-]
    probability: np.ndarray  # of readings 0, 1, 2 … [level, reading]
    slope: np.ndarray  # derivative of the probability by the mean electrons [level, reading, 1/e-]
    mean: np.ndarray  # mean reading [level, DN]
    variance: np.ndarray  # variance of the reading [level, DN²]

    @property
    def levels(self) -> np.ndarray:
        """Mean electrons of the levels [e-]."""
        return self.lowest_e + self.step_e * np.arange(len(self.probability))


@lru_cache(maxsize=8)
def tabulate_faint_light(sensor: SensorModel) -> FaintTable:
    """Return the table of a sensor, up to where readings are normal, in steps that the noise allows to interpolate."""
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    highest = max(FAINT_E, CLIP_REACH * noise - black / gain, (FINE_DN / gain) ** 2 - noise**2)
    step = max(noise, 1.0) / LEVELS
    # Further below, read noise alone moves the reading, which the kernel treats by itself.
    below = 0.0 if noise == 0 else CLIP_REACH * noise + 0.5 / gain
    first = -int(np.ceil(below / step))
    levels = step * np.arange(first, np.ceil(min(highest, LARGEST_TABLE_E) / step) + 1)
    distribution = ReadingDistribution(replace(sensor, dark_current_e_per_s=0.0))
    parts = [distribution.probabilities(part) for part in (levels[:-first], levels[-first:]) if part.size]
    # Columns are the readings 0, 1, 2 … of probability and slope.
    size = max(part.codes[-1] for part in parts) + 1
    padded = [np.pad(part[1:], ((0, 0), (0, 0), (part.first_code, size - 1 - part.codes[-1]))) for part in parts]
    return _add_moments(float(levels[0]), step, *np.concatenate(padded, axis=1))


def _add_moments(lowest_e: float, step_e: float, probability: np.ndarray, slope: np.ndarray) -> FaintTable:
    """Return the table of probabilities of the readings 0, 1, 2 … and their slopes, both [level, reading]."""
    cumulants = CodeProbabilities(0, probability, slope).cumulants()
    return FaintTable(lowest_e, step_e, probability, slope, cumulants.mean, cumulants.variance)


@lru_cache(maxsize=8)
def tabulate_between_codes(sensor: SensorModel, extra_e2: float) -> tuple[SensorModel, FaintTable]:
    """Return a sensor whose DN are `PARTS` times as fine, and its table, for readings less offsets of their own.

    Tables for black levels 1/`PARTS` DN apart are interleaved: they give the distribution of y − f for offsets f that
    are multiples of 1/`PARTS` DN. The read noise has `extra_e2` [e-²] more of variance. The black level is put where it
    clips nothing.
    """
    noise = float(np.sqrt(sensor.read_noise_e**2 + extra_e2))
    black = float(np.ceil(2 * CLIP_REACH * (sensor.gain_dn_per_e * noise + 1)))
    common = replace(sensor, read_noise_e=noise, full_scale_dn=np.inf)
    tables = [tabulate_faint_light(replace(common, black_level_dn=black + m / PARTS)) for m in range(PARTS)]
    size = min(table.probability.shape[1] for table in tables) - 1
    # Reading y of the table for f = m/PARTS stands at PARTS y − m; nothing reads as little as 0.
    parts = np.array([(table.probability[:, 1 : size + 1], table.slope[:, 1 : size + 1]) for table in tables[::-1]])
    probability, slope = np.moveaxis(parts, 0, -1).reshape(2, len(tables[0].mean), -1) / PARTS
    # The first reading is PARTS − (PARTS − 1); the table has it at 0.
    fine = replace(common, gain_dn_per_e=PARTS * sensor.gain_dn_per_e, black_level_dn=PARTS * black - 1.0)
    return fine, _add_moments(tables[0].lowest_e, tables[0].step_e, probability, slope)
