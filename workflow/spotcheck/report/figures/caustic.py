"""The caustic: beam radii over distance with the hyperbola through them."""

import numpy as np
import xarray as xr

from spotcheck.fitting.caustic import CONDITION, Hyperbola, compute_interval_half_width, select_beam_rows
from spotcheck.io.plus_minus import plus_minus
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results

LOOKS = {
    "x": (style.MEASURED, "o", (0, (5, 2))),
    "y": (style.SIMULATED, "s", (0, (1.2, 1.6))),
    "mean": ("0.1", "D", "solid"),
}


def draw(results: Results) -> style.Drawing:
    """Radii along both axes of the beam, of a round one also their mean, each with its hyperbola; M² above."""
    ds = results.get("caustic")
    factor, unit = style.scale(ds[CONDITION].values, "m")
    radii = ds["beam_radius"].values
    size, size_unit = style.scale(radii[np.isfinite(radii)].min(), "m")
    z = ds[CONDITION].broadcast_like(ds["beam_radius"].isel(axis=0)).values.ravel()
    reach = np.linspace(z.min() - 0.06 * np.ptp(z), z.max() + 0.06 * np.ptp(z), 200)
    figure = style.new(4.3)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    handles, labels = [], []
    round_ = not np.isfinite(float(ds["azimuth_stderr"]))
    names = ["x", "y", "mean"] if round_ else ["x", "y"]
    for name, shift in zip(names, series.offsets(np.unique(z), len(names)), strict=True):
        own = ds.sel(axis=name)
        colour, marker, dashes = LOOKS[name]
        fit = Hyperbola(
            float(own["origin"]),
            own["coefficient"].values,
            own["coefficient_covariance"].values,
            float(own["scatter"]),
            float(own["chi2_reduced"]),
            int(own["degrees_of_freedom"]),
        )
        curve, error = fit.radius(reach)
        error = compute_interval_half_width(error, fit.degrees)
        (line,) = top.plot(reach * factor, curve * size, color=colour, linestyle=dashes)
        if (name == "mean") == round_:
            low, high = (curve - error) * size, (curve + error) * size
            top.fill_between(reach * factor, low, high, color=colour, alpha=0.15, linewidth=0)
        radius = own["beam_radius"].values.ravel()
        spread = np.hypot(own["beam_radius_stderr"].values.ravel(), fit.scatter * radius)
        plain = {"fmt": marker, "color": colour, "markerfacecolor": "white", "markersize": 5, "elinewidth": 1}
        points = top.errorbar(z * factor, radius * size, **plain)
        left = 100 * (radius / fit.radius(z)[0] - 1)
        bottom.errorbar((z + shift) * factor, left, yerr=100 * spread / radius, **plain)
        handles.append((line, points))
        turn = float(ds["azimuth"]) + (90 if name == "y" else 0)
        words = "mean of both" if name == "mean" else f"axis at {turn:.1f}°"
        labels.append(f"{words}\n$M^2$ = {_pm(own, 'm2', 1, '')}")
    bottom.axhline(0, color="0.4", linewidth=0.8)
    bottom.set_xlabel(style.label("distance $z$", unit))
    bottom.set_ylabel("residual / %")
    top.set_ylabel(style.label("beam radius $w$", size_unit))
    top.set_ylim(bottom=0)
    style.legend_above(figure, handles, labels, len(names))
    return style.Drawing(figure, _caption(ds, factor, unit))


def _caption(ds: xr.Dataset, factor: float, unit: str) -> str:
    scatters = " and ".join(f"{100 * float(own['scatter']):.2g} %" for own in select_beam_rows(ds).values())
    azimuth = plus_minus(float(ds["azimuth"]), float(ds["azimuth_stderr"]))
    direction = (
        f"The beam's axes lie at ({azimuth})° and across it, from +x towards +y, in all frames"
        if np.isfinite(float(ds["azimuth_stderr"]))
        else "No frame tells an axis of the beam, so that its widths along x and y are shown"
    )
    kind = (
        "the beam counts as round, since the widths along them differ by less than 13 % in every frame (ISO 11146-1)"
        if ds.attrs["beam"] == "stigmatic"
        else "the beam is simple astigmatic: each axis has its own M², their mean has none"
    )
    text = (
        "1/e² radius of the beam, twice the fitted standard deviation, over the distance, with the hyperbola"
        " w² = a + b z + c z² (ISO 11146-1, with Gaussian widths in the place of second moments; crops centred on the"
        f" light). {direction}; {kind}. Beneath: points less hyperbola, set a little apart. Error bars: standard error"
        f" of the fit and the scatter that brings χ² to 1 per degree of freedom ({scatters} of the radius). Grey: 68 %"
        " interval of the hyperbola."
    )
    return " ".join([text, *(_of_axis(words, own, factor, unit) for words, own in select_beam_rows(ds).items())]) + (
        " The standard asks for ten positions, half of them near the waist and half far."
    )


def _of_axis(words: str, own: xr.Dataset, factor: float, unit: str) -> str:
    """The numbers of one hyperbola."""
    words = words[0].upper() + words[1:]
    if not np.isfinite(float(own["m2"])):
        return f"{words}: the hyperbola has no waist, the points do not hold one."
    near, far, total = (int(own[n]) for n in ("positions_near", "positions_far", "positions"))
    below = (
        " No beam has M² below 1: the fitted Gaussians pass over light in the wings, or the scatter misleads."
        if float(own["m2"] + 3 * own["m2_stderr"]) < 1
        else ""
    )
    return (
        f"{words}: waist w0 = {_pm(own, 'waist_radius', 1e6, 'µm')} at z0 = {_pm(own, 'waist_position', factor, unit)},"
        f" divergence θ = {_pm(own, 'divergence', 1e3, 'mrad')} (half-angle), Rayleigh length"
        f" {_pm(own, 'rayleigh_length', factor, unit)}, M² = {_pm(own, 'm2', 1, '')} (± standard error); {total}"
        f" positions, {near} of them within one Rayleigh length of the waist and {far} beyond two.{below}"
    )


def _pm(own: xr.Dataset, name: str, factor: float, unit: str) -> str:
    """A derived quantity ± its standard error, in the unit that the factor leads to."""
    return plus_minus(float(own[name]) * factor, float(own[f"{name}_stderr"]) * factor, unit)


FIGURES = (Entry("caustic", "Caustic of the beam", Category.BEAM, ("caustic",), draw),)
