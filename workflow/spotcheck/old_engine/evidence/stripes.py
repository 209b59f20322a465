"""Stripes: the highest peak in the spectrum of what frames of a site share, and where its phase stays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.windows import Site, windows_of
from spotcheck.old_engine.nuisance.numbers import fit_numbers
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, Numbers, told

# The shortest period [steps]: a sensor that reads every other line in its own way, or has a colour filter, has a
# pattern of 2 px of its own.
SHORTEST = 2.1
# The rings of frequency about a peak, in parts of its own, of whose median power chance is a part; and how many steps
# of the grid the peak itself is wide.
RING, WIDE = 1.3, 4
# The next peak is sought beyond so many steps of the grid.
APART = 8


class Stripes(NamedTuple):
    """Period [px] and direction [deg] across the stripes; the complex amplitude of every site, with its phase counted
    from the sensor's corner, and how well each is told; and what −2 ln L gains by them, to first order, beyond the
    highest of as many peaks of noise."""

    period: float
    direction: float
    amplitude: np.ndarray
    weight: np.ndarray
    gain: float


def stripes_of(sites: Sequence[Site], sigma_px: float) -> Stripes | None:
    """The strongest stripes of any phase: the power of all sites adds up, so that a phase anew at each does not matter.

    Of the places of a site only what is left beside a plane counts, which its brightness and displacement would be.
    """
    shape = np.max([own.pull.shape for own in sites], axis=0)
    padded = [fft.next_fast_len(int(n), real=True) for n in shape]
    step = sites[0].step
    ky, kx = fft.fftfreq(padded[0], step)[:, None], fft.rfftfreq(padded[1], step)[None, :]
    power = np.zeros((padded[0], padded[1] // 2 + 1))
    for own in sites:
        power += np.abs(fft.rfft2(own.pull, s=padded)) ** 2 * 2 / max(float(own.weight.sum()), 1e-300)
    radius = np.hypot(ky, kx)
    sought = (radius > 1 / (criteria.LONGEST.value * sigma_px)) & (radius < 1 / (SHORTEST * step))
    if not sought.any():
        return None
    power[~sought] = 0
    j, i = np.unravel_index(int(np.argmax(power)), power.shape)
    start = np.array([kx[0, i], ky[j, 0]])

    def minus(k: np.ndarray) -> float:
        # A step of the grid holds a peak; what lies beyond is another's flank.
        if np.any(np.abs(k - start) * step * padded[::-1] > 1):
            return 0.0
        return -float(sum(abs(a) ** 2 * w / 2 for a, w in (_amplitude(own, k) for own in sites)))

    simplex = start + 0.5 / (step * np.array(padded[::-1])) * np.array([[0, 0], [1, 0], [0, 1]])
    best = minimize(
        minus, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-7, "fatol": 1e-3}
    )
    amplitude, weight = (np.array(own) for own in zip(*(_amplitude(own, best.x) for own in sites), strict=True))
    period, direction = 1 / float(np.hypot(*best.x)), float(np.degrees(np.arctan2(best.x[1], best.x[0])))
    # Two numbers of each site, and as many places to look at (Laurent & Massart 2000, lemma 1, of χ²).
    places = np.log(np.count_nonzero(sought))
    chance = 2 * len(sites) + 2 * places + 2 * np.sqrt(2 * len(sites) * places)
    # Grains and rows have power of their own all about.
    far, wide = step * padded[0], step * padded[1]
    steps = np.hypot((ky - ky[j, 0]) * far, (kx - kx[0, i]) * wide)
    mirrored = np.hypot((ky + ky[j, 0]) * far, (kx + kx[0, i]) * wide)
    others = power[sought & (np.minimum(steps, mirrored) > APART)]
    lonely = not others.size or power[j, i] > criteria.STANDS_OUT.value * others.max()
    about = sought & (radius < RING * radius[j, i]) & (radius > radius[j, i] / RING) & (steps > WIDE)
    beside = float(np.median(power[about])) / (2 * len(sites)) if about.any() else 1.0
    gain = max(-float(best.fun) / max(beside, 1.0) - chance, 0.0)
    lonely &= len(sites) > 1 or not sites[0].single or abs(amplitude[0]) > criteria.FRINGES_ALONE.value
    return Stripes(period, direction, amplitude, weight, gain if lonely else 0.0)


def _amplitude(own: Site, k: np.ndarray) -> tuple[complex, float]:
    """Complex amplitude a of the field Re(a e^(2πi k·r)) of a site, and Σ of its weights."""
    rows, columns = own.pull.shape
    along = np.exp(-2j * np.pi * k[0] * own.step * (own.corner[1] + np.arange(columns)))
    across = np.exp(-2j * np.pi * k[1] * own.step * (own.corner[0] + np.arange(rows)))
    total = max(float(own.weight.sum()), 1e-300)
    return 2 * complex(across @ (own.pull @ along)) / total, total


class Phase(NamedTuple):
    """How stripes lie: in which form, their depth and phase [deg], and the part of the sites' amplitudes that
    agrees."""

    form: str
    depth: float
    phase: float
    agrees: float


def phases(found: Stripes, centre: np.ndarray) -> list[Phase]:
    """Whether stripes stay on the sensor, with the spot (centre x, y [site, 2]), or neither: each site its own."""
    angle = np.deg2rad(found.direction)
    turn = 2 * np.pi * (centre @ [np.cos(angle), np.sin(angle)]) / found.period
    out = []
    for form, own in (("sensor", found.amplitude), ("spot", found.amplitude * np.exp(1j * turn))):
        mean = np.average(own, weights=found.weight)
        agrees = abs(mean) / max(float(np.average(np.abs(own), weights=found.weight)), 1e-300)
        out.append(Phase(form, float(abs(mean)), float(np.degrees(np.angle(mean))) % 360, float(agrees)))
    depth = float(np.sqrt(np.average(np.abs(found.amplitude) ** 2, weights=found.weight)))
    return [own for own in out if own.agrees > criteria.COHERENT.value] or [Phase("site", depth, 0.0, 1.0)]


def waved(
    frames: Sequence[Frame], design: Design, numbers: Numbers, sites: Sequence[Site], period: float, direction: float
) -> tuple[Frame, ...]:
    """Frames with the waves of stripes in their views: of each site the amplitudes that its own sums tell, cosine and
    sine about the spot."""
    angle = np.deg2rad(direction)
    along = np.array([np.cos(angle), np.sin(angle)])
    which = np.searchsorted(np.unique(design.site), design.site)
    found = np.array([_amplitude(own, along / period)[0] for own in sites])
    turn = 2 * np.pi * (np.stack([numbers.x, numbers.y], 1) @ along) / period
    waves = found[which] * np.exp(1j * turn)
    one = np.ones((1, 1, 1))
    return tuple(
        frame._replace(view=frame.view._replace(wave_cos=w.real * one, wave_sin=-w.imag * one))
        for frame, w in zip(frames, waves, strict=True)
    )


def with_waves(frames: Sequence[Frame], design: Design, model: Model) -> list[Frame]:
    """Frames with the phases of stripes that are anew at each site: these are no part of the model."""
    place = next((k for k, p in enumerate(model.present) if p.effect.spectral and p.form == "site"), None)
    if place is None:
        return list(frames)
    named = model.present[place].named()
    fitted = fit_numbers(frames, model.without(place)).model
    ready, sites = Expectation(frames, fitted), []
    for window, which in windows_of(frames, design):
        for k in which:
            seen = ready.of(frames[k], k)
            window.add(frames[k], seen, told(frames[k], seen))
        sites.append(window.site())
    return list(waved(frames, design, fitted.numbers, sites, named["period"], named["direction"]))
