"""Pictures of a first look: a spot with its ellipses and profiles, and the radii of a scan with their hyperbolas."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.patches import Ellipse, Rectangle

from spotcheck.fitting.moments import AREA, Moments
from spotcheck.io.plus_minus import plus_minus
from spotcheck.quicklook.scan import Beam
from spotcheck.quicklook.seen import Profile, Seen
from spotcheck.report.figures import style

# Colours on the dark map of an image.
ON_IMAGE = {"moments": "#2FC79A", "fit": "white"}
LOOKS = (("o", "solid"), ("s", (0, (5, 2))))


def spot(one: Seen) -> style.Drawing:
    """The spot with both ellipses, and its profiles along both axes of the fit."""
    assert one.picture is not None and one.fit is not None
    figure = style.new(2.55, 8.6)
    image, *sides = figure.subplots(1, 3, width_ratios=(1.1, 1, 1))
    fit, own, picture = one.fit, one.moments, one.picture
    extent = picture.extent
    # The root shows faint light beside the spot as well.
    norm = PowerNorm(
        0.5, vmin=min(float(fit.offset), np.nextafter(one.highest_dn, -np.inf)), vmax=one.highest_dn, clip=True
    )
    image.imshow(picture.window, cmap=style.IMAGE_MAP, extent=extent, norm=norm)
    image.grid(False)
    handles: list = []
    labels: list[str] = []
    centre, angle = (float(fit.x_centre), float(fit.y_centre)), float(fit.orientation)
    size = 4 * float(fit.sigma_major), 4 * float(fit.sigma_minor)
    line = Ellipse(centre, *size, angle=angle, fill=False, edgecolor=ON_IMAGE["fit"], linestyle=(0, (4, 2)))
    image.add_patch(line)
    if own.is_measured:
        around = Ellipse((own.x, own.y), own.major, own.minor, angle=own.azimuth, fill=False, linewidth=1.3)
        around.set_edgecolor(ON_IMAGE["moments"])
        image.add_patch(around)
        image.add_patch(_area(own))
    image.set(xlim=extent[:2], ylim=extent[2:], xlabel="column / px", ylabel="row / px")
    for ax, profile, words in zip(sides, picture.profiles, ("longer axis", "shorter axis"), strict=True):
        handles, labels = _profile(ax, profile, one)
        ax.set_xlabel(f"along the {words} / px")
    sides[0].set_ylabel("reading / DN")
    style.legend_above(figure, handles, labels, len(handles))
    caption = (
        f"{one.name}. Left: root of the readings, contour at 1/e² of the fitted Gaussian (white, dashed)"
        + (", ellipse of D4σ (green) and the area that its moments are summed over (dotted)" if own.is_measured else "")
        + ". Right: readings through the fitted centre, and the fit."
    )
    return style.Drawing(figure, caption)


def _area(own: Moments) -> Rectangle:
    """The area of integration."""
    corner = own.x - AREA * own.major / 2, own.y - AREA * own.minor / 2
    return Rectangle(
        corner, AREA * own.major, AREA * own.minor, angle=own.azimuth, rotation_point="center", fill=False,
        edgecolor=ON_IMAGE["moments"], linewidth=0.8, linestyle=(0, (1, 2)),
    )  # fmt: skip


def _profile(ax: Axes, profile: Profile, one: Seen) -> tuple[list, list[str]]:
    (dots,) = ax.plot(profile.distance, profile.reading, ".", color=style.MEASURED, markersize=3)
    (line,) = ax.plot(profile.distance, profile.fitted, color=style.SIMULATED)
    handles, labels = [dots, line], ["readings", "Gaussian fit"]
    if one.clipped_px:
        handles.append(ax.axhline(one.stop_dn, color="0.3", linestyle=(0, (1, 1.5)), linewidth=1))
        labels.append("where the image stops")
    ax.set_xlim(profile.distance[0], profile.distance[-1])
    return handles, labels


def caustic(beams: Sequence[Beam]) -> style.Drawing:
    """1/e² radii along z with their hyperbolas, a panel a method."""
    told = [own for own in beams if not own.why_not]
    figure = style.new(3.3, 8.6)
    panels = figure.subplots(1, len(told), sharey=True, sharex=True, squeeze=False)[0]
    for ax, own in zip(panels, told, strict=True):
        reach = np.linspace(own.z.min() - 0.06 * np.ptp(own.z), own.z.max() + 0.06 * np.ptp(own.z), 200)
        for (words, found), colour, (marker, dashes) in zip(
            own.caustics.items(), (style.MEASURED, style.SIMULATED), LOOKS, strict=False
        ):
            error = np.hypot(own.stderr[words], found.scatter * own.radius[words])
            ax.errorbar(
                1e3 * own.z, 1e6 * own.radius[words], yerr=1e6 * error, fmt=marker, color=colour,
                markerfacecolor="white", elinewidth=1,
            )  # fmt: skip
            quality = plus_minus(found.m2, found.m2_stderr) if np.isfinite(found.m2) else "unknown"
            radius, _ = found.radius(reach)
            ax.plot(1e3 * reach, 1e6 * radius, color=colour, linestyle=dashes, label=f"{words}: $M^2$ = {quality}")
        ax.set(xlabel="distance z / mm", title=f"by {own.method}")
        ax.legend(loc="lower center")
    highest = max(float(radius.max()) for own in told for radius in own.radius.values())
    panels[0].set_ylim(0, 1.15e6 * highest)
    panels[0].set_ylabel("1/e² radius, half of D4σ / µm")
    return style.Drawing(
        figure,
        "Radius along z with the hyperbola of ISO 11146-1. Error bars: standard error, and the scatter about the curve"
        " where it is larger. Images whose frame does not hold the area of integration have no part in second moments.",
    )
