"""Content of transfer.nc: the statistics of every level of flats and darks, and all quantities of EMVA 1288.

Flats are frames of uniform light, darks are frames without light. A level is all flats or darks of one light and one
exposure. The signal of a flat is its mean reading less that of its dark, and its excess is the temporal variance less
that of its dark. The pattern of a level is its mean image without noise.
"""

import numpy as np
import xarray as xr

from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.levels import PatternVariances, collect_field
from spotcheck.characterization.photon_transfer import Transfer, fit_ranges
from spotcheck.io import store

# Variable over levels → (unit, meaning, attribute of `Level`).
LEVEL_VARIABLES = {
    "exposure": ("s", "exposure", "exposure_s"),
    "photons": ("1", "photons per pixel", "photons"),
    "frames": ("1", "number of frames", "frames"),
    "mean": ("DN", "mean reading", "mean"),
    "mean_stderr": ("DN", "standard error of the mean reading", "mean_error"),
    "variance": ("DN2", "variance in time", "variance"),
    "variance_stderr": ("DN2", "standard error of the variance in time", "variance_error"),
    "at_zero": ("1", "part of the pixels that read 0", "at_zero"),
    "at_full": ("1", "part of the pixels that read full scale", "at_full"),
}
# Attribute of `RangeFit` → (unit, meaning).
RANGE_VARIABLES = {
    "limit": ("1", "part of saturation up to which levels are fitted"),
    "levels": ("1", "number of levels fitted"),
    "gain": ("DN/e-", "overall gain of these levels"),
    "gain_error": ("DN/e-", "standard error of the gain of these levels"),
    "intercept": ("DN", "intercept of the response of these levels"),
    "intercept_error": ("DN", "standard error of the intercept of these levels"),
}
# Attribute of `Quantity` → (type, meaning).
QUANTITY_VARIABLES = {
    "value": (float, "value in its own unit"),
    "stderr": (float, "standard error in its own unit"),
    "symbol": (object, "symbol of EMVA 1288"),
    "unit": (object, "unit"),
    "why": (object, "why it is not known"),
}


def build_transfer_dataset(transfer: Transfer, title: str, name: str) -> xr.Dataset:
    """Return the content of transfer.nc.

    Its variables are over `dark` and `flat` (levels), over `range` (the levels up to a part of saturation) and over
    `quantity`.

    Parameters
    ----------
    transfer : photon transfer of the flats and darks.
    title, name : title and folder name of the dataset.
    """
    ds = store.add_remarks(xr.Dataset(attrs={"title": title, "dataset": name}), transfer.remarks)
    for kind, levels in (("dark", transfer.darks), ("flat", transfer.flats)):
        for variable, (units, long_name, field) in LEVEL_VARIABLES.items():
            attributes = {"units": units, "long_name": f"{long_name} of a {kind} level"}
            ds[f"{kind}_{variable}"] = (kind, collect_field(levels, field), attributes)
        for pattern_field in PatternVariances._fields:
            values = np.array([getattr(level.pattern, pattern_field) for level in levels], float)
            attributes = {"units": "DN2", "long_name": f"variance of the pattern, {pattern_field}"}
            ds[f"{kind}_pattern_{pattern_field}"] = (kind, values, attributes)
    for variable, values, units, long_name in (
        ("signal", transfer.signal, "DN", "mean reading over dark"),
        ("excess", transfer.excess, "DN2", "variance in time over dark"),
        ("excess_stderr", transfer.excess_error, "DN2", "standard error of the variance over dark"),
        ("fitted", transfer.is_in_gain_fit.astype(float), "1", "1 where the gain is fitted to the level"),
    ):
        # The arrays are empty if no dark has two frames.
        values = values if values.size else np.full(len(transfer.flats), np.nan)
        ds[variable] = ("flat", values, {"units": units, "long_name": long_name})
    saturation = -1 if transfer.saturation is None else transfer.saturation
    ds["saturation"] = ((), saturation, {"units": "1", "long_name": "number of the flat at saturation; -1: none"})
    ranges = fit_ranges(transfer)
    for field, (units, long_name) in RANGE_VARIABLES.items():
        values = np.array([getattr(range_fit, field) for range_fit in ranges], float)
        ds[f"range_{field}"] = ("range", values, {"units": units, "long_name": long_name})
    names = np.array(list(transfer.quantities), object)
    ds["quantity"] = ("quantity", names, {"units": "1", "long_name": "name of a quantity"})
    for field, (dtype, long_name) in QUANTITY_VARIABLES.items():
        values = np.array([getattr(quantity, field) for quantity in transfer.quantities.values()], dtype)
        ds[field] = ("quantity", values, {"units": "1", "long_name": long_name})
    return ds


def read_quantities(ds: xr.Dataset) -> dict[str, Quantity]:
    """Return the quantities of EMVA 1288 in the content of transfer.nc, by name."""
    columns = [ds[name].values for name in ("quantity", "symbol", "value", "stderr", "unit", "why")]
    return {
        str(name): Quantity(str(name), str(symbol), float(value), float(stderr), str(unit), str(why))
        for name, symbol, value, stderr, unit, why in zip(*columns, strict=True)
    }
