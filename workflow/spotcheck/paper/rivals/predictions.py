"""Predictions of worlds for measurements that the paper did not make, and the number of frames that separates worlds.

A world is a forward model with free parameters that could have made the paper's frames. A site is a place on the sample
with its own brightness and speckle. Three experiments are predicted: shorter exposures, at which no pixel is clipped; a
neutral-density filter at the longest exposure; and the profile of an unclipped spot.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spotcheck.fitting.spotfit import fit_spots
from spotcheck.metrics import crop_metrics
from spotcheck.paper.rivals.worlds import LONGEST_S, SIDE, Values, World

# Short exposures [s], and the transmission of a filter at the longest exposure [1].
SHORT_EXPOSURES_S, FILTER_TRANSMISSION = (1e-5, 3e-5), 0.01
# Levels [share of the maximum] between which the profile of a spot is measured, outer over inner radius.
PROFILE_LEVELS = (0.2, 0.8)
# Difference of means in standard errors that separates two worlds.
SEPARATION = 5.0


@dataclass(frozen=True)
class Prediction:
    """A quantity of one frame in an experiment, over the sites of a world."""

    experiment: str  # what is measured, in words
    unit: str  # "1" if dimensionless
    mean: float  # mean over sites [unit]
    sd: float  # standard deviation over sites [unit]


def predict(world: World, values: Values, rng: np.random.Generator) -> list[Prediction]:
    """Return the predictions of a world with given values of its parameters, from one realisation of all sites."""
    short = world.draw(values, rng, SHORT_EXPOSURES_S)
    # A filter acts on the light as a shorter exposure does, but the exposure time stays.
    filtered = world.draw(values, rng, (LONGEST_S,), transmission=FILTER_TRANSMISSION)
    predictions = []
    for k, exposure_s in enumerate(SHORT_EXPOSURES_S):
        label = f"exposure of {1e6 * exposure_s:.0f} µs"
        predictions += _summarise(short[:, k], label)
    return predictions + _summarise(filtered[:, 0], f"900 µs behind a filter of {100 * FILTER_TRANSMISSION:.0f} %")


def count_frames_to_separate(first: Prediction, second: Prediction) -> float:
    """Return the number of frames of each world at which the means differ by `SEPARATION` standard errors.

    It is at least 2, and infinite for equal means.
    """
    difference = abs(first.mean - second.mean)
    variance = first.sd**2 + second.sd**2
    return float(np.ceil(max(2.0, SEPARATION**2 * variance / difference**2))) if difference > 0 else np.inf


def _summarise(images: np.ndarray, label: str) -> list[Prediction]:
    """Return fitted width, largest reading and profile ratio over images [site, y, x] in DN."""
    fits = fit_spots(images, weighting="equal")
    columns = (
        ("fitted width", "px", fits.sigma_mean),
        ("largest reading", "DN", [crop_metrics.largest_reading(image) for image in images]),
        ("radius at 20 % over radius at 80 % of the profile", "1", [measure_profile_ratio(image) for image in images]),
    )
    return [
        Prediction(f"{name}, {label}", unit, float(np.nanmean(values)), float(np.nanstd(values, ddof=1)))
        for name, unit, values in columns
    ]


def measure_profile_ratio(image: np.ndarray) -> float:
    """Return the radius [px] at which the mean profile falls below 20 % of its maximum, over that for 80 %.

    The spot is in the middle of `image` [y, x] in DN. The result [1] is 2.69 for a Gaussian and 7.2 for an exponential
    profile; NaN if the profile does not fall so far.
    """
    radius = np.hypot(*(np.indices(image.shape) - SIDE / 2)).astype(int).ravel()
    profile = np.bincount(radius, image.ravel()) / np.maximum(np.bincount(radius), 1)
    radii = []
    for level in PROFILE_LEVELS:
        below = np.flatnonzero(profile < level * profile.max())
        if below.size == 0 or below[0] == 0:
            return np.nan
        k = int(below[0])
        # Linear interpolation between the rings, whose middles lie at k + ½.
        share = (profile[k - 1] - level * profile.max()) / (profile[k - 1] - profile[k])
        radii.append(k - 0.5 + share)
    outer, inner = radii
    return outer / inner


def list_separations(predictions: Sequence[list[Prediction]]) -> list[list[float]]:
    """Return the smallest number of frames that separates each pair of worlds [world, world]; 0 on the diagonal.

    `predictions` are those of each world, with the same quantities in the same order. The number for a pair is that of
    the quantity which needs the fewest frames.
    """
    return [
        [0.0 if first is second else min(map(count_frames_to_separate, first, second)) for second in predictions]
        for first in predictions
    ]
