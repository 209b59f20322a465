"""Curves of the results, drawn by Plotly with values on hover.

The width of the spot at the exposure t is p1 ln t + p2 [px], plus the width of the laser. The frames lie on a grid with
the dimensions angle, exposure, repeat and declared conditions. The argument `files` holds the content of each netCDF
result by file name without suffix; results of skipped stages are missing. Results have a source: measured frames,
frames simulated by the declared model, or frames simulated by the extended model with the effects of the verdict.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.precision import summarize_precision
from spotcheck.metrics.crop_metrics import PER_IMAGE
from spotcheck.model.propagation import beam_propagation
from spotcheck.report.figures import series, style
from spotcheck.report.figures.metric_plots import PAPER_FIGURES
from spotcheck.report.figures.photon_transfer import fit_response_line
from spotcheck.report.pages.plots import figure_json

# Number of points of the line p1 ln t + p2.
LINE_POINTS = 60
# Colours of page.css by the source of a value.
COLOURS = {"measured": "var(--measured)", "simulated": "var(--simulated)", "extended": "var(--accent)"}
# Dashes of Plotly by the source of a value.
SOURCE_DASHES = {"measured": "solid", "simulated": "dash", "extended": "dot"}
# Names of the distributions of readings for which bounds.nc has bounds (its dimension `law`).
READING_LAWS = {"poisson_gauss": "shot and read noise", "poisson": "shot noise alone", "dn": "a Poisson law of DN"}
# The ordinate of the nonlinearity ends at ±DEVIATION_MARGIN times the largest deviation of a level to which the line
# was fitted; smaller deviations than LEAST_DEVIATION [%] count as that.
DEVIATION_MARGIN, LEAST_DEVIATION = 1.6, 0.1
# Symbols and dashes distinguish series without colour.
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star", "pentagon")
DASHES = ("solid", "dash", "dot", "dashdot")

Trace = dict[str, Any]  # a series of a Plotly figure


class Curve(NamedTuple):
    """A curve of the report."""

    name: str  # id on the page
    title: str  # heading of the curve
    figure: str  # JSON for Plotly
    caption: str  # one or more sentences
    picture: str = ""  # name of the picture of the results folder figures/ that it replaces; "" for none


def draw_curves(files: Mapping[str, xr.Dataset]) -> list[Curve]:
    """Return every curve for which there are results, except that of the levels, in the order of the page."""
    drawings = {"precision": _draw_precision, "bounds": _draw_bounds, "discrepancy": _draw_condition_gaps}
    curves = [_draw_widths(files), *_draw_metrics(files)]
    curves += [draw(files[name]) for name, draw in drawings.items() if name in files]
    return [curve for curve in curves if curve is not None]


def _make_axis(title: str, **attributes: Any) -> dict[str, Any]:
    """Return a Plotly axis with a title and further attributes; dollar signs of Matplotlib are removed."""
    return {"title": {"text": title.replace("$", "")}, **attributes}


def _make_trace(mode: str, name: str, x: Any, y: Any) -> Trace:
    """Return a trace with coordinates `x` and `y` [point]; `mode` is that of Plotly, `name` stands in the legend."""
    return {"type": "scatter", "mode": mode, "name": name, "x": np.asarray(x), "y": np.asarray(y)}


def _make_points(name: str, x: Any, y: Any, error: Any = None, source: str = "measured", **attributes: Any) -> Trace:
    """Return a trace of points.

    Parameters
    ----------
    name : str
        Name in the legend.
    x, y : array_like
        Coordinates [point].
    error : array_like, optional
        Standard error of `y` [point]; by default there are no error bars.
    source : str
        Key of `COLOURS`.
    **attributes
        Attributes of a Plotly trace; those of `marker` are merged with the colour.
    """
    bars = {} if error is None else {"error_y": {"type": "data", "array": np.asarray(error), "thickness": 1}}
    colour = COLOURS[source]
    marker = {"color": colour, "size": 7, "line": {"width": 1, "color": colour}} | attributes.pop("marker", {})
    return _make_trace("markers", name, x, y) | {"marker": marker} | bars | attributes


def _make_line(name: str, x: Any, y: Any, colour: str = "var(--ink)", dash: str = "solid") -> Trace:
    """Return a trace of a line with coordinates `x` and `y` [point].

    `name` is shown in the legend; `colour` is a colour of CSS, `dash` a dash style of Plotly.
    """
    return _make_trace("lines", name, x, y) | {"line": {"color": colour, "dash": dash, "width": 1.5}}


def _draw_widths(files: Mapping[str, xr.Dataset]) -> Curve | None:
    """Return the fitted widths over exposure and the line p1 ln t + p2; None if there are fewer than two exposures."""
    if "fits" not in files or "exposure" not in files["fits"].coords or files["fits"].sizes["exposure"] < 2:
        return None
    fits = select_preferred_fits(files["fits"])
    times, unit, label = series.axis_values(fits, "exposure")
    dims = tuple(str(dim) for dim in fits["sigma_mean"].dims)
    # Here the exposure is the abscissa. The dimension that is the abscissa of other figures, such as the angle, has one
    # series for each value instead.
    usual_abscissa = series.choose_axes(fits, dims).abscissa
    dim = usual_abscissa if usual_abscissa != "exposure" else None
    data = []
    for k in range(fits.sizes[dim] if dim else 1):
        selected_fits = fits.isel({dim: k}) if dim else fits
        # All frames of an exposure in one row: [exposure, frame] in px.
        widths, errors = (
            selected_fits[name].transpose("exposure", ...).values.reshape(len(times), -1)
            for name in ("sigma_mean", "sigma_mean_stderr")
        )
        x = np.repeat(times, widths.shape[1])
        name = series.value_text(fits, dim, k) if dim else "measured"
        marker = {"symbol": SYMBOLS[k % len(SYMBOLS)]}
        hover = f"{name}: %{{y:.5~g}} ± %{{error_y.array:.2~g}} px at %{{x:.4~g}} {unit}<extra></extra>"
        data.append(_make_points(name, x, widths.ravel(), errors.ravel(), marker=marker, hovertemplate=hover))
    caption = "Widths σ̄ of all frames with their standard errors, over exposure."
    if "calibration" in files:
        calibration = files["calibration"]
        used = calibration.sel(estimator=calibration.attrs["used"])
        p1, p2 = float(used["p1_mean"]), float(used["p2_mean"])
        if np.isfinite([p1, p2]).all():
            # Displayed time for 1 s: 1000 if times are displayed in ms.
            units_per_second = times[0] / float(fits["exposure"][0])
            x = np.geomspace(times[0], times[-1], LINE_POINTS)
            widths_px = beam_propagation(x / units_per_second, p1, p2) + float(calibration["laser_width"])
            data.append(_make_line("p1 ln t + p2", x, widths_px))
            caption += f" The line is the law with p1 = {p1:.3f} px and p2 = {p2:.2f} px, which the simulation uses."
    layout = {"xaxis": _make_axis(label), "yaxis": _make_axis("width σ̄ / px")}
    return Curve("curve-width", "Fig. 11: Width over exposure", figure_json(data, layout), caption)


def _draw_metrics(files: Mapping[str, xr.Dataset]) -> list[Curve]:
    """Return a curve for each metric of single frames: its mean and standard deviation over frames, by source.

    Metrics without a value for any frame are omitted.
    """
    if "metrics" not in files:
        return []
    ds = files["metrics"]
    # Results, and label in their dimension `source`, of each source of the curves.
    sources = {"measured": (ds, "measured"), "simulated": (ds, "simulated")}
    if "extended_metrics" in files:
        sources["extended"] = files["extended_metrics"], "simulated"
    grid = tuple(str(dim) for dim in ds["psnr"].dims if dim not in ("registration", "data_range"))
    axes, curves = series.choose_axes(ds, grid), []
    for metric in PER_IMAGE:
        points = {
            name: series.average_frames(table[metric.name].sel(centring="light", source=source), axes)
            for name, (table, source) in sources.items()
        }
        if any(statistics.frames.any() for statistics in points.values()):
            unit, name = "" if metric.units == "1" else metric.units, metric.name.replace("_", " ")
            meaning = f"{metric.long_name[0].upper()}{metric.long_name[1:]}"
            caption = f"{meaning}. {series.frames_text(points['measured'], axes)}."
            figure = _draw_metric(ds, axes, points, style.axis_label(name, unit), unit)
            title = ": ".join(filter(None, (PAPER_FIGURES.get(metric.name), name.capitalize())))
            curves.append(Curve(f"curve-{metric.name}", title, figure, caption))
    return curves


def _draw_metric(
    ds: xr.Dataset, axes: series.PlotAxes, points: Mapping[str, series.LineStatistics], title: str, unit: str
) -> str:
    """Return the figure of a metric as JSON for Plotly: a line for each source and each value of `axes.lines`.

    Parameters
    ----------
    ds : Dataset
        Content of metrics.nc, which has the coordinates of the grid.
    axes : PlotAxes
        Role of each dimension of the grid.
    points : mapping of str to LineStatistics
        Statistics of the metric by source, a key of `COLOURS`.
    title : str
        Title of the ordinate.
    unit : str
        Unit of the metric; "" for a pure number.
    """
    x, _, label = series.axis_values(ds, axes.abscissa)
    data = []
    for source, statistics in points.items():
        is_measured = source == "measured"
        for k, line_name in enumerate(series.list_line_names(ds, axes)):
            name = f"{line_name} {source}".strip()
            attributes = {
                "marker": {"symbol": SYMBOLS[k % len(SYMBOLS)] + ("" if is_measured else "-open")},
                "hovertemplate": f"{name}: %{{y:.5~g}} {unit}<extra></extra>",
                "mode": "lines+markers",
                "line": {"color": COLOURS[source], "width": 1, "dash": SOURCE_DASHES[source]},
            }
            sd = statistics.sd[k] if np.isfinite(statistics.sd[k]).any() else None
            data.append(_make_points(name, x, statistics.mean[k], sd, source, **attributes))
    return figure_json(data, {"xaxis": _make_axis(label), "yaxis": _make_axis(title)})


def _draw_precision(ds: xr.Dataset) -> Curve | None:
    """Return the Cramér–Rao bound on the width of one frame over exposure, and the scatter of widths over repeats.

    `ds` is the content of precision.nc, which has the bound on a fine grid of exposures. Returns None without the
    bound.
    """
    if "fine_exposure" not in ds:
        return None
    times, unit, _ = series.axis_values(ds, "fine_exposure")
    # Displayed time for 1 s: 1000 if times are displayed in ms.
    units_per_second = times[0] / float(ds["fine_exposure"][0])
    data = [_make_line("bound of one frame", times, ds["sigma_bound_over_fine_exposure"].values)]
    for source, symbol in (("measured", "circle"), ("simulated", "diamond-open")):
        scatter = ds[f"scatter_{source}"].sel(parameter="sigma_mean")
        if "exposure" in scatter.coords and np.isfinite(scatter).any():
            # All conditions of an exposure in one row: [exposure, condition] in px.
            values = scatter.transpose("exposure", ...).values.reshape(scatter.sizes["exposure"], -1)
            x = np.repeat(scatter["exposure"].values * units_per_second, values.shape[1])
            attributes = {
                "marker": {"symbol": symbol},
                "hovertemplate": f"{source}: %{{y:.3~g}} px at %{{x:.4~g}} {unit}<extra></extra>",
            }
            data.append(_make_points(f"scatter, {source}", x, values.ravel(), None, source, **attributes))
    layout = {
        "xaxis": _make_axis(style.axis_label(style.NAMES["exposure"], unit), type="log", dtick=1),
        "yaxis": _make_axis("standard deviation of σ̄ / px", type="log"),
    }
    caption = summarize_precision(ds)
    return Curve("curve-precision", "Precision of a frame", figure_json(data, layout), caption, "precision")


def _draw_bounds(ds: xr.Dataset) -> Curve | None:
    """Return the Cramér–Rao bound on the width over the number of photons, for each distribution of readings.

    `ds` is the content of bounds.nc. Returns None without these bounds.
    """
    if "var_sigma_over_photons" not in ds:
        return None
    names_by_law = {str(law): READING_LAWS.get(str(law), str(law)) for law in ds["law"].values}
    bound = ds["var_sigma_over_photons"] ** 0.5
    data = [
        _make_line(name, ds["photons"].values, bound.sel(law=law).values, dash=DASHES[k % len(DASHES)])
        for k, (law, name) in enumerate(names_by_law.items())
    ]
    meanings = "; ".join(f"{name}: {ds.attrs[f'law_{law}']}" for law, name in names_by_law.items())
    layout = {
        "xaxis": _make_axis("photons on the brightest pixel", type="log"),
        "yaxis": _make_axis("bound on the sd of σ_g / px", type="log"),
    }
    caption = f"Cramér–Rao bound on the standard deviation of the width, over the light; {meanings}."
    return Curve("curve-bounds", "Fig. 13: Bounds over photons", figure_json(data, layout), caption)


def _draw_condition_gaps(ds: xr.Dataset) -> Curve | None:
    """Return the misfit of each condition before and after the effects of the verdict were added to the model.

    `ds` is the content of discrepancy.nc. It has the gap of each condition, which is the mean square of block residuals
    over that of their noise [1]. The curve shows its square root. Returns None if the gap was not measured.
    """
    if "gap_before" not in ds:
        return None
    names = [series.condition_text(ds, place) for place in series.iterate_places(ds, map(str, ds["gap_before"].dims))]
    data = []
    # The sources give the colours only.
    for name, source, symbol in (("before", "simulated", "circle-open"), ("after", "measured", "circle")):
        if f"gap_{name}" in ds:
            rms = np.sqrt(ds[f"gap_{name}"].values.ravel())
            hover = f"{name}: %{{y:.4~g}} at %{{x}}<extra></extra>"
            data.append(_make_points(name, names, rms, None, source, marker={"symbol": symbol}, hovertemplate=hover))
    floor = np.full(len(names), float(ds["gap_floor"]) ** 0.5)
    data.append(_make_line("noise floor", names, floor, dash="dot"))
    caption = (
        f"Rms of block residuals over their noise, for each condition, on {ds.attrs['gap_on']}. The gap at the top of"
        " the page is that on held-out data."
    )
    layout = {
        "xaxis": _make_axis("", tickangle=-45, type="category"),
        "yaxis": _make_axis("rms of block residuals / σ of their noise", type="log"),
    }
    return Curve("curve-gap", "Gap by condition", figure_json(data, layout), caption, "missing-gap")


def draw_levels(transfer: xr.Dataset | None) -> Curve | None:
    """Return the variance and the nonlinearity of the levels of the flats over the signal.

    A level is a set of flats with equal light. `transfer` is the content of transfer.nc; its variables `signal` and
    `excess` are mean [DN] and variance [DN²] of each level above those of the darks. Returns None if the file is
    missing or has no levels.
    """
    if transfer is None or "signal" not in transfer:
        return None
    signal, hover = transfer["signal"].values, "signal %{x:.5~g} DN: %{y:.4~g} "
    variance, stderr = transfer["excess"].values, transfer["excess_stderr"].values
    data = [_make_points("variance", signal, variance, stderr, hovertemplate=f"{hover}DN²<extra></extra>")]
    gain, is_fitted = read_quantities(transfer)["gain"].value, transfer["fitted"].values > 0
    if np.isfinite(gain) and is_fitted.any():
        ends = np.array([0.0, signal[is_fitted].max()])
        data.append(_make_line("straight line of the gain K", ends, gain * ends, "var(--simulated)", "dash"))
    response = fit_response_line(transfer)
    stderr = 100 * transfer["flat_mean_stderr"].values / np.abs(signal)
    limit = DEVIATION_MARGIN * float(np.nanmax(np.abs(response.deviation[response.is_used]), initial=LEAST_DEVIATION))
    data += [
        trace | {"xaxis": "x2", "yaxis": "y2", "showlegend": False}
        for trace in (
            _make_points("deviation", signal, response.deviation, stderr, hovertemplate=f"{hover}%<extra></extra>"),
            _make_line("straight line", [0.0, float(np.nanmax(signal))], [0.0, 0.0], "var(--simulated)", "dash"),
        )
    ]
    layout = {
        "xaxis": _make_axis("signal over dark / DN", domain=[0, 0.46]),
        "yaxis": _make_axis("variance over dark / DN²"),
        "xaxis2": _make_axis("signal over dark / DN", domain=[0.56, 1], anchor="y2"),
        "yaxis2": _make_axis("deviation from a line / %", anchor="x2", range=[-limit, limit]),
    }
    caption = (
        "Levels of the flats. Left: variance over signal; its slope is the gain in the linear range of the sensor."
        " Right: relative deviation of the signal from a straight line in light."
    )
    return Curve("levels", "Levels", figure_json(data, layout), caption)
