"""One trial of the settings search: the whole plan in small, measured and scored."""

from __future__ import annotations

import numpy as np

from rig import exposure, measure, scores
from rig.errors import RigError
from rig.plan import Shot, Site
from rig.settings import Settings


def measured(settings: Settings, sites: list[Site]) -> scores.Measured:
    """Expose and measure a full grid of angle x exposure x repeat.

    Only the lit windows are made. They hold just the pixels that the whole frames hold there, so that a trial
    measures what the written dataset will show, unless a crop reaches beyond the window (`window_px` of 320 leaves
    40 px for the walk of the maximum).
    """
    shots = [shot for site in sites for shot in site.shots]
    angles = sorted({shot.angle_deg for shot in shots if shot.angle_deg is not None})
    exposures = sorted({shot.exposure_s for shot in shots if shot.exposure_s is not None})
    repeats = sorted({shot.repeat for shot in shots})
    grid = (len(angles), len(exposures), len(repeats))
    if len(shots) != np.prod(grid) or any(shot.kind != "spot" for shot in shots):
        raise RigError("manifest.csv: the search needs a full grid of spot frames: angle x exposure x repeat")
    crops = np.empty((*grid, measure.CROP_PX, measure.CROP_PX), dtype=np.float32)
    for site in sites:
        lit = exposure.light(settings, site)
        for shot in site.shots:
            cell = _cell(shot, angles, exposures, repeats)
            crops[cell] = measure.crop_at_maximum(exposure.window_frame(settings, lit, shot))
    return scores.measure_set(settings, crops, angles, exposures)


def _cell(shot: Shot, angles: list[float], exposures: list[float], repeats: list[str]) -> tuple[int, int, int]:
    assert shot.angle_deg is not None and shot.exposure_s is not None
    return angles.index(shot.angle_deg), exposures.index(shot.exposure_s), repeats.index(shot.repeat)
