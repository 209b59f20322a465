"""The light on the sensor, in DN, in the contract's order: shape, blur, halo, ghost, fringes, speckle,
pedestals, pixel gains."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tests.validation.generators.second.case import LASER_WIDTH, Case, Effect, Frame


def spread(case: Case, t: float) -> float:
    """p_b in px for the true exposure t [s]."""
    law = case.get("spread_law")
    if law:
        middle = float(np.exp(np.mean(np.log(case.exposures))))
        return (case.p1 * np.log(middle) + case.p2) * (t / middle) ** law["exponent"]
    return case.p1 * np.log(t) + case.p2


def budget(law: str, width: float | np.ndarray, t: float | np.ndarray) -> float | np.ndarray:
    """The peak's law without its scale: width is p_b in px, t in s."""
    sigma = width + LASER_WIDTH
    return (width / sigma) ** 2 if law == "spot_area" else t / sigma**2


def true_exposure(case: Case, frame: Frame) -> float:
    """Exposure in s with the shutter's offset."""
    offset = case.get("shutter_offset")
    return frame.exposure + (offset["offset"] if offset else 0.0)


def amplitude(case: Case, i: int) -> float:
    """Peak A of frame i in DN, every brightness effect included."""
    frame, longest = case.frames[i], case.exposures[-1]
    t = true_exposure(case, frame)
    value = case.peak * budget(case.budget, spread(case, t), t)
    value /= budget(case.budget, case.p1 * np.log(longest) + case.p2, longest)
    if effect := case.get("photon_budget"):
        value *= (frame.exposure / longest) ** effect["q"]
    if effect := case.get("angle_reflectance"):
        value *= 1 + effect["d"] * np.cos(2 * np.radians(frame.angle - effect["gamma0"]))
    if effect := case.get("power_fluctuation"):
        value *= max(0.0, 1 + effect["rms"] * effect.state["z"][i])
    if effect := case.get("laser_drift"):
        share = i / max(1, len(case.frames) - 1)
        total = effect["total"]
        value *= 1 + total * share if effect.form["law"] == "linear" else (1 + total) ** share
    return value


def stretch(dx: np.ndarray, dy: np.ndarray, ratio: float, direction: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in which an ellipse of this axis ratio and long-axis direction [deg] is a circle of the same area."""
    c, s = np.cos(np.radians(direction)), np.sin(np.radians(direction))
    along, across = (c * dx + s * dy) / np.sqrt(ratio), (c * dy - s * dx) * np.sqrt(ratio)
    return c * along - s * across, s * along + c * across


def coordinates(case: Case, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances in px of every pixel centre from the spot's centre in frame i."""
    x, y = case.centres[case.frames[i].site]
    if effect := case.get("pointing_jitter"):
        x, y = np.array([x, y]) + effect["rms"] * effect.state["z"][i]
    axis = np.arange(case.size)
    return axis[None, :] - x, axis[:, None] - y


def spot(case: Case, i: int, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The spot itself, displaced by `shift` px: shape, motion blur. DN."""
    frame, peak = case.frames[i], amplitude(case, i)
    t = true_exposure(case, frame)
    focus = case.apply("width", 1.0, i)
    sigma, peak = (spread(case, t) + LASER_WIDTH) * focus, peak / focus**2
    dx, dy = coordinates(case, i)
    dx, dy = dx - shift[0], dy - shift[1]
    if effect := case.get("beam_ellipticity"):
        dx, dy = stretch(dx, dy, effect["ratio"], effect["direction"])
    if effect := case.get("fibre_anisotropy"):
        dx, dy = stretch(dx, dy, effect["ratio"], effect.form["sense"] * frame.angle + effect.form["gamma0_deg"])
    dx, dy = case.apply("coordinates", (dx, dy), i)
    half_square = (dx**2 + dy**2) / (2 * sigma**2)
    effect = case.get("super_gaussian")
    if case.shape:
        # The radius in which exp(−ρ²/2) would be exp(−(ρ²/2)^n).
        steeper = np.maximum(half_square, 1e-12) ** ((effect["n"] - 1) / 2) if effect else 1.0
        image = peak * case.shape(dx / sigma * steeper, dy / sigma * steeper)
    else:
        image = peak * np.exp(-(half_square ** effect["n"] if effect else half_square))
    image = case.apply("profile", image, i, half_square)
    if effect := case.get("motion_blur"):
        image = smear_along(image, effect["speed"] * t, effect["direction"])
    return image


def smear_along(image: np.ndarray, length: float, direction: float) -> np.ndarray:
    """Uniform smear of `length` px in `direction` [deg], centred, by the Fourier transform of a line."""
    c, s = np.cos(np.radians(direction)), np.sin(np.radians(direction))
    rows, columns = image.shape
    u = np.fft.rfftfreq(columns)[None, :] * c + np.fft.fftfreq(rows)[:, None] * s
    return np.fft.irfft2(np.fft.rfft2(image) * np.sinc(u * length), s=image.shape)


def halo(case: Case, i: int, effect: Effect) -> np.ndarray:
    """Broad component around the spot, in DN; its peak is a fraction of A."""
    dx, dy = coordinates(case, i)
    r2 = (dx**2 + dy**2) / effect["radius"] ** 2
    profile = effect.form["profile"]
    if profile == "exponential":
        shape = np.exp(-np.sqrt(r2))
    elif profile == "gaussian":
        shape = np.exp(-r2 / 2)
    else:
        shape = (1 + r2) ** -effect.form["power"]
    return amplitude(case, i) * effect["fraction"] * shape


@lru_cache(maxsize=128)
def grains(seed: int, site: int, size: int, grain: float, law: str) -> np.ndarray:
    """Granular field of mean 0 and rms 1; `grain` is the FWHM in px of its autocovariance."""
    rng = np.random.default_rng([seed, site])
    f2 = np.fft.fftfreq(size)[:, None] ** 2 + np.fft.fftfreq(size)[None, :] ** 2
    kernel = grain / 2.3548 / (1.0 if law == "developed" else np.sqrt(2.0))
    noise = rng.standard_normal((size, size)) + 1j * rng.standard_normal((size, size))
    wave = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-2 * (np.pi * kernel) ** 2 * f2))
    values = np.abs(wave) ** 2 if law == "developed" else wave.real
    return (values - values.mean()) / values.std()


def speckle(effect: Effect, site: int, size: int) -> np.ndarray:
    """Multiplicative field of one site: exponential grains on an even background, or log-normal grains."""
    field = grains(effect.seed, site, size, effect["grain"], effect.form["law"])
    if effect.form["law"] == "developed":
        return 1 + effect["contrast"] * field
    scale = np.sqrt(np.log1p(effect["contrast"] ** 2))
    return np.exp(scale * field - scale**2 / 2)


def fringes(case: Case, i: int, effect: Effect) -> np.ndarray:
    """Stripes 1 + d cos(2 pi u / period + phase), u along `direction`."""
    dx, dy = coordinates(case, i)
    if effect.form["phase"] != "spot":
        axis = np.arange(case.size) - (case.size - 1) / 2
        dx, dy = axis[None, :], axis[:, None]
    site = case.frames[i].site if effect.form["phase"] == "site" else 0
    angle = np.radians(effect["direction"])
    u = dx * np.cos(angle) + dy * np.sin(angle)
    return 1 + effect["d"] * np.cos(2 * np.pi * u / effect["period"] + effect.state["phase"][site])


def gradient(case: Case, effect: Effect) -> np.ndarray:
    """Sloping pedestal in DN."""
    axis = (np.arange(case.size) - (case.size - 1) / 2) / 100.0
    angle = np.radians(effect["direction"])
    return effect["level"] + effect["slope"] * (axis[None, :] * np.cos(angle) + axis[:, None] * np.sin(angle))


def add_pedestals(case: Case, image: np.ndarray, source: str) -> np.ndarray:
    """An image [DN] with the pedestals of a source, light or electronics."""
    for name in ("dark_offset", "background_gradient"):
        effect = case.get(name)
        if effect and effect.form["as"] == source:
            image = image + (effect["level"] if name == "dark_offset" else gradient(case, effect))
    return image


def light(case: Case, i: int) -> np.ndarray:
    """Mean light of frame i in DN."""
    image = spot(case, i)
    extra = 0.0
    if effect := case.get("scatter_halo"):
        extra = extra + halo(case, i, effect)
    if effect := case.get("ghost_reflection"):
        extra = extra + effect["fraction"] * spot(case, i, (effect["dx"], effect["dy"]))
    image = image + extra
    if effect := case.get("interference_fringes"):
        image = image * fringes(case, i, effect)
    if effect := case.get("speckle"):
        image = image * speckle(effect, case.frames[i].site, case.size)
    image = add_pedestals(case, case.apply("light", image, i), "light")
    if effect := case.get("fixed_pattern"):
        image = image * (1 + effect["prnu"] * effect.state["z"])
    return np.maximum(image, 0.0)
