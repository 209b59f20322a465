"""The report: one self-contained page of a dataset, from the verdict in a sentence down to what was skipped."""

import base64
import json
from pathlib import Path
from typing import Any

import xarray as xr

from spotcheck.characterization.sensor_choice import SOURCES
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import list_text
from spotcheck.io import store
from spotcheck.model import optics
from spotcheck.model.spot import TOP_HAT_RADIUS
from spotcheck.report.dataset_page import tables
from spotcheck.report.dataset_page.curves import curves_of, levels
from spotcheck.report.dataset_page.frames import NAMES, NOTHING, Files, Frames, frames_of
from spotcheck.report.dataset_page.gap import gap_of, was_added
from spotcheck.report.dataset_page.light import shape_of
from spotcheck.report.dataset_page.spoken import numbers_in, spoken
from spotcheck.report.dataset_page.table3 import parameters
from spotcheck.report.pages import plots, write_page
from spotcheck.report.pages.cited import Cited

# Vector pictures above this size are shown as PNG: a page must open at once.
LARGEST_SVG = 400_000
# Pictures in whose place the frames themselves can be looked at.
OF_FRAMES = ("overview", "residuals", "missing-answer")
# Results that hold an image for every frame; they are read frame by frame.
BY_FRAME = ("crops", "simulated", "views", "extended")


def write(dataset: Dataset, results: Path, path: Path) -> None:
    """Write report.html from what lies in a results folder."""
    files = {f.stem: store.read(f).load() for f in sorted(results.glob("*.nc")) if f.stem not in BY_FRAME}
    verdict = _read(results / "verdict.json")
    cite = Cited(results)
    content = {"cite": cite} | _first(dataset, files, verdict) | _details(dataset, results, files, verdict, cite)
    content["aside"] = _aside(dataset, results)
    content["shown"] = _shown(dataset, results, files, added=verdict is not None and was_added(verdict))
    if content["shown"] is not None:
        content |= _about(content["shown"])
    content["links"] = _links(content)
    write_page(path, "dataset_page/report.html", **plots.ingredients(), **content)


def _read(path: Path) -> Any:
    """The content of a JSON file; None where it is not there."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _first(dataset: Dataset, files: dict[str, xr.Dataset], verdict: dict[str, Any] | None) -> dict[str, Any]:
    """What the first screen says, but for its picture."""
    facts = tables.facts_of(files["frames"])
    told = f"{facts['kinds']} frames of {facts['shape']}, readings up to {facts['maximum']} of {facts['full_scale']} DN"
    return {
        "title": dataset.title,
        "facts": told,
        "spoken": spoken(verdict) if verdict else None,
        "spoken_numbers": numbers_in(verdict) if verdict else {},
        "gap": gap_of(verdict) if verdict else None,
        "levels_figure": levels(files.get("transfer")),
        "remarks": [(name, text) for name, ds in files.items() for text in store.remarks_of(ds)],
    }


def _shown(dataset: Dataset, results: Path, files: dict[str, xr.Dataset], *, added: bool) -> Frames | None:
    """The frames, where there are spots. An extended model to which nothing was `added` is the declared one again."""
    if not dataset.spots:
        return None
    with store.read(results / "crops.nc") as crops, store.read(results / "views.nc") as views:
        twice = [] if added else [str(name) for name in views if str(name).startswith("extended")]
        return frames_of(dataset, Files(files["frames"], crops, files["fits"], views.drop_vars(twice)))


def _aside(dataset: Dataset, results: Path) -> list[str]:
    """Sentences on spot frames that were set aside, or that stand out."""
    if not dataset.spots:
        return []
    with store.read(results / "crops.nc") as crops:
        return store.remarks_of(crops)


def _about(shown: Frames) -> dict[str, Any]:
    """What is said beside the frames."""
    best = shown.contents["frames"][shown.contents["best"]]
    names = [NAMES[name] for name in shown.contents["pictured"]]
    added = "extended" in shown.contents["pictured"]
    which = "The frame that shows best what was missing" if added else "The frame of which most is left"
    models = {0: "", 1: f", {names[0]}, and what it leaves"}.get(
        len(names), f", {list_text(names)}, and what each leaves"
    )
    scales = " Readings are on one scale and residuals on another, red where the frame is brighter than the model."
    worst = shown.rows[0]
    stands_out = worst["why"] != NOTHING
    return {
        "picture": f"{which} ({best['label'] or best['file']}): measured{models}.{scales if names else ''}",
        "ranked_by": NAMES[shown.ranked_by],
        "has_before": "declared" in shown.contents["names"] and shown.ranked_by == "extended",
        "worst": f"the worst: {worst['label'] or worst['file']}"
        if stands_out
        else f"none of {len(shown.rows)} stands out",
    }


def _details(
    dataset: Dataset, results: Path, files: dict[str, xr.Dataset], verdict: dict[str, Any] | None, cite: Cited
) -> dict[str, Any]:
    """What the folds hold."""
    index = _read(results / "figures" / "index.json") or {"figures": [], "skipped": []}
    stages = [(name, ds.attrs["skipped"]) for name, ds in files.items() if "skipped" in ds.attrs]
    if not dataset.spots:
        why = "the manifest names no frame of kind spot: crops, fits and all else that follows from them"
        stages.append(("spots", why))
    numbers = tables.numbers_of(results / "paper_numbers.csv")
    curves = curves_of(files)
    redrawn = {own.picture for own in curves} | set(OF_FRAMES if dataset.spots else ())
    pictures = [own for own in index["figures"] if own["name"] not in redrawn]
    return {
        "not_recorded": [axis.name for axis in dataset.axes if axis.values is None] if dataset.spots else [],
        "skipped": stages,
        "skipped_figures": _by_reason(index["skipped"]),
        "figures": [own | {"image": _image(results / "figures", own["name"])} for own in pictures],
        "missing": tables.missing_of(verdict, cite) if verdict else None,
        "light": shape_of(files.get("light"), verdict, dataset),
        "sheet": tables.sheet_of(verdict, cite),
        "curves": curves,
        "chain": _image(results / "chain", "fig06"),
        "sensor": tables.sensor_of(files.get("sensor"), cite),
        "sources_of_sensor": SOURCES,
        "transfer": tables.transfer_of(files.get("transfer"), cite),
        "calibration": tables.calibration_of(files.get("calibration"), cite),
        "caustic": tables.caustic_of(files.get("caustic"), cite),
        "precision": tables.precision_of(files.get("precision"), cite),
        "flagged": tables.flagged_of(dataset, files.get("fits")),
        "parameters": parameters(dataset, files, TOP_HAT_RADIUS, cite),
        "fits": tables.fits_of(dataset, files.get("fits"), cite),
        "fit_text": tables.fit_text(files.get("fits")),
        "levels": tables.levels_of(dataset, files),
        "numbers": numbers,
        "held": _held(numbers),
        "sources": [(name, ds.attrs.get("code_version", "")) for name, ds in files.items()],
        "magnification": _magnification(dataset),
    }


def _held(numbers: dict[str, Any] | None) -> str:
    shares = numbers["shares"].values() if numbers else ()
    return f"{sum(held for held, _ in shares)} of {sum(all_of for _, all_of in shares)} hold" if numbers else ""


def _links(content: dict[str, Any]) -> list[tuple[str, str]]:
    """From the first screen to folds, in their order."""
    every = (
        ("frames", "Look at frames", content["shown"]),
        ("table", "Which frame is worst", content["shown"]),
        ("missing", "The evidence", content["missing"]),
        ("light", "The light", content["light"]),
        ("sheet", "The data sheet", content["sheet"]),
        ("figures", "Figures", content["curves"]),
        ("sensor", "The sensor", content["sensor"] or content["transfer"]),
        ("numbers", "The paper's numbers", content["numbers"]),
        ("skipped", "What was skipped", True),
    )
    return [(name, text) for name, text, there in every if there]


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
