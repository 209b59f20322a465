"""Levels of flats and darks drawn without the library: by closed forms, or pixel by pixel through a sensor."""

from collections.abc import Callable

import numpy as np

from spotcheck.characterization.levels import Level, PatternVariances, add_common_drift
from spotcheck.characterization.photon_transfer import Transfer, analyse_photon_transfer

FULL, GAIN, BLACK, NOISE, TOP, LONGEST = 4095.0, 6.0, 40.0, 1.0, 3000.0, 6e-3
SHAPE = (480, 640)
PIXELS = SHAPE[0] * SHAPE[1]
DARK = (GAIN * NOISE) ** 2
# Drift of the lamp between the frames of a level, as a part of its light.
DRIFT = 4e-4


def level_of(kind: str, exposure_s: float, mean: float, mean_error: float, variance: float, error: float, full=0.0):
    """Return a level of two frames."""
    photons = exposure_s * 1e6 if kind == "flat" else 0.0
    return Level(kind, exposure_s, photons, 2, mean, mean_error, variance, error, 0.0, full,
                 PatternVariances(0.0, 0.0, 0.0, 0.0), SHAPE)  # fmt: skip


def transfer_with_end(levels: list[Level]) -> Transfer:
    """Return the photon transfer of levels and one more at the end of the converter, which shows saturation."""
    return analyse_photon_transfer(
        add_common_drift([*levels, level_of("flat", 8e-3, FULL, 0.0, 0.0, 1e-3, full=1.0)]), FULL
    )


def draw_by_moments(seed: int, *, bend=0.0, late=0.0, power=0.0, offset=0.0, lamp=0.0, wave=0.0, count=30) -> Transfer:
    """Draw means and variances of pairs of frames by their laws.

    Parameters
    ----------
    bend : response y − q y²/full scale.
    late : seconds by which the exposure is longer than stated.
    power : power of the exposure beyond 1 in the light.
    offset : stray light of flats [DN].
    lamp : relative scatter of the light from level to level.
    wave : amplitude of a wave in the response [DN].
    count : number of levels.
    """
    rng, levels = np.random.default_rng(seed), []
    for exposure_s in np.linspace(2e-4, LONGEST, count):
        light = TOP * ((exposure_s + late) / LONGEST) ** (1 + power) * (1 + lamp * rng.standard_normal()) + offset
        slope = 1 - 2 * bend * light / FULL
        signal = light - bend * (light**2 + GAIN * light) / FULL + wave * np.sin(6 * np.pi * light / FULL)
        for kind, mean, variance in (("dark", 0.0, DARK), ("flat", signal, slope**2 * (GAIN * light + DARK))):
            variance += 1 / 12
            frames = BLACK + mean + (DRIFT * mean + np.sqrt(variance / PIXELS)) * rng.standard_normal(2)
            error = variance * np.sqrt(2 / PIXELS)
            levels.append(
                level_of(kind, float(exposure_s), float(frames.mean()), float(np.std(frames, ddof=1) / np.sqrt(2)),
                         float(variance + error * rng.standard_normal()), float(error))
            )  # fmt: skip
    return transfer_with_end(levels)


def draw_by_pixels(
    seed: int,
    *,
    charge: Callable[[np.ndarray], np.ndarray] = np.asarray,
    digital: Callable[[np.ndarray], np.ndarray] = np.asarray,
    black=BLACK,
    faintest=0.03,
    count=24,
    pixels=60_000,
) -> Transfer:
    """Draw all pixels of pairs of frames: Poisson electrons, `charge` of the signal [DN], read noise, black level,
    `digital` of the reading [DN], rounding and both ends of the converter. `faintest` is the least light [TOP]."""
    rng, levels = np.random.default_rng(seed), []
    for exposure_s in LONGEST * np.linspace(faintest, 1.0, count):
        for kind, light in (("dark", 0.0), ("flat", TOP * exposure_s / LONGEST)):
            electrons = rng.poisson(light * (1 + DRIFT * rng.standard_normal((2, 1))) / GAIN, (2, pixels))
            signal = charge(GAIN * electrons) + GAIN * NOISE * rng.standard_normal((2, pixels))
            frames = np.clip(np.rint(digital(signal + black)), 0, FULL)
            means, difference = frames.mean(axis=1), frames[0] - frames[1]
            squares = (difference - difference.mean()) ** 2 / 2
            levels.append(
                level_of(kind, float(exposure_s), float(means.mean()), float(np.std(means, ddof=1) / np.sqrt(2)),
                         float(squares.mean()), float(squares.std() / np.sqrt(pixels)),
                         float(np.mean(frames >= FULL)))
            )  # fmt: skip
    return transfer_with_end(levels)
