"""Figs. 9–12: quality metrics of measured and simulated frames, and metrics that the paper does not show.

The declared model is that of the instrument file. The extended model also has the effects that the verdict added.
A law gives the width of the spot at each exposure. Without one, each frame is simulated with its own fitted parameters.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from spotcheck.io import store
from spotcheck.metrics.crop_metrics import CONTAINER_RANGE, PER_IMAGE
from spotcheck.metrics.metrics_table import FIT_PARAMETERS
from spotcheck.model.propagation import beam_propagation
from spotcheck.paper.rivals.summaries import PRINTED_BY_NAME
from spotcheck.paper.rivals.worlds import EXPOSURES_S, LASER_PX
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import METRICS, Category, Entry
from spotcheck.report.figures.results import Results

# Most panels of a figure, and of a row.
MAX_PANELS, PANELS_PER_ROW = 6, 3
# Heights of the legend and of a row of panels [inch].
LEGEND_HEIGHT, ROW_HEIGHT = 0.5, 2.7
# Simulated widths of one exposure count as equal within this difference [px].
WIDTH_TOLERANCE = 1e-9


# Names of the simulated series, and of the ranges of printed values, in legends.
MODEL_NAMES = ("declared model", "extended model")
PRINTED_NAME = "printed range"


class Series(NamedTuple):
    """The three series of a figure."""

    measured: series.LineStatistics  # measured frames
    declared: series.LineStatistics  # frames simulated by the declared model
    extended: series.LineStatistics | None  # frames simulated by the extended model; None if there is none


@dataclass(frozen=True)
class MetricPlot:
    """A metric that is drawn."""

    metric: str  # variable of metrics.nc
    label: str  # label of the ordinate with unit; {tens} stands for the power of ten by which values are divided
    meaning: str  # definition of the metric, the start of the caption
    # Smallest and largest measured mean in print at 100, 500 and 900 µs, in the unit of the metric; () without any.
    printed: tuple[tuple[float, float], ...] = ()


def follows_law(results: Results) -> bool:
    """Return whether all simulated frames of an exposure have the same width, which a law gives."""
    simulated = results.get("simulated")
    if str(simulated.attrs.get("calibration", "")).startswith("none"):
        return False
    sigma = simulated["sigma"].transpose("exposure", ...).values.reshape(simulated.sizes["exposure"], -1)
    widths_by_exposure = (row[np.isfinite(row)] for row in sigma)
    return all(np.ptp(widths) < WIDTH_TOLERANCE for widths in widths_by_exposure if widths.size)


def draw_metric(results: Results, plot: MetricPlot) -> style.Drawing:
    """Draw a metric of measured frames and of frames simulated by both models, one panel per line of the grid.

    Raises `Unavailable` if no measured frame has a value.
    """
    metrics, extended = results.get("metrics"), results.find("extended_metrics")
    # The paper uses least squares; its numbers are comparable with that fit only.
    fit = "least_squares" if results.has_paper_design() else metrics.attrs["preferred"]
    axes = series.choose_axes(metrics, store.grid_dims(metrics))
    measured_values = _select_values(metrics, plot.metric, fit, "measured")
    measured = series.require_values(series.average_frames(measured_values, axes), plot.meaning.lower())
    declared, with_effects = (
        None if ds is None else series.average_frames(_select_values(ds, plot.metric, fit, "simulated"), axes)
        for ds in (metrics, extended)
    )
    assert declared is not None
    divisor, power_text = style.choose_power_of_ten(float(np.nanmax(measured.mean)))
    shown = series.pick_evenly(len(measured.mean), MAX_PANELS)
    figure, panels = _make_panels(len(shown))
    names = series.list_line_names(metrics, axes)
    has_law = follows_law(results)
    # The law depends on the exposure alone, so that the simulation is the same at all other values of the abscissa.
    is_constant = has_law and axes.abscissa in ("angle", "repeat")
    handles: list = []
    for ax, k in zip(panels, shown, strict=True):
        x = series.set_abscissa(ax, metrics, axes)
        handles = _draw_series(ax, x, Series(measured, declared, with_effects), int(k), divisor, is_constant)
        ax.set_title(names[k])
        ax.label_outer()
    labels = ["measured", *MODEL_NAMES][: len(handles)]
    if plot.printed and results.has_paper_design():
        handles.append(_draw_printed_ranges(panels, [plot.printed[k] for k in shown], divisor))
        labels.append(PRINTED_NAME)
    figure.supylabel(plot.label.replace("{tens}", power_text), fontsize="medium")
    style.add_legend(figure, handles, labels, len(handles))
    caption = f"{plot.meaning}: crops centred on the light. {series.frames_text(measured, axes)};"
    caption += f" {int(measured.frames.sum())} measured frames."
    if len(shown) < len(names):
        caption += f" {len(shown)} of {len(names)} panels are shown."
    caption += " Declared: the paper's model with the calibrated p1 and p2"
    caption += f", which does not depend on the {axes.abscissa}." if is_constant else "."
    if not has_law:
        caption += " No law links the frames: each one is simulated with its own fitted parameters, so that"
        caption += " fitted amplitude and width agree by construction."
    if extended is not None:
        caption += " Extended: with the effects of the verdict; its sites are drawn at random, so that its error bars"
        caption += " are simulated as well."
    if plot.metric in FIT_PARAMETERS:
        all_values = metrics[plot.metric].sel(centring="light", source="measured", fit=fit)
        if untrusted_count := int(all_values.notnull().sum() - measured_values.notnull().sum()):
            caption += f" {untrusted_count} fits that did not converge or have an implausible width are not counted."
    return style.Drawing(figure, caption)


def _select_values(ds: xr.Dataset, metric: str, fit: str, source: str) -> xr.DataArray:
    """Return the values of a metric [dimensions of the grid], in its unit, of the crops that are centred on the light.

    `fit` and `source` are labels of metrics.nc, such as "least_squares" and "measured". Metrics that are parameters of
    the fit are NaN where the fit is not trusted.
    """
    chosen = ds.sel(centring="light", fit=fit, source=source)
    values = chosen[metric]
    return values.where((chosen["status"] & store.UNTRUSTED) == 0) if metric in FIT_PARAMETERS else values


def _make_panels(count: int, groups: int = 1) -> tuple[Figure, np.ndarray]:
    """Return a figure with `count` panels in each of some groups, and the panels in use [group · count].

    A group has at most `PANELS_PER_ROW` panels per row. The panels of a row share their ordinate, those of a single
    group too.
    """
    columns = min(count, PANELS_PER_ROW)
    rows_per_group = -(-count // columns)
    figure = style.new_figure(LEGEND_HEIGHT + groups * rows_per_group * ROW_HEIGHT)
    grid = figure.subplots(groups * rows_per_group, columns, squeeze=False, sharey="row" if groups > 1 else True)
    by_group = grid.reshape(groups, rows_per_group * columns)
    for unused in by_group[:, count:].ravel():
        unused.set_axis_off()
    return figure, by_group[:, :count].ravel()


def _draw_series(
    ax: Axes, x: np.ndarray, all_series: Series, line: int, divisor: float = 1.0, is_constant: bool = False
) -> list:
    """Draw the line with index `line` of each series over `x`, divided by `divisor`; return the legend's artists.

    `x` are the values of the abscissa [point]. Measured frames and the extended model have error bars. The declared
    model is a horizontal line at the average of all its frames if `is_constant`. The artists are those of the measured
    frames, the declared model and, if there is one, the extended model.
    """
    measured, declared, extended = all_series
    left, right = series.offset_lines(x, 2)

    def draw_bars(
        statistics: series.LineStatistics, offset: float, look: style.LineStyle, is_filled: bool
    ) -> ErrorbarContainer:
        """Draw mean and standard deviation of a series, shifted by `offset` along the abscissa."""
        mean, sd = statistics.mean[line] / divisor, statistics.sd[line] / divisor
        return series.draw_error_bars(ax, x + offset, mean, sd, look, is_filled)

    handles: list = [draw_bars(measured, left, style.LineStyle(style.MEASURED, "o"), True)]
    mean, frames = declared.mean[line] / divisor, declared.frames[line]
    look: dict[str, Any] = {"color": style.SIMULATED, "linestyle": style.DASHED}
    if is_constant and frames.any():
        handles.append(ax.axhline(_average_all_frames(mean, frames), **look))
    else:
        handles += ax.plot(x, mean, marker="s", markerfacecolor="white", **look)
    if extended is not None:
        handles.append(draw_bars(extended, right, style.LineStyle(style.ACCENT, "^"), False))
    return handles


def _draw_printed_ranges(panels: Iterable[Axes], ranges: Sequence[tuple[float, float]], divisor: float = 1.0) -> Artist:
    """Draw the range of printed values, divided by `divisor`, behind each panel; return an artist for the legend."""
    for ax, (low, high) in zip(panels, ranges, strict=True):
        span = ax.axhspan(low / divisor, high / divisor, facecolor=style.PRINTED, edgecolor="none", zorder=0.5)
    return span


def _average_all_frames(mean: np.ndarray, frames: np.ndarray) -> float:
    """Return the mean over all frames, from the `mean` of each point and its number of `frames`."""
    return float(np.average(mean[frames > 0], weights=frames[frames > 0]))


def draw_psnr(results: Results) -> style.Drawing:
    """Draw Fig. 9a: the peak signal-to-noise ratio (PSNR) as in the paper, and that of registered crops below.

    The paper centres each crop on its maximum and uses the range of 16-bit numbers. The panels below have crops that
    are registered on the fitted centres, and the range of the sensor. Raises `Unavailable` if there is no PSNR.
    """
    ds, extended = results.get("metrics"), results.find("extended_metrics")
    axes = series.choose_axes(ds, store.grid_dims(ds))
    full_scale = float(results.get("sensor")["full_scale_dn"])
    range_db = 20 * np.log10(CONTAINER_RANGE / full_scale)
    # (registration, data range, text of the ordinate) of each row of panels; both are labels of metrics.nc.
    kinds = (("maximum", "container", "range 65535"), ("fitted", "sensor", f"registered, range {full_scale:.0f}"))
    names = series.list_line_names(ds, axes)
    shown = series.pick_evenly(len(names), PANELS_PER_ROW)
    figure, panels = _make_panels(len(shown), groups=2)
    handles: list = []
    averages = []
    for (registration, data_range, title), row in zip(kinds, panels.reshape(2, -1), strict=True):

        def average(values: xr.DataArray, kind: tuple[str, str] = (registration, data_range)) -> series.LineStatistics:
            """Return the statistics of a PSNR with the registration and data range of this row."""
            return series.average_frames(values.sel(registration=kind[0], data_range=kind[1]), axes)

        declared = series.require_values(average(ds["psnr"]), "a peak signal-to-noise ratio")
        averages.append(declared)
        of_extended = None if extended is None else average(extended["psnr"])
        all_series = Series(average(ds["psnr_repeats"]), declared, of_extended)
        for ax, k in zip(row, shown, strict=True):
            x = series.set_abscissa(ax, ds, axes)
            handles = _draw_series(ax, x, all_series, int(k))
            ax.set_title(names[k] if registration == "maximum" else "")
        row[0].set_ylabel(f"PSNR / dB, {title}")
    labels = ["measured repeats", *MODEL_NAMES][: len(handles)]
    if results.has_paper_design():
        handles.append(_draw_printed_ranges(panels[: len(shown)], [PRINTED_PSNR_DB] * len(shown)))
        labels.append(PRINTED_NAME)
    style.add_legend(figure, handles, labels, len(handles))
    # The crops of the upper panels with the range of the lower ones, which separates both effects.
    at_sensor_range = ds["psnr"].sel(registration="maximum", data_range="sensor").values
    printed_db, registered_db = (_average_all_frames(points.mean, points.frames) for points in averages)
    sensor_range_db = at_sensor_range[np.isfinite(at_sensor_range)].mean()
    caption = (
        "Peak signal-to-noise ratio of measured frames against frames of both models, and against the next measured"
        " repeat: new speckle limits it even for a true model. Above: both crops centred on their own maximum and"
        " scaled to 65535, the range of a 16-bit container, as in the paper. Below: the other crop moved onto the"
        " measured fitted centre and scaled to the sensor's own range. The range alone is worth"
        f" {range_db:.1f} dB: against the declared model the upper crops average {printed_db:.1f} dB, at the sensor's"
        f" range {sensor_range_db:.1f} dB, and registered {registered_db:.1f} dB."
        f" {series.frames_text(averages[0], axes)}."
    )
    return style.Drawing(figure, caption)


# (smallest, largest) printed mean of a quantity, in its unit.
CONTRAST_RANGE, SHORT_AMPLITUDE_RANGE, LONG_AMPLITUDE_RANGE = (
    (PRINTED_BY_NAME[f"{name}_smallest"], PRINTED_BY_NAME[f"{name}_largest"])
    for name in ("contrast", "amplitude_short", "amplitude_long")
)
# Smallest and largest mean PSNR in print [dB], the smallest mean of the largest reading [DN], and p1 ln t + p2 [px].
PRINTED_PSNR_DB = (53.0, 58.0)
SMALLEST_MAXIMUM = PRINTED_BY_NAME["maximum_smallest"]
PRINTED_WIDTHS_PX = [
    float(beam_propagation(exposure_s, PRINTED_BY_NAME["p1"], PRINTED_BY_NAME["p2"])) for exposure_s in EXPOSURES_S
]
# Metrics of the paper.
CONTRAST = MetricPlot(
    "speckle_contrast",
    "speckle contrast $C_s$",
    "Speckle contrast (standard deviation over mean of a crop)",
    (CONTRAST_RANGE,) * 3,
)
MAXIMUM = MetricPlot(
    "maximum",
    "largest reading / DN",
    "Largest reading of a crop",
    ((SMALLEST_MAXIMUM, SMALLEST_MAXIMUM + PRINTED_BY_NAME["maximum_spread"]),) * 3,
)
AMPLITUDE = MetricPlot(
    "amplitude",
    "fitted amplitude / DN",
    "Peak of the fitted Gaussian above its offset",
    (SHORT_AMPLITUDE_RANGE, LONG_AMPLITUDE_RANGE, LONG_AMPLITUDE_RANGE),
)
MEAN_WIDTH = MetricPlot(
    "sigma_mean",
    "fitted width $\\bar{\\sigma}$ / px",
    "Direction-averaged standard deviation of the fitted Gaussian (mean of its long and short axis)",
    tuple((width, width + LASER_PX) for width in PRINTED_WIDTHS_PX),
)
TOTAL = MetricPlot(
    "sum",
    "sum of readings / {tens}DN",
    "Sum of all readings of a crop",
)
# All other metrics of single crops, by name.
OTHERS = {
    metric.name: MetricPlot(
        metric.name,
        style.axis_label(metric.name.replace("_", " "), "" if metric.units == "1" else metric.units),
        metric.long_name[0].upper() + metric.long_name[1:],
    )
    for metric in PER_IMAGE
    if metric.name not in (CONTRAST.metric, MAXIMUM.metric, TOTAL.metric)
}


# (name, title, metric, figure of the paper that shows it) of each figure of a metric.
METRIC_FIGURES: list[tuple[str, str, MetricPlot, str | None]] = [
    ("fig09b", "Speckle contrast", CONTRAST, "Fig. 9b"),
    ("fig10a", "Plateau: largest reading", MAXIMUM, "Fig. 10a"),
    ("fig10b", "Amplitude of the fitted Gaussian", AMPLITUDE, "Fig. 10b"),
    ("fig11", "Width of the fitted Gaussian", MEAN_WIDTH, "Fig. 11"),
    ("fig12", "Sum of all readings", TOTAL, "Fig. 12"),
]
# Figure of the paper by the name of the metric that it shows.
PAPER_FIGURES = {plot.metric: figure for _, _, plot, figure in METRIC_FIGURES}
METRIC_FIGURES += [
    (f"metric-{name.replace('_', '-')}", name.replace("_", " ").capitalize(), plot, None)
    for name, plot in OTHERS.items()
]
FIGURES = (
    Entry("fig09a", "Peak signal-to-noise ratio", Category.METRICS, ("metrics", "sensor"), draw_psnr, "Fig. 9a"),
    *(
        Entry(name, title, Category.METRICS, METRICS, partial(draw_metric, plot=plot), figure)
        for name, title, plot, figure in METRIC_FIGURES
    ),
)
