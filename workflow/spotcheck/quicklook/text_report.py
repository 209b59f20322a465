"""Text of a first look: lines for one image, a table for several, cautions, camera properties and M².

D4σ is the width by second moments, and 4σ that of the Gaussian fit. The area of integration of D4σ is a rectangle
around the spot. A caution is a sentence that says why a number may be wrong. `pitch_m` is the pixel pitch [m], None if
unknown.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.fitting.beam_axes import ROUND_RATIO
from spotcheck.fitting.caustic import describe_impossible_m2
from spotcheck.io.number_text import quantity_text
from spotcheck.quicklook.camera import Camera
from spotcheck.quicklook.image_analysis import GAUSSIAN_CHI2, ImageResult, Widths
from spotcheck.quicklook.scan import BeamScan

if TYPE_CHECKING:
    from spotcheck.quicklook.first_look import Look

# Reduced χ² above which the errors of the fit are at least doubled: the shape of the spot, not noise, dominates them.
SHAPE_CHI2 = 4.0
# Least relative widening of D4σ by a clip that is reported.
LEAST_WIDENING = 1e-3
# Mark of a D4σ whose area of integration extends beyond the frame.
UNCERTAIN = "*"
# Least number of positions of a scan, half of them within the first and half beyond the second distance from the waist
# in Rayleigh lengths (ISO 11146-1).
STANDARD_POSITIONS, NEAR_WAIST, FAR_FROM_WAIST = 10, 1, 2
# Most names that a list spells out, if there are at least two more.
MOST_NAMES = 9
# Space between columns, and characters of a row's name, of an image's name in a table, and of a line.
GAP, NAME_WIDTH, LONGEST_NAME, LINE_WIDTH = "  ", 15, 28, 100
# Heading of the column with the direction of the long axis.
DIRECTION = "long axis [°]"
# An error below this fraction of its value is rounding of the arithmetic.
ARITHMETIC = 1e-9

# Name and text of each row of a list of results.
Rows = list[tuple[str, str]]


class Caution(NamedTuple):
    """A caution about a number."""

    sentence: str  # sentence, which is the same for all images
    value: str = ""  # number or phrase of this image with which the sentence ends; "" if it ends without one


def format_look(look: Look) -> str:
    """Return all results as text: lines of at most `LINE_WIDTH` characters in blocks between blank lines."""
    cameras = [_format_rows(describe_camera(camera, look.cameras)) for camera in look.cameras]
    if len(look.images) == 1:
        image = look.images[0]
        blocks = [[image.name, *_format_rows(describe_image(image, look.pixel_pitch_m)), *cameras[0]]]
    else:
        head, body = build_table(look.images, look.pixel_pitch_m)
        # All columns side by side are wider than a terminal, so that the table is split into two.
        split = head.index(DIRECTION)
        blocks = [
            _align_columns([row[:split] for row in (head, *body)]),
            _align_columns([[row[0], *row[split:]] for row in (head, *body)]),
            *cameras,
            merge_cautions(look.images),
        ]
    blocks += [describe_beams(look), list(look.remarks)]
    return "\n\n".join("\n".join(map(_wrap_line, block)) for block in blocks if block)


def describe_camera(camera: Camera, cameras: Sequence[Camera]) -> Rows:
    """Return the properties of a camera, and the names of its images if `cameras` are several."""
    rows = [("images", _list_names(camera.images))] if len(cameras) > 1 else []
    if camera.gain is None or camera.read_noise is None:
        rows.append(("gain, read noise", f"unknown: {camera.method}"))
    else:
        gain, noise = camera.gain, camera.read_noise
        rows += [
            ("gain", f"{quantity_text(gain.value, gain.stderr, 'DN/e-')}, by {camera.method}"),
            ("read noise", quantity_text(noise.value, noise.stderr, "e-")),
        ]
    level = f"at most {camera.black_level_dn:.4g} DN: the level at the border of the images, which includes stray light"
    return [*rows, ("black level", level)]


def describe_image(image: ImageResult, pitch_m: float | None) -> Rows:
    """Return the results of one image; only that there is no spot if it has no fit."""
    if image.fit is None:
        height, width = image.shape
        rows = [("spot", f"none: nothing stands out of the noise on {width} × {height} px")]
        rows += [("clipped", _count_clipped(image))] if image.clipping.pixels else []
        return [*rows, *(("caution", text) for text in list_cautions(image))]
    moments, highest = image.moments, f"the highest reading is {image.clipping.highest_dn:.5g} DN"
    x, y = _format_value(*image.fit_value("x_centre")), _format_value(*image.fit_value("y_centre"), "px")
    peak, offset = (_format_value(*image.fit_value(name), "DN") for name in ("amplitude", "offset"))
    fit_size = _format_widths(image.fit_widths, pitch_m) + _format_axis(*image.fit_value("orientation"))
    moment_size = "unknown: the error of D4σ exceeds half of its value"
    if moments.is_measured:
        axis = _format_axis(moments.azimuth, moments.azimuth_stderr)
        moment_size = f"D4σ {_format_widths(image.moment_widths, pitch_m)}{axis}"
    clip = _describe_clip(image)
    return [
        ("centre", f"x {x}, y {y}"),
        ("Gaussian fit", f"4σ {fit_size}"),
        ("second moments", moment_size),
        ("peak", f"{peak} above an offset of {offset}; {highest}"),
        ("shape", _describe_shape(image)),
        ("clipped", f"{clip.value}; {clip.sentence}" if clip else f"no; {highest}"),
        *(("caution", text) for text in list_cautions(image)),
    ]


def _describe_shape(image: ImageResult) -> str:
    """Return whether the spot is round and whether it is a Gaussian, for an image with a fit."""
    # ISO 11146-1 defines roundness by second moments. The fit stands in if they are not measured.
    by_moments = image.moments.is_measured
    (major, major_stderr), (minor, minor_stderr) = image.moment_widths if by_moments else image.fit_widths
    ratio = minor / major
    stderr = ratio * math.hypot(minor_stderr / minor, major_stderr / major)
    text = f"short over long {'D4σ' if by_moments else '4σ of the fit'} {_format_value(ratio, stderr)}"
    _, fit_axis_stderr = image.fit_value("orientation")
    # The error of the direction is infinite if the axes do not differ significantly.
    if not math.isfinite(image.moments.azimuth_stderr if by_moments else fit_axis_stderr):
        roundness = f"round within the noise ({text})"
    elif ratio >= ROUND_RATIO:
        roundness = f"round{' by ISO 11146-1' if by_moments else ''} ({text}, {ROUND_RATIO} or more)"
    else:
        roundness = f"elliptical ({text})"
    if not math.isfinite(image.residual_rms):
        return f"{roundness}; the Gaussian fit did not converge"
    residual = f"rms residual {100 * image.residual_rms:.2g} % of the peak"
    if not image.is_noise_known:
        return f"{roundness}; {residual}; the noise is unknown"
    chi2 = math.nan if image.fit is None else float(image.fit.chi2_reduced)
    if chi2 <= GAUSSIAN_CHI2:
        return f"{roundness}; a Gaussian within the noise (reduced χ² {chi2:.3g})"
    return f"{roundness}; not a Gaussian: {residual}, reduced χ² {chi2:.3g}"


def _count_clipped(image: ImageResult) -> str:
    """Return a phrase with the number of clipped pixels and their reading."""
    return f"{image.clipping.pixels} px at {image.clipping.level_dn:.5g} DN"


def _describe_clip(image: ImageResult) -> Caution | None:
    """Return how the fit treats clipped pixels, with their number and effect on D4σ; None if there are none."""
    if not image.clipping.pixels:
        return None
    widening = image.clip_widening - 1
    effect = f", D4σ is about {100 * widening:.2g} % too wide" if widening > LEAST_WIDENING else ""
    sentence = "the fit takes the clip into account" if image.is_noise_known else "the fit leaves these pixels out"
    return Caution(sentence, _count_clipped(image) + effect)


def list_cautions(image: ImageResult) -> list[str]:
    """Return the cautions about one image as sentences."""
    return [f"{caution.sentence} {caution.value}".rstrip() for caution in _find_cautions(image)]


def _find_cautions(image: ImageResult) -> Iterator[Caution]:
    """Yield the cautions about fit, D4σ, their difference and pixels that are left out."""
    moments, fit = image.moments, image.fit
    for reason, count in image.impossible_counts.items():
        yield Caution(f"{reason}; such pixels:", str(count))
    if image.has_swapped_spot:
        yield Caution("a spot appears if high and low bytes are swapped: save the image in the other byte order")
    if fit is not None and not image.has_reliable_fit:
        yield Caution("the fit is not reliable: the image does not constrain it; status", str(fit.status))
    if fit is not None and image.is_noise_known and fit.chi2_reduced > SHAPE_CHI2:
        sentence = (
            "not a Gaussian: the fitted width depends on the weights of pixels, which its error includes; reduced χ²"
        )
        yield Caution(sentence, f"{fit.chi2_reduced:.3g}")
    if moments.is_measured and not moments.is_whole:
        sentence = f"{UNCERTAIN} D4σ is uncertain: its area of integration extends beyond the frame; part inside:"
        yield Caution(sentence, f"{100 * moments.area_fraction:.0f} %")
    if moments.has_lost_light:
        sentence = "D4σ is unknown: a part of the spot was not measured; part of its light on these pixels:"
        yield Caution(sentence, f"{100 * moments.lost_light:.2g} %")
    if moments.is_measured and not moments.has_converged:
        yield Caution("D4σ does not converge: it keeps changing with its area of integration")
    if excess := image.width_excess:
        reason_if_larger = "light in the wings, a second spot or an uneven background: D4σ exceeds 4σ of the fit by"
        reason_if_smaller = "flanks steeper than those of a Gaussian: D4σ is below 4σ of the fit by"
        yield Caution(reason_if_larger if excess > 0 else reason_if_smaller, f"{100 * abs(excess):.2g} %")
    if image.outlier_text:
        yield Caution(image.outlier_text)


def merge_cautions(images: Sequence[ImageResult]) -> list[str]:
    """Return the cautions about several images, each sentence once with the images that it concerns."""
    # Name and value of each image that a sentence concerns.
    concerned_images: dict[str, list[tuple[str, str]]] = {}
    for image in images:
        cautions = [Caution("nothing stands out of the noise")] if image.fit is None else []
        cautions += _find_cautions(image)
        if image.fit is not None and (clip := _describe_clip(image)):
            cautions.append(Caution(f"clipped; {clip.sentence}:", clip.value))
        for caution in cautions:
            concerned_images.setdefault(caution.sentence, []).append((image.name, caution.value))
    lines = []
    for sentence, pairs in concerned_images.items():
        names = _list_names([f"{value} ({name})" if value else name for name, value in pairs])
        lines.append(f"{sentence} {names}" if pairs[0][1] else f"{names}: {sentence}")
    return lines


def build_table(images: Sequence[ImageResult], pitch_m: float | None) -> tuple[list[str], list[list[str]]]:
    """Return the headings and one row per image of a table; widths are in µm if the pixel pitch is known, else in px.

    The column of z is missing if no position is known. Cells without a value are empty; unknown widths are "no value".
    """
    unit, factor = ("px", 1.0) if pitch_m is None else ("µm", 1e6 * pitch_m)
    has_z = any(image.z_m is not None for image in images)
    head = ["image", *(["z [mm]"] if has_z else []), f"D4σ long [{unit}]", "short", f"4σ of fit long [{unit}]",
            "short", DIRECTION, "peak [DN]", "reduced χ²", "clipped [px]"]  # fmt: skip
    body = []
    for image in images:
        # The end of a long name distinguishes the images of a series.
        row = [image.name if len(image.name) <= LONGEST_NAME else f"…{image.name[1 - LONGEST_NAME :]}"]
        if has_z:
            row.append("" if image.z_m is None else f"{1e3 * image.z_m:.6g}")
        mark = UNCERTAIN if image.moments.is_measured and not image.moments.is_whole else ""
        row += [_format_value(factor * width, factor * stderr) + mark for width, stderr in image.moment_widths]
        row += [_format_value(factor * width, factor * stderr) for width, stderr in image.fit_widths]
        if image.fit is None:
            row += ["", "", ""]
        else:
            angle, angle_stderr = image.fit_value("orientation")
            chi2 = float(image.fit.chi2_reduced)
            row += [
                _format_value(angle, angle_stderr) if math.isfinite(angle_stderr) else "round",
                _format_value(*image.fit_value("amplitude")),
                f"{chi2:.3g}" if math.isfinite(chi2) else "",
            ]
        body.append([*row, str(image.clipping.pixels)])
    return head, body


def describe_beams(look: Look) -> list[str]:
    """Return M² by each method as lines, and cautions about it; [] without a scan."""
    return [*(line for scan in look.beams for line in _describe_scan(scan)), *find_scan_cautions(look)]


def _describe_scan(scan: BeamScan) -> list[str]:
    """Return M² and waist by one method, a line per axis, or one line that says why there are none."""
    left_out = f"; left out: {_list_names(scan.left_out)}" if scan.left_out else ""
    if scan.reason:
        return [f"M² by {scan.method}: {scan.reason}{left_out}"]
    lines = []
    for axis, caustic in scan.caustics.items():
        text = "unknown, because the fitted hyperbola has no waist"
        if math.isfinite(caustic.m2):
            text = (
                f"{quantity_text(caustic.m2, caustic.m2_stderr)}, waist w0"
                f" {quantity_text(caustic.waist_radius, caustic.waist_radius_stderr, 'm')} at z"
                f" {quantity_text(caustic.waist_position, caustic.waist_position_stderr, 'm')}, half-angle"
                f" {quantity_text(caustic.divergence, caustic.divergence_stderr, 'rad')}"
            )
        lines.append(f"M² by {scan.method}, {axis}: {text}{left_out}")
    return lines


def find_scan_cautions(look: Look) -> Iterator[str]:
    """Yield cautions about M²: if it is below 1, which one to use, and if positions do not follow ISO 11146-1."""
    if not look.beams:
        return
    pitch, wavelength = f"the pixel pitch ({look.pixel_pitch_m:g} m)", f"the wavelength ({look.wavelength_m:g} m)"
    m2_by_method = (
        {f"{scan.method}, {axis}": (caustic.m2, caustic.m2_stderr) for axis, caustic in scan.caustics.items()}
        for scan in look.beams
    )
    # Both methods have the same pitch, wavelength and positions, so that the first caution is enough.
    remarks = (describe_impossible_m2(m2_by_axis, pitch, wavelength, "z") for m2_by_axis in m2_by_method)
    yield from [remark for remark in remarks if remark][:1]
    if any(image.width_excess > 0 for image in look.images):
        yield (
            "use M² by second moments: fits ignore light outside the Gaussian, which ISO 11146 includes, so their M² is"
            " too small"
        )
    # The standard is about second moments, the first of the beams. One axis will do, as all have the same positions.
    scan = look.beams[0]
    caustic = next(iter(scan.caustics.values()), None)
    if caustic is not None and math.isfinite(caustic.m2):
        # Distances of the different positions from the waist, in Rayleigh lengths.
        distances = [abs(z - caustic.waist_position) / caustic.rayleigh_length for z in set(scan.z.tolist())]
        near = sum(distance < NEAR_WAIST for distance in distances)
        far = sum(distance > FAR_FROM_WAIST for distance in distances)
        if min(near, far) < STANDARD_POSITIONS // 2:
            yield (
                f"ISO 11146-1 asks for {STANDARD_POSITIONS} positions or more, half of them within one Rayleigh length"
                f" of the waist and half beyond two; second moments have {len(distances)} positions, {near} within one"
                f" and {far} beyond two"
            )


def _format_value(value: float, stderr: float, unit: str = "") -> str:
    """Return value ± standard error with a unit; the value alone if its error is that of the arithmetic (no noise)."""
    return quantity_text(value, math.nan if stderr < ARITHMETIC * abs(value) else stderr, unit)


def _format_widths(widths: Widths, pitch_m: float | None) -> str:
    """Return both widths in px, and in µm if the pixel pitch is known."""
    units = [(1.0, "px")] + ([] if pitch_m is None else [(1e6 * pitch_m, "µm")])
    return " = ".join(
        " × ".join(_format_value(factor * width, factor * stderr) for width, stderr in widths) + f" {unit}"
        for factor, unit in units
    )


def _format_axis(angle_deg: float, stderr_deg: float) -> str:
    """Return the direction of the long axis as a phrase; "" if the spot is round (its error is not finite)."""
    return f", long axis at ({_format_value(angle_deg, stderr_deg)})°" if math.isfinite(stderr_deg) else ""


def _format_rows(rows: Rows) -> list[str]:
    """Return rows as lines: the name in a column of `NAME_WIDTH` characters, then the text."""
    return [f"{name:<{NAME_WIDTH}} {text}" for name, text in rows]


def _list_names(names: Sequence[str]) -> str:
    """Return names separated by commas; if there are many, the first `MOST_NAMES` and the number of the others."""
    more = len(names) - MOST_NAMES
    return ", ".join(names) if more <= 1 else f"{', '.join(names[:MOST_NAMES])} and {more} more"


def _align_columns(rows: list[list[str]]) -> list[str]:
    """Return the rows of a table, all of the same length, as lines: the first column aligned left, the others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [GAP.join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]


def _wrap_line(line: str) -> str:
    """Return a line broken to `LINE_WIDTH` characters, with continuations below the text of a row."""
    if len(line) <= LINE_WIDTH:
        return line
    # Only rows of `_format_rows` have two blanks at the end of the column of names.
    indent = " " * (NAME_WIDTH + 1 if line[NAME_WIDTH - 1 : NAME_WIDTH + 1] == "  " else 2)
    # NUL keeps a number together with its error and unit.
    joined = re.sub(r"(?<=[\d±]) (?=[\d±%µmD])", "\0", line)
    wrapped = textwrap.fill(
        joined, LINE_WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return wrapped.replace("\0", " ")
