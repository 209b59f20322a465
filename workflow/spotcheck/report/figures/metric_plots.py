"""Figs. 9–12: quality metrics of measured and simulated frames, and metrics that the paper does not show.

A law gives the width of the spot at each exposure. Without one, each frame is simulated with its own fitted parameters.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from spotcheck.io import store
from spotcheck.metrics.crop_metrics import CONTAINER_RANGE, PER_IMAGE
from spotcheck.metrics.metrics_table import FIT_PARAMETERS
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import METRICS, Category, Entry
from spotcheck.report.figures.results import Results

# Simulated widths of one exposure count as equal within this difference [px].
WIDTH_TOLERANCE = 1e-9


@dataclass(frozen=True)
class MetricPlot:
    """A metric that is drawn."""

    metric: str  # variable of metrics.nc
    label: str  # label of the ordinate with unit; {tens} stands for the power of ten by which values are divided
    meaning: str  # definition of the metric, the start of the caption
    note: str = ""  # numbers in print, for comparison; "" if the paper does not show the metric


def follows_law(results: Results) -> bool:
    """Return whether all simulated frames of an exposure have the same width, which a law gives."""
    simulated = results.get("simulated")
    if str(simulated.attrs.get("calibration", "")).startswith("none"):
        return False
    sigma = simulated["sigma"].transpose("exposure", ...).values.reshape(simulated.sizes["exposure"], -1)
    widths_by_exposure = (row[np.isfinite(row)] for row in sigma)
    return all(np.ptp(widths) < WIDTH_TOLERANCE for widths in widths_by_exposure if widths.size)


def draw_metric(results: Results, plot: MetricPlot) -> style.Drawing:
    """Draw a metric of measured frames with error bars, and of simulated frames dashed in the same colour.

    Raises `Unavailable` if no measured frame has a value.
    """
    metrics = results.get("metrics")
    # The paper uses least squares; its numbers are comparable with that fit only.
    fit = "least_squares" if results.has_paper_design() else metrics.attrs["preferred"]
    ds = metrics.sel(centring="light", fit=fit)
    axes = series.choose_axes(ds, store.grid_dims(metrics))
    values, untrusted_count = ds[plot.metric], 0
    if plot.metric in FIT_PARAMETERS:
        values = values.where((ds["status"] & store.UNTRUSTED) == 0)
        untrusted_count = int((ds[plot.metric].notnull() & values.isnull()).sel(source="measured").sum())
    measured = series.require_values(series.average_frames(values.sel(source="measured"), axes), plot.meaning.lower())
    simulated = series.average_frames(values.sel(source="simulated"), axes)
    divisor, power_text = style.choose_power_of_ten(float(np.nanmax(measured.mean)))
    names, lines = series.list_line_names(ds, axes), style.line_styles(len(measured.mean))
    has_law = follows_law(results)
    # The law depends on the exposure alone, so that the simulation is the same at all other values of the abscissa.
    is_constant = has_law and axes.abscissa in ("angle", "repeat")
    figure = style.new_figure(3.5)
    ax = figure.add_subplot()
    x = series.set_abscissa(ax, ds, axes)
    handles: list = []
    labels: list[str] = []
    for k, (line, offset) in enumerate(zip(lines, series.offset_lines(x, len(lines)), strict=True)):
        mean, sd = measured.mean[k] / divisor, measured.sd[k] / divisor
        handles.append(series.draw_error_bars(ax, x + offset, mean, sd, line))
        weights = simulated.frames[k] if is_constant else None
        handles.append(_draw_simulated(ax, x + offset, simulated.mean[k] / divisor, line, weights))
        labels += [", ".join(filter(None, (names[k], source))) for source in ("measured", "simulated")]
    ax.set_ylabel(plot.label.replace("{tens}", power_text))
    style.add_legend(figure, handles, labels, min(len(lines), 3) if len(lines) > 1 else 2)
    caption = f"{plot.meaning}: crops centred on the light. {series.frames_text(measured, axes)};"
    caption += f" {int(measured.frames.sum())} measured frames."
    if is_constant:
        caption += " Dashed level: the mean of the simulated frames, since the model does not depend on the"
        caption += f" {axes.abscissa}."
    else:
        caption += " Dashed with open markers: the simulated frames, evaluated in the same way."
    if not has_law:
        caption += " No law links the frames: each one is simulated with its own fitted parameters, so that"
        caption += " fitted amplitude and width agree by construction."
    if untrusted_count:
        caption += f" {untrusted_count} fits that did not converge or have an implausible width are not counted."
    return style.Drawing(figure, caption + (results.paper_note(plot.note) if plot.note else ""))


def _draw_simulated(
    ax: Axes, x: np.ndarray, mean: np.ndarray, line: style.LineStyle, weights: np.ndarray | None
) -> Line2D:
    """Draw the `mean` of simulated frames [point] over `x` dashed; return the artist for the legend.

    With `weights` [point], the numbers of frames, draw the weighted average of all points as a horizontal line instead.
    """
    dashes = (0, line.dashes)
    if weights is not None and weights.any():
        level = float(np.average(mean[weights > 0], weights=weights[weights > 0]))
        return ax.axhline(level, color=line.colour, linestyle=dashes)
    marker: dict[str, Any] = {"marker": line.marker, "markerfacecolor": "none", "markersize": 8}
    return ax.plot(x, mean, color=line.colour, linestyle=dashes, **marker)[0]


def draw_psnr(results: Results) -> style.Drawing:
    """Draw Fig. 9a: the peak signal-to-noise ratio (PSNR) as in the paper, and that of registered crops.

    The paper centres each crop on its maximum and uses the range of 16-bit numbers. The second panel has crops that are
    registered on the fitted centres, and the range of the sensor. Raises `Unavailable` if there is no PSNR.
    """
    ds = results.get("metrics")
    axes = series.choose_axes(ds, store.grid_dims(ds))
    full_scale = float(results.get("sensor")["full_scale_dn"])
    range_db = 20 * np.log10(CONTAINER_RANGE / full_scale)
    as_printed, registered = (
        series.require_values(
            series.average_frames(ds["psnr"].sel(registration=registration, data_range=data_range), axes),
            "a peak signal-to-noise ratio",
        )
        for registration, data_range in (("maximum", "container"), ("fitted", "sensor"))
    )
    names, lines = series.list_line_names(ds, axes), style.line_styles(len(as_printed.mean))
    figure = style.new_figure(3.6)
    panels = figure.subplots(1, 2)
    titles = ("crops at the maximum,\nrange 65535", f"crops registered on fitted centres,\nrange {full_scale:.0f}")
    handles = []
    for ax, statistics, title in zip(panels, (as_printed, registered), titles, strict=True):
        x = series.set_abscissa(ax, ds, axes)
        handles = [
            series.draw_error_bars(ax, x + offset, statistics.mean[k], statistics.sd[k], lines[k])
            for k, offset in enumerate(series.offset_lines(x, len(lines)))
        ]
        ax.set(title=title, ylabel="PSNR / dB")
    _equalize_spans(panels)
    if any(names):
        style.add_legend(figure, handles, names, min(len(names), 6))
    # The crops of the left panel with the range of the right one, which separates both effects.
    at_sensor_range = ds["psnr"].sel(registration="maximum", data_range="sensor").values
    printed_db, registered_db = _average_all_frames(as_printed), _average_all_frames(registered)
    sensor_range_db = at_sensor_range[np.isfinite(at_sensor_range)].mean()
    caption = (
        "Peak signal-to-noise ratio of measured against simulated frames. Left: both crops centred on their own"
        " maximum and scaled to 65535, the range of a 16-bit container, as in the paper. Right: the simulated crop"
        " moved onto the measured fitted centre and scaled to the sensor's own range. The range alone is worth"
        f" {range_db:.1f} dB: the crops of the left panel average {printed_db:.1f} dB, at the sensor's range"
        f" {sensor_range_db:.1f} dB, and registered {registered_db:.1f} dB. Both ordinates span the same"
        f" decibels. {series.frames_text(as_printed, axes)}."
    )
    note = "In print the means are 53 to 58 dB, highest at 100 µs, with spreads of 0.7 to 3.4 dB."
    return style.Drawing(figure, caption + results.paper_note(note))


def _average_all_frames(statistics: series.LineStatistics) -> float:
    """Return the mean of a quantity over all frames: that of all points, weighted by their numbers of frames."""
    has_frames = statistics.frames > 0
    return float(np.average(statistics.mean[has_frames], weights=statistics.frames[has_frames]))


def _equalize_spans(panels: np.ndarray) -> None:
    """Set the ordinates of all panels to the largest of their spans, each around its own middle.

    Equal distances on them then mean equal differences.
    """
    limits = [ax.get_ylim() for ax in panels]
    span = max(high - low for low, high in limits)
    for ax, (low, high) in zip(panels, limits, strict=True):
        ax.set_ylim((low + high - span) / 2, (low + high + span) / 2)


# Metrics of the paper.
CONTRAST = MetricPlot(
    "speckle_contrast",
    "speckle contrast $C_s$",
    "Speckle contrast (standard deviation over mean of a crop)",
    "In print the measured means lie between 4.4 and 9.5, the simulated values between 3.5 and 5.2, and the spread at"
    " 100 µs is about twice that of the longer exposures.",
)
MAXIMUM = MetricPlot(
    "maximum",
    "largest reading / DN",
    "Largest reading of a crop",
    "In print every measured mean exceeds 800 DN and all of them lie within 6 DN, over angles and exposures alike; the"
    " simulation is at most 43 DN off at 100 µs, below 8 DN at the longer two.",
)
AMPLITUDE = MetricPlot(
    "amplitude",
    "fitted amplitude / DN",
    "Peak of the fitted Gaussian above its offset",
    "In print the fitted amplitudes are 839 to 924 DN at 100 µs with a spread of up to 227 DN, and 992 to 1062 DN with"
    " at most 51 DN at the longer two.",
)
MEAN_WIDTH = MetricPlot(
    "sigma_mean",
    "fitted width $\\bar{\\sigma}$ / px",
    "Direction-averaged standard deviation of the fitted Gaussian (mean of its long and short axis)",
    "In print the spreads are 1 to 4 px and measured means lie within 2 px of the simulation from 0° to 90°; they rise"
    " from 45° to 90° and drop to 135°, where 100 µs is 4.5 px off.",
)
TOTAL = MetricPlot(
    "sum",
    "sum of readings / {tens}DN",
    "Sum of all readings of a crop",
    "In print the spreads reach 1.1 · 10⁶ and the simulated sums lie inside nearly all of them.",
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


def _entry(name: str, title: str, plot: MetricPlot, paper: str | None = None) -> Entry:
    """Return the entry of a figure of a metric; `paper` is the figure of the paper, None if it has none."""
    return Entry(name, title, Category.METRICS, METRICS, partial(draw_metric, plot=plot), paper)


FIGURES = (
    Entry("fig09a", "Peak signal-to-noise ratio", Category.METRICS, ("metrics", "sensor"), draw_psnr, "Fig. 9a"),
    _entry("fig09b", "Speckle contrast", CONTRAST, "Fig. 9b"),
    _entry("fig10a", "Plateau: largest reading", MAXIMUM, "Fig. 10a"),
    _entry("fig10b", "Amplitude of the fitted Gaussian", AMPLITUDE, "Fig. 10b"),
    _entry("fig11", "Width of the fitted Gaussian", MEAN_WIDTH, "Fig. 11"),
    _entry("fig12", "Sum of all readings", TOTAL, "Fig. 12"),
    *(
        _entry(f"metric-{name.replace('_', '-')}", name.replace("_", " ").capitalize(), plot)
        for name, plot in OTHERS.items()
    ),
)
