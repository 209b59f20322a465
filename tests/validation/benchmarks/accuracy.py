"""Accuracy of the fit in units of the bound, for all parameters and sensors with everything: gain, read noise, black
level, rounding, and for the second half of the table a full scale that clips about 5 % of the pixels.

Frames come from plain numpy, bounds from the benchmark's own Fisher information. Each frame is fitted twice, as it is
and clipped.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from spotcheck.fitting.fit_results import SpotFits
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.sensor import SensorModel
from tests.validation.benchmarks import spots
from tests.validation.benchmarks.spots import NAMES, ORIENTATION
from tests.validation.benchmarks.table import Figure, Limit, Part, Table

SEED = 20260102
# Spots of one sensor, and frames of one spot: mean image and bounds are computed once a spot.
SPOTS, FRAMES = 8, 20
# Light above this [e-] covers 2π σ₁ σ₂ ln(9091/1330) pixels: 5 % of the frame.
CLIP_E = 1330.0


def random_sensor(rng: np.random.Generator) -> SensorModel:
    """Gain 0.11 … 1 DN/e-, read noise 1 … 13 e-, a black level that clips nothing, 16 bit."""
    gain, noise = float(np.exp(rng.uniform(np.log(0.11), 0.0))), float(rng.uniform(1, 13))
    return SensorModel(gain, noise, black_level_dn=float(np.ceil(8 * gain * noise) + 2), full_scale_dn=65535.0)


def in_parallel(work: Callable[[Any], Any], items: Sequence, label: str) -> Iterator[Any]:
    """Results of `work(item)` in order, from as many processes as there are cores, with progress on stderr."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for number, result in enumerate(pool.map(work, items), 1):
            if number % max(1, len(items) // 8) == 0:
                print(f"{label}: {number} of {len(items)}", file=sys.stderr)
            yield result


def errors(fits: SpotFits, truth: np.ndarray, sensor: SensorModel) -> np.ndarray:
    """Fitted minus true parameters [n, 7] in e-, px and rad; `truth` [7] or [n, 7] as in `spots`."""
    found = fits.value[:, :7].copy()
    found[:, 0] /= sensor.gain_dn_per_e
    found[:, 6] = (found[:, 6] - sensor.black_level_dn) / sensor.gain_dn_per_e
    found[:, ORIENTATION] = np.radians(found[:, ORIENTATION])
    return spots.turned(found - truth)


def scores_of(seed: np.random.SeedSequence) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Errors in bounds [n, 7] of the fits of one sensor, without and with clipping, how many were flagged, and the
    share of clipped pixels."""
    rng = np.random.default_rng(seed)
    sensor = random_sensor(rng)
    full_scale = np.floor(sensor.black_level_dn + sensor.gain_dn_per_e * CLIP_E)
    short = replace(sensor, full_scale_dn=float(full_scale))
    information = spots.exact_information(sensor)
    whole, clipped, flagged, share = [], [], 0, []
    for _ in range(SPOTS):
        truth = spots.set_a(rng)
        mean, slopes = spots.mean_image(truth), spots.slopes(truth)
        bounds = spots.bounds(slopes, information(mean))
        bounds_clipped = spots.bounds(slopes, information(mean) * spots.clipped_share(mean, short))
        frames = [spots.frame(mean, sensor, rng) for _ in range(FRAMES)]
        share.append(np.mean(frames[0] >= full_scale))
        fits = fit_spots(frames, sensor)
        fits_clipped = fit_spots([np.minimum(f, np.uint16(full_scale)) for f in frames], short)
        whole.append(errors(fits, truth, sensor) / bounds)
        clipped.append(errors(fits_clipped, truth, short) / bounds_clipped)
        flagged += int(np.count_nonzero(fits.flags) + np.count_nonzero(fits_clipped.flags))
    return np.concatenate(whole), np.concatenate(clipped), flagged, float(np.mean(share))


def _rows(z: np.ndarray) -> list[list[str]]:
    """rms with its statistical error, and mean, of each parameter."""
    rms, mean, count = np.sqrt(np.mean(z**2, axis=0)), z.mean(axis=0), len(z)
    return [
        [f"{rms[k]:.4f} ± {rms[k] / np.sqrt(2 * count):.4f}", f"{mean[k]:+.4f} ± {1 / np.sqrt(count):.4f}"]
        for k in range(7)
    ]


def _figures(z: np.ndarray, what: str, wanted: str) -> Iterator[Figure]:
    """Worst rms and worst bias of the seven, as `must` or as `aim`."""
    rms, bias, count = np.sqrt(np.mean(z**2, axis=0)), np.abs(z.mean(axis=0)), len(z)
    for name, values, error, limit in (("rms error", rms, rms.max() / np.sqrt(2 * count), 1.02),
                                       ("bias", bias, 1 / np.sqrt(count), 0.1)):  # fmt: skip
        title = f"{what}: largest {name} of the seven ({NAMES[int(np.argmax(values))]})"
        shown = f"{values.max():.4f} ± {error:.4f} bounds"
        yield Figure(title, float(values.max()), shown, **{wanted: Limit("≤", limit)})


def measure(sensors: int = 128) -> Part:
    """`sensors` × SPOTS × FRAMES frames."""
    seeds = np.random.SeedSequence(SEED).spawn(sensors)
    whole, clipped, flagged, share = zip(*in_parallel(scores_of, seeds, "accuracy"), strict=True)
    z, z_clipped = np.concatenate(whole), np.concatenate(clipped)
    rows = [[NAMES[k], *a, *b] for k, (a, b) in enumerate(zip(_rows(z), _rows(z_clipped), strict=True))]
    table = Table(
        f"{len(z)} fits without and with clipped pixels, errors in bounds",
        ("parameter", "rms", "mean", "rms, clipped", "mean, clipped"),
        rows,
        f"{sensors} sensors of 0.11–1 DN/e- and 1–13 e- read noise, {SPOTS} spots each, {FRAMES} frames a spot; "
        f"{np.mean(share):.1%} of the pixels clipped; {sum(flagged)} fits flagged.",
    )
    figures = [*_figures(z, "nothing clipped", "must"), *_figures(z_clipped, "5 % of the pixels clipped", "aim")]
    return Part("Accuracy of the likelihood fit", figures, [table])
