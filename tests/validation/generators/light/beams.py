"""The light's shape: real beams of the shared folder, drawn ones that need no file, and the plain Gaussian.

A shape is a raster in u, v, the coordinates in which the circular Gaussian that fits it best is exp(−(u² + v²)/2).
"""

from collections.abc import Callable
from functools import lru_cache
from math import factorial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.polynomial.hermite import hermval
from PIL import Image
from scipy import ndimage

Rng = np.random.Generator
SHARED = Path(__file__).parents[5] / "shared" / "data"
# Half a raster's side and the distance of its points [σ].
REACH, STEP = 6.0, 0.05
# The light is 0 beyond the first radius, and as it is within the second [σ]: crops hold more than the first.
ENDS, TAPERS = 4.6, 4.0
# Smoothing of real frames over their width: below a fourteenth.
SMOOTHED = 1 / 15
# A frame whose beam comes nearer to the frame's edge than this [σ] is no beam to draw from.
NEAREST = 3.9
# Part of the readings within one σ that may stand at full scale.
CLIPPED = 1e-3
# How far drawn light is off a Gaussian: rms within `CORE` [σ], over the peak.
OFF, CORE = (0.03, 0.05), 2.5


class Beam(NamedTuple):
    """A shape by its name: spline coefficients of its raster, its highest value and its rms off the Gaussian, both in
    peaks of that Gaussian."""

    name: str
    spline: np.ndarray
    top: float
    off: float

    def __call__(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The shape at u, v (shapes that broadcast); never negative."""
        u, v = np.broadcast_arrays(u, v)
        at = [(v + REACH) / STEP, (u + REACH) / STEP]
        return np.maximum(ndimage.map_coordinates(self.spline, at, order=3, prefilter=False, mode="constant"), 0.0)


Source = Callable[[np.ndarray, np.ndarray], np.ndarray]


def beam(kind: str, rng: Rng) -> Beam | None:
    """A shape of a kind of light (`real`, `drawn`); None for `gauss`."""
    if kind == "gauss":
        return None
    if kind == "real":
        names = real_names()
        return real(names[int(rng.integers(len(names)))])
    return drawn(str(rng.choice(list(DRAWN))), rng)


# Real beams


def there() -> bool:
    """Whether the shared folder is."""
    return (SHARED / "hene-zscan").exists() and (SHARED / "tem00-zscan").exists()


@lru_cache(maxsize=1)
def real_names() -> tuple[str, ...]:
    """Frames of both scans that hold a whole, unclipped beam, as <folder>/<stem>."""
    paths = sorted(path for name in ("hene-zscan", "tem00-zscan") for path in (SHARED / name / "frames").iterdir())
    return tuple(f"{path.parts[-3]}/{path.stem}" for path in paths if _usable(path))


def _usable(path: Path) -> bool:
    pixels = np.asarray(Image.open(path), float)
    _, x, y, sigma = _rough(pixels)
    edge = min(x, y, pixels.shape[1] - x, pixels.shape[0] - y) / sigma
    core = np.hypot(*np.ogrid[-y : pixels.shape[0] - y, -x : pixels.shape[1] - x]) < sigma
    return bool(edge > NEAREST and np.mean(pixels[core] >= 255) < CLIPPED)


def _rough(pixels: np.ndarray) -> tuple[float, float, float, float]:
    """Pedestal, centre and width of a frame, from its border and its pixels above exp(−1/2) of the peak."""
    border = np.concatenate(
        [pixels[:20].ravel(), pixels[-20:].ravel(), pixels[:, :20].ravel(), pixels[:, -20:].ravel()]
    )
    pedestal = float(np.median(border))
    smooth = ndimage.gaussian_filter(pixels, 5.0) - pedestal
    y, x = np.nonzero(smooth > np.exp(-0.5) * smooth.max())
    return pedestal, float(x.mean()), float(y.mean()), float(np.sqrt(len(x) / np.pi))


@lru_cache(maxsize=32)
def real(name: str) -> Beam:
    """A real beam without its pedestal, smoothed and tapered."""
    folder, stem = name.split("/")
    (path,) = (SHARED / folder / "frames").glob(f"{stem}.*")
    pixels = np.asarray(Image.open(path), float)
    pedestal, x, y, sigma = _rough(pixels)
    ends = min(ENDS, min(x, y, pixels.shape[1] - x, pixels.shape[0] - y) / sigma - 0.05)
    radius = np.hypot(*np.ogrid[-y : pixels.shape[0] - y, -x : pixels.shape[1] - x]) / sigma
    # Where the border is darker than the beam's surround, the taper would end in a step.
    pedestal = max(pedestal, float(np.quantile(pixels[(radius > TAPERS - 0.3) & (radius < TAPERS)], 0.3)))
    source = _sampled(ndimage.gaussian_filter(pixels - pedestal, SMOOTHED * sigma))
    return standard(name, source, (x, y, sigma), ends)


def _sampled(values: np.ndarray) -> Source:
    """An image as a function of column and row, 0 outside."""
    spline = ndimage.spline_filter(values, 3)
    return lambda x, y: ndimage.map_coordinates(spline, np.broadcast_arrays(y, x), order=3, prefilter=False)


def standard(name: str, source: Source, guess: tuple[float, float, float], ends: float = ENDS) -> Beam:
    """A source of light in the coordinates of the Gaussian that fits it best within `CORE`, tapered to 0 at `ends`."""
    x, y, sigma = guess
    core = np.arange(-CORE, CORE + 1e-9, 0.1)
    inside = np.hypot(core[None, :], core[:, None]) <= CORE
    u, v = (np.broadcast_to(own, inside.shape)[inside] for own in (core[None, :], core[:, None]))
    gauss = np.exp(-(u**2 + v**2) / 2)
    slopes = gauss * np.stack([np.ones_like(u), u, v, u**2 + v**2])
    for _ in range(30):
        values = source(x + sigma * u, y + sigma * v)
        peak = float(gauss @ values / (gauss @ gauss))
        step = np.linalg.lstsq(peak * slopes.T, values - peak * gauss, rcond=None)[0]
        # A half step at most: far from a Gaussian the slopes promise too much.
        x, y, sigma = x + sigma * step[1], y + sigma * step[2], sigma * float(np.exp(np.clip(step[3], -0.5, 0.5)))
        if np.max(np.abs(step[1:])) < 1e-6:
            break
    axis = np.arange(-REACH, REACH + STEP / 2, STEP)
    radius = np.hypot(axis[None, :], axis[:, None])
    taper = np.cos(np.pi / 2 * np.clip((radius - ends + ENDS - TAPERS) / (ENDS - TAPERS), 0, 1)) ** 2
    raster = np.maximum(source(x + sigma * axis[None, :], y + sigma * axis[:, None]), 0.0) * taper / peak
    off = raster - np.exp(-(radius**2) / 2)
    rms = float(np.sqrt(np.mean(off[radius <= CORE] ** 2)))
    return Beam(name, ndimage.spline_filter(raster, 3), float(raster.max()), rms)


# Drawn beams

# Points of a pupil or a plane, and the waist of the Gaussian there [points].
SIDE, WAIST = 512, 20.0


def drawn(kind: str, rng: Rng) -> Beam:
    """Light of a kind, as far off a Gaussian as a draw of `OFF` wants it."""
    family, wanted = DRAWN[kind](rng), rng.uniform(*OFF)
    low, high = 0.0, 1.0
    while (found := family(high)).off < wanted and high < 64:
        low, high = high, 2 * high
    for _ in range(12):
        middle = (low + high) / 2
        found = family(middle)
        low, high = (middle, high) if found.off < wanted else (low, middle)
    return found._replace(name=kind)


def modes(rng: Rng) -> Callable[[float], Beam]:
    """A mixture of Hermite–Gauss modes to order 4: their intensities add, or their fields (Siegman, Lasers, 16)."""
    pairs = [(m, n) for m in range(5) for n in range(5 - m) if m + n]
    weights = rng.exponential(1.0, len(pairs)) * (rng.random(len(pairs)) < 0.35)
    phases, turned, coherent = np.exp(2j * np.pi * rng.random(len(pairs))), rng.uniform(0, np.pi), rng.random() < 0.5
    weights[int(rng.integers(len(pairs)))] += 1.0

    def family(s: float) -> Beam:
        def source(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            along, across = x * np.cos(turned) + y * np.sin(turned), y * np.cos(turned) - x * np.sin(turned)
            fields = [_hermite(m, along) * _hermite(n, across) for m, n in pairs]
            parts = 0.1 * s * weights / weights.sum()
            if coherent:
                extra = sum(f * np.sqrt(p) * phase for f, p, phase in zip(fields, parts, phases, strict=True))
                return np.abs(_hermite(0, along) * _hermite(0, across) + extra) ** 2
            return (_hermite(0, along) * _hermite(0, across)) ** 2 + sum(
                p * f**2 for f, p in zip(fields, parts, strict=True)
            )

        return standard("modes", source, (0.0, 0.0, 1.0))

    return family


def _hermite(order: int, x: np.ndarray) -> np.ndarray:
    """The normalised mode whose square has, at order 0, the width 1."""
    values = hermval(x / np.sqrt(2), [0.0] * order + [1.0]) / np.sqrt(2.0**order * factorial(order))
    return values * np.exp(-(x**2) / 4)


def lens(rng: Rng) -> Callable[[float], Beam]:
    """Aberrations of third order and trefoil through a lens: the far field of a Gaussian pupil with a phase of Zernike
    polynomials (Born and Wolf, Principles of Optics, 9.2)."""
    rho, theta = _pupil()
    shapes = [
        rho**2 * np.cos(2 * theta), rho**2 * np.sin(2 * theta), (3 * rho**3 - 2 * rho) * np.cos(theta),
        (3 * rho**3 - 2 * rho) * np.sin(theta), rho**3 * np.cos(3 * theta), rho**3 * np.sin(3 * theta),
        6 * rho**4 - 6 * rho**2,
    ]  # fmt: skip
    phase = np.tensordot(rng.standard_normal(len(shapes)), shapes, 1)
    inside = rho <= 1
    return lambda s: _far("lens", np.exp(-((2 * rho) ** 2) / 2 + 0.3j * s * phase) * inside)


def rings(rng: Rng) -> Callable[[float], Beam]:
    """Rings of a round aperture that dims the pupil beyond its edge, some Fresnel zones out of focus (Born and Wolf,
    8.8)."""
    rho, _ = _pupil()
    edge, defocus = rng.uniform(0.55, 0.8), rng.uniform(8, 20)
    whole = np.exp(-((2 * rho) ** 2) / 2 + 1j * defocus * rho**2)
    return lambda s: _far("rings", whole * (1 - np.tanh(0.3 * s) * (rho > edge)), defocus)


def _pupil() -> tuple[np.ndarray, np.ndarray]:
    """Radius over two waists, and angle, of the points of a pupil."""
    axis = (np.arange(SIDE) - SIDE / 2) / (2 * WAIST)
    return np.hypot(axis[None, :], axis[:, None]), np.arctan2(axis[:, None], axis[None, :])


def _far(name: str, field: np.ndarray, defocus: float = 0.0) -> Beam:
    """The far field of a pupil; `defocus` is the phase at one radius [rad], which widens it."""
    intensity = np.abs(np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(field)))) ** 2
    y, x = np.unravel_index(np.argmax(ndimage.gaussian_filter(intensity, 2.0)), intensity.shape)
    # Widths of intensities are those of fields over √2: SIDE/2π over the pupil's by diffraction, the phase's slope by
    # rays.
    sigma = SIDE / (2 * np.pi * WAIST) / np.sqrt(2) * np.hypot(1, defocus / 2)
    return standard(name, _sampled(intensity / intensity.max()), (float(x), float(y), float(sigma)))


def field(rng: Rng) -> Callable[[float], Beam]:
    """A smooth random field on a Gaussian."""
    axis = np.arange(-REACH, REACH + STEP / 2, STEP)
    noise = ndimage.gaussian_filter(rng.standard_normal((len(axis),) * 2), rng.uniform(0.35, 0.9) / STEP, mode="wrap")
    rough = _sampled(np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 2) * noise / noise.std())

    def family(s: float) -> Beam:
        def source(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            extra = 0.1 * s * rough((x + REACH) / STEP, (y + REACH) / STEP)
            return np.exp(-(x**2 + y**2) / 2) + extra

        return standard("field", source, (0.0, 0.0, 1.0))

    return family


DRAWN: dict[str, Callable[[Rng], Callable[[float], Beam]]] = {
    make.__name__: make for make in (modes, lens, rings, field)
}
