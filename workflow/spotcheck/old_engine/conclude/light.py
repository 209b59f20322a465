"""What the light is, once its shape is learned: how much of it lies elsewhere than declared, and where.

A learned shape S shares with the frames' numbers what makes all frames brighter, wider or moved. So the declared shape
B is first brought to the brightness A, width w and centre (a, b) that minimise ∫(S − A B)²; then s = S/A − B is
orthogonal to B, ∂B/∂x, ∂B/∂y and ∂B/∂σ, and lengths are in the σ of that B. S has noise of the fit in it: draws of its
coefficients, brought to the same gauge, tell errors, and what noise adds to a size.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg, ndimage, optimize

from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.judgement import Light
from spotcheck.old_engine.conclude.modes import Modes
from spotcheck.old_engine.model import chain
from spotcheck.old_engine.model.chain import Free, View
from spotcheck.old_engine.model.effect import Effect, Place, Present
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.nuisance.fit import Fitted, splines_of
from spotcheck.old_engine.nuisance.taken import draws_of
from spotcheck.old_engine.observe.pixels import Frame, Model, Numbers

# Rings [σ] and directions by which integrals are taken: half a step of the finest splines that are learned, and as fine
# at 2.4 σ, beyond which there is hardly any light.
RING, DIRECTIONS = 0.06, 256
# Azimuthal orders that are told apart, from 0 on.
ORDERS = 9
# Draws of the noise: what it adds to a size to 1 part in 60 of its scatter, errors to 1 part in 11.
DRAWS = 64
# What noise adds depends on the true s, for which that part of s stands whose power within so many σ of the radius is
# more than so many times the noise's. On three kinds of s at all strengths what was taken off then was wrong by up to
# this part of noise's own size, which is in the error.
NEAR, ABOVE, WRONG = 0.5, 2.0, 0.1
# The whole shape is below 0 where it is so by so many standard deviations: 64 draws tell these, some 8,000 splines lie
# within reach, and by Student's law one light in 2,000 does so by chance.
BELOW = 6.0
# Part of the power that one order must have to be most of it.
MOST = 0.5
# How far below 0 the shape must fall for a person to be told [peaks]: at a kink splines themselves fall by 0.0015.
FALLS = 0.005
LOBES = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


class Gauge(NamedTuple):
    """Brightness A [1], width w [σ] and centre (a, b) [σ] at which the declared shape is nearest to the whole one."""

    bright: float
    wide: float
    x: float
    y: float


REST = Gauge(1.0, 1.0, 0.0, 0.0)


class Seen(NamedTuple):
    """What pixels see of a spot: from `left` to `right` and from `top` to `bottom` of its centre [σ]. Beyond, a learned
    shape is anything, and the declared one stands."""

    left: float = -np.inf
    right: float = np.inf
    top: float = -np.inf
    bottom: float = np.inf

    def __call__(self, u, v) -> np.ndarray:
        """Whether places are seen."""
        return (u >= self.left) & (u <= self.right) & (v >= self.top) & (v <= self.bottom)


ALL = Seen()


def seen_of(frames: Sequence[Frame], model: Model) -> list[Seen]:
    """Of every light that is learned, what the pixels of some of its frames at least see."""
    own, width = model.numbers, np.exp(model.numbers.log_width)
    ends = [[(axis.min(), axis.max()) for axis in (frame.view.x, frame.view.y)] for frame in frames]
    (left, right), (top, bottom) = np.moveaxis(np.array(ends), 0, -1)
    low, high = ((left - own.x) / width, (top - own.y) / width), ((right - own.x) / width, (bottom - own.y) / width)
    out: list[Seen] = []
    if model.lights is None:
        return out
    for light in range(len(model.lights.coefficients)):
        at = model.lights.which == light
        (left, top), (right, bottom) = [v[at].min() for v in low], [v[at].max() for v in high]
        out.append(Seen(float(left), float(right), float(top), float(bottom)))
    return out


def light_of(fitted: Fitted, seen: Seen = ALL, light: int = 0, seed: int = 0) -> Light:
    """What a fit with learned shapes found of one of its lights; `power` scatters about 0 where there is nothing but
    noise."""
    model, gauge = fitted.model, gauge_of(fitted.model, seen, light)
    shape = gauged(model, gauge, seen, light)
    u, v, area = _rings(shape.reach)
    declared, own = _declared(model, u, v, REST), shape(u, v)
    whole = own + declared
    noise = _noise(fitted, light, gauge, shape, u, v, seed) * seen(gauge.wide * u + gauge.x, gauge.wide * v + gauge.y)
    total = float((whole * area).sum())
    power, error = _power(own, noise, area / total)
    parts = _orders(own, area) - np.mean([_orders(n, area) for n in noise], axis=0)
    parts = np.clip(parts, 0.0, None) / max(np.clip(parts, 0.0, None).sum(), 1e-300)
    orders = parts[:ORDERS] if power > criteria.STATED.value * error else np.zeros(ORDERS)
    below = whole + BELOW * np.sqrt(np.mean(noise**2, axis=0)) < 0
    lowest = float(whole[below].min()) if below.any() else max(float(whole.min()), 0.0)
    return Light(power, error, tuple(map(float, orders)), _axes(whole * area / total, u, v), lowest, shape)


def described(light: Light, modes: Modes | None = None, declared: str = "a Gaussian's") -> str:
    """What a person is told of a light, from its share on and without a full stop."""
    if light.power <= criteria.STATED.value * light.error:
        most = max(light.power, 0.0) + 2 * light.error
        return f"less than {100 * most:.2g} % of the light lies elsewhere than {declared}"
    said = f"{100 * light.power:.2g} % of the light lies elsewhere than {declared}, {_pattern(light)}"
    if modes is not None:
        parts = [f"{100 * part:.2g} % TEM{m}{n}" for (m, n), part in modes.parts.items()]
        said += f", as if it were {' and '.join(', '.join(parts).rsplit(', ', 1))}"
    if light.lowest < -FALLS:
        said += f"; the learned shape falls to {100 * light.lowest:.2g} % of its peak, as no light does".replace(
            "-", "−"
        )
    return said


def _pattern(light: Light) -> str:
    """Where most of the power lies."""
    order = int(np.argmax(light.orders))
    if light.orders[order] < MOST:
        return "in no simple pattern"
    if order == 2:
        major, minor, direction = light.axes
        if minor > 0:
            return f"most of it in a spot {major / minor:.3g} times as long as wide, along {direction:.0f}°"
    where = {0: "rings about the centre", 1: "one side"}.get(order, f"{LOBES[order]} lobes")
    return f"most of it {'to' if order == 1 else 'in'} {where}"


def present_of(light: Light, effects: Iterable[Effect]) -> Present | None:
    """The effect that stands for a light in a model, where one of `effects` does."""
    effect = next((own for own in effects if own.place is Place.SHAPE), None)
    values = (float(np.clip(light.power, 0.0, 1.0)), float(np.argmax(light.orders)))
    return None if effect is None else Present(effect, effect.forms[0], values)


def described_by_pose(lights: Sequence[Light]) -> str:
    """What a person is told of lights that differ from pose to pose."""
    powers = [100 * max(own.power, 0.0) for own in lights]
    worst = described(max(lights, key=lambda own: own.power))
    return (
        f"it has another shape in each of {len(lights)} poses, {min(powers):.2g} to {max(powers):.2g} %"
        f" of the light elsewhere than a Gaussian's; where it is most, {worst}"
    )


def attributes_of(light: Light) -> dict[str, Any]:
    """What describes a light in its file."""
    major, minor, direction = light.axes
    return {
        "described": described(light),
        "power": light.power,
        "power_stderr": light.error,
        "orders": np.array(light.orders),
        "major_over_sigma": major,
        "minor_over_sigma": minor,
        "direction_deg": direction,
        "lowest": light.lowest,
    }


def in_gauge(model: Model, seen: Sequence[Seen] = (ALL,)) -> Model:
    """A model in the gauge of each of its shapes: the same light, as a verdict gives it.

    # ASSUME: A and w are so near to 1, and (a, b) to 0, that effects which go with a spot's peak, width or stretched
    # coordinates need no other values.
    """
    own, lights, width = model.numbers, model.lights, np.exp(model.numbers.log_width)
    assert lights is not None
    gauges = [gauge_of(model, mine, k) for k, mine in enumerate(seen)]
    shapes = [gauged(model, gauge, mine, k) for k, (gauge, mine) in enumerate(zip(gauges, seen, strict=True))]
    bright, wide, x, y = np.array(gauges)[lights.which].T
    numbers = Numbers(own.log_peak + np.log(bright), own.log_width + np.log(wide), own.x + x * width, own.y + y * width)
    side = max(len(shape.coefficients) for shape in shapes)
    # A shape that reaches less far is 0 beyond.
    padded = [np.pad(shape.coefficients, (side - len(shape.coefficients)) // 2) for shape in shapes]
    return model._replace(lights=lights._replace(coefficients=np.array(padded)), numbers=numbers)


def gauge_of(model: Model, seen: Seen = ALL, light: int = 0) -> Gauge:
    """The gauge of one of a model's learned shapes."""
    learned = _learned(model, light)
    u, v, area = _rings(learned.reach)
    whole, heavy = _declared(model, u, v, REST) + learned(u, v) * seen(u, v), np.sqrt(area)

    def off(own: np.ndarray) -> np.ndarray:
        return (heavy * (whole - _declared(model, u, v, _gauge(own)))).ravel()

    return _gauge(optimize.least_squares(off, np.zeros(4), xtol=1e-10, ftol=1e-12).x)


def gauged(model: Model, gauge: Gauge, seen: Seen = ALL, light: int = 0) -> LightShape:
    """What one of the whole shapes of a model has beside the declared one in a gauge: with all peaks times A, widths
    times w and centres moved by (a, b) σ it is the same light."""
    learned = _learned(model, light)
    side = 2 * int(np.ceil(learned.reach / (gauge.wide * learned.step))) + 1
    nodes = learned.step * (np.arange(side) - (side - 1) / 2)
    u, v = nodes[None, :], nodes[:, None]
    # B as it was, seen from the gauge.
    before = Gauge(1 / gauge.bright, 1 / gauge.wide, -gauge.x / gauge.wide, -gauge.y / gauge.wide)
    apart = _declared(model, u, v, before) - _declared(model, u, v, REST)
    inside = seen(gauge.wide * u + gauge.x, gauge.wide * v + gauge.y)
    return through(apart + _seen(learned, gauge, u, v) * inside, learned.step)


def _learned(model: Model, light: int) -> LightShape:
    assert model.lights is not None
    return model.lights.shapes[light]


def through(values: np.ndarray, step: float) -> LightShape:
    """The surface through values [row, column] at its nodes."""
    band = np.repeat([[1 / 6], [2 / 3], [1 / 6]], len(values), axis=1)
    rows = linalg.solve_banded((1, 1), band, values)
    return LightShape(step, np.ascontiguousarray(linalg.solve_banded((1, 1), band, rows.T).T))


def _gauge(own: np.ndarray) -> Gauge:
    """A gauge from ln A, ln w, a and b."""
    return Gauge(float(np.exp(own[0])), float(np.exp(own[1])), float(own[2]), float(own[3]))


def _seen(own: LightShape, gauge: Gauge, u, v) -> np.ndarray:
    """A surface seen from a gauge, in its peaks [row, column]."""
    return own(gauge.wide * u + gauge.x, gauge.wide * v + gauge.y) / gauge.bright


def _rings(reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places u, v [ring, direction] in σ, and the area that each stands for [σ²]."""
    radius = np.arange(RING / 2, reach, RING)[:, None]
    turn = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    area = np.broadcast_to(radius * RING * 2 * np.pi / DIRECTIONS, (len(radius), DIRECTIONS))
    return radius * np.cos(turn), radius * np.sin(turn), area


def _declared(model: Model, u, v, gauge: Gauge) -> np.ndarray:
    """The declared shape [row, column], with effects that change its profile; at rest of peak 1 and width 1 about 0."""
    one = np.ones((1, 1, 1))
    view = View(u[None], v[None], gauge.x * one, gauge.y * one, one, 0 * one, 0 * one, 0 * one, 0 * one, 1.0, 1.0, 0.0,
                0.0, 1.0, 1.0)  # fmt: skip
    profiles = [own for own in model.present if own.effect.place is Place.PROFILE]
    base = Free(gauge.bright * one, gauge.wide * one)
    return chain.light(view, model.baseline._replace(learned=None), base, profiles)[0][0]


def _noise(fitted: Fitted, light: int, gauge: Gauge, shape: LightShape, u, v, seed: int) -> np.ndarray:
    """Draws of the noise of a gauged shape [draw, ring, direction], without what the gauge takes of it.

    # ASSUME: the shape's noise beside known numbers of frames; what these add sums to 0 over frames, and little of it
    # passes the gauge.
    """
    step = 1e-4
    moved = (REST._replace(wide=1 + step), REST._replace(x=step), REST._replace(y=step))
    declared = _declared(fitted.model, u, v, REST)
    taken = [declared, *((_declared(fitted.model, u, v, own) - declared) / step for own in moved)]
    flat = np.reshape(taken, (4, -1))
    radius = np.hypot(u, v).ravel()
    projected = linalg.solve((flat * radius) @ flat.T, flat * radius, assume_a="pos")
    drawn = draws_of(fitted.schur, splines_of(fitted.model)[1], DRAWS, np.random.default_rng(seed))[:, light]
    noise = np.array([_seen(LightShape(shape.step, own), gauge, u, v).ravel() for own in drawn])
    return (noise - (noise @ projected.T) @ flat).reshape(-1, *u.shape)


def _power(own: np.ndarray, noise: np.ndarray, share: np.ndarray) -> tuple[float, float]:
    """½ ∫|s| without what noise adds to it, and its error; `share` [ring, direction]: each place's part of the whole.

    Noise adds much where s is small, and next to nothing where it is large: what it adds is told by draws of it about
    the part of s that stands out of it, order by order and ring by ring (Wiener's filter).
    """
    radius = share[:, :1]

    def nearby(square: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter1d(radius * square, NEAR / RING, axis=0)

    orders = np.fft.rfft(own, axis=1)
    above = nearby(np.abs(orders) ** 2)
    expected = nearby(np.mean(np.abs(np.fft.rfft(noise, axis=2)) ** 2, axis=0))
    part = np.clip(1 - ABOVE * expected / np.maximum(above, 1e-300), 0.0, 1.0)
    kept = np.fft.irfft(part * orders, own.shape[1], axis=1)
    size, plain = (np.abs(values) * share / 2 for values in (own, kept))
    again = (np.abs(kept + noise) * share / 2).sum(axis=(1, 2))
    alone = (np.abs(noise) * share / 2).sum(axis=(1, 2)).mean()
    return float(size.sum() - again.mean() + plain.sum()), float(np.hypot(again.std(ddof=1), WRONG * alone))


def _orders(own: np.ndarray, area: np.ndarray) -> np.ndarray:
    """∫ s² of every azimuthal order about the centre, from 0 on (Parseval)."""
    square = np.abs(np.fft.rfft(own, axis=1)) ** 2 / own.shape[1]
    square[:, 1:-1] *= 2
    return (square * area[:, :1]).sum(axis=0)


def _axes(part: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    """Second-moment widths along major and minor axis, and the direction of the major one [deg], 0 to 180."""
    x, y = (part * u).sum(), (part * v).sum()
    xx, yy, xy = ((part * own).sum() for own in ((u - x) ** 2, (v - y) ** 2, (u - x) * (v - y)))
    (small, large), turned = np.linalg.eigh([[xx, xy], [xy, yy]])
    direction = float(np.rad2deg(np.arctan2(turned[1, 1], turned[0, 1])) % 180)
    return float(np.sqrt(max(large, 0.0))), float(np.sqrt(max(small, 0.0))), direction
