"""How often the fit finds the spot from its own start, over all spots that a camera may show.

A fit is right when it carries no flag and every parameter lies within 6 bounds of the truth.
"""

import csv
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.spotfit import fit_spots
from tests.validation.benchmarks import spots
from tests.validation.benchmarks.accuracy import errors, in_parallel, random_sensor
from tests.validation.benchmarks.spots import NAMES, ORIENTATION, SIDE
from tests.validation.benchmarks.table import Figure, Limit, Part

SEED = 20260103
SPOTS = 25
RIGHT, WRONG = 6.0, 10.0
# A spot is near round, and its orientation not counted, when its bound is larger [rad].
NEAR_ROUND = np.radians(3)
WORST = 30


class Outcome(NamedTuple):
    """One spot, its camera, and its fit: status and the largest error of a parameter in bounds (NaN without a root)."""

    amplitude_dn: float
    x_px: float
    y_px: float
    sigma_major_px: float
    sigma_minor_px: float
    orientation_deg: float
    offset_e: float
    gain_dn_per_e: float
    read_noise_e: float
    black_level_dn: float
    bits: int
    status: int
    error_in_bounds: float
    parameter: str


def random_truth(rng: np.random.Generator, gain: float) -> np.ndarray:
    """Any spot: peak 50 … 1000 DN, widths 3 … 40 px at ratios 1 … 3, centre anywhere on the frame, faint offset."""
    ratio = rng.uniform(1, 3)
    minor = np.exp(rng.uniform(np.log(3), np.log(40 / ratio)))
    peak = np.exp(rng.uniform(np.log(50), np.log(1000))) / gain
    x, y = rng.uniform(0, SIDE - 1, 2)
    return np.array([peak, x, y, ratio * minor, minor, rng.uniform(0, np.pi), rng.uniform(0, 20)])


def outcomes(seed: np.random.SeedSequence) -> list[Outcome]:
    """The spots of one sensor."""
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    found = []
    for _ in range(SPOTS):
        truth = random_truth(rng, sensor.gain_dn_per_e)
        mean = spots.mean_image(truth)
        frame = spots.frame(mean, sensor, rng)
        bits = int(rng.integers(max(10, int(frame.max() + 1).bit_length()), 17))
        camera = replace(sensor, full_scale_dn=2.0**bits - 1)
        bounds = spots.bounds(spots.slopes(truth), spots.plain_information(mean, sensor))
        fits = fit_spots([frame], camera)
        z = np.abs(errors(fits, truth, sensor)[0] / bounds)
        if bounds[ORIENTATION] > NEAR_ROUND:
            z[ORIENTATION] = 0.0
        # NaN, of a fit without a root, counts as worst.
        worst = int(np.argmax(np.nan_to_num(z, nan=np.inf)))
        spot = [truth[0] * sensor.gain_dn_per_e, *truth[1:5], np.degrees(truth[5]), truth[6]]
        chain = [sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn, bits]
        found.append(Outcome._make([*spot, *chain, int(fits.flags[0]), float(z[worst]), NAMES[worst]]))
    return found


def write_worst(found: list[Outcome], path: Path) -> None:
    """The worst cases with their parameters: the flagged ones first, then by their error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = sorted(found, key=lambda o: (o.status, np.nan_to_num(o.error_in_bounds, nan=np.inf)), reverse=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(Outcome._fields)
        writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in outcome] for outcome in ordered[:WORST])


def measure(folder: Path, sensors: int = 240) -> Part:
    """`sensors` × SPOTS spots; the worst go to `convergence.csv` in a folder."""
    seeds = np.random.SeedSequence(SEED).spawn(sensors)
    found = [outcome for part in in_parallel(outcomes, seeds, "convergence") for outcome in part]
    write_worst(found, folder / "convergence.csv")
    flagged = np.array([outcome.status != 0 for outcome in found])
    error = np.array([outcome.error_in_bounds for outcome in found])
    right = ~flagged & (error <= RIGHT)
    wrong = ~flagged & ~(error <= WRONG)
    share = float(right.mean())
    figures = [
        Figure(
            "unflagged, and all parameters within 6 bounds", share, f"{right.sum()} of {len(found)}", Limit("≥", 0.999)
        ),
        Figure("unflagged, and off by more than 10 bounds", int(wrong.sum()), str(wrong.sum()), Limit("≤", 0)),
        Figure("flagged", int(flagged.sum()), str(flagged.sum())),
    ]
    return Part("Convergence from its own start, centres up to the border", figures)
