"""Mechanisms outside the vocabulary. Each draws its form and returns a hook for one stage of the rendering."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import dctn, idctn
from scipy.signal import lfilter

from tests.validation.generators.second.case import Case, Effect
from tests.validation.generators.second.optics import spot

Rng = np.random.Generator


def build(
    stage: str,
    hook: Callable,
    form: dict[str, object],
    unit: str,
    start: float,
    cap: float,
    unknowns: int = 0,
    floor: float = 0.0,
    variance: Callable[[float], float] = lambda s: 1.0,
) -> Effect:
    """An effect whose only parameter is its strength in `unit`."""
    return Effect(
        "",
        lambda s: {"strength": s},
        {**form, "unit": unit, "stage": stage},
        start,
        cap,
        unknowns,
        floor=floor,
        stage=stage,
        hook=hook,
        variance=variance,
    )


def normals(rng: Rng) -> Callable[[int, tuple[int, ...]], np.ndarray]:
    """Normal numbers of a frame, the same at every call."""
    seed = int(rng.integers(2**31))
    return lambda i, shape: np.random.default_rng([seed, i]).standard_normal(shape)


def column_gain(case: Case, rng: Rng) -> Effect:
    """The gain scatters from column to column, anew in every frame (fixed, it would be a fixed pattern)."""
    z = normals(rng)
    return build(
        "electrons",
        lambda e, i, s, noise: e * (1 + s * z(i, (1, case.size))),
        {},
        "fraction rms",
        0.02,
        0.2,
        len(case.frames) * 100,
    )


def two_tap(case: Case, rng: Rng) -> Effect:
    """The right half is read by a second amplifier whose zero is off, by an amount that scatters."""
    z, right = normals(rng), np.arange(case.size) >= case.size // 2
    return build(
        "digital",
        lambda y, i, s: y + s * (1 + 0.3 * z(i, ())) * right,
        {},
        "DN",
        5.0,
        25.0,
    )


def rolling_shade(case: Case, rng: Rng) -> Effect:
    """A lamp-like ripple of the light along the rows' read-out; its phase is new in every frame."""
    z, period = normals(rng), rng.uniform(22, 40)
    rows = np.arange(case.size)[:, None]
    return build(
        "light",
        lambda y, i, s: y * (1 + s * np.cos(2 * np.pi * rows / period + 10 * z(i, ()))),
        {"period_px": period},
        "fraction",
        0.03,
        0.3,
        len(case.frames),
    )


def missing_codes(case: Case, rng: Rng) -> Effect:
    """The first codes of every stretch are missing and read as its lowest one."""
    stretch = int(rng.integers(40, 70))
    return build(
        "codes",
        lambda y, i, s: np.where(y % stretch < round(s), y - y % stretch, y),
        {"every_codes": stretch},
        "codes",
        16.0,
        0.6 * stretch,
    )


def focus_scatter(case: Case, rng: Rng) -> Effect:
    """The width scatters from frame to frame at constant energy."""
    z = normals(rng)
    return build(
        "width",
        lambda width, i, s: width * np.exp(s * z(i, ())),
        {},
        "fraction rms",
        0.02,
        0.15,
        len(case.frames),
    )


def width_by_angle(case: Case, rng: Rng) -> Effect:
    """The width, not the axis ratio, follows the sample's angle."""
    gamma0 = rng.uniform(0, 180)
    angle = np.radians([frame.angle - gamma0 for frame in case.frames])
    return build(
        "width",
        lambda width, i, s: width * (1 + s * np.cos(2 * angle[i])),
        {"gamma0_deg": gamma0},
        "fraction",
        0.02,
        0.2,
    )


def pixel_crosstalk(case: Case, rng: Rng) -> Effect:
    """Collected charge leaks to the diagonal neighbour: the noise is correlated, the spot hardly changes."""
    step = int(rng.choice([-1, 1]))
    return build(
        "electrons",
        lambda e, i, s, noise: (1 - s) * e + s * np.roll(e, (1, step), (0, 1)),
        {"dx": step, "dy": 1},
        "fraction",
        0.08,
        0.3,
        0,
        rng.uniform(0.08, 0.2),
        variance=lambda s: (1 - s) ** 2 + s**2,
    )


def amplifier_tail(case: Case, rng: Rng) -> Effect:
    """Undershoot that trails along the row after bright pixels."""
    keep = np.exp(-1 / rng.uniform(10, 25))

    def hook(e: np.ndarray, i: int, s: float, noise: Rng | None) -> np.ndarray:
        return e - s * lfilter([0.0, 1 - keep], [1.0, -keep], e, axis=1)

    return build("electrons", hook, {"kept_per_px": float(keep)}, "fraction", 0.05, 0.4)


def donut(case: Case, rng: Rng) -> Effect:
    """A narrow dip in the middle of the beam."""
    width = rng.uniform(0.25, 0.5)
    return build(
        "profile",
        lambda y, i, s, half_square: y * (1 - s * np.exp(-half_square / width**2)),
        {"width_sigma": width},
        "depth",
        0.1,
        0.9,
    )


def skew(case: Case, rng: Rng) -> Effect:
    """Coma: wider on one side of the centre than on the other."""
    angle = rng.uniform(0, 2 * np.pi)
    c, k = np.cos(angle), np.sin(angle)

    def hook(d: tuple[np.ndarray, np.ndarray], i: int, s: float) -> tuple[np.ndarray, np.ndarray]:
        along, across = c * d[0] + k * d[1], c * d[1] - k * d[0]
        along = along / np.where(along > 0, 1 + s, 1 - s)
        return c * along - k * across, k * along + c * across

    return build("coordinates", hook, {"direction_deg": float(np.degrees(angle))}, "fraction", 0.1, 0.6)


def image_lag(case: Case, rng: Rng) -> Effect:
    """A part of the previous frame's spot is still there."""
    return build(
        "light",
        lambda y, i, s: y + s * spot(case.only(), i - 1) if i else y,
        {},
        "fraction",
        0.05,
        0.4,
    )


def second_spot(case: Case, rng: Rng) -> Effect:
    """A small lamp: its place, width and brightness do not follow the spot."""
    angle, distance, width = rng.uniform(0, 2 * np.pi), rng.uniform(20, 70), rng.uniform(3, 6)
    axis = np.arange(case.size) - (case.size - 1) / 2
    dx, dy = axis[None, :] - distance * np.cos(angle), axis[:, None] - distance * np.sin(angle)
    blob = np.exp(-(dx**2 + dy**2) / (2 * width**2))
    form = {"direction_deg": float(np.degrees(angle)), "distance_px": distance, "sigma_px": width}
    return build("light", lambda y, i, s: y + s * blob, form, "DN", 40.0, 300.0)


def newton_rings(case: Case, rng: Rng) -> Effect:
    """Concentric rings of interference whose phase is new in every frame."""
    z, scale, at = normals(rng), rng.uniform(25, 40), (case.size - 1) / 2 + rng.uniform(-20, 20, 2)
    axis = np.arange(case.size)
    square = ((axis[None, :] - at[0]) ** 2 + (axis[:, None] - at[1]) ** 2) / scale**2
    return build(
        "light",
        lambda y, i, s: y * (1 + s * np.cos(2 * np.pi * square + 10 * z(i, ()))),
        {"scale_px": scale, "x_px": float(at[0]), "y_px": float(at[1])},
        "fraction",
        0.03,
        0.3,
    )


def rts_pixels(case: Case, rng: Rng) -> Effect:
    """A few pixels blink between two levels from frame to frame."""
    share, z = rng.uniform(0.005, 0.02), normals(rng)
    blinking = rng.random((case.size, case.size)) < share
    return build(
        "digital",
        lambda y, i, s: y + s / 2 * np.sign(z(i, y.shape)) * blinking,
        {"share": share},
        "DN",
        40.0,
        120.0,
        len(case.frames) * int(blinking.sum()),
        40.0,
    )


def offset_wander(case: Case, rng: Rng) -> Effect:
    """The zero of the whole frame scatters from frame to frame around the black level."""
    z = normals(rng)
    return build("digital", lambda y, i, s: y + s * z(i, ()), {}, "DN rms", 3.0, 8.0, len(case.frames))


def block_compression(case: Case, rng: Rng) -> Effect:
    """Blocks of 8 x 8 px whose cosine coefficients are rounded, the finer ones more coarsely."""
    frequency = np.add.outer(np.arange(8), np.arange(8))
    n = case.size // 8

    def hook(y: np.ndarray, i: int, s: float) -> np.ndarray:
        step = s * (1 + frequency / 2)
        blocks = y.reshape(n, 8, n, 8).swapaxes(1, 2)
        rounded = np.rint(dctn(blocks, axes=(2, 3), norm="ortho") / step) * step
        return np.rint(idctn(rounded, axes=(2, 3), norm="ortho").swapaxes(1, 2).reshape(y.shape))

    return build("codes", hook, {}, "DN, coarseness of the mean", 10.0, 60.0)


def excess_shot_noise(case: Case, rng: Rng) -> Effect:
    """A multiplication stage: noise that grows with the signal beyond Poisson's."""

    def hook(e: np.ndarray, i: int, s: float, noise: Rng | None) -> np.ndarray:
        return e if noise is None else e + np.sqrt(s * e) * noise.standard_normal(e.shape)

    return build("electrons", hook, {}, "variance fraction", 0.3, 2.0, 0, rng.uniform(0.3, 1.0), lambda s: 1 + s)


MECHANISMS: dict[str, Callable[[Case, Rng], Effect]] = {
    draw.__name__: draw
    for draw in (
        column_gain,
        two_tap,
        rolling_shade,
        missing_codes,
        focus_scatter,
        width_by_angle,
        pixel_crosstalk,
        amplifier_tail,
        donut,
        skew,
        image_lag,
        second_spot,
        newton_rings,
        rts_pixels,
        offset_wander,
        block_compression,
        excess_shot_noise,
    )
}
