"""Frames of Gaussian spots drawn by numpy alone: what no part of the library had a hand in.

Poisson electrons, normal read noise, gain, black level, rounding, and a converter that ends at 0 and at full scale;
and a few things that no baseline has, to see whether they are noticed.
"""

from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.pixels import Frame, Model, Numbers

FULL_SCALE = 1023.0
LONGEST_S = 9e-4


class Setup(NamedTuple):
    """Gain [DN/e-], read noise [e-], black level [DN], side of a crop [px], angles, exposures [s], repeats, peak [DN]
    at the longest exposure, and σ_g there as a part of the side."""

    gain: float = 0.11
    noise: float = 6.0
    black: float = 12.0
    side: int = 96
    angles: int = 4
    exposures: tuple[float, ...] = (1e-4, 3e-4, 9e-4)
    repeats: int = 4
    peak: float = 700.0
    width: float = 1 / 13


class Groups(NamedTuple):
    """Site and condition of every frame."""

    site: np.ndarray
    condition: np.ndarray


def view_of(side: int, exposure_s: float, order: float = 0.0) -> View:
    """The chain's view of a crop at the sensor's corner."""
    one = np.zeros((1, 1, 1))
    axis = np.arange(side, dtype=float)
    return View(
        x=axis[None, None], y=axis[None, :, None], x0=one, y0=one, exposure_s=one + exposure_s, angle=one,
        order=one + order, wave_cos=one, wave_sin=one, longest_s=LONGEST_S, reference_s=LONGEST_S, frame_x=0.0,
        frame_y=0.0, frame_rows=float(side), rows_each=1.0,
    )  # fmt: skip


def draw(rng: np.random.Generator, setup: Setup, effect: dict[str, float] | None = None):
    """Frames, a model whose numbers are near the truth, and the design."""
    effect = effect or {}
    side, longest = setup.side, setup.width * setup.side
    p1 = longest / 15
    p2 = longest - p1 * np.log(LONGEST_S)
    x, y = np.arange(side)[None, :], np.arange(side)[:, None]
    frames, numbers, site, condition = [], [], [], []
    for place in range(setup.angles * setup.repeats):
        x0, y0 = side / 2 + rng.uniform(-2, 2, 2)
        for j, t in enumerate(setup.exposures):
            width = p1 * np.log(t) + p2
            peak = setup.peak * t / LONGEST_S * (longest / width) ** 2 * np.exp(effect.get("power", 0.0) * rng.normal())
            at = (x0, y0) + effect.get("jitter", 0.0) * rng.standard_normal(2)
            light = peak * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * width**2))
            light = light * (1 + effect.get("bump", 0.0) * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / width**2))
            wave = np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / 9)
            light = light * (1 + effect.get("stripes", 0.0) * wave) + effect.get("pedestal", 0.0)
            electrons = rng.poisson(light / setup.gain) + setup.noise * effect.get("noise", 1.0) * rng.standard_normal(
                light.shape
            )
            signal = np.minimum(setup.gain * electrons, effect.get("clip", np.inf))
            signal = signal + setup.black + effect.get("rows", 0.0) * rng.standard_normal((side, 1))
            signal[3, 5] += effect.get("hot", 0.0)
            frames.append(Frame(np.clip(np.rint(signal), 0, FULL_SCALE), view_of(side, t)))
            numbers.append((np.log(peak), np.log(width), *at) + 0.02 * rng.standard_normal(4))
            site.append(place)
            condition.append(place % setup.angles * len(setup.exposures) + j)
    sensor = SensorModel(setup.gain, setup.noise, black_level_dn=setup.black, full_scale_dn=FULL_SCALE)
    model = Model(Baseline(0.0, "linear", False, LONGEST_S), sensor, (), Numbers(*np.array(numbers).T.copy()))
    return frames, model, Groups(np.array(site), np.array(condition))


def any_setup(rng: np.random.Generator, single: bool) -> Setup:
    """A camera and a crop drawn at random, over what cameras are like."""
    setup = Setup(
        gain=float(rng.uniform(0.1, 0.3)), noise=float(np.exp(rng.uniform(np.log(2), np.log(13)))),
        black=float(rng.choice([0.0, rng.uniform(0, 20)])), side=int(rng.integers(60, 121)),
        peak=float(rng.uniform(200, 800)), width=float(rng.uniform(1 / 16, 1 / 9)),
    )  # fmt: skip
    return setup._replace(angles=1, repeats=1, exposures=(LONGEST_S,)) if single else setup
