"""The frames of the report: packed images, the data of the script frames.js that shows them, and the table of frames.

Three models predict the mean image of a frame: the declared model, the extended model with the effects that the verdict
adds, and the simulation, in which p1 and p2 give the width of the spot at an exposure. A layer is one image of a frame
on the page: the measured one, or that of a model. The residual is measured minus model. `rms` is its root mean square
[DN], `over_noise` the same divided by that of the noise [1]. Images may be reduced to means of blocks of pixels;
`block` is the side of a block [px], 1 without reduction. `full_scale` is the largest reading of the sensor [DN].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.report.dataset_page.frame_packing import Layer, block_means, choose_block, choose_step, pack_layers
from spotcheck.report.dataset_page.frame_remarks import (
    compute_median_factors,
    describe_deviations,
    describe_flags,
    describe_residual,
    read_deviations,
)
from spotcheck.report.figures import series
from spotcheck.report.figures.style import axis_name
from spotcheck.report.views import MODELS
from spotcheck.sensor.model import NoiseLine

# Number of frames that are packed to estimate the size of all.
SAMPLE_FRAMES = 8
# Names of the layers on the page.
NAMES = {
    "measured": "measured",
    "declared": "declared model",
    "extended": "extended model",
    "simulated": "simulation by p1 and p2",
}
# Prefix of the name of a layer of the extended model without one effect; frames.js has the same text.
WITHOUT = "without "
# Text of a frame without remarks in the table of frames.
NO_REMARK = "no remark"
# Frames are ranked by their residual from the first of these models that exists.
RANKING_MODELS = ("extended", "declared", "simulated")
# Models that the picture at the top of the page may show, in this order.
PICTURE_MODELS = ("declared", "extended", "simulated")

Place = dict[str, int]  # index of a frame by dimension of the grid (angle, exposure, repeat, …)
Images = dict[str, np.ndarray]  # images of a frame [row, column] in DN by layer


class FrameFiles(NamedTuple):
    """Results about the spot frames."""

    frames: xr.Dataset  # frames.nc: a row for each frame
    crops: xr.Dataset  # crops.nc: measured images of the spots
    fits: xr.Dataset  # fits.nc: fitted spots
    views: xr.Dataset  # views.nc: images of the models, and residuals


@dataclass(frozen=True)
class FrameSection:
    """The frames for the page."""

    index: dict[str, Any]  # data of frames.js, as `_build_viewer_index` returns them
    packed: list[str]  # images of each frame, as `pack_layers` returns them
    rows: list[dict[str, Any]]  # rows of the table, as `_tabulate_frame` returns them, the largest residual first
    ranked_by: str  # model whose residuals order the rows
    ranked_in: str  # key of the residual that orders the rows: "over_noise", or "rms" if the noise is unknown
    remark: str  # sentence on the reduction of images to means of blocks; "" if they are not reduced


def collect_frames(dataset: Dataset, files: FrameFiles) -> FrameSection:
    """Return the section of all spot frames; their images are reduced if they would make the page too large."""
    cells, dims = list(dataset.cells()), store.grid_dims(files.crops)
    places: list[Place] = [dict(zip(dims, index, strict=True)) for index, _ in cells]
    full_scale = float(files.frames["full_scale"])
    block = _estimate_block(files, places, full_scale)
    median_factors = compute_median_factors(files.views)
    packed: list[str] = []
    frames: list[dict[str, Any]] = []  # data of each frame for frames.js
    rows: list[dict[str, Any]] = []
    for place, (_, frame) in zip(places, cells, strict=True):
        images = _read_images(files, place)
        layers = _make_layers(images, full_scale, block)
        packed.append(pack_layers(layers))
        frame_data = _describe_frame(files, place, frame, layers)
        record = _find_record(files.frames, frame)
        remarks = "; ".join(_list_remarks(files, place, record, images, frame_data["spot"], median_factors))
        frames.append(frame_data | {"remarks": remarks})
        rows.append(_tabulate_frame(frame_data, remarks, len(rows), int(record["maximum"])))
    index = _build_viewer_index(files, dims, frames, block, full_scale)
    ranked_in = "rms" if all(row["over_noise"] is None for row in rows) else "over_noise"
    # Frames that no model covers have no residual and come last.
    rows.sort(key=lambda row: -np.inf if row[ranked_in] is None else row[ranked_in], reverse=True)
    remark = f"Images are reduced to means of {block} × {block} px, to limit the size of the page." if block > 1 else ""
    return FrameSection(index, packed, rows, _ranking_model(files), ranked_in, remark)


def _estimate_block(files: FrameFiles, places: Sequence[Place], full_scale: float) -> int:
    """Return the smallest side of blocks [px] with which all frames fit on the page, estimated from a sample of them.

    `places` are the indices of all frames.
    """
    sample_indices = np.unique(np.linspace(0, len(places) - 1, SAMPLE_FRAMES).astype(int))
    sample = [_read_images(files, places[k]) for k in sample_indices]

    def mean_size(block: int) -> float:
        """Return the mean size of a packed frame [byte]; `block` is the side of its blocks [px]."""
        return float(np.mean([len(pack_layers(_make_layers(images, full_scale, block))) for images in sample]))

    return choose_block(mean_size, len(places))


def _read_images(files: FrameFiles, place: Place) -> Images:
    """Return the images of a frame: measured, by each model, and by the extended model without each of its effects.

    Images without any finite reading are omitted.
    """
    views = files.views.isel(place)
    images = {"measured": files.crops["image"].sel(centring="light").isel(place).values.astype(float)}
    images |= {name: views[name].values for name in MODELS if name in views}
    if "extended_without" in views:
        names = [f"{WITHOUT}{effect}" for effect in views["without"].values]
        images |= dict(zip(names, views["extended_without"].values, strict=True))
    return {name: image for name, image in images.items() if np.isfinite(image).any()}


def _make_layers(images: Images, full_scale: float, block: int) -> dict[str, Layer]:
    """Return the images of a frame as layers to be packed, by name, reduced to means of blocks."""
    return {
        name: Layer(
            readings=block_means(image, block),
            step=_layer_step(name, full_scale, block),
            is_smooth=name != "measured",
            base="extended" if name.startswith(WITHOUT) else "",
        )
        for name, image in images.items()
    }


def _layer_step(name: str, full_scale: float, block: int) -> float:
    """Return the reading of the integer 1 [DN] in a layer; measured readings are integers unless they are averaged."""
    return 1.0 if name == "measured" and block == 1 else choose_step(full_scale)


def _describe_frame(files: FrameFiles, place: Place, frame: Frame, layers: Mapping[str, Layer]) -> dict[str, Any]:
    """Return the data of a frame for frames.js.

    `at` is its index in each dimension of the grid, `label` its conditions in words, `file` its file and `layers` the
    names of its layers. `has_gaps` says whether pixels were not measured. `corner` is the first column and row of the
    crop [px of the sensor]. `spot` is the fitted centre (x, y) [px of the crop] and `sigma` the fitted width [px].
    `rms` and `over_noise` are the residuals by model.
    """
    crop, fit = files.crops.sel(centring="light").isel(place), select_preferred_fits(files.fits).isel(place)
    left, top = int(crop["left"]), int(crop["top"])
    centre = np.array([float(fit["x_centre"]) - left, float(fit["y_centre"]) - top])
    if not np.isfinite(centre).all():
        # Without a fitted spot the viewer shows the middle of the crop.
        centre[:] = (crop.sizes["x"] - 1) / 2
    models = [name for name in MODELS if name in layers]
    return {
        "at": list(place.values()),
        "label": series.condition_text(files.crops, place) or frame.label,
        "file": frame.label,
        "layers": list(layers),
        "has_gaps": "measured" in layers and bool(np.isnan(layers["measured"].readings).any()),
        "corner": [left, top],
        "spot": [round(float(coordinate), 3) for coordinate in centre],
        "sigma": round(float(fit["sigma_mean"]), 3) if np.isfinite(fit["sigma_mean"]) else None,
        "rms": {name: _rounded(files.views[f"{name}_rms"].isel(place)) for name in models},
        "over_noise": {name: _rounded(files.views[f"{name}_left"].isel(place)) for name in models},
    }


def _find_record(frames: xr.Dataset, frame: Frame) -> xr.Dataset:
    """Return the row of frames.nc about a frame, without the dimension `frame`."""
    is_same = (frames["file"] == frame.file) & (frames["page"] == (frame.page or 0))
    return frames.isel(frame=int(np.argmax(is_same.values)))


def _list_remarks(
    files: FrameFiles,
    place: Place,
    record: xr.Dataset,
    images: Images,
    centre: Sequence[float],
    median_factors: Mapping[str, float],
) -> list[str]:
    """Return remarks on a frame: flags, deviations from the other frames, and the largest residual.

    Parameters
    ----------
    files : FrameFiles
        Results about the frames.
    place : dict of str to int
        Index of the frame by dimension.
    record : Dataset
        Row of frames.nc about the frame.
    images : dict of str to ndarray
        Images of the frame by layer, as `_read_images` returns them.
    centre : sequence of float
        Centre of its spot (x, y) [px of the crop].
    median_factors : mapping of str to float
        As `compute_median_factors` returns them.
    """
    fit, views = select_preferred_fits(files.fits).isel(place), files.views
    # Pixels that the fit left out, in words.
    left_out_pixels = str(fit["left_out"].values) if "left_out" in fit else ""
    remarks = describe_flags(int(fit["status"]), left_out_pixels, int(record["at_full_scale"]))
    remarks += describe_deviations(read_deviations(views, place, median_factors))
    model = next((name for name in RANKING_MODELS if name in images), None)
    if model is not None and "measured" in images:
        # Variance of readings [DN²] over their mean [DN].
        noise = NoiseLine(float(views["noise_at_zero"]), float(views["noise_slope"]))
        residual = images["measured"] - images[model]
        remarks.append(describe_residual(residual, noise.variance(images[model]), centre))
    return list(filter(None, remarks))


def _tabulate_frame(frame_data: Mapping[str, Any], remarks: str, number: int, maximum: int) -> dict[str, Any]:
    """Return a row of the table of frames, from the data that `_describe_frame` returns.

    `number` is the index of the frame in frames.js, `maximum` its highest reading [DN]. `over_noise` [1] and `rms` [DN]
    are residuals from `model`, the first of `RANKING_MODELS` that covers the frame. `before` [1] is the residual over
    the noise from the declared model. Unknown residuals are None.
    """
    over_noise, rms = frame_data["over_noise"], frame_data["rms"]
    # A frame that the extended model does not cover shows the residual of the next model.
    model = next((name for name in RANKING_MODELS if rms.get(name) is not None), None)
    return {
        "model": model,
        "over_noise": over_noise.get(model),
        "before": over_noise.get("declared"),
        "rms": rms.get(model),
        "number": number,
        "label": frame_data["label"],
        "file": frame_data["file"],
        "maximum": maximum,
        "remarks": remarks or NO_REMARK,
    }


def _build_viewer_index(
    files: FrameFiles, dims: Sequence[str], frames: list[dict[str, Any]], block: int, full_scale: float
) -> dict[str, Any]:
    """Return the data of frames.js: the grid, the layers, the noise, and the frames.

    `dims` are the dimensions of the grid; `frames` are the data of all frames, as `_describe_frame` returns them. In
    the result `side` is the side of the packed images [block], `steps` are the steps of the layers [DN], and `noise` is
    the variance of readings at the mean 0 DN [DN²] and its increase for each DN of mean [DN], None if unknown.
    """
    # The names of the layers of all frames, without repetition.
    layers = list(dict.fromkeys(name for frame in frames for name in frame["layers"]))
    first = _choose_first(frames, _ranking_model(files))
    models = [name for name in PICTURE_MODELS if name in frames[first]["layers"]]
    return {
        "block": block,
        "side": files.crops.sizes["x"] // block,
        "names": {name: NAMES.get(name) or f"extended model {name}" for name in layers},
        "steps": {name: _layer_step(name, full_scale, block) for name in layers},
        "smooth": [name for name in layers if name != "measured"],
        "axes": [
            {
                "name": dim,
                "label": axis_name(dim).replace("$", ""),
                "values": [series.value_text(files.crops, dim, k) for k in range(files.crops.sizes[dim])],
            }
            for dim in dims
        ],
        "noise": [_rounded(files.views["noise_at_zero"]), _rounded(files.views["noise_slope"])],
        "frames": frames,
        "first_frame": first,
        # The declared and the extended model, or the only one.
        "first_models": models[: 2 if "extended" in models else 1],
    }


def _ranking_model(files: FrameFiles) -> str:
    """Return the name of the model whose residuals rank the frames."""
    return next(name for name in RANKING_MODELS if name in files.views)


def _choose_first(frames: Sequence[Mapping[str, Any]], model: str) -> int:
    """Return the index of the frame at the top of the page, from the data that `_describe_frame` returns.

    If `model` is the extended model, it is the frame that this model improves most over the declared one. Otherwise it
    is the frame with the largest residual from `model`.
    """

    def score(frame: Mapping[str, Any]) -> tuple[bool, float]:
        """Return (whether both models cover the frame, drop of the mean square residual [DN²] or residual).

        The residual is from `model`, over the noise [1], or in DN if the noise is unknown; it is 0 if unknown.
        """
        before, after = (frame["rms"].get(name) for name in ("declared", "extended"))
        if model == "extended" and before is not None and after is not None:
            return True, before**2 - after**2
        return False, frame["over_noise"].get(model) or frame["rms"].get(model) or 0.0

    return max(range(len(frames)), key=lambda k: score(frames[k]))


def _rounded(value: xr.DataArray) -> float | None:
    """Return a scalar rounded to six significant digits, which keeps the page small; None if it is not finite."""
    number = float(value)
    return float(f"{number:.6g}") if np.isfinite(number) else None
