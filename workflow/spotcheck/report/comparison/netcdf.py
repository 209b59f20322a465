"""Comparison as an xarray dataset over `dataset` and `quantity`, the content of comparison.nc.

A quantity is a number that at least two datasets have, at its conditions. A trend is the slope of its values over the
dates or the order of the datasets.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.report.comparison.changes import FALSE_ALARM_RATE, MIN_TREND_POINTS
from spotcheck.report.comparison.table import Comparison, conditions_text, label_quantity

# Variables of comparison.nc: (name, field of the record that it stores, meaning). The records are `Measurement` for
# numbers and texts, and `Change` for differences and slopes.
NUMBER_VARIABLES = (
    ("value", "value", "value"),
    ("stderr", "stderr", "standard error; missing where none is known"),
    ("degrees", "degrees", "degrees of freedom of the standard error"),
)
DIFFERENCE_VARIABLES = (
    ("difference", "value", "value less that of the first dataset that has one"),
    ("difference_stderr", "stderr", "standard error of the difference"),
    ("difference_degrees", "degrees", "degrees of freedom of that (Welch and Satterthwaite)"),
    ("z", "z", "deviate of a normal law that is as odd as the difference over its error"),
    ("p_value", "p_value", "p-value of no difference, two-sided"),
)
SLOPE_VARIABLES = (
    ("slope", "value", "slope"),
    ("slope_stderr", "stderr", "standard error of the slope"),
    ("slope_degrees", "degrees", "degrees of freedom of that"),
    ("slope_z", "z", "deviate of a normal law that is as odd as the slope over its error"),
    ("slope_p_value", "p_value", "p-value of no slope, two-sided"),
)
TEXT_VARIABLES = (
    ("error_of", "error", "what the standard error is the error of"),
    ("variable", "source", "variable of the results that the value is from"),
)
DIMS = ("dataset", "quantity")
# Words for "significant" in the meaning of a variable; `false_alarms` is an attribute of the file.
SIGNIFICANT = "beyond chance, by Holm at the rate `false_alarms` among all that were tested"

Variable = tuple[str | tuple[str, ...], np.ndarray, dict[str, str]]  # dimensions, values, attributes


def build_dataset(comparison: Comparison) -> xr.Dataset:
    """Return the numbers, differences and trends of a comparison, and which of them are significant.

    Parameters
    ----------
    comparison : Comparison
        The comparison; each of its rows becomes an element of `quantity`.

    Returns
    -------
    Dataset
        Numbers and differences over `dataset` and `quantity`, in the unit of the quantity, NaN where unknown; trends
        over `quantity`. `changed` and `slope_beyond` are 1 if a difference or a slope is significant. With fewer than
        `MIN_TREND_POINTS` datasets there are no variables of slopes.
    """
    datasets, rows, axis = comparison.datasets, comparison.rows, comparison.axis
    labels = [dataset.label for dataset in datasets]
    statuses = [dataset.verdict["status"] if dataset.verdict else "" for dataset in datasets]
    ds = xr.Dataset(
        {
            "dataset": _texts("dataset", labels, "dataset; the first is the reference"),
            "quantity": _texts("quantity", [label_quantity(row.name) for row in rows], "what is compared"),
            "group": _texts("quantity", [row.name.group for row in rows], "group of the quantity"),
            "unit": _texts("quantity", [row.units for row in rows], "unit of the quantity"),
            "conditions": _texts("quantity", [conditions_text(row.name.conditions) for row in rows], "conditions"),
            "results": _texts("dataset", [str(dataset.folder) for dataset in datasets], "results folder"),
            "status": _texts("dataset", statuses, "status of the verdict"),
        },
        attrs={
            "title": f"Comparison of {', '.join(labels)}",
            "dataset": ", ".join(labels),
            "false_alarms": FALSE_ALARM_RATE,
            "tested": comparison.tested_changes,
            "tested_trends": comparison.tested_trends,
            "remarks": "\n".join(comparison.remarks),
        },
    )
    for name, field, long_name in TEXT_VARIABLES:
        texts = [[getattr(row.numbers[k], field) for row in rows] for k in range(len(datasets))]
        ds[name] = _texts(DIMS, texts, long_name)
    numbers, changes = [row.numbers for row in rows], [row.changes for row in rows]
    for variables, records_of_rows in ((NUMBER_VARIABLES, numbers), (DIFFERENCE_VARIABLES, changes)):
        for name, field, long_name in variables:
            values = np.array([[getattr(record, field) for record in records] for records in records_of_rows], float)
            ds[name] = (DIMS, values.T, _describe_field(field, long_name))
    ds["changed"] = _flags(DIMS, np.array([row.is_changed for row in rows]).T, "difference")
    unit = "day" if axis.unit == "day" else "1"
    ds["place"] = ("dataset", np.array(axis.places), {"units": unit, "long_name": axis.name})
    if len(datasets) >= MIN_TREND_POINTS:
        for name, field, long_name in SLOPE_VARIABLES:
            values = np.array([getattr(row.trend, field) for row in rows], float)
            ds[name] = ("quantity", values, _describe_field(field, long_name, f" per {axis.unit}"))
        ds["slope_beyond"] = _flags("quantity", np.array([row.has_trend for row in rows]), "slope")
    return ds


def _texts(dims: str | tuple[str, ...], texts: Sequence, long_name: str) -> Variable:
    """Return a variable of texts; `texts` has the dimensions `dims`."""
    return dims, np.array(texts, object), {"units": "1", "long_name": long_name}


def _flags(dims: str | tuple[str, ...], flags: np.ndarray, subject: str) -> Variable:
    """Return a variable that is 1 where the difference or slope (`subject`) is significant, else 0.

    `flags` is a mask with the dimensions `dims`, True where it is significant.
    """
    long_name = f"1 where the {subject} is {SIGNIFICANT}"
    return dims, flags.astype("i4"), {"units": "1", "long_name": long_name}


def _describe_field(field: str, long_name: str, per: str = "") -> dict[str, str]:
    """Return the netCDF attributes of a variable that stores a field of a record.

    `per` follows the unit of a slope, such as " per day". `infinite` tells readers what an infinite value means.
    """
    units = f"of the quantity{per}" if field in ("value", "stderr") else "1"
    infinite = {"infinite": "the error is not from scatter"} if field == "degrees" else {}
    return {"units": units, "long_name": long_name} | infinite
