"""The caustic: beam radii over distance with the hyperbola through them."""

import numpy as np
import xarray as xr

from spotcheck.estimate.caustic import CONDITION, Hyperbola, half_width
from spotcheck.estimate.plus_minus import plus_minus
from spotcheck.figures import series, style
from spotcheck.figures.entry import Category, Entry
from spotcheck.figures.results import Results

LOOKS = {
    "major": (style.MEASURED, "o", (0, (5, 2))),
    "minor": (style.SIMULATED, "s", (0, (1.2, 1.6))),
    "mean": ("0.1", "D", "solid"),
}


def draw(results: Results) -> style.Drawing:
    """Radii along the long and the short axis and their mean, each with its hyperbola; waist and M² beside it."""
    ds = results.get("caustic")
    factor, unit = style.scale(ds[CONDITION].values, "m")
    radii = ds["beam_radius"].values
    size, size_unit = style.scale(radii[np.isfinite(radii)].min(), "m")
    z = ds[CONDITION].broadcast_like(ds["beam_radius"].isel(axis=0)).values.ravel()
    reach = np.linspace(z.min() - 0.06 * np.ptp(z), z.max() + 0.06 * np.ptp(z), 200)
    figure = style.new(4.3)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    handles, labels = [], []
    names = [str(name) for name in ds["axis"].values]
    for name, shift in zip(names, series.offsets(np.unique(z), 3), strict=True):
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
        error = half_width(error, fit.degrees)
        (line,) = top.plot(reach * factor, curve * size, color=colour, linestyle=dashes)
        if name == "mean":
            low, high = (curve - error) * size, (curve + error) * size
            top.fill_between(reach * factor, low, high, color=colour, alpha=0.15, linewidth=0)
        radius = own["beam_radius"].values.ravel()
        spread = np.hypot(own["beam_radius_stderr"].values.ravel(), fit.scatter * radius)
        plain = {"fmt": marker, "color": colour, "markerfacecolor": "white", "markersize": 5, "elinewidth": 1}
        points = top.errorbar(z * factor, radius * size, **plain)
        left = 100 * (radius / fit.radius(z)[0] - 1)
        bottom.errorbar((z + shift) * factor, left, yerr=100 * spread / radius, **plain)
        handles.append((line, points))
        labels.append(f"{'mean of both' if name == 'mean' else f'{name} axis'}\n$M^2$ = {_pm(own, 'm2', 1, '')}")
    bottom.axhline(0, color="0.4", linewidth=0.8)
    bottom.set_xlabel(style.label("distance $z$", unit))
    bottom.set_ylabel("residual / %")
    top.set_ylabel(style.label("beam radius $w$", size_unit))
    top.set_ylim(bottom=0)
    style.legend_above(figure, handles, labels, 3)
    return style.Drawing(figure, _caption(ds, factor, unit))


def _caption(ds: xr.Dataset, factor: float, unit: str) -> str:
    own = ds.sel(axis="mean")
    near, far, total = (int(ds[n]) for n in ("positions_near", "positions_far", "positions"))
    scatter = f"{100 * float(own['scatter']):.1f} %"
    text = (
        "1/e² radius of the beam, twice the fitted standard deviation, over the distance, with the hyperbola"
        " w² = a + b z + c z² (ISO 11146-1, with Gaussian widths in the place of second moments; crops centred on the"
        " light). Beneath: points less hyperbola, set a little apart. Error bars: standard error of the fit and the"
        f" scatter that brings χ² to 1 per degree of freedom ({scatter} of the radius for the mean of both axes)."
        " Grey: 68 % interval of the mean's hyperbola. Long and short axis are each frame's own: where an astigmatic"
        " beam is round they change places, and then their own M² means little."
    )
    if not np.isfinite(float(own["m2"])):
        return text + " The hyperbola has no waist: the points do not hold one."
    if float(own["m2"]) < 1:
        text += " No beam has M² below 1: the fitted Gaussians pass over light in the wings, or the scatter misleads."
    return text + (
        f" Mean of both axes: waist w0 = {_pm(own, 'waist_radius', 1e6, 'µm')} at z0 ="
        f" {_pm(own, 'waist_position', factor, unit)}, divergence θ = {_pm(own, 'divergence', 1e3, 'mrad')}"
        f" (half-angle), Rayleigh length {_pm(own, 'rayleigh_length', factor, unit)},"
        f" M² = {_pm(own, 'm2', 1, '')} (± standard error). {total} positions, {near} of them within one Rayleigh"
        f" length of the waist and {far} beyond two; the standard asks for ten, half of them near and half far."
    )


def _pm(own: xr.Dataset, name: str, factor: float, unit: str) -> str:
    """A derived quantity ± its standard error, in the unit that the factor leads to."""
    return plus_minus(float(own[name]) * factor, float(own[f"{name}_stderr"]) * factor, unit)


FIGURES = (Entry("caustic", "Caustic of the beam", Category.BEAM, ("caustic",), draw),)
