"""How often the fit finds the spot from its own start, over all spots that a camera may show.

A fit is right when it carries no flag and every parameter lies within 6 bounds of the truth.
"""

from dataclasses import replace

import numpy as np

from spotcheck.fitting.spotfit import fit_spots
from tests.validation.benchmarks import spots
from tests.validation.benchmarks.accuracy import errors, in_parallel, random_sensor
from tests.validation.benchmarks.spots import ORIENTATION, SIDE
from tests.validation.benchmarks.table import Figure, Limit, Part

SEED = 20260103
SPOTS = 25
RIGHT, WRONG = 6.0, 10.0
# A spot is near round, and its orientation not counted, when its bound is larger [rad].
NEAR_ROUND = np.radians(3)


def random_truth(rng: np.random.Generator, gain: float) -> np.ndarray:
    """Any spot: peak 50 … 1000 DN, widths 3 … 40 px at ratios 1 … 3, centre anywhere on the frame, faint offset."""
    ratio = rng.uniform(1, 3)
    minor = np.exp(rng.uniform(np.log(3), np.log(40 / ratio)))
    peak = np.exp(rng.uniform(np.log(50), np.log(1000))) / gain
    x, y = rng.uniform(0, SIDE - 1, 2)
    return np.array([peak, x, y, ratio * minor, minor, rng.uniform(0, np.pi), rng.uniform(0, 20)])


def outcomes(seed: np.random.SeedSequence) -> np.ndarray:
    """Return status and largest error of a parameter (in bounds, infinite if the fit failed) of each spot of a sensor
    [spot, 2]."""
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    found = []
    for _ in range(SPOTS):
        truth = random_truth(rng, sensor.gain_dn_per_e)
        mean = spots.mean_image(truth)
        frame = spots.frame(mean, sensor, rng)
        bits = int(rng.integers(max(10, int(frame.max() + 1).bit_length()), 17))
        bounds = spots.bounds(spots.slopes(truth), spots.plain_information(mean, sensor))
        fits = fit_spots([frame], replace(sensor, full_scale_dn=2.0**bits - 1))
        z = np.abs(errors(fits, truth, sensor)[0] / bounds)
        if bounds[ORIENTATION] > NEAR_ROUND:
            z[ORIENTATION] = 0.0
        found.append((fits.flags[0], np.nan_to_num(z, nan=np.inf).max()))
    return np.array(found)


def measure(sensors: int = 240) -> Part:
    """`sensors` × SPOTS spots."""
    seeds = np.random.SeedSequence(SEED).spawn(sensors)
    status, error = np.concatenate(list(in_parallel(outcomes, seeds, "convergence"))).T
    flagged = status != 0
    right, wrong = ~flagged & (error <= RIGHT), ~flagged & (error > WRONG)
    shown = f"{right.sum()} of {len(right)}"
    figures = [
        Figure("unflagged, and all parameters within 6 bounds", float(right.mean()), shown, Limit("≥", 0.999)),
        Figure("unflagged, and off by more than 10 bounds", int(wrong.sum()), str(wrong.sum()), Limit("≤", 0)),
        Figure("flagged", int(flagged.sum()), str(flagged.sum())),
    ]
    return Part("Convergence from its own start, centres up to the border", figures)
