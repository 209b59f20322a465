"""Mechanisms outside the vocabulary that no static shape holds. Each draws its form and returns a hook for one stage of
the rendering."""

from collections.abc import Callable

import numpy as np

from tests.validation.generators.second.case import FULL_SCALE, Case, Effect
from tests.validation.generators.second.optics import spot

Rng = np.random.Generator
Normals = Callable[[int, tuple[int, ...]], np.ndarray]


def build(
    stage: str,
    hook: Callable,
    form: dict[str, object],
    unit: str,
    start: float,
    cap: float,
    floor: float = 0.0,
    variance: Callable[[float], float] = lambda s: 1.0,
) -> Effect:
    """An effect whose only parameter is its strength in `unit`."""
    form = {**form, "unit": unit, "stage": stage}
    return Effect(lambda s: {"strength": s}, form, start, cap, floor=floor, stage=stage, hook=hook, variance=variance)


def normals(rng: Rng) -> Normals:
    """Normal numbers of a frame, the same at every call."""
    seed = int(rng.integers(2**31))
    return lambda i, shape: np.random.default_rng([seed, i]).standard_normal(shape)


def ripples(phase: np.ndarray, z: Normals) -> Callable[[np.ndarray, int, float], np.ndarray]:
    """A hook that modulates light by waves of a phase [pixel, rad], to which every frame adds one of its own."""
    return lambda y, i, s: y * (1 + s * np.cos(phase + 10 * z(i, ())))


def _middle(case: Case) -> np.ndarray:
    return np.arange(case.size) - (case.size - 1) / 2


def vignetting(case: Case, rng: Rng) -> Effect:
    """The light falls off from a point of the sensor, so the spot's light depends on where it lies."""
    away, angle = rng.uniform(60, 160), rng.uniform(0, 2 * np.pi)
    x, y = away * np.cos(angle), away * np.sin(angle)
    square = ((_middle(case)[None, :] - x) ** 2 + (_middle(case)[:, None] - y) ** 2) / 100**2
    form: dict[str, object] = {"x_px": x, "y_px": y}
    return build("light", lambda image, i, s: image * np.maximum(1 - s * square, 0.0), form, "per (100 px)²", 0.03, 0.3)


def flicker_rows(case: Case, rng: Rng) -> Effect:
    """Offsets of rows with a spectrum of one over f, anew in every frame."""
    z = normals(rng)
    f = np.fft.rfftfreq(case.size)
    shape = np.where(f > 0, 1 / np.sqrt(np.maximum(f, f[1])), 0.0)

    def hook(y: np.ndarray, i: int, s: float) -> np.ndarray:
        row = np.fft.irfft(np.fft.rfft(z(i, (case.size,))) * shape, case.size)
        return y + s * (row / row.std())[:, None]

    return build("digital", hook, {}, "DN rms", 1.0, 15.0)


def trefoil_by_exposure(case: Case, rng: Rng) -> Effect:
    """A threefold lobe on the spot's contour that grows with exposure, as a lens does that warms."""
    turned, longest = rng.uniform(0, 2 * np.pi / 3), case.exposures[-1]

    def hook(d: tuple[np.ndarray, np.ndarray], i: int, s: float) -> tuple[np.ndarray, np.ndarray]:
        part = s * case.frames[i].exposure / longest
        factor = 1 - part * np.cos(3 * (np.arctan2(d[1], d[0]) - turned))
        return d[0] * factor, d[1] * factor

    return build("coordinates", hook, {"direction_deg": float(np.degrees(turned))}, "of the radius", 0.01, 0.3)


def dust(case: Case, rng: Rng) -> Effect:
    """Specks on the sensor's window dim what is behind them, while the spot moves and scales."""
    count, shade = int(rng.integers(2, 6)), np.zeros((case.size, case.size))
    at, width = rng.normal(0, 14, (count, 2)), rng.uniform(2, 6, count)
    for (x, y), own in zip(at, width, strict=True):
        square = (_middle(case)[None, :] - x) ** 2 + (_middle(case)[:, None] - y) ** 2
        shade = np.maximum(shade, np.exp(-square / (2 * own**2)))
    return build("light", lambda image, i, s: image * (1 - s * shade), {"specks": count}, "depth", 0.03, 0.8)


def bad_frames(case: Case, rng: Rng) -> Effect:
    """One frame in twenty is spoilt: part of the beam is blocked, as much as is drawn."""
    count = max(1, round(len(case.frames) / 20))
    bad = np.sort(rng.choice(len(case.frames), count, replace=False))
    edge = _middle(case)[:, None] > rng.uniform(-5, 10)

    def hook(image: np.ndarray, i: int, s: float) -> np.ndarray:
        return image * (1 - s * edge) if i in bad else image

    effect = build("light", hook, {"frames": bad.tolist()}, "part", 0.3, 0.9, floor=rng.uniform(0.3, 0.9))
    effect.state["frames"] = bad
    return effect


def second_spot_sometimes(case: Case, rng: Rng) -> Effect:
    """A faint second spot of another lamp in some of the frames."""
    some = rng.random(len(case.frames)) < rng.uniform(0.15, 0.4)
    some[int(rng.integers(len(some)))] = True
    distance, angle, width = rng.uniform(20, 60), rng.uniform(0, 2 * np.pi), rng.uniform(4, 9)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    blob = np.exp(-((_middle(case)[None, :] - x) ** 2 + (_middle(case)[:, None] - y) ** 2) / (2 * width**2))
    form: dict[str, object] = {"frames": int(some.sum())}
    return build("light", lambda image, i, s: image + s * some[i] * blob, form, "DN", 10.0, 300.0)


def gain_of_halves(case: Case, rng: Rng) -> Effect:
    """The right half of the sensor has an amplifier of another gain."""
    right = np.arange(case.size) >= case.size / 2 + rng.uniform(-10, 10)
    return build("digital", lambda y, i, s: y + s * (y - case.black) * right, {}, "part", 0.02, 0.2)


def converter_steps(case: Case, rng: Rng) -> Effect:
    """The converter's transfer has steps where a bit turns over: every second stretch of codes lies higher."""
    every = int(rng.choice([32, 64, 128]))

    def hook(y: np.ndarray, i: int, s: float) -> np.ndarray:
        return np.minimum(y + np.ceil(s) * (np.floor(y / every) % 2), FULL_SCALE)

    return build("codes", hook, {"every_codes": every}, "codes", 2.0, 20.0)


def column_gain(case: Case, rng: Rng) -> Effect:
    """The gain scatters from column to column, anew in every frame (fixed, it would be a fixed pattern)."""
    z = normals(rng)

    def hook(e: np.ndarray, i: int, s: float, noise: Rng | None) -> np.ndarray:
        return e * (1 + s * z(i, (1, case.size)))

    return build("electrons", hook, {}, "fraction rms", 0.02, 0.2)


def two_tap(case: Case, rng: Rng) -> Effect:
    """The right half is read by a second amplifier whose zero is off, by an amount that scatters."""
    z, right = normals(rng), np.arange(case.size) >= case.size // 2
    return build("digital", lambda y, i, s: y + s * (1 + 0.3 * z(i, ())) * right, {}, "DN", 5.0, 25.0)


def rolling_shade(case: Case, rng: Rng) -> Effect:
    """A lamp-like ripple of the light along the rows' read-out; its phase is new in every frame."""
    z, period = normals(rng), rng.uniform(22, 40)
    phase = 2 * np.pi * np.arange(case.size)[:, None] / period
    return build("light", ripples(phase, z), {"period_px": period}, "fraction", 0.03, 0.3)


def focus_scatter(case: Case, rng: Rng) -> Effect:
    """The width scatters from frame to frame at constant energy."""
    z = normals(rng)
    return build("width", lambda width, i, s: width * np.exp(s * z(i, ())), {}, "fraction rms", 0.02, 0.15)


def width_by_angle(case: Case, rng: Rng) -> Effect:
    """The width, not the axis ratio, follows the sample's angle."""
    gamma0 = rng.uniform(0, 180)
    angle = np.radians([frame.angle - gamma0 for frame in case.frames])

    def hook(width: float, i: int, s: float) -> float:
        return width * (1 + s * np.cos(2 * angle[i]))

    return build("width", hook, {"gamma0_deg": gamma0}, "fraction", 0.02, 0.2)


def image_lag(case: Case, rng: Rng) -> Effect:
    """A part of the previous frame's spot is still there."""
    return build("light", lambda y, i, s: y + s * spot(case.only(), i - 1) if i else y, {}, "fraction", 0.05, 0.4)


def newton_rings(case: Case, rng: Rng) -> Effect:
    """Concentric rings of interference whose phase is new in every frame."""
    z, scale, at = normals(rng), rng.uniform(25, 40), (case.size - 1) / 2 + rng.uniform(-20, 20, 2)
    axis = np.arange(case.size)
    square = ((axis[None, :] - at[0]) ** 2 + (axis[:, None] - at[1]) ** 2) / scale**2
    form: dict[str, object] = {"scale_px": scale, "x_px": float(at[0]), "y_px": float(at[1])}
    return build("light", ripples(2 * np.pi * square, z), form, "fraction", 0.03, 0.3)


def offset_wander(case: Case, rng: Rng) -> Effect:
    """The zero of the whole frame scatters from frame to frame around the black level."""
    z = normals(rng)
    return build("digital", lambda y, i, s: y + s * z(i, ()), {}, "DN rms", 3.0, 8.0)


def excess_shot_noise(case: Case, rng: Rng) -> Effect:
    """A multiplication stage: noise that grows with the signal beyond Poisson's."""

    def hook(e: np.ndarray, i: int, s: float, noise: Rng | None) -> np.ndarray:
        return e if noise is None else e + np.sqrt(s * e) * noise.standard_normal(e.shape)

    floor = rng.uniform(0.3, 1.0)
    return build("electrons", hook, {}, "variance fraction", 0.3, 2.0, floor, lambda s: 1 + s)


MECHANISMS: dict[str, Callable[[Case, Rng], Effect]] = {
    draw.__name__: draw
    for draw in (
        *(image_lag, vignetting, flicker_rows, converter_steps, width_by_angle, trefoil_by_exposure),
        *(dust, bad_frames, second_spot_sometimes, gain_of_halves, two_tap, focus_scatter),
        *(rolling_shade, column_gain, newton_rings, offset_wander, excess_shot_noise),
    )
}
# What acts in few frames: those are looked at, and its strength is as it was drawn.
RARE = ("bad_frames",)
# What needs several exposures.
NEEDS = {"trefoil_by_exposure": ("default",)}
