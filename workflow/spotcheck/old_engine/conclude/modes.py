"""As if the light were a sum of modes: intensities of Hermite–Gauss modes that add up to a learned shape.

A picture for a person, not a finding: many sums give nearly the same light, and modes that interfere are no sum at all.
So weights are given only where non-negative ones of a few modes explain nearly all that is not a Gaussian.
"""

from typing import NamedTuple

import numpy as np
from scipy import optimize, special

from spotcheck.old_engine.conclude.judgement import Light

# Highest sum of both orders of a mode, and the part of ∫s² that the sum must explain: see `real-light`, section A.
HIGHEST, EXPLAINED = 4, 0.9
# Step [σ] and half side [σ] of the square on which sums are compared.
STEP, HALF = 0.12, 5.1
# Widths of the mode of order 0 [σ] and directions [deg] that a search starts from.
WIDTHS, TURNS = np.linspace(0.5, 1.1, 13), np.arange(0.0, 90.0, 15.0)
# A mode that holds less than this part of the light is not told, and a sum of more modes than so many is no picture.
LEAST, MOST = 0.01, 4


class Modes(NamedTuple):
    """Parts of the light by orders along and across the direction [deg], the largest first; the width of the mode of
    order 0 [σ of the declared shape], and how much of what is not a Gaussian the sum explains."""

    parts: dict[tuple[int, int], float]
    width: float
    direction: float
    explained: float


def modes_of(light: Light) -> Modes | None:
    """The sum of modes that comes nearest to a light whose declared shape is a Gaussian; None where none comes near."""
    at = np.arange(-HALF, HALF + STEP / 2, STEP)
    u, v = (own.ravel() for own in np.meshgrid(at, at))
    s = light.shape(u, v)
    whole = s + np.exp(-(u * u + v * v) / 2)

    def off(own) -> float:
        return _fit(u, v, whole, float(own[0]), float(own[1]))[1]

    start = min(((width, turn) for width in WIDTHS for turn in TURNS), key=off)
    steps = np.array([start, (start[0] + 0.02, start[1]), (start[0], start[1] + 5.0)])
    best = optimize.minimize(off, start, method="Nelder-Mead", options={"initial_simplex": steps, "maxfev": 80}).x
    weights, left = _fit(u, v, whole, float(best[0]), float(best[1]))
    explained = 1 - (left / max(float(np.linalg.norm(s)), 1e-300)) ** 2
    if explained < EXPLAINED:
        return None
    parts = weights / weights.sum()
    told = sorted(((float(p), own) for p, own in zip(parts, _orders(), strict=True) if p >= LEAST), reverse=True)
    if len(told) > MOST:
        return None
    return Modes({own: p for p, own in told}, float(best[0]), float(best[1] % 180), float(explained))


def _orders() -> list[tuple[int, int]]:
    return [(m, n) for m in range(HIGHEST + 1) for n in range(HIGHEST + 1 - m)]


def _fit(u: np.ndarray, v: np.ndarray, whole: np.ndarray, width: float, turn: float) -> tuple[np.ndarray, float]:
    """Non-negative weights of the modes, and the norm of what they leave."""
    along, across = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    one, two = (_intensities(own / width) for own in (u * along + v * across, v * along - u * across))
    columns = np.array([one[m] * two[n] for m, n in _orders()]) / width**2
    # Through the normal equations, which are few.
    root = np.linalg.cholesky(columns @ columns.T)
    weights, left = optimize.nnls(root.T, np.linalg.solve(root, columns @ whole))
    rest = whole @ whole - np.sum(np.linalg.solve(root, columns @ whole) ** 2)
    return weights, float(np.sqrt(max(rest, 0.0) + left**2))


def _intensities(x: np.ndarray) -> list[np.ndarray]:
    """|ψ_m(x)|² of unit integral, in units of the width of |ψ_0|² (Siegman, Lasers, sec. 16.4)."""
    out = []
    for m in range(HIGHEST + 1):
        scale = 2.0**m * special.factorial(m) * np.sqrt(2 * np.pi)
        out.append(special.eval_hermite(m, x / np.sqrt(2)) ** 2 * np.exp(-x * x / 2) / scale)
    return out
