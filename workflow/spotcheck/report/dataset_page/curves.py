"""Curves of the report that Plotly draws from the results, with values on hover."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.transfer_data import quantities_of
from spotcheck.fitting.precision import summarize_precision
from spotcheck.metrics.crop_metrics import PER_IMAGE
from spotcheck.model.propagation import beam_propagation
from spotcheck.report.figures import series, style
from spotcheck.report.figures.photon_transfer import response_line
from spotcheck.report.pages.plots import figure

# Points of a law that is drawn as a line.
FINE = 60
COLOURS = {"measured": "var(--measured)", "simulated": "var(--simulated)"}
# Pictures of figures/ in whose place metrics are drawn here; others are called after their metric.
PICTURES = {"speckle_contrast": "fig09b", "maximum": "fig10a", "sum": "fig12"}
# What laws of the readings are called.
LAWS = {"poisson_gauss": "shot and read noise", "poisson": "shot noise alone", "dn": "a Poisson law of DN"}
# Markers of series beside each other, and dashes of the simulated ones: told apart without colour.
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star", "pentagon")


class Curve(NamedTuple):
    """A figure of the report: its name and title, Plotly's JSON, what it shows in a sentence or two, and the picture of
    figures/ in whose place it stands ("": none)."""

    name: str
    title: str
    figure: str
    caption: str
    picture: str = ""


def curves_of(files: Mapping[str, xr.Dataset]) -> list[Curve]:
    """Every curve that the results support."""
    there = {name: ds for name, ds in files.items() if "skipped" not in ds.attrs}
    found = [width(there), *metrics(there), precision(there), bounds(there), by_condition(there)]
    return [own for own in found if own is not None]


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis of Plotly with its title: quantity / unit. Signs that matplotlib sets in italics are plain."""
    return {"title": {"text": title.replace("$", "")}} | more


def points(name: str, x: Any, y: Any, error: Any = None, source: str = "measured", **more: Any) -> dict[str, Any]:
    """Points with error bars."""
    bars = {} if error is None else {"error_y": {"type": "data", "array": np.asarray(error), "thickness": 1}}
    marker = {"color": COLOURS[source], "size": 7, "line": {"width": 1, "color": COLOURS[source]}} | more.pop(
        "marker", {}
    )
    own = {"type": "scatter", "mode": "markers", "name": name, "x": np.asarray(x), "y": np.asarray(y), "marker": marker}
    return own | bars | more


def line(name: str, x: Any, y: Any, colour: str = "var(--ink)", dash: str = "solid", **more: Any) -> dict[str, Any]:
    """A line."""
    own = {"type": "scatter", "mode": "lines", "name": name, "x": np.asarray(x), "y": np.asarray(y)}
    return own | {"line": {"color": colour, "dash": dash, "width": 1.5}} | more


def width(files: Mapping[str, xr.Dataset]) -> Curve | None:
    """Fitted widths over exposure, with the law of p1 and p2."""
    if "fits" not in files or "exposure" not in files["fits"].coords or files["fits"].sizes["exposure"] < 2:
        return None
    fits = files["fits"].sel(centring="light", fit=files["fits"].attrs["preferred"])
    times, unit, label = series.coordinate(fits, "exposure")
    others = [d for d in fits["sigma_mean"].dims if d != "exposure"]
    data = []
    lines = series.design_of(fits, tuple(str(d) for d in fits["sigma_mean"].dims))
    dim = lines.across if lines.across != "exposure" else None
    for k in range(fits.sizes[dim] if dim else 1):
        own = fits.isel({dim: k}) if dim else fits
        rest = [d for d in others if d != dim]
        values, errors = (
            own[n].transpose("exposure", *rest).values.reshape(len(times), -1)
            for n in ("sigma_mean", "sigma_mean_stderr")
        )
        x = np.repeat(times[:, None], values.shape[1], axis=1)
        name = series.value_text(fits, dim, k) if dim else "measured"
        symbol = SYMBOLS[k % len(SYMBOLS)]
        hover = f"{name}: %{{y:.5~g}} ± %{{error_y.array:.2~g}} px at %{{x:.4~g}} {unit}<extra></extra>"
        data.append(
            points(name, x.ravel(), values.ravel(), errors.ravel(), marker={"symbol": symbol}, hovertemplate=hover)
        )
    caption = "Widths σ̄ of all frames with their standard errors, over exposure."
    calibration = files.get("calibration")
    if calibration is not None:
        used = calibration.sel(estimator=calibration.attrs["used"])
        p1, p2 = float(used["p1_mean"]), float(used["p2_mean"])
        if np.isfinite([p1, p2]).all():
            factor = times[0] / float(fits["exposure"][0])
            fine = np.geomspace(times[0], times[-1], FINE)
            law = beam_propagation(fine / factor, p1, p2) + float(calibration["laser_width"])
            data.append(line("p1 ln t + p2", fine, law))
            caption += f" The line is the law with p1 = {p1:.3f} px and p2 = {p2:.2f} px, on which the simulation runs."
    layout = {"xaxis": axis(label), "yaxis": axis("width σ̄ / px")}
    return Curve("curve-width", "Width over exposure", figure(data, layout), caption)


def metrics(files: Mapping[str, xr.Dataset]) -> list[Curve]:
    """Each metric of a crop, measured and simulated, mean and scatter over repeats."""
    if "metrics" not in files:
        return []
    ds = files["metrics"].sel(centring="light")
    grid = tuple(str(d) for d in ds["psnr"].dims if d not in ("registration", "data_range"))
    design, out = series.design_of(ds, grid), []
    for metric in PER_IMAGE:
        found = {source: series.points(ds[metric.name].sel(source=source), design) for source in COLOURS}
        if any(own.frames.any() for own in found.values()):
            unit, name = "" if metric.units == "1" else metric.units, metric.name.replace("_", " ").capitalize()
            caption = (
                f"{metric.long_name[0].upper()}{metric.long_name[1:]}. {series.frames_text(found['measured'], design)}."
            )
            own = _by_design(ds, design, found, style.label(name.lower(), unit), unit)
            picture = PICTURES.get(metric.name, f"metric-{metric.name.replace('_', '-')}")
            out.append(Curve(f"curve-{metric.name}", name, own, caption, picture))
    return out


def _by_design(ds: xr.Dataset, design: series.Design, found: Mapping[str, series.Points], title: str, unit: str) -> str:
    """A line for each source and each value of the design's lines."""
    x, _, label = series.coordinate(ds, design.across)
    names, data = series.line_names(ds, design), []
    for source, own in found.items():
        for k, name in enumerate(names):
            words = f"{name} {source}".strip()
            marker = {"symbol": SYMBOLS[k % len(SYMBOLS)] + ("" if source == "measured" else "-open")}
            hover = f"{words}: %{{y:.5~g}} {unit}<extra></extra>"
            dash = {"color": COLOURS[source], "width": 1, "dash": "solid" if source == "measured" else "dash"}
            error = own.sd[k] if np.isfinite(own.sd[k]).any() else None
            data.append(points(words, x, own.mean[k], error, source, marker=marker, hovertemplate=hover)
                        | {"mode": "lines+markers", "line": dash})  # fmt: skip
    return figure(data, {"xaxis": axis(label), "yaxis": axis(title)})


def precision(files: Mapping[str, xr.Dataset]) -> Curve | None:
    """The bound on the width from one frame over exposure, with the scatter over repeats."""
    ds = files.get("precision")
    if ds is None or "fine_exposure" not in ds:
        return None
    fine, unit, _ = series.coordinate(ds, "fine_exposure")
    factor = fine[0] / float(ds["fine_exposure"][0])
    data = [line("bound of one frame", fine, ds["sigma_bound_over_fine_exposure"].values)]
    for source in COLOURS:
        scatter = ds[f"scatter_{source}"].sel(parameter="sigma_mean")
        if "exposure" in scatter.coords and np.isfinite(scatter).any():
            values = scatter.transpose("exposure", ...).values.reshape(scatter.sizes["exposure"], -1)
            x = np.repeat(scatter["exposure"].values[:, None] * factor, values.shape[1], axis=1)
            marker = {"symbol": "circle" if source == "measured" else "diamond-open"}
            hover = f"{source}: %{{y:.3~g}} px at %{{x:.4~g}} {unit}<extra></extra>"
            data.append(
                points(
                    f"scatter, {source}", x.ravel(), values.ravel(), None, source, marker=marker, hovertemplate=hover
                )
            )
    layout = {
        "xaxis": axis(style.label(style.NAMES["exposure"], unit), type="log", dtick=1),
        "yaxis": axis("standard deviation of σ̄ / px", type="log"),
    }
    return Curve(
        "curve-precision", "How precisely a frame measures", figure(data, layout), summarize_precision(ds), "precision"
    )


def bounds(files: Mapping[str, xr.Dataset]) -> Curve | None:
    """Bounds on the width over photons, for each law of the readings."""
    ds = files.get("bounds")
    if ds is None or "var_sigma_over_photons" not in ds:
        return None
    dashes = ("solid", "dash", "dot", "dashdot")
    photons, bound = ds["photons"].values, ds["var_sigma_over_photons"] ** 0.5
    data = [
        line(LAWS.get(str(law), str(law)), photons, bound.sel(law=law).values, dash=dashes[k % len(dashes)])
        for k, law in enumerate(ds["law"].values)
    ]
    laws = "; ".join(f"{LAWS.get(str(law), str(law))}: {ds.attrs[f'law_{law}']}" for law in ds["law"].values)
    layout = {
        "xaxis": axis("photons on the brightest pixel", type="log"),
        "yaxis": axis("bound on the sd of σ_g / px", type="log"),
    }
    caption = f"Cramér–Rao bound on the standard deviation of the width, over the light; {laws}."
    return Curve("curve-bounds", "Bounds over photons", figure(data, layout), caption)


def by_condition(files: Mapping[str, xr.Dataset]) -> Curve | None:
    """The gap of every condition, before and after."""
    ds = files.get("discrepancy")
    if ds is None or "gap_before" not in ds:
        return None
    dims = [str(d) for d in ds["gap_before"].dims]
    places = list(np.ndindex(*(ds.sizes[d] for d in dims)))
    names = [
        ", ".join(filter(None, (series.value_text(ds, d, k) for d, k in zip(dims, at, strict=True)))) for at in places
    ]
    data = []
    for stage, source in (("before", "simulated"), ("after", "measured")):
        if f"gap_{stage}" in ds:
            values = np.sqrt(ds[f"gap_{stage}"].values.ravel())
            hover = f"{stage}: %{{y:.4~g}} at %{{x}}<extra></extra>"
            marker = {"symbol": "circle-open" if stage == "before" else "circle"}
            data.append(points(stage, names, values, None, source, marker=marker, hovertemplate=hover))
    floor = np.full(len(names), float(ds["gap_floor"]) ** 0.5)
    data.append(line("noise floor", names, floor, dash="dot"))
    caption = (
        f"Rms of residuals over their noise, in means of blocks of pixels, of each condition, on {ds.attrs['gap_on']}."
        " The gap above is that of blocks of 8 × 8 px near the spot, on held-out data."
    )
    layout = {
        "xaxis": axis("", tickangle=-45, type="category"),
        "yaxis": axis("rms of block residuals / σ of their noise", type="log"),
    }
    return Curve("curve-gap", "The gap by condition", figure(data, layout), caption, "missing-gap")


def levels(transfer: xr.Dataset | None) -> Curve | None:
    """Of flats: variance and deviation from a straight line, over the signal."""
    if transfer is None or "skipped" in transfer.attrs or "signal" not in transfer:
        return None
    signal, found = transfer["signal"].values, quantities_of(transfer)
    hover = "signal %{x:.5~g} DN: %{y:.4~g} "
    gain, used = found["gain"].value, transfer["fitted"].values > 0
    data = [
        points(
            "variance",
            signal,
            transfer["excess"].values,
            transfer["excess_stderr"].values,
            hovertemplate=hover + "DN²<extra></extra>",
        )
    ]
    if np.isfinite(gain) and used.any():
        reach = np.array([0.0, signal[used].max()])
        data.append(line("straight line of the gain K", reach, gain * reach, "var(--simulated)", "dash"))
    own = response_line(transfer)
    off = 100 * (signal / own.of(own.light) - 1)
    error = 100 * transfer["flat_mean_stderr"].values / np.abs(signal)
    most = 1.6 * float(np.nanmax(np.abs(off[own.used]), initial=0.1))
    second = {"xaxis": "x2", "yaxis": "y2", "showlegend": False}
    data.append(points("off the straight line", signal, off, error, hovertemplate=hover + "%<extra></extra>") | second)
    data.append(line("straight line", [0.0, float(np.nanmax(signal))], [0.0, 0.0], "var(--simulated)", "dash") | second)
    layout = {
        "xaxis": axis("signal over dark / DN", domain=[0, 0.46]),
        "yaxis": axis("variance over dark / DN²"),
        "xaxis2": axis("signal over dark / DN", domain=[0.56, 1], anchor="y2"),
        "yaxis2": axis("off a straight line / %", anchor="x2", range=[-most, most]),
    }
    caption = (
        "Levels of the flats: variance over signal, whose slope is the gain while the sensor is linear, and how far the"
        " signal is off a straight line in light."
    )
    return Curve("levels", "Levels", figure(data, layout), caption)
