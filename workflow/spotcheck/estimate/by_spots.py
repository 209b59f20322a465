"""What spots show of the sensor: gain and noise floor, and where the signal stops."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from spotcheck.estimate.noise import Gain, NoiseCurve, common_stop, correlated_px, gain_from_curve, noise_curve, stop_of
from spotcheck.estimate.same_site import EMPTY, curve_of, tally_of

# Readings below this part of the level at which the signal stops still have all their noise.
BELOW_STOP = 0.9
# Readings above this part of it are at the stop; there less than this part of the shot noise is left.
AT_STOP, COLLAPSED = 0.9, 0.5


class BySpots(NamedTuple):
    """Gain and noise floor and how they came about (None, ""); the level over black [DN] at which frames stop with its
    standard error (None); and the variance [DN²] of a pixel there, by pairs of frames (NaN)."""

    gain: Gain | None
    how: str
    stop: tuple[float, float] | None
    variance_at_stop: float

    @property
    def collapses(self) -> bool:
        """Whether noise is gone where frames stop, as it is where the sensor stops, not the light."""
        if self.gain is None or self.stop is None:
            return False
        return self.variance_at_stop < self.gain.floor + COLLAPSED * self.gain.gain * self.stop[0]


def seen_by_spots(
    crops: Iterable[np.ndarray],
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]],
    black_dn: float,
    full_scale_dn: float,
) -> BySpots:
    """From what neighbouring pixels, or two frames of the same pixels, do not share, whichever tells the gain better.

    `crops` are images [DN]; `pairs` are aligned images [DN] by what they are pairs of. Where the material has grain
    that pairs share, they tell what neighbours cannot.
    """

    def whole(*stops: float) -> float:
        """Readings up to which all noise is there: where the signal stops its noise does too."""
        return float(min([full_scale_dn, *(black_dn + BELOW_STOP * stop for stop in stops if np.isfinite(stop))]))

    curves, stops, ways, stopped = [], [], {}, np.zeros(2)
    for crop in crops:
        stops.append(stop_of(crop, black_dn))
        curve = noise_curve(crop, whole(stops[-1]))
        # Noise that neighbours share, as compression and fine grain leave it, is not in their differences.
        told = curve.level.size and correlated_px(crop, whole(stops[-1])).tells
        curves += [curve] if told else []
    if curves:
        pooled = NoiseCurve(*(np.concatenate(parts) for parts in zip(*curves, strict=True)))
        ways[f"differences of neighbouring pixels in {_counted(len(curves), 'frame')}"] = pooled
    for of_what, images in pairs.items():
        tally, number = EMPTY, 0
        for two in images:
            ends = [stop_of(one, black_dn) for one in two]
            tally = tally + tally_of(*two, black_dn, whole(*ends))
            stopped += _at_stop(two, black_dn + AT_STOP * float(np.mean(ends)))
            number += 1
        ways[f"differences of {_counted(number, 'pair')} of {of_what}"] = curve_of(tally, black_dn)
    gains = {how: own for how, curve in ways.items() if (own := gain_from_curve(curve, black_dn)) is not None}
    end = common_stop(stops), float(stopped[1] / stopped[0]) if stopped[0] else np.nan
    if not gains:
        return BySpots(None, "", *end)
    how = min(gains, key=lambda own: gains[own].gain_stderr / gains[own].gain)
    return BySpots(gains[how], how, *end)


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
