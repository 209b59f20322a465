"""The paper's printed numbers, each with the range in which it counts as met, and how far a rig is from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig import measure, papersim
from rig.settings import Settings

# Axes of every table below: angle, exposure, repeat.
QUANTITIES = ("maximum", "amplitude", "sigma_px", "contrast", "sum", "peak_share")


@dataclass(frozen=True)
class Score:
    """One number: its value here and the range that counts as met (both ends included)."""

    name: str
    value: float
    low: float
    high: float

    @property
    def is_met(self) -> bool:
        return self.low <= self.value <= self.high

    @property
    def miss(self) -> float:
        """How far from safely inside: distance from the range less a tenth at each end, in units of its width."""
        if not math.isfinite(self.value):
            return 10.0
        width = self.high - self.low
        if not math.isfinite(width):  # one end open: a twentieth of the other end, at least 1
            width = max(1.0, 0.05 * abs(self.low if math.isfinite(self.low) else self.high))
        low, high = self.low + 0.1 * width, self.high - 0.1 * width
        return min(10.0, max(low - self.value, self.value - high, 0.0) / width)


@dataclass(frozen=True)
class Measured:
    """Measured quantities of a whole set of crops, and the calibration of its sites."""

    angles_deg: list[float]  # angles of the set [deg]
    exposures_s: list[float]  # exposures [s]
    crops: np.ndarray  # readings [angle, exposure, repeat, y, x] in DN
    tables: dict[str, np.ndarray]  # each of `QUANTITIES` [angle, exposure, repeat]
    p1: np.ndarray  # slope of the width in ln exposure, of each site [angle, repeat] in px
    p2: np.ndarray  # width at 1 s, of each site [angle, repeat] in px


@dataclass(frozen=True)
class Simulated:
    """The paper's simulation calibrated on a set: tables [exposure, repeat], and the PSNR of every crop against it."""

    tables: dict[str, np.ndarray]
    psnr_db: np.ndarray


def measure_set(settings: Settings, crops: np.ndarray, angles_deg: list[float], exposures_s: list[float]) -> Measured:
    """Measure every crop, and fit p1 ln(t / 1 s) + p2 to the widths of every site."""
    tables = _measure_all(crops)
    widths = tables["sigma_px"] - papersim.laser_sigma_px(settings)
    per_exposure = widths.transpose(1, 0, 2).reshape(len(exposures_s), -1)
    p1, p2 = np.polyfit(np.log(exposures_s), per_exposure, 1).reshape(2, crops.shape[0], crops.shape[2])
    return Measured(angles_deg, exposures_s, crops, tables, p1, p2)


def simulate_set(settings: Settings, measured: Measured, seed: int) -> Simulated:
    """One simulated image for each exposure and repeat; it serves every angle, for the model knows none."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
    exposures, repeats = measured.exposures_s, measured.crops.shape[2]
    law = papersim.Law(
        float(measured.p1.mean()), float(measured.p2.mean()), papersim.laser_sigma_px(settings), scale_dn=1000.0
    )
    wanted = float(measured.tables["maximum"][:, 1:].mean())
    law = papersim.calibrated_scale(settings, law, exposures[1:], wanted, rng)
    images = np.array([[papersim.simulate(settings, law, t, rng) for _ in range(repeats)] for t in exposures])
    psnr = np.empty(measured.crops.shape[:3])
    for angle, exposure, repeat in np.ndindex(*psnr.shape):
        psnr[angle, exposure, repeat] = measure.psnr_db(
            measured.crops[angle, exposure, repeat], images[exposure, repeat]
        )
    return Simulated(_measure_all(images), psnr)


def _measure_all(crops: np.ndarray) -> dict[str, np.ndarray]:
    values = np.empty((len(QUANTITIES), *crops.shape[:-2]))
    for cell in np.ndindex(*crops.shape[:-2]):
        crop = crops[cell].astype(float)
        fit = measure.fit_gaussian(crop)
        shares = measure.contrast(crop), crop.sum(), measure.peak_share(crop)
        values[:, *cell] = crop.max(), fit.amplitude, fit.sigma_px, *shares
    return dict(zip(QUANTITIES, values, strict=True))


def score(measured: Measured, simulated: Simulated) -> list[Score]:
    """Every printed number of the measured side, and those of the simulated side that hang on it."""
    tables = measured.tables | {"psnr_db": simulated.psnr_db}
    mean = {name: table.mean(axis=2) for name, table in tables.items()}
    sd = {name: table.std(axis=2, ddof=1) for name, table in tables.items()}
    model = {name: table.mean(axis=1) for name, table in simulated.tables.items()}
    inf = math.inf
    model_sigma = model["sigma_px"]
    width_off = mean["sigma_px"] - model_sigma
    at = {angle: i for i, angle in enumerate(measured.angles_deg)}
    first_three = [at[a] for a in (0.0, 45.0, 90.0)]
    rise = np.min(mean["sigma_px"][at[90.0]] - mean["sigma_px"][at[45.0]])
    drop = np.min(mean["sigma_px"][at[90.0]] - mean["sigma_px"][at[135.0]])
    inside = np.abs(model["sum"] - mean["sum"]) <= sd["sum"]
    plateau_off = np.abs(model["maximum"] - mean["maximum"])
    contrast_ratio = sd["contrast"][:, 0].mean() / sd["contrast"][:, 1:].mean()
    highest = np.min(mean["psnr_db"][:, 0] - mean["psnr_db"][:, 1:].max(axis=1))
    rows = [
        ("p1 mean [px]", measured.p1.mean(), 2.16, 2.80),
        ("p2 mean [px]", measured.p2.mean(), 33.35, 35.75),
        ("PSNR mean, smallest [dB]", mean["psnr_db"].min(), 50.5, 55.5),
        ("PSNR mean, largest [dB]", mean["psnr_db"].max(), 55.5, 60.5),
        ("PSNR sd, smallest [dB]", sd["psnr_db"].min(), -0.65, 2.05),
        ("PSNR sd, largest [dB]", sd["psnr_db"].max(), 2.05, 4.75),
        ("PSNR at 100 us above the others, least [dB]", highest, 0.0, inf),
        ("C_s mean, smallest", mean["contrast"].min(), 1.85, 6.95),
        ("C_s mean, largest", mean["contrast"].max(), 6.95, 12.05),
        ("C_s sd, smallest", sd["contrast"].min(), -0.375, 1.075),
        ("C_s sd, largest", sd["contrast"].max(), 1.075, 2.525),
        ("C_s sd at 100 us over the others' (about 2)", contrast_ratio, 1.5, 2.7),
        ("plateau, least of all frames [DN]", mean["maximum"].min(), 800.0, inf),
        ("plateau means, spread [DN]", np.ptp(mean["maximum"]), 0.0, 6.0),
        ("plateau sd, largest [DN]", sd["maximum"].max(), 0.0, 10.0),
        ("amplitude mean 100 us, smallest [DN]", mean["amplitude"][:, 0].min(), 796.5, 881.5),
        ("amplitude mean 100 us, largest [DN]", mean["amplitude"][:, 0].max(), 881.5, 966.5),
        ("amplitude mean 500/900 us, smallest [DN]", mean["amplitude"][:, 1:].min(), 957.0, 1027.0),
        ("amplitude mean 500/900 us, largest [DN]", mean["amplitude"][:, 1:].max(), 1027.0, 1097.0),
        ("amplitude sd 100 us, largest [DN]", sd["amplitude"][:, 0].max(), 113.5, 227.0),
        ("amplitude sd 500/900 us, largest [DN]", sd["amplitude"][:, 1:].max(), 0.0, 51.0),
        ("width sd, smallest [px]", sd["sigma_px"].min(), -0.5, 2.5),
        ("width sd, largest [px]", sd["sigma_px"].max(), 2.5, 5.5),
        ("width against simulation 0-90 deg, largest [px]", np.abs(width_off[first_three]).max(), 0.0, 2.0),
        ("width against simulation 135 deg 100 us [px]", abs(width_off[at[135.0], 0]), 2.25, 4.5),
        ("width rise 45 to 90 deg, least [px]", rise, 0.0, inf),
        ("width drop 90 to 135 deg, least [px]", drop, 0.0, inf),
        ("simulated sums inside the measured spread [of 12]", float(inside.sum()), 11.0, inf),
        ("peak pixels of the plateau, smallest", mean["peak_share"].min(), -0.01, 0.03),
        ("peak pixels of the plateau, largest", mean["peak_share"].max(), 0.03, 0.07),
        ("simulated plateau off, largest [DN]", plateau_off.max(), 21.5, 43.0),
        ("simulated plateau off 500/900 us, largest [DN]", plateau_off[:, 1:].max(), 0.0, 8.0),
        ("simulated C_s, smallest", model["contrast"].min(), 2.65, 4.35),
        ("simulated C_s, largest", model["contrast"].max(), 4.35, 6.05),
        ("simulated width steps, short less long [px]", 2 * model_sigma[1] - model_sigma[0] - model_sigma[2], 0.0, inf),
    ]
    return [Score(name, float(value), low, high) for name, value, low, high in rows]


def extras(measured: Measured) -> dict[str, float]:
    """Clues that are not counted: how p1 hangs on the width, and the scatter of p1 and p2."""
    width = measured.tables["sigma_px"].mean(axis=1).ravel()
    return {
        "corr(p1, mean width)": float(np.corrcoef(measured.p1.ravel(), width)[0, 1]),
        "sd(p1) over sites [px]": float(measured.p1.std(ddof=1)),
        "sd(p2) over sites [px]": float(measured.p2.std(ddof=1)),
        "sd(p1) over angle means [px]": float(measured.p1.mean(axis=1).std(ddof=1)),
        "sd(p2) over angle means [px]": float(measured.p2.mean(axis=1).std(ddof=1)),
        "sum sd, largest [DN]": float(measured.tables["sum"].std(axis=2, ddof=1).max()),
    }
