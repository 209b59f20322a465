"""The contract's 24 effects, each drawn at random in one of the forms that the contract leaves free."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.validation.generators.second.case import Case, Effect

Rng = np.random.Generator


def saturation(case: Case, rng: Rng) -> Effect:
    """Level in DN of signal above black; soft knees have an order."""
    knee = str(rng.choice(["hard_before_read_noise", "hard_after_read_noise", "soft"]))
    if knee == "soft":
        form = {"knee": knee, "order": float(rng.choice([4, 6, 8, 12]))}
        return Effect(lambda s: {"level": case.plateau / (0.6 + s)}, form, 0.2, 1.2, floor=0.25)
    floor = rng.uniform(0.03, 0.25)
    return Effect(lambda s: {"level": case.plateau * (1 - s)}, {"knee": knee}, 0.08, 0.5, floor=floor)


def nonlinearity(case: Case, rng: Rng) -> Effect:
    """Bends down three times out of four."""
    sign = float(rng.choice([1, 1, 1, -1]))
    return Effect(lambda s: {"q": sign * s}, {}, 0.05, 0.35)


def black_clipping(case: Case, rng: Rng) -> Effect:
    """Threshold in raw DN, above the black level."""
    form = {"law": str(rng.choice(["subtraction", "dead_zone"]))}
    return Effect(lambda s: {"threshold": case.black + s}, form, 6.0, 40.0, floor=4.0)


def pedestal_form(rng: Rng) -> dict[str, object]:
    """A pedestal made of light, with its shot noise, or by the electronics, without."""
    return {"as": str(rng.choice(["light", "electronics"]))}


def dark_offset(case: Case, rng: Rng) -> Effect:
    """The same in every frame."""
    return Effect(lambda s: {"level": s}, pedestal_form(rng), 3.0, 60.0)


def background_gradient(case: Case, rng: Rng) -> Effect:
    """Linear, nowhere negative."""
    direction, rise = rng.uniform(0, 360), rng.uniform(1.0, 1.6) * case.size / 2 * np.sqrt(2) / 100
    form = pedestal_form(rng)
    return Effect(lambda s: {"level": rise * s, "slope": s, "direction": direction}, form, 3.0, 30.0, floor=2.0)


def super_gaussian(case: Case, rng: Rng) -> Effect:
    """Steeper or flatter."""
    sign = float(rng.choice([1, -1]))
    return Effect(lambda s: {"n": float(np.exp(sign * s))}, {}, 0.06, 0.6)


def scatter_halo(case: Case, rng: Rng) -> Effect:
    """Three profiles; the radius is the profile's own scale."""
    form: dict[str, object] = {"profile": str(rng.choice(["exponential", "gaussian", "power_law"]))}
    if form["profile"] == "power_law":
        form["power"] = float(rng.choice([1.5, 2.0, 3.0]))
    radius = rng.uniform(32, 60) if form["profile"] == "gaussian" else rng.uniform(22, 55)
    return Effect(lambda s: {"fraction": s, "radius": radius}, form, 0.02, 0.3)


def fibre_anisotropy(case: Case, rng: Rng) -> Effect:
    """Sense of rotation and zero are free."""
    form = {"sense": float(rng.choice([-1, 1])), "gamma0_deg": rng.uniform(0, 180)}
    return Effect(lambda s: {"ratio": 1 + s}, form, 0.05, 0.8)


def beam_ellipticity(case: Case, rng: Rng) -> Effect:
    """Any direction."""
    direction = rng.uniform(0, 180)
    return Effect(lambda s: {"ratio": 1 + s, "direction": direction}, {}, 0.05, 0.8)


def angle_reflectance(case: Case, rng: Rng) -> Effect:
    """Any zero."""
    gamma0 = rng.uniform(0, 180)
    return Effect(lambda s: {"d": s, "gamma0": gamma0}, {}, 0.02, 0.3)


def photon_budget(case: Case, rng: Rng) -> Effect:
    """Steeper or flatter than the stated law."""
    sign = float(rng.choice([1, -1]))
    return Effect(lambda s: {"q": sign * s}, {}, 0.04, 0.6)


def shutter_offset(case: Case, rng: Rng) -> Effect:
    """Opens too long or too short; width and brightness both follow the true exposure."""
    unit = float(rng.choice([1, -1])) * case.exposures[0]
    return Effect(lambda s: {"offset": unit * s}, {}, 0.1, 0.48)


def spread_law(case: Case, rng: Rng) -> Effect:
    """A power of t through the base width at the geometric mean exposure."""
    return Effect(lambda s: {"exponent": s}, {}, 0.25, 0.5)


def motion_blur(case: Case, rng: Rng) -> Effect:
    """s is the length in px at the longest exposure."""
    direction, longest = rng.uniform(0, 180), case.exposures[-1]
    return Effect(lambda s: {"speed": s / longest, "direction": direction}, {}, 8.0, 40.0)


def interference_fringes(case: Case, rng: Rng) -> Effect:
    """Phase fixed to the sensor, to the spot, or anew at each site."""
    period, direction = float(np.exp(rng.uniform(np.log(5), np.log(40)))), rng.uniform(0, 180)
    form, sites = {"phase": str(rng.choice(["sensor", "spot", "site"]))}, len(case.centres)
    state = {"phase": rng.uniform(0, 2 * np.pi, sites)}
    return Effect(lambda s: {"d": s, "period": period, "direction": direction}, form, 0.03, 0.4, state=state)


def ghost_reflection(case: Case, rng: Rng) -> Effect:
    """Any direction, 25 to 60 px away."""
    distance, angle = rng.uniform(25, 60), rng.uniform(0, 2 * np.pi)
    dx, dy = distance * np.cos(angle), distance * np.sin(angle)
    return Effect(lambda s: {"fraction": s, "dx": dx, "dy": dy}, {}, 0.02, 0.25)


def speckle(case: Case, rng: Rng) -> Effect:
    """Exponential grains on an even background, or log-normal ones."""
    grain, form = rng.uniform(1.5, 5.0), {"law": str(rng.choice(["developed", "lognormal"]))}
    seed, floor = int(rng.integers(2**31)), rng.uniform(0.03, 0.2)
    return Effect(lambda s: {"contrast": s, "grain": grain}, form, 0.05, 0.5, seed=seed, floor=floor)


def excess_read_noise(case: Case, rng: Rng) -> Effect:
    """Total, not additional, electrons."""
    floor = rng.uniform(0.3, 1.5)
    return Effect(lambda s: {"total": case.read_noise * (1 + s)}, {}, 0.3, 4.0, floor=floor)


def frame_scatter(rng: Rng, shape: tuple[int, ...]) -> tuple[dict[str, object], dict[str, np.ndarray]]:
    """Numbers of mean 0 and rms 1 without order, normal or uniform."""
    law = str(rng.choice(["normal", "uniform"]))
    z = rng.standard_normal(shape) if law == "normal" else rng.uniform(-np.sqrt(3), np.sqrt(3), shape)
    return {"law": law}, {"z": z}


def power_fluctuation(case: Case, rng: Rng) -> Effect:
    """Each frame by itself."""
    form, state = frame_scatter(rng, (len(case.frames),))
    return Effect(lambda s: {"rms": s}, form, 0.01, 0.15, state=state)


def laser_drift(case: Case, rng: Rng) -> Effect:
    """From the first frame to the last, by equal steps or by equal factors."""
    sign, form = float(rng.choice([1, -1])), {"law": str(rng.choice(["linear", "geometric"]))}
    return Effect(lambda s: {"total": sign * s}, form, 0.03, 0.3)


def pointing_jitter(case: Case, rng: Rng) -> Effect:
    """Each exposure of a site by itself, both axes alike."""
    form, state = frame_scatter(rng, (len(case.frames), 2))
    return Effect(lambda s: {"rms": s}, form, 0.3, 3.0, state=state)


def fixed_pattern(case: Case, rng: Rng) -> Effect:
    """Pixel gains, hot pixels of constant height, or both."""
    form = {"kind": str(rng.choice(["gains", "hot", "both"]))}
    state = {"z": rng.standard_normal((case.size, case.size)), "height": 25 + rng.exponential(60, 100)}
    y, x = np.divmod(rng.choice(case.size**2, 100, replace=False), case.size)
    state |= {"y": y, "x": x}
    if form["kind"] == "hot":
        return Effect(lambda s: {"prnu": 0.0, "hot_pixels": round(s)}, form, 30, 100, state=state)
    hot = 0 if form["kind"] == "gains" else int(rng.integers(5, 60))
    return Effect(lambda s: {"prnu": s, "hot_pixels": hot}, form, 0.02, 0.1, state=state)


def row_noise(case: Case, rng: Rng) -> Effect:
    """Additive in DN, anew in every frame."""
    form, state = frame_scatter(rng, (len(case.frames), case.size))
    return Effect(lambda s: {"rms": s}, form, 2.0, 15.0, state=state)


def smear(case: Case, rng: Rng) -> Effect:
    """Added to the light that made it."""
    return Effect(lambda s: {"fraction": s}, {}, 0.03, 0.3)


VOCABULARY: dict[str, Callable[[Case, Rng], Effect]] = {
    draw.__name__: draw
    for draw in (
        *(saturation, nonlinearity, black_clipping, dark_offset, background_gradient, super_gaussian),
        *(scatter_halo, fibre_anisotropy, beam_ellipticity, angle_reflectance, photon_budget, shutter_offset),
        *(spread_law, motion_blur, interference_fringes, ghost_reflection, speckle, excess_read_noise),
        *(power_fluctuation, laser_drift, pointing_jitter, fixed_pattern, row_noise, smear),
    )
}
