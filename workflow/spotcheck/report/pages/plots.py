"""Plots on a page: Plotly itself, its colour scales, and figures as JSON for the macro of plot.html."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from spotcheck.report.figures import style

# Number of colours that define a colour scale; Plotly interpolates linearly between them.
STOPS = 17


def plotly_content() -> dict[str, Any]:
    """Return the variables of `write_page` for a page with plots: the text of plotly.js and the colour scales."""
    return {"plotly": get_plotlyjs(), "scales": colour_scales()}


def colour_scales() -> dict[str, list[tuple[float, str]]]:
    """Return the Plotly colour scales "reading" and "residual": lists of (position from 0 to 1, hex colour)."""
    maps = {"reading": style.IMAGE_MAP, "residual": style.DIVERGING_MAP}
    stops = np.linspace(0, 1, STOPS).tolist()
    return {name: [(stop, to_hex(matplotlib.colormaps[cmap](stop))) for stop in stops] for name, cmap in maps.items()}


def figure_json(data: Sequence[Mapping[str, Any]], layout: Mapping[str, Any]) -> str:
    """Return a Plotly figure as JSON that can be embedded in HTML.

    Colours such as `var(--measured)` are those of page.css; plots.js replaces them before Plotly draws the figure.
    """
    return embed_json({"data": data, "layout": layout})


def embed_json(content: Any) -> str:
    """Return content as JSON that can be embedded in HTML; NaN becomes null."""
    return to_json_plotly(content).replace("<", "\\u003c")
