"""Plots on a page: the code of Plotly, its colour scales, and figures as JSON.

The template plot.html has a macro `plot` that embeds a figure in a page. The script plots.js draws the figures when a
browser opens the page.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from spotcheck.report.figures import style

# Number of colours that define a colour scale; Plotly interpolates linearly between them.
STOP_COUNT = 17


def plotly_content() -> dict[str, Any]:
    """Return the variables that a template with plots needs.

    `plotly` is the text of plotly.js; `scales` are the colour scales of `colour_scales`.
    """
    return {"plotly": get_plotlyjs(), "scales": colour_scales()}


def colour_scales() -> dict[str, list[tuple[float, str]]]:
    """Return the colour scales of Plotly by name: "reading" for images, "residual" for differences around 0.

    A scale is a list of (position from 0 to 1, colour such as "#d55e00").
    """
    map_names = {"reading": style.IMAGE_MAP, "residual": style.DIVERGING_MAP}
    stops = np.linspace(0, 1, STOP_COUNT).tolist()
    return {
        scale: [(stop, to_hex(matplotlib.colormaps[map_name](stop))) for stop in stops]
        for scale, map_name in map_names.items()
    }


def figure_json(data: Sequence[Mapping[str, Any]], layout: Mapping[str, Any]) -> str:
    """Return a Plotly figure as JSON that can be embedded in HTML.

    Parameters
    ----------
    data : sequence of mapping
        Traces of the figure, as Plotly defines them. Colours such as `var(--measured)` are variables of page.css;
        plots.js replaces them before Plotly draws the figure.
    layout : mapping
        Layout of the figure, as Plotly defines it.
    """
    return embed_json({"data": data, "layout": layout})


def embed_json(content: Any) -> str:
    """Return content as JSON that can be embedded in HTML; NaN becomes null."""
    # A "<" in a text could end the script element that holds the JSON.
    return to_json_plotly(content).replace("<", "\\u003c")
