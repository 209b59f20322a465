"""The base point: a spot for every frame under the baseline's law, from which residuals are taken.

It needs only to be near: every later fit refits p1, p2, the peak and the centres jointly with whatever it tests, and
the model's change between the two is evaluated, not linearised.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.observe.frames import round_spot
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law
from spotcheck.model.sensor import SensorModel


class Base(NamedTuple):
    """Peak [DN], σ_g [px], centre x0, y0 [px of the crop] of every frame, and the law they follow (None: each its
    own)."""

    amplitude: np.ndarray
    sigma: np.ndarray
    x0: np.ndarray
    y0: np.ndarray
    law: Law | None

    def of_condition(self, design: Design) -> Law | Free:
        """The base as the chain takes it, one view a condition."""
        if self.law is not None:
            return self.law
        own = [design.condition == c for c in range(design.conditions)]
        # A condition of which all frames are kept unseen is not fitted, but must not hinder the others.
        mean = [np.array([v[at].mean() if at.any() else v.mean() for at in own]) for v in self[:2]]
        return Free(*(m[:, None, None] for m in mean))


def spots_of(shots: Sequence[Shot], sensor: SensorModel, top_hat: bool) -> np.ndarray:
    """A round spot for every frame, each fitted alone [frame, (peak, x0, y0, σ, trusted)]."""
    out = [round_spot(shot.pixels(), sensor, top_hat) for shot in shots]
    return np.array([[*own, float(np.isfinite(own).all())] for own in out])


def base_of(spots: np.ndarray, corners: np.ndarray, design: Design, baseline: Baseline, crop_px: int) -> Base | None:
    """The base through single spots; `corners` [frame, (left, top)] of the crops. None where no spot can be used."""
    trusted = spots[:, 4] > 0
    trusted &= (spots[:, 3] < criteria.WIDEST.value * crop_px) & (
        np.abs(spots[:, 1:3] - crop_px / 2) < crop_px / 2
    ).all(axis=1)
    if not trusted.any():
        return None
    amplitude, sigma = spots[:, 0].copy(), spots[:, 3].copy()
    # A frame without a fit of its own takes what its condition, or else the whole set, has.
    for k in np.flatnonzero(~trusted):
        like = trusted & (design.condition == design.condition[k])
        like = like if like.any() else trusted
        amplitude[k], sigma[k] = np.median(spots[like, 0]), np.median(spots[like, 3])
    centre = spots[:, 1:3] + corners
    centre[~trusted] = np.nan
    for site in range(design.sites):
        own = design.site == site
        known = own & trusted
        where = np.average(centre[known], axis=0, weights=spots[known, 0]) if known.any() else np.nan
        centre[own] = where
    x0, y0 = (centre - corners).T
    x0, y0 = (np.where(np.isfinite(v), v, (crop_px - 1) / 2) for v in (x0, y0))
    if baseline.photon_budget == "free":
        return Base(amplitude, sigma, x0, y0, None)
    exposures = design.exposure_s[design.condition]
    p1, p2 = _line(np.log(exposures[trusted]), sigma[trusted] - baseline.laser_px)
    if (baseline.propagation(exposures, p1, p2) <= 0.3).any():
        p1, p2 = 0.0, max(float(np.median(sigma[trusted])) - baseline.laser_px, 1.0)
    relative = baseline.relative_peak(exposures, p1, p2)
    peak = float(np.sum(amplitude[trusted] * relative[trusted]) / np.sum(relative[trusted] ** 2))
    law = Law(p1, p2, peak)
    return Base(peak * relative, baseline.sigma(exposures, p1, p2) + 0 * exposures, x0, y0, law)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and intercept; slope 0 where all x are equal."""
    if np.ptp(x) == 0:
        return 0.0, float(np.median(y))
    slope, intercept = np.polyfit(x, y, 1)
    return float(slope), float(intercept)
