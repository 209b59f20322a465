"""Radial profiles of measured and simulated frames, and their difference.

A profile has the mean over each ring of 1 px around the spot's centre. The simulated reading is the mean reading,
without random noise, shifted onto the measured spot. A condition is one exposure with one value of each declared
condition.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from spotcheck.io import store
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import FRAMES, Category, Entry
from spotcheck.report.figures.frame_pairs import FittedSpot, iterate_frames
from spotcheck.report.figures.results import Results, Unavailable

# Largest number of panels, and of panels in a row.
MAX_PANELS, MAX_COLUMNS = 12, 3
# The light ends where all readings, less the lowest one, are below MIN_FRACTION of the highest one. Profiles are shown
# up to RADIUS_FACTOR times that radius.
MIN_FRACTION, RADIUS_FACTOR = 0.01, 1.25
# Smallest radius at which the light ends, before the factor [px].
MIN_RADIUS = 4.0


@dataclass(frozen=True)
class Profile:
    """Profiles of one condition, averaged over its frames; arrays are [ring], NaN if a ring has no usable pixel."""

    radius: np.ndarray  # middle of the ring [px]
    measured: np.ndarray  # measured reading [DN]
    simulated: np.ndarray  # simulated reading [DN]
    residual: np.ndarray  # measured less simulated reading [DN]
    scatter: np.ndarray  # standard deviation of the residual over frames [DN]; NaN for one frame
    frames: int  # number of frames
    name: str  # condition as text; "" if it was not recorded


def average_rings(image: np.ndarray, spot: FittedSpot, count: int) -> np.ndarray:
    """Return the mean [DN] of the pixels in each of `count` rings of 1 px around a spot [ring].

    `image` is [row, column] in DN. NaN pixels are ignored; the mean is NaN if a ring has no other.
    """
    y, x = np.indices(image.shape)
    ring = np.hypot(y - spot.row, x - spot.column).astype(int)
    is_used = np.isfinite(image) & (ring < count)
    pixels = np.bincount(ring[is_used], minlength=count)
    return np.bincount(ring[is_used], image[is_used], minlength=count) / np.where(pixels, pixels, np.nan)


def average_profiles(results: Results) -> list[Profile]:
    """Return the profile of each exposure and declared condition, averaged over angles and repeats.

    Conditions without a usable frame are left out. Raises `Unavailable` if this leaves none.
    """
    crops = results.get("crops")
    dims = [dim for dim in store.grid_dims(crops) if dim == "exposure" or dim not in series.UNITS]
    profiles = []
    for index in series.iterate_places(crops, dims):
        # Measured and predicted profile of each frame [frame][source][ring].
        rings = [
            [average_rings(image, frame.spot, min(predicted.shape) // 2) for image in (frame.image, predicted)]
            for frame, predicted in iterate_frames(results, index)
        ]
        if not rings:
            continue
        measured, simulated = np.array(rings).transpose(1, 0, 2)  # each [frame, ring]
        residual = measured - simulated
        scatter = residual.std(axis=0, ddof=1) if len(rings) > 1 else np.full(residual.shape[1], np.nan)
        radius, name = np.arange(residual.shape[1]) + 0.5, series.condition_text(crops, index)
        mean_measured, mean_simulated, mean_residual = (a.mean(axis=0) for a in (measured, simulated, residual))
        profiles.append(Profile(radius, mean_measured, mean_simulated, mean_residual, scatter, len(rings), name))
    if not profiles:
        raise Unavailable("no frame has a fitted spot")
    return profiles


def draw_profiles(results: Results) -> style.Drawing:
    """Draw the profiles of each condition, and below them the residual with its scatter over frames.

    Raises `Unavailable` if no frame is usable.
    """
    profiles = average_profiles(results)
    profiles = [profiles[k] for k in series.pick_evenly(len(profiles), MAX_PANELS)]
    columns = min(MAX_COLUMNS, len(profiles))
    rows = -(-len(profiles) // columns)  # rounded up
    figure = style.new_figure(0.5 + 2.6 * rows)
    axes = figure.subplots(2 * rows, columns, sharex=True, sharey=False, squeeze=False, height_ratios=(1.6, 1) * rows)
    uppers, lowers = axes[0::2].ravel(), axes[1::2].ravel()
    # Largest reading, and largest absolute residual with its scatter: all panels have the same ordinates.
    highest = max(float(np.nanmax([profile.measured, profile.simulated])) for profile in profiles)
    largest = max(float(np.nanmax(np.abs(p.residual) + np.nan_to_num(p.scatter))) for p in profiles)
    last_radius = _find_last_radius(profiles, highest)
    handles: list = []
    for k, (upper, lower) in enumerate(zip(uppers, lowers, strict=True)):
        if k >= len(profiles):
            upper.set_axis_off()
            lower.set_axis_off()
            continue
        handles = _draw_profile(upper, lower, profiles[k])
        upper.set(ylim=(-0.04 * highest, 1.06 * highest), xlim=(0, last_radius))
        lower.set_ylim(-1.08 * largest, 1.08 * largest)
        is_leftmost, is_lowest = k % columns == 0, k + columns >= len(profiles)
        upper.set_ylabel("reading / DN" if is_leftmost else "")
        lower.set_ylabel("residual / DN" if is_leftmost else "")
        lower.set_xlabel("radius / px" if is_lowest else "")
        # The lowest panels are not all in the last row, which may have gaps.
        upper.tick_params(labelleft=is_leftmost, labelbottom=False)
        lower.tick_params(labelleft=is_leftmost, labelbottom=is_lowest)
    labels = ["measured", "simulated", "measured − simulated", "± 1 sd over frames"][: len(handles)]
    style.add_legend(figure, handles, labels, len(handles))
    counts = [profile.frames for profile in profiles]
    caption = (
        "Mean reading in rings of 1 px around the fitted centre, measured and simulated (the mean image centred on the"
        f" measured centre), light-centred crops, {series.range_text(counts)} frame{'s' if max(counts) > 1 else ''} a"
        " panel; below, measured less simulated."
    )
    if max(counts) > 1:
        caption += " Grey: one standard deviation of the residual over frames, not its standard error."
    return style.Drawing(figure, caption)


def _draw_profile(upper: Axes, lower: Axes, profile: Profile) -> list:
    """Draw a profile in the upper axes and its residual in the lower ones; return the artists for the legend.

    These are measured, simulated and residual, and with two or more frames the band of the scatter.
    """
    (measured,) = upper.plot(profile.radius, profile.measured, color=style.MEASURED)
    (simulated,) = upper.plot(profile.radius, profile.simulated, color=style.SIMULATED, linestyle=style.DASHED)
    (residual,) = lower.plot(profile.radius, profile.residual, color="0.1")
    handles: list = [measured, simulated, residual]
    if profile.frames > 1:
        for ax, centre in ((upper, profile.measured), (lower, profile.residual)):
            low, high = centre - profile.scatter, centre + profile.scatter
            band = ax.fill_between(profile.radius, low, high, color="0.6", alpha=0.5, linewidth=0)
        handles.append(band)
    lower.axhline(0, color="0.4", linewidth=0.8)
    upper.set_title(profile.name, pad=3)
    return handles


def _find_last_radius(profiles: list[Profile], highest: float) -> float:
    """Return the radius [px] up to which profiles are shown; outside of it the light is negligible.

    `highest` is the largest reading of all profiles [DN].
    """
    curves = np.array([curve for profile in profiles for curve in (profile.measured, profile.simulated)])
    # Readings above the lowest one, which has little light.
    is_bright = (curves - np.nanmin(curves, axis=1, keepdims=True) > MIN_FRACTION * highest).any(axis=0)
    last = float(profiles[0].radius[is_bright].max(initial=MIN_RADIUS))
    return min(RADIUS_FACTOR * last, float(profiles[0].radius[-1]))


TITLE = "Radial profiles and their residual"
FIGURES = (Entry("residual-profiles", TITLE, Category.RESIDUALS, FRAMES, draw_profiles),)
