"""The numbers of a dataset that can be set beside those of another, each with its error and what that is the error of,
from the files of its results folder."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.photon_transfer import QUANTITIES as MEASURED
from spotcheck.characterization.sensor_choice import FLATS, QUANTITIES, SHEET, SPOTS
from spotcheck.characterization.transfer_data import quantities_of
from spotcheck.errors import InputError
from spotcheck.fitting.caustic import AXES
from spotcheck.fitting.caustic import QUANTITIES as OF_BEAM
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.metrics.crop_metrics import PER_IMAGE

# Columns of the spots' fits that are compared, and what a reader calls them.
OF_SPOTS = {
    "sigma_major": "width of the long axis",
    "sigma_minor": "width of the short axis",
    "amplitude": "amplitude",
}
# PSNR of crops laid over each other by their fitted centres, in the sensor's own range.
PSNR = {"registration": "fitted", "data_range": "sensor"}
# A fit with one of these flags has no error to be believed.
NO_ERROR = store.flag("misfit") | store.flag("no_error")

# A condition: name of the axis, value, unit.
Condition = tuple[str, float, str]


class Name(NamedTuple):
    """What a number is of: its group, what it is, and under which conditions."""

    group: str
    what: str
    where: tuple[Condition, ...] = ()


class Number(NamedTuple):
    """A number with its standard error (NaN: none known), the degrees of freedom of that error (infinite: not from
    scatter), the unit, what the error is of, and the variable it was read from."""

    value: float
    stderr: float
    degrees: float
    units: str
    error: str
    source: str


# What a dataset has where it lacks a number that others have.
ABSENT = Number(np.nan, np.nan, np.nan, "", "", "")
Named = Iterator[tuple[Name, Number]]
NO_ERROR_KNOWN = "no error known"


def numbers_of(files: dict[str, xr.Dataset], verdict: dict[str, Any] | None) -> dict[Name, Number]:
    """Every number of a dataset, in the order in which they are told; `files` by their name without suffix. Raises
    `InputError` for a file that lacks what this version writes."""
    known = {name: ds for name, ds in files.items() if "skipped" not in ds.attrs}
    out: dict[Name, Number] = {}
    for name, read in READERS.items():
        if name in known:
            out |= _read(f"{name}.nc", read, known[name])
    if "transfer" in known:
        # The sensor's file repeats what flats and darks say.
        out = {name: own for name, own in out.items() if not (name.group == SENSOR and FLATS in name.what)}
    if verdict is not None:
        out |= _read("verdict.json", _verdict, verdict)
    return {name: own for name, own in out.items() if np.isfinite(own.value)}


def _read(file: str, read: Callable[[Any], Named], content: Any) -> dict[Name, Number]:
    try:
        return dict(read(content))
    except KeyError:
        dataset = content["dataset"] if isinstance(content, dict) else content.attrs["dataset"]
        raise InputError(f"{file} of {dataset}: is of another version; run the workflow on the dataset again") from None


def _number(value: Any, stderr: Any, units: str, error: str, source: str, degrees: float = np.inf) -> Number:
    """A number as it is stored; an error of 0 is none, as nothing measures without."""
    error_size = np.nan if stderr is None else float(stderr)
    known = np.isfinite(error_size) and error_size > 0
    own = (error_size, degrees) if known else (np.nan, np.nan)
    return Number(np.nan if value is None else float(value), *own, units, error if known else NO_ERROR_KNOWN, source)


LAW, SENSOR, BY_FLATS, FOUND = "p1 and p2", "Sensor", "Flats and darks", "What was added to the model"
BEAM, SPOT, METRICS = "Beam", "Spots", "Metrics"
GROUPS = (LAW, SENSOR, BY_FLATS, FOUND, BEAM, SPOT, METRICS)


def _calibration(ds: xr.Dataset) -> Named:
    own = ds.sel({"estimator": ds.attrs["used"]})
    for name in ("p1", "p2"):
        sites = int(own[name].notnull().sum())
        error = f"scatter of {sites} sites"
        mean = f"{name}_mean"
        units = str(ds[mean].attrs["units"])
        yield Name(LAW, name), _number(own[mean], own[f"{name}_stderr"], units, error, mean, sites - 1)


def _sensor(ds: xr.Dataset) -> Named:
    errors = {SHEET: "stated by the data sheet", FLATS: "flats and darks", SPOTS: "noise of the spots"}
    for name, (units, long_name) in QUANTITIES.items():
        for source, error in errors.items():
            at = {"source": source}
            value, stderr = ds[f"{name}_by"].sel(at), ds[f"{name}_by_stderr"].sel(at)
            yield Name(SENSOR, f"{long_name}, by {source}"), _number(value, stderr, units, error, f"{name}_by")


def _transfer(ds: xr.Dataset) -> Named:
    for own in quantities_of(ds).values():
        name = Name(BY_FLATS, f"{MEASURED[own.name][2]}, {own.symbol}")
        yield name, _number(own.value, own.stderr, own.unit, "fit to the levels", f"value: {own.name}")


def _caustic(ds: xr.Dataset) -> Named:
    for axis in AXES:
        own = ds.sel({"axis": axis})
        degrees = float(own["degrees_of_freedom"])
        for name, (units, long_name) in OF_BEAM.items():
            error = "fit to the widths, with their scatter"
            found = _number(own[name], own[f"{name}_stderr"], units, error, name, degrees)
            yield Name(BEAM, f"{long_name}, {'mean of both axes' if axis == 'mean' else axis + ' axis'}"), found


def _fits(ds: xr.Dataset) -> Named:
    fits = select_preferred_fits(ds)
    good = (fits["status"] & store.UNTRUSTED) == 0
    # Where a fit's residuals are above the noise, its error grows with them, after the Particle Data Group (Review of
    # Particle Physics, Introduction 5.2.2).
    scale = (fits["chi2_reduced"].clip(min=1) ** 0.5).where((fits["status"] & NO_ERROR) == 0)
    for name, text in OF_SPOTS.items():
        single = (fits[f"{name}_stderr"] * scale).where(good)
        yield from _over_repeats(fits[name].where(good), single, Name(SPOT, text), "the fit")


def _metrics(ds: xr.Dataset) -> Named:
    measured = ds.sel(source="measured", centring="light")
    every = {own.name.replace("_", " "): measured[own.name] for own in PER_IMAGE}
    every["PSNR of measured against simulated"] = ds["psnr"].sel(PSNR)
    for text, values in every.items():
        yield from _over_repeats(values.where(np.isfinite(values)), None, Name(METRICS, text), "")


def _over_repeats(values: xr.DataArray, single: xr.DataArray | None, name: Name, error: str) -> Named:
    """The mean over the repeats of every condition. Its error is that of their scatter, or of two and more: of a single
    frame its own (`single`), where there is one."""
    count, mean = values.notnull().sum("repeat"), values.mean("repeat")
    scatter = (values.std("repeat", ddof=1) / np.sqrt(count)).values
    alone = np.full(mean.shape, np.nan) if single is None else single.mean("repeat").values
    units, dims = str(values.attrs["units"]), [str(d) for d in mean.dims]
    axes = {d: (mean[d].values, str(values[d].attrs["units"])) for d in dims if d in mean.coords}
    for at in np.ndindex(*mean.shape):
        number = int(count.values[at])
        where = tuple((d, float(axes[d][0][k]), axes[d][1]) for d, k in zip(dims, at, strict=True) if d in axes)
        many = number > 1
        own = (scatter[at], f"scatter of {number} repeats", number - 1) if many else (alone[at], error, np.inf)
        found = _number(mean.values[at], own[0], units, own[1], str(values.name), own[2])
        yield name._replace(where=where), found


def _verdict(verdict: dict[str, Any]) -> Named:
    for effect in verdict["effects"]:
        for key, own in effect["parameters"].items():
            name = Name(FOUND, f"{form_text(effect)}: {key}")
            yield name, _number(own["value"], own["stderr"], own["unit"], "fit to all frames", "effects")
    # What p1 and p2 are depends on what else is in the model: they are compared beside the same effects only.
    beside = ", ".join(sorted(form_text(effect) for effect in verdict["effects"]))
    for key, own in verdict["baseline_shift"].items() if beside else ():
        name = Name(FOUND, f"{key} beside {beside}")
        yield name, _number(own["after"], own["stderr"], own["unit"], "fit to all frames", "baseline_shift")
    left = verdict["unexplained"]
    yield Name(FOUND, "unexplained part of the peak"), _number(left["size"], left["error"], "1", "noise", "unexplained")
    if light := verdict["light"]:
        name = Name(FOUND, "light that is not where it is declared, as a part of all")
        yield name, _number(light["power"], light["stderr"], "1", "fit to all frames", "light")


def form_text(effect: dict[str, Any]) -> str:
    """An effect of a verdict with its form: numbers of two forms mean different things."""
    return f"{effect['name']} ({effect['form']})" if effect["form"] else str(effect["name"])


# Results that hold numbers to compare, in the order of `GROUPS`.
READERS = {
    "calibration": _calibration,
    "sensor": _sensor,
    "transfer": _transfer,
    "caustic": _caustic,
    "fits": _fits,
    "metrics": _metrics,
}


def files_in(folder: Path) -> list[Path]:
    """The files of a results folder that are compared, as far as they are there."""
    names = ("frames.nc", *(f"{name}.nc" for name in READERS), "verdict.json")
    return [folder / name for name in names if (folder / name).is_file()]
