"""A small dataset with a known disagreement, drawn by numpy alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from spotcheck.dataset.folder import Dataset, load
from spotcheck.sensor import SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import folder

# Side of a frame [px].
SIDE = 60
SENSOR = SensorModel(0.11, 6.0, black_level_dn=12.0, full_scale_dn=1023.0)
STATED = "{bit_depth: 10, gain_dn_per_e: 0.11, read_noise_e: 6.0, black_level_dn: 12.0}"
ANGLES, EXPOSURES, REPEATS = (0.0, 45.0), (1e-4, 4e-4), 3
# σ = P1 ln(t / 1 s) + P2 [px], 6.9 and 8.6 px; peak at the longest exposure [DN], else ∝ t/σ².
P1, P2, PEAK = 1.2, 18.0, 600.0
# Width without an exposure [px].
SIGMA = 7.0
# x, y [px] from the spot's centre, angle [deg], exposure [s], sigma [px], spot [DN] → light [DN].
Light = Callable[..., np.ndarray]


@dataclass(frozen=True)
class SmallFrame:
    """A drawn frame with its truth."""

    angle_deg: float | None
    exposure_s: float | None
    repeat: int
    readings: np.ndarray  # [row, column] DN, uint16
    peak_dn: float
    sigma_px: float
    x: float  # column of the centre [px]
    y: float  # row of the centre [px]


def plain(dx, dy, angle, exposure, sigma, spot):
    """Return the light of the declared model."""
    return spot


def ghost(dx, dy, angle, exposure, sigma, spot):
    """Return light with a copy of the spot, 6 % as bright, 12 px to the right and 5 px up."""
    return spot + 0.06 * np.max(spot) * np.exp(-((dx - 12) ** 2 + (dy + 5) ** 2) / (2 * sigma**2))


def bump(dx, dy, angle, exposure, sigma, spot):
    """Return light with a round ring from 1.6 to 1.9 widths, at 45° and the longer exposure alone."""
    radius = np.hypot(dx, dy) / sigma
    return spot + 8.0 * (angle == 45 and exposure == EXPOSURES[-1]) * ((radius > 1.6) & (radius < 1.9))


def draw_small(
    light: Light = plain,
    angles: Sequence[float | None] = ANGLES,
    exposures: Sequence[float | None] = EXPOSURES,
    repeats: int = REPEATS,
    seed: int = 4,
) -> list[SmallFrame]:
    """Return random frames, one of each angle, repeat and exposure in this order; the centre is that of the site."""
    rng = np.random.default_rng(seed)
    widths = {t: SIGMA if t is None else P1 * np.log(t) + P2 for t in exposures}
    strength = {t: 1.0 if t is None else t / widths[t] ** 2 for t in exposures}
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    drawn = []
    for angle in angles:
        for repeat in range(repeats):
            x0, y0 = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            for t in exposures:
                sigma, peak = widths[t], PEAK * strength[t] / max(strength.values())
                spot = peak * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))
                readings = draw(light(x - x0, y - y0, angle, t, sigma, spot), t or 1.0, SENSOR, rng)
                drawn.append(SmallFrame(angle, t, repeat, readings, peak, sigma, x0, y0))
    return drawn


def write_dataset(base: Path, frames: Sequence[SmallFrame], more: str = "") -> Dataset:
    """Write frames as a dataset called small; `more` goes into its instrument file."""
    blank = lambda value: "" if value is None else value  # noqa: E731
    rows = [f"frames/f{k}.tif,spot,{blank(f.angle_deg)},{blank(f.exposure_s)},{f.repeat}" for k, f in enumerate(frames)]
    model = "" if any(f.exposure_s is None for f in frames) else ", model: {photon_budget: linear}"
    folder(base, rows, f"{{name: small, crop_px: {SIDE}, sensor: {STATED}{model}{more}}}")
    for k, frame in enumerate(frames):
        tifffile.imwrite(base / f"frames/f{k}.tif", frame.readings)
    return load(base)
