"""Plots on a page: Plotly itself, its colour scales, and figures as JSON for the macro of plot.html."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from spotcheck.report.figures import style

# Stops of a colour scale; Plotly draws straight lines between them.
STOPS = 17


def ingredients() -> dict[str, Any]:
    """What `write_page` needs for a page with plots: the text of plotly.js, and the scales of readings and
    residuals."""
    return {"plotly": get_plotlyjs(), "scales": colour_scales()}


def colour_scales() -> dict[str, list[tuple[float, str]]]:
    """The scales of readings and residuals."""
    return {"reading": _scale(style.IMAGE_MAP), "residual": _scale(style.DIVERGING_MAP)}


def figure(data: Sequence[Mapping[str, Any]], layout: Mapping[str, Any]) -> str:
    """A figure of Plotly as JSON that may stand inside a page. NaN becomes null; `var(--measured)` and the like are
    colours of page.css, light or dark."""
    return as_json({"data": data, "layout": layout})


def as_json(content: Any) -> str:
    """Content as JSON that may stand inside a page. NaN becomes null."""
    return to_json_plotly(content).replace("<", "\\u003c")


def _scale(name: str) -> list[tuple[float, str]]:
    """A colour map of matplotlib as Plotly has it."""
    return [(float(at), to_hex(matplotlib.colormaps[name](at))) for at in np.linspace(0, 1, STOPS)]
