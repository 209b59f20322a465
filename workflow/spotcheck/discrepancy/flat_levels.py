"""Levels of flats over their darks, and what a forward model reads there.

Data are, for each level of light, the mean [DN] and the variance in time [DN²] of a reading over those of darks of the
same exposure. A level is a frame of even light (a spot of endless width), and a dark a frame without light, so that
readings have the distribution that spots have.
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
from spotcheck.sensor import SensorModel

# Width [px] of a spot that is even over any sensor.
ENDLESS_PX = 1e9
# Levels of which a larger part of the pixels reads full scale are left out: there the light's unevenness would count.
MOST_CLIPPED = 1e-3
# Every so many levels one is held out; with fewer levels than the second nothing is assessed.
HELD_OUT_EVERY, FEWEST_LEVELS = 3, 6
# Relative scatter of light over exposure up to which a lamp is steady, so that the light is a law of the exposure.
STEADY = 0.02
# Least dark noise [e-] and least errors of a mean [DN], and of mean [DN] and variance [1] of a dark reading.
LEAST_NOISE_E, LEAST_MEAN_ERROR, LEAST_DARK_ERRORS = 0.1, 1e-6, (0.01, 0.01)
# An effect that bends the response about 0 shifts the mean dark reading by part of its noise: by so much, in parts of
# that noise, the black level may change. Misfit of darks [standard errors] below which nothing is adjusted.
BLACK_LEVEL_SHARE, NO_MISFIT = 0.1, 1e-3


@dataclass(frozen=True)
class FlatLevels:
    """Levels in the order of their light, and the declared model of them."""

    frames: int  # number of frames of all levels
    light: np.ndarray  # light as a part of the largest [level]
    values: np.ndarray  # mean [DN] and variance [DN²] over darks [2, level]
    errors: np.ndarray  # standard errors of the values [2, level]
    is_held_out: np.ndarray  # whether a level takes no part in the search [level]
    conditions: FrameConditions  # of the levels; arrays [level, 1, 1]
    dark: np.ndarray  # mean [DN] and variance [DN²] of a dark reading [2]
    dark_errors: np.ndarray  # standard errors of these [2]
    declared: ForwardModel  # a linear sensor, with R and K by plain photon transfer, and the black level of the darks
    black_level_error: float  # by what another model may have another black level [DN]
    scales: EffectScales  # scales from which effects derive bounds and starts
    needs_met: frozenset[Need]  # conditions of effects that the levels vary


@dataclass(frozen=True)
class ExpectedLevels:
    """What a model reads at the levels."""

    values: np.ndarray  # mean [DN] and variance [DN²] over darks [2, level]
    light_slopes: np.ndarray  # derivatives of mean and variance by the light of the lamp [1] and [DN], [2, level]
    lamp_dn: np.ndarray  # light of the lamp [DN, level]
    # Mean and variance of a dark reading less those measured, black level less the declared one, in standard errors.
    dark_misfit: np.ndarray  # [3]


# Data


def collect_levels(transfer: Transfer, full_scale_dn: float) -> FlatLevels | None:
    """Return the levels that can be assessed; None if there are too few of different light, or no gain."""
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
    place, nowhere = np.arange(len(usable)), np.zeros((len(usable), 1, 1))
    part = light / light.max()
    conditions = FrameConditions(
        PixelGrid(nowhere, nowhere, 1, 1), nowhere, nowhere, (part * longest_s)[:, None, None], longest_s, longest_s
    )
    declared, dark, dark_errors = _declare(transfer, values[0], part, longest_s, full_scale_dn)
    levels = FlatLevels(
        frames=sum(level.frames for level in flats),
        light=part,
        values=values,
        errors=np.stack([mean_errors, transfer.excess_error[usable]]),
        # Both ends take part in the search: a fit is to be tried between levels, not beyond them.
        is_held_out=(place % HELD_OUT_EVERY == 1) & (place < len(usable) - 1),
        conditions=conditions,
        dark=dark,
        dark_errors=dark_errors,
        declared=declared,
        black_level_error=np.inf,
        scales=_scales_of(declared, float(values[0].max()), float(part.min()) * longest_s, longest_s),
        needs_met=frozenset({Need.EXPOSURES, Need.THREE_EXPOSURES, Need.LAW} if is_steady else ()),
    )
    error = BLACK_LEVEL_SHARE * float(np.sqrt(dark[1]))
    return replace(levels, declared=match_dark(levels, declared)[0], black_level_error=error)


def _declare(
    transfer: Transfer, signal: np.ndarray, part: np.ndarray, longest_s: float, full_scale_dn: float
) -> tuple[ForwardModel, np.ndarray, np.ndarray]:
    """Return the linear model of plain photon transfer, and mean and variance of a dark reading with their errors."""
    gain, offset, noise = (transfer.quantities[name] for name in ("gain", "dark_offset", "dark_noise_dn"))
    dark, stated = np.array([offset.value, noise.value**2]), [offset.stderr, 2 * noise.value * noise.stderr]
    if not np.isfinite(dark).all():
        # Quantities that contradict others are unknown; a dark is what it is.
        shortest = min((level for level in transfer.darks if level.frames > 1), key=lambda level: level.exposure_s)
        dark, stated = np.array([shortest.mean, shortest.variance]), [shortest.mean_error, shortest.variance_error]
    dark_errors = np.fmax(stated, LEAST_DARK_ERRORS * np.array([1.0, dark[1]]))
    noise_e = max(np.sqrt(max(dark[1] - 1 / 12, 0.0)) / gain.value, LEAST_NOISE_E)
    sensor = SensorModel(gain.value, noise_e, 0.0, np.inf, max(float(dark[0]), 0.0), full_scale_dn)
    law = ExposureLaw(0.0, ENDLESS_PX, float(np.median(signal / part)))
    return ForwardModel(Baseline(0.0, "linear", False, longest_s), sensor, law), dark, dark_errors


def _scales_of(declared: ForwardModel, peak_dn: float, shortest_s: float, longest_s: float) -> EffectScales:
    """Return the scales from which effects derive parameter limits and starting values."""
    sensor = declared.sensor
    return EffectScales(
        sigma_px=ENDLESS_PX, peak_dn=peak_dn, full_scale_dn=min(sensor.full_scale_dn, 65535.0), crop_px=1.0,
        shortest_s=shortest_s, read_noise_e=sensor.read_noise_e, gain_dn_per_e=sensor.gain_dn_per_e,
        width_exponent=0.0, longest_s=longest_s,
    )  # fmt: skip


# Readings


def expect_levels(levels: FlatLevels, model: ForwardModel) -> ExpectedLevels:
    """Return what a model reads at the levels; its black level and read noise become those that its darks show."""
    model, dark, dark_misfit = match_dark(levels, model)
    light = model.light(levels.conditions)
    moments = model.moments(model.sensor_input(levels.conditions, light=light))
    mean, variance, *slopes = (np.ravel(np.broadcast_to(part, levels.conditions.exposure_s.shape)) for part in moments)
    return ExpectedLevels(
        np.stack([mean - dark[0], variance - dark[1]]),
        np.stack(slopes),
        np.ravel(np.broadcast_to(light.spot, levels.conditions.exposure_s.shape)),
        dark_misfit,
    )


def match_dark(levels: FlatLevels, model: ForwardModel) -> tuple[ForwardModel, np.ndarray, np.ndarray]:
    """Return a model with the black level and read noise that the darks show, mean and variance of its dark readings
    [2], and the misfit of these and of its black level in standard errors [3].

    The black level is at least 0: what would lie below is an effect.
    """
    centre = PixelGrid(np.zeros((1, 1)), np.zeros((1, 1)), 1, 1)
    dark_frame = replace(levels.conditions, pixels=centre, x0=0.0, y0=0.0, exposure_s=levels.conditions.longest_s)

    def with_dark(point: np.ndarray) -> ForwardModel:
        sensor = replace(model.sensor, black_level_dn=float(point[0]), read_noise_e=float(point[1]))
        return replace(model, sensor=sensor)

    def dark_of(point: np.ndarray) -> np.ndarray:
        moments = (moved := with_dark(point)).moments(
            moved.sensor_input(dark_frame, light=Light(np.zeros((1, 1)), 0.0))
        )
        return np.array([moments.mean.item(), moments.variance.item()])

    def misfit_of(point: np.ndarray) -> np.ndarray:
        shift = (point[0] - levels.declared.sensor.black_level_dn) / levels.black_level_error
        return np.append((dark_of(point) - levels.dark) / levels.dark_errors, shift)

    noise_dn = levels.declared.sensor.read_noise_e * levels.declared.sensor.gain_dn_per_e
    start = np.array([levels.declared.sensor.black_level_dn, noise_dn / model.sensor.gain_dn_per_e])
    misfit = misfit_of(start)
    if np.all(np.abs(misfit) < NO_MISFIT):
        return with_dark(start), dark_of(start), misfit
    fit = least_squares(misfit_of, start, bounds=([0.0, 1e-9], [np.inf, np.inf]), x_scale=np.maximum(start, 1e-2))
    return with_dark(fit.x), dark_of(fit.x), misfit_of(fit.x)
