"""Pages written by rules: tables of equations and symbols, the paper's numbers, the report.

All share one shell, page.html with the style of page.css; one with plots takes plots.js and Plotly besides (`plots`). A
page is one file that fetches nothing.
"""

from pathlib import Path
from typing import Any

import jinja2

from spotcheck.io import store

TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader([Path(__file__).parent, Path(__file__).parents[1]]),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)


def write_page(path: str | Path, template: str, **content: Any) -> None:
    """Render a template of this folder to a self-contained page, whole or not at all."""
    store.write_text(path, TEMPLATES.get_template(template).render(**content))
