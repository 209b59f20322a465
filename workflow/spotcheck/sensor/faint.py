"""Tables of the reading's distribution under faint light, for the compiled kernel of the spot fit.

Light is faint if the distribution of a reading is visibly not normal: it is skewed, clipped at 0 DN, or its noise is
less than the rounding. The kernel then looks up the probability of a reading in these tables, which are computed with
`ReadingDistribution`. Under bright light it uses a formula.

A level is a mean number of electrons ν [e-] of a pixel, light and dark current together, at which a table holds the
distribution. A reading is a whole number of DN (digital numbers) from 0 on. Brackets give the shape of an array.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from spotcheck.sensor.codes import CodeProbabilities
from spotcheck.sensor.distribution import ReadingDistribution
from spotcheck.sensor.model import SensorModel

# A Poisson distribution of this mean [e-] passes for normal.
FAINT_E = 32.0
# The table also covers light whose mean reading is less than CLIP_REACH standard deviations of the read noise above 0,
# where some readings are clipped, and light at which the standard deviation of a reading is below LEAST_NOISE_DN [DN],
# where the error of rounding depends on the signal.
CLIP_REACH, LEAST_NOISE_DN = 6.0, 0.6
# Largest level [e-], for converters whose step is many electrons: rounding then hides what the noise would show.
LARGEST_TABLE_E = 2000.0
# Number of levels per standard deviation of the read noise, or per electron if the read noise is less than one.
LEVELS_PER_NOISE = 8
# Number of parts of a DN for tables of readings less a pixel's offset. Within one part the score ∂ ln P/∂ν is nearly
# linear in the reading, even without noise.
PARTS = 8
# A reading less likely than this is treated as normal: its exact slope would be 0/0.
IMPROBABLE = 1e-250


@dataclass(frozen=True)
class FaintTable:
    """Probability of readings at uniform levels of mean electrons, also below 0."""

    lowest_e: float  # mean electrons of the first level [e-]
    step_e: float  # distance between levels [e-]
    probability: np.ndarray  # probability of the readings 0, 1, 2 … DN [level, reading]
    slope: np.ndarray  # derivative of the probability by the mean electrons [level, reading] in 1/e-
    mean: np.ndarray  # mean reading [level] in DN
    variance: np.ndarray  # variance of the reading [level] in DN²

    @property
    def levels(self) -> np.ndarray:
        """Mean electrons of each level [level] in e-."""
        return self.lowest_e + self.step_e * np.arange(len(self.probability))


@lru_cache(maxsize=8)
def tabulate_faint_light(sensor: SensorModel) -> FaintTable:
    """Return the table of a sensor, up to the level from which on readings are normal. The result is cached.

    The sensor's dark current is ignored, as a level includes the dark electrons. Levels are a small part of the noise
    apart, so that probabilities can be interpolated between them.
    """
    gain, noise, black = sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn
    highest = max(FAINT_E, CLIP_REACH * noise - black / gain, (LEAST_NOISE_DN / gain) ** 2 - noise**2)
    step = max(noise, 1.0) / LEVELS_PER_NOISE
    # Further below 0, read noise alone moves the reading, which the kernel treats by itself.
    below_zero = 0.0 if noise == 0 else CLIP_REACH * noise + 0.5 / gain
    levels_below_zero = int(np.ceil(below_zero / step))
    levels = step * np.arange(-levels_below_zero, np.ceil(min(highest, LARGEST_TABLE_E) / step) + 1)
    distribution = ReadingDistribution(replace(sensor, dark_current_e_per_s=0.0))
    # `probabilities` takes means that are either all below 0 or none.
    codes = [distribution.probabilities(group) for group in np.split(levels, [levels_below_zero]) if group.size]
    # Probability and slope [2, level, reading], with columns for the readings 0, 1, 2 …
    last_code = max(group.codes[-1] for group in codes)
    padded = [np.pad(group[1:], ((0, 0), (0, 0), (group.first_code, last_code - group.codes[-1]))) for group in codes]
    return _build_table(float(levels[0]), step, *np.concatenate(padded, axis=1))


def _build_table(lowest_e: float, step_e: float, probability: np.ndarray, slope: np.ndarray) -> FaintTable:
    """Return the table of probabilities of the readings 0, 1, 2 … and their slopes, both [level, reading]."""
    cumulants = CodeProbabilities(0, probability, slope).cumulants()
    return FaintTable(lowest_e, step_e, probability, slope, cumulants.mean, cumulants.variance)


@lru_cache(maxsize=8)
def tabulate_between_codes(sensor: SensorModel, extra_e2: float) -> tuple[SensorModel, FaintTable]:
    """Return (sensor with a finer DN, its table), for readings from which the offset of a pixel was subtracted.

    Such a reading is no whole number of DN. A DN of the fine sensor is 1/`PARTS` DN of the real one. Its table
    interleaves tables for black levels 1/`PARTS` DN apart: they give the distribution of reading − offset for offsets
    that are multiples of 1/`PARTS` DN.

    Parameters
    ----------
    sensor : the real sensor. Its black level is replaced by one that clips nothing.
    extra_e2 : variance [e-²] that is added to that of the read noise.
    """
    noise = float(np.sqrt(sensor.read_noise_e**2 + extra_e2))
    black = float(np.ceil(2 * CLIP_REACH * (sensor.gain_dn_per_e * noise + 1)))
    unclipped = replace(sensor, read_noise_e=noise, full_scale_dn=np.inf)
    tables = [tabulate_faint_light(replace(unclipped, black_level_dn=black + m / PARTS)) for m in range(PARTS)]
    # Reading y of the table for the offset m/PARTS becomes the fine reading PARTS y − m. The reading 0 is left out, as
    # the black level is far above it. Arrays are [part, 2, level, reading], with the largest m first.
    kept = slice(1, min(table.probability.shape[1] for table in tables))
    parts = np.array([(table.probability[:, kept], table.slope[:, kept]) for table in tables[::-1]])
    probability, slope = np.moveaxis(parts, 0, -1).reshape(2, len(tables[0].mean), -1) / PARTS
    # The first fine reading, PARTS − (PARTS − 1) = 1, is at column 0, so the black level is lower by 1.
    fine = replace(unclipped, gain_dn_per_e=PARTS * sensor.gain_dn_per_e, black_level_dn=PARTS * black - 1.0)
    return fine, _build_table(tables[0].lowest_e, tables[0].step_e, probability, slope)
