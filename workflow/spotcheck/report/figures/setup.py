"""Fig. 5: the optical set-up to scale, with the numbers that follow from the instrument file."""

import math
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Ellipse

from spotcheck.model import optics
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

MM = 1e3
# Height over width of the drawing; an instrument beyond it has its heights stretched, and the caption says so.
FLATTEST, STEEPEST = 0.28, 0.62
# Width and height of the drawing in units of d_w + f and of the field of view.
ROOM = (1.24, 1.36)
BEAM = "#C00000"


class Geometry(NamedTuple):
    """What the drawing needs, in mm: working distance, focal length, field and sensor (height, width), opening."""

    distance: float
    focal: float
    field: tuple[float, float]
    sensor: tuple[float, float]
    opening: float | None


def draw(results: Results) -> style.Drawing:
    """Object plane, lens and sensor with the chief rays of the field of view, and a table of derived numbers."""
    lens, pitch = results.instrument.optics, results.instrument.sensor.pixel_pitch_m
    focal, distance = lens.focal_length_m, lens.working_distance_m
    given = {
        "optics.focal_length_m": focal,
        "optics.working_distance_m": distance,
        "sensor.pixel_pitch_m": pitch,
    }
    missing = [key for key, value in given.items() if value is None]
    if missing or focal is None or distance is None or pitch is None:
        raise Unavailable(f"instrument.yaml does not give {', '.join(missing)}")
    frames = results.get("frames")
    pixels = int(frames["rows"]), int(frames["columns"])
    sensor = pixels[0] * pitch, pixels[1] * pitch
    field = optics.field_of_view(sensor[0], focal, distance), optics.field_of_view(sensor[1], focal, distance)
    opening = focal / lens.f_number * MM if lens.f_number else None
    drawn = Geometry(
        distance * MM, focal * MM, (field[0] * MM, field[1] * MM), (sensor[0] * MM, sensor[1] * MM), opening
    )
    rows = numbers(results, pixels)
    stretch = enlargement(drawn)
    heights = style.WIDTH * ROOM[1] * drawn.field[0] * stretch / _wide(drawn), 0.22 * -(-len(rows) // 2)
    figure = style.new(sum(heights) + 0.15)
    top, bottom = figure.subplots(2, 1, height_ratios=heights)
    top.set_aspect(stretch)
    _scene(top, drawn, bool(results.instrument.laser.wavelength_m))
    _table(bottom, rows)
    caption = (
        "The set-up seen from the side, with the rays through the middle of the lens that bound the field of view."
        " Lengths are to scale"
        + (f" along the axis, heights {stretch:.2g}-fold" if stretch != 1 else "")
        + (", the opening of the aperture included" if opening else "")
        + "; the laser's tilt is exaggerated, since it stands beside the camera. Numbers: thin lens far from its object"
        " (Eq. 1), grain by Eq. 3, depth of focus by Eq. 4 for a blur of one pixel."
    )
    clause = "The paper rounds M to 0.2 where it prints 10.296 µm for the grain and 1.872 px."
    return style.Drawing(figure, caption + results.beside_paper(clause))


def numbers(results: Results, pixels: tuple[int, int]) -> list[tuple[str, str]]:
    """Rows of the table: what, and its value with unit; a row whose inputs are missing is left out."""
    lens, laser = results.instrument.optics, results.instrument.laser
    focal, distance, pitch = lens.focal_length_m, lens.working_distance_m, results.instrument.sensor.pixel_pitch_m
    assert focal is not None and distance is not None and pitch is not None
    scale = optics.magnification(focal, distance)
    sensor = [n * pitch for n in pixels]
    field = [optics.field_of_view(side, focal, distance) for side in sensor]
    angle = [math.degrees(optics.viewing_angle(side, distance)) for side in field]
    rows = [
        ("focal length $f$", f"{focal * MM:.4g} mm"),
        ("working distance $d_w$", f"{distance * MM:.4g} mm"),
        ("magnification $M = f/d_w$", f"{scale:.4f}"),
        ("sensor (h × w)", f"{sensor[0] * MM:.3f} × {sensor[1] * MM:.3f} mm"),
        ("", f"{pixels[0]} × {pixels[1]} px of {pitch * 1e6:.4g} µm"),
        ("field of view (h × w)", f"{field[0] * MM:.2f} × {field[1] * MM:.2f} mm"),
        ("viewing angle δ (h × w)", f"{angle[0]:.1f}° × {angle[1]:.2f}°"),
    ]
    if lens.f_number:
        rows.append(("aperture $f_a$", f"{lens.f_number:.4g}"))
        depth = optics.depth_of_focus(pitch, lens.f_number, scale)
        rows.append(("depth of focus", f"{depth * MM:.2f} mm"))
        if laser.wavelength_m:
            grain = optics.speckle_grain(scale, laser.wavelength_m, lens.f_number)
            rows.append(("speckle grain $\\bar{d}_s$", f"{grain * 1e6:.2f} µm = {grain / pitch:.3f} px"))
    if laser.wavelength_m:
        rows.append(("wavelength $\\lambda_{la}$", f"{laser.wavelength_m * 1e9:.4g} nm"))
    if results.instrument.laser_sigma_m:
        width = results.instrument.laser_sigma_m
        rows.append(("laser width $\\sigma_{la}$", f"{width * 1e6:.1f} µm = {scale * width / pitch:.2f} px imaged"))
    return rows


def _wide(own: Geometry) -> float:
    """Width of the drawing in mm."""
    return ROOM[0] * (own.distance + own.focal)


def enlargement(own: Geometry) -> float:
    """By how much heights are enlarged so that the drawing is neither a line nor a tower; mostly 1."""
    shape = ROOM[1] * own.field[0] / _wide(own)
    return 1.0 if FLATTEST <= shape <= STEEPEST else float(np.clip(shape, FLATTEST, STEEPEST) / shape)


def _scene(ax: Axes, own: Geometry, laser: bool) -> None:
    """Draw the side view."""
    half_field, half_sensor = own.field[0] / 2, own.sensor[0] / 2
    width = _wide(own)
    ax.set_axis_off()
    ax.plot([-1.04 * own.distance, 1.15 * own.focal], [0, 0], color="0.6", linewidth=0.8, linestyle=(0, (9, 3, 2, 3)))
    for sign in (-1, 1):
        ax.plot(
            [-own.distance, 0, own.focal],
            [sign * half_field, 0, -sign * half_sensor],
            color=style.MEASURED,
            linewidth=1.0,
        )
    ax.plot([-own.distance] * 2, [-half_field, half_field], color="0.15", linewidth=4, solid_capstyle="butt")
    ax.plot([own.focal] * 2, [-half_sensor, half_sensor], color="0.15", linewidth=4, solid_capstyle="butt")
    stop = 0.30 * half_field
    ax.add_patch(Ellipse((0, 0), 0.035 * width, 2.4 * stop, facecolor="#cfe3f2", edgecolor=style.MEASURED, zorder=1))
    if own.opening:
        for sign in (-1, 1):
            ends = [sign * own.opening / 2, sign * 1.35 * stop]
            ax.plot([0, 0], ends, color="0.15", linewidth=2, solid_capstyle="butt", zorder=4)
    if laser:
        start = (-0.2 * own.distance, 0.42 * own.field[0])
        ax.plot([start[0], -own.distance], [start[1], 0], color=BEAM, linewidth=1.4)
        ax.plot(-own.distance, 0, "o", color=BEAM, markersize=6, zorder=5)
        ax.plot(own.focal, 0, "o", color=BEAM, markersize=4, zorder=5)
        ax.text(start[0] + 0.01 * width, start[1], "laser", color=BEAM, va="center")
    _names(ax, own, width, stop)
    spare = width - own.distance - own.focal
    ax.set_xlim(-own.distance - 0.55 * spare, own.focal + 0.45 * spare)
    ax.set_ylim(-0.76 * own.field[0], (ROOM[1] - 0.76) * own.field[0])


def _names(ax: Axes, own: Geometry, width: float, stop: float) -> None:
    """Names of the parts, and the measures."""
    half_field, half_sensor = own.field[0] / 2, own.sensor[0] / 2
    measure = {"arrowstyle": "<->", "color": "0.3", "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
    below = -1.22 * half_field
    for start, end, text in ((-own.distance, 0.0, "$d_w$"), (0.0, own.focal, "$f$")):
        ax.annotate("", (start, below), (end, below), arrowprops=measure)
        ax.text((start + end) / 2, below - 0.05 * half_field, text, ha="center", va="top")
    side = -own.distance - 0.035 * width
    ax.annotate("", (side, -half_field), (side, half_field), arrowprops=measure)
    ax.text(side - 0.008 * width, 0, "field of view", rotation=90, ha="right", va="center")
    side = own.focal + 0.025 * width
    ax.annotate("", (side, -half_sensor), (side, half_sensor), arrowprops=measure)
    ax.text(side + 0.01 * width, 0, "sensor", rotation=90, ha="left", va="center")
    ax.text(-own.distance, 1.06 * half_field, "sample", ha="center", va="bottom")
    ax.text(0, 1.45 * stop, "lens, aperture", ha="center", va="bottom")
    angle = math.degrees(math.atan(half_field / own.distance))
    size = 1.1 * own.distance
    ax.add_patch(Arc((0, 0), size, size, theta1=180, theta2=180 + angle, color="0.3", linewidth=0.9))
    ax.text(-0.575 * own.distance, -0.24 * half_field, "δ/2", ha="right", va="center")


def _table(ax: Axes, rows: list[tuple[str, str]]) -> None:
    ax.set_axis_off()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    each = -(-len(rows) // 2)
    for k, (what, value) in enumerate(rows):
        column, line = divmod(k, each)
        y = 1 - (line + 0.5) / each
        ax.text(0.52 * column, y, what, va="center", fontsize=8.5)
        ax.text(0.52 * column + 0.235, y, value, va="center", fontsize=8.5)


FIGURES = (Entry("fig05", "Optical set-up", Category.SET_UP, ("frames",), draw, "Fig. 5"),)
