"""How strong an effect is: Fisher signal-to-noise after the baseline was refitted, on the frames meant for discovery.

Steady effects: twice the Kullback-Leibler divergence of the Gaussian pixel readings from the nearest baseline. The
difference of means is projected on what p1, p2, peak and the centre of each site can take up (to first order), and the
variances are compared at the refitted mean: for small changes d^2/v + (dv/v)^2/2, summed over pixels. Effects that
scatter: twice the expected log-likelihood ratio of a component of variance s^2 seen with information F, which is
s^2 F - ln(1 + s^2 F), summed over frames, rows, pixels or grains.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import optimize

from rig.hidden.base import Base
from rig.hidden.chain import moments
from rig.hidden.designs import CROP_PX, FRAME_PX, Design, Shot
from rig.hidden.effect import Array, Effect, Moments
from rig.hidden.world import World

_PIXELS = 300_000  # looked at, in all frames together: every thin-th row and column of the crop
_LEAST = 0.01  # smallest variance of a reading [DN^2]


def evidence(x: Array) -> Array:
    """x - ln(1 + x), for x = s^2 F or a relative change of variance."""
    return x - np.log1p(x)


class Reference:
    """A baseline without the effect on a thinned grid of pixels, and derivatives of its readings by its parameters.

    Arrays are [site, exposure, y, x]; `mean` [DN], `variance` [DN^2], derivatives `d_log_peak`, `d_x`, `d_y` [DN/px].
    """

    def __init__(self, base: Base, frames: Sequence[Sequence[Shot]], thin: int) -> None:
        self.base, self.frames, self.thin = base, frames, thin
        self.mean, variance = self.pictures(World(base))
        self.variance = np.maximum(variance, _LEAST)
        grow = 1e-3
        self.d_log_peak = self._slope(dataclasses.replace(base, peak_dn=base.peak_dn * (1 + grow)), grow)
        self.d_p2 = self._slope(dataclasses.replace(base, p2=base.p2 + 0.01), 0.01)
        self.d_x = (self.pictures(World(base), 0.02, 0.0)[0] - self.mean) / 0.02
        self.d_y = (self.pictures(World(base), 0.0, 0.02)[0] - self.mean) / 0.02
        self._shared = [self.d_log_peak, self.d_p2]
        if len(base.exposures_s) > 1:
            self._shared.append(self._slope(dataclasses.replace(base, p1=base.p1 + 0.01), 0.01))

    @functools.cached_property
    def d_reading(self) -> Array:
        """Derivative with respect to the black level [1]: less than 1 where readings stop at 0."""
        return self._slope(dataclasses.replace(self.base, black_level=self.base.black_level + 0.05), 0.05)

    def pictures(self, world: World, dx: float = 0.0, dy: float = 0.0) -> Moments:
        """Mean and variance of all frames, all spots displaced by (dx, dy) px."""
        means, variances = [], []
        for site in self.frames:
            for shot in site:
                first = (FRAME_PX - CROP_PX) // 2
                # A grid that wanders from frame to frame, so that no period of fringes falls in step with it.
                x = first + (5 * shot.index) % self.thin + np.arange(CROP_PX // self.thin) * self.thin
                y = first + (3 * shot.index + shot.index // 7) % self.thin + np.arange(CROP_PX // self.thin) * self.thin
                moved = dataclasses.replace(shot, x_px=shot.x_px + dx, y_px=shot.y_px + dy)
                mean, variance = moments(world, world.view(moved, x, y, self.thin))
                means.append(mean)
                variances.append(variance)
        shape = (len(self.frames), len(self.frames[0]), *means[0].shape)
        return np.stack(means).reshape(shape), np.stack(variances).reshape(shape)

    def per_pixel(self, derivative: Array) -> Array:
        """Information of each pixel on what the reading answers to with `derivative`."""
        return derivative**2 / self.variance

    def information(self, derivative: Array) -> Array:
        """Information of each frame [site, exposure]."""
        return self.per_pixel(derivative).sum(axis=(-2, -1)) * self.thin**2

    def distance2(self, mean: Array, variance: Array) -> float:
        """Squared signal-to-noise of pictures that the world, refitted, does not show."""
        left = self.refitted(mean)
        expected = self.variance + self.base.gain * (mean - left - self.mean)
        # A reading that never changes tells no more than one that seldom does.
        change = evidence(np.maximum(variance, _LEAST) / np.maximum(expected, _LEAST) - 1.0)
        return float((left**2 / self.variance + change).sum()) * self.thin**2

    def refitted(self, mean: Array) -> Array:
        """Return `mean` - `self.mean` without what p1, p2, peak and centres can explain."""
        root, local, shared = self._tangent
        left = ((mean - self.mean) * root).reshape(root.shape[0], -1)
        left = _without(left[:, None], local)[:, 0]
        if shared.size:
            left = left - np.tensordot(shared @ left.ravel(), shared.reshape(-1, *left.shape), axes=1)
        return left.reshape(root.shape) / root

    @functools.cached_property
    def _tangent(self) -> tuple[Array, Array, Array]:
        """Root weights, orthonormal local directions [site, 2, pixels], orthonormal shared ones [k, all pixels]."""
        root = 1.0 / np.sqrt(self.variance)
        sites = root.shape[0]
        local = np.stack([(d * root).reshape(sites, -1) for d in (self.d_x, self.d_y)], axis=1)
        local = np.linalg.qr(local.transpose(0, 2, 1))[0].transpose(0, 2, 1)
        shared = np.stack([(d * root).reshape(sites, -1) for d in self._shared], axis=1)
        shared = _without(shared, local).transpose(1, 0, 2).reshape(len(self._shared), -1)
        # Directions that coincide (a width at one exposure, say) count once.
        norms = np.linalg.norm(shared, axis=1)
        shared = shared[norms > 0] / norms[norms > 0, None]
        values, vectors = np.linalg.eigh(shared @ shared.T)
        kept = values > 1e-9
        return root, local, (vectors[:, kept] / np.sqrt(values[kept])).T @ shared

    def _slope(self, base: Base, step: float) -> Array:
        return (self.pictures(World(base))[0] - self.mean) / step


def _without(vectors: Array, local: Array) -> Array:
    """[site, k, pixels] less its part in the orthonormal local directions."""
    return vectors - (vectors @ local.transpose(0, 2, 1)) @ local


class Judge:
    """Signal-to-noise of an effect in one dataset's design and frames."""

    def __init__(self, design: Design, shots: Sequence[Shot]) -> None:
        kept = sorted((s for s in shots if design.discovery(s.repeat)), key=lambda s: (s.site, s.exposure_s))
        step = len(design.exposures_s)
        self.frames = [kept[k : k + step] for k in range(0, len(kept), step)]
        self.thin = max(1, math.ceil(math.sqrt(len(kept) * CROP_PX**2 / _PIXELS)))
        self._latest: Reference | None = None

    def snr(self, base: Base, effect: Effect) -> float:
        """Signal-to-noise of an effect."""
        base = effect.rebased(base)
        if self._latest is None or self._latest.base != base:
            self._latest = Reference(base, self.frames, self.thin)
        if effect.scatters:
            total = effect.scatter_snr2(self._latest)
        else:
            total = self._latest.distance2(*self._latest.pictures(World(base, effect)))
        return math.sqrt(max(total, 0.0))


def solve(snr: Callable[[float], float], target: float, span: tuple[float, float]) -> float:
    """The strength within `span` where snr(strength) meets `target` (to 3 %), or the nearer end."""

    @functools.lru_cache(maxsize=64)
    def excess(log_strength: float) -> float:
        return math.log(max(snr(math.exp(log_strength)), 1e-3) / target)

    low, high = math.log(span[0]), math.log(span[1])
    # From above: faint ends are flat where the noise of the arithmetic takes over.
    if excess(high) <= 0.0:
        return math.exp(high)
    if excess(low) >= 0.0:
        return math.exp(low)
    # Most effects grow in proportion; a few steps of that leave a narrow bracket.
    for _ in range(6):
        guess = high - excess(high) * 0.98
        if not low < guess < high:
            break
        if excess(guess) > 0.0:
            high = guess
        else:
            low = guess
            break
        if excess(high) < 0.03:
            return math.exp(high)
    root, _ = optimize.brentq(excess, low, high, xtol=0.003, rtol=1e-9, full_output=True, disp=False)
    return math.exp(root)
