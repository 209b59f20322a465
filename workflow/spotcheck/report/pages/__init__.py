"""Self-contained HTML pages: comparisons, equations, symbols, the paper's numbers; and the shell of the report.

All pages share page.html and the style of page.css. A page with plots also includes plots.js and Plotly (`plots`). A
page is one file and loads no other file, so that it can be read offline and passed on.
"""

from pathlib import Path
from typing import Any

import jinja2

from spotcheck.io import store
from spotcheck.io.number_text import number_text, quantity_text

# Templates of this folder and of the folder `report`; they also write the Markdown of the effects. All have the
# functions that format numbers.
TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader([Path(__file__).parent, Path(__file__).parents[1]]),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.globals |= {"number_text": number_text, "quantity_text": quantity_text}


def write_page(path: str | Path, template: str, **content: Any) -> None:
    """Write a page from a template and its variables; the file appears complete or not at all.

    Parameters
    ----------
    path : str or Path
        Page to write.
    template : str
        Path of the template, relative to this folder or to the folder `report`.
    **content
        Variables of the template; text is escaped unless it is `Markup`.
    """
    store.write_text(path, TEMPLATES.get_template(template).render(**content))
