"""The comparison as a file: xarray over `dataset` and `quantity`."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.report.comparison.changes import FALSE_ALARMS, FEWEST
from spotcheck.report.comparison.table import Comparison, full_text, where_text

# Variables over quantities of many units, over `dataset` and `quantity`: name, field of the number, meaning.
NUMBERS = (
    ("value", "value", "value"),
    ("stderr", "stderr", "standard error; missing where none is known"),
    ("degrees", "degrees", "degrees of freedom of the standard error"),
)
DIFFERENCES = (
    ("difference", "value", "value less that of the first dataset that has one"),
    ("difference_stderr", "stderr", "standard error of the difference"),
    ("difference_degrees", "degrees", "degrees of freedom of that (Welch and Satterthwaite)"),
    ("z", "z", "deviate of a normal law that is as odd as the difference over its error"),
    ("p_value", "p_value", "p-value of no difference, two-sided"),
)
SLOPES = (
    ("slope", "value", "slope"),
    ("slope_stderr", "stderr", "standard error of the slope"),
    ("slope_degrees", "degrees", "degrees of freedom of that"),
    ("slope_z", "z", "deviate of a normal law that is as odd as the slope over its error"),
    ("slope_p_value", "p_value", "p-value of no slope, two-sided"),
)
BOTH = ("dataset", "quantity")
MARK = "beyond chance, by Holm at the rate `false_alarms` among all that were tested"


def dataset_of(found: Comparison) -> xr.Dataset:
    """Values, differences and trends with their errors; `changed` and `slope_beyond` mark what is beyond chance."""
    labels = [own.label for own in found.sets]
    ds = xr.Dataset(
        attrs={
            "title": f"Comparison of {', '.join(labels)}",
            "dataset": ", ".join(labels),
            "false_alarms": FALSE_ALARMS,
            "tested": found.tested,
            "tested_trends": found.trends,
            "remarks": "\n".join(found.remarks),
        }
    )
    ds["dataset"] = _texts("dataset", labels, "dataset; the first is the reference")
    ds["quantity"] = _texts("quantity", [full_text(row.name) for row in found.rows], "what is compared")
    ds["group"] = _texts("quantity", [row.name.group for row in found.rows], "group of the quantity")
    ds["unit"] = _texts("quantity", [row.units for row in found.rows], "unit of the quantity")
    ds["conditions"] = _texts("quantity", [where_text(row.name.where) for row in found.rows], "conditions")
    ds["results"] = _texts("dataset", [str(own.folder) for own in found.sets], "results folder")
    statuses = [own.verdict["status"] if own.verdict else "" for own in found.sets]
    ds["status"] = _texts("dataset", statuses, "status of the verdict")
    for name, field, long_name in (
        ("error_of", "error", "what the standard error is the error of"),
        ("variable", "source", "variable of the results that the value is from"),
    ):
        texts = np.array([[getattr(own, field) for own in row.numbers] for row in found.rows], object).T
        ds[name] = (BOTH, texts, {"units": "1", "long_name": long_name})
    for fields, kind in ((NUMBERS, "numbers"), (DIFFERENCES, "changes")):
        for name, field, long_name in fields:
            values = np.array([[getattr(own, field) for own in getattr(row, kind)] for row in found.rows], float).T
            ds[name] = (BOTH, values, _attributes(field, long_name))
    changed = np.array([row.changed for row in found.rows], "i4").T
    ds["changed"] = (BOTH, changed, {"units": "1", "long_name": f"1 where the difference is {MARK}"})
    return _with_trends(ds, found)


def _with_trends(ds: xr.Dataset, found: Comparison) -> xr.Dataset:
    """Where each dataset lies, and the slopes where there are enough datasets for any."""
    unit = "day" if found.per == "day" else "1"
    ds["place"] = ("dataset", np.array(found.places), {"units": unit, "long_name": found.along})
    if len(found.sets) < FEWEST:
        return ds
    for name, field, long_name in SLOPES:
        values = np.array([getattr(row.trend, field) for row in found.rows], float)
        ds[name] = ("quantity", values, _attributes(field, long_name, f" per {found.per}"))
    beyond = np.array([row.rising for row in found.rows], "i4")
    ds["slope_beyond"] = ("quantity", beyond, {"units": "1", "long_name": f"1 where the slope is {MARK}"})
    return ds


def _texts(dim: str, texts: Sequence[str], long_name: str) -> tuple[str, np.ndarray, dict[str, str]]:
    return dim, np.array(texts, object), {"units": "1", "long_name": long_name}


def _attributes(field: str, long_name: str, per: str = "") -> dict[str, str]:
    """Attributes of a variable whose places have units of their own, if any: those in `unit`."""
    own = field in ("value", "stderr")
    attrs = {"units": f"of the quantity{per}" if own else "1", "long_name": long_name}
    return attrs | ({"infinite": "the error is not from scatter"} if field == "degrees" else {})
