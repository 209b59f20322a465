"""Tables of the results as rows of text: sensor, flats and darks, p1 and p2, fits, precision, the paper's numbers."""

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
from spotcheck.fitting.caustic import select_beam_rows
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.fit_results import PARAMETERS
from spotcheck.fitting.precision import summarize_precision
from spotcheck.io import store
from spotcheck.io.number_text import number_text, quantity_text
from spotcheck.paper.number_checks import GROUPS
from spotcheck.paper.plateau_level import estimate_plateau_levels
from spotcheck.report.dataset_page.frames import cell_label
from spotcheck.report.pages.citations import Citations

# Most rows of the table of fits; fits.nc has all of them.
MOST_FITS = 200
# Columns of the table of fit ranges, by the ends of their names in transfer.nc.
RANGE_COLUMNS = ("limit", "levels", "gain", "intercept")
# Quantities of a beam: variable of caustic.nc, words, and the unit.
BEAM = (
    ("waist_radius", "waist w0 =", "m"),
    ("waist_position", "at z0 =", "m"),
    ("divergence", "divergence θ =", "rad"),
    ("m2", "M² =", "1"),
)

Row = dict[str, Any]


def summarize_frames(frames: xr.Dataset) -> str:
    """Return the number of frames of each kind, their size and their largest reading, from frames.nc."""
    kinds, counts = np.unique(frames["kind"].values.astype(str), return_counts=True)
    listed = ", ".join(f"{count:,} {kind}" for kind, count in zip(kinds, counts, strict=True))
    size = f"{int(frames['columns'])} × {int(frames['rows'])} px"
    return f"{listed} frames of {size}, readings up to {int(frames['maximum'].max())} of {int(frames['full_scale'])} DN"


def tabulate_sensor(sensor: xr.Dataset | None, citations: Citations) -> list[Row]:
    """Return the quantities of the sensor: the values in use, and the values by each source."""
    if sensor is None:
        return []
    rows = []
    for name, (unit, long_name) in SENSOR_QUANTITIES.items():
        value, error = float(sensor[name]), float(sensor[f"{name}_stderr"])
        text = "unknown" if np.isnan(value) else "none" if np.isinf(value) else f"{value:.4g}"
        by_source = zip(
            sensor["source"].values, sensor[f"{name}_by"].values, sensor[f"{name}_by_stderr"].values, strict=True
        )
        rows.append(
            {
                "name": long_name,
                "value": citations.cite(text, f"sensor.{name}"),
                "error": "" if np.isnan(error) else citations.cite(f"± {error:.2g}", f"sensor.{name}"),
                "units": unit,
                "source": sensor[name].attrs["source"],
                "by_source": [
                    ""
                    if np.isnan(stated)
                    else citations.cite(
                        quantity_text(float(stated), float(stderr)), f"sensor.{name}_by[source={source}]"
                    )
                    for source, stated, stderr in by_source
                ],
            }
        )
    return rows


def tabulate_transfer(transfer: xr.Dataset | None, citations: Citations) -> dict[str, Any] | None:
    """Return the quantities of EMVA 1288 from flats and darks, their remarks, and gains of several fit ranges."""
    if transfer is None:
        return None
    rows = []
    for quantity in read_quantities(transfer).values():
        text = quantity_text(quantity.value, quantity.stderr)
        is_known = np.isfinite(quantity.value)
        rows.append(
            {
                "name": TRANSFER_QUANTITIES[quantity.name][2],
                "symbol": quantity.symbol,
                "value": citations.cite(text, f"transfer.{quantity.name}") if is_known else "unknown",
                "unit": "" if quantity.unit == "1" else quantity.unit,
                "why": quantity.why,
            }
        )
    ranges = [
        [
            citations.cite(text, f"transfer.range_{name}[range={k}]")
            for name, text in zip(RANGE_COLUMNS, row, strict=True)
        ]
        for k, row in enumerate(tabulate_ranges(transfer))
    ]
    return {"rows": rows, "remarks": store.remarks_of(transfer), "ranges": ranges}


def tabulate_ranges(transfer: xr.Dataset) -> list[tuple[str, str, str, str]]:
    """Return, for each fit range, its upper end in parts of saturation, number of levels, gain and intercept."""
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


def tabulate_calibration(calibration: xr.Dataset | None, citations: Citations) -> dict[str, Any] | None:
    """Return p1 and p2 by each estimator, with standard deviations and the bias found by simulation."""
    if calibration is None:
        return None
    rows = []
    for estimator in calibration["estimator"].values:
        values, label = calibration.sel(estimator=estimator), f"[estimator={estimator}]"
        row: Row = {
            "text": calibration.attrs[f"estimator_{estimator}"],
            "is_used": estimator == calibration.attrs["used"],
            "peak": citations.cite(number_text(float(values["peak"]), 4), f"calibration.peak{label}"),
        }
        for p in ("p1", "p2"):
            text = quantity_text(float(values[f"{p}_mean"]), float(values[f"{p}_stderr"]), "px")
            row[p] = {"value": citations.cite(text, f"calibration.{p}_mean{label}")}
            for name in ("sd_all", "sd_angles", "miss"):
                # Less than a millionth of a pixel is rounding of floats.
                text = number_text(round(float(values[f"{p}_{name}"]), 6), 2)
                row[p][name] = citations.cite(text, f"calibration.{p}_{name}{label}")
            row[p]["sd_repeats"] = number_text(float(values[f"{p}_sd_repeats"].mean()), 2)
        rows.append(row)
    return {
        "rows": rows,
        "laser_width": float(calibration["laser_width"]),
        "has_converged": bool(calibration["likelihood_converged"]),
    }


def tabulate_fits(dataset: Dataset, fits: xr.Dataset | None, citations: Citations) -> list[tuple[str, list[str]]]:
    """Return the first frames, each with its fitted values and standard errors, and reduced χ²."""
    if fits is None:
        return []
    chosen = select_preferred_fits(fits)
    rows = []
    for index, frame in list(dataset.cells())[:MOST_FITS]:
        fit = chosen.isel({axis.name: k for axis, k in zip(dataset.axes, index, strict=True)})
        cells = []
        for name in PARAMETERS:
            value, error = float(fit[name]), float(fit[f"{name}_stderr"])
            text = quantity_text(value, error)
            # A round spot has no orientation: its error is infinite.
            is_known = np.isfinite(value) and not np.isinf(error)
            cells.append(citations.cite_frame(text, f"fits.{name}", frame.label) if is_known else "–")
        chi2 = number_text(float(fit["chi2_reduced"]))
        cells.append(citations.cite_frame(chi2, "fits.chi2_reduced", frame.label))
        rows.append((frame.label, cells))
    return rows


def describe_fit(fits: xr.Dataset | None) -> str:
    """Return the method of the fits in the table."""
    return "" if fits is None else str(fits.attrs[f"fit_{fits.attrs['preferred']}"])


def tabulate_levels(dataset: Dataset, files: dict[str, xr.Dataset]) -> dict[str, Any] | None:
    """Return peaks by readings of the paper's equations, beside the calibrated one.

    None without calibration or sensor, or if the data sheet lacks a number of Table 3.
    """
    if "calibration" not in files or "sensor" not in files:
        return None
    used = files["calibration"].sel(estimator=files["calibration"].attrs["used"])
    p1, p2, gain = float(used["p1_mean"]), float(used["p2_mean"]), float(files["sensor"]["gain_dn_per_e"])
    longest = max(frame.exposure_s or 0.0 for frame in dataset.spots)
    try:
        rows = [
            (text, number_text(peak))
            for text, peak in estimate_plateau_levels(dataset.instrument, longest, p1, p2, gain)
        ]
    except InputError:
        return None
    return {"rows": rows, "calibrated": float(used["peak"]), "exposure": quantity_text(longest, None, "s")}


def describe_caustic(caustic: xr.Dataset | None, citations: Citations) -> Markup | None:
    """Return waist, divergence and M² in a sentence, for each axis or for the mean of both axes of a round beam."""
    if caustic is None:
        return None
    parts = []
    for words, beam in select_beam_rows(caustic).items():
        quantities = []
        for name, phrase, unit in BEAM:
            text = quantity_text(float(beam[name]), float(beam[f"{name}_stderr"]), unit)
            key = f"caustic.{name}[axis={beam['axis'].item()}]"
            quantities.append(Markup("{} {}").format(phrase, citations.cite(text, key)))
        parts.append(Markup("{}: {} {}, {}, {}").format(words, *quantities))
    return Markup(
        "The fitted widths follow a hyperbola in z ({} beam; 1/e² radii of the fitted Gaussian, standard errors); {}."
    ).format(caustic.attrs["beam"], Markup("; ").join(parts))


def tabulate_precision(precision: xr.Dataset | None, citations: Citations) -> dict[str, Any] | None:
    """Return a sentence on the precision, and for every condition scatter, bound and their ratio."""
    if precision is None:
        return None
    dims = [str(dim) for dim in precision["frames_measured"].dims]
    rows = []
    for index in np.ndindex(*(precision.sizes[dim] for dim in dims)):
        place = dict(zip(dims, index, strict=True))
        condition = precision.isel(place)
        labels = [f"{dim}={condition[dim].item() if dim in precision.coords else k}" for dim, k in place.items()]
        cells = []
        for source in ("measured", "simulated"):
            for table, parameter, text in _precision_texts(condition, source):
                key = ",".join([*labels, *([f"parameter={parameter}"] if parameter else [])])
                cells.append(citations.cite(text, f"precision.{table}_{source}[{key}]"))
        rows.append((cell_label(precision, place) or "all frames", cells))
    return {"sentence": summarize_precision(precision), "rows": rows}


def _precision_texts(condition: xr.Dataset, source: str) -> list[tuple[str, str, str]]:
    """Return the numbers of a condition: name of the variable, parameter ("" for none), and text."""

    def value(name: str, parameter: str) -> float:
        return float(condition[f"{name}_{source}"].sel(parameter=parameter))

    texts = [("frames", "", str(int(condition[f"frames_{source}"])))]
    texts += [(name, "sigma_mean", number_text(value(name, "sigma_mean"), 2)) for name in ("scatter", "bound")]
    for parameter in ("sigma_mean", "amplitude"):
        ratio, error = value("ratio", parameter), value("ratio_stderr", parameter)
        texts.append(("ratio", parameter, quantity_text(ratio, error) if np.isfinite(ratio) else "–"))
    return texts


def list_flagged_frames(dataset: Dataset, fits: xr.Dataset | None) -> list[tuple[str, str]]:
    """Return frames that are not used, or not completely, with the meanings of their flags."""
    if fits is None:
        return []
    chosen = select_preferred_fits(fits).transpose(*(axis.name for axis in dataset.axes), ...)
    status, left_out = chosen["status"].values, chosen["left_out"].values
    still_used = store.flag("clipped") | store.flag("misfit")
    rows = []
    for index, frame in dataset.cells():
        reasons = [
            left_out[index] if bit == store.flag("left_out") else text
            for bit, (_, text) in store.STATUS.items()
            if status[index] & bit and not bit & still_used
        ]
        if reasons:
            rows.append((frame.label, "; ".join(reasons)))
    return rows


def read_paper_numbers(path: Path) -> dict[str, Any] | None:
    """Return the rows of paper_numbers.csv by group, and how many of each are met; None without the file."""
    if not path.exists():
        return None
    groups: dict[str, list[dict[str, str]]] = {name: [] for name in GROUPS.values()}
    for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
        groups[GROUPS[row["group"]]].append(row)
    shares = {name: (sum(row["holds"] == "True" for row in rows), len(rows)) for name, rows in groups.items()}
    met, total = (sum(share[k] for share in shares.values()) for k in (0, 1))
    return {"groups": groups, "shares": shares, "hint": f"{met} of {total} hold"}
