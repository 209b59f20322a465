"""An effect tried on a few points: what its function returns must be what its place asks for."""

import traceback
from collections.abc import Iterator
from typing import Any

import numpy as np

from spotcheck.old_engine.model.baseline import Baseline
from spotcheck.old_engine.model.chain import Free, Moments, View, moments
from spotcheck.old_engine.model.effect import Context, Effect, Place, Present
from spotcheck.old_engine.model.sensor import SensorModel

SENSOR = SensorModel(0.11, 13.0, black_level_dn=12.0, full_scale_dn=1023.0)
ROWS, COLUMNS = 10, 12
# Draws of what scatters, and how far [of the rms] mean and rms of so many may be off.
DRAWS, MEAN_OFF, RMS_OFF = 1000, 0.2, 0.3
# What scatters about which mean.
MEANS = {"gain": 1.0, "field": 1.0, "row": 0.0, "centre": 0.0}


def faults(effect: Effect, context: Context) -> Iterator[str]:
    """What is wrong with what an effect does, at each of its starts and where it should vanish."""
    bounds = effect.bounds(context)
    for start in effect.starts(context):
        values = np.array(start, float)
        if ((values < bounds[:, 0]) | (values > bounds[:, 1])).any():
            yield f"starts gives {tuple(start)}, outside the bounds of {', '.join(p.name for p in effect.parameters)}"
        for form in effect.forms:
            own = Present(effect, form, tuple(map(float, start)))
            yield from _of_draws(own) if effect.place is Place.SCATTER else _of_means(own)


def _of_means(own: Present) -> Iterator[str]:
    """Of an effect with a mean."""
    named = ", ".join(f"{name} = {value:g}" for name, value in own.named().items())
    try:
        then = _readings((own,))
    except Exception as error:
        yield f"function raises {_said(error)} at {named}; it must broadcast over views and points"
        return
    shape = (len(_view().x0), ROWS, COLUMNS)
    if any(np.shape(part) != shape for part in then):
        yield f"function returns an array that does not broadcast to views and points at {named}"
    elif not all(np.isfinite(part).all() for part in then):
        yield f"function returns what is not finite at {named}; it must return numbers"
    # What contains another effect leaves that when it vanishes itself.
    elif np.isfinite(own.effect.neutral) and not own.effect.contains:
        neutral = own._replace(values=(own.effect.neutral, *own.values[1:]))
        if not all(np.allclose(a, b, rtol=1e-6) for a, b in zip(_readings((neutral,)), _readings(()), strict=True)):
            yield f"neutral is {own.effect.neutral:g}, but with it the function still changes readings"


def _of_draws(own: Present) -> Iterator[str]:
    """Of an effect that scatters."""
    scatter, rng = own.effect.scatter, np.random.default_rng(1)
    assert scatter is not None
    before: tuple[Any, ...] = {"row": (DRAWS,), "field": ((ROWS * COLUMNS, COLUMNS),)}.get(scatter.of, ())
    shape = {"row": (DRAWS,), "field": (ROWS * COLUMNS, COLUMNS), "centre": (2,)}.get(scatter.of, ())
    try:
        drawn = [own.apply(*before, rng) for _ in range(1 if before else DRAWS)]
    except Exception as error:
        yield f"function raises {_said(error)}; it must draw a {scatter.of}"
        return
    if any(np.shape(one) != shape for one in drawn):
        yield f"function draws an array of shape {np.shape(drawn[0])} for a {scatter.of}; it must be {shape}"
        return
    values, rms = np.array(drawn, float), own.values[0]
    mean = MEANS[scatter.of]
    if not abs(values.mean() - mean) < MEAN_OFF * rms or not abs(values.std() - rms) < RMS_OFF * rms:
        yield (
            f"function draws a {scatter.of} of mean {values.mean():.3g} and rms {values.std():.3g} where"
            f" {own.effect.parameters[0].name} is {rms:g}; the mean must be {mean:g} and the rms that"
        )


def _readings(present: tuple[Present, ...]) -> Moments:
    base = Free(np.full((2, 1, 1), 640.0), np.full((2, 1, 1), 3.0))
    return moments(_view(), Baseline(0.0, "free", False, 2e-4), base, present, SENSOR)


def _view() -> View:
    """Two views of a small spot: other exposures, angles and places in the order of acquisition."""
    one = np.ones((2, 1, 1))
    two = np.array([0.0, 1.0])[:, None, None]
    return View(
        x=np.arange(float(COLUMNS))[None, None, :] * one,
        y=np.arange(float(ROWS))[None, :, None] * one,
        x0=5.3 * one,
        y0=4.6 * one,
        exposure_s=1e-4 * (1 + two),
        angle=np.pi / 2 * two,
        order=two,
        wave_cos=0 * one,
        wave_sin=0 * one,
        longest_s=2e-4,
        reference_s=2e-4,
        frame_x=COLUMNS / 2,
        frame_y=ROWS / 2,
        frame_rows=float(ROWS),
        rows_each=1.0,
    )


def _said(error: Exception) -> str:
    """An exception in one line, with the line of the user's file."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''} (line {where.lineno})"
