"""Pictures of a first look: a spot with its ellipses and profiles, and the caustics of a scan.

A caustic is the 1/e² radius of a beam along z, to which a hyperbola is fitted. D4σ is the width by second moments; its
area of integration is a rectangle around the spot.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.patches import Ellipse, Rectangle

from spotcheck.fitting.moments import AREA, Moments
from spotcheck.io.number_text import quantity_text
from spotcheck.quicklook.image_analysis import ImageResult, Profile
from spotcheck.quicklook.scan import BeamScan
from spotcheck.report.figures import style

# Colours that stand out on the dark map of an image.
MOMENTS_COLOUR, FIT_COLOUR = "#2FC79A", "white"
# Dashes of the contour of the fit, the area of integration and the clip level: offset, and lengths of line and gap.
DASHED, DOTTED, CLIP_DOTTED = (0, (4, 2)), (0, (1, 2)), (0, (1, 1.5))
# Colour, marker and dashes of the first and the second axis of a beam.
AXIS_STYLES = ((style.MEASURED, "o", "solid"), (style.SIMULATED, "s", (0, (5, 2))))
# Margin beside the outermost positions of a caustic, as a fraction of their range; and points of its curve.
CAUSTIC_MARGIN, CURVE_POINTS = 0.06, 200


def draw_spot(image: ImageResult) -> style.Drawing:
    """Draw the spot with the contours of fit and moments, and its profiles along both axes of the fit.

    Parameters
    ----------
    image : results of an image with a fitted spot.

    Returns
    -------
    Drawing
        The figure and its caption.
    """
    assert image.picture is not None and image.fit is not None
    fit, moments, picture = image.fit, image.moments, image.picture
    figure = style.new_figure(2.55, 8.6)
    map_axes, *profile_axes = figure.subplots(1, 3, width_ratios=(1.1, 1, 1))
    highest = image.clipping.highest_dn
    # The square root makes faint light beside the spot visible. The range must not be empty.
    norm = PowerNorm(0.5, vmin=min(float(fit.offset), np.nextafter(highest, -np.inf)), vmax=highest, clip=True)
    map_axes.imshow(picture.window, cmap=style.IMAGE_MAP, extent=picture.extent, norm=norm)
    map_axes.grid(False)
    centre, size = (float(fit.x_centre), float(fit.y_centre)), (4 * float(fit.sigma_major), 4 * float(fit.sigma_minor))
    contour = Ellipse(centre, *size, angle=float(fit.orientation), fill=False, edgecolor=FIT_COLOUR, linestyle=DASHED)
    map_axes.add_patch(contour)
    if moments.is_measured:
        _draw_moments(map_axes, moments)
    map_axes.set(xlim=picture.extent[:2], ylim=picture.extent[2:], xlabel="column / px", ylabel="row / px")
    for axes, profile, axis in zip(profile_axes, picture.profiles, ("longer axis", "shorter axis"), strict=True):
        _draw_profile(axes, profile, image)
        axes.set_xlabel(f"along the {axis} / px")
    profile_axes[0].set_ylabel("reading / DN")
    handles, labels = profile_axes[0].get_legend_handles_labels()
    style.add_legend(figure, handles, labels, len(handles))
    caption = (
        f"{image.name}. Left: root of the readings, contour at 1/e² of the fitted Gaussian (white, dashed)"
        + (", ellipse of D4σ (green) and its area of integration (dotted)" if moments.is_measured else "")
        + ". Right: readings through the fitted centre, and the fit."
    )
    return style.Drawing(figure, caption)


def _draw_moments(axes: Axes, moments: Moments) -> None:
    """Draw the ellipse of D4σ and its area of integration into a map with axes in px."""
    outline: dict[str, Any] = {"angle": moments.azimuth, "fill": False, "edgecolor": MOMENTS_COLOUR}
    axes.add_patch(Ellipse((moments.x, moments.y), moments.major, moments.minor, linewidth=1.3, **outline))
    width, height = AREA * moments.major, AREA * moments.minor
    corner = moments.x - width / 2, moments.y - height / 2
    outline |= {"rotation_point": "center", "linewidth": 0.8, "linestyle": DOTTED}
    axes.add_patch(Rectangle(corner, width, height, **outline))


def _draw_profile(axes: Axes, profile: Profile, image: ImageResult) -> None:
    """Draw the readings and the fit along one axis, and the clip level if the image is clipped."""
    axes.plot(profile.distance, profile.reading, ".", color=style.MEASURED, markersize=3, label="readings")
    axes.plot(profile.distance, profile.fitted, color=style.SIMULATED, label="Gaussian fit")
    if image.clipping.pixels:
        level = image.clipping.level_dn
        axes.axhline(level, color="0.3", linestyle=CLIP_DOTTED, linewidth=1, label="clip level")
    axes.set_xlim(profile.distance[0], profile.distance[-1])


def draw_caustics(scans: Sequence[BeamScan]) -> style.Drawing:
    """Draw the 1/e² radii along z with their hyperbolas, one panel per method that has caustics.

    Parameters
    ----------
    scans : scans by each method; at least one has caustics.

    Returns
    -------
    Drawing
        The figure and its caption.
    """
    scans = [scan for scan in scans if not scan.reason]
    figure = style.new_figure(3.3, 8.6)
    panels = figure.subplots(1, len(scans), sharey=True, sharex=True, squeeze=False)[0]
    for axes, scan in zip(panels, scans, strict=True):
        margin = CAUSTIC_MARGIN * np.ptp(scan.z)
        z = np.linspace(scan.z.min() - margin, scan.z.max() + margin, CURVE_POINTS)
        for (axis, caustic), (colour, marker, dashes) in zip(scan.caustics.items(), AXIS_STYLES, strict=False):
            radius = scan.radius[axis]
            axes.errorbar(
                1e3 * scan.z, 1e6 * radius, yerr=1e6 * np.hypot(scan.stderr[axis], caustic.scatter * radius),
                fmt=marker, color=colour, markerfacecolor="white", elinewidth=1,
            )  # fmt: skip
            m2 = quantity_text(caustic.m2, caustic.m2_stderr) if np.isfinite(caustic.m2) else "unknown"
            curve, _ = caustic.radius(z)
            axes.plot(1e3 * z, 1e6 * curve, color=colour, linestyle=dashes, label=f"{axis}: $M^2$ = {m2}")
        axes.set(xlabel="distance z / mm", title=f"by {scan.method}")
        axes.legend(loc="lower center")
    largest = max(float(radius.max()) for scan in scans for radius in scan.radius.values())
    panels[0].set_ylim(0, 1.15e6 * largest)
    panels[0].set_ylabel("1/e² radius, half of D4σ / µm")
    return style.Drawing(
        figure,
        "Radius along z with the hyperbola of ISO 11146-1. Error bars: standard error, or the scatter about the curve"
        " if that is larger. Second moments leave out images whose area of integration extends beyond the frame.",
    )
