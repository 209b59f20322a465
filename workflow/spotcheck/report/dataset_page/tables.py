"""Tables of the report as rows of text: the verdict, sensor, p1 and p2, fits, precision, the paper's numbers."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from markupsafe import Markup

from spotcheck.characterization.photon_transfer import QUANTITIES as MEASURED
from spotcheck.characterization.sensor_choice import QUANTITIES
from spotcheck.characterization.transfer_data import quantities_of
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import (
    condition_text,
    digits_of,
    limit_text,
    number_text,
    over_noise_text,
    percent_text,
    value_text,
)
from spotcheck.errors import InputError
from spotcheck.fitting.caustic import select_beam_rows
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.fit_results import PARAMETERS
from spotcheck.fitting.precision import summarize_precision
from spotcheck.io import store
from spotcheck.io.plus_minus import plus_minus
from spotcheck.model.effect import Effect
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.paper.level import readings
from spotcheck.report.dataset_page.frames import label_of
from spotcheck.report.dataset_page.spoken import numbers_in
from spotcheck.report.pages.cited import Cited

# Rows of the table of fits; all of them are in fits.nc.
MOST_FITS = 200
# Columns of the table of `ranges`, by the ends of their names in transfer.nc.
RANGES = ("limit", "levels", "gain", "intercept")
# What is said of the beam: variable of caustic.nc, words, factor to the unit, and the unit.
BEAM = (
    ("waist_radius", "waist w0 =", 1e6, "µm"),
    ("waist_position", "at z0 =", 1e3, "mm"),
    ("divergence", "divergence θ =", 1e3, "mrad"),
    ("m2", "M² =", 1.0, ""),
)


def facts_of(table: xr.Dataset) -> dict[str, Any]:
    """What frames.nc says of all frames together."""
    kinds, counts = np.unique(table["kind"].values.astype(str), return_counts=True)
    return {
        "kinds": ", ".join(f"{n:,} {kind}" for kind, n in zip(kinds, counts, strict=True)),
        "shape": f"{int(table['columns'])} × {int(table['rows'])} px",
        "bits": int(table["container_bits"]),
        "full_scale": int(table["full_scale"]),
        "clipped": int((table["at_full_scale"] > 0).sum()),
        "maximum": int(table["maximum"].max()),
    }


def sensor_of(ds: xr.Dataset | None, cite: Cited) -> list[dict[str, Any]]:
    """The sensor's numbers: that which the chain runs on, and what each source says."""
    if ds is None:
        return []
    rows = []
    for name, (units, long_name) in QUANTITIES.items():
        value, error = float(ds[name]), float(ds[f"{name}_stderr"])
        rows.append(
            {
                "name": long_name,
                "value": cite(
                    "unknown" if np.isnan(value) else "none" if np.isinf(value) else f"{value:.4g}", f"sensor.{name}"
                ),
                "error": "" if np.isnan(error) else cite(f"± {error:.2g}", f"sensor.{name}"),
                "units": units,
                "source": ds[name].attrs["source"],
                "by": [
                    "" if np.isnan(v) else cite(plus_minus(float(v), float(e)), f"sensor.{name}_by[source={source}]")
                    for source, v, e in zip(
                        ds["source"].values, ds[f"{name}_by"].values, ds[f"{name}_by_stderr"].values, strict=True
                    )
                ],
            }
        )
    return rows


def transfer_of(ds: xr.Dataset | None, cite: Cited) -> dict[str, Any] | None:
    """Quantities of EMVA 1288, and remarks on flats and darks."""
    if ds is None:
        return None
    rows = []
    for own in quantities_of(ds).values():
        known = np.isfinite(own.value)
        rows.append(
            {
                "name": MEASURED[own.name][2],
                "symbol": own.symbol,
                "value": cite(plus_minus(own.value, own.stderr), f"transfer.{own.name}") if known else "unknown",
                "unit": "" if own.unit == "1" else own.unit,
                "why": own.why,
            }
        )
    cited = [
        [cite(text, f"transfer.range_{name}[range={k}]") for name, text in zip(RANGES, row, strict=True)]
        for k, row in enumerate(ranges(ds))
    ]
    return {"rows": rows, "remarks": store.remarks_of(ds), "ranges": cited}


def ranges(ds: xr.Dataset) -> list[tuple[str, str, str, str]]:
    """Rows of text: up to which part of saturation levels are fitted, how many they are, gain and intercept."""
    return [
        (
            f"{100 * float(own['range_limit']):.3g} %",
            f"{int(own['range_levels'])}",
            plus_minus(float(own["range_gain"]), float(own["range_gain_error"])),
            plus_minus(float(own["range_intercept"]), float(own["range_intercept_error"])).replace("-", "−"),
        )
        for own in (ds.isel(range=k) for k in range(ds.sizes["range"]))
    ]


def calibration_of(ds: xr.Dataset | None, cite: Cited) -> dict[str, Any] | None:
    """p1 and p2 by each estimator."""
    if ds is None or "skipped" in ds.attrs:
        return None
    rows = []
    for name in ds["estimator"].values:
        own = ds.sel({"estimator": name})
        row: dict[str, Any] = {"text": ds.attrs[f"estimator_{name}"], "used": name == ds.attrs["used"]}
        for p in ("p1", "p2"):
            mean, stderr = float(own[f"{p}_mean"]), float(own[f"{p}_stderr"])
            row[p] = {"value": cite(value_text(mean, stderr, "px"), f"calibration.{p}_mean[estimator={name}]")}
            for key in ("sd_all", "sd_angles", "miss"):
                # Less than a millionth of a pixel is the rounding of floats.
                text = number_text(round(float(own[f"{p}_{key}"]), 6), 2)
                row[p][key] = cite(text, f"calibration.{p}_{key}[estimator={name}]")
            row[p]["sd_repeats"] = number_text(float(own[f"{p}_sd_repeats"].mean()), 2)
        row["peak"] = cite(number_text(float(own["peak"]), 4), f"calibration.peak[estimator={name}]")
        rows.append(row)
    return {"rows": rows, "laser_width": float(ds["laser_width"]), "converged": bool(ds["likelihood_converged"])}


def fits_of(dataset: Dataset, fits: xr.Dataset | None, cite: Cited) -> list[tuple[str, list[str]]]:
    """Frame, and its fitted values with standard errors, for the first frames of a dataset."""
    if fits is None:
        return []
    dims = tuple(axis.name for axis in dataset.axes)
    own = select_preferred_fits(fits).transpose(*dims)
    rows = []
    for index, frame in list(dataset.cells())[:MOST_FITS]:
        at = own.isel(dict(zip(dims, index, strict=True)))
        cells = []
        for name in PARAMETERS:
            value, error = float(at[name]), float(at[f"{name}_stderr"])
            digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 4)) if error > 0 and np.isfinite(error) else 2
            text = f"{value:.{digits}f} ± {error:.{digits}f}".replace("-", "−")
            # A round spot has no orientation: its error is infinite.
            is_known = np.isfinite(value) and not np.isinf(error)
            cells.append(cite.of_frame(text, f"fits.{name}", frame.label) if is_known else "–")
        chi2 = float(at["chi2_reduced"])
        cells.append("–" if np.isnan(chi2) else cite.of_frame(number_text(chi2), "fits.chi2_reduced", frame.label))
        rows.append((frame.label, cells))
    return rows


def fit_text(fits: xr.Dataset | None) -> str:
    """How the spots of the table were fitted."""
    return "" if fits is None else str(fits.attrs[f"fit_{fits.attrs['preferred']}"])


def levels_of(dataset: Dataset, files: dict[str, xr.Dataset]) -> dict[str, Any] | None:
    """Readings of the paper's absolute level beside the calibrated one; None where the data sheet has not all of
    Table 3."""
    calibration, sensor = files.get("calibration"), files.get("sensor")
    if calibration is None or "skipped" in calibration.attrs or sensor is None:
        return None
    own = calibration.sel({"estimator": calibration.attrs["used"]})
    longest = max(f.exposure_s or 0.0 for f in dataset.spots)
    try:
        rows = readings(
            dataset.instrument, longest, float(own["p1_mean"]), float(own["p2_mean"]), float(sensor["gain_dn_per_e"])
        )
    except InputError:
        return None
    told = [(text, number_text(value)) for text, value in rows]
    return {"rows": told, "calibrated": float(own["peak"]), "exposure": value_text(longest, None, "s")}


def caustic_of(ds: xr.Dataset | None, cite: Cited) -> Markup | None:
    """Waist, divergence and M² in a sentence for the mean of both axes of a round beam, or for each of them."""
    if ds is None or "skipped" in ds.attrs:
        return None

    def told(own: xr.Dataset, name: str, words: str, scale: float, unit: str) -> Markup:
        text = plus_minus(float(own[name]) * scale, float(own[f"{name}_stderr"]) * scale, unit).replace("-", "−")
        return Markup("{} {}").format(words, cite(text, f"caustic.{name}[axis={own['axis'].item()}]"))

    parts = [
        Markup("{}: {} {}, {}, {}").format(words, *(told(own, *row) for row in BEAM))
        for words, own in select_beam_rows(ds).items()
    ]
    return Markup(
        "The fitted widths follow a hyperbola in z ({} beam; 1/e² radii of the fitted Gaussian, standard errors); {}."
    ).format(ds.attrs["beam"], Markup("; ").join(parts))


def precision_of(ds: xr.Dataset | None, cite: Cited) -> dict[str, Any] | None:
    """The sentence, and scatter over bound of every condition."""
    if ds is None or "skipped" in ds.attrs:
        return None
    dims = [str(d) for d in ds["frames_measured"].dims]
    rows = []
    for at in np.ndindex(*(ds.sizes[d] for d in dims)):
        own = ds.isel(dict(zip(dims, at, strict=True)))
        inside = [f"{d}={own[d].item() if d in ds.coords else k}" for d, k in zip(dims, at, strict=True)]
        cells = []
        for source in ("measured", "simulated"):
            told = [(f"frames_{source}", "", str(int(own[f"frames_{source}"])))]
            told += [
                (
                    f"{what}_{source}",
                    "sigma_mean",
                    number_text(float(own[f"{what}_{source}"].sel(parameter="sigma_mean")), 2),
                )
                for what in ("scatter", "bound")
            ]
            for name in ("sigma_mean", "amplitude"):
                ratio, error = (float(own[f"{q}_{source}"].sel(parameter=name)) for q in ("ratio", "ratio_stderr"))
                told.append((f"ratio_{source}", name, plus_minus(ratio, error) if np.isfinite(ratio) else "–"))
            for table, parameter, text in told:
                labels = ",".join([*inside, *([f"parameter={parameter}"] if parameter else [])])
                cells.append(cite(text, f"precision.{table}[{labels}]"))
        rows.append((label_of(ds, dict(zip(dims, at, strict=True))) or "all frames", cells))
    return {"sentence": summarize_precision(ds), "rows": rows}


def sheet_of(verdict: dict[str, Any] | None, cite: Cited) -> dict[str, Any] | None:
    """What the data sheet states beside what the frames say."""
    if not verdict or not verdict["sheet"]:
        return None
    rows = [
        {
            "name": own["name"].replace("_", " "),
            "stated": cite(
                value_text(own["stated"], own["stated_stderr"], own["unit"]), f"verdict.sheet.{own['name']}.stated"
            ),
            "found": cite(value_text(own["found"], own["stderr"], own["unit"]), f"verdict.sheet.{own['name']}.found"),
            "moved": cite(
                f"{own['stated_errors']:.2g}".replace("-", "−"), f"verdict.sheet.{own['name']}.stated_errors"
            ),
            "contradicts": own["contradicts"],
        }
        for own in verdict["sheet"]
    ]
    against = sum(row["contradicts"] for row in rows)
    return {"rows": rows, "hint": f"{against} of {len(rows)} contradicted" if against else "they agree"}


def missing_of(verdict: dict[str, Any], cite: Cited) -> dict[str, Any]:
    """The verdict in rows of text."""
    # A run may leave the learned shape out of its vocabulary, but not out of its verdict.
    known = {**built_in(), **vocabulary()}
    effects = [
        {
            "name": own["name"],
            "text": known[own["name"]].sentence,
            "values": [
                (key, cite(value_text(p["value"], p["stderr"], p["unit"]), f"verdict.effects.{own['name']}.{key}"))
                for key, p in own["parameters"].items()
            ],
            "none": f"{neutral:g}" if np.isfinite(neutral := known[own["name"]].vanishes_at) else "",
            "gain": cite(number_text(own["evidence"]["gain"]), f"verdict.effects.{own['name']}.evidence.gain"),
            "z": cite(number_text(own["evidence"]["z"]), f"verdict.effects.{own['name']}.evidence.z"),
            # A learned shape is told by all frames together, and by no cells.
            "cells": "–" if own["evidence"]["consistency"] is None else own["evidence"]["consistency"]["cells"],
            "rivals": [name for name in own["candidates"] if name != own["name"]],
            "closed": cite(percent_of(_at_most_all(own["gap_closed"])), f"verdict.effects.{own['name']}.gap_closed"),
        }
        for own in verdict["effects"]
    ]
    gap = verdict["gap"]
    shifts = [
        (
            name,
            cite(_before(own), f"verdict.baseline_shift.{name}.before"),
            cite(value_text(own["after"], own["stderr"], own["unit"]), f"verdict.baseline_shift.{name}.after"),
        )
        for name, own in verdict["baseline_shift"].items()
        if own["before"] is not None and effects
    ]
    limits = [
        (
            own["effect"],
            known[own["effect"]].sentence if own["effect"] in known else "",
            cite.within(own["words"] or "–", _ends(own, known.get(own["effect"]))),
            f"{own['frames']:,}" if own["frames"] else "–",
            "; ".join(filter(None, (own["why"], own["more"]))),
        )
        for own in sorted(verdict["limits"], key=lambda own: not own["words"])
    ]
    return {
        "status": verdict["status"].replace("_", " "),
        "sentence": [cite.within(line, numbers_in(verdict)) for line in verdict["sentence"].splitlines()],
        "effects": effects,
        "gap": [cite(over_noise_text(gap[key]), f"verdict.gap.{key}") for key in ("before", "after", "noise_floor")]
        if gap["on"]
        else [],
        "gap_on": gap["on"],
        "closed": percent_of(_at_most_all(gap["closed"])),
        "shifts": shifts,
        "places": [
            (own["words"], cite(number_text(own["z"]), f"verdict.where.{k}.z"))
            for k, own in sorted(enumerate(verdict["where"]), key=lambda place: -abs(place[1]["z"]))
        ],
        "limits": limits,
        "advice": [(own["frames"], condition_text(own["condition"]), own["separates"]) for own in verdict["advice"]],
        "not_assessed": [(own["effect"], own["why"]) for own in verdict["not_assessed"]],
        "vocabulary": verdict.get("vocabulary"),
    }


def _ends(own: dict[str, Any], effect: Effect | None) -> dict[str, str]:
    """The texts of a limit's ends and their keys."""
    key = f"verdict.limits.{own['effect']}.{own['parameter']}"
    ends = [end for end in ("low", "high") if own[end] is not None]
    return {limit_text(own[end], own["unit"], effect): f"{key}.{end}" for end in ends}


def _before(own: dict[str, Any]) -> str:
    """p1 or p2 before, to the digits of the error that it has after."""
    error = own["stderr"]
    text = f"{own['before']:.{max(digits_of(error), 0)}f}".replace("-", "−") if error else number_text(own["before"], 4)
    return f"{text} {own['unit']}"


def _at_most_all(part: float | None) -> float | None:
    """Noise may close a gap by more than all of it."""
    return None if part is None else min(part, 1.0)


def percent_of(part: float | None) -> str:
    """A part in percent, a dash where it is not known."""
    return "–" if part is None else percent_text(part)


def flagged_of(dataset: Dataset, fits: xr.Dataset | None) -> list[tuple[str, str]]:
    """Frames, or pixels of them, that something kept from use, with the flags' meanings."""
    if fits is None:
        return []
    own = select_preferred_fits(fits).transpose(*(axis.name for axis in dataset.axes), ...)
    status, left_out, used = own["status"].values, own["left_out"].values, store.flag("clipped") | store.flag("misfit")
    out = []
    for index, frame in dataset.cells():
        reasons = [
            left_out[index] if bit == store.flag("left_out") else text
            for bit, (_, text) in store.STATUS.items()
            if status[index] & bit and not bit & used
        ]
        if reasons:
            out.append((frame.label, "; ".join(reasons)))
    return out


def numbers_of(path: Path) -> dict[str, Any] | None:
    """Rows of paper_numbers.csv as text, and the shares that hold."""
    if not path.exists():
        return None
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    groups: dict[str, list[dict]] = {}
    for row in rows:
        groups.setdefault(row["kind"], []).append(row)
    counted = {kind: [r for r in own if r["counted"] == "True"] for kind, own in groups.items()}
    shares = {kind: (sum(r["holds"] == "True" for r in own), len(own)) for kind, own in counted.items() if own}
    return {"groups": groups, "shares": shares}
