"""Tables of the results as rows of text: sensor, flats and darks, p1 and p2, fits, precision, the paper's numbers.

The width of the spot at the exposure t is p1 ln t + p2 [px]. The calibration estimates p1, p2 and the peak [DN] of a
spot by several estimators, of which the simulation uses one. A site is a place on the sample with its own p1 and p2.
An argument that is named like a netCDF file holds the content of this file. Numbers are marked text: HTML that shows
the source of a number on hover.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from markupsafe import Markup

from spotcheck.characterization.emva_quantities import QUANTITIES as TRANSFER_QUANTITIES
from spotcheck.characterization.sensor_choice import QUANTITIES as SENSOR_QUANTITIES
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset.folder import Dataset
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.fit_results import PARAMETERS
from spotcheck.fitting.precision import summarize_precision
from spotcheck.fitting.scan_caustic import ESTIMATORS, select_beam_axes
from spotcheck.io import store
from spotcheck.io.number_text import number_text, quantity_text
from spotcheck.metrics.model_comparison import compare_models, summarise_comparison
from spotcheck.paper.number_checks import GROUPS
from spotcheck.paper.plateau_level import estimate_plateau_levels
from spotcheck.report.figures import series
from spotcheck.report.pages.citations import Citations

# Largest number of rows of the table of fits; fits.nc has the fits of all frames.
MAX_FIT_ROWS = 200
# Columns of the table of ranges of levels to which a line was fitted: upper end, number of levels, gain and intercept.
# Their variables in transfer.nc have the prefix "range_".
RANGE_COLUMNS = ("limit", "levels", "gain", "intercept")
# Quantities of a beam: variable of caustic.nc, words before the value, and unit.
BEAM = (
    ("waist_radius", "waist w0 =", "m"),
    ("waist_position", "at z0 =", "m"),
    ("divergence", "divergence θ =", "rad"),
    ("m2", "M² =", "1"),
)
# Decimals of a standard deviation or bias of p1 and p2 [px]: smaller values are rounding errors of floats.
SD_DECIMALS = 6

Row = dict[str, Any]  # row of a table: texts by the names of the columns in the template


def summarize_frames(frames: xr.Dataset) -> str:
    """Return the number of frames of each kind, their size and their largest reading as text.

    `frames` is the content of frames.nc. The kinds are spot, flat and dark.
    """
    kinds, counts = np.unique(frames["kind"].values.astype(str), return_counts=True)
    kind_texts = ", ".join(f"{count:,} {kind}" for kind, count in zip(kinds, counts, strict=True))
    size = f"{int(frames['columns'])} × {int(frames['rows'])} px"
    largest = f"readings up to {int(frames['maximum'].max())} of {int(frames['full_scale'])} DN"
    return f"{kind_texts} frames of {size}, {largest}"


def tabulate_sensor(sensor: xr.Dataset, citations: Citations) -> list[Row]:
    """Return a row for each quantity of the sensor: the value in use and its source, and the value by each source.

    Sources are, for example, the data sheet and the flats. A row has the name of the quantity, its `value`, standard
    `error` and `units`, the `source` of the value, and `by_source`: value and standard error by each source.
    """
    rows = []
    for name, (unit, long_name) in SENSOR_QUANTITIES.items():
        value, error = float(sensor[name]), float(sensor[f"{name}_stderr"])
        # A full well is infinite if there is none: no pixel is ever full.
        text = "unknown" if np.isnan(value) else "none" if np.isinf(value) else f"{value:.4g}"
        # Names of the sources, and the values and standard errors that they give, each [source].
        columns = (sensor[variable].values for variable in ("source", f"{name}_by", f"{name}_by_stderr"))
        rows.append(
            {
                "name": long_name,
                "value": citations.cite(text, f"sensor.{name}"),
                "error": "" if np.isnan(error) else citations.cite(f"± {error:.2g}", f"sensor.{name}"),
                "units": unit,
                "source": sensor[name].attrs["source"],
                "by_source": [
                    citations.cite(_known_text(value_by, stderr_by), f"sensor.{name}_by[source={source}]")
                    for source, value_by, stderr_by in zip(*columns, strict=True)
                ],
            }
        )
    return rows


def _known_text(value: float, stderr: float) -> str:
    """Return a value with its standard error; "" if the value is NaN."""
    return "" if np.isnan(value) else quantity_text(float(value), float(stderr))


def tabulate_transfer(transfer: xr.Dataset, citations: Citations) -> dict[str, Any]:
    """Return the variable `transfer` of sensor.html.

    `rows` are the quantities of EMVA 1288, with the reason `why` if a quantity is unknown. `remarks` are those of the
    file. `ranges` are the rows of `tabulate_ranges`.
    """
    rows = []
    for quantity in read_quantities(transfer).values():
        _, _, meaning = TRANSFER_QUANTITIES[quantity.name]
        text = quantity_text(quantity.value, quantity.stderr)
        is_known = np.isfinite(quantity.value)
        rows.append(
            {
                "name": meaning,
                "symbol": quantity.symbol,
                "value": citations.cite(text, f"transfer.{quantity.name}") if is_known else "unknown",
                "unit": "" if quantity.unit == "1" else quantity.unit,
                "why": quantity.why,
            }
        )
    ranges = []
    for k, texts in enumerate(tabulate_ranges(transfer)):
        keys = (f"transfer.range_{name}[range={k}]" for name in RANGE_COLUMNS)
        ranges.append(list(map(citations.cite, texts, keys)))
    return {"rows": rows, "remarks": store.remarks_of(transfer), "ranges": ranges}


def tabulate_ranges(transfer: xr.Dataset) -> list[tuple[str, str, str, str]]:
    """Return a row of texts for each range of levels to which a line was fitted.

    A level is a set of flats with equal light. A row has the upper end of the range [% of saturation], the number of
    levels, the gain [DN/e-] and the intercept [DN], both with standard errors.
    """
    rows = []
    for k in range(transfer.sizes["range"]):
        fit = transfer.isel(range=k)
        gain, intercept = (
            quantity_text(float(fit[f"range_{name}"]), float(fit[f"range_{name}_error"]))
            for name in ("gain", "intercept")
        )
        limit = f"{100 * float(fit['range_limit']):.3g} %"
        rows.append((limit, f"{int(fit['range_levels'])}", gain, intercept.replace("-", "−")))
    return rows


def tabulate_calibration(calibration: xr.Dataset, citations: Citations) -> dict[str, Any]:
    """Return the variable `calibration` of calibration.html.

    `rows` has p1, p2 and the peak by each estimator. For p1 and p2, `sd_repeats`, `sd_angles` and `sd_all` are the
    standard deviations over repeats, angles and all sites [px], and `miss` is the bias that a simulation found [px].
    `laser_width` is the width of the laser in the image [px]. `has_converged` is about the estimator by maximum
    likelihood.
    """
    rows = []
    for estimator in calibration["estimator"].values:
        values, label = calibration.sel(estimator=estimator), f"[estimator={estimator}]"
        row: Row = {
            "text": calibration.attrs[f"estimator_{estimator}"],
            "is_used": estimator == calibration.attrs["used"],
            "peak": citations.cite(number_text(float(values["peak"]), digits=4), f"calibration.peak{label}"),
        }
        for p in ("p1", "p2"):
            text = quantity_text(float(values[f"{p}_mean"]), float(values[f"{p}_stderr"]), "px")
            row[p] = {"value": citations.cite(text, f"calibration.{p}_mean{label}")}
            for name in ("sd_all", "sd_angles", "miss"):
                text = number_text(round(float(values[f"{p}_{name}"]), SD_DECIMALS), digits=2)
                row[p][name] = citations.cite(text, f"calibration.{p}_{name}{label}")
            row[p]["sd_repeats"] = number_text(float(values[f"{p}_sd_repeats"].mean()), digits=2)
        rows.append(row)
    return {
        "rows": rows,
        "laser_width": float(calibration["laser_width"]),
        "has_converged": bool(calibration["likelihood_converged"]),
    }


def tabulate_fits(dataset: Dataset, fits: xr.Dataset, citations: Citations) -> list[tuple[str, list[str]]]:
    """Return (name of the frame, cells) for each of the first `MAX_FIT_ROWS` frames.

    The cells are the fitted parameters with standard errors, and the reduced χ².
    """
    preferred = select_preferred_fits(fits)
    rows = []
    for index, frame in list(dataset.cells())[:MAX_FIT_ROWS]:
        fit = preferred.isel({axis.name: k for axis, k in zip(dataset.axes, index, strict=True)})
        cells: list[str] = []
        for name in PARAMETERS:
            value, error = float(fit[name]), float(fit[f"{name}_stderr"])
            # The orientation of a round spot is not defined; its error is infinite.
            text = quantity_text(value, error) if np.isfinite(value) and not np.isinf(error) else "–"
            cells.append(citations.cite_frame(text, f"fits.{name}", frame.label))
        chi2 = number_text(float(fit["chi2_reduced"]))
        cells.append(citations.cite_frame(chi2, "fits.chi2_reduced", frame.label))
        rows.append((frame.label, cells))
    return rows


def tabulate_levels(dataset: Dataset, files: dict[str, xr.Dataset]) -> dict[str, Any] | None:
    """Return the peak of the spot [DN] by each interpretation of the equations of the paper, and the calibrated peak.

    The units of the equations do not agree, so that several interpretations are possible. `files` has the contents of
    the netCDF files by name without suffix. `rows` of the result has (interpretation, peak). Returns None if the
    instrument file lacks a number of Table 3 of the paper.
    """
    used = files["calibration"].sel(estimator=files["calibration"].attrs["used"])
    p1, p2, gain = float(used["p1_mean"]), float(used["p2_mean"]), float(files["sensor"]["gain_dn_per_e"])
    longest_s = max(frame.exposure_s or 0.0 for frame in dataset.spots)
    try:
        levels = estimate_plateau_levels(dataset.instrument, longest_s, p1, p2, gain)
        rows = [(text, number_text(peak)) for text, peak in levels]
    except InputError:
        return None
    return {"rows": rows, "calibrated": float(used["peak"]), "exposure": quantity_text(longest_s, None, "s")}


def describe_caustic(caustic: xr.Dataset, citations: Citations) -> Markup:
    """Return a sentence with waist, divergence and M² for each estimator, the one to quote first.

    A sentence describes both axes, or the mean of both axes of a round beam.
    """
    sentences = []
    for estimator in map(str, caustic["estimator"].values):
        ds = caustic.sel(estimator=estimator)
        clauses = []
        for axis_name, beam in select_beam_axes(ds).items():
            quantities = []
            for variable, words, unit in BEAM:
                text = quantity_text(float(beam[variable]), float(beam[f"{variable}_stderr"]), unit)
                key = f"caustic.{variable}[estimator={estimator}, axis={beam['axis'].item()}]"
                quantities.append(Markup("{} {}").format(words, citations.cite(text, key)))
            clauses.append(Markup("{}: {} {}, {}, {}").format(axis_name, *quantities))
        sentences.append(
            Markup("By {}, the widths follow a hyperbola in z ({} beam; 1/e² radii, standard errors); {}.").format(
                ESTIMATORS[estimator], str(ds["beam"].values), Markup("; ").join(clauses)
            )
        )
    light = f"The light is {caustic.attrs['light']}."
    missing = f" No caustic by {caustic.attrs['missing']}." if caustic.attrs["missing"] else ""
    return Markup(" ").join([*sentences, Markup("{}{}").format(light, missing)])


def tabulate_precision(precision: xr.Dataset, citations: Citations) -> dict[str, Any]:
    """Return a sentence on the precision of the fits, and a row for each condition.

    `rows` has (condition in words, cells). The cells are those of `_precision_texts` for the measured and then for the
    simulated frames.
    """
    rows = []
    for place in series.iterate_places(precision, map(str, precision["frames_measured"].dims)):
        condition = precision.isel(place)
        # The number of the dimension's value stands for a value that was not recorded.
        labels = [f"{dim}={condition[dim].item() if dim in precision.coords else k}" for dim, k in place.items()]
        cells = []
        for source in ("measured", "simulated"):
            for variable, parameter, text in _precision_texts(condition, source):
                selection = ",".join([*labels, *([f"parameter={parameter}"] if parameter else [])])
                cells.append(citations.cite(text, f"precision.{variable}_{source}[{selection}]"))
        rows.append((series.condition_text(precision, place) or "all frames", cells))
    return {"sentence": summarize_precision(precision), "rows": rows}


def _precision_texts(condition: xr.Dataset, source: str) -> list[tuple[str, str, str]]:
    """Return (variable, parameter, text) of each number of a condition.

    The numbers are the count of frames, the scatter of the width over repeats, its Cramér–Rao bound, and the ratio of
    scatter to bound for width and amplitude. The variable is that of precision.nc without its ending, which is the
    `source`, "measured" or "simulated". The parameter is "" for the count.
    """
    texts = [("frames", "", str(int(condition[f"frames_{source}"])))]
    for variable in ("scatter", "bound"):
        value = float(condition[f"{variable}_{source}"].sel(parameter="sigma_mean"))
        texts.append((variable, "sigma_mean", number_text(value, digits=2)))
    for parameter in ("sigma_mean", "amplitude"):
        ratio, error = (float(condition[f"{k}_{source}"].sel(parameter=parameter)) for k in ("ratio", "ratio_stderr"))
        texts.append(("ratio", parameter, quantity_text(ratio, error) if np.isfinite(ratio) else "–"))
    return texts


def list_flagged_frames(dataset: Dataset, fits: xr.Dataset) -> list[tuple[str, str]]:
    """Return (name, reasons) of each frame that was not fitted, or not completely.

    The reasons are the meanings of the flags of its fit.
    """
    preferred = select_preferred_fits(fits).transpose(*(axis.name for axis in dataset.axes), ...)
    # Flags, and pixels that a fit left out in words, [index of the frame in each dimension of the grid].
    status, left_out_pixels = preferred["status"].values, preferred["left_out"].values
    # Frames with only these flags are used completely.
    harmless_flags = store.flag("clipped") | store.flag("misfit")
    rows = []
    for index, frame in dataset.cells():
        reasons = [
            left_out_pixels[index] if bit == store.flag("left_out") else meaning
            for bit, (_, meaning) in store.STATUS.items()
            if status[index] & bit and not bit & harmless_flags
        ]
        if reasons:
            rows.append((frame.label, "; ".join(reasons)))
    return rows


def tabulate_models(declared: xr.Dataset, extended: xr.Dataset) -> dict[str, Any]:
    """Return the variable `models` of models.html: distances of both models from the measured frames.

    `declared` and `extended` are the contents of metrics.nc and extended_metrics.nc. A distance is the difference of a
    metric between simulated and measured frames, in standard deviations over measured repeats. `summary` has the
    distances (declared, extended) of each metric over all conditions, `rows` has those of each condition.
    """
    compared = compare_models(declared, extended)
    distances = summarise_comparison(compared)
    rows = [
        (
            row.metric,
            series.condition_text(declared, row.index),
            quantity_text(row.measured, row.measured_sd),
            # Value and distance of the declared and of the extended model.
            *(f"{number_text(value, 4)} ({number_text(distance, 2)})"
              for value, distance in zip((row.declared, row.extended), row.distances(), strict=True)),
        )
        for row in compared
    ]  # fmt: skip
    summary = {name: tuple(map(number_text, pair)) for name, pair in distances.items()}
    closer = sum(of_extended < of_declared for of_declared, of_extended in distances.values())
    return {"summary": summary, "rows": rows, "hint": f"extended nearer in {closer} of {len(summary)} metrics"}


def read_paper_numbers(path: Path) -> dict[str, Any] | None:
    """Return the variable `numbers` of numbers.html, from the file paper_numbers.csv; None without the file.

    The file has a row for each number or statement of the paper, which `holds` if our value is in its accepted
    interval. `groups` are the rows by the words for their group. `shares` has (rows that hold, all rows) of each group.
    """
    if not path.exists():
        return None
    groups: dict[str, list[dict[str, str]]] = {name: [] for name in GROUPS.values()}
    for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
        groups[GROUPS[row["group"]]].append(row)
    shares = {name: (sum(row["holds"] == "True" for row in rows), len(rows)) for name, rows in groups.items()}
    met, total = (sum(share[k] for share in shares.values()) for k in (0, 1))
    return {"groups": groups, "shares": shares, "hint": f"{met} of {total} hold"}
