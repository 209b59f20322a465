"""An effect at a multiple of its bound: the strength at which its signal-to-noise has a wanted value.

What scatters has no change of its own; its signal-to-noise is that of the variance it adds: half the squared ratio of
that to the variance of what it is told by, summed (Kay, Detection Theory, 5.3).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tests.validation.generators.light.bound import Reference, Snr
from tests.validation.generators.second.case import Case, Effect
from tests.validation.generators.second.optics import spread

# Of an effect's strength s (see second/effects.py) the least that is put in: twice a size that a user would call
# nothing, however well it is told, or more; a threshold of black below half a code is lost in rounding. DN, fractions
# or px as s is.
LEAST = {
    "saturation": 0.01, "nonlinearity": 0.01, "black_clipping": 1.0, "dark_offset": 0.3, "background_gradient": 0.3,
    "super_gaussian": 0.02, "scatter_halo": 0.004, "fibre_anisotropy": 0.01, "beam_ellipticity": 0.01,
    "angle_reflectance": 0.01, "photon_budget": 0.02, "shutter_offset": 0.01, "spread_law": 0.05, "motion_blur": 2.5,
    "interference_fringes": 0.006, "ghost_reflection": 0.004, "speckle": 0.02, "excess_read_noise": 0.06,
    "power_fluctuation": 0.006, "laser_drift": 0.01, "pointing_jitter": 0.2, "fixed_pattern": 0.004,
    "row_noise": 0.2, "smear": 0.004, "outside:flicker_rows": 0.2, "outside:two_tap": 0.3, "outside:offset_wander": 0.3,
    "outside:image_lag": 0.003, "outside:second_spot_sometimes": 1.0, "outside:converter_steps": 1.0,
}  # fmt: skip
# Where counts are the strength.
LEAST_HOT = 5.0
# Effects that are laws of brightness or width: told beside other laws, not beside numbers of each frame's own.
LAWS = ("angle_reflectance", "photon_budget", "shutter_offset", "spread_law", "laser_drift")
# An effect that a free shape leaves less than this part of its signal-to-noise is hidden in the shape.
TIED = 0.2
# A strength is found when its signal-to-noise is within so much of the wanted one (ln), or after so many steps.
CLOSE, STEPS = 0.03, 8
# A level that an effect's own limits keep it below by more than this factor is not reached.
REACHED = 0.8


class Tuned(NamedTuple):
    """What became of an effect: the multiple that was wanted, those reached with the shape known and free, whether it
    is tied with the shape, whether the wanted one was reached, and whether its least size made it stronger."""

    wanted: float
    known: float
    free: float
    tied: bool
    met: bool
    floored: bool


def tune(
    reference: Reference, case: Case, effect: Effect, wanted: float, behind: Callable[[], float] | None = None
) -> Tuned:
    """Set an effect's strength so that its signal-to-noise beside a free shape, and `behind` what lies on top, is as
    wanted; where the shape hides it, that with the shape known."""
    measure = measure_of(reference, case, effect)
    low, high = least_of(effect), effect.cap
    start = measure(np.sqrt(low * high))
    tied = start.free < TIED * start.known

    def reached(s: float) -> float:
        found = measure(s)
        value = found.known if tied else found.free
        # In logarithms of the wanted one; far below it nothing is to be told from 0.
        return float(np.log(max(min(value, behind() if behind else np.inf) / wanted, 1e-6)))

    ends = [(low, reached(low)), (high, reached(high))]
    floored, met = ends[0][1] >= 0, ends[1][1] >= np.log(REACHED)
    if floored or ends[1][1] <= 0:
        effect.s = low if floored else high
    else:
        _find(reached, ends)
    found = measure(effect.s)
    return Tuned(wanted, found.known, found.free, bool(found.free < TIED * found.known), bool(met), bool(floored))


def _find(reached: Callable[[float], float], ends: list[tuple[float, float]]) -> None:
    """Search between two ends (strength, ln of what it reaches over what is wanted) of which the first is below 0."""
    for _ in range(STEPS):
        (low, below), (high, above) = ends
        # Straight in logarithms, but never too near an end.
        part = float(np.clip(-below / (above - below), 0.1, 0.9))
        s = float(np.exp((1 - part) * np.log(low) + part * np.log(high)))
        now = reached(s)
        if abs(now) < CLOSE:
            return
        ends[0 if now < 0 else 1] = (s, now)


def least_of(effect: Effect) -> float:
    """The least strength."""
    if effect.name == "fixed_pattern" and effect.form["kind"] == "hot":
        return LEAST_HOT
    if effect.floor >= effect.cap:
        # As strong as it was drawn.
        return effect.cap
    # Of other strangers any size will do.
    return LEAST.get(effect.name, 1e-3 * effect.cap)


def unknown_of(reference: Reference, name: str) -> np.ndarray | None:
    """What an effect is told beside: the laws' unknowns for laws, and for strangers, which any law is broken by; every
    frame's own numbers (None) for all else."""
    return reference.lawful() if name in LAWS or name.startswith("outside:") else None


def measure_of(reference: Reference, case: Case, effect: Effect) -> Callable[[float], Snr]:
    """Signal-to-noise by strength."""
    scatter = SCATTERS.get(effect.name)
    unknown = unknown_of(reference, effect.name)

    def measure(s: float) -> Snr:
        effect.s = s
        if scatter:
            return scatter(reference, effect)
        if effect.name != "spread_law":
            return reference.snr(reference.change(case.only(effect)), unknown)
        # Against the law p1 ln t + p2 that comes nearest to the power.
        middle = float(np.exp(np.mean(np.log(case.exposures))))
        p1 = s * spread(case.only(), middle)
        near = replace(case.only(), p1=p1, p2=case.p1 * np.log(middle) + case.p2 - p1 * np.log(middle))
        own = Reference(near)
        return own.snr(own.change(replace(near, effects={effect.name: effect})), own.lawful())

    return measure


# What scatters


def _variances(squares: np.ndarray, scale: float) -> float:
    """Signal-to-noise from squared ratios, of which each stands for `scale`."""
    return float(np.sqrt(scale * np.sum(squares) / 2))


def _of_frames(number: int, unit: Callable[[Reference], np.ndarray]) -> Callable[[Reference, Effect], Snr]:
    """A scatter of one of the frames' numbers, of s in a unit."""

    def snr(reference: Reference, effect: Effect) -> Snr:
        share = len(reference.case.frames) / len(reference.frames)
        size = effect.s * unit(reference)
        return Snr(*(_variances((size / own) ** 4, share) for own in reference.errors(number)))

    return snr


def _power(reference: Reference, effect: Effect) -> Snr:
    return _of_frames(0, lambda own: np.ones(len(own.frames)))(reference, effect)


def _jitter(reference: Reference, effect: Effect) -> Snr:
    both = [_of_frames(number, lambda own: 1 / own.sigma)(reference, effect) for number in (2, 3)]
    return Snr(*(float(np.hypot(*own)) for own in zip(*both, strict=True)))


def _rows(reference: Reference, effect: Effect) -> Snr:
    """Rows of every frame; a DN on a code is a DN of light less its shot noise."""
    told = reference.stride * np.sum(1 / reference.variance, axis=2)
    share = len(reference.case.frames) / len(reference.frames) * reference.stride
    found = _variances((effect.s**2 * told) ** 2, share)
    return Snr(found, found)


def _grain(reference: Reference, effect: Effect) -> Snr:
    """A field of a site. Of one site the free shape takes what is coarser than its nodes; of several their mean."""
    case = reference.case
    sites = sorted({case.frames[i].site for i in reference.frames})
    told = _told_by_field(reference, [[k for k, i in enumerate(reference.frames) if case.frames[i].site == site]
                                      for site in sites])  # fmt: skip
    # Sum over distances of the squared correlation exp(−4 ln 2 d²/g²).
    area = max(np.pi * effect["grain"] ** 2 / (8 * np.log(2)), 1.0)
    count = len(case.centres)
    share = reference.stride**2 * count / len(sites) * area
    known = _variances(effect.s**4 * told**2, share)
    left = 1 - 1 / count if count > 1 else _finer(reference, effect["grain"])
    return Snr(known, known * np.sqrt(left))


def _finer(reference: Reference, grain: float) -> float:
    """Part of the squared spectrum of a field that is finer than the shape's nodes."""
    f = np.fft.fftfreq(256)
    power = np.exp(-2 * (np.pi * grain) ** 2 * (f[:, None] ** 2 + f[None, :] ** 2) / (4 * np.log(2)))
    coarse = np.abs(f) < 1 / (2 * reference.nodes * float(reference.sigma[0]))
    return float(1 - np.sum(power[np.ix_(coarse, coarse)]) / np.sum(power))


def _pattern(reference: Reference, effect: Effect) -> Snr:
    """A field of the sensor, of all frames; hot pixels at known places."""
    share = len(reference.case.frames) / len(reference.frames)
    hot = int(effect["hot_pixels"])
    heights = effect.state["height"][:hot]
    dark = float(np.median(reference.variance))
    of_hot = float(np.sum(heights**2)) / dark * len(reference.case.frames)
    told = _told_by_field(reference, [list(range(len(reference.frames)))]) * share
    gains = _variances(effect["prnu"] ** 4 * told**2, reference.stride**2)
    left = 1.0 if len(reference.case.centres) > 1 else 1 - 1 / (reference.nodes * float(reference.sigma[0])) ** 2
    return Snr(float(np.hypot(gains, np.sqrt(of_hot))), float(np.hypot(gains * np.sqrt(left), np.sqrt(of_hot))))


def _told_by_field(reference: Reference, groups: list[list[int]]) -> np.ndarray:
    """Information on a factor of every pixel that the frames of a group share [group, y, x]."""
    light = np.stack([reference.thin(image) for image in reference.light])
    own = (light * reference.by_light.mean) ** 2
    return np.stack([own[group].sum(axis=0) for group in groups])


SCATTERS: dict[str, Callable[[Reference, Effect], Snr]] = {
    "power_fluctuation": _power,
    "pointing_jitter": _jitter,
    "row_noise": _rows,
    "speckle": _grain,
    "fixed_pattern": _pattern,
}
