"""Levels of flats above their darks, and the values that a forward model predicts for them.

A level is a set of flats of the same light. Its data are the mean [DN] and the variance in time [DN²] of a reading,
both less those of darks of the same exposure. For the forward model of spots, a level is a frame with a spot of endless
width, and a dark is a frame without light. K is the gain [DN/e-], R the light of the lamp at the largest level [DN].
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from spotcheck.characterization.levels import measure_light
from spotcheck.characterization.photon_transfer import Transfer
from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, PixelGrid
from spotcheck.model.effect import EffectScales, Need
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw, Light
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Width [px] of a spot that is even over any sensor.
ENDLESS_PX = 1e9
# Largest part of the pixels of a level that may read full scale. At brighter levels, unevenness of the light would
# decide how many pixels are clipped.
MOST_CLIPPED = 1e-3
# One level of every three is held out; datasets with fewer than six levels are not assessed.
HELD_OUT_EVERY, FEWEST_LEVELS = 3, 6
# Largest relative scatter of light/exposure of a steady lamp, whose light is proportional to the exposure.
STEADY = 0.02
# Least dark noise [e-] and least error of a mean [DN]; least errors of the mean [DN] and of the variance (relative) of
# a dark reading.
LEAST_NOISE_E, LEAST_MEAN_ERROR, LEAST_DARK_ERRORS = 0.1, 1e-6, (0.01, 0.01)
# Standard error of the black level, in parts of the dark noise: an effect that curves the response about 0 shifts the
# mean dark reading by a part of the noise. Difference from the darks [standard errors] that needs no adjustment.
BLACK_LEVEL_SHARE, NO_MISFIT = 0.1, 1e-3
# Largest reading [DN] of a camera whose full scale is unknown (infinite).
LARGEST_READING_DN = 65535.0
# Least read noise [e-] in the match of a model to the darks, and least scale of its parameters.
POSITIVE_NOISE_E, LEAST_SCALE = 1e-9, 1e-2


@dataclass(frozen=True)
class FlatLevels:
    """Levels in the order of their light, and the declared model of them."""

    frames: int  # number of frames of all levels
    light: np.ndarray  # light of each level, relative to the largest one [level]
    values: np.ndarray  # mean [DN] and variance [DN²] of readings less those of darks [2, level]
    errors: np.ndarray  # standard errors of the values [2, level]
    is_held_out: np.ndarray  # whether a level is kept for validation and takes no part in fits [level]
    conditions: FrameConditions  # conditions of the levels; arrays [level, 1, 1]
    dark: np.ndarray  # mean [DN] and variance [DN²] of a dark reading [2]
    dark_errors: np.ndarray  # standard errors of these [2]
    declared: ForwardModel  # linear sensor with R and K from the straight line, and black level and noise of the darks
    black_level_error: float  # standard error within which the black level of another model may differ [DN]
    scales: EffectScales  # sizes of the dataset, from which effects derive bounds and starting values
    needs_met: frozenset[Need]  # needs of effects that the levels meet


@dataclass(frozen=True)
class ExpectedLevels:
    """Values that a model predicts for the levels."""

    values: np.ndarray  # mean [DN] and variance [DN²] of readings less those of darks [2, level]
    light_slopes: np.ndarray  # derivatives of mean [1] and variance [DN] by the light of the lamp [2, level]
    lamp_dn: np.ndarray  # light of the lamp [level, DN]
    # Differences in standard errors [3]: mean and variance of a dark reading less the measured ones, and black level
    # less the declared one.
    dark_misfit: np.ndarray


# Data


def collect_levels(transfer: Transfer, full_scale_dn: float) -> FlatLevels | None:
    """Return the levels that can be assessed; None if they are too few or all of the same light, or if K is unknown.

    Parameters
    ----------
    transfer : Transfer
        Levels of flats (`flats`), and mean `signal` [DN] and variance `excess` [DN²] of each less those of darks.
        `quantities` has the results of a straight line by name, such as the gain.
    full_scale_dn : float
        Largest reading [DN].
    """
    if np.isnan(transfer.quantities["gain"].value):
        return None
    light = measure_light(transfer.flats)
    clipped = np.array([level.at_full for level in transfer.flats])
    usable = np.flatnonzero((clipped <= MOST_CLIPPED) & (transfer.signal > 0) & (light > 0))
    usable = usable[np.argsort(light[usable], kind="stable")]
    light, flats = light[usable], [transfer.flats[k] for k in usable]
    if len(usable) < FEWEST_LEVELS or not np.isfinite(light).all() or np.ptp(light) == 0:
        return None
    exposure_s = np.array([level.exposure_s for level in flats])
    rate = light / exposure_s
    is_steady = bool(np.isfinite(exposure_s).all()) and float(np.std(rate) / np.mean(rate)) < STEADY
    longest_s = float(exposure_s.max()) if is_steady else 1.0
    values = np.stack([transfer.signal[usable], transfer.excess[usable]])
    mean_errors = np.maximum([level.mean_error for level in flats], LEAST_MEAN_ERROR)
    position, origin = np.arange(len(usable)), np.zeros((len(usable), 1, 1))
    relative_light = light / light.max()
    # Without a steady lamp, the exposure stands for the light.
    exposure_s = (relative_light * longest_s)[:, None, None]
    # One pixel at the centre of the endless spot of each level.
    conditions = FrameConditions(PixelGrid(origin, origin, 1, 1), origin, origin, exposure_s, longest_s, longest_s)
    declared, dark, dark_errors = _declare(transfer, values[0], relative_light, longest_s, full_scale_dn)
    levels = FlatLevels(
        frames=sum(level.frames for level in flats),
        light=relative_light,
        values=values,
        errors=np.stack([mean_errors, transfer.excess_error[usable]]),
        # The faintest and the brightest level are fitted: predictions are tested between levels, not beyond them.
        is_held_out=(position % HELD_OUT_EVERY == 1) & (position < len(usable) - 1),
        conditions=conditions,
        dark=dark,
        dark_errors=dark_errors,
        declared=declared,
        black_level_error=np.inf,
        scales=_scales_of(declared, float(values[0].max()), float(relative_light.min()) * longest_s, longest_s),
        needs_met=frozenset({Need.EXPOSURES, Need.THREE_EXPOSURES, Need.LAW} if is_steady else ()),
    )
    # The black level of the declared model itself is free to match the darks: its error is infinite in this step.
    error = BLACK_LEVEL_SHARE * float(np.sqrt(dark[1]))
    return replace(levels, declared=match_dark(levels, declared)[0], black_level_error=error)


def _declare(
    transfer: Transfer, signal: np.ndarray, relative_light: np.ndarray, longest_s: float, full_scale_dn: float
) -> tuple[ForwardModel, np.ndarray, np.ndarray]:
    """Return the linear model of plain photon transfer, mean and variance of a dark reading [2], and their errors [2].

    `signal` [level, DN] is the mean of each level above darks, `relative_light` [level] its light.
    """
    gain, offset, noise = (transfer.quantities[name] for name in ("gain", "dark_offset", "dark_noise_dn"))
    dark, stated = np.array([offset.value, noise.value**2]), [offset.stderr, 2 * noise.value * noise.stderr]
    if not np.isfinite(dark).all():
        # Photon transfer leaves quantities that contradict each other unknown; the shortest dark is then used as it is.
        shortest = min((level for level in transfer.darks if level.frames > 1), key=lambda level: level.exposure_s)
        dark, stated = np.array([shortest.mean, shortest.variance]), [shortest.mean_error, shortest.variance_error]
    dark_errors = np.fmax(stated, LEAST_DARK_ERRORS * np.array([1.0, dark[1]]))
    noise_e = max(np.sqrt(max(dark[1] - ROUNDING_VARIANCE, 0.0)) / gain.value, LEAST_NOISE_E)
    sensor = SensorModel(gain.value, noise_e, 0.0, np.inf, max(float(dark[0]), 0.0), full_scale_dn)
    law = ExposureLaw(0.0, ENDLESS_PX, float(np.median(signal / relative_light)))
    return ForwardModel(Baseline(0.0, "linear", False, longest_s), sensor, law), dark, dark_errors


def _scales_of(declared: ForwardModel, peak_dn: float, shortest_s: float, longest_s: float) -> EffectScales:
    """Return the sizes of the dataset, from which effects derive bounds and starting values.

    `peak_dn` is the mean of the brightest level above darks [DN].
    """
    sensor = declared.sensor
    return EffectScales(
        sigma_px=ENDLESS_PX, peak_dn=peak_dn, full_scale_dn=min(sensor.full_scale_dn, LARGEST_READING_DN), crop_px=1.0,
        shortest_s=shortest_s, read_noise_e=sensor.read_noise_e, gain_dn_per_e=sensor.gain_dn_per_e,
        width_exponent=0.0, longest_s=longest_s,
    )  # fmt: skip


# Readings


def expect_levels(levels: FlatLevels, model: ForwardModel) -> ExpectedLevels:
    """Return the values that a model predicts for the levels, after its black level and read noise match the darks."""
    model, dark, dark_misfit = match_dark(levels, model)
    light = model.light(levels.conditions)
    moments = model.moments(model.sensor_input(levels.conditions, light=light))
    # Mean, variance and their derivatives by the light, then the light itself [level].
    shape = levels.conditions.exposure_s.shape
    mean, variance, *slopes, lamp_dn = (np.ravel(np.broadcast_to(values, shape)) for values in (*moments, light.spot))
    return ExpectedLevels(np.stack([mean - dark[0], variance - dark[1]]), np.stack(slopes), lamp_dn, dark_misfit)


def match_dark(levels: FlatLevels, model: ForwardModel) -> tuple[ForwardModel, np.ndarray, np.ndarray]:
    """Fit black level and read noise of a model to the darks.

    The black level is at least 0. If a sensor cuts readings at 0, that is an effect and not a negative black level.

    Returns
    -------
    model : ForwardModel
        Model with the fitted black level and read noise.
    dark : array [2]
        Mean [DN] and variance [DN²] of a dark reading of this model.
    dark_misfit : array [3]
        See `ExpectedLevels`.
    """
    origin = PixelGrid(np.zeros((1, 1)), np.zeros((1, 1)), 1, 1)
    dark_frame = replace(levels.conditions, pixels=origin, x0=0.0, y0=0.0, exposure_s=levels.conditions.longest_s)
    no_light = Light(np.zeros((1, 1)), 0.0)

    def with_dark(point: np.ndarray) -> ForwardModel:
        """Return the model with a point (black level [DN], read noise [e-])."""
        sensor = replace(model.sensor, black_level_dn=float(point[0]), read_noise_e=float(point[1]))
        return replace(model, sensor=sensor)

    def expect_dark(point: np.ndarray) -> np.ndarray:
        """Return mean [DN] and variance [DN²] of a dark reading at a point [2]."""
        adjusted = with_dark(point)
        moments = adjusted.moments(adjusted.sensor_input(dark_frame, light=no_light))
        return np.array([moments.mean.item(), moments.variance.item()])

    def misfit_at(point: np.ndarray) -> np.ndarray:
        """Return the dark misfit at a point [3]."""
        shift = (point[0] - levels.declared.sensor.black_level_dn) / levels.black_level_error
        return np.append((expect_dark(point) - levels.dark) / levels.dark_errors, shift)

    noise_dn = levels.declared.sensor.read_noise_e * levels.declared.sensor.gain_dn_per_e
    point = np.array([levels.declared.sensor.black_level_dn, noise_dn / model.sensor.gain_dn_per_e])
    misfit = misfit_at(point)
    if not np.all(np.abs(misfit) < NO_MISFIT):
        bounds, scales = ([0.0, POSITIVE_NOISE_E], [np.inf, np.inf]), np.maximum(point, LEAST_SCALE)
        point = least_squares(misfit_at, point, bounds=bounds, x_scale=scales).x
        misfit = misfit_at(point)
    return with_dark(point), expect_dark(point), misfit
