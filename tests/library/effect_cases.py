"""What the tests of effects share: contexts, cases, and the dataset contract's light, written out once more and slowly.

`slow_light` is the contract's chain at pixels, one stage a function, in a given order of stages: the library must agree
in the contract's order, and would not in another.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.cli.vocabulary import set_choice
from spotcheck.model import chain
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.effect import Context, Present
from spotcheck.model.effects import Choice, vocabulary
from spotcheck.model.sensor import SensorModel


@contextmanager
def knowing(*files: Path, only: Sequence[str] = (), without: Sequence[str] = ()) -> Iterator[None]:
    """The vocabulary of a run that adds files and leaves effects out, until the end of a block."""
    set_choice(Choice(tuple(map(str, files)), tuple(only), tuple(without)))
    try:
        yield
    finally:
        set_choice(Choice())


def written(folder: Path, name: str, text: str) -> Path:
    """A Python file with that text."""
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    return path


CONTEXTS = {
    "the paper's": Context(18.4, 640.0, 1023.0, 240.0, 1e-4, 13.0, 0.11, 0.17, 9e-4),
    "small and faint": Context(2.5, 12.0, 255.0, 40.0, 1e-6, 0.0, 2.0, -0.3, 5e-6),
    "16 bit": Context(45.0, 6e4, 65535.0, 512.0, 3.0, 2.0, 1.2, 0.0, 9.0),
}

P1, P2, PEAK, LASER = 2.48, 34.55, 640.0, 1.19
LONGEST = 9e-4
EXPOSURES = (1e-4, 3e-4, 9e-4)
REFERENCE = float(np.exp(np.mean(np.log(EXPOSURES))))
# With a black level, so that the converter's zero cuts nothing but what an effect brings there.
SENSOR = SensorModel(0.11, 13.0, 70.0, np.inf, 40.0, 1023.0)


class Case(NamedTuple):
    """An effect as a test sets it: name, form, parameters by name."""

    name: str
    form: str
    values: dict[str, float]

    def present(self) -> Present:
        """As the library takes it; what the form lacks is NaN, so that nothing may depend on it."""
        effect = vocabulary()[self.name]
        assert set(self.values) >= {p.name for p in effect.parameters} - set(effect.idle.get(self.form, ()))
        return Present(effect, self.form, tuple(float(self.values.get(p.name, np.nan)) for p in effect.parameters))


def of(name: str, form: str = "", **values: float) -> Case:
    """One effect at work."""
    return Case(name, form or vocabulary()[name].forms[0], values)


def present(cases) -> list[Present]:
    """Effects as the library takes them."""
    return [case.present() for case in cases]


def some_views() -> View:
    """Six frames of 48 × 44 pixels, every second of a crop that lies at (100, 60) on a sensor of 420 × 300."""
    views = [(a, t) for a in (0.0, 50.0) for t in EXPOSURES]
    column = [np.array(v, float)[:, None, None] for v in (range(6), *zip(*views, strict=True))]
    k, angle, exposure = column
    return View(
        x=(100.0 + 2 * np.arange(48))[None, None, :],
        y=(60.0 + 2 * np.arange(44))[None, :, None],
        x0=147.3 + 1.7 * k,
        y0=104.6 - 0.9 * k,
        exposure_s=exposure,
        angle=np.deg2rad(angle),
        order=k / 5,
        wave_cos=0.05 + 0.01 * k,
        wave_sin=-0.03 * k,
        longest_s=LONGEST,
        reference_s=REFERENCE,
        frame_x=209.5,
        frame_y=149.5,
        frame_rows=300.0,
        rows_each=2.0,
    )


VIEW = some_views()


# The contract's light, slowly. A stage gets the light so far, a function of (x, y), and returns what it becomes.


class Frame(NamedTuple):
    """One frame of the slow chain: its numbers, and every effect's parameters and form."""

    x0: float
    y0: float
    exposure_s: float
    angle_deg: float
    order: float
    wave: tuple[float, float]
    amplitude: float
    sigma: float
    top_hat: bool
    own: dict[str, dict[str, float]]
    form: dict[str, str]


def course(order: float, form: str, own: dict[str, float]) -> float:
    """How far a drift has run at a place in the order of acquisition: steadily, or as what warms up."""
    if form == "linear":
        return order
    return (1 - np.exp(-own["rate"] * order)) / (1 - np.exp(-own["rate"]))


def slow_frame(view: View, k: int, cases, budget: str, top_hat: bool) -> Frame:
    """Width and peak of frame `k`: σ_g = p_b + laser, peak ∝ (p_b/σ_g)² or t/σ_g², each law as it is written."""
    own, form = {c.name: c.values for c in cases}, {c.name: c.form for c in cases}

    def spread(t):
        if "spread_law" in own:
            return (P1 * np.log(REFERENCE) + P2) * (t / REFERENCE) ** own["spread_law"]["exponent"]
        return P1 * np.log(t) + P2

    def law(t):
        return (spread(t) / (spread(t) + LASER)) ** 2 if budget == "spot_area" else t / (spread(t) + LASER) ** 2

    nominal, angle, order = (float(v[k, 0, 0]) for v in (view.exposure_s, view.angle, view.order))
    true = nominal + own.get("shutter_offset", {"offset": 0.0})["offset"]
    amplitude = PEAK * law(true) / law(LONGEST)
    if "photon_budget" in own:
        amplitude *= (nominal / LONGEST) ** own["photon_budget"]["q"]
    if "angle_reflectance" in own:
        d, gamma0 = own["angle_reflectance"]["d"], np.deg2rad(own["angle_reflectance"]["gamma0"])
        amplitude *= 1 + d * np.cos(2 * (angle - gamma0))
    if "laser_drift" in own:
        amplitude *= 1 + own["laser_drift"]["total"] * course(order, form["laser_drift"], own["laser_drift"])
    x0, y0, a, b = (float(v[k, 0, 0]) for v in (view.x0, view.y0, view.wave_cos, view.wave_sin))
    sigma = spread(true) + LASER
    return Frame(x0, y0, nominal, np.rad2deg(angle), order, (a, b), amplitude, sigma, top_hat, own, form)


def shape(light, f: Frame):
    """An ellipse by its covariance matrix, of area 2πσ²; exp(−(ρ²/2)^n)."""
    ratio, axis = 1.0, 0.0
    if "beam_ellipticity" in f.own:
        ratio, axis = f.own["beam_ellipticity"]["ratio"], f.own["beam_ellipticity"]["direction"]
    if "fibre_anisotropy" in f.own:
        sense = 1 if f.form["fibre_anisotropy"] == "same sense" else -1
        ratio, axis = f.own["fibre_anisotropy"]["ratio"], sense * f.angle_deg + f.own["fibre_anisotropy"]["zero"]
    along = np.array([np.cos(np.deg2rad(axis)), np.sin(np.deg2rad(axis))])
    across = np.array([-along[1], along[0]])
    covariance = f.sigma**2 * (ratio * np.outer(along, along) + np.outer(across, across) / ratio)
    (a, b), (_, c) = np.linalg.inv(covariance)
    n = f.own.get("super_gaussian", {"n": 1.0})["n"]

    def out(x, y):
        dx, dy = x - f.x0, y - f.y0
        return f.amplitude * np.exp(-(((a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2) ** n))

    return out


def top_hat(light, f: Frame):
    """Light above exp(−1/4) of A is cut to it."""
    return (lambda x, y: np.minimum(light(x, y), np.exp(-0.25) * f.amplitude)) if f.top_hat else light


def blur(light, f: Frame, steps: int = 300):
    """The mean over a path of length speed · t about the spot, by the midpoint rule."""
    if "motion_blur" not in f.own:
        return light
    length = f.own["motion_blur"]["speed"] * f.exposure_s
    direction = np.deg2rad(f.own["motion_blur"]["direction"])
    path = length * ((np.arange(steps) + 0.5) / steps - 0.5)
    return lambda x, y: sum(light(x - s * np.cos(direction), y - s * np.sin(direction)) for s in path) / steps


def added(light, f: Frame):
    """A halo of peak `fraction` A, and a displaced copy of the spot."""

    def out(x, y):
        total = light(x, y)
        if "scatter_halo" in f.own:
            p, form = f.own["scatter_halo"], f.form["scatter_halo"]
            r = np.hypot(x - f.x0, y - f.y0) / p["radius"]
            profile = {"exponential": np.exp(-r), "gaussian": np.exp(-r * r / 2)}
            total = total + p["fraction"] * f.amplitude * profile.get(form, (1 + r * r) ** -p["tail"])
        if "ghost_reflection" in f.own:
            p = f.own["ghost_reflection"]
            total = total + p["fraction"] * light(x - p["dx"], y - p["dy"])
        return total

    return out


def fringes(light, f: Frame):
    """1 + d cos(2πu/period + φ), u across the stripes."""
    if "interference_fringes" not in f.own:
        return light
    p, form = f.own["interference_fringes"], f.form["interference_fringes"]
    d, phase = p["d"], np.deg2rad(p["phase"])
    if form == "site":
        # a cos + b sin is one wave of its own strength and phase.
        d, phase = np.hypot(*f.wave), -np.arctan2(f.wave[1], f.wave[0])
    x0, y0 = (0.0, 0.0) if form == "sensor" else (f.x0, f.y0)
    direction = np.deg2rad(p["direction"])

    def out(x, y):
        u = (x - x0) * np.cos(direction) + (y - y0) * np.sin(direction)
        return light(x, y) * (1 + d * np.cos(2 * np.pi * u / p["period"] + phase))

    return out


def pedestals(light, f: Frame):
    """Ambient light, uniform or rising from the frame's centre, never below 0."""

    def out(x, y):
        total = light(x, y) + 0 * x
        if f.form.get("dark_offset") == "light":
            total = total + f.own["dark_offset"]["level"]
        if f.form.get("background_gradient") == "light":
            total = total + gradient(x, y, f.own["background_gradient"])
        return total

    return out


def gradient(x, y, p):
    """The pedestal of a gradient [DN]."""
    uphill = np.deg2rad(p["direction"])
    distance = (x - 209.5) * np.cos(uphill) + (y - 149.5) * np.sin(uphill)
    plane = p["level"] + p["slope"] * distance / 100
    return np.where(plane > 0, plane, 0.0)


STAGES = (shape, top_hat, blur, added, fringes, pedestals)


def slow_light(cases, budget="linear", cut=False, stages=STAGES, view=VIEW) -> np.ndarray:
    """Light [DN] of all views, pedestals of light included."""
    x, y = np.broadcast_arrays(view.x[0], view.y[0])
    out = []
    for k in range(len(view.x0)):
        frame, light = slow_frame(view, k, cases, budget, cut), None
        for stage in stages:
            light = stage(light, frame)
        out.append(light(x, y))
    return np.array(out)


def fast_light(cases, budget="linear", cut=False, view=VIEW) -> np.ndarray:
    """The library's."""
    own, beside = chain.light(view, Baseline(LASER, budget, cut, LONGEST), Law(P1, P2, PEAK), present(cases))
    return own + beside + np.zeros((len(view.x0), view.y.size, view.x.size))


HALO = [
    of("scatter_halo", "exponential", fraction=0.04, radius=31.0, tail=1.5),
    of("scatter_halo", "gaussian", fraction=0.1, radius=45.0, tail=1.5),
    of("scatter_halo", "power", fraction=0.07, radius=22.0, tail=1.3),
]
FRINGES = [
    of("interference_fringes", "spot", d=0.2, period=9.3, direction=33.0, phase=70.0),
    of("interference_fringes", "sensor", d=0.6, period=21.0, direction=-118.0, phase=10.0),
    of("interference_fringes", "site", d=0.2, period=14.2, direction=80.0, phase=70.0),
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
    of("laser_drift", total=-0.4),
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
SINGLE = [*LAWS, *ELLIPSES, *PROFILES, BLUR, *HALO, GHOST, *FRINGES, *PEDESTALS]


def title(case: Case) -> str:
    """For the names of tests."""
    return "-".join([case.name, case.form.replace(" ", "_"), *(f"{v:g}" for v in list(case.values.values())[:1])])


def all_moments(cases, sensor=SENSOR, view=VIEW, base=None, brightness=1.0):
    """Moments of every view under the linear budget."""
    own = Law(P1, P2, PEAK) if base is None else base
    return chain.moments(view, Baseline(LASER, "linear", False, LONGEST), own, present(cases), sensor, brightness)


def free(amplitude: float, sigma: float, **changes) -> tuple[View, Free]:
    """One view of 240 × 240 px with the spot at (120.4, 119.7), and a base without a law."""
    one = np.ones((1, 1, 1))
    view = VIEW._replace(
        x=np.arange(240.0)[None, None, :],
        y=np.arange(240.0)[None, :, None],
        x0=120.4 * one,
        y0=119.7 * one,
        exposure_s=1e-3 * one,
        angle=0.5 * one,
        order=0.25 * one,
        wave_cos=0 * one,
        wave_sin=0 * one,
        longest_s=1e-3,
        frame_x=119.5,
        frame_y=119.5,
        frame_rows=240.0,
        rows_each=1.0,
    )
    return view._replace(**changes), Free(amplitude * one, sigma * one)


PLAIN = Baseline(LASER, "free", False, 1e-3)
