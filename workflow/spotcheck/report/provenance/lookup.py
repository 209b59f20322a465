"""Look up a number of the results by its name.

A question is the name of a number, or of a table of numbers, with labels of dimensions in brackets. A label is the
value of a coordinate or an index. Text on hover is shown by the report beside a number.
"""

import shlex
from pathlib import Path

import numpy as np

from spotcheck.errors import InputError
from spotcheck.report.provenance import netcdf
from spotcheck.report.provenance.catalog import Catalog, add_labels, load_catalog, parse_question
from spotcheck.report.provenance.frames import find_frame_index, find_frame_row
from spotcheck.report.provenance.records import CatalogEntry, Number, Source, StoredNumber


def find_number(results: str | Path, question: str) -> Number:
    """Return a number of the results with its provenance.

    Parameters
    ----------
    results : str or Path
        Results folder of a dataset.
    question : str
        Full name of a number, or the end of one, with labels of its dimensions in brackets: `p1`, `gap.closed`,
        `fits.sigma_mean[angle=90, repeat=1]`. The label `frame` names a frame by its file.

    Returns
    -------
    Number
        Value, standard error, unit, meaning, and the file that stores the number.

    Raises
    ------
    InputError
        If no number, or more than one, has this name, or if a label is missing or unknown.
    """
    results = Path(results)
    catalog = load_catalog(results)
    name, labels = parse_question(question)
    entry = catalog.find_entry(name, labels)
    stored = catalog.stored.get(entry.key) or _read_table(results, catalog, entry, labels, question)
    finite = {name: _finite_or_none(getattr(stored, name)) for name in ("value", "stderr")}
    return Number(
        **(vars(stored) | finite),
        key=add_labels(entry.key, entry, stored.labels),
        short_key=add_labels(catalog.find_short_name(entry), entry, stored.labels),
        source=catalog.sources[entry.path[0]],
    )


def _finite_or_none(value: float | None) -> float | None:
    """Return a value; None if it is None, NaN or infinite."""
    return value if value is not None and np.isfinite(value) else None


def _read_table(
    results: Path, catalog: Catalog, entry: CatalogEntry, labels: dict[str, str | int], question: str
) -> StoredNumber:
    """Return the number of a netCDF file at the labels by dimension; `frame` stands for all dimensions of the grid.

    `labels` is changed in place: the index of the frame is added. Raises `InputError`, which starts with the
    `question`, if a required label is missing.
    """
    file = entry.path[0]
    table = catalog.tables[file]
    # Only frames.nc has the dimension `frame`; other files have the dimensions of the grid.
    if "frame" in labels and "frame" in entry.dims:
        labels["frame"] = find_frame_row(table, str(labels["frame"]))
    elif "frame" in labels:
        index = find_frame_index(results, file, str(labels["frame"]))
        labels |= {dim: k for dim, k in index.items() if dim in entry.dims}
    if missing := [dim for dim in entry.required_dims if dim not in labels]:
        proposed = labels | {dim: netcdf.dim_labels(table, dim)[0] for dim in missing}
        example = add_labels(entry.key, entry, proposed)
        raise InputError(f"{question}: is one number for each {' and '.join(missing)}; write e.g. {example}")
    return netcdf.read_number(table, entry, labels)


def list_numbers(results: str | Path) -> list[str]:
    """Return the full names of all numbers that can be looked up without labels."""
    return [key for key, entry in load_catalog(Path(results)).entries.items() if not entry.required_dims]


def list_tables(results: str | Path) -> list[str]:
    """Return the full names of all tables with the dimensions that need a label: "fits.sigma_mean[angle, repeat]"."""
    entries = load_catalog(Path(results)).entries
    return [f"{key}[{', '.join(entry.required_dims)}]" for key, entry in entries.items() if entry.required_dims]


def find_related(results: Path, question: str, number: Number) -> list[Number]:
    """Return other numbers whose full name contains the short name in a question, such as p1 in the verdict.

    Returns [] for a question with labels or a name of several words.
    """
    catalog, (name, labels) = load_catalog(results), parse_question(question)
    if labels or "." in name:
        return []
    return [
        find_number(results, key)
        for key, entry in catalog.entries.items()
        if not entry.required_dims and key != number.key and (name in entry.path[1:-1] or name in entry.names())
    ]


def hover_text(number: Number) -> str:
    """Return one line with the file, variable, rule and inputs of a number."""
    return _describe_source(number.source, number.variable, number.short_key)


def frame_hover_text(results: str | Path, table: str, frame: str) -> str:
    """Return the hover text of a number of one frame without reading its value.

    Parameters
    ----------
    results : str or Path
        Results folder of a dataset.
    table : str
        Name of a table, such as `fits.sigma_mean`.
    frame : str
        Label of the frame; it is not checked.

    Raises
    ------
    InputError
        If there is no such table.
    """
    catalog = load_catalog(Path(results))
    entry = catalog.find_entry(table, ("frame",))
    return _describe_source(catalog.sources[entry.path[0]], entry.path[-1], f"{table}[frame={frame}]")


def _describe_source(source: Source, variable: str, name: str) -> str:
    """Return file, variable, rule and inputs in one line, and the command that explains the number `name`."""
    inputs = ", ".join(dict.fromkeys(item.name for item in source.inputs))
    made_by = f"by rule {source.rule}{f' from {inputs}' if inputs else ''}" if source.rule else "as given"
    # The report may be passed on; the folder of a user's file could reveal whose computer it is on.
    file = source.file if source.rule else Path(source.file).name
    return f"{file}: {spaced_variable(variable)}, {made_by}; explain: spotcheck explain {shlex.quote(name)}"


def spaced_variable(variable: str) -> str:
    """Return a variable with a space before its labels: "sigma_mean [angle=90]"."""
    return variable.replace("[", " [", 1)
