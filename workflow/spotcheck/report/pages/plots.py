"""Plots on a page: Plotly itself, its colour scales, and figures as JSON for the macro of plot.html."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from spotcheck.report.figures import style

# Stops of a colour scale; Plotly interpolates linearly between them.
STOPS = 17


def plotly_content() -> dict[str, Any]:
    """Return the variables of `write_page` for a page with plots: the text of plotly.js and the colour scales."""
    return {"plotly": get_plotlyjs(), "scales": colour_scales()}


def colour_scales() -> dict[str, list[tuple[float, str]]]:
    """Return the colour scales of readings and residuals in the form of Plotly: (position in 0…1, hex colour)."""
    maps = {"reading": style.IMAGE_MAP, "residual": style.DIVERGING_MAP}
    positions = [float(position) for position in np.linspace(0, 1, STOPS)]
    return {name: [(p, to_hex(matplotlib.colormaps[colours](p))) for p in positions] for name, colours in maps.items()}


def figure_json(data: Sequence[Mapping[str, Any]], layout: Mapping[str, Any]) -> str:
    """Return a Plotly figure as `embed_json` does; `var(--measured)` and the like are colours of page.css."""
    return embed_json({"data": data, "layout": layout})


def embed_json(content: Any) -> str:
    """Return content as JSON that can be embedded in HTML; NaN becomes null."""
    return to_json_plotly(content).replace("<", "\\u003c")
