"""A small set of frames with a known disagreement, and a judgement of it put together by hand, without any search."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spotcheck.dataset import Dataset, load
from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import Detection
from spotcheck.discrepancy.explain import Account, account
from spotcheck.discrepancy.extend import Findings, Size, Tolerance
from spotcheck.discrepancy.look import Look, look_again, look_at
from spotcheck.discrepancy.shots import Shot, design_of
from spotcheck.discrepancy.verdict import Judgement, verdict_json
from spotcheck.discrepancy.verify import Gap
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Law
from spotcheck.model.effect import Present
from spotcheck.model.effects import vocabulary
from spotcheck.model.sensor import SensorModel
from tests.library.conftest import folder
from tests.reference.numpy_chain import draw

SIDE = 60
SENSOR = SensorModel(0.11, 6.0, 0.0, np.inf, 12.0, 1023.0)
ANGLES, EXPOSURES, REPEATS = (0.0, 45.0), (1e-4, 4e-4), 3
LAW = Law(1.2, 18.0, 600.0)
# x, y [px] from the spot's centre, angle [deg], exposure [s], sigma [px], spot [DN] → light [DN].
Light = Callable[..., np.ndarray]


def plain(dx, dy, angle, exposure, sigma, spot):
    """The base model's own spot."""
    return spot


def ghost(dx, dy, angle, exposure, sigma, spot):
    """With a copy, 6 % as bright, 12 px to the right and 5 px up."""
    peak = np.max(spot)
    return spot + 0.06 * peak * np.exp(-((dx - 12) ** 2 + (dy + 5) ** 2) / (2 * sigma**2))


def bump(dx, dy, angle, exposure, sigma, spot):
    """With a round ring of light from 1.6 to 1.9 widths, at 45° and the longer exposure alone."""
    radius = np.hypot(dx, dy) / sigma
    own = angle == 45 and exposure == EXPOSURES[-1]
    return spot + 8.0 * own * ((radius > 1.6) & (radius < 1.9))


def frames(
    light: Light = plain,
    angles: Sequence[float | None] = ANGLES,
    exposures: Sequence[float | None] = EXPOSURES,
    repeats: int = REPEATS,
    after: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None,
    seed: int = 4,
    sensor: SensorModel = SENSOR,
    rows_dn: float = 0.0,
) -> tuple[list[Shot], Base, Setting]:
    """Random frames with their true base; `after` alters the readings [DN] of a frame, `rows_dn` is the rms of rows'
    offsets."""  # fmt: skip
    rng = np.random.default_rng(seed)
    known = [t for t in exposures if t is not None]
    baseline = Baseline(0.0, "linear" if known else "free", False, max(known, default=1.0))
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    shots, rows = [], []
    for angle in angles:
        for repeat in range(repeats):
            x0, y0 = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            for exposure in exposures:
                t = baseline.longest_s if exposure is None else exposure
                sigma = float(LAW.p1 * np.log(t) + LAW.p2) if known else 7.0
                peak = LAW.peak * float(baseline.relative_peak(t, LAW.p1, LAW.p2)) if known else LAW.peak
                spot = peak * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))
                own = sensor
                if rows_dn:
                    offset = rows_dn * rng.standard_normal((SIDE, 1))
                    own = sensor._replace(black_level_dn=sensor.black_level_dn + offset)
                image = draw(light(x - x0, y - y0, angle, exposure, sigma, spot), t, own, rng).astype(float)
                image = after(image, rng) if after else image
                shots.append(Shot(angle, exposure, repeat, len(shots), (), 0, 0, lambda image=image: image))
                rows.append((peak, sigma, x0, y0))
    base = Base(*np.array(rows).T, LAW if known else None)
    return shots, base, Setting(baseline, sensor, float(SIDE), ((SIDE - 1) / 2, (SIDE - 1) / 2))


def looked(*arguments: Any, **options: Any) -> tuple[Look, Account]:
    """The first look at `frames(…)` and what the base model makes of it."""
    shots, base, setting = frames(*arguments, **options)
    look = look_at(shots, design_of(shots), base, setting)
    return look, account(look, ())


def present(name: str, *values: float, form: str | None = None) -> Present:
    """An effect of the vocabulary with values."""
    effect = vocabulary()[name]
    return Present(effect, effect.forms[0] if form is None else form, values)


def judgement(
    status: str, light: Light = ghost, *effects: Present, p_value: float = 1 / 301, **options: Any
) -> Judgement:
    """A judgement of `frames(light, …)` with a status and effects given from outside; their values are fitted."""
    shots, base, setting = frames(light, **options)
    look = look_at(shots, design_of(shots), base, setting)
    first = account(look, ())
    names = [p.effect.name for p in effects]
    explanations, best = [], None
    evidence = {
        name: (-5.0, first.refit.chi2 - 2.0) for name in ("super_gaussian", "motion_blur") if status != "consistent"
    }
    if effects:
        own = account(look, effects)
        explanations = [own]
        near = look_again(shots, look, own.refit.model, own.latent)
        best = near, account(near, effects, own.refit.model)
        for name in names:
            alone = account(look, [p for p in effects if p.effect.name == name])
            evidence[name] = (alone.score - first.score, alone.refit.chi2)
    seen = Detection(p_value, 300, 9.0, {})
    gap = None
    if effects:
        maps = {"before": first.refit.residual, "after": explanations[0].refit.residual}
        gap = Gap(9.0, 1.1, 0.99, 0.986, 3.0, 0.1, "left-out repeats", (0.986,) + (0.0,) * (len(effects) - 1), maps)
    found = Findings(
        look=look,
        base=first,
        detection=seen,
        size=Size(0.006, 0.1, 0.001),
        explanations=explanations,
        best=best,
        rest=Detection(0.4 if status != "unknown" else p_value, 300, 1.0, {}),
        rest_size=Size(0.0, 0.0, 0.0),
        singles={},
        not_assessed={"angle_reflectance": "fewer than three fibre angles"},
        status=status,
        evidence=evidence,
    )
    return Judgement(found, gap, [], "")


def nothing(why: str = "there is no usable spot frame") -> Judgement:
    """Nothing could be tested."""
    return Judgement(None, None, [], why)


def verdict_of(own: Judgement, name: str = "small") -> dict[str, Any]:
    """Its verdict, without table and sentence."""
    return verdict_json(own, name, Tolerance())


def dataset(base: Path, angles=ANGLES, exposures=EXPOSURES, repeats: int = REPEATS, more: str = "") -> Dataset:
    """The dataset folder that such frames would lie in."""
    blank = lambda value: "" if value is None else value  # noqa: E731
    cells = [(a, t, r) for a in angles for r in range(repeats) for t in exposures]
    rows = [f"frames/f{k}.tif,spot,{blank(a)},{blank(t)},{r}" for k, (a, t, r) in enumerate(cells)]
    return load(folder(base, rows, f"{{name: small, crop_px: {SIDE}{more}}}"))
