"""Figures: one function a picture, one small module a family. A module lists its own in `FIGURES`, and no other does.

A drawing function takes the results of a dataset and returns a figure with its caption, or raises `Unavailable` with
the reason that a reader is told. Nothing here computes what another stage could store.
"""

import importlib
import pkgutil
from functools import cache

from spotcheck.report.figures.entry import Category, Entry


@cache
def every_figure() -> tuple[Entry, ...]:
    """The `FIGURES` of all modules in this folder: by category, then by the names of the files."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    entries = [entry for module in modules for entry in getattr(module, "FIGURES", ())]
    return tuple(sorted(entries, key=lambda entry: list(Category).index(entry.category)))
