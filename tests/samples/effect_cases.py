"""What the tests of effects share: scales, cases, and the dataset contract's light, written out once more and slowly.

`slow_light` is the contract's chain at pixels, one stage a function, in a given order of stages: the library must agree
in the contract's order, and would not in another.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, PixelGrid, crop_grid
from spotcheck.model.effect import AppliedEffect, AppliedStep, EffectScales, RandomStep
from spotcheck.model.effects import Choice, choose, vocabulary
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.sensor import SensorModel
from tests.samples.small_datasets import ROOT

# The examples of effects in a file that the page of effects shows: one that changes the mean, and one that is random.
MEAN_EXAMPLE, RANDOM_EXAMPLE = (
    part.split("```")[0]
    for part in (ROOT / "workflow/docs/effects.md").read_text(encoding="utf-8").split("```python\n")[1:]
)


@contextmanager
def knowing(*files: Path, only: Sequence[str] = (), without: Sequence[str] = ()) -> Iterator[None]:
    """Use the vocabulary of a run that adds files and leaves effects out, until the end of a block."""
    choose(Choice(tuple(map(str, files)), tuple(only), tuple(without)))
    try:
        yield
    finally:
        choose(Choice())


def written(folder: Path, name: str, text: str) -> Path:
    """Write a Python file and return its path."""
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    return path


SCALES = {
    "the paper's": EffectScales(18.4, 640.0, 1023.0, 240.0, 1e-4, 13.0, 0.11, 0.17, 9e-4),
    "small and faint": EffectScales(2.5, 12.0, 255.0, 40.0, 1e-6, 0.0, 2.0, -0.3, 5e-6),
    "16 bit": EffectScales(45.0, 6e4, 65535.0, 512.0, 3.0, 2.0, 1.2, 0.0, 9.0),
}

P1, P2, PEAK, LASER = 2.48, 34.55, 640.0, 1.19
LAW = ExposureLaw(P1, P2, PEAK)
LONGEST = 9e-4
EXPOSURES = (1e-4, 3e-4, 9e-4)
REFERENCE = float(np.exp(np.mean(np.log(EXPOSURES))))
# With a black level, so that the converter's zero cuts nothing but what an effect brings there.
SENSOR = SensorModel(0.11, 13.0, 70.0, np.inf, 40.0, 1023.0)


class Case(NamedTuple):
    """An effect as a test sets it: name, text of its variant, parameters by name."""

    name: str
    variant: str
    values: dict[str, float]

    def applied(self) -> AppliedEffect:
        """Return the effect in a model; what the variant lacks is NaN, so that nothing may depend on it."""
        return vocabulary()[self.name].apply(self.values, self.variant)

    def changed(self, **values: float) -> "Case":
        """Return the case with other values."""
        return self._replace(values=self.values | values)


def of(name: str, variant: str | None = None, **values: float) -> Case:
    """Return a case, without a text that of the first variant."""
    return Case(name, next(iter(vocabulary()[name].variants)).value if variant is None else variant, values)


def applied(cases: Sequence[Case]) -> tuple[AppliedEffect, ...]:
    """Return cases as a model takes them."""
    return tuple(case.applied() for case in cases)


# Every second pixel of a crop that lies at (100, 60) on a sensor of 420 × 300.
ROWS, COLUMNS = 44, 48
GRID = PixelGrid(100.0 + 2 * np.arange(COLUMNS)[None, :], 60.0 + 2 * np.arange(ROWS)[:, None], 420, 300)
FRAMES = [
    FrameConditions(GRID, 147.3 + 1.7 * k, 104.6 - 0.9 * k, exposure, LONGEST, REFERENCE, np.deg2rad(angle), k / 5)
    for k, (angle, exposure) in enumerate((angle, exposure) for angle in (0.0, 50.0) for exposure in EXPOSURES)
]
# What random steps have drawn in the tests of the light, in the order of an effect's steps.
RNG = np.random.default_rng(3)
DRAWN: dict[str, tuple[Any, ...]] = {
    "interference_fringes": (np.deg2rad(70.0),),
    "speckle": (RNG.gamma(4.0, 0.25, (ROWS, COLUMNS)),),
    "fixed_pattern": (1 + 0.1 * RNG.standard_normal((ROWS, COLUMNS)),),
    "power_fluctuation": (1.2,),
    "pointing_jitter": (1.7, -2.9),  # to the right, down
    "site_variation": (0.93, 1.15),  # width, brightness
}


def free_frame(peak_dn: float, sigma_px: float, grid: PixelGrid | None = None, **changes: Any) -> FrameConditions:
    """Return a frame without a law: 240 × 240 px with the spot at (120.4, 119.7), or another grid of that sensor."""
    conditions = {"x0": 120.4, "y0": 119.7, "exposure_s": 1e-3, "longest_s": 1e-3, "reference_s": 1e-3}
    conditions |= {"angle": 0.5, "order": 0.25, "peak_dn": peak_dn, "sigma_px": sigma_px}
    return FrameConditions(grid or crop_grid(range(240), range(240), 240, 240), **(conditions | changes))


FREE = Baseline(LASER, "free", False, 1e-3)


def model_of(cases: Sequence[Case], budget: str = "linear", cut: bool = False, sensor=SENSOR) -> ForwardModel:
    """Return the paper's model with effects; without a law under the budget `free`."""
    law = None if budget == "free" else LAW
    return ForwardModel(Baseline(LASER, budget, cut, LONGEST), sensor, law, applied(cases))


def expected_of(cases: Sequence[Case], sensor=SENSOR, frames=FRAMES, budget: str = "linear") -> np.ndarray:
    """Return mean and variance [quantity, frame, row, column] of readings."""
    readings = [model_of(cases, budget, sensor=sensor).expected(frame) for frame in frames]
    return np.array([[reading.mean for reading in readings], [reading.variance for reading in readings]])


# The contract's light, slowly. A stage gets the light so far, a function of (x, y), and returns what it becomes.


class SlowFrame(NamedTuple):
    """One frame of the slow chain: its numbers, and every effect's parameters and variant."""

    x0: float
    y0: float
    exposure_s: float
    angle_deg: float
    amplitude: float
    sigma: float
    top_hat: bool
    values: dict[str, dict[str, float]]
    variant: dict[str, str]


def drift(order: float, variant: str, values: dict[str, float]) -> float:
    """How far a drift has run at a place in the order of acquisition: steadily, or as what warms up."""
    if variant == "linear":
        return order
    return (1 - np.exp(-values["rate"] * order)) / (1 - np.exp(-values["rate"]))


def slow_frame(frame: FrameConditions, cases, budget: str, cut: bool) -> SlowFrame:
    """Width and peak of a frame: σ_g = p_b + laser, peak ∝ (p_b/σ_g)² or t/σ_g², each law as it is written."""
    values, variant = {c.name: c.values for c in cases}, {c.name: c.variant for c in cases}

    def spread(t):
        if "spread_law" in values:
            return (P1 * np.log(REFERENCE) + P2) * (t / REFERENCE) ** values["spread_law"]["exponent"]
        return P1 * np.log(t) + P2

    def law(t):
        return (spread(t) / (spread(t) + LASER)) ** 2 if budget == "spot_area" else t / (spread(t) + LASER) ** 2

    true = frame.exposure_s + values.get("shutter_offset", {"offset": 0.0})["offset"]
    amplitude, sigma, x0, y0 = PEAK * law(true) / law(LONGEST), spread(true) + LASER, frame.x0, frame.y0
    if "photon_budget" in values:
        amplitude *= (frame.exposure_s / LONGEST) ** values["photon_budget"]["q"]
    if "angle_reflectance" in values:
        d, gamma0 = values["angle_reflectance"]["d"], np.deg2rad(values["angle_reflectance"]["gamma0"])
        amplitude *= 1 + d * np.cos(2 * (frame.angle - gamma0))
    if "laser_drift" in values:
        p = values["laser_drift"]
        amplitude *= 1 + p["total"] * drift(frame.order, variant["laser_drift"], p)
    if "power_fluctuation" in values:
        amplitude *= DRAWN["power_fluctuation"][0]
    if "site_variation" in values:
        sigma *= DRAWN["site_variation"][0]
        amplitude *= DRAWN["site_variation"][1]
    if "pointing_jitter" in values:
        x0, y0 = x0 + DRAWN["pointing_jitter"][0], y0 + DRAWN["pointing_jitter"][1]
    return SlowFrame(x0, y0, true, np.rad2deg(frame.angle), amplitude, sigma, cut, values, variant)


def shape(light, f: SlowFrame):
    """An ellipse by its covariance matrix, of area 2πσ²; exp(−(ρ²/2)^n)."""
    ratio, axis = 1.0, 0.0
    if "beam_ellipticity" in f.values:
        ratio, axis = f.values["beam_ellipticity"]["ratio"], f.values["beam_ellipticity"]["direction"]
    if "fibre_anisotropy" in f.values:
        sense = 1 if f.variant["fibre_anisotropy"] == "same sense" else -1
        ratio, axis = f.values["fibre_anisotropy"]["ratio"], sense * f.angle_deg + f.values["fibre_anisotropy"]["zero"]
    along = np.array([np.cos(np.deg2rad(axis)), np.sin(np.deg2rad(axis))])
    across = np.array([-along[1], along[0]])
    covariance = f.sigma**2 * (ratio * np.outer(along, along) + np.outer(across, across) / ratio)
    (a, b), (_, c) = np.linalg.inv(covariance)
    n = f.values.get("super_gaussian", {"n": 1.0})["n"]

    def out(x, y):
        dx, dy = x - f.x0, y - f.y0
        return f.amplitude * np.exp(-(((a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2) ** n))

    return out


def top_hat(light, f: SlowFrame):
    """Light above exp(−1/4) of A is cut to it."""
    return (lambda x, y: np.minimum(light(x, y), np.exp(-0.25) * f.amplitude)) if f.top_hat else light


def blur(light, f: SlowFrame, steps: int = 300):
    """The mean over a path of length speed · t about the spot, by the midpoint rule."""
    if "motion_blur" not in f.values:
        return light
    length = f.values["motion_blur"]["speed"] * f.exposure_s
    direction = np.deg2rad(f.values["motion_blur"]["direction"])
    path = length * ((np.arange(steps) + 0.5) / steps - 0.5)
    return lambda x, y: sum(light(x - s * np.cos(direction), y - s * np.sin(direction)) for s in path) / steps


def added(light, f: SlowFrame):
    """A halo of peak `fraction` A, and a displaced copy of the spot."""

    def out(x, y):
        total = light(x, y)
        if "scatter_halo" in f.values:
            p, variant = f.values["scatter_halo"], f.variant["scatter_halo"]
            r = np.hypot(x - f.x0, y - f.y0) / p["radius"]
            profile = {"exponential": np.exp(-r), "gaussian": np.exp(-r * r / 2)}
            total = total + p["fraction"] * f.amplitude * (
                (1 + r * r) ** -p["tail"] if variant == "power" else profile[variant]
            )
        if "ghost_reflection" in f.values:
            p = f.values["ghost_reflection"]
            total = total + p["fraction"] * light(x - p["dx"], y - p["dy"])
        return total

    return out


def fringes(light, f: SlowFrame):
    """1 + d cos(2πu/period + φ), u across the stripes."""
    if "interference_fringes" not in f.values:
        return light
    p, variant = f.values["interference_fringes"], f.variant["interference_fringes"]
    phase = DRAWN["interference_fringes"][0] if variant == "site" else np.deg2rad(p["phase"])
    x0, y0 = (0.0, 0.0) if variant == "sensor" else (f.x0, f.y0)
    direction = np.deg2rad(p["direction"])

    def out(x, y):
        u = (x - x0) * np.cos(direction) + (y - y0) * np.sin(direction)
        return light(x, y) * (1 + p["d"] * np.cos(2 * np.pi * u / p["period"] + phase))

    return out


def speckle(light, f: SlowFrame):
    """A granular field on the spot and what belongs to it."""
    return (lambda x, y: light(x, y) * DRAWN["speckle"][0]) if "speckle" in f.values else light


def pedestals(light, f: SlowFrame):
    """Ambient light, uniform or rising from the frame's centre, never below 0."""

    def out(x, y):
        total = light(x, y) + 0 * x
        if f.variant.get("dark_offset") == "light":
            total = total + f.values["dark_offset"]["level"]
        if f.variant.get("background_gradient") == "light":
            p = f.values["background_gradient"]
            uphill = np.deg2rad(p["direction"])
            distance = (x - 209.5) * np.cos(uphill) + (y - 149.5) * np.sin(uphill)
            plane = p["level"] + p["slope"] * distance / 100
            total = total + np.where(plane > 0, plane, 0.0)
        return total

    return out


def pixel_gains(light, f: SlowFrame):
    """The gain of each pixel, on all light."""
    return (lambda x, y: light(x, y) * DRAWN["fixed_pattern"][0]) if "fixed_pattern" in f.values else light


SLOW_STAGES = (shape, top_hat, blur, added, fringes, speckle, pedestals, pixel_gains)


def slow_light(cases, budget="linear", cut=False, stages=SLOW_STAGES, frames=FRAMES) -> np.ndarray:
    """Light [DN] of frames [frame, row, column], pedestals of light included."""
    out = []
    for frame in frames:
        x, y = np.broadcast_arrays(frame.pixels.x, frame.pixels.y)
        slow, light = slow_frame(frame, cases, budget, cut), None
        for stage in stages:
            light = stage(light, slow)
        out.append(light(x, y))
    return np.array(out)


def model_light(cases, budget="linear", cut=False, frames=FRAMES) -> np.ndarray:
    """The library's light [DN] of frames [frame, row, column]; random steps have drawn `DRAWN`."""
    model, drawn = model_of(cases, budget, cut), {}
    for effect in model.effects:
        steps = [step for step in effect.effect.variants[effect.variant] if isinstance(step, RandomStep)]
        values = DRAWN[effect.effect.name] if steps else ()
        drawn |= {AppliedStep(step, effect): value for step, value in zip(steps, values, strict=True)}
    lights = [model.light(frame, drawn).total for frame in frames]
    return np.array([light * np.ones((frame.pixels.y.size, frame.pixels.x.size)) for light, frame in
                     zip(lights, frames, strict=True)])  # fmt: skip


HALO = [
    of("scatter_halo", "exponential", fraction=0.04, radius=31.0),
    of("scatter_halo", "gaussian", fraction=0.1, radius=45.0),
    of("scatter_halo", "power", fraction=0.07, radius=22.0, tail=1.3),
]
FRINGES = [
    of("interference_fringes", "spot", d=0.2, period=9.3, direction=33.0, phase=70.0),
    of("interference_fringes", "sensor", d=0.6, period=21.0, direction=-118.0, phase=10.0),
    of("interference_fringes", "site", d=0.2, period=14.2, direction=80.0),
]
ELLIPSES = [
    of("fibre_anisotropy", "same sense", ratio=1.4, zero=20.0),
    of("fibre_anisotropy", "opposite sense", ratio=2.6, zero=-75.0),
    of("beam_ellipticity", ratio=1.3, direction=25.0),
    of("beam_ellipticity", ratio=3.1, direction=160.0),
]
LAWS = [
    of("angle_reflectance", d=0.3, gamma0=28.0),
    of("photon_budget", q=-0.7),
    of("photon_budget", q=0.4),
    of("shutter_offset", offset=-4e-5),
    of("shutter_offset", offset=3e-5),
    of("spread_law", exponent=0.31),
    of("laser_drift", "linear", total=-0.4),
    of("laser_drift", "settling", total=0.3, rate=2.5),
]
PEDESTALS = [
    of("dark_offset", "light", level=17.0),
    of("background_gradient", "light", level=9.0, slope=13.0, direction=215.0),
    of("background_gradient", "light", level=30.0, slope=4.0, direction=-60.0),
]
GHOST = of("ghost_reflection", fraction=0.12, dx=31.0, dy=-17.0)
# 13 px at the longest exposure: 0.7 σ_g.
BLUR = of("motion_blur", speed=1.4e4, direction=62.0)
PROFILES = [of("super_gaussian", n=1.35), of("super_gaussian", n=0.6)]
# Effects that draw a number or a field.
SCATTERED = {
    "power_fluctuation": of("power_fluctuation", rms=0.12),
    "pointing_jitter": of("pointing_jitter", rms=1.5),
    "speckle": of("speckle", contrast=0.5, grain=1.5),
    "fixed_pattern": of("fixed_pattern", prnu=0.07, hot_pixels=3.0),
    "row_noise": of("row_noise", rms=3.0),
    "site_variation": of("site_variation", brightness=0.15, width=0.06),
    "interference_fringes": FRINGES[2],
}
SATURATION = [
    of("saturation", "sharp", level=380.0),
    of("saturation", "soft", level=380.0, knee=0.15),
    of("saturation", "power", level=380.0, knee=0.05),
    of("saturation", "sharp scattered", level=380.0, scatter=0.1),
    of("saturation", "sharp with noise", level=380.0),
    of("saturation", "soft with noise", level=380.0, knee=0.15),
    of("saturation", "power with noise", level=380.0, knee=0.05),
]
# Effects on the light, and all others that draw nothing.
LIGHT = [*LAWS, *ELLIPSES, *PROFILES, BLUR, *HALO, GHOST, *FRINGES, *PEDESTALS]
STEADY = [
    *(case for case in LIGHT if case.variant != "site"),
    of("dark_offset", "electronic", level=21.0),
    of("background_gradient", "electronic", level=9.0, slope=13.0, direction=215.0),
    *(case for case in SATURATION if case.variant != "sharp scattered"),
    of("nonlinearity", q=0.4),
    of("nonlinearity", q=-0.5),
    of("black_clipping", "subtracted", threshold=41.0),
    of("black_clipping", "dead zone", threshold=43.3),
    of("excess_read_noise", total=40.0),
    of("smear", fraction=0.3),
]


def title(case: Case) -> str:
    """Return a name for a test."""
    return "-".join([case.name, case.variant.replace(" ", "_"), *(f"{v:g}" for v in list(case.values.values())[:1])])
