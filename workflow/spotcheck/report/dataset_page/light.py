"""The section on the light: the declared shape and the learned one side by side.

The declared shape is that of the instrument file. The learned shape was fitted to the frames without assuming a
formula; all frames of a pose, which is an orientation of the sample, share it. Both shapes are light relative to the
peak of the declared Gaussian. Their coordinates u (along a row) and v (along a column) are distances from the centre of
the spot, in widths σ_g of the declared Gaussian.
"""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import percent_text
from spotcheck.report.figures.light import MIN_LIGHT, Shapes, compare_shapes
from spotcheck.report.pages.plots import colour_scales, figure_json

# Width of a map, and of the space between two maps, as shares of the width of the figure.
MAP_WIDTH, MAP_GAP = 0.3, 0.02
# A map shows every second row and column of a shape, to limit the size of the page.
MAP_STEP = 2


class LightSection(NamedTuple):
    """The section of the report on the light; the figures are "" without a learned shape."""

    hint: str  # short text beside the heading
    text: str  # one or two sentences on the shape
    maps: str = ""  # JSON for Plotly: maps of both shapes and their difference
    profiles: str = ""  # JSON for Plotly: both shapes along the row and the column through the centre


def describe_light(ds: xr.Dataset | None, verdict: dict[str, Any] | None, dataset: Dataset) -> LightSection | None:
    """Return the section on the light; None if the verdict did not assess the spots.

    Parameters
    ----------
    ds : Dataset or None
        Content of light.nc, also if that stage was skipped; None without the file.
    verdict : dict or None
        Content of verdict.json; None without the file.
    dataset : Dataset
        The dataset, whose instrument declares the shape.
    """
    if ds is None or verdict is None or verdict["status"] == "not_assessed":
        return None
    if "skipped" in ds.attrs or verdict["light"] is None:
        return LightSection("as declared", "The frames agree with the declared shape of the light.")
    shapes = compare_shapes(ds, dataset)
    description, pose_count = str(ds.attrs["described"]), ds.sizes["light"]
    selection = (
        "" if pose_count == 1 else f" Of {pose_count} lights, one for each pose, the one that differs most is shown."
    )
    text = f"{description[:1].upper()}{description[1:]}.{selection}"
    hint = f"{percent_text(verdict['light']['power'])} of its power lies elsewhere than declared"
    return LightSection(hint, text, _draw_maps(shapes), _draw_profiles(shapes))


def _draw_maps(shapes: Shapes) -> str:
    """Return maps of both shapes on one colour scale, and of their difference on another, as JSON for Plotly."""
    # The difference is in per cent of the peak.
    scales, difference = colour_scales(), 100 * (shapes.learned - shapes.declared)
    limit, peak = float(np.abs(difference).max()), float(max(shapes.declared.max(), shapes.learned.max()))
    # Title, image [row, column], name of the colour scale in Plotly's layout, and unit of each map.
    maps = (("declared", shapes.declared, "coloraxis", "1"), ("learned", shapes.learned, "coloraxis", "1"),
            ("learned − declared", difference, "coloraxis2", "%"))  # fmt: skip
    places = shapes.places[::MAP_STEP]
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"annotations": []}
    for k, (title, image, scale, unit) in enumerate(maps):
        # Plotly numbers the axes of several plots in a figure as x, x2, x3.
        axis, start = "" if k == 0 else str(k + 1), k * (MAP_WIDTH + MAP_GAP)
        data.append({"type": "heatmap", "z": np.round(image[::MAP_STEP, ::MAP_STEP], 5), "x": places, "y": places,
                     "coloraxis": scale, "xaxis": f"x{axis}", "yaxis": f"y{axis}",
                     "hovertemplate": f"{title}: %{{z:.3~g}} {unit} of the peak<extra></extra>"})  # fmt: skip
        layout[f"xaxis{axis}"] = {"domain": [start, start + MAP_WIDTH], "anchor": f"y{axis}", "constrain": "domain",
                                  "title": {"text": "u / σ_g"}} | ({"matches": "x"} if k else {})  # fmt: skip
        layout[f"yaxis{axis}"] = {"anchor": f"x{axis}", "scaleanchor": f"x{axis}", "autorange": "reversed",
                                  "constrain": "domain", "showticklabels": k == 0}  # fmt: skip
        layout["annotations"].append({"text": title, "x": start + MAP_WIDTH / 2, "y": 1, "xref": "paper",
                                      "yref": "paper", "yanchor": "bottom", "xanchor": "center",
                                      "showarrow": False})  # fmt: skip
    layout["coloraxis"] = {"colorscale": scales["reading"], "cmin": 0, "cmax": peak,
                           "colorbar": {"title": {"text": "peak"}, "len": 0.45, "y": 0.8, "x": 1}}  # fmt: skip
    layout["coloraxis2"] = {"colorscale": scales["residual"], "cmin": -limit, "cmax": limit,
                            "colorbar": {"title": {"text": "%"}, "len": 0.45, "y": 0.2, "x": 1}}  # fmt: skip
    return figure_json(data, layout)


def _draw_profiles(shapes: Shapes) -> str:
    """Return both shapes along the row and the column through the centre, as JSON for Plotly."""
    middle, data = len(shapes.places) // 2, []
    lines = {
        "learned": (shapes.learned, {"color": "var(--measured)", "dash": "solid"}),
        "declared": (shapes.declared, {"color": "var(--simulated)", "dash": "dash"}),
    }
    for name, (image, line) in lines.items():
        # The left plot with the axes x, y shows the middle row, the right one with x2, y2 the middle column.
        for axis, values in (("", image[middle]), ("2", image[:, middle])):
            data.append({"type": "scatter", "mode": "lines", "name": name, "x": shapes.places,
                         "y": np.maximum(values, MIN_LIGHT), "line": line, "xaxis": f"x{axis}", "yaxis": f"y{axis}",
                         "legendgroup": name, "showlegend": axis == "",
                         "hovertemplate": f"{name}: %{{y:.3~g}} of the peak<extra></extra>"})  # fmt: skip
    log = {"type": "log", "range": [float(np.log10(MIN_LIGHT)), 0.1]}
    layout = {
        "xaxis": {"domain": [0, 0.47], "title": {"text": "u / σ_g, along the row through the centre"}},
        "yaxis": {"title": {"text": "light / peak"}} | log,
        "xaxis2": {"domain": [0.53, 1], "anchor": "y2", "title": {"text": "v / σ_g, along the column"}},
        "yaxis2": {"anchor": "x2", "showticklabels": False} | log,
    }
    return figure_json(data, layout)
