"""The design of frames as the files beside the rooms take it; the frames themselves are in `observe/shots`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.observe.shots import (
    Blocks,
    Shot,
    held_out,
    keys_and_numbers,
    left_out,
    or_nan,
    shots_of,
    together,
)

__all__ = ["Blocks", "Design", "Shot", "design_of", "held_out", "left_out", "never_chose", "shots_of", "together"]


class Design(NamedTuple):
    """Index arrays over the frames: `condition` (angle, exposure, other conditions), `site` (angle, repeat, other
    conditions), `repeat`; the conditions' angles [deg] and exposures [s] (NaN: not recorded), the angle index of each
    condition; `order` [frame] from 0 to 1, NaN where unknown."""

    condition: np.ndarray
    site: np.ndarray
    repeat: np.ndarray
    order: np.ndarray
    angle_deg: np.ndarray
    exposure_s: np.ndarray
    place: np.ndarray

    @property
    def conditions(self) -> int:
        """How many conditions there are."""
        return len(self.angle_deg)

    @property
    def sites(self) -> int:
        """How many sites there are."""
        return int(self.site.max()) + 1

    @property
    def places(self) -> int:
        """How many sets of sites with their own angle and other conditions there are."""
        return int(self.place.max()) + 1

    def take(self, frames: np.ndarray) -> "Design":
        """The same conditions with some of the frames only; sites are numbered anew."""
        site = np.unique(self.site[frames], return_inverse=True)[1]
        return self._replace(
            condition=self.condition[frames], site=site, repeat=self.repeat[frames], order=self.order[frames]
        )


def design_of(shots: Sequence[Shot]) -> Design:
    """The design that a list of frames spans."""
    keys = [(or_nan(s.angle_deg), *map(or_nan, s.conditions), or_nan(s.exposure_s)) for s in shots]
    conditions, condition = keys_and_numbers(keys)
    _, site = keys_and_numbers([(key[:-1], s.repeat) for key, s in zip(keys, shots, strict=True)])
    _, place = keys_and_numbers([key[:-1] for key in conditions])
    known = [s.order for s in shots if s.order is not None]
    span = max(known) - min(known) if len(known) == len(shots) and len(known) > 1 else 0
    # A span says that the order of all is known.
    order = np.array([((s.order or 0) - min(known)) / span if span else np.nan for s in shots])
    angles = np.array([key[0] for key in conditions], float)
    exposures = np.array([key[-1] for key in conditions], float)
    return Design(condition, site, np.array([s.repeat for s in shots]), order, angles, exposures, place)


def never_chose(design: Design) -> str:
    """Which frames stand for conditions of which all are kept unseen; "" where there is none."""
    out = held_out(design.repeat)
    blind = np.setdiff1d(np.arange(design.conditions), design.condition[~out])
    if not blind.size:
        return ""
    count = int(np.isin(design.condition, blind).sum())
    which = f"{count} frames belong" if count > 1 else "1 frame belongs"
    return f"{which} to conditions of which every frame is kept unseen: they may test a model, but did not choose it"
