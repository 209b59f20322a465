"""A world: a baseline and at most one hidden effect, and what one frame of it looks like."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rig.hidden.base import TOP_HAT, Base
from rig.hidden.designs import Shot
from rig.hidden.effect import Array, Effect

NO_EFFECT = Effect(0.0)


@dataclass(frozen=True)
class State:
    """Spot of one frame."""

    t: float  # true exposure [s]
    spread: float  # width of the spread of light [px]
    sigma: float  # width of the spot [px]
    peak: float  # peak A [DN]
    x: float  # column of the centre [px]
    y: float  # row of the centre [px]


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
    """Baseline and effect."""

    base: Base
    effect: Effect = NO_EFFECT

    def state(self, shot: Shot) -> State:
        """Numbers of one frame."""
        t = self.effect.time(shot.exposure_s)
        spread = self.effect.spread(self.base.spread(t), t)
        dx, dy = self.effect.shift(shot)
        return State(
            t=t,
            spread=spread,
            sigma=spread + self.base.laser_px,
            peak=self.base.peak(t, spread) * self.effect.brightness(shot),
            x=shot.x_px + dx,
            y=shot.y_px + dy,
        )

    def view(self, shot: Shot, x: Array, y: Array, thin: int = 1) -> View:
        """A frame's pixels at columns `x` and rows `y`."""
        state = self.state(shot)

        def image(dx: float, dy: float) -> Array:
            return self._blurred(shot, state, x - state.x - dx, y - state.y - dy)

        return View(shot, state, self.base, x, y, thin, image)

    def light(self, view: View) -> Array:
        """Expected light [DN]: shape, top hat, motion blur, then the effect on light."""
        return self.effect.light(view.image(0.0, 0.0), view)

    def _blurred(self, shot: Shot, state: State, dx: Array, dy: Array) -> Array:
        """The spot after its top hat, averaged over the path of a motion by Gauss-Legendre quadrature."""
        length, direction = self.effect.smear_path(state)
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
        """exp(-(rho^2/2)^n), peak 1; rho is the radius in units of sigma, after an ellipse of equal area is undone."""
        (ratio, direction), n = self.effect.ellipse(shot), self.effect.flank()
        if ratio == 1.0 and n == 1.0:
            column = np.exp(-0.5 * (dy / state.sigma) ** 2)
            return column[:, None] * np.exp(-0.5 * (dx / state.sigma) ** 2)
        u, v = dx[None, :] / state.sigma, dy[:, None] / state.sigma
        if ratio != 1.0:
            c, s = math.cos(direction), math.sin(direction)
            turn = np.array([[c, s], [-s, c]])
            stretch = turn.T @ np.diag([ratio**-0.5, ratio**0.5]) @ turn
            u, v = stretch[0, 0] * u + stretch[0, 1] * v, stretch[1, 0] * u + stretch[1, 1] * v
        half = 0.5 * (u**2 + v**2)
        return np.exp(-(half if n == 1.0 else half**n))
