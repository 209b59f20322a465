"""The report: one self-contained page of a dataset's figures, tables, what was skipped, and why."""

import base64
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck import optics, store
from spotcheck.dataset import Dataset
from spotcheck.discrepancy.verdict.words import condition_text, percent_text, value_text
from spotcheck.errors import InputError
from spotcheck.estimate.caustic import beam_rows
from spotcheck.estimate.fits import preferred
from spotcheck.estimate.fitted import PARAMETERS
from spotcheck.estimate.photon_transfer import QUANTITIES as MEASURED
from spotcheck.estimate.plus_minus import plus_minus
from spotcheck.estimate.precision import sentence
from spotcheck.estimate.sensor import QUANTITIES, SOURCES
from spotcheck.estimate.transfer_data import quantities_of
from spotcheck.figures.entry import Category
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.model.spot import TOP_HAT_RADIUS
from spotcheck.pages import write_page
from spotcheck.pages.table3 import parameters
from spotcheck.paper.level import readings

# Vector pictures above this size are shown as PNG: a page must open at once.
LARGEST_SVG = 400_000
# Rows of the table of fits; all of them are in fits.nc.
MOST_FITS = 200
# Rows of the table of places; all of them are in verdict.json.


def write(dataset: Dataset, results: Path, path: Path) -> None:
    """Write report.html from what lies in a results folder."""
    index = json.loads((results / "figures" / "index.json").read_text(encoding="utf-8"))
    files = {f.stem: store.read(f).load() for f in sorted(results.glob("*.nc")) if f.stem not in ("crops", "simulated")}
    stages = [(name, ds.attrs["skipped"]) for name, ds in files.items() if "skipped" in ds.attrs]
    if not dataset.spots:
        why = "the manifest names no frame of kind spot: crops, fits and all else that follows from them"
        stages.append(("spots", why))
    figures = [f | {"image": _image(results / "figures", f["name"])} for f in index["figures"]]
    content: dict[str, Any] = {
        "title": dataset.title,
        "dataset": dataset,
        "frames": _frames(files["frames"]),
        "not_recorded": [axis.name for axis in dataset.axes if axis.values is None] if dataset.spots else [],
        "skipped": stages,
        "skipped_figures": _by_reason(index["skipped"]),
        "figures": [f for f in figures if f["category"] != Category.MISSING.value],
        "missing": _missing(results / "verdict.json"),
        "missing_figures": [f for f in figures if f["category"] == Category.MISSING.value],
        "chain": _image(results / "chain", "fig06"),
        "sensor": _sensor(files.get("sensor")),
        "sources_of_sensor": SOURCES,
        "transfer": _transfer(files.get("transfer")),
        "calibration": _calibration(files.get("calibration")),
        "caustic": _caustic(files.get("caustic")),
        "precision": _precision(files.get("precision")),
        "remarks": [(name, text) for name, ds in files.items() for text in store.remarks_of(ds)],
        "flagged": _flagged(dataset, files.get("fits")),
        "parameters": parameters(dataset, files, TOP_HAT_RADIUS),
        "fits": _fits(dataset, files.get("fits")),
        "fit_text": _fit_text(files.get("fits")),
        "levels": _levels(dataset, files),
        "numbers": _numbers(results / "paper_numbers.csv"),
        "sources": [(name, ds.attrs.get("code_version", "")) for name, ds in files.items()],
        "magnification": _magnification(dataset),
    }
    write_page(path, "report.html", **content)


def _by_reason(skipped: list[dict[str, str]]) -> list[tuple[str, list[str]]]:
    """Titles of the figures that were skipped, by the reason."""
    out: dict[str, list[str]] = {}
    for own in skipped:
        out.setdefault(own["why"], []).append(own["title"])
    return list(out.items())


def _image(folder: Path, name: str) -> str:
    """A picture as a data address: vector where it is small."""
    vector = folder / f"{name}.svg"
    chosen, kind = (vector, "svg+xml") if vector.stat().st_size < LARGEST_SVG else (folder / f"{name}.png", "png")
    return f"data:image/{kind};base64,{base64.b64encode(chosen.read_bytes()).decode()}"


def _magnification(dataset: Dataset) -> float | None:
    lens = dataset.instrument.optics
    if lens.focal_length_m is None or lens.working_distance_m is None:
        return None
    return optics.magnification(lens.focal_length_m, lens.working_distance_m)


def _frames(table: xr.Dataset) -> dict[str, Any]:
    kinds, counts = np.unique(table["kind"].values.astype(str), return_counts=True)
    return {
        "kinds": ", ".join(f"{n} {kind}" for kind, n in zip(kinds, counts, strict=True)),
        "shape": f"{int(table['columns'])} × {int(table['rows'])} px",
        "bits": int(table["container_bits"]),
        "full_scale": int(table["full_scale"]),
        "clipped": int((table["at_full_scale"] > 0).sum()),
        "maximum": int(table["maximum"].max()),
    }


def _sensor(ds: xr.Dataset | None) -> list[dict[str, Any]]:
    if ds is None:
        return []
    rows = []
    for name, (units, long_name) in QUANTITIES.items():
        value, error = float(ds[name]), float(ds[f"{name}_stderr"])
        rows.append(
            {
                "name": long_name,
                "value": "unknown" if np.isnan(value) else "none" if np.isinf(value) else f"{value:.4g}",
                "error": "" if np.isnan(error) else f"± {error:.2g}",
                "units": units,
                "source": ds[name].attrs["source"],
                "by": [
                    "" if np.isnan(v) else plus_minus(float(v), float(e))
                    for v, e in zip(ds[f"{name}_by"].values, ds[f"{name}_by_stderr"].values, strict=True)
                ],
            }
        )
    return rows


def _transfer(ds: xr.Dataset | None) -> dict[str, Any] | None:
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
                "value": plus_minus(own.value, own.stderr) if known else "unknown",
                "unit": "" if own.unit == "1" else own.unit,
                "why": own.why,
            }
        )
    return {"rows": rows, "remarks": store.remarks_of(ds), "ranges": ranges(ds)}


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


def _calibration(ds: xr.Dataset | None) -> dict[str, Any] | None:
    if ds is None or "skipped" in ds.attrs:
        return None
    rows = []
    for name in ds["estimator"].values:
        own = ds.sel({"estimator": name})
        row: dict[str, Any] = {"text": ds.attrs[f"estimator_{name}"], "used": name == ds.attrs["used"]}
        for p in ("p1", "p2"):
            row[p] = {key: _number(own[f"{p}_{key}"]) for key in ("mean", "sd_all", "sd_angles", "miss")}
            row[p]["stderr"] = _number(own[f"{p}_stderr"], ".2g")
            row[p]["sd_repeats"] = _number(own[f"{p}_sd_repeats"].mean())
        row["peak"] = _number(own["peak"], ".4g")
        rows.append(row)
    return {"rows": rows, "laser_width": float(ds["laser_width"]), "converged": bool(ds["likelihood_converged"])}


def _fits(dataset: Dataset, fits: xr.Dataset | None) -> list[tuple[str, list[str]]]:
    """Frame, and its fitted values with standard errors, for the first frames of a dataset."""
    if fits is None:
        return []
    dims = tuple(axis.name for axis in dataset.axes)
    own = preferred(fits).transpose(*dims)
    rows = []
    for index, frame in list(dataset.cells())[:MOST_FITS]:
        at = own.isel(dict(zip(dims, index, strict=True)))
        cells = []
        for name in PARAMETERS:
            value, error = float(at[name]), float(at[f"{name}_stderr"])
            digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 4)) if error > 0 and np.isfinite(error) else 2
            cells.append("–" if np.isnan(value) else f"{value:.{digits}f} ± {error:.{digits}f}")
        chi2 = float(at["chi2_reduced"])
        rows.append((frame.label, [*cells, "–" if np.isnan(chi2) else f"{chi2:.3g}"]))
    return rows


def _fit_text(fits: xr.Dataset | None) -> str:
    return "" if fits is None else str(fits.attrs[f"fit_{fits.attrs['preferred']}"])


def _levels(dataset: Dataset, files: dict[str, xr.Dataset]) -> dict[str, Any] | None:
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
    return {"rows": rows, "calibrated": float(own["peak"]), "exposure_s": longest}


def _number(value: xr.DataArray, form: str = ".3f") -> str:
    return format(float(value), form) if np.isfinite(float(value)) else "–"


def _caustic(ds: xr.Dataset | None) -> str | None:
    """Waist, divergence and M² in a sentence for the mean of both axes of a round beam, or for each of them."""
    if ds is None or "skipped" in ds.attrs:
        return None

    def quantity(own: xr.Dataset, name: str, scale: float, unit: str) -> str:
        return plus_minus(float(own[name]) * scale, float(own[f"{name}_stderr"]) * scale, unit)

    parts = [
        f"{words}: waist w0 = {quantity(own, 'waist_radius', 1e6, 'µm')}"
        f" at z0 = {quantity(own, 'waist_position', 1e3, 'mm')}, divergence θ ="
        f" {quantity(own, 'divergence', 1e3, 'mrad')}, M² = {quantity(own, 'm2', 1.0, '')}"
        for words, own in beam_rows(ds).items()
    ]
    return (
        f"The fitted widths follow a hyperbola in z ({ds.attrs['beam']} beam; 1/e² radii of the fitted Gaussian,"
        f" standard errors); {'; '.join(parts)}."
    )


def _precision(ds: xr.Dataset | None) -> dict[str, Any] | None:
    """The sentence, and scatter over bound of every condition."""
    if ds is None or "skipped" in ds.attrs:
        return None
    dims = [str(d) for d in ds["frames_measured"].dims]
    rows = []
    for at in np.ndindex(*(ds.sizes[d] for d in dims)):
        own = ds.isel(dict(zip(dims, at, strict=True)))
        places = [f"{d} {float(own[d]):.4g} {_unit(ds[d])}".strip() for d in dims if d in ds.coords]
        cells = []
        for source in ("measured", "simulated"):
            cells.append(str(int(own[f"frames_{source}"])))
            for name in ("sigma_mean", "amplitude"):
                ratio, error = (float(own[f"{q}_{source}"].sel(parameter=name)) for q in ("ratio", "ratio_stderr"))
                cells.append(plus_minus(ratio, error) if np.isfinite(ratio) else "–")
            cells.insert(-2, _number(own[f"scatter_{source}"].sel(parameter="sigma_mean"), ".3g"))
            cells.insert(-2, _number(own[f"bound_{source}"].sel(parameter="sigma_mean"), ".3g"))
        rows.append((", ".join(places) or "all frames", cells))
    return {"sentence": sentence(ds), "rows": rows}


def _unit(coordinate: xr.DataArray) -> str:
    units = str(coordinate.attrs.get("units", ""))
    return {"degree": "°", "1": ""}.get(units, units)


def _missing(path: Path) -> dict[str, Any] | None:
    """The verdict in rows of text."""
    if not path.exists():
        return None
    verdict = json.loads(path.read_text(encoding="utf-8"))
    # A run may leave the learned shape out of its vocabulary, but not out of its verdict.
    known = {**built_in(), **vocabulary()}
    effects = [
        {
            "name": own["name"],
            "text": known[own["name"]].sentence,
            "values": [
                f"{key} = {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()
            ],
            "rivals": [name for name in own["candidates"] if name != own["name"]],
            "closed": percent_of(_at_most_all(own["gap_closed"])),
        }
        for own in verdict["effects"]
    ]
    gap = verdict["gap"]
    shifts = [
        (name, _plain(own["before"], ".4f"), value_text(own["after"], own["stderr"], own["unit"]))
        for name, own in verdict["baseline_shift"].items()
        if own["before"] is not None and effects
    ]
    limits = [
        (
            own["effect"],
            "–" if own["value"] is None else f"{own['parameter']} below {value_text(own['value'], None, own['unit'])}",
            own["why"],
        )
        for own in verdict["limits"]
    ]
    return {
        "status": verdict["status"].replace("_", " "),
        "sentence": verdict["sentence"].splitlines(),
        "effects": effects,
        "gap": [(key, _plain(gap[key])) for key in ("before", "after", "noise_floor")] if gap["on"] else [],
        "gap_on": gap["on"],
        "closed": percent_of(_at_most_all(gap["closed"])),
        "shifts": shifts,
        "places": [(own["words"], f"{own['z']:.3g}".replace("-", "−")) for own in verdict["where"]],
        "limits": limits,
        "advice": [(own["frames"], condition_text(own["condition"]), own["separates"]) for own in verdict["advice"]],
        "not_assessed": [(own["effect"], own["why"]) for own in verdict["not_assessed"]],
        "vocabulary": verdict.get("vocabulary"),
    }


def _plain(value: float | None, form: str = ".3g") -> str:
    return "–" if value is None else format(value, form).replace("-", "−")


def _at_most_all(part: float | None) -> float | None:
    """Noise may close a gap by more than all of it."""
    return None if part is None else min(part, 1.0)


def percent_of(part: float | None) -> str:
    """A part in percent, a dash where it is not known."""
    return "–" if part is None else percent_text(part)


def _flagged(dataset: Dataset, fits: xr.Dataset | None) -> list[tuple[str, str]]:
    """Frames, or pixels of them, that something kept from use, with the flags' meanings."""
    if fits is None:
        return []
    own = preferred(fits).transpose(*(axis.name for axis in dataset.axes), ...)
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


def _numbers(path: Path) -> dict[str, Any] | None:
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
