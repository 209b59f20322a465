"""The ingest stage: check the frames of a dataset and tabulate digest, extremes, clipping and copies (frames.nc)."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import xarray as xr

from spotcheck.crops.full_scale import FullScale, ReadingExtremes, find_full_scale, measure_extremes
from spotcheck.dataset import frames
from spotcheck.dataset import ingested as seen
from spotcheck.dataset.folder import Dataset, check_files, unit_of
from spotcheck.dataset.plausible import remarks_on
from spotcheck.errors import InputError
from spotcheck.io import progress, store

# Largest number of frames that a remark lists by name.
MAX_NAMED = 5


def check_dataset(dataset: Dataset) -> frames.Probe:
    """Check without decoding pixels that all files exist, that their headers agree, and that the crop fits.

    Raises
    ------
    InputError
        For the first check that fails.
    """
    check_files(dataset)
    return frames.probe_all(dataset)


def ingest_frames(dataset: Dataset, before: Mapping[str, seen.Look] = MappingProxyType({})) -> xr.Dataset:
    """Return the table of all frames of the manifest, which is written as frames.nc.

    Parameters
    ----------
    dataset : Dataset
        Every frame is decoded once.
    before : mapping
        Digests of earlier runs by path. They are reused for files whose size and times have not changed.

    Returns
    -------
    Dataset
        Digest, extreme readings, clipped pixels and copies by `frame`; shape, bits and full scale of all frames;
        attribute `remarks`.

    Raises
    ------
    InputError
        If a file changes while it is read: its digest would not belong to the pixels.
    """
    probe = check_dataset(dataset)
    extremes, means, zeros, copy_of = [], [], [], []
    looks, first_with = dict[str, seen.Look](), dict[bytes, int]()
    for row, frame in enumerate(progress.over(dataset.frames, "reading frames")):
        if frame.path not in looks:
            path = dataset.folder / frame.path
            looks[frame.path] = seen.look(path, before.get(str(path)))
        pixels = frames.readings(frames.read_good(dataset, frame))
        extremes.append(measure_extremes(pixels))
        means.append(pixels.mean(dtype=np.float64))
        zeros.append(int(pixels.size - np.count_nonzero(pixels)))
        # ASSUME: noise makes no two exposures equal in every pixel, unless all of them read the same, as black ones do.
        is_uniform = extremes[-1].lowest == extremes[-1].highest
        first = row if is_uniform else first_with.setdefault(hashlib.sha256(pixels.data).digest(), row)
        copy_of.append(first if first < row else -1)
    for file, look in looks.items():
        if seen.look(dataset.folder / file, look).sha256 != look.sha256:
            raise InputError(f"{file}: has changed while it was read; run again when nothing writes to it")
    full_scale = find_full_scale(extremes, dataset.instrument, probe.bits)
    table = xr.Dataset(attrs={"title": dataset.title, "dataset": dataset.name})
    remarks = [*probe.remarks, *remarks_on(dataset), *full_scale.remarks, *_name_copies(dataset, copy_of)]
    table = store.with_remarks(table, remarks)
    digests = [looks[frame.path].sha256 for frame in dataset.frames]
    table = table.assign(_pixel_columns(extremes, means, zeros, copy_of, full_scale.reading))
    table = table.assign(_manifest_columns(dataset, digests))
    table = table.assign(_shared_values(probe, full_scale))
    return table.assign_coords(_extra_columns(dataset, set(table.variables)))


def _pixel_columns(
    extremes: list[ReadingExtremes], means: list[float], zeros: list[int], copy_of: list[int], full_scale: int
) -> dict[str, tuple]:
    """Return the columns of frames.nc that are computed from pixels, each with the row of the manifest as `frame`."""
    at_full_scale = [frame.at_highest if frame.highest == full_scale else 0 for frame in extremes]
    lowest, highest = [frame.lowest for frame in extremes], [frame.highest for frame in extremes]
    return {
        name: ("frame", np.array(values, dtype), {"units": units, "long_name": long_name})
        for name, values, dtype, units, long_name in (
            ("frame", range(len(extremes)), "i8", "1", "row of the manifest, from 0"),
            ("minimum", lowest, "i4", "DN", "smallest reading"),
            ("maximum", highest, "i4", "DN", "largest reading"),
            ("mean", means, "f8", "DN", "mean reading"),
            ("at_full_scale", at_full_scale, "i8", "pixel", "pixels that read full scale"),
            ("at_zero", zeros, "i8", "pixel", "pixels that read zero"),
            ("copy_of", copy_of, "i4", "1", "earlier frame that holds the same pixels; -1 where none does"),
        )
    }


def _manifest_columns(dataset: Dataset, digests: list[str]) -> dict[str, tuple]:
    """Return the columns of frames.nc that every manifest has, and the SHA-256 of each frame's file."""
    texts = {
        name: ("frame", np.array(values, dtype=object), {"units": "1", "long_name": long_name})
        for name, values, long_name in (
            ("file", [frame.file for frame in dataset.frames], "path in the dataset folder"),
            ("kind", [frame.kind for frame in dataset.frames], "spot, dark or flat"),
            ("sha256", digests, "SHA-256 of the file"),
        )
    }
    # Empty cells (None) become NaN.
    numbers = {
        name: ("frame", np.array(values, float), {"units": units, "long_name": long_name})
        for name, values, units, long_name in (
            ("angle_deg", [frame.angle_deg for frame in dataset.frames], "degree", "fibre orientation"),
            ("exposure_s", [frame.exposure_s for frame in dataset.frames], "s", "exposure time"),
            ("repeat", [frame.repeat for frame in dataset.frames], "1", "site or repetition within a condition"),
            ("page", [frame.page for frame in dataset.frames], "1", "page of a stack, from 0"),
        )
    }
    return texts | numbers


def _shared_values(probe: frames.Probe, full_scale: FullScale) -> dict[str, tuple]:
    """Return the variables of frames.nc that all frames share."""
    variables = {
        name: ((), value, {"units": units, "long_name": long_name})
        for name, value, units, long_name in (
            ("rows", probe.shape[0], "pixel", "rows of every frame"),
            ("columns", probe.shape[1], "pixel", "columns of every frame"),
            ("container_bits", probe.bits, "bit", "bits of a stored pixel"),
            ("full_scale", full_scale.reading, "DN", "largest possible reading"),
        )
    }
    variables["full_scale"][2]["source"] = full_scale.source
    return variables


def _extra_columns(dataset: Dataset, reserved: set) -> dict[str, tuple]:
    """Return the additional columns of the manifest as coordinates, under names that netCDF allows."""
    coordinates = {}
    for column in dataset.frames[0].extra:
        name = re.sub(r"\W", "_", column)[:100]
        name = name if name[:1].isalpha() and name not in reserved else f"column_{name}"
        texts = np.array([frame.extra[column] for frame in dataset.frames], dtype=object)
        coordinates[name] = ("frame", texts, {"units": unit_of(column), "long_name": f"column {column}"})
    return coordinates


def _name_copies(dataset: Dataset, copy_of: list[int]) -> list[str]:
    """Return one remark per frame that is a copy; for many, the first and the number of the others."""
    remarks = [
        f"{frame.label} holds the same pixels as {dataset.frames[first].label}, so that it is left out as a copy"
        for frame, first in zip(dataset.frames, copy_of, strict=True)
        if first >= 0
    ]
    more = [f"{len(remarks) - MAX_NAMED} more frames are copies"] if len(remarks) > MAX_NAMED else []
    return remarks[:MAX_NAMED] + more


def exclude_copies(dataset: Dataset, table: xr.Dataset) -> Dataset:
    """Return the dataset without copies of other frames (by its frames.nc) and without frames with keep = no."""
    rows = zip(dataset.frames, table["copy_of"].values, strict=True)
    return replace(dataset, frames=tuple(frame for frame, first in rows if first < 0 and frame.keep is not False))


def read_full_scale(table: xr.Dataset) -> FullScale:
    """Return the full scale of a dataset from its frames.nc."""
    return FullScale(int(table["full_scale"]), str(table["full_scale"].attrs["source"]))
