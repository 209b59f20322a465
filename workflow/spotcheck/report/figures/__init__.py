"""Figures of the report: each module draws one family of figures and lists them in `FIGURES`.

A drawing function takes the `Results` of a dataset and returns a `Drawing`, a figure with its caption. It raises
`Unavailable` with the reason if the results do not support the figure. Figures draw stored numbers only.
"""

import importlib
import pkgutil
from functools import cache

from spotcheck.report.figures.entry import Category, Entry


@cache
def every_figure() -> tuple[Entry, ...]:
    """Return the entries of all figures, sorted by category and within it by name of the module."""
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    entries = [entry for module in modules for entry in getattr(module, "FIGURES", ())]
    return tuple(sorted(entries, key=lambda entry: list(Category).index(entry.category)))
