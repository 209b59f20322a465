"""The first two stages: what each frame is (ingest), and the crop around its spot (crop)."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

from spotcheck import frames, provenance, store
from spotcheck.clip import End, end_of, top_of
from spotcheck.dataset import Dataset, check_files, unit_of
from spotcheck.errors import InputError
from spotcheck.plausible import remarks_on

# How the crop is centred: on the light's centroid (default of every stage), or on the maximum, as the paper.
CENTRINGS = ("light", "maximum")


def check_dataset(dataset: Dataset) -> frames.Probe:
    """All checks that need no pixels: files named and there, headers readable and alike, crop within the frame."""
    check_files(dataset)
    return frames.probe_all(dataset)


def ingest(dataset: Dataset) -> xr.Dataset:
    """Table of every frame of the manifest: digest, shape, depth, extremes, clipped pixels. Decodes each frame once."""
    probe = check_dataset(dataset)
    names = {
        "minimum": ("i4", "DN", "smallest reading"),
        "maximum": ("i4", "DN", "largest reading"),
        "mean": ("f8", "DN", "mean reading"),
        "at_full_scale": ("i8", "pixel", "pixels that read full scale"),
        "at_zero": ("i8", "pixel", "pixels that read zero"),
    }
    count = len(dataset.frames)
    columns = {name: np.zeros(count, dtype) for name, (dtype, _, _) in names.items()}
    digest_of = cache(lambda file: provenance.file_digest(dataset.folder / file))
    digests, tops = [], []
    for k, frame in enumerate(dataset.frames):
        pixels = frames.read(dataset, frame)
        digests.append(digest_of(frame.file))
        top = top_of(pixels)
        tops.append(top)
        columns["minimum"][k], columns["maximum"][k] = top.lowest, top.highest
        columns["mean"][k] = pixels.mean(dtype=np.float64)
        columns["at_zero"][k] = pixels.size - np.count_nonzero(pixels)
    end = end_of(tops, dataset.instrument, probe.bits)
    columns["at_full_scale"][:] = [own.pixels if own.highest == end.reading else 0 for own in tops]
    ds = xr.Dataset(attrs={"title": dataset.title, "dataset": dataset.name})
    uniform = [own.lowest == own.highest for own in tops]
    ds = store.with_remarks(ds, [*remarks_on(dataset), *end.remarks, *_copies(dataset, digests, uniform)])
    ds["frame"] = ("frame", np.arange(count), {"units": "1", "long_name": "row of the manifest, from 0"})
    for name, (_, units, long_name) in names.items():
        ds[name] = ("frame", columns[name], {"units": units, "long_name": long_name})
    for name, values, long_name in (
        ("file", [f.file for f in dataset.frames], "path in the dataset folder"),
        ("kind", [f.kind for f in dataset.frames], "spot, dark or flat"),
        ("sha256", digests, "SHA-256 of the file"),
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
        ds = ds.assign_coords({name: ("frame", texts, {"units": unit_of(column), "long_name": f"column {column}"})})
    for name, value, units, long_name in (
        ("rows", probe.shape[0], "pixel", "rows of every frame"),
        ("columns", probe.shape[1], "pixel", "columns of every frame"),
        ("container_bits", probe.bits, "bit", "bits of a stored pixel"),
        ("full_scale", end.reading, "DN", "largest possible reading"),
    ):
        ds[name] = ((), value, {"units": units, "long_name": long_name})
    ds["full_scale"].attrs["source"] = end.source
    return ds


def _copies(dataset: Dataset, digests: list[str], uniform: list[bool]) -> Iterator[str]:
    """A sentence on frames that are copies of others; black ones without noise are alike by themselves."""
    first: dict[tuple[str, int], str] = {}
    copies = []
    for frame, digest, alike in zip(dataset.frames, digests, uniform, strict=True):
        if not alike and first.setdefault((digest, frame.page), frame.label) != frame.label:
            copies.append((frame.label, first[digest, frame.page]))
    if copies:
        more = f" ({len(copies)} copies in all)" if len(copies) > 1 else ""
        yield (
            f"{copies[0][0]} is a copy of {copies[0][1]}{more}: between copies there is no noise, so scatter and gain"
            " come out too small; drop them from manifest.csv"
        )


def end_in(table: xr.Dataset) -> End:
    """Where the readings of a dataset stop, by its frames.nc."""
    return End(int(table["full_scale"]), str(table["full_scale"].attrs["source"]))


def crop(dataset: Dataset, table: xr.Dataset, path: Path, *, code: str, inputs: list) -> None:
    """Write crops.nc: for every spot both crops, their place on the sensor, and the reduced copy of the whole frame."""
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
        ("block_y", frames.blocks_along(shape[0], shape), block, "first row of the block"),
        ("block_x", frames.blocks_along(shape[1], shape), block, "first column of the block"),
        ("row", shape[0], 1, "row of the frame"),
        ("column", shape[1], 1, "column of the frame"),
    ):
        extra[name] = (name, np.arange(size, dtype="i4") * step, {"units": "pixel", "long_name": long_name})
    variables = {
        "image": store.Variable(("centring", "y", "x"), "f4", "DN", "crop; NaN beyond the frame"),
        "top": store.Variable(("centring",), "i4", "pixel", "row of the frame under row 0 of the crop"),
        "left": store.Variable(("centring",), "i4", "pixel", "column of the frame under column 0 of the crop"),
        "status": store.Variable(("centring",), "i4", "1", "status flags"),
        "block_mean": store.Variable(("block_y", "block_x"), "f4", "DN", "mean of each block of the frame"),
        "row_mean": store.Variable(("row",), "f4", "DN", "mean of each row of the frame"),
        "column_mean": store.Variable(("column",), "f4", "DN", "mean of each column of the frame"),
    }
    seen = {str(f): str(s) for f, s in zip(table["file"].values, table["sha256"].values, strict=True)}
    with store.frame_writer(path, dataset, extra, variables, code=code, inputs=inputs) as writer:
        for index, frame, pixels in frames.spots(dataset):
            if seen.get(frame.file) is None:
                raise InputError(f"{frame.file}: not in frames.nc; run ingest again")
            writer.put(index, _cell(pixels, side, highest))


def _cell(pixels: np.ndarray, side: int, highest: float) -> dict[str, object]:
    """All variables of one frame."""
    spots = (frames.light_centroid(pixels, side), frames.brightest_pixel(pixels))
    images = np.stack([frames.cut(pixels, spot, side) for spot in spots])
    surround, top = frames.reduce_frame(pixels), top_of(pixels)
    clip = float(top.highest) if top.stops(top.lowest) else highest
    return {
        "image": images,
        "top": [spot.row - side // 2 for spot in spots],
        "left": [spot.column - side // 2 for spot in spots],
        "status": [_status(image, spots[0].found, highest, clip) for image in images],
        "block_mean": surround.block_mean,
        "row_mean": surround.row_mean,
        "column_mean": surround.column_mean,
    }


def _status(image: np.ndarray, found: bool, highest: float, clip: float) -> int:
    """Flags of a crop by the largest reading of all [DN], and that at which the frame itself stops."""
    valid = np.isfinite(image)
    clipped = bool(np.any(image[valid] >= clip))
    status = 0 if valid.all() else store.flag("masked")
    if np.all(image[valid] >= highest):
        return status | store.flag("saturated")
    if not found:
        status |= store.flag("black")
    return status | (store.flag("clipped") if clipped else 0)


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
