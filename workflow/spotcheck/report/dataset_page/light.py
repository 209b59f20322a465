"""The light of the report: declared and learned shape side by side."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import percent_text
from spotcheck.report.figures.light import MIN_LIGHT, compare_shapes
from spotcheck.report.pages.plots import colour_scales, figure


class Shape(NamedTuple):
    """What the page says of the light: a hint for the fold, its words, and figures of maps and lines."""

    hint: str
    words: str
    maps: str
    lines: str


def shape_of(ds: xr.Dataset | None, verdict: dict[str, Any] | None, dataset: Dataset) -> Shape | None:
    """The declared and the learned shape; None where no spot could be looked at."""
    if ds is None or verdict is None or verdict["status"] == "not_assessed":
        return None
    if "skipped" in ds.attrs or verdict["light"] is None:
        return Shape("as declared", "The frames ask for no other light than the declared one.", "", "")
    shapes = compare_shapes(ds, dataset)
    u, before, after = shapes.places, shapes.declared, shapes.learned
    lights = ds.sizes["light"]
    which = "" if lights == 1 else f" Of {lights} lights, one for each pose, that is shown which is least as declared."
    words = f"{str(ds.attrs['described'])[:1].upper()}{str(ds.attrs['described'])[1:]}.{which}"
    hint = f"{percent_text(verdict['light']['power'])} of it lies elsewhere than declared"
    return Shape(hint, words, _maps(u, before, after), _lines(u, before, after))


def _maps(u: np.ndarray, before: np.ndarray, after: np.ndarray) -> str:
    scales, end = colour_scales(), 100 * float(np.abs(after - before).max())
    panels = (("declared", before, "coloraxis", "1"), ("learned", after, "coloraxis", "1"),
              ("learned − declared", 100 * (after - before), "coloraxis2", "%"))  # fmt: skip
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"annotations": []}
    step = 0.3
    for k, (title, image, scale, unit) in enumerate(panels):
        number, start = "" if k == 0 else str(k + 1), k * (step + 0.02)
        data.append({"type": "heatmap", "z": np.round(image[::2, ::2], 5), "x": u[::2], "y": u[::2], "coloraxis": scale,
                     "xaxis": f"x{number}", "yaxis": f"y{number}",
                     "hovertemplate": f"{title}: %{{z:.3~g}} {unit} of the peak<extra></extra>"})  # fmt: skip
        linked = {"matches": "x"} if k else {}
        layout[f"xaxis{number}"] = {"domain": [start, start + step], "anchor": f"y{number}", "constrain": "domain",
                                    "title": {"text": "u / σ_g"}} | linked  # fmt: skip
        layout[f"yaxis{number}"] = {"anchor": f"x{number}", "scaleanchor": f"x{number}", "autorange": "reversed",
                                    "constrain": "domain", "showticklabels": k == 0}  # fmt: skip
        layout["annotations"].append({"text": title, "x": start + step / 2, "y": 1, "xref": "paper", "yref": "paper",
                                      "yanchor": "bottom", "xanchor": "center", "showarrow": False})  # fmt: skip
    layout["coloraxis"] = {"colorscale": scales["reading"], "cmin": 0, "cmax": float(max(before.max(), after.max())),
                           "colorbar": {"title": {"text": "peak"}, "len": 0.45, "y": 0.8, "x": 1}}  # fmt: skip
    layout["coloraxis2"] = {"colorscale": scales["residual"], "cmin": -end, "cmax": end,
                            "colorbar": {"title": {"text": "%"}, "len": 0.45, "y": 0.2, "x": 1}}  # fmt: skip
    return figure(data, layout)


def _lines(u: np.ndarray, before: np.ndarray, after: np.ndarray) -> str:
    middle, data = len(u) // 2, []
    looks = {"learned": ("var(--measured)", "solid", after), "declared": ("var(--simulated)", "dash", before)}
    for name, (colour, dash, image) in looks.items():
        for number, values in (("", image[middle]), ("2", image[:, middle])):
            data.append({"type": "scatter", "mode": "lines", "name": name, "x": u, "y": np.maximum(values, MIN_LIGHT),
                         "line": {"color": colour, "dash": dash}, "xaxis": f"x{number}", "yaxis": f"y{number}",
                         "legendgroup": name, "showlegend": number == "",
                         "hovertemplate": f"{name}: %{{y:.3~g}} of the peak<extra></extra>"})  # fmt: skip
    log = {"type": "log", "range": [float(np.log10(MIN_LIGHT)), 0.1]}
    layout = {
        "xaxis": {"domain": [0, 0.47], "title": {"text": "u / σ_g, along the row through the centre"}},
        "yaxis": {"title": {"text": "light / peak"}} | log,
        "xaxis2": {"domain": [0.53, 1], "anchor": "y2", "title": {"text": "v / σ_g, along the column"}},
        "yaxis2": {"anchor": "x2", "showticklabels": False} | log,
    }
    return figure(data, layout)
