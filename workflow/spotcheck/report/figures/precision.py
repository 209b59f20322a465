"""Precision of a spot fit: Cramér–Rao bound over the exposure, and scatter over repeats in units of the bound.

The scatter is the standard deviation of a fitted parameter over the repeats of a condition. The bound is the smallest
standard deviation that an unbiased estimate from one frame can have. A condition is one value of each dimension of the
grid other than the repeat, such as an angle and an exposure. A source is "measured" or "simulated" frames.
"""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from spotcheck.fitting.precision import pool_ratios, summarize_precision
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

# Parameters of a fit in precision.nc, with their labels; the orientation of a round spot has no meaning.
LABELS = {
    "amplitude": "amplitude",
    "x_centre": "column $x_0$",
    "y_centre": "row $y_0$",
    "sigma_major": "long width",
    "sigma_minor": "short width",
    "offset": "offset",
    "sigma_mean": "mean width $\\bar{\\sigma}$",
}


# Looks of the points of each source.
LOOKS: dict[str, dict[str, Any]] = {
    "measured": {"marker": "o", "linestyle": "none", "color": style.MEASURED, "markerfacecolor": style.MEASURED},
    "simulated": {"marker": "D", "linestyle": "none", "color": style.SIMULATED, "markerfacecolor": "white"},
}


def draw_precision(results: Results) -> style.Drawing:
    """Draw bound and scatter of the width over the exposure (left), and the ratio scatter / bound (right).

    A panel without data is left out. Raises `Unavailable` if this leaves none.
    """
    ds = results.get("precision")
    sources = [source for source in LOOKS if np.isfinite(pool_ratios(ds, source, "sigma_mean")[0])]
    has_bound = "fine_exposure" in ds
    if not has_bound and not sources:
        raise Unavailable(f"{ds.attrs['no_design']}; and no condition has two usable repeats")
    figure = style.new_figure(3.6)
    panels = figure.subplots(1, 2 if has_bound and sources else 1, squeeze=False)[0]
    handles: dict = {}
    if has_bound:
        handles |= _draw_bound(panels[0], results, ds)
    if sources:
        handles |= _draw_ratios(panels[-1], ds, sources)
    style.add_legend(figure, list(handles.values()), list(handles), 4)
    caption = summarize_precision(ds)
    if has_bound:
        caption += (
            " Left: the bound of one frame along the calibrated law, with all five parameters of a round spot unknown,"
            " and noise, rounding and clipping of the sensor; grey bars: the dataset's exposures; points: standard"
            " deviation over the repeats of a condition."
        )
    if sources:
        caption += (
            f" {'Right: s' if has_bound else 'S'}catter over repeats in units of the bound, all conditions together,"
            " with its standard error. If repeats are different sites, the centres include their scatter."
        )
    return style.Drawing(figure, caption)


def _draw_bound(ax: Axes, results: Results, ds: xr.Dataset) -> dict:
    """Draw bound and scatter of the mean width over the exposure; return the artists by name for the legend.

    `ds` is the content of precision.nc. The scatter has a point for each condition.
    """
    factor, unit = style.choose_unit(results.exposures(), "s")
    for exposure in ds["design_exposure"].values * factor:
        ax.axvline(exposure, color="0.85", linewidth=3.0, zorder=0)
    bound = ds["sigma_bound_over_fine_exposure"].values
    handles = {"bound of one frame": ax.plot(ds["fine_exposure"].values * factor, bound, color="black")[0]}
    for source, look in LOOKS.items():
        scatter = ds[f"scatter_{source}"].sel(parameter="sigma_mean")
        if "exposure" not in scatter.coords or not np.isfinite(scatter).any():
            continue
        values = scatter.transpose("exposure", ...).values.reshape(scatter.sizes["exposure"], -1)
        # The conditions of one exposure are 4 % apart on the logarithmic axis, so that they do not hide each other.
        shift = 1.04 ** (np.arange(values.shape[1]) - (values.shape[1] - 1) / 2)
        x = (scatter["exposure"].values[:, None] * factor * shift).ravel()
        handles[source] = ax.plot(x, values.ravel(), markersize=4, **look)[0]
    ax.set(xscale="log", yscale="log", xlabel=style.axis_label("exposure time $t$", unit))
    ax.set_ylabel("standard deviation of $\\bar{\\sigma}$ / px")
    return handles


def _draw_ratios(ax: Axes, ds: xr.Dataset, sources: list[str]) -> dict:
    """Draw the ratio scatter / bound of each parameter, pooled over all conditions, for each of `sources`.

    `ds` is the content of precision.nc. Returns the artists by source for the legend.
    """
    handles = {}
    y = np.arange(len(LABELS))[::-1]
    ax.axvline(1.0, color="black", linewidth=0.9)
    for k, source in enumerate(sources):
        ratio, stderr = np.array([pool_ratios(ds, source, name) for name in LABELS]).T
        y_source = y + 0.12 * (k - (len(sources) - 1) / 2)  # sources beside each other
        handles[source] = ax.errorbar(ratio, y_source, xerr=stderr, capsize=2, markersize=5, **LOOKS[source])
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, 0.5), max(high, 2.0))
    ax.set_yticks(y, list(LABELS.values()))
    ax.set_xlabel("scatter over repeats / bound")
    return handles


FIGURES = (Entry("precision", "How precisely a frame measures", Category.BOUNDS, ("precision",), draw_precision),)
