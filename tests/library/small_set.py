"""A small set of frames with a known disagreement, drawn by numpy alone."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from spotcheck.dataset import Dataset, load
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Law
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.frames import Setting
from spotcheck.old_engine.observe.shots import Shot
from tests.library.conftest import folder
from tests.reference.numpy_chain import draw

SIDE = 60
SENSOR = SensorModel(0.11, 6.0, 0.0, np.inf, 12.0, 1023.0)
ANGLES, EXPOSURES, REPEATS = (0.0, 45.0), (1e-4, 4e-4), 3
LAW = Law(1.2, 18.0, 600.0)
# x, y [px] from the spot's centre, angle [deg], exposure [s], sigma [px], spot [DN] → light [DN].
Light = Callable[..., np.ndarray]


def plain(dx, dy, angle, exposure, sigma, spot):
    """The base model's own spot."""
    return spot


def ghost(dx, dy, angle, exposure, sigma, spot):
    """With a copy, 6 % as bright, 12 px to the right and 5 px up."""
    peak = np.max(spot)
    return spot + 0.06 * peak * np.exp(-((dx - 12) ** 2 + (dy + 5) ** 2) / (2 * sigma**2))


def bump(dx, dy, angle, exposure, sigma, spot):
    """With a round ring of light from 1.6 to 1.9 widths, at 45° and the longer exposure alone."""
    radius = np.hypot(dx, dy) / sigma
    own = angle == 45 and exposure == EXPOSURES[-1]
    return spot + 8.0 * own * ((radius > 1.6) & (radius < 1.9))


def frames(
    light: Light = plain,
    angles: Sequence[float | None] = ANGLES,
    exposures: Sequence[float | None] = EXPOSURES,
    repeats: int = REPEATS,
    after: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None,
    seed: int = 4,
    sensor: SensorModel = SENSOR,
) -> tuple[list[Shot], np.ndarray, Setting]:
    """Random frames, the true peak [DN], width, x and y [px] of each, and the setting; `after` alters the readings [DN]
    of a frame."""
    rng = np.random.default_rng(seed)
    known = [t for t in exposures if t is not None]
    baseline = Baseline(0.0, "linear" if known else "free", False, max(known, default=1.0))
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    shots, rows = [], []
    for angle in angles:
        for repeat in range(repeats):
            x0, y0 = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            for exposure in exposures:
                t = baseline.longest_s if exposure is None else exposure
                sigma = float(LAW.p1 * np.log(t) + LAW.p2) if known else 7.0
                peak = LAW.peak * float(baseline.relative_peak(t, LAW.p1, LAW.p2)) if known else LAW.peak
                spot = peak * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))
                image = draw(light(x - x0, y - y0, angle, exposure, sigma, spot), t, sensor, rng).astype(float)
                image = after(image, rng) if after else image
                shots.append(Shot(angle, exposure, repeat, len(shots), (), 0, 0, lambda image=image: image))
                rows.append((peak, sigma, x0, y0))
    return shots, np.array(rows), Setting(baseline, sensor, (0.0, 0.0, 0.0), SIDE, SIDE)


def present(name: str, *values: float, form: str | None = None) -> Present:
    """An effect of the vocabulary with values."""
    effect = vocabulary()[name]
    return Present(effect, effect.forms[0] if form is None else form, values)


def dataset(base: Path, angles=ANGLES, exposures=EXPOSURES, repeats: int = REPEATS, more: str = "") -> Dataset:
    """The dataset folder that such frames would lie in."""
    blank = lambda value: "" if value is None else value  # noqa: E731
    cells = [(a, t, r) for a in angles for r in range(repeats) for t in exposures]
    rows = [f"frames/f{k}.tif,spot,{blank(a)},{blank(t)},{r}" for k, (a, t, r) in enumerate(cells)]
    return load(folder(base, rows, f"{{name: small, crop_px: {SIDE}{more}}}"))
