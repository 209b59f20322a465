"""Caustic of the beam: 1/e² radius over distance, with fitted hyperbolas.

The beam has two axes, x and y. They are the principal axes if the frames determine their direction, the azimuth; else
they are the axes of the image. The third one, "mean", is the mean of both. The figure shows the widths by the estimator
that is to be quoted, the first one of caustic.nc.
"""

import numpy as np
import xarray as xr

from spotcheck.fitting.hyperbola import Hyperbola, compute_interval_half_width
from spotcheck.fitting.scan_caustic import CONDITION, FIT, select_beam_axes
from spotcheck.io.number_text import quantity_text
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results

CURVE_POINTS = 200
# The curves extend beyond the outermost points by this fraction of the range of the distances z.
CURVE_MARGIN = 0.06
# (colour, marker, line style) of each axis of the beam.
LOOKS = {
    "x": (style.MEASURED, "o", style.DASHED),
    "y": (style.SIMULATED, "s", (0, (1.2, 1.6))),
    "mean": ("0.1", "D", "solid"),
}


def draw_caustic(results: Results) -> style.Drawing:
    """Draw the radii along the axes of the beam with hyperbolas and residuals.

    The mean of both axes is drawn as well if the frames do not determine the azimuth.
    """
    ds = results.get("caustic").isel(estimator=0)
    z_factor, z_unit = style.choose_unit(ds[CONDITION].values, "m")
    radii = ds["beam_radius"].values
    w_factor, w_unit = style.choose_unit(radii[np.isfinite(radii)].min(), "m")
    z = ds[CONDITION].broadcast_like(ds["beam_radius"].isel(axis=0)).values.ravel()
    margin = CURVE_MARGIN * np.ptp(z)
    curve_z = np.linspace(z.min() - margin, z.max() + margin, CURVE_POINTS)
    figure = style.new_figure(4.3)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    handles, labels = [], []
    has_azimuth = np.isfinite(float(ds["azimuth_stderr"]))
    names = ["x", "y"] if has_azimuth else ["x", "y", "mean"]
    for name, offset in zip(names, series.offset_lines(np.unique(z), len(names)), strict=True):
        beam = ds.sel(axis=name)
        colour, marker, dashes = LOOKS[name]
        hyperbola = _read_hyperbola(beam)
        curve, stderr = hyperbola.radius(curve_z)
        half_interval = compute_interval_half_width(stderr, hyperbola.degrees)
        (line,) = upper.plot(curve_z * z_factor, curve * w_factor, color=colour, linestyle=dashes)
        # Without an azimuth only the mean describes the beam, so that only its interval is shown.
        if has_azimuth or name == "mean":
            low, high = (curve - half_interval) * w_factor, (curve + half_interval) * w_factor
            upper.fill_between(curve_z * z_factor, low, high, color=colour, alpha=0.15, linewidth=0)
        radius = beam["beam_radius"].values.ravel()
        radius_error = np.hypot(beam["beam_radius_stderr"].values.ravel(), hyperbola.scatter * radius)
        look = {"fmt": marker, "color": colour, "markerfacecolor": "white", "markersize": 5, "elinewidth": 1}
        handles.append((line, upper.errorbar(z * z_factor, radius * w_factor, **look)))
        residual = 100 * (radius / hyperbola.radius(z)[0] - 1)
        lower.errorbar((z + offset) * z_factor, residual, yerr=100 * radius_error / radius, **look)
        azimuth = float(ds["azimuth"]) + (90 if name == "y" else 0)
        axis_text = "mean of both" if name == "mean" else f"axis at {azimuth:.1f}°"
        labels.append(f"{axis_text}\n$M^2$ = {_quantity_text(beam, 'm2')}")
    lower.axhline(0, color="0.4", linewidth=0.8)
    lower.set(xlabel=style.axis_label("distance $z$", z_unit), ylabel="residual / %")
    upper.set_ylabel(style.axis_label("beam radius $w$", w_unit))
    upper.set_ylim(bottom=0)
    style.add_legend(figure, handles, labels, len(names))
    return style.Drawing(figure, _write_caption(ds))


def _read_hyperbola(beam: xr.Dataset) -> Hyperbola:
    """Return the fitted hyperbola of one axis of the beam; `beam` is caustic.nc at that axis."""
    return Hyperbola(
        origin=float(beam["origin"]),
        coefficients=beam["coefficient"].values,
        covariance=beam["coefficient_covariance"].values,
        scatter=float(beam["scatter"]),
        chi2_reduced=float(beam["chi2_reduced"]),
        degrees=int(beam["degrees_of_freedom"]),
    )


def _write_caption(ds: xr.Dataset) -> str:
    """Return the caption; `ds` is the content of caustic.nc for the estimator shown."""
    # Part of caustic.nc for each axis by its name as text: both axes if the azimuth is known, else only their mean.
    beam_by_name = select_beam_axes(ds)
    scatters = " and ".join(f"{100 * float(beam['scatter']):.2g} %" for beam in beam_by_name.values())
    azimuth = quantity_text(float(ds["azimuth"]), float(ds["azimuth_stderr"]))
    direction = (
        f"The beam's axes lie at ({azimuth})° and across it, from +x towards +y, in all frames"
        if np.isfinite(float(ds["azimuth_stderr"]))
        else "The frames do not determine the axes of the beam, so that its widths along x and y are shown"
    )
    kind = (
        "the beam counts as round, since the widths along them differ by less than 13 % in every frame (ISO 11146-1)"
        if ds["beam"] == "stigmatic"
        else "the beam is simple astigmatic: each axis has its own M², their mean has none"
    )
    is_fit = str(ds["estimator"].values) == FIT
    widths = "Gaussian widths instead of second moments" if is_fit else "second moments of whole frames"
    text = (
        "1/e² radius of the beam, twice the standard deviation, over the distance, with the hyperbola"
        f" w² = a + b z + c z² (ISO 11146-1, {widths}). {direction}; {kind}. Below: points less hyperbola, shifted"
        " apart for clarity. Error bars: standard error of the width and the scatter that brings χ² to 1 per degree of"
        f" freedom ({scatters} of the radius). Bands: 68 % interval of the hyperbola."
    )
    # Fits alone leave out light.
    cause = "the fitted Gaussians ignore light in the wings, or the radii" if is_fit else "the radii"
    sentences = [_beam_text(name, beam, cause) for name, beam in beam_by_name.items()]
    end = "The standard asks for ten positions, half of them near the waist and half far."
    return " ".join([text, *sentences, end])


def _beam_text(name: str, beam: xr.Dataset, cause: str) -> str:
    """Return the quantities of the beam along one axis as a sentence.

    `name` is that axis as text, and `cause` the subject of a clause on what makes M² too small.
    """
    name = name[0].upper() + name[1:]
    if not np.isfinite(float(beam["m2"])):
        return f"{name}: the fitted hyperbola has no waist; the points do not constrain one."
    near, far, total = (int(beam[key]) for key in ("positions_near", "positions_far", "positions"))
    # The warning needs M² more than three standard errors below 1, which chance alone hardly gives.
    warning = (
        f" M² cannot be below 1: {cause} scatter too much." if float(beam["m2"] + 3 * beam["m2_stderr"]) < 1 else ""
    )
    return (
        f"{name}: waist w0 = {_quantity_text(beam, 'waist_radius', 'm')} at"
        f" z0 = {_quantity_text(beam, 'waist_position', 'm')},"
        f" divergence θ = {_quantity_text(beam, 'divergence', 'rad')} (half-angle), Rayleigh length"
        f" {_quantity_text(beam, 'rayleigh_length', 'm')}, M² = {_quantity_text(beam, 'm2')} (± standard"
        f" error); {total} positions, {near} of them within one Rayleigh length of the waist and {far} beyond two."
        f"{warning}"
    )


def _quantity_text(beam: xr.Dataset, name: str, unit: str = "1") -> str:
    """Return a variable of caustic.nc, stored in `unit`, with its standard error as text."""
    return quantity_text(float(beam[name]), float(beam[f"{name}_stderr"]), unit)


FIGURES = (Entry("caustic", "Caustic of the beam", Category.BEAM, ("caustic",), draw_caustic),)
