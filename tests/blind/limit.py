"""How strong an effect must be to be found at all, by the rig's own reckoning: nothing of the library is asked."""

from collections import defaultdict

import numpy as np

from rig import hidden
from rig.hidden import registry
from rig.hidden.strength import Judge, Reference
from rig.hidden.world import World
from spotcheck.discrepancy.extend import Tolerance

# Signal-to-noise at which a single known signature is found in 90 of 100 at 1 % false alarms.
FISHER = 3.9


def limit_of(case: hidden.Case, tolerance: Tolerance) -> float:
    """The signal-to-noise from which on a case's effects should be found: Fisher's limit, or where their size in any
    condition passes the tolerance, if that is more. Sizes grow as the signal-to-noise does."""
    steady = tuple(effect for effect in case.world.effects if not effect.scatters)
    if len(steady) < len(case.world.effects):
        # The tolerance is of means and noise: scatter that stands out is always told.
        return FISHER
    judge = Judge(registry.design(case.design), case.shots)
    reference = Reference(World(case.world.base), judge.frames, judge.thin)
    mean, variance = reference.pictures(World(case.world.base, steady))
    left = reference.refitted(mean)
    top = float(np.max(reference.mean)) - case.world.base.black_level
    expected = reference.variance + case.world.base.gain * (mean - left - reference.mean)
    excess = abs(float(np.mean(np.maximum(variance, 1e-2) / np.maximum(expected, 1e-2)))) - 1
    conditions = defaultdict(list)
    for k, site in enumerate(judge.frames):
        for j, shot in enumerate(site):
            conditions[shot.angle_deg, shot.exposure_s].append(
                (left[k, j] ** 2, left[k, j] ** 2 / reference.variance[k, j])
            )
    squares = [np.mean(own, axis=(0, 2, 3)) for own in conditions.values()]
    of_peak, of_noise = (float(np.sqrt(max(own[i] for own in squares))) for i in (0, 1))
    sizes = (of_peak / top / tolerance.of_peak, of_noise / tolerance.of_noise, abs(excess) / (2 * tolerance.of_noise))
    return max(FISHER, case.truth["snr"] / max(*sizes, 1e-9))
