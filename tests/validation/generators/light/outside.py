"""Mechanisms outside the vocabulary that no static shape holds: some of the second generator's, and more."""

from collections.abc import Callable

import numpy as np

from tests.validation.generators.second import outside as second
from tests.validation.generators.second.case import FULL_SCALE, Case, Effect
from tests.validation.generators.second.outside import Rng, build, normals


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
    return build(
        "light", lambda image, i, s: image + s * some[i] * blob, {"frames": int(some.sum())}, "DN", 10.0, 300.0
    )


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


MECHANISMS: dict[str, Callable[[Case, Rng], Effect]] = {
    draw.__name__: draw
    for draw in (
        second.image_lag,
        vignetting,
        flicker_rows,
        converter_steps,
        second.width_by_angle,
        trefoil_by_exposure,
        dust,
        bad_frames,
        second_spot_sometimes,
        gain_of_halves,
        second.two_tap,
        second.focus_scatter,
        second.rolling_shade,
        second.column_gain,
        second.newton_rings,
        second.offset_wander,
        second.excess_shot_noise,
    )
}
# What acts in few frames: those are looked at, and its strength is as it was drawn.
RARE = ("bad_frames",)
# What needs several exposures.
NEEDS = {"trefoil_by_exposure": ("default",)}
