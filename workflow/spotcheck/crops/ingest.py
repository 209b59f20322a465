"""The ingest stage: check the frames of a dataset and tabulate digest, extremes, clipping and copies (frames.nc).

A digest is the SHA-256 of a file. The manifest (manifest.csv) lists the frames of a dataset, one row for each.
Impossible readings are constants in place of measured readings, such as those of lost packets, masks and overlays
(`dataset.impossible_readings`).
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.crops.crop_size import sample_evenly
from spotcheck.crops.full_scale import FullScale, ReadingExtremes, find_full_scale, measure_extremes
from spotcheck.dataset import file_cache, frames
from spotcheck.dataset.folder import Dataset, check_files, get_column_unit
from spotcheck.dataset.impossible_readings import describe_impossible_readings
from spotcheck.dataset.manifest import Frame
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.errors import InputError
from spotcheck.io import progress, store

# Largest number of frames that a remark lists by name.
MAX_NAMED = 5
# Largest length of the name of a variable for a column of the manifest.
MAX_NAME_LENGTH = 100


def check_dataset(dataset: Dataset) -> frames.FrameFormat:
    """Return the format that all frames share, after a check of their files; no pixel is decoded.

    The files must exist, their headers must agree, and the crop must fit into the frames.

    Raises
    ------
    InputError
        For the first check that fails.
    """
    check_files(dataset)
    return frames.check_formats(dataset)


def check_readings(dataset: Dataset) -> None:
    """Decode the first frame of some files at even distances, as `new-dataset` does.

    Raises
    ------
    InputError
        If one cannot be decoded, or its pixels are no readings: swapped bytes, false colours, values above full scale.
    """
    first_frames: dict[str, Frame] = {}
    for frame in dataset.frames:
        first_frames.setdefault(frame.file, frame)
    for frame in sample_evenly(list(first_frames.values())):
        frames.read_image(dataset, frame)


def ingest_frames(dataset: Dataset, before: Mapping[str, file_cache.FileRecord] = MappingProxyType({})) -> xr.Dataset:
    """Return the table of all frames of the manifest, the content of frames.nc.

    Parameters
    ----------
    dataset : Dataset
        Every frame is decoded once.
    before : mapping
        Records (digest, size, times) of files from earlier runs, by full path. Digests are reused for files whose size
        and times have not changed.

    Returns
    -------
    xr.Dataset
        Along `frame`: digest, extreme readings, pixels at full scale and copies. Once: shape of a frame, bits of a
        stored pixel, full scale. The attribute `remarks` has sentences for the user.

    Raises
    ------
    InputError
        If `check_dataset` fails, or if a file changes while it is read: its digest would not belong to the pixels.
    """
    frame_format = check_dataset(dataset)
    statistics, digests, reading_remarks = _decode_frames(dataset, before)
    extremes, means, zeros, copy_of = zip(*statistics, strict=True)
    full_scale = find_full_scale(extremes, dataset.instrument, frame_format.bits)
    at_full_scale = [extreme.at_highest if extreme.highest == full_scale.reading else 0 for extreme in extremes]
    manifest = dataset.frames
    columns = {
        "frame": _column(range(len(manifest)), "i8", "1", "row of the manifest, from 0"),
        "minimum": _column([extreme.lowest for extreme in extremes], "i4", "DN", "smallest reading"),
        "maximum": _column([extreme.highest for extreme in extremes], "i4", "DN", "largest reading"),
        "mean": _column(means, "f8", "DN", "mean reading"),
        "at_full_scale": _column(at_full_scale, "i8", "pixel", "pixels that read full scale"),
        "at_zero": _column(zeros, "i8", "pixel", "pixels that read zero"),
        "copy_of": _column(copy_of, "i4", "1", "earlier frame that holds the same pixels; -1 where none does"),
        # `file` may end with a path inside the file, as for HDF5; `path` is the file alone.
        "file": _column([frame.file for frame in manifest], object, "1", "path in the dataset folder"),
        "kind": _column([frame.kind for frame in manifest], object, "1", "spot, dark or flat"),
        "sha256": _column([digests[frame.path] for frame in manifest], object, "1", "SHA-256 of the file"),
        # Empty cells (None) become NaN.
        "angle_deg": _column([frame.angle_deg for frame in manifest], float, "degree", "fibre orientation"),
        "exposure_s": _column([frame.exposure_s for frame in manifest], float, "s", "exposure time"),
        "repeat": _column([frame.repeat for frame in manifest], float, "1", "site or repetition within a condition"),
        "page": _column([frame.page for frame in manifest], float, "1", "page of a stack, from 0"),
    }
    shared = {
        "rows": ((), frame_format.shape[0], {"units": "pixel", "long_name": "rows of every frame"}),
        "columns": ((), frame_format.shape[1], {"units": "pixel", "long_name": "columns of every frame"}),
        "container_bits": ((), frame_format.bits, {"units": "bit", "long_name": "bits of a stored pixel"}),
        "full_scale": ((), full_scale.reading, {"units": "DN", "long_name": "largest possible reading"}),
    }
    coordinates = _extra_columns(dataset, {*columns, *shared})
    table = xr.Dataset(columns | shared, coordinates, {"title": dataset.title, "dataset": dataset.name})
    table["full_scale"].attrs["source"] = full_scale.source
    copy_remarks = _describe_copies(dataset, copy_of)
    remarks = [*frame_format.remarks, *list_unusual_values(dataset), *full_scale.remarks, *reading_remarks]
    remarks += copy_remarks
    return store.add_remarks(table, remarks)


def _decode_frames(
    dataset: Dataset, before: Mapping[str, file_cache.FileRecord]
) -> tuple[list[tuple[ReadingExtremes, float, int, int]], dict[str, str], list[str]]:
    """Decode all frames and compute the digests of their files.

    Parameters
    ----------
    dataset : Dataset
        Every frame of its manifest is decoded once.
    before : mapping
        Records of files from earlier runs, by full path.

    Returns
    -------
    statistics : list of tuple
        For each frame: extreme readings, mean [DN], number of pixels that read 0, and row of the first frame with the
        same pixels (−1: none). Bad pixels and impossible readings are left out.
    digests : dict
        SHA-256 of each file by its path in the folder (`Frame.path`).
    remarks : list of str
        Sentences on impossible readings, of frames of every kind.

    Raises
    ------
    InputError
        If a file changes while it is read.
    """
    # Record of each file by its path in the folder, and row of the first frame with given pixels by their digest.
    statistics, records, first_rows = [], dict[str, file_cache.FileRecord](), dict[bytes, int]()
    # Label of each frame, with its number of impossible readings by reason.
    impossible_counts = []
    for row, frame in enumerate(progress.track(dataset.frames, "reading frames")):
        if frame.path not in records:
            full_path = dataset.folder / frame.path
            records[frame.path] = file_cache.record_file(full_path, before.get(str(full_path)))
        image, impossible_readings = frames.read_checked_image(dataset, frame)
        impossible_counts.append((frame.label, impossible_readings.counts))
        pixels = frames.select_good_readings(image)
        extremes = measure_extremes(pixels)
        # ASSUME: two exposures that agree in every pixel are copies, as noise makes them differ. Frames with the same
        # reading in all pixels, such as black ones, do not count as copies.
        is_uniform = extremes.lowest == extremes.highest
        first_row = row if is_uniform else first_rows.setdefault(hashlib.sha256(pixels.data).digest(), row)
        zeros = int(pixels.size - np.count_nonzero(pixels))
        statistics.append((extremes, float(pixels.mean(dtype=np.float64)), zeros, first_row if first_row < row else -1))
    # The digest is computed again only if size or times of the file differ from the record.
    for path, record in records.items():
        if file_cache.record_file(dataset.folder / path, record).sha256 != record.sha256:
            raise InputError(f"{path}: has changed while it was read; run again when nothing writes to it")
    remarks = describe_impossible_readings(impossible_counts, MAX_NAMED)
    return statistics, {path: record.sha256 for path, record in records.items()}, remarks


def _column(values: Sequence[Any], dtype: Any, units: str, long_name: str) -> tuple:
    """Return dimension, values and attributes of a variable of frames.nc from its values [frame]."""
    return "frame", np.array(values, dtype), {"units": units, "long_name": long_name}


def _extra_columns(dataset: Dataset, reserved: set[str]) -> dict[str, tuple]:
    """Return the additional columns of the manifest as coordinates, under names that netCDF allows.

    `reserved` are the names of other variables, which are avoided. Values are texts, as in the manifest. Two columns
    whose names differ only in other characters than letters and digits share a name, and the last one is stored.
    """
    coordinates = {}
    for column in dataset.frames[0].extra:
        name = re.sub(r"\W", "_", column)[:MAX_NAME_LENGTH]
        name = name if name[:1].isalpha() and name not in reserved else f"column_{name}"
        texts = [frame.extra[column] for frame in dataset.frames]
        coordinates[name] = _column(texts, object, get_column_unit(column), f"column {column}")
    return coordinates


def _describe_copies(dataset: Dataset, copy_of: Sequence[int]) -> list[str]:
    """Return one remark for each frame that is a copy, at most `MAX_NAMED`, and the number of the others.

    `copy_of` [frame] is the row of the first frame with the same pixels; −1 for a frame that is no copy.
    """
    remarks = [
        f"{frame.label} holds the same pixels as {dataset.frames[first_row].label}, so that it is left out as a copy"
        for frame, first_row in zip(dataset.frames, copy_of, strict=True)
        if first_row >= 0
    ]
    more = [f"{len(remarks) - MAX_NAMED} more frames are copies"] if len(remarks) > MAX_NAMED else []
    return remarks[:MAX_NAMED] + more


def exclude_copies(dataset: Dataset, table: xr.Dataset) -> Dataset:
    """Return the dataset without the frames that its frames.nc calls copies, and without those with keep = no.

    `table` is the content of frames.nc, with one row for each frame of the dataset in the same order.
    """
    rows = zip(dataset.frames, table["copy_of"].values, strict=True)
    return replace(dataset, frames=tuple(frame for frame, copy_of in rows if copy_of < 0 and frame.keep is not False))


def read_full_scale(table: xr.Dataset) -> FullScale:
    """Return the full scale of a dataset with its source, from the content of frames.nc; it has no remarks."""
    return FullScale(int(table["full_scale"]), str(table["full_scale"].attrs["source"]))
