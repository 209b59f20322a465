"""M² of a scan along z (ISO 11146-1) from second moments and from Gaussian fits.

A scan is a series of images at several positions along a beam. A caustic is the radius of the beam along z, to which a
hyperbola is fitted. D4σ is the width by second moments: four standard deviations σ.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from spotcheck.fitting.beam_axes import SpotWidths, fit_beam_axes, project_widths
from spotcheck.fitting.caustic import FEWEST_POSITIONS, Caustic, fit_caustic
from spotcheck.fitting.scan_caustic import ESTIMATORS, describe_axis_rotation
from spotcheck.fitting.scan_widths import convert_moments
from spotcheck.quicklook.image_analysis import ImageResult

# Methods of measuring widths.
MOMENTS, FIT = ESTIMATORS["moments"], ESTIMATORS["fit"]


@dataclass(frozen=True, eq=False)
class BeamScan:
    """Caustics of a beam by one method of measuring widths."""

    method: str  # MOMENTS or FIT
    z: np.ndarray  # positions of the images with a usable width and a position [m], shape [image]
    left_out: tuple[str, ...]  # names of the images without a usable width or a position
    reason: str = ""  # why there is no caustic; "" if there is one
    radius: dict[str, np.ndarray] = field(default_factory=dict)  # 1/e² radius [m] by axis, shape [image]
    stderr: dict[str, np.ndarray] = field(default_factory=dict)  # standard error of the radius [m] by axis, [image]
    caustics: dict[str, Caustic] = field(default_factory=dict)  # fitted hyperbola by axis


def fit_scan(images: Sequence[ImageResult], pitch_m: float, wavelength_m: float) -> tuple[BeamScan, ...]:
    """Return the caustics by second moments and by Gaussian fits.

    Parameters
    ----------
    images : results of the images.
    pitch_m : pixel pitch [m].
    wavelength_m : wavelength [m].

    Returns
    -------
    tuple of BeamScan
        One per method, second moments first.
    """
    methods = ((MOMENTS, lambda image: convert_moments(image.moments)), (FIT, _select_fit))
    return tuple(_fit_beam(method, select, images, pitch_m, wavelength_m) for method, select in methods)


def _select_fit(image: ImageResult) -> tuple[float, ...] | None:
    """Return the fields of `SpotWidths` (widths σ [px], direction [deg], their errors) by the Gaussian fit.

    Returns None if the fit is not reliable.
    """
    if not image.has_reliable_fit:
        return None
    values, stderrs = zip(*map(image.fit_value, ("sigma_major", "sigma_minor", "orientation")), strict=True)
    return *values, *stderrs


def _fit_beam(
    method: str, select: Callable, images: Sequence[ImageResult], pitch_m: float, wavelength_m: float
) -> BeamScan:
    """Return the caustics along the axes of the beam, or that of the mean radius if the beam is round.

    `method` is MOMENTS or FIT. `select` returns the fields of `SpotWidths` for an `ImageResult`; None without a width.
    There is no caustic, only a reason, if positions are too few or the axes rotate along the beam.
    """
    widths = [None if image.z_m is None else select(image) for image in images]
    left_out = tuple(image.name for image, values in zip(images, widths, strict=True) if values is None)
    z = np.array([image.z_m for image, values in zip(images, widths, strict=True) if values is not None], float)
    if (count := len(np.unique(z))) < FEWEST_POSITIONS:
        reason = f"widths at {FEWEST_POSITIONS} or more positions are needed; this scan has {count}"
        return BeamScan(method, z, left_out, reason)
    spots = SpotWidths(*np.array([values for values in widths if values is not None], float).T)
    axes = fit_beam_axes(spots)
    if axes.rotated_spot is not None:
        return BeamScan(method, z, left_out, describe_axis_rotation(axes, z))
    if np.isfinite(axes.azimuth_stderr):
        directions = {f"axis at {round(axes.azimuth + turn)}°": axes.azimuth + turn for turn in (0, 90)}
        sigmas = {axis: project_widths(spots, azimuth) for axis, azimuth in directions.items()}
    else:
        mean, stderr_of_mean = (spots.major + spots.minor) / 2, np.hypot(spots.major_stderr, spots.minor_stderr) / 2
        sigmas = {"mean of both axes": (mean, stderr_of_mean)}
    # The 1/e² radius is 2σ.
    radius = {axis: 2 * pitch_m * sigma for axis, (sigma, _) in sigmas.items()}
    stderr = {axis: 2 * pitch_m * sigma_stderr for axis, (_, sigma_stderr) in sigmas.items()}
    caustics = {axis: fit_caustic(z, radius[axis], stderr[axis], wavelength_m=wavelength_m) for axis in sigmas}
    return BeamScan(method, z, left_out, "", radius, stderr, caustics)
