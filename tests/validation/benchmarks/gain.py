"""How much worse spots tell the gain than flats do: as many frames of the same sensor each, drawn by plain numpy.

Flats lie at levels from dark to three quarters of full scale, two of each. Spots are bright at the centre and dark at
the border; those with speckle are two exposures each of half as many sites, and neighbouring pixels cannot tell grain
from noise there.
"""

import sys
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from spotcheck.characterization.levels import Level, estimate_pattern_variances, estimate_row_variances
from spotcheck.characterization.photon_transfer import analyse_photon_transfer
from spotcheck.characterization.spot_estimates import estimate_from_spots
from tests.validation.benchmarks.table import Figure, Limit, Part, Table

SEED, DRAWS, FRAMES, SIDE = 20261121, 24, 32, 240
BLACK, FULL = 40.0, 4095.0
# Contrast and grain [px] of the speckle, width of the spots [px].
CONTRAST, GRAIN, WIDTH = 0.5, 1.0, 35.0


class Camera(NamedTuple):
    """Gain [DN/e-] and read noise [e-] of a sensor without faults."""

    gain: float
    noise: float

    def frame(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One frame [DN] of expected electrons."""
        seen = rng.poisson(electrons) + self.noise * rng.standard_normal(electrons.shape)
        return np.clip(np.rint(BLACK + self.gain * seen), 0, FULL)

    @property
    def brightest(self) -> float:
        """Three quarters of full scale [e-]."""
        return 0.75 * (FULL - BLACK) / self.gain


def by_flats(camera: Camera, rng: np.random.Generator) -> tuple[float, float]:
    """Gain and its standard error from flats, and two darks."""
    levels = []
    for light in (0.0, *np.linspace(0.05, 1, FRAMES // 2) * camera.brightest):
        first, second = (camera.frame(np.full((SIDE, SIDE), light), rng) for _ in range(2))
        rows = estimate_row_variances(first, second)
        mean, error = (first.mean() + second.mean()) / 2, np.sqrt(rows.mean() / 2) / SIDE
        variance, variance_error = rows.mean(), rows.std(ddof=1) / np.sqrt(rows.size)
        noise = mean, error, variance, variance_error, 0.0, 0.0
        kind, pattern = "flat" if light else "dark", estimate_pattern_variances(first, second)
        levels.append(Level(kind, 1e-3, light, 2, *noise, pattern, (SIDE, SIDE)))
    own = analyse_photon_transfer(levels, FULL).quantities["gain"]
    return own.value, own.stderr


def by_spots(camera: Camera, rng: np.random.Generator, speckled: bool) -> tuple[float, float]:
    """Gain and its standard error from spots: every one at another place, or two exposures of each site."""
    y, x = np.mgrid[:SIDE, :SIDE]
    pairs = []
    for _ in range(FRAMES // 2):
        centre = SIDE / 2 + rng.uniform(-5, 5, 2)
        light = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * WIDTH**2))
        if speckled:
            light = light * _grain(rng)
        light = light * camera.brightest / light.max()
        pairs.append(tuple(camera.frame(part * light, rng) for part in (0.5, 1.0)))
    found = estimate_from_spots((one for two in pairs for one in two), {"exposures of a site": pairs}, BLACK, FULL).gain
    return (found.gain, found.gain_stderr) if found else (np.nan, np.nan)


def _grain(rng: np.random.Generator) -> np.ndarray:
    """Speckle of mean 1: intensities of a few random fields add up to that contrast."""
    patterns = round(1 / CONTRAST**2)
    fields = gaussian_filter(rng.standard_normal((2 * patterns, SIDE, SIDE)), (0, GRAIN, GRAIN))
    field = (fields**2).sum(axis=0)
    return field / field.mean()


def measure() -> Part:
    """Errors of the gain over random sensors."""
    rng = np.random.default_rng(SEED)
    ways = {
        "flats": by_flats,
        "spots": lambda camera, own: by_spots(camera, own, speckled=False),
        "spots with speckle": lambda camera, own: by_spots(camera, own, speckled=True),
    }
    off = {name: np.zeros((DRAWS, 2)) for name in ways}
    for k in range(DRAWS):
        camera = Camera(float(np.exp(rng.uniform(np.log(0.1), np.log(0.5)))), float(rng.uniform(3, 15)))
        for name, way in ways.items():
            gain, error = way(camera, rng)
            off[name][k] = gain / camera.gain - 1, error / camera.gain
        if (k + 1) % 8 == 0:
            print(f"gain: {k + 1} of {DRAWS}", file=sys.stderr)
    rms = {name: float(np.sqrt(np.mean(own[:, 0] ** 2))) for name, own in off.items()}
    rows = [
        [name, f"{100 * rms[name]:.2f} %", f"{100 * np.median(own[:, 1]):.2f} %", f"{rms[name] / rms['flats']:.1f}"]
        for name, own in off.items()
    ]
    note = (
        f"{DRAWS} random sensors, {FRAMES} frames of {SIDE} × {SIDE} px each; speckle of contrast {CONTRAST:g} and "
        f"grain {GRAIN:g} px. The rms over the sensors has a relative standard error of"
        f" {100 / np.sqrt(2 * DRAWS):.0f} %."
    )
    worst = max(rms["spots"], rms["spots with speckle"])
    figures = [Figure("error of the gain from spots, of K", worst, f"{100 * worst:.1f} %", Limit("≤", 0.05))]
    for name, row in zip(ways, rows, strict=True):
        if name != "flats":
            title = f"the same from {name} over that from flats"
            figures.append(Figure(title, rms[name] / rms["flats"], row[-1]))
    columns = ["frames", "rms error", "stated error", "ratio to flats"]
    return Part("Gain without flats", figures, [Table("Gain by flats and by spots", columns, rows, note)])
