"""Fig. 7: the beam propagation parameters p1 and p2 of each fibre orientation.

The width of the spot at the exposure t is p1 ln t + p2 (Eq. 8 of the paper), both in px. A site is a place on the
sample. It has one fibre orientation (angle), one repeat and one value of each declared condition, and frames of all
exposures. calibration.nc has p1 and p2 of each site by several estimators.
"""

import numpy as np
import xarray as xr

from spotcheck.io.number_text import quantity_text
from spotcheck.paper.rivals.summaries import PRINTED_BY_NAME
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results


def draw_parameters(results: Results) -> style.Drawing:
    """Draw p1 (left ordinate) and p2 (right ordinate) by the estimator that the simulation uses.

    The abscissa is the angle, or another dimension if there is a single angle. Raises `Unavailable` if no site has p1
    and p2.
    """
    calibration = results.get("calibration")
    # Name of the estimator that the simulation uses.
    used = str(calibration.attrs["used"])
    ds = calibration.sel(estimator=used)
    # Dimensions of the sites; the exposure is none of them, because p1 and p2 result from a regression over it.
    dims = tuple(map(str, ds["p1"].dims))
    abscissa = next((dim for dim in ("angle", *dims) if ds.sizes[dim] > 1), "repeat")
    pooled_dims = tuple(dim for dim in dims if dim != abscissa)
    axes = series.PlotAxes(abscissa=abscissa, lines=None, pooled=pooled_dims)
    figure = style.new_figure(3.4)
    left = figure.add_subplot()
    right = left.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    handles, labels = [], []
    lines = (style.LineStyle(style.MEASURED, "o"), style.LineStyle(style.SIMULATED, "s"))
    statistics = {name: series.require_values(series.average_frames(ds[name], axes), name) for name in ("p1", "p2")}
    for k, (name, ax, line) in enumerate(zip(statistics, (left, right), lines, strict=True)):
        x = series.set_abscissa(left, ds, axes)
        # Mean and standard deviation of each point of the only line [px].
        mean, sd = statistics[name].mean[0], statistics[name].sd[0]
        offset = series.offset_lines(x, 2)[k]
        handles.append(series.draw_error_bars(ax, x + offset, mean, sd, line, is_filled=k == 0))
        # "p1" with a subscript.
        symbol = f"$p_{name[1]}$"
        # Mean and standard deviation over all sites.
        labels.append(f"{symbol} = {quantity_text(float(ds[f'{name}_mean']), float(ds[f'{name}_sd_all']))} px")
        ax.set_ylabel(f"{symbol} / px", color=line.colour)
        ax.tick_params(axis="y", colors=line.colour)
        if results.has_paper_design():
            printed, printed_sd = PRINTED_BY_NAME[name], PRINTED_BY_NAME[f"{name}_sd"]
            ax.axhspan(printed - printed_sd, printed + printed_sd, facecolor=line.colour, alpha=0.12, zorder=0.5)
    style.add_legend(figure, handles, labels, 2)
    known = calibration["estimator"].values[np.isfinite(calibration["p1_mean"].values)]
    other_texts = [_estimator_text(calibration, str(name)) for name in known if name != used]
    sites = statistics["p1"]
    caption = (
        "Beam propagation parameters p1 and p2 (Eq. 8) of every site, averaged at each"
        f" {style.axis_name(abscissa)}; crops centred on the light."
        # The text counts values, of which each site has one.
        f" {series.frames_text(sites, axes).replace('frames a point', 'sites a point')}"
        " (each site has one fit over all its exposures). Legend: mean ± standard deviation over all"
        f" {int(sites.frames.sum())} sites. Estimator: {calibration.attrs[f'estimator_{used}']} ({used})."
        f" Others: {'; '.join(other_texts)}."
    )
    return style.Drawing(figure, caption)


def _estimator_text(calibration: xr.Dataset, name: str) -> str:
    """Return the meaning of an estimator of calibration.nc, and the means of p1 and p2 over all sites, as text."""
    ds = calibration.sel(estimator=name)
    values = (f"{symbol} = {float(ds[f'{symbol}_mean']):.2f} px" for symbol in ("p1", "p2"))
    return f"{calibration.attrs[f'estimator_{name}']}: {', '.join(values)}"


FIGURES = (
    Entry("fig07", "Beam propagation parameters", Category.CALIBRATION, ("calibration",), draw_parameters, "Fig. 7"),
)
