"""The crop stage: cut out the spot of each frame and flag unusable frames (crops.nc).

The frames lie on a grid of conditions such as angle, exposure and repeat; a cell is a place in it. Each frame has two
crops, one for each of `CENTRINGS`. The status of a crop is a set of flags, stored as bits (`store.STATUS`). The column
`keep` of manifest.csv decides by hand: no excludes a frame, yes uses it in spite of some flags.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.crops import spotfinding
from spotcheck.crops.full_scale import measure_extremes
from spotcheck.crops.ingest import MAX_NAMED
from spotcheck.crops.outlier_frames import SpotMoments, find_outlier_frames, measure_moments
from spotcheck.crops.second_spots import describe_second_spots
from spotcheck.dataset import file_cache, frames
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame
from spotcheck.errors import InputError
from spotcheck.io import progress, store

# Centre of the crop: the centroid of the light (default of every stage), or the maximum, as in the paper.
CENTRINGS = ("light", "maximum")
AT_LIGHT = CENTRINGS.index("light")
# A crop is saturated if at most this part of its pixels reads below full scale.
MAX_UNCLIPPED_SATURATED = 0.01
# Variables of crops.nc that each frame fills: name, dimensions, type, unit and description.
VARIABLES = {
    "image": store.Variable(
        ("centring", "y", "x"), "f4", "DN", "crop; NaN beyond the frame and where the pixel is bad"
    ),
    "top": store.Variable(("centring",), "i4", "pixel", "row of the frame under row 0 of the crop"),
    "left": store.Variable(("centring",), "i4", "pixel", "column of the frame under column 0 of the crop"),
    "status": store.Variable(("centring",), "i4", "1", "status flags"),
    "cut_reading": store.Variable((), "f4", "DN", "reading of pixels whose faint light was cut off; NaN if none was"),
    "block_mean": store.Variable(("block_y", "block_x"), "f4", "DN", "mean of each block of the frame"),
    "row_mean": store.Variable(("row",), "f4", "DN", "mean of each row of the frame"),
    "column_mean": store.Variable(("column",), "f4", "DN", "mean of each column of the frame"),
}


def crop_spots(dataset: Dataset, table: xr.Dataset, path: Path, *, code: str, inputs: list) -> None:
    """Write crops.nc: both crops of every spot, their position on the sensor, and a reduced copy of the whole frame.

    Outlier frames are flagged. The attribute `remarks` of crops.nc gives the reason for each frame that is set aside.

    Parameters
    ----------
    dataset : Dataset
        Its spot frames are decoded one at a time.
    table : xr.Dataset
        Content of frames.nc, the table of all frames of the dataset.
    path : Path
        crops.nc to write.
    code, inputs
        Provenance, see `store.write`: digest of the code that writes, and paths of the files that are read.

    Raises
    ------
    InputError
        If a frame is missing in `table`, or if its file has changed since frames.nc was written.
    """
    side = dataset.instrument.crop_px
    full_scale = float(table["full_scale"])
    columns = (table[name].values for name in ("file", "page", "copy_of"))
    # By file and page of a frame. `copy_of` is −1 for a frame that is no copy.
    is_copy = {(str(file), int(page)): int(copy_of) >= 0 for file, page, copy_of in zip(*columns, strict=True)}
    coordinates = _crop_coordinates(dataset, (int(table["rows"]), int(table["columns"])))
    with (
        store.frame_writer(path, dataset, coordinates, VARIABLES, code=code, inputs=inputs) as writer,
        file_cache.verify_unchanged(dataset, table),
    ):
        # In the order of `dataset.spots`, which is that of `dataset.cells`.
        indices, statuses, moments, centres = [], [], [], []
        for index, frame in progress.track(dataset.cells(), "cropping spots", len(dataset.spots)):
            if (frame.file, frame.page) not in is_copy:
                raise InputError(f"{frame.label}: not in frames.nc; run ingest again")
            flags = store.flag("copy") if is_copy[frame.file, frame.page] else 0
            flags |= store.flag("dropped") if frame.keep is False else 0
            pixels, impossible_readings = frames.read_checked_image(dataset, frame)
            values = _process_frame(pixels, impossible_readings.is_cut, side, full_scale, flags)
            writer.put(index, values)
            indices.append(index)
            statuses.append(values["status"])
            image, left, top = (values[name][AT_LIGHT] for name in ("image", "left", "top"))
            centres.append((left + side // 2, top + side // 2))
            moments.append(measure_moments(image, left, top) if is_usable(values["status"][AT_LIGHT]) else None)
        # Outliers are known only when all frames are measured.
        # A dataset of flats and darks alone has no spots.
        by_centring = np.array(statuses, dtype=int).reshape(-1, len(CENTRINGS))
        revised_statuses, remarks = _flag_outliers(dataset, by_centring, moments)
        is_out = (revised_statuses[:, AT_LIGHT] & store.UNUSABLE) != 0
        used = [None if out else moment for out, moment in zip(is_out, moments, strict=True)]
        if remark := describe_second_spots(dataset, used, np.reshape(centres, (-1, 2)), partial(_measure_at, dataset)):
            remarks.insert(0, remark)
        for index, status in zip(indices, revised_statuses, strict=True):
            writer.put(index, {"status": status})
        writer.remark(remarks)


def _measure_at(dataset: Dataset, frame: Frame, x: float, y: float, side: float) -> SpotMoments | None:
    """Return the moments of the light of a frame in a square with the centre x, y and the side `side` [px].

    The position is that on the sensor, column and row. Returns None if the square has too few lit pixels.
    """
    centre, side_px = spotfinding.Spot(round(y), round(x), True), round(side)
    crop = spotfinding.cut_crop(frames.read_masked_image(dataset, frame), centre, side_px)
    return measure_moments(crop, centre.column - side_px // 2, centre.row - side_px // 2)


def _crop_coordinates(dataset: Dataset, shape: tuple[int, int]) -> xr.Dataset:
    """Return the coordinates of crops.nc other than those of the grid, for frames of `shape` (rows, columns)."""
    side, block = dataset.instrument.crop_px, min(frames.BLOCK_PX, *shape)
    coordinates = xr.Dataset(attrs={"title": dataset.title, "dataset": dataset.name})
    attributes = {"units": "1", "long_name": "what the crop is centred on"}
    coordinates["centring"] = ("centring", np.array(CENTRINGS, dtype=object), attributes)
    for name, size, step, long_name in (
        ("y", side, 1, "row of the crop"),
        ("x", side, 1, "column of the crop"),
        ("block_y", frames.count_blocks(shape[0], shape), block, "first row of the block"),
        ("block_x", frames.count_blocks(shape[1], shape), block, "first column of the block"),
        ("row", shape[0], 1, "row of the frame"),
        ("column", shape[1], 1, "column of the frame"),
    ):
        coordinates[name] = (name, np.arange(size, dtype="i4") * step, {"units": "pixel", "long_name": long_name})
    return coordinates


def _process_frame(pixels: np.ndarray, is_cut: np.ndarray, side: int, full_scale: float, flags: int) -> dict[str, Any]:
    """Return the values of `VARIABLES` by name for one frame [row, column] in DN, NaN at bad pixels.

    `is_cut` is True for pixels whose faint light was cut off [row, column]. `side` is that of the crop [px], and
    `full_scale` the largest reading [DN]. `flags` are bits that are set in the status of both crops, beside those that
    the pixels give.
    """
    # In the order of `CENTRINGS`.
    spots = (spotfinding.find_light_centroid(pixels, side), spotfinding.find_brightest_pixel(pixels))
    images = np.stack([spotfinding.cut_crop(pixels, spot, side) for spot in spots])
    # The fields of `ReducedFrame` are the variables block_mean, row_mean and column_mean.
    reduced_frame = frames.reduce_frame(frames.mask_readings(pixels, is_cut))
    extremes = measure_extremes(frames.select_good_readings(pixels))
    # All cut pixels of a frame have the same reading.
    cut_reading = float(pixels[is_cut][0]) if is_cut.any() else np.nan
    flags |= store.flag("cut_off") if is_cut.any() else 0
    # Readings clip at full scale, or at a plateau below it: many pixels with exactly the highest reading.
    clip = float(extremes.highest) if extremes.has_plateau() else full_scale
    tops, lefts = [spot.row - side // 2 for spot in spots], [spot.column - side // 2 for spot in spots]
    statuses = []
    for image, top, left in zip(images, tops, lefts, strict=True):
        is_inside = 0 <= top <= pixels.shape[0] - side and 0 <= left <= pixels.shape[1] - side
        # A crop is masked where it reaches beyond the frame.
        masked_flag = 0 if is_inside else store.flag("masked")
        statuses.append(flags | masked_flag | _flag_readings(image, spots[AT_LIGHT].exists, full_scale, clip))
    crops = {"image": images, "top": tops, "left": lefts, "status": statuses, "cut_reading": cut_reading}
    return crops | reduced_frame._asdict()


def _flag_readings(image: np.ndarray, has_spot: bool, full_scale: float, clip: float) -> int:
    """Return the status flags that the readings of a crop give, as bits; 0 if there are none.

    A crop is saturated if nearly all of its readings are at full scale, or if it has no reading; other flags are then
    not set. Otherwise it is black if its frame has no spot, and clipped if a reading reaches `clip`.

    Parameters
    ----------
    image : crop [row, column] in DN; NaN pixels do not count.
    has_spot : whether the frame has light above the noise.
    full_scale : largest possible reading [DN].
    clip : reading at which the frame is clipped [DN]; a plateau may lie below full scale.
    """
    readings = image[np.isfinite(image)]
    if np.count_nonzero(readings < full_scale) <= MAX_UNCLIPPED_SATURATED * readings.size:
        return store.flag("saturated")
    return (0 if has_spot else store.flag("black")) | (store.flag("clipped") if np.any(readings >= clip) else 0)


def _flag_outliers(
    dataset: Dataset, statuses: np.ndarray, moments: list[SpotMoments | None]
) -> tuple[np.ndarray, list[str]]:
    """Flag outlier frames, and clear flags of frames with keep = yes.

    Parameters
    ----------
    dataset : Dataset
        The dataset; the column `keep` of its manifest decides by hand.
    statuses : array [spot, centring]
        Flags of the crops, in the order of `dataset.spots`. They are revised in place.
    moments : list
        Moments of each of `dataset.spots`; None for unusable frames.

    Returns
    -------
    statuses : array [spot, centring]
        The revised flags.
    remarks : list of str
        One sentence for each reason for which frames are set aside, or are used by hand in spite of it.
    """
    outliers, remark = find_outlier_frames(dataset, moments)
    reasons = {outlier.spot: outlier.reason for outlier in outliers}
    for outlier in outliers:
        statuses[outlier.spot] |= store.flag(outlier.flag)
    # Fate of frames and its reason, such as "set aside as black: …" → labels of these frames.
    labels_by_fate: dict[str, list[str]] = {}
    # EXCLUDED are all flags by which a frame is set aside, CLEARED_BY_KEEP those that keep = yes clears.
    for spot, frame in enumerate(dataset.spots):
        flags = statuses[spot, AT_LIGHT] & store.EXCLUDED
        if frame.keep:
            statuses[spot] &= ~store.CLEARED_BY_KEEP
        if flags:
            fate = "used by hand (keep = yes in manifest.csv) though" if frame.keep else "set aside as"
            reason = reasons.get(spot, store.describe_flags(flags))
            labels_by_fate.setdefault(f"{fate} {store.status_names(flags)}: {reason}", []).append(frame.label)
    remarks = [remark] if remark else []
    for fate, labels in labels_by_fate.items():
        if len(labels) == 1:
            remarks.append(f"{labels[0]} is {fate}")
        else:
            more = [f"{len(labels) - MAX_NAMED} more"] if len(labels) > MAX_NAMED else []
            remarks.append(f"{len(labels)} frames are {fate} ({', '.join([*labels[:MAX_NAMED], *more])})")
    return statuses, remarks


def read_measured_crop(crop: xr.Dataset) -> np.ndarray:
    """Return the image [y, x] of one crop in DN, with NaN also where faint light was cut off at a threshold.

    `crop` is one cell and centring of crops.nc. Verdicts use the image itself, which shows a dead zone of the camera.
    """
    image = crop["image"].values
    return np.where(image == crop["cut_reading"].values, np.nan, image) if "cut_reading" in crop else image


def is_usable(status: int | np.ndarray | xr.DataArray) -> bool:
    """Return whether the status of one crop, a single number, allows a fit and metrics.

    `store.UNUSABLE` are the flags of frames without a usable spot, such as missing, copy or dropped.
    """
    return not int(status) & store.UNUSABLE


def iterate_cells(ds: xr.Dataset, dims: tuple[str, ...]) -> Iterator[dict[str, int]]:
    """Yield the indices {dimension: index} of each cell of the grid along `dims` that has a frame, for `isel`.

    A cell has a frame if any combination of the other dimensions has one: its `status` is not "missing". Most cells may
    be empty, for example if each repeat has its own exposure.

    Parameters
    ----------
    ds : result over the grid, with `status` over `dims` and further dimensions such as `centring`.
    dims : names of dimensions of the grid.
    """
    other_dims = [dim for dim in ds["status"].dims if dim not in dims]
    has_frame = (ds["status"] != store.flag("missing")).any(other_dims).transpose(*dims).values
    for index in np.argwhere(has_frame).tolist():
        yield dict(zip(dims, index, strict=True))
