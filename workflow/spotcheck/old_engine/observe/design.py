"""The design of a set of frames, and which effects it can show: known before any reading is looked at."""

from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Effect


class Design(NamedTuple):
    """Of every frame [frame]: its site and its condition (numbers from 0 on), fibre angle [deg], exposure [s], and
    place in the order of acquisition (0 to 1), NaN where not known; and its pose, all of its condition but the
    exposure, in words."""

    site: np.ndarray
    condition: np.ndarray
    angle_deg: np.ndarray
    exposure_s: np.ndarray
    order: np.ndarray
    pose: np.ndarray

    def take(self, frames: np.ndarray) -> "Design":
        """The design of some of the frames."""
        return Design(*(own[frames] for own in self))

    @property
    def exposures(self) -> np.ndarray:
        """The exposures that occur [s]."""
        return np.unique(self.exposure_s[np.isfinite(self.exposure_s)])

    @property
    def reference_s(self) -> float:
        """The reference exposure of the spread law [s]: the geometric mean of those that occur."""
        return float(np.exp(np.mean(np.log(self.exposures)))) if self.exposures.size else 1.0


def missing(effect: Effect, design: Design, *, law: bool) -> str:
    """What an effect needs and a design does not vary (a key of `NEEDS`); "" where nothing is missing. `law`: the
    baseline has a law of the light in exposure."""
    exposures = design.exposures.size
    angles = np.unique(design.angle_deg[np.isfinite(design.angle_deg)]).size
    frames = len(design.site)
    has = {
        "exposure": exposures > 1,
        # Two exposures fit any law of the width.
        "three exposures": exposures > 2,
        "exposures of a site": np.bincount(design.site).max(initial=0) > 1,
        # Two angles fit any amplitude and phase.
        "angle": angles > 2,
        "order": bool(np.isfinite(design.order).all()) and frames > 2,
        "frames": frames > 2,
        "law": law,
    }
    return next((need for need in effect.needs if not has[need]), "")


def view_of(design: Design) -> View:
    """The chain's view of all frames at once, for what does not ask where a pixel lies."""
    one = np.zeros((len(design.site), 1, 1))
    exposure, angle, order = (
        np.asarray(own, float)[:, None, None] for own in (design.exposure_s, np.deg2rad(design.angle_deg), design.order)
    )
    longest = float(design.exposures.max(initial=0.0)) or 1.0
    return View(x=one, y=one, x0=one, y0=one, exposure_s=exposure, angle=angle, order=order, wave_cos=one, wave_sin=one,
                longest_s=longest, reference_s=design.reference_s, frame_x=0.0, frame_y=0.0, frame_rows=1.0,
                rows_each=1.0)  # fmt: skip
