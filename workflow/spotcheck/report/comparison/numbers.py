"""Numbers of a results folder that can be compared with those of other datasets.

p1 and p2 are the slope and the offset [px] of the spot's width over the logarithm of the exposure. A crop is the square
part of a frame around its spot. The verdict (verdict.json) names the effects that the model of the frames lacks; its
baseline is the model without added effects.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization import photon_transfer, sensor_choice
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.errors import InputError
from spotcheck.fitting import hyperbola, scan_caustic
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.metrics.crop_metrics import PER_IMAGE

# Variables of fits.nc that are compared, with their meaning.
SPOT_VARIABLES = {
    "sigma_major": "width of the long axis",
    "sigma_minor": "width of the short axis",
    "amplitude": "amplitude",
}
# Labels of metrics.nc that select the peak signal-to-noise ratio (PSNR) of crops that are registered on their fitted
# centres, relative to the range of the sensor.
PSNR = {"registration": "fitted", "data_range": "sensor"}
# A fit with one of these flags has no usable standard error.
ERROR_UNUSABLE = store.flag("misfit") | store.flag("no_error")
# `Measurement.error` of a number without a standard error.
UNKNOWN_ERROR = "no error known"
# Groups of quantities, in the order in which they are shown.
LAW, SENSOR, EMVA, VERDICT = "p1 and p2", "Sensor", "Flats and darks", "What was added to the model"
BEAM, SPOT, METRICS = "Beam", "Spots", "Metrics"
GROUPS = (LAW, SENSOR, EMVA, VERDICT, BEAM, SPOT, METRICS)


class Condition(NamedTuple):
    """Value of a design axis at which frames were taken."""

    axis: str  # name of the axis, such as "angle"
    value: float  # value on the axis [unit]
    unit: str  # unit of the axis


class QuantityName(NamedTuple):
    """Identity of a number: numbers of datasets with equal names are compared."""

    group: str  # one of `GROUPS`
    quantity: str  # meaning of the number
    conditions: tuple[Condition, ...] = ()  # conditions of the frames; empty if the number is for all frames


@dataclass(frozen=True)
class Measurement:
    """A number with its standard error."""

    value: float = np.nan  # value [units]; NaN if the dataset lacks the number
    stderr: float = np.nan  # standard error [units]; NaN if unknown
    degrees: float = np.nan  # degrees of freedom of the standard error; infinite if it is not from scatter
    units: str = ""  # unit; "1" for a pure number, "" if the dataset lacks the number
    error: str = ""  # source of the standard error, such as "scatter of 6 sites"
    source: str = ""  # variable of the result file that holds the value


# Placeholder for a number that a dataset lacks.
ABSENT = Measurement()
# Pairs of a name and a number.
NamedMeasurements = Iterator[tuple[QuantityName, Measurement]]


def collect_numbers(files: dict[str, xr.Dataset], verdict: dict[str, Any] | None) -> dict[QuantityName, Measurement]:
    """Return every finite number of a dataset that can be compared.

    Parameters
    ----------
    files : dict of str to Dataset
        netCDF results by file name without suffix.
    verdict : dict or None
        Content of verdict.json; None if there is none.

    Returns
    -------
    dict of QuantityName to Measurement
        In the order in which numbers are shown.

    Raises
    ------
    InputError
        If a file lacks a variable because another version wrote it.
    """
    numbers: dict[QuantityName, Measurement] = {}
    for stem, read in READERS.items():
        if stem in files and "skipped" not in files[stem].attrs:
            numbers |= _read_or_refuse(f"{stem}.nc", read, files[stem])
    if "transfer" in files and "skipped" not in files["transfer"].attrs:
        # sensor.nc repeats the results of flats and darks.
        by_flats = f", by {sensor_choice.FLATS}"
        for name in [name for name in numbers if name.group == SENSOR and name.quantity.endswith(by_flats)]:
            del numbers[name]
    if verdict is not None:
        numbers |= _read_or_refuse("verdict.json", _read_verdict, verdict)
    return {name: number for name, number in numbers.items() if np.isfinite(number.value)}


def _read_or_refuse(
    file_name: str, read: Callable[[Any], NamedMeasurements], content: xr.Dataset | dict[str, Any]
) -> dict[QuantityName, Measurement]:
    """Return the numbers that `read` yields from the content of a result file, NaN included.

    Raises `InputError` if the file lacks a variable or key, as files of another version do.
    """
    try:
        return dict(read(content))
    except KeyError:
        name = getattr(content, "attrs", content)["dataset"]
        fault = f"{file_name} of {name}: is of another version; run the workflow on the dataset again"
        raise InputError(fault) from None


def _measure(value: Any, stderr: Any, units: str, error: str, source: str, degrees: float = np.inf) -> Measurement:
    """Return a `Measurement` with these fields; a value or standard error of None becomes NaN.

    A standard error of 0 counts as unknown, since no measurement is exact.
    """
    value, stderr = (np.nan if number is None else float(number) for number in (value, stderr))
    if not (np.isfinite(stderr) and stderr > 0):
        stderr, degrees, error = np.nan, np.nan, UNKNOWN_ERROR
    return Measurement(value, stderr, degrees, units, error, source)


def _read_calibration(ds: xr.Dataset) -> NamedMeasurements:
    """Yield p1 and p2 from calibration.nc, by the estimator that the simulation uses."""
    calibration = ds.sel({"estimator": ds.attrs["used"]})
    for name in ("p1", "p2"):
        sites = int(calibration[name].notnull().sum())
        mean, stderr, error = calibration[f"{name}_mean"], calibration[f"{name}_stderr"], f"scatter of {sites} sites"
        yield QuantityName(LAW, name), _measure(mean, stderr, mean.attrs["units"], error, f"{name}_mean", sites - 1)


def _read_sensor(ds: xr.Dataset) -> NamedMeasurements:
    """Yield the quantities in sensor.nc by each source: data sheet, flats and darks, spots."""
    errors = {
        sensor_choice.SHEET: "stated by the data sheet",
        sensor_choice.FLATS: "flats and darks",
        sensor_choice.SPOTS: "noise of the spots",
    }
    for name, (units, long_name) in sensor_choice.QUANTITIES.items():
        for source, error in errors.items():
            value, stderr = (ds[variable].sel({"source": source}) for variable in (f"{name}_by", f"{name}_by_stderr"))
            yield QuantityName(SENSOR, f"{long_name}, by {source}"), _measure(value, stderr, units, error, f"{name}_by")


def _read_transfer(ds: xr.Dataset) -> NamedMeasurements:
    """Yield the quantities of EMVA 1288 in transfer.nc, which are from flats and darks."""
    for quantity in read_quantities(ds).values():
        _, _, meaning = photon_transfer.QUANTITIES[quantity.name]
        number = quantity.value, quantity.stderr, quantity.unit
        name = QuantityName(EMVA, f"{meaning}, {quantity.symbol}")
        yield name, _measure(*number, "fit to the levels", f"value: {quantity.name}")


def _read_caustic(ds: xr.Dataset) -> NamedMeasurements:
    """Yield the quantities of the beam in caustic.nc by each estimator, along both axes and for the mean of both."""
    for estimator, axis in itertools.product(map(str, ds["estimator"].values), scan_caustic.AXES):
        beam = ds.sel(estimator=estimator, axis=axis)
        axis_text = "mean of both axes" if axis == "mean" else f"{axis} axis"
        for name, (units, long_name) in hyperbola.QUANTITIES.items():
            stderr, degrees = beam[f"{name}_stderr"], float(beam["degrees_of_freedom"])
            number = _measure(beam[name], stderr, units, "fit to the widths, with their scatter", name, degrees)
            yield QuantityName(BEAM, f"{long_name}, {axis_text}, {scan_caustic.ESTIMATORS[estimator]}"), number


def _read_fits(ds: xr.Dataset) -> NamedMeasurements:
    """Yield widths and amplitude of the spots in fits.nc at each condition."""
    fits = select_preferred_fits(ds)
    is_trusted = (fits["status"] & store.UNTRUSTED) == 0
    # The standard error is inflated by √χ²_red if the residuals exceed the noise, after the Particle Data Group
    # (Review of Particle Physics, Introduction 5.2.2).
    inflation = (fits["chi2_reduced"].clip(min=1) ** 0.5).where((fits["status"] & ERROR_UNUSABLE) == 0)
    for variable, meaning in SPOT_VARIABLES.items():
        stderr = (fits[f"{variable}_stderr"] * inflation).where(is_trusted)
        yield from _average_repeats(fits[variable].where(is_trusted), QuantityName(SPOT, meaning), stderr)


def _read_metrics(ds: xr.Dataset) -> NamedMeasurements:
    """Yield the quality metrics in metrics.nc of measured crops at each condition."""
    measured = ds.sel(source="measured", centring="light")
    metrics = {metric.name.replace("_", " "): measured[metric.name] for metric in PER_IMAGE}
    metrics["PSNR of measured against simulated"] = ds["psnr"].sel(PSNR)
    for meaning, values in metrics.items():
        yield from _average_repeats(values.where(np.isfinite(values)), QuantityName(METRICS, meaning))


def _average_repeats(
    values: xr.DataArray, name: QuantityName, frame_stderr: xr.DataArray | None = None
) -> NamedMeasurements:
    """Yield the mean over the repeats of each condition; NaN if no repeat is usable.

    Parameters
    ----------
    values : DataArray
        Values of frames on the grid of conditions and `repeat`; NaN if unusable. Name and unit become those of the
        numbers.
    name : QuantityName
        Name of the quantity, without conditions.
    frame_stderr : DataArray or None
        Standard error of each frame's fit, used for conditions with one usable frame. Conditions with more have the
        standard error of their scatter. None if frames have no error of their own.
    """
    mean, count = values.mean("repeat"), values.notnull().sum("repeat").values.astype(int)
    scatter_stderr = values.std("repeat", ddof=1).values / np.sqrt(count)
    # With one usable frame, this mean is the error of that frame.
    fit_stderr = np.full(mean.shape, np.nan) if frame_stderr is None else frame_stderr.mean("repeat").values
    units, source, dims = str(values.attrs["units"]), str(values.name), [str(dim) for dim in mean.dims]
    for index in np.ndindex(*mean.shape):
        conditions = tuple(
            Condition(dim, float(mean[dim].values[k]), str(values[dim].attrs["units"]))
            for dim, k in zip(dims, index, strict=True)
            if dim in mean.coords
        )
        if count[index] > 1:
            error = f"scatter of {count[index]} repeats"
            number = _measure(mean.values[index], scatter_stderr[index], units, error, source, float(count[index] - 1))
        else:
            number = _measure(mean.values[index], fit_stderr[index], units, "the fit", source)
        yield name._replace(conditions=conditions), number


def _read_verdict(verdict: dict[str, Any]) -> NamedMeasurements:
    """Yield the parameters of named effects, p1 and p2, the unexplained part and the power of the learned light.

    The learned light is a shape of the light that was fitted to the frames instead of the declared one.
    """
    error = "fit to all frames"
    for effect in verdict["effects"]:
        for key, parameter in effect["parameters"].items():
            name = QuantityName(VERDICT, f"{_effect_text(effect)}: {key}")
            yield name, _measure(parameter["value"], parameter["stderr"], parameter["unit"], error, "effects")
    # p1 and p2 depend on the other effects of the model, so that they are compared for equal sets of effects only.
    effects = ", ".join(sorted(_effect_text(effect) for effect in verdict["effects"]))
    for key, shift in verdict["baseline_shift"].items() if effects else ():
        name = QuantityName(VERDICT, f"{key} beside {effects}")
        yield name, _measure(shift["after"], shift["stderr"], shift["unit"], error, "baseline_shift")
    size, stderr = (verdict["unexplained"][key] for key in ("size", "error"))
    yield QuantityName(VERDICT, "unexplained part of the peak"), _measure(size, stderr, "1", "noise", "unexplained")
    if light := verdict["light"]:
        name = QuantityName(VERDICT, "light that is not where it is declared, as a part of all")
        yield name, _measure(light["power"], light["stderr"], "1", error, "light")


def _effect_text(effect: dict[str, Any]) -> str:
    """Return the name of an effect with its form in brackets, if it has several forms.

    Parameters of two forms have different meanings and must not be compared.
    """
    return f"{effect['name']} ({effect['form']})" if effect["form"] else str(effect["name"])


# Readers of the netCDF results, by file name without suffix, in the order of `GROUPS`.
READERS: dict[str, Callable[[xr.Dataset], NamedMeasurements]] = {
    "calibration": _read_calibration,
    "sensor": _read_sensor,
    "transfer": _read_transfer,
    "caustic": _read_caustic,
    "fits": _read_fits,
    "metrics": _read_metrics,
}


def list_files(folder: Path) -> list[Path]:
    """Return the files of a results folder with numbers that are compared, as far as they exist."""
    names = ("frames.nc", *(f"{stem}.nc" for stem in READERS), "verdict.json")
    return [folder / name for name in names if (folder / name).is_file()]
