"""The baseline model's numbers: the laws of width and peak, the sensor, and how they are drawn for a dataset."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rig.hidden.designs import CROP_PX, Design, middle_exposure

_FWHM = 2.3548
TOP_HAT = math.exp(-0.25)  # contract: light above this part of the peak is cut to it


@dataclass(frozen=True)
class Base:
    """Content of the instrument file, and the calibration that an analysis has to find."""

    exposures_s: tuple[float, ...]
    p1: float  # [px]
    p2: float  # [px]
    laser_px: float  # M sigma_la / s_px
    peak_dn: float  # peak A of the Gaussian, before the top hat, at the brightest exposure
    photon_budget: str
    top_hat: bool
    gain: float  # K [DN/e-]
    read_noise: float  # [e-]
    dark_current: float  # [e-/s]
    black_level: float  # [DN]
    bit_depth: int

    @property
    def full_scale(self) -> int:
        """Largest reading [DN]."""
        return 2**self.bit_depth - 1

    @property
    def plateau_dn(self) -> float:
        """Brightest light in any frame [DN], after the top hat."""
        return self.peak_dn * (TOP_HAT if self.top_hat else 1.0)

    def spread(self, t: float) -> float:
        """p_b = p1 ln(t / 1 s) + p2 [px]."""
        return self.p1 * math.log(t) + self.p2

    def peak(self, t: float, spread: float) -> float:
        """Peak A [DN] of a spot of spread p_b [px] exposed for t [s]."""
        brightest = max(self._relative(s, self.spread(s)) for s in self.exposures_s)
        return self.peak_dn * self._relative(t, spread) / brightest

    def _relative(self, t: float, spread: float) -> float:
        sigma = spread + self.laser_px
        return (spread / sigma) ** 2 if self.photon_budget == "spot_area" else t / sigma**2

    def truth(self) -> dict[str, Any]:
        """As plain numbers for the truth file."""
        values = asdict(self) | {"sigma_px": [self.spread(t) + self.laser_px for t in self.exposures_s]}
        del values["exposures_s"]
        return values


def draw_base(
    rng: np.random.Generator, design: Design, title: str, budget: str | None, can_have_black: bool
) -> tuple[Base, dict[str, Any]]:
    """Draw a baseline and its data sheet. `budget` fixes the photon budget."""
    bit_depth = 12 if rng.random() < 0.2 else 10
    step = 2.0 ** (bit_depth - 10)  # a 12-bit converter divides the same light into finer steps
    gain = _round(step * math.exp(rng.uniform(math.log(0.05), math.log(0.25))), 4)
    drawn_black = _round(step * rng.uniform(5.0, 40.0), 3) if rng.random() < 0.5 else 0.0
    black_level = drawn_black if can_have_black else 0.0
    drawn_budget = str(rng.choice(["spot_area", "linear"]))
    top_hat = bool(rng.random() < 0.5)
    sensor = {
        "pixel_pitch_m": float(rng.choice([5.5e-6, 4.8e-6, 3.45e-6])),
        "bit_depth": bit_depth,
        "gain_dn_per_e": gain,
        "read_noise_e": _round(rng.uniform(5.0, 20.0), 3),
        "dark_current_e_per_s": _round(rng.uniform(0.0, 200.0), 3),
        "quantum_efficiency": _round(rng.uniform(0.3, 0.8), 2),
        "black_level_dn": black_level,
    }
    instrument: dict[str, Any] = {"name": title, "crop_px": CROP_PX, "sensor": sensor}
    instrument |= _draw_optics(rng)
    instrument["model"] = {"photon_budget": budget or drawn_budget, "top_hat": top_hat}
    laser_px = _laser_px(instrument)
    p1, p2 = _draw_spread(rng, design, laser_px)
    plateau = rng.uniform(0.40, 0.85) * (2**bit_depth - 1)
    base = Base(
        exposures_s=design.exposures_s,
        p1=p1,
        p2=p2,
        laser_px=laser_px,
        peak_dn=plateau / (TOP_HAT if top_hat else 1.0),
        photon_budget=instrument["model"]["photon_budget"],
        top_hat=top_hat,
        gain=gain,
        read_noise=sensor["read_noise_e"],
        dark_current=sensor["dark_current_e_per_s"],
        black_level=black_level,
        bit_depth=bit_depth,
    )
    return base, instrument


def _draw_optics(rng: np.random.Generator) -> dict[str, Any]:
    """Sections optics, laser and material about Table 3, each sometimes absent."""
    sections: dict[str, Any] = {}
    if rng.random() < 0.85:
        sections["optics"] = {
            "focal_length_m": _round(rng.uniform(0.035, 0.06), 4),
            "working_distance_m": _round(rng.uniform(0.2, 0.3), 3),
            "f_number": float(rng.choice([5.6, 8.0, 11.0, 16.0])),
            "filter_transmission": 0.9193,
        }
    if rng.random() < 0.85:
        sections["laser"] = {
            "power_w": 0.001,
            "wavelength_m": float(rng.choice([6.5e-7, 5.32e-7])),
            "fwhm_x_m": _round(rng.uniform(60e-6, 110e-6), 3),
            "fwhm_y_m": _round(rng.uniform(60e-6, 110e-6), 3),
        }
    if rng.random() < 0.7:
        sections["material"] = {"reflectance": _round(rng.uniform(0.01, 0.05), 3)}
    return sections


def _laser_px(instrument: dict[str, Any]) -> float:
    """M sigma_la / s_px, 0 without optics or laser (contract)."""
    if "optics" not in instrument or "laser" not in instrument:
        return 0.0
    optics, laser = instrument["optics"], instrument["laser"]
    magnification = optics["focal_length_m"] / optics["working_distance_m"]
    sigma_m = (laser["fwhm_x_m"] + laser["fwhm_y_m"]) / 2 / _FWHM
    return magnification * sigma_m / instrument["sensor"]["pixel_pitch_m"]


def _draw_spread(rng: np.random.Generator, design: Design, laser_px: float) -> tuple[float, float]:
    """p1 and p2 [px] such that sigma_g stays within 14 to 36 px at every exposure; one exposure: p1 = 0 (contract)."""
    longest, shortest = max(design.exposures_s), min(design.exposures_s)
    rise = math.log(longest / shortest)
    if rise == 0.0:
        return 0.0, rng.uniform(14.0, 36.0) - laser_px
    p1 = rng.uniform(1.0, 8.0)
    low = 14.0 + p1 * rise
    sigma_long = rng.uniform(low, max(low, 36.0))
    middle = sigma_long - p1 * math.log(longest / middle_exposure(design)) - laser_px
    return p1, middle - p1 * math.log(middle_exposure(design))


def _round(value: float, digits: int) -> float:
    """`digits` significant digits: what stands in the file is exactly what the frames are made with."""
    return float(f"{value:.{digits}g}")
