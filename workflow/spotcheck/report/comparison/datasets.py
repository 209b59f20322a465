"""Results of several datasets, read for comparison.

Conditions are the values of the design axes at which frames were taken, such as angle and exposure. Numbers of spots
are compared at equal conditions. The verdict (verdict.json) names the effects that the model of the frames lacks. A
stage is a step of the workflow that writes one result file.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.dataset.conditions import merge_values
from spotcheck.dataset.manifest import DATE
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.report.comparison.numbers import GROUPS, Measurement, QuantityName, collect_numbers, list_files

# Column of the manifest whose tolerance applies to a design axis; other axes are named like their column.
COLUMNS = {"angle": "angle_deg", "exposure": "exposure_s"}
# Smallest number of datasets of a comparison.
MIN_DATASETS = 2


@dataclass(frozen=True)
class DatasetResults:
    """Results of one dataset."""

    folder: Path  # results folder
    label: str  # name among the compared datasets: that of the folder, or its path if two folders have one name
    title: str  # title of the dataset
    frames: dict[str, int]  # number of frames by kind: "spot", "flat" or "dark"
    mean_time: datetime | None  # mean time of exposure of the frames; None if unknown
    verdict: dict[str, Any] | None  # content of verdict.json; None if there is none
    numbers: dict[QuantityName, Measurement]  # numbers that can be compared
    skipped: dict[str, str]  # reason for each skipped stage, by the name of the stage


def read_datasets(folders: Sequence[Path]) -> list[DatasetResults]:
    """Return the results of several datasets.

    Conditions (such as angle or exposure) that agree within the tolerance of their manifest column get one common
    value, so that the numbers at these conditions are compared.

    Parameters
    ----------
    folders : sequence of Path
        Results folders, at least two.

    Returns
    -------
    list of DatasetResults
        In the order of `folders`. Datasets whose folders have the same name are labelled by their paths.

    Raises
    ------
    InputError
        With fewer than two folders, if a folder has no frames.nc or is named twice, or if no two datasets have a
        number of the same name and unit.
    """
    if len(folders) < MIN_DATASETS:
        raise InputError(f"{len(folders)} dataset to compare; name two or more")
    for folder, count in Counter(folder.resolve() for folder in folders).items():
        if count > 1:
            raise InputError(f"{folder}: named twice; a dataset is compared with others")
    datasets = _align_conditions([_read_dataset(folder) for folder in folders])
    counts = Counter(dataset.label for dataset in datasets)
    datasets = [replace(d, label=str(d.folder)) if counts[d.label] > 1 else d for d in datasets]
    if not list_shared(datasets):
        labels = " and ".join(dataset.label for dataset in datasets)
        raise InputError(
            f"{labels} have no number in common; compare datasets of one kind, at conditions that they share"
        )
    return datasets


def list_shared(datasets: Sequence[DatasetResults]) -> list[QuantityName]:
    """Return the names of numbers that two or more datasets have, all in one unit, in the order of `GROUPS`."""
    shared = [name for name, units in _list_units(datasets).items() if len(units) > 1 and len(set(units.values())) == 1]
    return sorted(shared, key=lambda name: GROUPS.index(name.group))


def list_unit_conflicts(datasets: Sequence[DatasetResults]) -> list[str]:
    """Return one sentence for each number that is not compared because its units differ."""
    conflicts = {name: units for name, units in _list_units(datasets).items() if len(set(units.values())) > 1}
    return [
        f"{name.quantity} is not compared: it is in {', '.join(f'{unit} in {label}' for label, unit in units.items())}"
        for name, units in conflicts.items()
    ]


def _list_units(datasets: Sequence[DatasetResults]) -> dict[QuantityName, dict[str, str]]:
    """Return the unit of each number in each dataset that has it: name → label of the dataset → unit."""
    units: dict[QuantityName, dict[str, str]] = {}
    for dataset in datasets:
        for name, number in dataset.numbers.items():
            units.setdefault(name, {})[dataset.label] = number.units
    return units


def _read_dataset(folder: Path) -> DatasetResults:
    """Return the results of one dataset. Raises `InputError` if the folder has no frames.nc."""
    if not (folder / "frames.nc").is_file():
        raise InputError(f"{folder}: holds no results of a dataset (no frames.nc); run the workflow on it first")
    files, verdict = {}, None
    for path in list_files(folder):
        if path.suffix == ".json":
            verdict = json.loads(path.read_text(encoding="utf-8"))
        else:
            with store.read(path) as ds:
                # Images are large, and no number is read from them.
                without_images = [str(name) for name in ds.data_vars if not {"x", "y"} & set(ds[name].dims)]
                files[path.stem] = ds[without_images].load()
    frames = files["frames"]
    return DatasetResults(
        folder=folder,
        label=folder.name or str(folder),
        title=str(frames.attrs["title"]),
        frames=dict(Counter(frames["kind"].values.astype(str).tolist())),
        mean_time=_average_dates(frames),
        verdict=verdict,
        numbers=collect_numbers(files, verdict),
        skipped={name: str(ds.attrs["skipped"]) for name, ds in files.items() if "skipped" in ds.attrs},
    )


def _average_dates(frames: xr.Dataset) -> datetime | None:
    """Return the mean time of exposure of the rows of frames.nc; None if a date is missing or not ISO 8601."""
    if DATE not in frames.variables:
        return None
    try:
        dates = [datetime.fromisoformat(text) for text in frames[DATE].values.astype(str)]
    except ValueError:
        return None
    # A time without a zone counts as UTC: an error of hours does not matter to a trend over days.
    timestamps = [date.replace(tzinfo=date.tzinfo or UTC).timestamp() for date in dates]
    return datetime.fromtimestamp(float(np.mean(timestamps)), UTC)


def _align_conditions(datasets: Sequence[DatasetResults]) -> list[DatasetResults]:
    """Return the datasets with values that count as one condition replaced by their mean."""
    conditions = {item for dataset in datasets for name in dataset.numbers for item in name.conditions}
    # Common value of a condition by (axis, value in a dataset).
    common_values: dict[tuple[str, float], float] = {}
    for axis in {condition.axis for condition in conditions}:
        values = sorted({condition.value for condition in conditions if condition.axis == axis})
        means = merge_values(COLUMNS.get(axis, axis), values).values
        common_values |= {(axis, value): mean for value, mean in zip(values, means, strict=True) if mean is not None}
    return [
        replace(dataset, numbers={_align_name(name, common_values): number for name, number in dataset.numbers.items()})
        for dataset in datasets
    ]


def _align_name(name: QuantityName, common_values: Mapping[tuple[str, float], float]) -> QuantityName:
    """Return a name with the common value of each of its conditions; `common_values` is by axis and old value."""
    conditions = (item._replace(value=common_values[item.axis, item.value]) for item in name.conditions)
    return name._replace(conditions=tuple(conditions))


def list_sources(folders: Sequence[Path]) -> list[Path]:
    """Return every file that `read_datasets` reads from the results folders."""
    return [path for folder in folders for path in list_files(folder)]
