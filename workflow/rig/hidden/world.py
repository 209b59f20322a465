"""A world: a baseline, the frames to be taken, and hidden effects; and what one frame of it looks like."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rig.hidden.base import TOP_HAT, Base
from rig.hidden.designs import Shot
from rig.hidden.effect import Array, Effect


@dataclass(frozen=True)
class State:
    """One frame's numbers: true exposure [s], spread, width and centre [px], peak A [DN]."""

    t: float
    spread: float
    sigma: float
    peak: float
    x: float
    y: float


@dataclass(frozen=True)
class View:
    """The pixels of one frame that are looked at: columns `x`, rows `y` (every `thin`-th of each)."""

    shot: Shot
    state: State
    base: Base
    x: Array
    y: Array
    thin: int
    image: Callable[[float, float], Array]  # the spot [DN], displaced by (dx, dy) px

    @property
    def dx(self) -> Array:
        """Columns from the spot's centre [px]."""
        return self.x - self.state.x

    @property
    def dy(self) -> Array:
        """Rows from the spot's centre [px], as a column."""
        return (self.y - self.state.y)[:, None]

    def of(self, whole: Array) -> Array:
        """These pixels of a map of the whole sensor."""
        return whole if self.thin == 1 and whole.shape == (self.y.size, self.x.size) else whole[np.ix_(self.y, self.x)]


@dataclass(frozen=True)
class World:
    """Baseline and effects, the effects in the order of the chain."""

    base: Base
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(sorted(self.effects, key=lambda effect: effect.rank)))

    def steady(self) -> World:
        """The same without the effects that scatter."""
        return dataclasses.replace(self, effects=tuple(effect for effect in self.effects if not effect.scatters))

    def state(self, shot: Shot) -> State:
        """Numbers of one frame."""
        t = shot.exposure_s
        for effect in self.effects:
            t = effect.time(t)
        spread = self.base.spread(t)
        for effect in self.effects:
            spread = effect.spread(spread, t, shot)
        shifts = [effect.shift(shot) for effect in self.effects]
        return State(
            t=t,
            spread=spread,
            sigma=spread + self.base.laser_px,
            peak=self.base.peak(t, spread) * math.prod(effect.brightness(shot) for effect in self.effects),
            x=shot.x_px + sum(dx for dx, _ in shifts),
            y=shot.y_px + sum(dy for _, dy in shifts),
        )

    def view(self, shot: Shot, x: Array, y: Array, thin: int = 1) -> View:
        """A frame's pixels at columns `x` and rows `y`."""
        state = self.state(shot)

        def image(dx: float, dy: float) -> Array:
            return self._blurred(shot, state, x - state.x - dx, y - state.y - dy)

        return View(shot, state, self.base, x, y, thin, image)

    def zero(self) -> tuple[float, float]:
        """What the converter subtracts [DN], and the reading [DN] below which it shows 0."""
        both = [effect.zero() for effect in self.effects]
        return sum(subtracted for subtracted, _ in both), max((dead for _, dead in both), default=0.0)

    def light(self, view: View) -> Array:
        """Expected light [DN]: shape, top hat, motion blur, then the effects on light in the order of the chain."""
        light = view.image(0.0, 0.0)
        for effect in self.effects:
            light = effect.light(light, view)
        return light

    def _blurred(self, shot: Shot, state: State, dx: Array, dy: Array) -> Array:
        """The spot after its top hat, averaged over the path of a motion by Gauss-Legendre quadrature."""
        length, direction = max((effect.smear_path(state) for effect in self.effects), default=(0.0, 0.0))
        if length == 0.0:
            return self._spot(shot, state, dx, dy)
        # At least two nodes a pixel, so that the edge of a top hat is averaged as smoothly as the flanks.
        nodes, weights = np.polynomial.legendre.leggauss(max(12, math.ceil(2 * length)))
        total = np.zeros((dy.size, dx.size))
        for node, weight in zip(nodes, weights, strict=True):
            along = node * length / 2
            step_x, step_y = along * math.cos(direction), along * math.sin(direction)
            total += weight / 2 * self._spot(shot, state, dx - step_x, dy - step_y)
        return total

    def _spot(self, shot: Shot, state: State, dx: Array, dy: Array) -> Array:
        """Shape and top hat [DN]; `dx`, `dy` from the centre [px]."""
        shape = self._shape(shot, state, dx, dy)
        if self.base.top_hat:
            np.minimum(shape, TOP_HAT, out=shape)
        shape *= state.peak
        return shape

    def _shape(self, shot: Shot, state: State, dx: Array, dy: Array) -> Array:
        """exp(-(rho^2/2)^n), peak 1."""
        stretch = self._stretch(shot)
        n = math.prod(effect.flank() for effect in self.effects)
        warps = [effect for effect in self.effects if type(effect).warp is not Effect.warp]
        if stretch is None and n == 1.0 and not warps:
            column = np.exp(-0.5 * (dy / state.sigma) ** 2)
            return column[:, None] * np.exp(-0.5 * (dx / state.sigma) ** 2)
        u, v = dx[None, :] / state.sigma, dy[:, None] / state.sigma
        if stretch is not None:
            u, v = stretch[0, 0] * u + stretch[0, 1] * v, stretch[1, 0] * u + stretch[1, 1] * v
        rho2 = u**2 + v**2
        for effect in warps:
            warped = effect.warp(rho2, u, v)
            rho2 = rho2 if warped is None else warped
        half = 0.5 * rho2
        return np.exp(-(half if n == 1.0 else half**n))

    def _stretch(self, shot: Shot) -> Array | None:
        """Map from displacements to those of a circle, area unchanged; None when nothing is elliptical."""
        matrix = None
        for effect in self.effects:
            ratio, direction = effect.ellipse(shot)
            if ratio != 1.0:
                c, s = math.cos(direction), math.sin(direction)
                turn = np.array([[c, s], [-s, c]])
                one = turn.T @ np.diag([ratio**-0.5, ratio**0.5]) @ turn
                matrix = one if matrix is None else one @ matrix
        return matrix
