"""How precisely the rig measures: the bound over exposure, and scatter over repeats in units of the bound."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from spotcheck.fitting.precision import SCATTERED, pool_ratios, summarize_precision
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

LABELS = {
    "amplitude": "amplitude",
    "x_centre": "column $x_0$",
    "y_centre": "row $y_0$",
    "sigma_major": "long width",
    "sigma_minor": "short width",
    "offset": "offset",
    "sigma_mean": "mean width $\\bar{\\sigma}$",
}
LOOKS = {"measured": (style.MEASURED, "o", True), "simulated": (style.SIMULATED, "D", False)}


def draw(results: Results) -> style.Drawing:
    """Left: standard deviation of the width from one frame, bound and scatter; right: scatter over bound."""
    ds = results.get("precision")
    scattered = [s for s in LOOKS if np.isfinite(pool_ratios(ds, s, "sigma_mean")[0])]
    design = "fine_exposure" in ds
    if not design and not scattered:
        raise Unavailable(f"{ds.attrs['no_design']}; and no condition has two usable repeats")
    figure = style.new(3.6)
    panels = figure.subplots(1, 2 if design and scattered else 1, squeeze=False)[0]
    handles: dict = {}
    if design:
        handles |= _over_exposure(panels[0], results, ds)
    if scattered:
        handles |= _ratios(panels[-1], ds, scattered)
    style.legend_above(figure, list(handles.values()), list(handles), 4)
    caption = summarize_precision(ds)
    if design:
        caption += " Left: the bound of one frame along the calibrated law, all five numbers of a round spot unknown,"
        caption += " noise, rounding and clips as the sensor has them; grey bars: the dataset's exposures; points:"
        caption += " standard deviation over the repeats of a condition."
    if scattered:
        caption += (
            f" {'Right: s' if design else 'S'}catter over repeats in units of the bound, all conditions together,"
        )
        caption += " with its standard error. Where repeats are other sites, centres scatter with them."
    return style.Drawing(figure, caption)


def _over_exposure(ax: Axes, results: Results, ds: xr.Dataset) -> dict:
    factor, unit = style.scale(results.exposures(), "s")
    for t in ds["design_exposure"].values * factor:
        ax.axvline(t, color="0.85", linewidth=3.0, zorder=0)
    handles = {
        "bound of one frame": ax.plot(
            ds["fine_exposure"].values * factor, ds["sigma_bound_over_fine_exposure"].values, color="black"
        )[0]
    }
    for source, (colour, marker, filled) in LOOKS.items():
        scatter = ds[f"scatter_{source}"].sel(parameter="sigma_mean")
        if "exposure" not in scatter.coords or not np.isfinite(scatter).any():
            continue
        values = scatter.transpose("exposure", ...).values.reshape(scatter.sizes["exposure"], -1)
        # Side by side, so that the conditions of one exposure do not hide each other.
        shift = 1.04 ** (np.arange(values.shape[1]) - (values.shape[1] - 1) / 2)
        x = scatter["exposure"].values[:, None] * factor * shift
        handles[source] = ax.plot(
            x.ravel(),
            values.ravel(),
            marker,
            color=colour,
            markerfacecolor=colour if filled else "white",
            markersize=4,
        )[0]
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(style.label("exposure time $t$", unit))
    ax.set_ylabel("standard deviation of $\\bar{\\sigma}$ / px")
    return handles


def _ratios(ax: Axes, ds: xr.Dataset, sources: list[str]) -> dict:
    handles = {}
    y = np.arange(len(SCATTERED))[::-1]
    ax.axvline(1.0, color="black", linewidth=0.9)
    for k, source in enumerate(sources):
        colour, marker, filled = LOOKS[source]
        ratio, error = np.array([pool_ratios(ds, source, name) for name in SCATTERED]).T
        handles[source] = ax.errorbar(
            ratio,
            y + 0.12 * (k - (len(sources) - 1) / 2),
            xerr=error,
            fmt=marker,
            color=colour,
            markerfacecolor=colour if filled else "white",
            markersize=5,
            capsize=2,
        )
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, 0.5), max(high, 2.0))
    ax.set_yticks(y, [LABELS[name] for name in SCATTERED])
    ax.set_xlabel("scatter over repeats / bound")
    return handles


FIGURES = (Entry("precision", "How precisely a frame measures", Category.BOUNDS, ("precision",), draw),)
