"""The first two stages: what each frame is (ingest), and the crop around its spot (crop)."""

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.crops import siblings, spotfinding
from spotcheck.crops.clip import End, end_of, top_of
from spotcheck.dataset import file_cache, frames
from spotcheck.dataset.folder import Dataset, check_files, get_column_unit
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.errors import InputError
from spotcheck.io import progress, store

# How the crop is centred: on the light's centroid (default of every stage), or on the maximum, as the paper.
CENTRINGS = ("light", "maximum")
# Frames of a kind that are named one by one; more would not be read.
MOST_NAMED = 5
# Part of a crop's pixels that must read below full scale, or nothing of a spot is seen.
LEAST_UNCLIPPED = 0.01


def check_dataset(dataset: Dataset) -> frames.FrameFormat:
    """All checks that need no pixels: files named and there, headers readable and alike, crop within the frame."""
    check_files(dataset)
    return frames.check_formats(dataset)


def ingest(dataset: Dataset, before: Mapping[str, file_cache.FileRecord] = MappingProxyType({})) -> xr.Dataset:
    """Table of every frame of the manifest: digest, shape, depth, extremes, clipped pixels, and of which other frame it
    is a copy; `remarks` on what a user should know. Decodes each frame once; digests are taken from looks `before`, by
    path, where the file bears the stamps of then.

    Raises `InputError` where a file changes meanwhile, as its digest would not be that of the pixels.
    """
    probe = check_dataset(dataset)
    names = {
        "minimum": ("i4", "DN", "smallest reading"),
        "maximum": ("i4", "DN", "largest reading"),
        "mean": ("f8", "DN", "mean reading"),
        "at_full_scale": ("i8", "pixel", "pixels that read full scale"),
        "at_zero": ("i8", "pixel", "pixels that read zero"),
        "copy_of": ("i4", "1", "earlier frame that holds the same pixels; -1 where none does"),
    }
    count = len(dataset.frames)
    columns = {name: np.zeros(count, dtype) for name, (dtype, _, _) in names.items()}
    looks, first, tops = dict[str, file_cache.FileRecord](), dict[bytes, int](), []
    for k, frame in enumerate(progress.track(dataset.frames, "reading frames")):
        if frame.path not in looks:
            path = dataset.folder / frame.path
            looks[frame.path] = file_cache.record_file(path, before.get(str(path)))
        pixels = frames.select_good_readings(frames.read_masked_image(dataset, frame))
        top = top_of(pixels)
        tops.append(top)
        columns["minimum"][k], columns["maximum"][k] = top.lowest, top.highest
        columns["mean"][k] = pixels.mean(dtype=np.float64)
        columns["at_zero"][k] = pixels.size - np.count_nonzero(pixels)
        # ASSUME: noise makes no two exposures equal in every pixel, unless all of them read the same, as black ones do.
        varied = top.lowest < top.highest
        earlier = first.setdefault(hashlib.sha256(pixels.data).digest(), k) if varied else k
        columns["copy_of"][k] = earlier if earlier < k else -1
    for file, own in looks.items():
        if file_cache.record_file(dataset.folder / file, own).sha256 != own.sha256:
            raise InputError(f"{file}: has changed while it was read; run again when nothing writes to it")
    end = end_of(tops, dataset.instrument, probe.bits)
    columns["at_full_scale"][:] = [own.pixels if own.highest == end.reading else 0 for own in tops]
    ds = xr.Dataset(attrs={"title": dataset.title, "dataset": dataset.name})
    remarks = [*probe.remarks, *list_unusual_values(dataset), *end.remarks, *copies(dataset, columns["copy_of"])]
    ds = store.add_remarks(ds, remarks)
    ds["frame"] = ("frame", np.arange(count), {"units": "1", "long_name": "row of the manifest, from 0"})
    for name, (_, units, long_name) in names.items():
        ds[name] = ("frame", columns[name], {"units": units, "long_name": long_name})
    for name, values, long_name in (
        ("file", [f.file for f in dataset.frames], "path in the dataset folder"),
        ("kind", [f.kind for f in dataset.frames], "spot, dark or flat"),
        ("sha256", [looks[f.path].sha256 for f in dataset.frames], "SHA-256 of the file"),
    ):
        ds[name] = ("frame", np.array(values, dtype=object), {"units": "1", "long_name": long_name})
    for name, numbers, units, long_name in (
        ("angle_deg", [f.angle_deg for f in dataset.frames], "degree", "fibre orientation"),
        ("exposure_s", [f.exposure_s for f in dataset.frames], "s", "exposure time"),
        ("repeat", [f.repeat for f in dataset.frames], "1", "site or repetition within a condition"),
        ("page", [f.page for f in dataset.frames], "1", "page of a stack, from 0"),
    ):
        filled = np.array([np.nan if v is None else v for v in numbers], float)
        ds[name] = ("frame", filled, {"units": units, "long_name": long_name})
    reserved = {*ds.variables, "rows", "columns", "container_bits", "full_scale"}
    for column in dataset.frames[0].extra:
        # A column may be called anything; netCDF names may not.
        name = re.sub(r"\W", "_", column)[:100]
        name = name if name[:1].isalpha() and name not in reserved else f"column_{name}"
        texts = np.array([frame.extra[column] for frame in dataset.frames], dtype=object)
        ds = ds.assign_coords(
            {name: ("frame", texts, {"units": get_column_unit(column), "long_name": f"column {column}"})}
        )
    for name, value, units, long_name in (
        ("rows", probe.shape[0], "pixel", "rows of every frame"),
        ("columns", probe.shape[1], "pixel", "columns of every frame"),
        ("container_bits", probe.bits, "bit", "bits of a stored pixel"),
        ("full_scale", end.reading, "DN", "largest possible reading"),
    ):
        ds[name] = ((), value, {"units": units, "long_name": long_name})
    ds["full_scale"].attrs["source"] = end.source
    return ds


def copies(dataset: Dataset, copy_of: np.ndarray) -> list[str]:
    """A remark on each frame that is a copy; of many on the first and their number."""
    own = np.flatnonzero(copy_of >= 0)
    said = [f"{dataset.frames[k].label} holds the same pixels as {dataset.frames[copy_of[k]].label}" for k in own]
    more = [f"{len(said) - MOST_NAMED} more frames are copies"] if len(said) > MOST_NAMED else []
    return [f"{text}, so that it is left out as a copy" for text in said[:MOST_NAMED]] + more


def without_copies(dataset: Dataset, table: xr.Dataset) -> Dataset:
    """The dataset without frames that hold the pixels of an earlier one, and without those left out by hand."""
    pairs = zip(dataset.frames, table["copy_of"].values, strict=True)
    kept = [frame for frame, own in pairs if own < 0 and frame.keep is not False]
    return replace(dataset, frames=tuple(kept))


def end_in(table: xr.Dataset) -> End:
    """Where the readings of a dataset stop, by its frames.nc."""
    return End(int(table["full_scale"]), str(table["full_scale"].attrs["source"]))


def crop(dataset: Dataset, table: xr.Dataset, path: Path, *, code: str, inputs: list) -> None:
    """Write crops.nc: for every spot both crops, their place on the sensor, and the reduced copy of the whole frame.
    Frames that are not like their siblings are flagged; `remarks` says of each frame that is set aside why.

    Raises `InputError` where a frame is no more what `table`, its frames.nc, says of it.
    """
    side = dataset.instrument.crop_px
    shape, highest = (int(table["rows"]), int(table["columns"])), float(table["full_scale"])
    block = min(frames.BLOCK_PX, *shape)
    extra = xr.Dataset(attrs={"title": dataset.title, "dataset": dataset.name})
    extra["centring"] = (
        "centring",
        np.array(CENTRINGS, dtype=object),
        {"units": "1", "long_name": "what the crop is centred on"},
    )
    for name, size, step, long_name in (
        ("y", side, 1, "row of the crop"),
        ("x", side, 1, "column of the crop"),
        ("block_y", frames.count_blocks(shape[0], shape), block, "first row of the block"),
        ("block_x", frames.count_blocks(shape[1], shape), block, "first column of the block"),
        ("row", shape[0], 1, "row of the frame"),
        ("column", shape[1], 1, "column of the frame"),
    ):
        extra[name] = (name, np.arange(size, dtype="i4") * step, {"units": "pixel", "long_name": long_name})
    variables = {
        "image": store.Variable(
            ("centring", "y", "x"), "f4", "DN", "crop; NaN beyond the frame and where the pixel is bad"
        ),
        "top": store.Variable(("centring",), "i4", "pixel", "row of the frame under row 0 of the crop"),
        "left": store.Variable(("centring",), "i4", "pixel", "column of the frame under column 0 of the crop"),
        "status": store.Variable(("centring",), "i4", "1", "status flags"),
        "block_mean": store.Variable(("block_y", "block_x"), "f4", "DN", "mean of each block of the frame"),
        "row_mean": store.Variable(("row",), "f4", "DN", "mean of each row of the frame"),
        "column_mean": store.Variable(("column",), "f4", "DN", "mean of each column of the frame"),
    }
    columns = (table[name].values for name in ("file", "page", "copy_of"))
    copied = {(str(file), int(page)): int(own) >= 0 for file, page, own in zip(*columns, strict=True)}
    with (
        store.frame_writer(path, dataset, extra, variables, code=code, inputs=inputs) as writer,
        file_cache.verify_unchanged(dataset, table),
    ):
        places, statuses, glances = [], [], []
        for index, frame in progress.track(dataset.cells(), "cropping spots", len(dataset.spots)):
            pixels = frames.read_masked_image(dataset, frame)
            if (frame.file, frame.page) not in copied:
                raise InputError(f"{frame.label}: not in frames.nc; run ingest again")
            again = store.flag("copy") if copied[frame.file, frame.page] else 0
            again |= store.flag("dropped") if frame.keep is False else 0
            cell = _cell(pixels, side, highest, again)
            writer.put(index, cell)
            places.append(index)
            statuses.append(cell["status"])
            glances.append(_glance(cell))
        judged, remarks = _judged(dataset, np.array(statuses), glances)
        for index, status in zip(places, judged, strict=True):
            writer.put(index, {"status": status})
        writer.remark(remarks)


def _cell(pixels: np.ndarray, side: int, highest: float, flags: int) -> dict[str, Any]:
    """All variables of one frame; `flags` are set in its status beside what its pixels say."""
    spots = (spotfinding.light_centroid(pixels, side), spotfinding.brightest_pixel(pixels))
    images = np.stack([spotfinding.cut(pixels, spot, side) for spot in spots])
    surround, top = frames.reduce_frame(pixels), top_of(frames.select_good_readings(pixels))
    clip = float(top.highest) if top.stops(top.lowest) else highest
    return {
        "image": images,
        "top": [spot.row - side // 2 for spot in spots],
        "left": [spot.column - side // 2 for spot in spots],
        "status": [
            flags
            | _status(image, spots[0].found, highest, clip)
            | (0 if _within(pixels, spot, side) else store.flag("masked"))
            for image, spot in zip(images, spots, strict=True)
        ],
        "block_mean": surround.block_mean,
        "row_mean": surround.row_mean,
        "column_mean": surround.column_mean,
    }


def _glance(cell: dict[str, Any]) -> siblings.Glance | None:
    """A glance at the crop around the light; None where it is of no use."""
    at_light = CENTRINGS.index("light")
    if not usable(cell["status"][at_light]):
        return None
    return siblings.glance(cell["image"][at_light], cell["left"][at_light], cell["top"][at_light])


def _judged(
    dataset: Dataset, statuses: np.ndarray, glances: list[siblings.Glance | None]
) -> tuple[np.ndarray, list[str]]:
    """Statuses [spot, centring] with what siblings say and the manifest overrules, and a remark on each frame that is
    set aside."""
    odd, remark = siblings.odd_ones(dataset, glances)
    why = {own.spot: own.why for own in odd}
    for own in odd:
        statuses[own.spot] |= store.flag(own.flag)
    aside: dict[str, list[str]] = {}
    for k, frame in enumerate(dataset.spots):
        flags = statuses[k, CENTRINGS.index("light")] & store.EXCLUDED
        if frame.keep:
            statuses[k] &= ~store.CLEARED_BY_KEEP
        if not flags:
            continue
        said = f"{store.status_names(flags)}: {why.get(k, store.describe_flags(flags))}"
        manner = "used by hand (keep = yes in manifest.csv) though" if frame.keep else "set aside as"
        aside.setdefault(f"{manner} {said}", []).append(frame.label)
    told = [f"{own[0]} is {text}" if len(own) == 1 else f"{len(own)} frames are {text} ({some_of(own)})"
            for text, own in aside.items()]  # fmt: skip
    return statuses, [*([remark] if remark else []), *told]


def some_of(labels: list[str]) -> str:
    """Frames by name, and of many the first."""
    more = [f"{len(labels) - MOST_NAMED} more"] if len(labels) > MOST_NAMED else []
    return ", ".join([*labels[:MOST_NAMED], *more])


def _status(image: np.ndarray, found: bool, highest: float, clip: float) -> int:
    """Flags of a crop by the largest reading of all [DN], and that at which the frame itself stops."""
    valid = np.isfinite(image)
    if np.count_nonzero(image[valid] < highest) <= LEAST_UNCLIPPED * np.count_nonzero(valid):
        return store.flag("saturated")
    clipped = bool(np.any(image[valid] >= clip))
    return (0 if found else store.flag("black")) | (store.flag("clipped") if clipped else 0)


def _within(pixels: np.ndarray, spot: spotfinding.Spot, side: int) -> bool:
    """Whether a crop lies within its frame."""
    starts = spot.row - side // 2, spot.column - side // 2
    return all(0 <= start <= length - side for start, length in zip(starts, pixels.shape, strict=True))


def usable(status: int | np.ndarray | xr.DataArray) -> bool:
    """Whether a crop can serve a fit or a metric."""
    return not int(status) & store.UNUSABLE


def cells(ds: xr.Dataset, dims: tuple[str, ...]) -> Iterator[dict[str, int]]:
    """Every index of the named dimensions that has a frame, as keywords for `isel`; frames are then read one at a time.
    A grid of as many exposures as repeats is nearly empty."""
    others = [d for d in ds["status"].dims if d not in dims]
    there = (ds["status"] != store.flag("missing")).any(others).transpose(*dims).values
    for index in np.argwhere(there).tolist():
        yield dict(zip(dims, index, strict=True))
