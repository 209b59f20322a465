"""Widths of the spots of a scan along z, by second moments and by Gaussian fits, and whether the light is Gaussian.

D4σ is the width by second moments, four standard deviations σ (ISO 11146-1). It includes light outside a Gaussian,
which a fit leaves out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.fitting.beam_axes import SpotWidths
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.moments import Moments, second_moments
from spotcheck.io import progress, store

# Parameters of a spot fit that `SpotWidths` holds, in its order.
WIDTH_PARAMETERS = ("sigma_major", "sigma_minor", "orientation")
# A difference of widths is significant above this many standard errors and above this fraction of the width.
SIGNIFICANT_SIGMAS, SIGNIFICANT_FRACTION = 3.0, 0.02

# Second moments of spots by their index on the grid of the dataset.
MomentsByCell = Mapping[tuple[int, ...], Moments]


@dataclass(frozen=True, eq=False)
class ScanWidths:
    """Widths σ of the spots of a scan, each an array over the grid; NaN for unusable spots."""

    axes: SpotWidths  # widths along both axes of each spot, and their direction
    mean: np.ndarray  # mean of both widths [px]
    mean_stderr: np.ndarray  # standard error of `mean` [px]

    @property
    def is_usable(self) -> np.ndarray:
        """Whether a spot has all widths with errors, over the grid. The error of the direction may be infinite."""
        axes = self.axes
        numbers = (axes.major, axes.minor, axes.orientation, axes.major_stderr, axes.minor_stderr)
        return np.isfinite(np.stack([*numbers, self.mean, self.mean_stderr])).all(axis=0)


def collect_fit_widths(fits: xr.Dataset) -> ScanWidths:
    """Return the fitted widths that can be trusted; `fits` is fits.nc."""
    spots = select_preferred_fits(fits)
    spots = spots.where((spots["status"] & store.UNTRUSTED) == 0).transpose(*spots["status"].dims)
    axes = SpotWidths(*(spots[f"{name}{suffix}"].values for suffix in ("", "_stderr") for name in WIDTH_PARAMETERS))
    return ScanWidths(axes, spots["sigma_mean"].values, spots["sigma_mean_stderr"].values)


def measure_scan_moments(dataset: Dataset, fits: xr.Dataset) -> dict[tuple[int, ...], Moments]:
    """Return the second moments of every usable spot of a dataset on its whole frame.

    A crop may be smaller than the area of integration of the standard. `fits` is fits.nc, whose status tells which
    spots are usable.
    """
    status = select_preferred_fits(fits)["status"].values
    cells = [(index, frame) for index, frame in dataset.cells() if is_usable(status[index])]
    return {
        index: second_moments(frames.read_measured_image(dataset, frame))
        for index, frame in progress.track(cells, "measuring second moments")
    }


def collect_moment_widths(moments: MomentsByCell, shape: tuple[int, ...]) -> ScanWidths:
    """Return the widths by second moments over a grid of `shape`; NaN for spots without a D4σ of the standard."""
    values = np.full((*shape, len(fields(SpotWidths))), np.nan)
    for index, spot_moments in moments.items():
        if (spot_widths := convert_moments(spot_moments)) is not None:
            values[index] = spot_widths
    axes = SpotWidths(*np.moveaxis(values, -1, 0))
    return ScanWidths(axes, (axes.major + axes.minor) / 2, np.hypot(axes.major_stderr, axes.minor_stderr) / 2)


def convert_moments(moments: Moments) -> tuple[float, ...] | None:
    """Return the six fields of `SpotWidths` in their order, from the second moments of one spot.

    They are the widths σ = D4σ/4 along the longer and the shorter axis [px], the direction of the longer axis [deg],
    and the standard errors of these three. Returns None if D4σ has a large error (`is_measured`), or if its area of
    integration extends beyond the frame (`is_whole`), so that it is not the width of the standard.
    """
    if not (moments.is_measured and moments.is_whole):
        return None
    return (
        moments.major / 4, moments.minor / 4, moments.azimuth,
        moments.major_stderr / 4, moments.minor_stderr / 4, moments.azimuth_stderr,
    )  # fmt: skip


def compute_width_excess(
    moment_width: tuple[float, float], fit_width: tuple[float, float], *, is_whole: bool, clip_widening: float = 1.0
) -> float:
    """Return the relative excess of D4σ over 4σ of a fit; 0 if it is not significant or a width is unknown.

    Parameters
    ----------
    moment_width, fit_width : mean of both widths, D4σ and 4σ of the fit, and its standard error [px]; NaN if unknown.
    is_whole : whether the frame contains the area of integration. D4σ is too small otherwise.
    clip_widening : factor by which a clip widens D4σ; this does not count.
    """
    excess = moment_width[0] / clip_widening / fit_width[0] - 1
    if excess < 0 and not is_whole:
        return 0.0
    least = max(SIGNIFICANT_SIGMAS * np.hypot(moment_width[1], fit_width[1]) / fit_width[0], SIGNIFICANT_FRACTION)
    return float(excess) if abs(excess) > least else 0.0


def has_wings(moments: MomentsByCell, widths: ScanWidths, is_clipped: np.ndarray) -> bool:
    """Return whether D4σ of any spot exceeds the fitted width `widths`, so that the light is not Gaussian.

    Spots that are clipped, `is_clipped` over the grid, do not count: a clip widens D4σ.
    """
    for index, spot_moments in moments.items():
        if spot_moments.is_measured and not is_clipped[index]:
            fit_width = 4 * float(widths.mean[index]), 4 * float(widths.mean_stderr[index])
            if compute_width_excess(spot_moments.mean_width, fit_width, is_whole=spot_moments.is_whole) > 0:
                return True
    return False
