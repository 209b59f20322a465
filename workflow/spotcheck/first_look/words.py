"""A first look in words: a sheet for one image, a table for several, what the camera is, and M²."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from spotcheck.estimate.beam_axes import ROUND_RATIO
from spotcheck.estimate.plus_minus import plus_minus
from spotcheck.first_look.scan import Beam
from spotcheck.first_look.seen import Seen

if TYPE_CHECKING:
    from spotcheck.first_look.looking import Look

# A difference is told beyond so many standard errors, of widths beyond this part as well.
BEYOND, PART = 3.0, 0.02
# χ² per degree of freedom up to which the residuals pass for noise: the noise itself is known to some percent.
AS_NOISE = 1.1
# Part of the area of integration that a frame must hold.
WHOLE = 0.98
# White space between columns, and the widest name.
GAP, LONGEST = "  ", 28


def told(look: Look) -> str:
    """All of it as text."""
    lines = []
    if len(look.images) == 1:
        lines += sheet(look.images[0], look.pixel_pitch_m)
        lines += [f"{name:<14} {text}" for name, text in look.cameras[0].lines()]
    else:
        lines += aligned(*table(look.images, look.pixel_pitch_m))
        for own in look.cameras:
            lines += ["", *(f"{name:<16} {text}" for name, text in own.lines())]
        if notes := remarks_of(look.images):
            lines += ["", *notes]
    if look.beams:
        lines += [""] + [line for own in look.beams for line in beam_lines(own)]
    if look.remarks:
        lines += ["", *look.remarks]
    return "\n".join(lines)


def sheet(one: Seen, pitch: float | None) -> list[str]:
    """One image, a line a quantity."""
    return [one.name, *(f"{name:<14} {text}" for name, text in rows(one, pitch))]


def rows(one: Seen, pitch: float | None) -> list[tuple[str, str]]:
    """Name and text of what one image shows."""
    own, fit = one.moments, one.fit
    if fit is None:
        return [("spot", f"none: nothing stands out of the noise on {one.columns} × {one.rows} px")]
    out = [("centre", f"x {plus_minus(fit.x_centre, fit.x_centre_stderr)}, y {plus_minus(fit.y_centre, fit.y_centre_stderr, 'px')}")]
    out.append(("Gaussian fit", f"4σ {_pair(fit_widths(one), pitch)}{_direction(fit.orientation, fit.orientation_stderr)}"))
    moments = f"D4σ {_pair(moment_widths(one), pitch)}{_direction(own.azimuth, own.azimuth_stderr)}"
    out.append(("second moments", moments if own.measured else "no width: their error is as large as they are"))
    out.append(("peak", f"{plus_minus(fit.amplitude, fit.amplitude_stderr, 'DN')} over {plus_minus(fit.offset, fit.offset_stderr, 'DN')}; highest reading {one.peak_dn:.5g} DN"))
    out.append(("shape", "; ".join(shape(one))))
    out.append(("clipped", clipped(one)))
    return out + [("beware", text) for text in beware(one)]


def fit_widths(one: Seen) -> list[tuple[float, float]]:
    """4σ of the fit along both axes with errors [px]."""
    fit = one.fit
    if fit is None:
        return [(math.nan, math.nan)] * 2
    return [(4 * float(fit.sigma_major), 4 * float(fit.sigma_major_stderr)), (4 * float(fit.sigma_minor), 4 * float(fit.sigma_minor_stderr))]


def moment_widths(one: Seen) -> list[tuple[float, float]]:
    """D4σ along both axes with errors [px]; NaN where it was not measured."""
    own = one.moments
    if not own.measured:
        return [(math.nan, math.nan)] * 2
    return [(own.major, own.major_stderr), (own.minor, own.minor_stderr)]


def shape(one: Seen) -> list[str]:
    """What the fit says of the shape."""
    fit = one.fit
    if fit is None:
        return []
    ratio = float(fit.sigma_minor / fit.sigma_major)
    error = ratio * math.hypot(fit.sigma_minor_stderr / fit.sigma_minor, fit.sigma_major_stderr / fit.sigma_major)
    text = f"minor/major {plus_minus(ratio, error)}"
    if not math.isfinite(fit.orientation_stderr):
        out = [f"round within its noise ({text})"]
    elif ratio >= ROUND_RATIO:
        out = [f"round by ISO 11146-1 ({text}, {ROUND_RATIO} or more)"]
    else:
        out = [f"elliptical ({text})"]
    left = f"residuals of {100 * one.misfit:.2g} % of the peak"
    if not one.noise_known:
        out.append(f"{left}, beside a noise that is unknown")
    elif fit.chi2_reduced <= AS_NOISE:
        out.append(f"a Gaussian within its noise (χ² {fit.chi2_reduced:.3g})")
    else:
        out.append(f"no Gaussian within its noise (χ² {fit.chi2_reduced:.3g}): {left}")
    return out + _beside_the_fit(one)


def _beside_the_fit(one: Seen) -> list[str]:
    """What second moments see that the fit passes over."""
    (wide, wide_error), (own, own_error) = (_mean(widths(one)) for widths in (moment_widths, fit_widths))
    excess = wide / own - 1
    if not abs(excess) > max(BEYOND * math.hypot(wide_error, own_error) / own, PART):
        return []
    if excess > 0:
        return [f"D4σ exceeds the fit by {100 * excess:.2g} %: light in the wings, a second spot or an uneven background"]
    return [f"D4σ falls short of the fit by {-100 * excess:.2g} %: flanks steeper than a Gaussian's"]


def _mean(widths: list[tuple[float, float]]) -> tuple[float, float]:
    (a, a_error), (b, b_error) = widths
    return (a + b) / 2, math.hypot(a_error, b_error) / 2


def clipped(one: Seen) -> str:
    """What is clipped, and what that does to the numbers."""
    if not one.clipped_px:
        return f"nothing seen: the highest reading is {one.peak_dn:.5g} DN" + (
            f", and the camera stops at {one.stop_dn:.5g} DN" if math.isfinite(one.stop_dn) else ""
        )
    where = f"{one.clipped_px} px at {one.stop_dn:.5g} DN"
    fit = "the fit allows for it" if one.noise_known else "the fit leaves them out"
    if one.widened < 1.001:
        return f"{where}; {fit}, and D4σ hardly feels it"
    return f"{where}; {fit}, D4σ is too wide by about {100 * (one.widened - 1):.2g} %"


def beware(one: Seen) -> list[str]:
    """What speaks against the numbers of an image."""
    out, own = [], one.moments
    if one.fit is not None and not one.fitted:
        out.append(f"the fit is not to be trusted ({one.fit.status}): the image does not tell a width")
    if own.measured and own.inside < WHOLE:
        out.append(
            f"the frame holds {100 * own.inside:.0f} % of the area that ISO 11146 sums over (3 × D4σ): D4σ hangs on what"
            " lies beyond it"
        )
    if own.measured and not own.settled:
        out.append("D4σ did not settle: it goes on changing with its area of integration")
    if one.left_out:
        out.append(one.left_out)
    return out


def remarks_of(images: tuple[Seen, ...]) -> list[str]:
    """What speaks against the numbers of several images, by name."""
    found: dict[str, list[str]] = {}
    for one in images:
        if one.fit is None:
            found.setdefault("no spot stands out of the noise", []).append(one.name)
        for text in [*beware(one), *([clipped(one)] if one.clipped_px else []), *_beside_the_fit(one)]:
            found.setdefault(text, []).append(one.name)
    return [f"{', '.join(names)}: {text}" for text, names in found.items()]


def table(images: tuple[Seen, ...], pitch: float | None) -> tuple[list[str], list[list[str]]]:
    """Head and rows of several images."""
    unit, factor = ("px", 1.0) if pitch is None else ("µm", 1e6 * pitch)
    with_z = any(one.z_m is not None for one in images)
    head = ["image", *(["z [mm]"] if with_z else []), f"D4σ [{unit}]", "", f"4σ of fit [{unit}]", "", "long axis [°]",
            "peak [DN]", "χ²", "clipped [px]"]  # fmt: skip
    out = []
    for one in images:
        name = one.name if len(one.name) <= LONGEST else f"…{one.name[1 - LONGEST :]}"
        cells = [name] + ([f"{1e3 * one.z_m:.6g}" if one.z_m is not None else ""] if with_z else [])
        for widths in (moment_widths(one), fit_widths(one)):
            cells += [plus_minus(factor * value, factor * error) for value, error in widths]
        if one.fit is None:
            out.append([*cells, "", "", "", ""])
            continue
        angle = plus_minus(one.fit.orientation, one.fit.orientation_stderr) if math.isfinite(one.fit.orientation_stderr) else "round"
        peak, chi2 = plus_minus(one.fit.amplitude, one.fit.amplitude_stderr), float(one.fit.chi2_reduced)
        out.append([*cells, angle, peak, f"{chi2:.3g}" if math.isfinite(chi2) else "", str(one.clipped_px)])
    return head, out


def aligned(head: list[str], body: list[list[str]]) -> list[str]:
    """A table as lines of text."""
    widths = [max(len(row[k]) for row in (head, *body)) for k in range(len(head))]
    return [
        GAP.join(cell.ljust(size) if k == 0 else cell.rjust(size) for k, (cell, size) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in (head, *body)
    ]


def beam_lines(own: Beam) -> list[str]:
    """M² and waist by one method, a line an axis."""
    if own.why_not:
        return [f"by {own.method}: {own.why_not}"]
    out = []
    for words, found in own.caustics.items():
        if not math.isfinite(found.m2):
            out.append(f"by {own.method}, {words}: no waist; the widths do not hold one")
            continue
        out.append(
            f"by {own.method}, {words}: M² {plus_minus(found.m2, found.m2_stderr)}, waist w0"
            f" {plus_minus(1e6 * found.waist_radius, 1e6 * found.waist_radius_stderr, 'µm')} at z"
            f" {plus_minus(1e3 * found.waist_position, 1e3 * found.waist_position_stderr, 'mm')}, half-angle"
            f" {plus_minus(1e3 * found.divergence, 1e3 * found.divergence_stderr, 'mrad')}"
        )
    return out


def _pair(widths: list[tuple[float, float]], pitch: float | None) -> str:
    """Both widths in px, and in µm where the pitch is known."""
    text = " × ".join(plus_minus(value, error) for value, error in widths) + " px"
    if pitch is not None:
        text += " = " + " × ".join(plus_minus(1e6 * pitch * value, 1e6 * pitch * error) for value, error in widths) + " µm"
    return text


def _direction(angle: float, error: float) -> str:
    return f", long axis at ({plus_minus(angle, error)})°" if math.isfinite(error) else ""
