"""What spots show of the sensor: gain and noise floor, and where the signal stops."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from spotcheck.characterization.noise_curve import FEWEST, Gain, NoiseCurve, correlated_px, gain_from_curve, noise_curve
from spotcheck.characterization.same_site import EMPTY, curve_of, tally_of
from spotcheck.characterization.skipped import skipped_codes
from spotcheck.sensor import SensorModel

# Readings below this part of the level at which the signal stops still have all their noise.
BELOW_STOP = 0.9
# Readings above this part of it are at the stop; there less than this part of the shot noise is left.
AT_STOP, COLLAPSED = 0.9, 0.5
# Frames in which it is looked for skipped codes and for noise that pixels share.
LOOKED_AT = 5
# The rim of a frame, whose median is its dark level, in parts of its sides: a spot lies within.
RIM = 0.05

# Readings gather where the signal stops: bins of this part of a level, that hold this many times the pixels that a
# spot's flank has in as many, from where to where of the highest the flank is looked at, and how near to each other
# the levels of frames of different light must be.
FINE, GATHER, FLANK, ALIKE = 0.04, 4.0, (0.25, 0.6), 0.05


class BySpots(NamedTuple):
    """Gain and noise floor and how they came about (None, ""); the level over black [DN] at which frames stop with its
    standard error (None); the variance [DN²] of a pixel there, by pairs of frames (NaN); the level [DN] over which
    light was counted: black, or what the rims of frames read; and the lowest of these rims [DN]."""

    gain: Gain | None
    how: str
    stop: tuple[float, float] | None
    variance_at_stop: float
    level_dn: float
    lowest_dn: float

    @property
    def collapses(self) -> bool:
        """Whether noise is gone where frames stop, as it is where the sensor stops, not the light."""
        if self.gain is None or self.stop is None:
            return False
        return self.variance_at_stop < self.gain.floor + COLLAPSED * self.gain.gain * self.stop[0]


def seen_by_spots(
    crops: Iterable[np.ndarray],
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]],
    black_dn: float | None,
    full_scale_dn: float,
    response_bend: float = 0.0,
) -> BySpots:
    """From what neighbouring pixels, or two frames of the same pixels, do not share, whichever tells the gain better.

    `crops` are images [DN]; `pairs` are aligned images [DN] by what they are pairs of. Where the material has grain
    that pairs share, they tell what neighbours cannot. Without a black level light is counted over what the rim of each
    frame reads: the floor is then the noise of a dark pixel, shot noise of stray light included. What the data sheet
    says of the response is turned round.
    """
    nonlinear = SensorModel(1.0, 0.0, full_scale_dn=full_scale_dn, response_bend=response_bend)
    curves, stops, levels, first = [], [], [], list[np.ndarray]()
    for crop in crops:
        levels.append(dark_level(crop) if black_dn is None else black_dn)
        sensor = replace(nonlinear, black_level_dn=levels[-1])
        image = sensor.linearize(crop)
        stops.append(stop_of(image, levels[-1]))
        curve = noise_curve(image, _whole(sensor.without_curvature().full_scale_dn, levels[-1], stops[-1]))
        curves += [curve._replace(level=curve.level - levels[-1])] if curve.level.size else []
        first += [crop] if len(first) < LOOKED_AT else []
    level, ways, stopped = float(np.median(levels)) if levels else black_dn or 0.0, {}, np.zeros(2)
    if curves:
        pooled = NoiseCurve(*(np.concatenate(parts) for parts in zip(*curves, strict=True)))
        how = f"differences of neighbouring pixels in {_counted(len(curves), 'frame')}"
        ways[how + _caveat(first, full_scale_dn)] = pooled
    sensor = replace(nonlinear, black_level_dn=level)
    for of_what, images in pairs.items():
        tally, number = EMPTY, 0
        for pair in images:
            two = sensor.linearize(pair[0]), sensor.linearize(pair[1])
            ends = [stop_of(one, level) for one in two]
            tally = tally + tally_of(*two, level, _whole(sensor.without_curvature().full_scale_dn, level, *ends))
            stopped += _at_stop(two, level + AT_STOP * float(np.mean(ends)))
            number += 1
        curve = curve_of(tally, level)
        ways[f"differences of {_counted(number, 'pair')} of {of_what}"] = curve._replace(level=curve.level - level)
    gains = {how: own for how, curve in ways.items() if (own := gain_from_curve(curve, 0.0)) is not None}
    lowest = min(levels, default=level)
    end = common_stop(stops), float(stopped[1] / stopped[0]) if stopped[0] else np.nan, level, lowest
    if not gains:
        return BySpots(None, "", *end)
    how = min(gains, key=lambda own: gains[own].gain_stderr / gains[own].gain)
    return BySpots(gains[how], how, *end)


def _whole(full_scale_dn: float, level: float, *stops: float) -> float:
    """Readings up to which all noise is there: where the signal stops its noise does too."""
    return float(min([full_scale_dn, *(level + BELOW_STOP * stop for stop in stops if np.isfinite(stop))]))


def _caveat(images: Sequence[np.ndarray], full_scale_dn: float) -> str:
    """What speaks against trusting neighbours: codes that a look-up table skips, and noise that pixels share. Chance
    makes one frame's noise look shared once in a while, compression that of most."""
    skipped, shared = skipped_codes(images), [correlated_px(image, full_scale_dn) for image in images]
    out = f"; {len(skipped)} codes are never read, as a look-up table skips them" if skipped else ""
    if sum(own.tells for own in shared) <= len(shared) / 2:
        reach = int(np.median([own.reach_px for own in shared]))
        out += f"; pixels share noise over {reach} px, as in compressed frames, so it is not that of single pixels"
    return out


def _at_stop(two: tuple[np.ndarray, np.ndarray], least: float) -> np.ndarray:
    """Number of the pixels that read more than `least` [DN] in both frames, and that times their variance by the median
    of squared differences: some have not yet stopped."""
    both = np.minimum(*two) > least
    if not both.any():
        return np.zeros(2)
    squared = float(np.median((two[1] - two[0])[both] ** 2)) / 2
    return both.sum() * np.array([1.0, squared / chi2.median(1)])


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def dark_level(frame: np.ndarray) -> float:
    """What most pixels of the rim read [DN]."""
    rows, columns = (max(1, round(RIM * side)) for side in frame.shape)
    inner = np.zeros(frame.shape, bool)
    inner[rows:-rows, columns:-columns] = True
    return float(np.nanmedian(frame[~inner]))


def stop_of(image: np.ndarray, black_level: float) -> float:
    """Level over black [DN] at which the readings of one spot gather; NaN where they do not.

    A Gaussian spot has as many pixels in every step of ln level, so a step that has many more is where light stops.
    """
    level = image[np.isfinite(image)] - black_level
    top = float(np.quantile(level, 0.999)) if level.size else 0.0
    if top <= 0:
        return np.nan
    steps = np.log(level[level > FLANK[0] * top] / top)
    edges = np.arange(np.log(FLANK[0]), 0.15, FINE)
    count, _ = np.histogram(steps, edges)
    flank = count[(edges[:-1] >= np.log(FLANK[0])) & (edges[1:] <= np.log(FLANK[1]))]
    if flank.sum() < FEWEST:
        return np.nan
    fullest = int(np.argmax(count))
    if count[fullest] < GATHER * flank.mean() or edges[fullest] < np.log(FLANK[1]):
        return np.nan
    near = np.abs(steps - edges[fullest] - FINE / 2) < 1.5 * FINE
    return float(top * np.exp(np.median(steps[near])))


def common_stop(stops: list[float]) -> tuple[float, float] | None:
    """The level at which most frames stop, with its standard error; None where fewer than two do, or where each stops
    elsewhere, as plateaus of the light itself would."""
    known = np.array([stop for stop in stops if np.isfinite(stop)])
    if len(known) < 2:
        return None
    middle = float(np.median(known))
    alike = known[np.abs(known - middle) < ALIKE * middle]
    if len(alike) < 2 or len(alike) < 0.6 * len(known):
        return None
    return float(alike.mean()), float(alike.std(ddof=1) / np.sqrt(len(alike)))
