"""A first look in words: a sheet for one image, a table for several, what the camera is, and M²."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.fitting.beam_axes import ROUND_RATIO
from spotcheck.io.plus_minus import plus_minus as exact_plus_minus
from spotcheck.quicklook.camera import Camera
from spotcheck.quicklook.scan import Beam
from spotcheck.quicklook.seen import AS_NOISE, Seen

if TYPE_CHECKING:
    from spotcheck.quicklook.looking import Look

# A difference of widths is told beyond so many standard errors, and beyond this part of them.
BEYOND, PART = 3.0, 0.02
# χ² per degree of freedom from which the light's shape, not noise, sets what a fit finds: errors are doubled there.
NO_GAUSSIAN = 4.0
# The clip is told where it widens D4σ by more than this part.
FELT = 1e-3
# Mark of a D4σ in a table whose area of integration reaches beyond the frame.
UNCERTAIN = "*"
# Positions that ISO 11146-1 asks for.
STANDARD_POSITIONS = 10
# Images that a sentence names one by one.
MOST_NAMES = 9
# White space between columns, width of a sheet's names, and the longest name in a table.
GAP, NAME, LONGEST = "  ", 15, 28
# Characters of a line at most, as terminals show them.
ACROSS = 100
DIRECTION = "long axis [°]"

# An error below this part of its value is that of the computer's arithmetic.
ARITHMETIC = 1e-9

Widths = list[tuple[float, float]]


class Remark(NamedTuple):
    """What speaks against a number: a sentence, and what ends it, which may differ from image to image."""

    sentence: str
    value: str = ""


def plus_minus(value: float, error: float, unit: str = "") -> str:
    """Value ± error; the value alone where the image has no noise."""
    return exact_plus_minus(value, math.nan if error < ARITHMETIC * abs(value) else error, unit)


def told(look: Look) -> str:
    """All of it as text."""
    one = len(look.images) == 1
    if one:
        parts = [sheet(look.images[0], look.pixel_pitch_m)]
    else:
        head, body = table(look.images, look.pixel_pitch_m)
        widths = head.index(DIRECTION)
        # All columns side by side are wider than a terminal.
        parts = [
            aligned(head[:widths], [row[:widths] for row in body]),
            aligned([head[0], *head[widths:]], [[row[0], *row[widths:]] for row in body]),
        ]
    for own in look.cameras:
        camera = [f"{name:<{NAME}} {text}" for name, text in camera_rows(own, look.cameras)]
        if one:
            parts[0] += camera
        else:
            parts.append(camera)
    parts.append([] if one else remarks_of(look.images))
    parts.append(beams(look))
    parts.append(list(look.remarks))
    return "\n\n".join("\n".join(map(wrapped, part)) for part in parts if part)


def wrapped(line: str) -> str:
    """A line that a terminal holds; what follows is set in, below the text where a name stands before it."""
    if len(line) <= ACROSS:
        return line
    inside = " " * (NAME + 1 if line[NAME - 1 : NAME + 1] == "  " else 2)
    # A number stays with its error and its unit.
    whole = re.sub(r"(?<=[\d±]) (?=[\d±%µmD])", "\0", line)
    return textwrap.fill(whole, ACROSS, subsequent_indent=inside, break_long_words=False,
                         break_on_hyphens=False).replace("\0", " ")  # fmt: skip


def camera_rows(own: Camera, every: Sequence[Camera]) -> list[tuple[str, str]]:
    """Name and text of what images tell of a camera, and of several which images are its."""
    return [*([("camera of", listed(own.images))] if len(every) > 1 else []), *own.lines()]


def sheet(one: Seen, pitch: float | None) -> list[str]:
    """One image, a line a quantity."""
    return [one.name, *(f"{name:<{NAME}} {text}" for name, text in rows(one, pitch))]


def rows(one: Seen, pitch: float | None) -> list[tuple[str, str]]:
    """Name and text of what one image shows."""
    own, fit = one.moments, one.fit
    if fit is None:
        none = [("spot", f"none: nothing stands out of the noise on {one.columns} × {one.rows} px")]
        return none + ([("clipped", f"{one.clipped_px} px at {one.stop_dn:.5g} DN")] if one.clipped_px else [])
    x, y = plus_minus(*one.fitted_to("x_centre")), plus_minus(*one.fitted_to("y_centre"), "px")
    peak, offset = (plus_minus(*one.fitted_to(name), "DN") for name in ("amplitude", "offset"))
    moments = f"D4σ {_pair(moment_widths(one), pitch)}{_direction(own.azimuth, own.azimuth_stderr)}"
    return [
        ("centre", f"x {x}, y {y}"),
        ("Gaussian fit", f"4σ {_pair(fit_widths(one), pitch)}{_direction(*one.fitted_to('orientation'))}"),
        ("second moments", moments if own.is_measured else "no width: its error is as large as it is"),
        ("peak", f"{peak} over {offset}; highest reading {one.highest_dn:.5g} DN"),
        ("shape", "; ".join(shape(one))),
        ("clipped", f"{clip.value}; {clip.sentence}" if (clip := clipped(one)) else _unclipped(one)),
        *(("beware", said(remark)) for remark in beware(one)),
    ]


def fit_widths(one: Seen) -> Widths:
    """4σ of the fit along the longer and the shorter axis with errors [px]; NaN where there is none."""
    known = [one.fitted_to(name) for name in ("sigma_major", "sigma_minor")]
    return [(4 * value, 4 * error) for value, error in known]


def moment_widths(one: Seen) -> Widths:
    """D4σ along the longer and the shorter axis with errors [px]; NaN where it was not measured."""
    own = one.moments
    if not own.is_measured:
        return [(math.nan, math.nan)] * 2
    return [(own.major, own.major_stderr), (own.minor, own.minor_stderr)]


def shape(one: Seen) -> list[str]:
    """What the fit says of the shape."""
    fit = one.fit
    if fit is None:
        return []
    # ISO 11146-1 judges by second moments; without them the fit has to do.
    by_moments = one.moments.is_measured
    (major, major_error), (minor, minor_error) = moment_widths(one) if by_moments else fit_widths(one)
    ratio = minor / major
    error = ratio * math.hypot(minor_error / minor, major_error / major)
    text = f"shorter over longer {'D4σ' if by_moments else '4σ of the fit'} {plus_minus(ratio, error)}"
    if not math.isfinite(one.moments.azimuth_stderr if by_moments else fit.orientation_stderr):
        out = [f"round within its noise ({text})"]
    elif ratio >= ROUND_RATIO:
        out = [f"round{' by ISO 11146-1' if by_moments else ''} ({text}, {ROUND_RATIO} or more)"]
    else:
        out = [f"elliptical ({text})"]
    left = f"residuals of {100 * one.misfit:.2g} % of the peak"
    if not one.noise_known:
        return [*out, f"{left}, beside a noise that is unknown"]
    if fit.chi2_reduced <= AS_NOISE:
        return [*out, f"a Gaussian within its noise (χ² {fit.chi2_reduced:.3g})"]
    return [*out, f"not quite a Gaussian: {left}, χ² {fit.chi2_reduced:.3g}"]


def clipped(one: Seen) -> Remark | None:
    """What is clipped, and what that does to the numbers; None where nothing is seen to be."""
    if not one.clipped_px:
        return None
    felt = f", D4σ is about {100 * (one.widened - 1):.2g} % too wide" if one.widened > 1 + FELT else ""
    fit = "the fit allows for it" if one.noise_known else "the fit leaves these pixels out"
    return Remark(fit, f"{one.clipped_px} px at {one.stop_dn:.5g} DN{felt}")


def _unclipped(one: Seen) -> str:
    return f"nothing seen: the highest reading is {one.highest_dn:.5g} DN"


def beware(one: Seen) -> list[Remark]:
    """What speaks against the numbers of an image."""
    out, own = [], one.moments
    if one.fit is not None and not one.fitted:
        out.append(Remark("the fit is not to be trusted, as the image does not tell a width", str(one.fit.status)))
    if one.fit is not None and one.noise_known and one.fit.chi2_reduced > NO_GAUSSIAN:
        why = "no Gaussian, so that the fit's width depends on how it weighs pixels, which its error holds; χ²"
        out.append(Remark(why, f"{one.fit.chi2_reduced:.3g}"))
    if own.is_measured and not own.is_whole:
        why = f"{UNCERTAIN} D4σ is uncertain, as its area of integration reaches beyond the frame; part inside:"
        out.append(Remark(why, f"{100 * own.area_fraction:.0f} %"))
    if own.is_measured and not own.has_converged:
        out.append(Remark("D4σ does not settle: it goes on changing with its area of integration"))
    if (excess := _excess(one)) > 0:
        why = "light in the wings, a second spot or an uneven background"
        out.append(Remark(f"{why}: D4σ exceeds the fit by", f"{100 * excess:.2g} %"))
    elif excess < 0:
        out.append(Remark("flanks steeper than a Gaussian's: D4σ falls short of the fit by", f"{-100 * excess:.2g} %"))
    if one.left_out:
        out.append(Remark(one.left_out))
    return out


def _excess(one: Seen) -> float:
    """By which part D4σ differs from 4σ of the fit; 0 within the errors or where one is unknown."""
    means = []
    for (a, a_error), (b, b_error) in (moment_widths(one), fit_widths(one)):
        means.append(((a + b) / 2, math.hypot(a_error, b_error) / 2))
    (wide, wide_error), (own, own_error) = means
    excess = wide / one.widened / own - 1
    if excess < 0 and not one.moments.is_whole:
        return 0.0
    return excess if abs(excess) > max(BEYOND * math.hypot(wide_error, own_error) / own, PART) else 0.0


def remarks_of(images: Sequence[Seen]) -> list[str]:
    """What speaks against the numbers of several images: each sentence once, with the images that it is for."""
    found: dict[str, list[tuple[str, str]]] = {}
    for one in images:
        for remark in _remarks(one):
            found.setdefault(remark.sentence, []).append((one.name, remark.value))
    out = []
    for sentence, whose in found.items():
        names = listed([f"{value} ({name})" if value else name for name, value in whose])
        out.append(f"{sentence} {names}" if whose[0][1] else f"{names}: {sentence}")
    return out


def _remarks(one: Seen) -> Iterator[Remark]:
    if one.fit is None:
        yield Remark("nothing stands out of the noise")
        return
    yield from beware(one)
    if clip := clipped(one):
        yield Remark(f"clipped; {clip.sentence}:", clip.value)


def table(images: Sequence[Seen], pitch: float | None) -> tuple[list[str], list[list[str]]]:
    """Head and rows of several images."""
    unit, factor = ("px", 1.0) if pitch is None else ("µm", 1e6 * pitch)
    with_z = any(one.z_m is not None for one in images)
    head = ["image", *(["z [mm]"] if with_z else []), f"D4σ long [{unit}]", "short", f"4σ of fit long [{unit}]",
            "short", DIRECTION, "peak [DN]", "reduced χ²", "clipped [px]"]  # fmt: skip
    body = []
    for one in images:
        row = [one.name if len(one.name) <= LONGEST else f"…{one.name[1 - LONGEST :]}"]
        row += ["" if one.z_m is None else f"{1e3 * one.z_m:.6g}"] if with_z else []
        beyond = UNCERTAIN if one.moments.is_measured and not one.moments.is_whole else ""
        for widths, mark in ((moment_widths(one), beyond), (fit_widths(one), "")):
            row += [plus_minus(factor * value, factor * error) + mark for value, error in widths]
        body.append(row + _of_fit(one))
    return head, body


def _of_fit(one: Seen) -> list[str]:
    """Direction, peak, χ² and clip as a table has them."""
    if one.fit is None:
        return ["", "", "", ""]
    angle, error = one.fitted_to("orientation")
    direction = plus_minus(angle, error) if math.isfinite(error) else "round"
    chi2 = float(one.fit.chi2_reduced)
    peak = plus_minus(*one.fitted_to("amplitude"))
    return [direction, peak, f"{chi2:.3g}" if math.isfinite(chi2) else "", str(one.clipped_px)]


def aligned(head: list[str], body: list[list[str]]) -> list[str]:
    """A table as lines of text."""
    sizes = [max(len(row[k]) for row in (head, *body)) for k in range(len(head))]
    return [GAP.join([row[0].ljust(sizes[0]), *map(str.rjust, row[1:], sizes[1:])]).rstrip() for row in (head, *body)]


def beams(look: Look) -> list[str]:
    """M² by each method, and what speaks against it."""
    return [*(line for own in look.beams for line in beam_lines(own)), *on_beams(look)]


def on_beams(look: Look) -> list[str]:
    """Which M² to take where the light has wings, and whether the scan is one of the standard."""
    out = []
    if look.beams and any(_excess(one) > 0 for one in look.images):
        out.append(
            "take M² by second moments: fits pass over light beside the Gaussian, which M² after ISO 11146 counts, so"
            " that theirs is too small"
        )
    # The standard is on second moments, which come first; all axes have the same positions.
    for own in look.beams[:1]:
        found = next(iter(own.caustics.values()), None)
        if found is None or not math.isfinite(found.m2):
            continue
        away = [abs(z - found.waist_position) / found.rayleigh_length for z in set(own.z.tolist())]
        near, far = sum(part < 1 for part in away), sum(part > 2 for part in away)
        if min(near, far) < STANDARD_POSITIONS // 2:
            out.append(
                f"ISO 11146-1 asks for {STANDARD_POSITIONS} positions or more, half of them within one Rayleigh length"
                f" of the waist and half beyond two; by second moments here are {len(away)}, {near} and {far}"
            )
    return out


def beam_lines(own: Beam) -> list[str]:
    """M² and waist by one method, a line an axis, and which images had no part in it."""
    without = f"; left out: {listed(own.left_out)}" if own.left_out else ""
    if own.why_not:
        return [f"M² by {own.method}: {own.why_not}{without}"]
    out = []
    for words, found in own.caustics.items():
        if not math.isfinite(found.m2):
            out.append(f"M² by {own.method}, {words}: unknown, the widths hold no waist{without}")
            continue
        out.append(
            f"M² by {own.method}, {words}: {plus_minus(found.m2, found.m2_stderr)}, waist w0"
            f" {plus_minus(1e6 * found.waist_radius, 1e6 * found.waist_radius_stderr, 'µm')} at z"
            f" {plus_minus(1e3 * found.waist_position, 1e3 * found.waist_position_stderr, 'mm')}, half-angle"
            f" {plus_minus(1e3 * found.divergence, 1e3 * found.divergence_stderr, 'mrad')}{without}"
        )
    return out


def listed(names: Sequence[str]) -> str:
    """Names between commas, of many the first ones and how many more there are."""
    more = len(names) - MOST_NAMES
    return ", ".join(names) if more <= 1 else f"{', '.join(names[:MOST_NAMES])} and {more} more"


def said(remark: Remark) -> str:
    """A remark on one image as a line."""
    return f"{remark.sentence} {remark.value}".rstrip()


def _pair(widths: Widths, pitch: float | None) -> str:
    """Both widths in px, and in µm where the pitch is known."""
    units = [(1.0, "px")] + ([] if pitch is None else [(1e6 * pitch, "µm")])
    return " = ".join(
        " × ".join(plus_minus(factor * value, factor * error) for value, error in widths) + f" {unit}"
        for factor, unit in units
    )


def _direction(angle: float, error: float) -> str:
    return f", long axis at ({plus_minus(angle, error)})°" if math.isfinite(error) else ""
