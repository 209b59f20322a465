"""What the page shows frame by frame: packed readings, what the controls offer, and the table of frames."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.discrepancy.words import number_text, over_noise_text
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.report.dataset_page.packed import Layer, block_of, packed, step_of, thinned
from spotcheck.report.dataset_page.ranking import deviations_of, deviations_text, flags_text, place_text, usual_of
from spotcheck.report.figures import series
from spotcheck.report.figures.style import axis_name
from spotcheck.report.views import MODELS
from spotcheck.sensor.model import NoiseLine

# Frames that are packed to see how large all will be.
SAMPLE = 8
NAMES = {
    "measured": "measured",
    "declared": "declared model",
    "extended": "extended model",
    "simulated": "simulation by p1 and p2",
}
WITHOUT = "without "
NOTHING = "nothing stands out"
# By which model frames are ranked: the best that there is.
RANKED_BY = ("extended", "declared", "simulated")
# In which order models stand in the picture of the first screen.
PICTURED = ("declared", "extended", "simulated")


class Frames(NamedTuple):
    """All that frames.js takes: what there is to show, each frame as text; rows of the table, the worst first, which
    model they are ranked by, in which of its numbers (`left`; `rms` where the noise is unknown), and what was
    thinned."""

    contents: dict[str, Any]
    texts: list[str]
    rows: list[dict[str, Any]]
    ranked_by: str
    ranked_in: str
    remark: str


class Files(NamedTuple):
    """The results that frames are shown from."""

    frames: xr.Dataset
    crops: xr.Dataset
    fits: xr.Dataset
    views: xr.Dataset


def frames_of(dataset: Dataset, files: Files) -> Frames:
    """Every frame of kind spot."""
    cells, dims = list(dataset.cells()), store.grid_dims(files.crops)
    full_scale = float(files.frames["full_scale"])
    chosen = np.unique(np.linspace(0, len(cells) - 1, SAMPLE).astype(int))
    places = [dict(zip(dims, at, strict=True)) for at, _ in cells]
    sample = [_images(files, places[k]) for k in chosen]
    block = block_of(
        lambda own: float(np.mean([len(packed(_layers(images, full_scale, own))) for images in sample])), len(cells)
    )
    texts, shown, rows, usual = [], [], [], usual_of(files.views)
    for k, (place, (_, frame)) in enumerate(zip(places, cells, strict=True)):
        images = _images(files, place)
        layers = _layers(images, full_scale, block)
        texts.append(packed(layers))
        own = _shown(files, place, frame, layers)
        shown.append(own)
        rows.append(_row(files, place, frame, k, own, images, usual))
        own["why"] = "" if rows[-1]["why"] == NOTHING else rows[-1]["why"]
    names = list(dict.fromkeys(name for own in shown for name in own["layers"]))
    contents = {
        "block": block,
        "side": dataset.instrument.crop_px // block,
        "names": {name: NAMES.get(name) or f"extended model {name}" for name in names},
        "steps": {name: _step(name, full_scale, block) for name in names},
        "smooth": [name for name in names if name != "measured"],
        "axes": _axes(files.crops, dims),
        "noise": [_number(files.views["noise_at_zero"]), _number(files.views["noise_slope"])],
        "frames": shown,
    }
    ranked_by = next(name for name in RANKED_BY if name in files.views)
    best = contents["best"] = _best(shown, ranked_by)
    # Before and after, or the only model.
    able = [name for name in PICTURED if name in shown[best]["layers"]]
    contents["pictured"] = able[: 2 if "extended" in able else 1]
    remark = f"Images are shown in blocks of {block} × {block} px, so that the page stays small." if block > 1 else ""
    ranked_in = "rms" if all(row["left"] is None for row in rows) else "left"
    # A frame of which nothing is left, for it could not be used, comes last.
    rows.sort(key=lambda row: -np.inf if row[ranked_in] is None else row[ranked_in], reverse=True)
    return Frames(contents, texts, rows, ranked_by, ranked_in, remark)


def _step(name: str, full_scale: float, block: int) -> float:
    return 1.0 if name == "measured" and block == 1 else step_of(full_scale)


def _images(files: Files, at: dict[str, int]) -> dict[str, np.ndarray]:
    """Readings [row, column] that there are of a frame: measured, models, and the extended model without each
    effect."""
    views = files.views.isel(at)
    images = {"measured": files.crops["image"].sel(centring="light").isel(at).values.astype(float)}
    images |= {name: views[name].values for name in MODELS if name in views}
    if "extended_without" in views:
        names = [f"{WITHOUT}{own}" for own in views["without"].values]
        images |= dict(zip(names, views["extended_without"].values, strict=True))
    return {name: own for name, own in images.items() if np.isfinite(own).any()}


def _layers(images: dict[str, np.ndarray], full_scale: float, block: int) -> dict[str, Layer]:
    """The same as they are packed."""
    return {
        name: Layer(
            thinned(own, block),
            _step(name, full_scale, block),
            name != "measured",
            "extended" if name.startswith(WITHOUT) else "",
        )
        for name, own in images.items()
    }


def _shown(files: Files, at: dict[str, int], frame: Frame, layers: dict[str, Layer]) -> dict[str, Any]:
    """What frames.js has to know of a frame; places and widths are in px of the crop."""
    crop, fit = files.crops.sel(centring="light").isel(at), select_preferred_fits(files.fits).isel(at)
    left, top = int(crop["left"]), int(crop["top"])
    centre, middle = (float(fit["x_centre"]) - left, float(fit["y_centre"]) - top), (crop.sizes["x"] - 1) / 2
    centre = centre if np.isfinite(centre).all() else (middle, middle)
    width = float(fit["sigma_mean"])
    gaps = bool(np.isnan(layers["measured"].readings).any()) if "measured" in layers else False
    return {
        "at": list(at.values()),
        "label": label_of(files.crops, at) or frame.label,
        "file": frame.label,
        "layers": list(layers),
        "gaps": gaps,
        "corner": [left, top],
        "spot": [round(own, 3) for own in centre],
        "sigma": round(width, 3) if np.isfinite(width) else None,
        "rms": {name: _number(files.views[f"{name}_rms"].isel(at)) for name in MODELS if name in layers},
        "left": {name: _number(files.views[f"{name}_left"].isel(at)) for name in MODELS if name in layers},
    }


def label_of(ds: xr.Dataset, at: dict[str, int]) -> str:
    """A frame by its place on the grid: `90°, 900 µs, repeat 3`."""
    return ", ".join(filter(None, (series.value_text(ds, dim, k) for dim, k in at.items())))


def _axes(crops: xr.Dataset, dims: tuple[str, ...]) -> list[dict[str, Any]]:
    """What a control offers for each axis of the grid."""
    return [
        {
            "name": dim,
            "label": axis_name(dim).replace("$", ""),
            "values": [series.value_text(crops, dim, k) for k in range(crops.sizes[dim])],
        }
        for dim in dims
    ]


def _row(
    files: Files,
    at: dict[str, int],
    frame: Frame,
    number: int,
    shown: dict[str, Any],
    images: dict[str, np.ndarray],
    usual: dict[str, float],
) -> dict[str, Any]:
    """A row of the table of frames."""
    fit, views = select_preferred_fits(files.fits).isel(at), files.views
    same = (files.frames["file"] == frame.file) & (files.frames["page"] == (frame.page or 0))
    record = files.frames.isel(frame=int(np.argmax(same.values)))
    left_out = str(fit["left_out"].values) if "left_out" in fit else ""
    why = flags_text(int(fit["status"]), left_out, int(record["at_full_scale"]))
    why += deviations_text(deviations_of(views, at, usual))
    known = [name for name in RANKED_BY if shown["left"].get(name) is not None]
    model = next((name for name in RANKED_BY if name in images), None)
    if model is not None and "measured" in images:
        mean, line = images[model], NoiseLine(float(views["noise_at_zero"]), float(views["noise_slope"]))
        text = place_text(images["measured"] - mean, line.variance(mean), shown["spot"])
        why += [text] if text else []
    numbers = {
        "left": shown["left"][known[0]] if known else None,
        "before": shown["left"].get("declared"),
        "rms": shown["rms"].get(model) if model else None,
    }
    texts = {"rms_text": number_text(numbers["rms"])}
    texts |= {f"{name}_text": over_noise_text(numbers[name]) for name in ("left", "before")}
    return (
        numbers
        | texts
        | {
            "number": number,
            "label": shown["label"],
            "file": frame.label,
            "maximum": int(record["maximum"]),
            "why": "; ".join(why) or NOTHING,
        }
    )


def _best(shown: list[dict[str, Any]], ranked_by: str) -> int:
    """The frame in which the disagreement is seen best: where most goes with what was added, else where most is
    left."""

    def gain(own: dict[str, Any]) -> float:
        before, after = (own["rms"].get(name) for name in ("declared", "extended"))
        if ranked_by == "extended" and before is not None:
            return before**2 - (after or 0.0) ** 2
        # A frame without a model comes last.
        return (own["left"].get(ranked_by) or own["rms"].get("simulated") or 0.0) - 1e12

    return int(np.argmax([gain(own) for own in shown]))


def _number(value: xr.DataArray) -> float | None:
    """A number with as many digits as anybody reads; None where it is not known."""
    number = float(value)
    return float(f"{number:.6g}") if np.isfinite(number) else None
