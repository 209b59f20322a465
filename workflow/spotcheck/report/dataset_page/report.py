"""The report: one self-contained page of a dataset, from a summary of the verdict to a list of skipped stages.

Each stage of the workflow writes one netCDF file. If a stage could not run, the attribute `skipped` of its file holds
the reason. The verdict (verdict.json) says which effects the declared model of the frames lacks. The extended model
includes these effects. Functions return parts of the page as variables of the template report.html, by name.
"""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from spotcheck.characterization.sensor_choice import SOURCES
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import list_text, over_noise_text
from spotcheck.io import store
from spotcheck.report.dataset_page import tables
from spotcheck.report.dataset_page.curves import draw_curves, draw_levels
from spotcheck.report.dataset_page.evidence import compare_data_sheet, tabulate_evidence
from spotcheck.report.dataset_page.frames import NAMES, NO_REMARK, FrameFiles, FrameSection, collect_frames
from spotcheck.report.dataset_page.gap import adds_to_model, plot_gap
from spotcheck.report.dataset_page.light import describe_light
from spotcheck.report.dataset_page.simulation_parameters import tabulate_parameters
from spotcheck.report.dataset_page.summary import number_keys, summarize
from spotcheck.report.pages import plots, write_page
from spotcheck.report.pages.citations import Citations

# SVG pictures of this size or more [byte] are embedded as PNG, so that the page opens quickly.
LARGEST_SVG = 400_000
# Names of the pictures that are omitted because the page shows the frames themselves (frames.js).
FRAME_PICTURES = ("residuals", "missing-answer")
# Names of netCDF files with an image for every frame, which are too large to be loaded whole.
FRAME_RESULTS = ("crops", "simulated", "views", "extended")

Content = dict[str, Any]  # variables of the template report.html by name
Stages = dict[str, xr.Dataset]  # contents of netCDF files by file name without suffix

# Functions that return the table of a result, by the name of its file, which is also that of the variable of the page.
TABLES: dict[str, Callable[[xr.Dataset, Citations], Any]] = {
    "sensor": tables.tabulate_sensor,
    "transfer": tables.tabulate_transfer,
    "calibration": tables.tabulate_calibration,
    "caustic": tables.describe_caustic,
    "precision": tables.tabulate_precision,
}
# Titles of the tables from docstrings, by their path below the results folder.
TABLES_OF_CODE = {
    "docs/equations.html": "Equations of the paper, with the functions and tests of each",
    "docs/symbols.html": "Symbols of the paper, and their names in the code",
}


def write_report(dataset: Dataset, results: Path, path: Path) -> None:
    """Write the report of a dataset.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    results : Path
        Results folder of the dataset.
    path : Path
        Page to write.
    """
    stages = {f.stem: store.read_whole(f) for f in sorted(results.glob("*.nc")) if f.stem not in FRAME_RESULTS}
    available = {name: ds for name, ds in stages.items() if "skipped" not in ds.attrs}
    verdict = _read_json(results / "verdict.json")
    citations = Citations(results)
    content: Content = {
        "title": dataset.title,
        "citations": citations,
        "facts": tables.summarize_frames(stages["frames"]),
        "remarks": [(name, text) for name, ds in stages.items() for text in store.remarks_of(ds)],
        "light": describe_light(stages.get("light"), verdict, dataset),
        "code_versions": [(name, ds.attrs.get("code_version", "")) for name, ds in stages.items()],
        **_describe_verdict(verdict, citations),
        **_tabulate_results(dataset, available, citations),
        **_collect_figures(dataset, results, available),
        **_list_skipped(dataset, stages),
        "numbers": tables.read_paper_numbers(results / "paper_numbers.csv"),
        "other_pages": _list_other_pages(results),
    }
    if dataset.spots:
        content |= _build_frame_content(dataset, results, stages, verdict)
    content["links"] = _list_links(content)
    write_page(path, "dataset_page/report.html", **plots.plotly_content(), **content)


def _read_json(path: Path) -> Any:
    """Return the content of a JSON file; None if there is no such file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _describe_verdict(verdict: dict[str, Any] | None, citations: Citations) -> Content:
    """Return the summary, the gap, the evidence and the tested data sheet of a verdict; {} if `verdict` is None."""
    if verdict is None:
        return {}
    return {
        "summary": summarize(verdict),
        "summary_numbers": number_keys(verdict),
        "gap": plot_gap(verdict),
        "evidence": tabulate_evidence(verdict, citations),
        "sheet": compare_data_sheet(verdict),
    }


def _tabulate_results(dataset: Dataset, available: Stages, citations: Citations) -> Content:
    """Return the tables of the results; `available` are the files of stages that were not skipped."""
    content = {name: tabulate(available[name], citations) for name, tabulate in TABLES.items() if name in available}
    if (fits := available.get("fits")) is not None:
        content["fits"] = tables.tabulate_fits(dataset, fits, citations)
        # Method of these fits in words.
        content["fit_method"] = fits.attrs[f"fit_{fits.attrs['preferred']}"]
        content["flagged"] = tables.list_flagged_frames(dataset, fits)
    if {"calibration", "sensor"} <= available.keys():
        content["levels"] = tables.tabulate_levels(dataset, available)
    if {"metrics", "extended_metrics"} <= available.keys():
        content["models"] = tables.tabulate_models(available["metrics"], available["extended_metrics"])
    parameters = tabulate_parameters(dataset, available, citations)
    return content | {"sensor_sources": SOURCES, "parameters": parameters}


def _collect_figures(dataset: Dataset, results: Path, available: Stages) -> Content:
    """Return the curves, the pictures, and the figures that could not be drawn.

    Pictures are omitted if a curve replaces them, or if they are among `FRAME_PICTURES` and the page shows frames.
    `skipped_figures` has pairs of a reason and the titles of all figures with this reason.
    """
    curves = draw_curves(available)
    replaced = {curve.picture for curve in curves} | set(FRAME_PICTURES if dataset.spots else ())
    index = _read_json(results / "figures" / "index.json") or {"figures": [], "skipped": []}
    titles_by_reason: dict[str, list[str]] = {}
    for figure in index["skipped"]:
        titles_by_reason.setdefault(figure["why"], []).append(figure["title"])
    return {
        "curves": curves,
        "levels_curve": draw_levels(available.get("transfer")),
        "pictures": [
            figure | {"image": _embed_picture(results / "figures", figure["name"])}
            for figure in index["figures"]
            if figure["name"] not in replaced
        ],
        "skipped_figures": list(titles_by_reason.items()),
    }


def _embed_picture(folder: Path, name: str) -> str:
    """Return a picture as a data URL: `<name>.svg` of a folder, or `<name>.png` if the SVG is large."""
    svg = folder / f"{name}.svg"
    is_small = svg.stat().st_size < LARGEST_SVG
    path, image_type = (svg, "svg+xml") if is_small else (folder / f"{name}.png", "png")
    return f"data:image/{image_type};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _list_skipped(dataset: Dataset, stages: Stages) -> Content:
    """Return the skipped stages with their reasons.

    For a dataset with spots, `axes_without_values` has the names of the dimensions of the grid, such as "exposure",
    whose values the manifest does not give.
    """
    skipped = [(name, ds.attrs["skipped"]) for name, ds in stages.items() if "skipped" in ds.attrs]
    if not dataset.spots:
        return {"skipped": [*skipped, ("spots", "the manifest has no frame of kind spot; crops and fits need them")]}
    return {"skipped": skipped, "axes_without_values": [axis.name for axis in dataset.axes if axis.values is None]}


def _build_frame_content(dataset: Dataset, results: Path, stages: Stages, verdict: dict[str, Any] | None) -> Content:
    """Return the section on the spot frames: their images, texts beside them, and the remarks of crops.nc.

    The remarks are about frames that no fit uses; the page lists them as "frames set aside".
    """
    has_additions = verdict is not None and adds_to_model(verdict)
    with store.read(results / "crops.nc") as crops, store.read(results / "views.nc") as views:
        # Without additions, the extended model equals the declared one and is not shown.
        omitted = [] if has_additions else [str(name) for name in views if str(name).startswith("extended")]
        section = collect_frames(dataset, FrameFiles(stages["frames"], crops, stages["fits"], views.drop_vars(omitted)))
        return {"frames": section, "set_aside": store.remarks_of(crops), **_describe_frames(section)}


def _describe_frames(section: FrameSection) -> Content:
    """Return the texts beside the picture at the top of the page and beside the table, and a function for its texts."""
    index = section.index
    first, largest = index["frames"][index["first_frame"]], section.rows[0]
    models = [NAMES[name] for name in index["first_models"]]
    criterion = "improvement by the extended model" if "extended" in index["first_models"] else "residual"
    scales = " All readings share one colour scale, all residuals another; red means brighter than the model."
    shown = f"measured, {list_text(models)}, and residuals.{scales}" if models else "measured."
    remarks = f"remarks on {sum(row['remarks'] != NO_REMARK for row in section.rows)} of {len(section.rows)} frames"
    return {
        "first_caption": f"The frame with the largest {criterion} ({first['label'] or first['file']}): {shown}",
        "ranking_model": NAMES[section.ranked_by],
        "over_noise_text": over_noise_text,
        "has_before": "declared" in index["names"] and section.ranked_by == "extended",
        "table_hint": f"largest residual: {largest['label'] or largest['file']}; {remarks}",
    }


def _list_other_pages(results: Path) -> list[tuple[str, str]]:
    """Return (path below the results folder, title) of each executed notebook and each page of `TABLES_OF_CODE`.

    The title of a notebook is its first line if this is a heading, otherwise the name of its file.
    """
    pages = []
    for page in sorted((results / "notebooks").glob("*.html")):
        cells = json.loads(page.with_suffix(".ipynb").read_text(encoding="utf-8"))["cells"]
        first_line = "".join(cells[0]["source"]).partition("\n")[0] if cells else ""
        is_heading = first_line.startswith("# ") and cells[0]["cell_type"] == "markdown"
        title = first_line.removeprefix("# ") if is_heading else page.stem
        pages.append((f"notebooks/{page.name}", f"Notebook: {title}"))
    return pages + [(path, title) for path, title in TABLES_OF_CODE.items() if (results / path).exists()]


def _list_links(content: Content) -> list[tuple[str, str]]:
    """Return the links at the top of the page: (id, title) of each section that has content."""
    # Id, title and content of each section.
    sections = (
        ("frames", "Frames", content.get("frames")),
        ("table", "Table of frames", content.get("frames")),
        ("evidence", "Evidence", content.get("evidence")),
        ("models", "Both models", content.get("models")),
        ("light", "Light", content["light"]),
        ("sheet", "Data sheet", content.get("sheet")),
        ("figures", "Figures", content["curves"]),
        ("sensor", "Sensor", content.get("sensor") or content.get("transfer")),
        ("numbers", "The paper's numbers", content["numbers"]),
        ("skipped", "Skipped", True),
    )
    return [(section_id, title) for section_id, title, section in sections if section]
