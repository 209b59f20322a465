"""Fig. 5: the optical set-up to scale, and numbers that follow from the instrument file.

The drawing is a side view. Its origin is the lens; x is the distance behind it along the optical axis and y the height
above that axis, both in mm.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Ellipse

from spotcheck.model import optics
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

MM = 1e3  # mm / m
# Limits of height / width of the drawing; outside of them its heights are stretched or compressed.
MIN_ASPECT, MAX_ASPECT = 0.28, 0.62
# Size of the drawing: width / (d_w + f), and height / height of the field of view.
RELATIVE_WIDTH, RELATIVE_HEIGHT = 1.24, 1.36
# Height of the lens above the axis, lower limit of the drawing, and height of the laser, each / height of the field of
# view.
RELATIVE_LENS, RELATIVE_BOTTOM, RELATIVE_LASER = 0.15, -0.76, 0.42
# Height of a line of the table [inch].
LINE_HEIGHT = 0.22
BEAM = "#C00000"  # colour of the laser beam
DARK, GREY = "0.15", "0.3"
# Look of thick lines: object plane, sensor and aperture stop.
THICK: dict[str, Any] = {"color": DARK, "solid_capstyle": "butt"}


@dataclass(frozen=True)
class Geometry:
    """Dimensions of the set-up; pairs are (height, width) of the frame."""

    distance: float  # working distance [mm]
    focal: float  # focal length [mm]
    pitch: float  # pixel pitch [mm]
    pixels: tuple[int, int]  # size of a frame [px]
    sensor: tuple[float, float]  # size of the sensor [mm]
    field: tuple[float, float]  # field of view in the object plane [mm]
    f_number: float | None  # f-number; None if unknown

    @property
    def width(self) -> float:
        """Width of the drawing [mm]."""
        return RELATIVE_WIDTH * (self.distance + self.focal)

    @property
    def stretch(self) -> float:
        """Factor on heights that keeps height / width of the drawing within its limits."""
        aspect = RELATIVE_HEIGHT * self.field[0] / self.width
        return float(np.clip(aspect, MIN_ASPECT, MAX_ASPECT) / aspect)


def read_geometry(results: Results) -> Geometry:
    """Return the dimensions of the set-up by the instrument file and the size of the frames in frames.nc.

    Raises `Unavailable` if the instrument file has no focal length, working distance or pixel pitch.
    """
    lens, pitch = results.instrument.optics, results.instrument.sensor.pixel_pitch_m
    focal, distance = lens.focal_length_m, lens.working_distance_m
    if focal is None or distance is None or pitch is None:
        keys = ("optics.focal_length_m", "optics.working_distance_m", "sensor.pixel_pitch_m")
        missing = ", ".join(key for key, value in zip(keys, (focal, distance, pitch), strict=True) if value is None)
        raise Unavailable(f"instrument.yaml does not give {missing}")
    frames = results.get("frames")
    pixels = int(frames["rows"]), int(frames["columns"])
    height, width = (count * pitch for count in pixels)
    return Geometry(
        distance=distance * MM,
        focal=focal * MM,
        pitch=pitch * MM,
        pixels=pixels,
        sensor=(height * MM, width * MM),
        field=(optics.field_of_view(height, focal, distance) * MM, optics.field_of_view(width, focal, distance) * MM),
        f_number=lens.f_number,
    )


def draw_setup(results: Results) -> style.Drawing:
    """Draw object plane, lens and sensor with the chief rays of the field of view, and a table of numbers.

    Raises `Unavailable` if the instrument file does not give the geometry.
    """
    geometry = read_geometry(results)
    rows = list_numbers(results, geometry)
    stretch = geometry.stretch
    # Heights of drawing and table [inch].
    scene_height = style.WIDTH * RELATIVE_HEIGHT * geometry.field[0] * stretch / geometry.width
    heights = scene_height, LINE_HEIGHT * math.ceil(len(rows) / 2)
    figure = style.new_figure(sum(heights) + 0.15)  # with a gap between drawing and table
    upper, lower = figure.subplots(2, 1, height_ratios=heights)
    upper.set_aspect(stretch)
    _draw_scene(upper, geometry, bool(results.instrument.laser.wavelength_m))
    _draw_labels(upper, geometry)
    _draw_table(lower, rows)
    caption = (
        "The set-up seen from the side, with the rays through the middle of the lens that bound the field of view."
        " Lengths are to scale"
        + (f" along the axis, heights {stretch:.2g}-fold" if stretch != 1 else "")
        + (", the opening of the aperture included" if geometry.f_number else "")
        + "; the tilt of the laser, which is mounted beside the camera, is exaggerated. Numbers: thin lens far from its"
        " object (Eq. 1), grain by Eq. 3, depth of focus by Eq. 4 for a blur of one pixel."
    )
    return style.Drawing(figure, caption)


def list_numbers(results: Results, geometry: Geometry) -> list[tuple[str, str]]:
    """Return the rows of the table as (name, value with unit); rows with unknown values are left out."""
    laser, f_number, pixels = results.instrument.laser, geometry.f_number, geometry.pixels
    sensor, field, pitch = geometry.sensor, geometry.field, geometry.pitch / MM  # the pitch in m
    magnification = optics.magnification(geometry.focal, geometry.distance)
    angles = [math.degrees(optics.viewing_angle(side, geometry.distance)) for side in field]
    rows = [
        ("focal length $f$", f"{geometry.focal:.4g} mm"),
        ("working distance $d_w$", f"{geometry.distance:.4g} mm"),
        ("magnification $M = f/d_w$", f"{magnification:.4f}"),
        ("sensor (h × w)", f"{sensor[0]:.3f} × {sensor[1]:.3f} mm"),
        ("", f"{pixels[0]} × {pixels[1]} px of {pitch * 1e6:.4g} µm"),
        ("field of view (h × w)", f"{field[0]:.2f} × {field[1]:.2f} mm"),
        ("viewing angle δ (h × w)", f"{angles[0]:.1f}° × {angles[1]:.2f}°"),
    ]
    if f_number:
        rows.append(("aperture $f_a$", f"{f_number:.4g}"))
        rows.append(("depth of focus", f"{optics.depth_of_focus(pitch, f_number, magnification) * MM:.2f} mm"))
        if laser.wavelength_m:
            grain = optics.speckle_grain(magnification, laser.wavelength_m, f_number)
            rows.append(("speckle grain $\\bar{d}_s$", f"{grain * 1e6:.2f} µm = {grain / pitch:.3f} px"))
    if laser.wavelength_m:
        rows.append(("wavelength $\\lambda_{la}$", f"{laser.wavelength_m * 1e9:.4g} nm"))
    if sigma := results.instrument.laser_sigma_m:
        sigma_px = magnification * sigma / pitch
        rows.append(("laser width $\\sigma_{la}$", f"{sigma * 1e6:.1f} µm = {sigma_px:.2f} px imaged"))
    return rows


def _draw_scene(ax: Axes, geometry: Geometry, has_laser: bool) -> None:
    """Draw axis, chief rays, object plane, lens, sensor, aperture stop, and the laser beam if `has_laser`."""
    distance, focal, width = geometry.distance, geometry.focal, geometry.width
    half_field, half_sensor = geometry.field[0] / 2, geometry.sensor[0] / 2
    ax.set_axis_off()
    ax.plot([-1.04 * distance, 1.15 * focal], [0, 0], color="0.6", linewidth=0.8, linestyle=(0, (9, 3, 2, 3)))
    for sign in (-1, 1):
        heights = [sign * half_field, 0, -sign * half_sensor]
        ax.plot([-distance, 0, focal], heights, color=style.MEASURED, linewidth=1.0)
    ax.plot([-distance] * 2, [-half_field, half_field], linewidth=4, **THICK)
    ax.plot([focal] * 2, [-half_sensor, half_sensor], linewidth=4, **THICK)
    lens = RELATIVE_LENS * geometry.field[0]
    ax.add_patch(Ellipse((0, 0), 0.035 * width, 2.4 * lens, facecolor="#cfe3f2", edgecolor=style.MEASURED, zorder=1))
    if geometry.f_number:
        # Edges of the stop, which leave an opening of f / f_a.
        opening = focal / geometry.f_number
        for sign in (-1, 1):
            ax.plot([0, 0], [sign * opening / 2, sign * 1.35 * lens], linewidth=2, zorder=4, **THICK)
    if has_laser:
        laser_x, laser_y = -0.2 * distance, RELATIVE_LASER * geometry.field[0]
        ax.plot([laser_x, -distance], [laser_y, 0], color=BEAM, linewidth=1.4)
        # The spot on the object plane and its image on the sensor.
        ax.plot(-distance, 0, "o", color=BEAM, markersize=6, zorder=5)
        ax.plot(focal, 0, "o", color=BEAM, markersize=4, zorder=5)
        ax.text(laser_x + 0.01 * width, laser_y, "laser", color=BEAM, va="center")
    spare = width - distance - focal  # margins on the left and on the right
    ax.set_xlim(-distance - 0.55 * spare, focal + 0.45 * spare)
    ax.set_ylim(RELATIVE_BOTTOM * geometry.field[0], (RELATIVE_HEIGHT + RELATIVE_BOTTOM) * geometry.field[0])


def _draw_labels(ax: Axes, geometry: Geometry) -> None:
    """Write the names of the parts, and draw dimension lines and half the viewing angle."""
    distance, focal, width = geometry.distance, geometry.focal, geometry.width
    half_field, half_sensor = geometry.field[0] / 2, geometry.sensor[0] / 2
    arrow = {"arrowstyle": "<->", "color": GREY, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
    y = -1.22 * half_field
    # Lengths below the drawing, heights beside object plane and sensor.
    for start, end, text in ((-distance, 0.0, "$d_w$"), (0.0, focal, "$f$")):
        ax.annotate("", (start, y), (end, y), arrowprops=arrow)
        ax.text((start + end) / 2, y - 0.05 * half_field, text, ha="center", va="top")
    for x, half_height, gap, text, align in (
        (-distance - 0.035 * width, half_field, -0.008 * width, "field of view", "right"),
        (focal + 0.025 * width, half_sensor, 0.01 * width, "sensor", "left"),
    ):
        ax.annotate("", (x, -half_height), (x, half_height), arrowprops=arrow)
        ax.text(x + gap, 0, text, rotation=90, ha=align, va="center")
    ax.text(-distance, 1.06 * half_field, "sample", ha="center", va="bottom")
    ax.text(0, 1.45 * RELATIVE_LENS * geometry.field[0], "lens, aperture", ha="center", va="bottom")
    angle, size = math.degrees(math.atan(half_field / distance)), 1.1 * distance
    ax.add_patch(Arc((0, 0), size, size, theta1=180, theta2=180 + angle, color=GREY, linewidth=0.9))
    ax.text(-0.575 * distance, -0.24 * half_field, "δ/2", ha="right", va="center")


def _draw_table(ax: Axes, rows: list[tuple[str, str]]) -> None:
    """Write the rows (name, value) of the table in two columns."""
    ax.set_axis_off()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    line_count = math.ceil(len(rows) / 2)
    for k, (name, value) in enumerate(rows):
        column, line = divmod(k, line_count)
        y = 1 - (line + 0.5) / line_count
        ax.text(0.52 * column, y, name, va="center", fontsize=8.5)
        ax.text(0.52 * column + 0.235, y, value, va="center", fontsize=8.5)


FIGURES = (Entry("fig05", "Optical set-up", Category.SET_UP, ("frames",), draw_setup, "Fig. 5"),)
