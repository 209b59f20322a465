"""Frames with their views, and every frame's brightness, width and centre to begin with."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.estimate.spotfit import fit_spots
from spotcheck.old_engine import criteria
from spotcheck.old_engine.boundary import new_sensor
from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, View, bounds_context
from spotcheck.old_engine.model.effect import Context
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Around, Frame, Numbers
from spotcheck.old_engine.observe.shots import Shot, design_of

# From this part of readings at full scale on it is the clip that keeps a likelihood from its root.
CLIPPED = 0.01
# The first start of a level lies at this part of the peak: it is to be the brightest reading itself.
TOP = 0.97
# The brightest readings, beyond which some odd pixel may lie.
ODD = 20
# Of frames with more pixels than this together [px] every second, third, … row and column is looked at, as long as the
# narrowest spot keeps so many of them [1/σ].
MOST_PIXELS, SAMPLES = 5e5, 16


class Setting(NamedTuple):
    """What the instrument fixes: the declared baseline, the sensor with the standard errors of its gain [DN/e-], read
    noise [e-] and black level [DN], rows and columns of a frame, and which of the three were known beforehand, by name:
    others come from the very frames, which cannot contradict them."""

    baseline: Baseline
    sensor: SensorModel
    stderr: tuple[float, float, float]
    rows: int
    columns: int
    beforehand: tuple[str, ...] = ("gain_dn_per_e", "read_noise_e", "black_level_dn")


class Observed(NamedTuple):
    """Frames with their design, where each spot's fit begins, and what bounds and starts of effects depend on."""

    frames: list[Frame]
    design: Design
    numbers: Numbers
    context: Context


def observed(shots: Sequence[Shot], setting: Setting) -> Observed | str:
    """Frames ready to be searched, of many pixels some; or why there are none."""
    every = whole(shots, setting)
    if isinstance(every, str):
        return every
    step = step_of(every.frames, every.numbers)
    return every._replace(frames=[thinned(own, step) for own in every.frames])


def whole(shots: Sequence[Shot], setting: Setting) -> Observed | str:
    """Frames with all their pixels, ready to be fitted, or why there are none."""
    design = design_of(shots)
    longest = float(design.exposures.max(initial=0.0)) or 1.0
    frames = []
    for k, shot in enumerate(shots):
        pixels = np.asarray(shot.pixels(), float)
        rows, columns = pixels.shape
        one = np.ones((1, 1, 1))
        exposure = design.exposure_s[k] if np.isfinite(design.exposure_s[k]) else longest
        angle = np.deg2rad(design.angle_deg[k] if np.isfinite(design.angle_deg[k]) else 0.0)
        view = View(
            x=(shot.left + np.arange(float(columns)))[None, None, :],
            y=(shot.top + np.arange(float(rows)))[None, :, None],
            x0=0 * one, y0=0 * one, exposure_s=exposure * one, angle=angle * one, order=design.order[k] * one,
            wave_cos=0 * one, wave_sin=0 * one, longest_s=longest, reference_s=design.reference_s,
            frame_x=(setting.columns - 1) / 2, frame_y=(setting.rows - 1) / 2, frame_rows=float(setting.rows),
            rows_each=1.0,
        )  # fmt: skip
        frames.append(Frame(pixels, view, around(shot)))
    numbers = first_numbers(frames, design, setting)
    if isinstance(numbers, str):
        return numbers
    return Observed(frames, design, numbers, context_of(frames, design, numbers, setting))


def step_of(frames: Sequence[Frame], numbers: Numbers) -> int:
    """Of how many rows and columns of the sensor one is enough: a light that is so wide is alike in neighbours.

    # ASSUME: nothing that repeats within two such steps is in the frames; a finer stripe would pass for a coarser.
    """
    wanted = np.ceil(np.sqrt(sum(own.pixels.size for own in frames) / MOST_PIXELS))
    return int(max(min(wanted, np.exp(numbers.log_width.min()) // SAMPLES), 1))


def thinned(frame: Frame, step: int) -> Frame:
    """A frame with one of so many rows and columns, those whose number on the sensor they divide."""
    if step == 1:
        return frame
    rows, columns = (slice(-int(axis.min()) % step, None, step) for axis in (frame.view.y, frame.view.x))
    view = frame.view._replace(x=frame.view.x[..., columns], y=frame.view.y[:, rows], rows_each=float(step))
    return frame._replace(pixels=np.ascontiguousarray(frame.pixels[rows, columns]), view=view)


def around(shot: Shot) -> Around | None:
    """Blocks of the whole frame of a shot."""
    if shot.beside is None:
        return None
    blocks = shot.beside()
    row, column = np.nonzero(np.isfinite(blocks.mean))
    middle = (np.stack([column, row]) + 0.5) * blocks.side - 0.5
    return Around(middle[0], middle[1], blocks.mean[row, column], blocks.side**2)


def round_spot(pixels: np.ndarray, sensor: SensorModel, baseline: Baseline) -> np.ndarray:
    """Peak [DN], centre x, y [px] and σ_g [px] of a round spot; NaN where there is no fit.

    By the sensor's law, or by least squares where that has no root though hardly a reading is at full scale: noise may
    be far above the data sheet's.
    """
    ways = ("likelihood", "equal") if np.mean(pixels >= sensor.full_scale_dn) < CLIPPED else ("likelihood",)
    fits = (
        fit_spots(
            pixels[None],
            new_sensor(sensor),
            weighting=way,
            top_hat=baseline.top_hat,
            integrated=baseline.pixel_integration,
            circular=True,
        )
        for way in ways
    )
    fit = next((fit for fit in fits if fit.flags[0] == 0), None)
    return np.full(4, np.nan) if fit is None else fit.value[0, :4]


def first_numbers(frames: Sequence[Frame], design: Design, setting: Setting) -> Numbers | str:
    """A round spot for every frame, each fitted alone. A frame without a fit takes what its condition, or else all,
    have."""
    found = np.full((len(frames), 4), np.nan)
    for k, frame in enumerate(frames):
        found[k] = round_spot(frame.pixels, setting.sensor, setting.baseline)
    side = np.array([frame.pixels.shape for frame in frames], float)
    known = np.isfinite(found).all(axis=1) & (found[:, 3] < criteria.WIDEST.value * side.min(axis=1))
    known &= (np.abs(found[:, [2, 1]] - side / 2) < side / 2).all(axis=1)
    if not known.any():
        wide = bool((found[:, 3] >= criteria.WIDEST.value * side.min(axis=1)).any())
        return "no spot could be fitted in any frame" + (": it is as wide as its crop" if wide else "")
    for k in map(int, np.flatnonzero(~known)):
        like = known & (design.condition == design.condition[k])
        like = like if like.any() else known
        found[k, [0, 3]] = np.median(found[like][:, [0, 3]], axis=0)
        same = known & (design.site == design.site[k])
        found[k, 1:3] = np.median(found[same][:, 1:3], axis=0) if same.any() else side[k, ::-1] / 2 - 0.5
    left, top = (np.array([float(axis.min()) for axis in own]) for own in
                 ([f.view.x for f in frames], [f.view.y for f in frames]))  # fmt: skip
    peak = np.maximum(found[:, 0], 1e-3)
    return Numbers(np.log(peak), np.log(found[:, 3]), found[:, 1] + left, found[:, 2] + top)


def context_of(frames: Sequence[Frame], design: Design, numbers: Numbers, setting: Setting) -> Context:
    """What bounds and starts depend on: the brightest light is that of the brightest readings."""
    exposures = design.exposures
    shortest, longest = float(exposures.min(initial=np.inf)), float(exposures.max(initial=0.0)) or 1.0
    base = Free(np.exp(numbers.log_peak), np.exp(numbers.log_width))
    own = bounds_context(base, setting.baseline, setting.sensor, float(frames[0].pixels.shape[0]),
                         min(shortest, longest), longest, design.reference_s)  # fmt: skip
    top = max(float(np.sort(f.pixels[np.isfinite(f.pixels)])[-ODD:][0]) for f in frames)
    return own._replace(peak_dn=max(top - setting.sensor.black_level_dn, 1.0) / TOP)
