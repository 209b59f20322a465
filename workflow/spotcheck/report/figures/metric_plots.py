"""Figs. 9–12: quality metrics of measured and simulated frames, over the fibre orientation or what the design has.

A metric without a figure of its own in the paper is drawn as well, under its name.
"""

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from spotcheck.io import store
from spotcheck.metrics.crop_metrics import CONTAINER_RANGE, PER_IMAGE, Metric
from spotcheck.metrics.metrics_table import FIT_PARAMETERS
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import METRICS, Category, Entry
from spotcheck.report.figures.frames_of import UNTRUSTED
from spotcheck.report.figures.results import Results

CENTRED_LIGHT = "crops centred on the light"


def law_in_time(results: Results) -> bool:
    """Whether the simulation follows a law, so that all frames of an exposure share one width and one peak."""
    simulated = results.get("simulated")
    if str(simulated.attrs.get("calibration", "")).startswith("none"):
        return False
    dims = [d for d in simulated["sigma"].dims if d != "exposure"]
    values = simulated["sigma"].transpose("exposure", *dims).values.reshape(simulated.sizes["exposure"], -1)
    return all(np.ptp(row[np.isfinite(row)]) < 1e-9 for row in values if np.isfinite(row).any())


def contrast(results: Results) -> style.Drawing:
    """Fig. 9b: spatial speckle contrast C_s of the crops."""
    clause = (
        "In print the measured means lie between 4.4 and 9.5, the simulated values between 3.5 and 5.2, and the"
        " spread at 100 µs is about twice that of the longer exposures."
    )
    text = "Speckle contrast (standard deviation over mean of a crop)"
    return _metric(results, "speckle_contrast", "speckle contrast $C_s$", text, clause)


def maximum(results: Results) -> style.Drawing:
    """Fig. 10a: largest reading of the crops."""
    clause = (
        "In print every measured mean exceeds 800 DN and all of them lie within 6 DN, over angles and exposures"
        " alike; the simulation is at most 43 DN off at 100 µs, below 8 DN at the longer two."
    )
    return _metric(results, "maximum", "largest reading / DN", "Largest reading of a crop", clause)


def amplitude(results: Results) -> style.Drawing:
    """Fig. 10b: amplitude of the fitted Gaussian."""
    clause = (
        "In print the fitted amplitudes are 839 to 924 DN at 100 µs with a spread of up to 227 DN, and 992 to 1062 DN"
        " with at most 51 DN at the longer two."
    )
    return _metric(
        results, "amplitude", "fitted amplitude / DN", "Peak of the fitted Gaussian above its offset", clause
    )


def width(results: Results) -> style.Drawing:
    """Fig. 11: direction-averaged width of the fitted Gaussian."""
    clause = (
        "In print the spreads are 1 to 4 px and measured means lie within 2 px of the simulation from 0° to 90°; they"
        " rise from 45° to 90° and drop to 135°, where 100 µs is 4.5 px off."
    )
    text = "Direction-averaged standard deviation of the fitted Gaussian (mean of its long and short axis)"
    return _metric(results, "sigma_mean", "fitted width $\\bar{\\sigma}$ / px", text, clause)


def total(results: Results) -> style.Drawing:
    """Fig. 12: sum of all readings of the crops."""
    clause = "In print the spreads reach 1.1 · 10⁶ and the simulated sums lie inside nearly all of them."
    return _metric(results, "sum", "sum of readings / {tens}DN", "Sum of all readings of a crop", clause)


def other(results: Results, metric: Metric) -> style.Drawing:
    """A metric that no figure of the paper shows."""
    unit = "" if metric.units == "1" else metric.units
    label = style.label(metric.name.replace("_", " "), unit)
    return _metric(results, metric.name, label, metric.long_name[0].upper() + metric.long_name[1:])


def _metric(results: Results, name: str, ylabel: str, what: str, paper: str = "") -> style.Drawing:
    """One metric: measured with error bars, simulated dashed in the same colour; `paper` is what the paper prints."""
    # Beside the paper's figures its own estimator, elsewhere the better one.
    every = results.get("metrics")
    ds = every.sel(centring="light", fit="least_squares" if results.like_paper() else every.attrs["preferred"])
    design = series.design_of(ds, store.grid_dims(results.get("metrics")))
    values, left_out = ds[name], 0
    if name in FIT_PARAMETERS:
        values = values.where((ds["status"] & UNTRUSTED) == 0)
        left_out = int((ds[name].notnull() & values.isnull()).sel(source="measured").sum())
    measured = series.need_values(series.points(values.sel(source="measured"), design), what.lower())
    simulated = series.points(values.sel(source="simulated"), design)
    tens, tens_text = style.tens(float(np.nanmax(measured.mean)))
    names, looks = series.line_names(ds, design), style.lines(len(measured.mean))
    law = law_in_time(results)
    constant = law and design.across in ("angle", "repeat")

    figure = style.new(3.5)
    ax = figure.add_subplot()
    x = series.abscissa(ax, ds, design)
    handles: list = []
    labels: list[str] = []
    for k, (look, shift) in enumerate(zip(looks, series.offsets(x, len(looks)), strict=True)):
        handles.append(series.bars(ax, x + shift, measured.mean[k] / tens, measured.sd[k] / tens, look))
        handles.append(_simulated(ax, x + shift, simulated, k, tens, look, constant))
        labels += [", ".join(filter(None, (names[k], source))) for source in ("measured", "simulated")]
    ax.set_ylabel(ylabel.replace("{tens}", tens_text))
    style.legend_above(figure, handles, labels, min(len(looks), 3) if len(looks) > 1 else 2)
    caption = _caption(what, measured, design, law, constant)
    if left_out:
        caption += f" {left_out} fits that did not converge or left the range of sound widths are not counted."
    return style.Drawing(figure, caption + (results.beside_paper(paper) if paper else ""))


def _simulated(
    ax: Axes, x: np.ndarray, found: series.Points, k: int, tens: float, look: style.Line, constant: bool
) -> Line2D:
    """The simulated counterpart: a level where the model knows nothing of the abscissa, else a dashed line."""
    dashes = (0, look.dashes)
    if constant and found.frames[k].any():
        level = float(np.average(found.mean[k][found.frames[k] > 0], weights=found.frames[k][found.frames[k] > 0]))
        return ax.axhline(level / tens, color=look.colour, linestyle=dashes)
    return ax.plot(
        x,
        found.mean[k] / tens,
        color=look.colour,
        linestyle=dashes,
        marker=look.marker,
        markerfacecolor="none",
        markersize=8,
    )[0]


def _caption(what: str, found: series.Points, design: series.Design, law: bool, level: bool) -> str:
    """`law`: the simulation follows a law in t; `level`: it is drawn as one."""
    own = f"{what}: {CENTRED_LIGHT}. {series.frames_text(found, design)}; {int(found.frames.sum())} measured frames."
    if level:
        own += " Dashed level: the simulated frames by the same functions, averaged, since the model knows no"
        own += f" {'angle' if design.across == 'angle' else 'repeat'}."
    else:
        own += " Dashed with open markers: the simulated frames by the same functions."
    if not law:
        own += " No law links the frames: each is simulated at its own fit, so that fitted amplitude and width agree by"
        own += " construction."
    return own


def psnr(results: Results) -> style.Drawing:
    """Fig. 9a: PSNR as the paper computes it, and with registered crops and the sensor's own range."""
    ds = results.get("metrics")
    design = series.design_of(ds, store.grid_dims(ds))
    full_scale = float(results.get("sensor")["full_scale_dn"])
    gap = 20 * np.log10(CONTAINER_RANGE / full_scale)
    kinds = [("maximum", "container"), ("fitted", "sensor")]
    found = [series.points(ds["psnr"].sel(registration=r, data_range=d), design) for r, d in kinds]
    for own in found:
        series.need_values(own, "a peak signal-to-noise ratio")
    names, looks = series.line_names(ds, design), style.lines(len(found[0].mean))
    figure = style.new(3.6)
    panels = figure.subplots(1, 2)
    titles = ("crops at the maximum,\nrange 65535", f"crops registered on fitted centres,\nrange {full_scale:.0f}")
    handles = []
    for ax, own, title in zip(panels, found, titles, strict=True):
        x = series.abscissa(ax, ds, design)
        shifts = series.offsets(x, len(looks))
        handles = [series.bars(ax, x + s, own.mean[k], own.sd[k], looks[k]) for k, s in enumerate(shifts)]
        ax.set_title(title)
        ax.set_ylabel("PSNR / dB")
    _same_span(panels)
    if any(names):
        style.legend_above(figure, handles, names, min(len(names), 6))
    between = ds["psnr"].sel(registration="maximum", data_range="sensor").values
    between = between[np.isfinite(between)].mean()
    caption = (
        "Peak signal-to-noise ratio of measured against simulated frames. Left: both crops centred on their own"
        " maximum and scaled to 65535, the range of a 16-bit container, as in the paper. Right: the simulated crop"
        " moved onto the measured fitted centre and scaled to the sensor's own range. The range alone is worth"
        f" {gap:.1f} dB: the crops of the left panel average {_average(found[0]):.1f} dB, at the sensor's range"
        f" {between:.1f} dB, and registered {_average(found[1]):.1f} dB. Both ordinates span the same decibels."
        f" {series.frames_text(found[0], design)}."
    )
    clause = "In print the means are 53 to 58 dB, highest at 100 µs, with spreads of 0.7 to 3.4 dB."
    return style.Drawing(figure, caption + results.beside_paper(clause))


def _average(found: series.Points) -> float:
    good = found.frames > 0
    return float(np.average(found.mean[good], weights=found.frames[good]))


def _same_span(panels: np.ndarray) -> None:
    """Give all ordinates the largest span, each around its own middle, so that distances compare by eye."""
    limits = [ax.get_ylim() for ax in panels]
    span = max(high - low for low, high in limits)
    for ax, (low, high) in zip(panels, limits, strict=True):
        ax.set_ylim((low + high - span) / 2, (low + high + span) / 2)


IN_PRINT = (
    Entry("fig09a", "Peak signal-to-noise ratio", Category.METRICS, ("metrics", "sensor"), psnr, "Fig. 9a"),
    Entry("fig09b", "Speckle contrast", Category.METRICS, METRICS, contrast, "Fig. 9b"),
    Entry("fig10a", "Plateau: largest reading", Category.METRICS, METRICS, maximum, "Fig. 10a"),
    Entry("fig10b", "Amplitude of the fitted Gaussian", Category.METRICS, METRICS, amplitude, "Fig. 10b"),
    Entry("fig11", "Width of the fitted Gaussian", Category.METRICS, METRICS, width, "Fig. 11"),
    Entry("fig12", "Sum of all readings", Category.METRICS, METRICS, total, "Fig. 12"),
)
FIGURES = IN_PRINT + tuple(
    Entry(
        f"metric-{own.name.replace('_', '-')}",
        own.name.replace("_", " ").capitalize(),
        Category.METRICS,
        METRICS,
        partial(other, metric=own),
    )
    for own in PER_IMAGE
    if own.name not in ("speckle_contrast", "maximum", "sum")
)
