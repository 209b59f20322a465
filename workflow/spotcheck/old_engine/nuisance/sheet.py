"""The data sheet's errors: gain, read noise and black level as numbers that a fit may move, as far as the sheet's own
errors let it, and by how much frames contradict the sheet."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.nuisance.darkness import darkness
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.parameters import (
    SENSOR,
    SENSOR_NUMBERS,
    changes_of,
    nudged_of,
    values_of,
    values_of_sensor,
)
from spotcheck.old_engine.nuisance.taken import lacking, variances_of
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, told


class Against(NamedTuple):
    """Of one number of the sheet: its name; what is stated, with its error; what frames and sheet together say, with
    the error of that; by how many stated errors it moved; and that in the errors that it would have if the sheet were
    right (a standard normal number then)."""

    name: str
    stated: float
    stated_stderr: float
    value: float
    stderr: float
    stated_errors: float
    z: float


def fit_sheet(frames: Sequence[Frame], fitted: Fitted) -> Fitted:
    """Fit on with the numbers of the sheet told beside what the shape takes.

    The shape takes noise up, one variance for each coefficient that the readings tell. Likelihood takes that for less
    noise; restricted likelihood (REML, Patterson & Thompson 1971) gives it back.
    """
    first = fit(frames, fitted.model, fitted.penalty, fitted.free)
    return fit(frames, first.model, first.penalty, first.free, tilt=tilt_of(frames, first))


def tilt_of(frames: Sequence[Frame], fitted: Fitted) -> np.ndarray:
    """What the score of each free parameter lacks for what the shape takes up of the noise."""
    ready = Expectation(frames, fitted.model)
    nudged = nudged_of(frames, ready, fitted.free)
    variances = variances_of(fitted)
    out, peaks = np.zeros(len(fitted.free)), np.exp(fitted.model.numbers.log_peak)
    for k, frame in enumerate(frames):
        seen = ready.of(frame, k)
        lacks = lacking(variances[k], float(peaks[k]), seen, told(frame, seen))
        out += [np.vdot(lacks, change[1]) for change in changes_of(frame, k, seen, nudged)]
    return out


def against_sheet(fitted: Fitted) -> tuple[Against, ...]:
    """By how much a fit moved the numbers of the sheet."""
    errors = np.sqrt(np.diag(fitted.covariance)[len(fitted.schur.left) - len(fitted.free) :])
    told = zip(fitted.free, values_of(fitted.model, fitted.free), errors, strict=True)
    return tuple(_against(own.parameter, own.centre, own.precision**-0.5, float(value), float(error))
                 for own, value, error in told if own.effect == SENSOR)  # fmt: skip


def against_dark(frames: Sequence[Frame], model: Model) -> tuple[Against, ...]:
    """By how much dark pixels move the numbers of the sheet that they alone tell."""
    dark, stated = darkness(frames, model), model.stated
    if dark is None:
        return ()
    told = {1: (dark.read_noise_e, dark.read_noise_stderr), 2: (dark.black_level_dn, dark.black_level_stderr)}
    values, out = values_of_sensor(stated.sensor), []
    for p, (value, error) in told.items():
        if stated.stderr[p] > 0 and np.isfinite(error):
            part = stated.stderr[p] ** 2 / (stated.stderr[p] ** 2 + error**2)
            both = values[p] + part * (value - values[p])
            out.append(_against(p, values[p], stated.stderr[p], both, error * part**0.5))
    return tuple(out)


def _against(number: int, stated: float, stated_stderr: float, value: float, error: float) -> Against:
    # Sheet and frames are independent: a moved value has the variance that the sheet's loses by the frames.
    scatter = np.sqrt(max(stated_stderr**2 - error**2, 1e-12 * stated_stderr**2))
    moved = value - stated
    name = SENSOR_NUMBERS[number]
    return Against(name, stated, stated_stderr, value, error, moved / stated_stderr, float(moved / scatter))
