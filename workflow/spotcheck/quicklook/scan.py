"""M² of the images of a scan along z (ISO 11146-1), by their second moments and by their Gaussian fits."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.beam_axes import SpotWidths, fit_beam_axes, project_widths
from spotcheck.fitting.caustic import FEWEST_POSITIONS, Caustic, describe_axis_rotation, fit_caustic
from spotcheck.quicklook.seen import Seen

METHODS = {"second moments": "second_moments", "Gaussian fit": "gaussian_fit"}


class Beam(NamedTuple):
    """A scan by one method: the name of the method; where the images are [m] and their radii with standard errors [m]
    by axis; the caustics by axis; the reason why there is no caustic (""); and names of the images that are left out,
    because no width or none of the standard's is known there."""

    method: str
    z: np.ndarray
    radius: dict[str, np.ndarray]
    stderr: dict[str, np.ndarray]
    caustics: dict[str, Caustic]
    why_not: str
    left_out: tuple[str, ...]


def beams_of(images: Sequence[Seen], pitch_m: float, wavelength_m: float) -> list[Beam]:
    """The beam by each method."""
    return [_beam(method, widths, images, pitch_m, wavelength_m) for method, widths in WIDTHS.items()]


def _of_moments(one: Seen) -> tuple[float, ...] | None:
    own = one.moments
    if not (own.is_measured and own.is_whole):
        return None
    return own.major / 4, own.minor / 4, own.azimuth, own.major_stderr / 4, own.minor_stderr / 4, own.azimuth_stderr


def _of_fit(one: Seen) -> tuple[float, ...] | None:
    if not one.fitted or one.fit is None:
        return None
    of = ("sigma_major", "sigma_minor", "orientation")
    return tuple(float(getattr(one.fit, f"{name}{suffix}")) for suffix in ("", "_stderr") for name in of)


WIDTHS: dict[str, Callable[[Seen], tuple[float, ...] | None]] = dict(zip(METHODS, (_of_moments, _of_fit), strict=True))


def _beam(method: str, widths: Callable, images: Sequence[Seen], pitch_m: float, wavelength_m: float) -> Beam:
    known = [(one.z_m, own) for one in images if one.z_m is not None and (own := widths(one)) is not None]
    z = np.array([own for own, _ in known], float)
    left_out = tuple(one.name for one in images if one.z_m is None or widths(one) is None)
    if (positions := len(np.unique(z))) < FEWEST_POSITIONS:
        why = f"M² needs widths at {FEWEST_POSITIONS} positions or more, and {positions} have one"
        return Beam(method, z, {}, {}, {}, why, left_out)
    spots = SpotWidths(*np.array([own for _, own in known], float).T)
    axes = fit_beam_axes(spots)
    if axes.rotated_spot is not None:
        return Beam(method, z, {}, {}, {}, describe_axis_rotation(axes, z), left_out)
    if np.isfinite(axes.azimuth_stderr):
        directions = {f"axis at {round(axes.azimuth + turn)}°": axes.azimuth + turn for turn in (0, 90)}
        found = {words: project_widths(spots, azimuth) for words, azimuth in directions.items()}
    else:
        mean = (spots.major + spots.minor) / 2
        found = {"mean of both axes": (mean, np.hypot(spots.major_stderr, spots.minor_stderr) / 2)}
    radius, stderr = ({words: 2 * pitch_m * own[k] for words, own in found.items()} for k in (0, 1))
    caustics = {words: fit_caustic(z, radius[words], stderr[words], wavelength_m=wavelength_m) for words in found}
    return Beam(method, z, radius, stderr, caustics, "", left_out)
