"""Photon transfer as a file: every level with its statistics, every quantity with its standard error."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.characterization.levels import Level, Spatial
from spotcheck.characterization.photon_transfer import QUANTITIES, Quantity, Transfer, by_range, unknown
from spotcheck.io import store

COLUMNS = {
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


def dataset_of(found: Transfer, title: str, name: str) -> xr.Dataset:
    """Variables over `dark` and `flat` (levels), and over `quantity`; title and name of what was measured."""
    ds = store.add_remarks(xr.Dataset(attrs={"title": title, "dataset": name}), found.remarks)
    for kind, levels in (("dark", found.darks), ("flat", found.flats)):
        for name, (units, long_name, field) in COLUMNS.items():
            values = np.array([getattr(own, field) for own in levels], float)
            ds[f"{kind}_{name}"] = (kind, values, {"units": units, "long_name": f"{long_name} of a {kind} level"})
        _add_patterns(ds, kind, levels)
    size = len(found.flats)
    for name, values, units, long_name in (
        ("signal", found.signal, "DN", "mean reading over dark"),
        ("excess", found.excess, "DN2", "variance in time over dark"),
        ("excess_stderr", found.excess_error, "DN2", "standard error of the variance over dark"),
        ("fitted", found.fitted.astype(float), "1", "1 where the gain is fitted to the level"),
    ):
        ds[name] = ("flat", values if values.size else np.full(size, np.nan), {"units": units, "long_name": long_name})
    saturation = -1 if found.saturation is None else found.saturation
    ds["saturation"] = ((), saturation, {"units": "1", "long_name": "number of the flat at saturation; -1: none"})
    ranges = by_range(found)
    for name, units, long_name in (
        ("limit", "1", "part of saturation up to which levels are fitted"),
        ("levels", "1", "number of levels fitted"),
        ("gain", "DN/e-", "overall gain of these levels"),
        ("gain_error", "DN/e-", "standard error of the gain of these levels"),
        ("intercept", "DN", "intercept of the response of these levels"),
        ("intercept_error", "DN", "standard error of the intercept of these levels"),
    ):
        values = np.array([getattr(own, name) for own in ranges], float)
        ds[f"range_{name}"] = ("range", values, {"units": units, "long_name": long_name})
    own = list(quantities_in(found).values())
    ds["quantity"] = ("quantity", np.array(list(QUANTITIES), object), {"units": "1", "long_name": "name of a quantity"})
    for name, values, long_name in (
        ("value", np.array([q.value for q in own], float), "value in its own unit"),
        ("stderr", np.array([q.stderr for q in own], float), "standard error in its own unit"),
        ("symbol", np.array([q.symbol for q in own], object), "symbol of EMVA 1288"),
        ("unit", np.array([q.unit for q in own], object), "unit"),
        ("why", np.array([q.why for q in own], object), "why it is not known"),
    ):
        ds[name] = ("quantity", values, {"units": "1", "long_name": long_name})
    return ds


def quantities_in(found: Transfer) -> dict[str, Quantity]:
    """All quantities in the order of the standard."""
    # What nothing was said of had nothing to be told from.
    return {name: found.quantities.get(name) or unknown(name, "there are no frames for it") for name in QUANTITIES}


def _add_patterns(ds: xr.Dataset, kind: str, levels: Sequence[Level]) -> None:
    for part in Spatial._fields:
        values = np.array([getattr(own.spatial, part) for own in levels], float)
        ds[f"{kind}_pattern_{part}"] = (kind, values, {"units": "DN2", "long_name": f"variance of the pattern, {part}"})


def quantities_of(ds: xr.Dataset) -> dict[str, Quantity]:
    """The quantities of a file, by name."""
    columns = [ds[name].values for name in ("quantity", "symbol", "value", "stderr", "unit", "why")]
    return {
        str(name): Quantity(str(name), str(symbol), float(value), float(stderr), str(unit), str(why))
        for name, symbol, value, stderr, unit, why in zip(*columns, strict=True)
    }
