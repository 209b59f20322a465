"""Where frames disagree with a model, in the words of those who measure beams."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.cells import BLOCK, LEVELS, PATCH, RADII
from spotcheck.old_engine.evidence.parts import Part, smallest_of
from spotcheck.old_engine.evidence.pixels import AZIMUTHS
from spotcheck.old_engine.evidence.windows import Window
from spotcheck.old_engine.observe.pixels import Frame, Model

# So many places are told at most.
MOST = 3
# Kinds of cells that lie somewhere on the sensor: of these one place is told.
SPOTS = ("block", "patch", "sector")


class Where(NamedTuple):
    """A place at which the frames disagree with the declared model most: in words, and its z."""

    words: str
    z: float


def places_of(parts: Sequence[Part]) -> tuple[Where, ...]:
    """The oddest places of those parts of a test that alone would speak against the model, one of each kind. What few
    cells tell comes before what many tell together."""
    out: dict[str, Where] = {}
    for part in sorted(parts, key=lambda own: -abs(own.statistic)):
        what, kind = part.name.split(", ")[0].split(": ")
        kind = kind if what in ("mean", "numbers") else what
        if part.where and smallest_of(part.p_value, len(parts)) < criteria.ALPHA.value:
            out.setdefault("" if kind in SPOTS else kind, Where(part.where, part.z))
    return tuple(out.values())[:MOST]


class Scene(NamedTuple):
    """What words for places need: the first row and column on the sensor, in steps of so many px; readings [DN] at the
    bounds between levels of light, light [e-] up to which they count, and each frame's exposure [s] and angle [deg]."""

    step: int
    corner: tuple[int, int]
    readings: np.ndarray
    brightest: float
    exposure_s: np.ndarray
    angle_deg: np.ndarray


def scene_of(frames: Sequence[Frame], model: Model) -> Scene:
    """The scene of some frames."""
    brightest, sensor = float(np.exp(np.max(model.numbers.log_peak))), model.sensor
    readings = sensor.black_level_dn + brightest * (np.arange(LEVELS + 1) / LEVELS) ** 2
    exposure, angle = (
        np.array([float(np.ravel(getattr(own.view, name))[0]) for own in frames]) for name in ("exposure_s", "angle")
    )
    return Scene(
        frames[0].step, Window(frames).corner, readings, brightest / sensor.gain_dn_per_e, exposure, np.rad2deg(angle)
    )


def cell_words(what: str, kind: str, label: tuple[int, int], frames: np.ndarray, scene: Scene) -> str:
    """A cell of some frames: where its mean or its `variance` is odd."""
    when, place = moment(frames, scene), place_of(kind, label, scene)
    if what == "variance":
        return f"the noise of {place or 'all readings'}{when}"
    return f"{place or 'the whole crop'}{when}"


def place_of(kind: str, label: tuple[int, int], scene: Scene) -> str:
    """Where a cell lies."""
    one, two = label
    if kind in ("block", "patch"):
        side = BLOCK if kind == "block" else PATCH
        row, column = (
            scene.step * (first + side * own + side // 2) for first, own in zip(scene.corner, label, strict=True)
        )
        return f"{scene.step * side} px about row {row}, column {column}"
    if kind in ("row", "column"):
        return f"{kind}s, most of all {kind} {scene.step * (scene.corner[kind == 'column'] + one)}"
    if kind == "level":
        low, high = (f"{own:,.{0 if own >= 10 else 1}f}" for own in scene.readings[one : one + 2])
        if one == 0:
            return f"grey levels below {high} DN"
        return f"grey levels above {low} DN" if one == LEVELS - 1 else f"grey levels of {low} to {high} DN"
    if kind == "sector":
        turn = f"at {(two + 0.5) * 360 / AZIMUTHS - 180:.0f}°"
        if one == 0:
            return f"within {RADII[0]:g} σ of the centre, {turn}"
        beyond = f"{RADII[one - 1]:g} to {RADII[one]:g} σ from" if one < len(RADII) else f"beyond {RADII[-1]:g} σ of"
        return f"{beyond} the centre, {turn}"
    return ""


def number_words(name: str, frames: np.ndarray, scene: Scene) -> str:
    """A number of a frame's, or of frames that share something."""
    return f"the spot's {name}{moment(frames, scene)}"


def moment(frames: np.ndarray, scene: Scene) -> str:
    """What some frames have in common that not all have; "" where there is nothing."""
    out = []
    exposures, own = np.unique(scene.exposure_s), np.unique(scene.exposure_s[frames])
    if len(own) == 1 < len(exposures):
        ends = {exposures[0]: "the shortest exposure", exposures[-1]: "the longest exposure"}
        out.append(ends.get(own[0], f"an exposure of {1e3 * own[0]:.3g} ms"))
    angles = np.unique(scene.angle_deg[frames])
    if len(angles) == 1 < len(np.unique(scene.angle_deg)):
        out.append(f"{angles[0]:.3g}°")
    alone = f" in frame {frames[0]}" if len(frames) == 1 < len(scene.exposure_s) else ""
    return alone + (f", at {' and '.join(out)}" if out else "")
