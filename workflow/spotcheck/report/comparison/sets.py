"""Results folders of several datasets, read so that they can be set side by side."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.conditions import merge_values
from spotcheck.dataset.manifest import DATE
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.report.comparison.numbers import GROUPS, Name, Number, files_in, numbers_of

# Columns whose tolerances tell which conditions of two datasets are one.
COLUMNS = {"angle": "angle_deg", "exposure": "exposure_s"}
ENOUGH = 2


class Set(NamedTuple):
    """What the results of a dataset say: folder, the word that names it among the others, its title, frames of each
    kind, when its frames were taken on average (None: not known), the verdict, its numbers, and stages that were
    skipped with the reason."""

    folder: Path
    label: str
    title: str
    frames: dict[str, int]
    taken: datetime | None
    verdict: dict[str, Any] | None
    numbers: dict[Name, Number]
    skipped: dict[str, str]


def read_sets(folders: Sequence[Path]) -> list[Set]:
    """The datasets of results folders, in their order, with conditions that are one within their tolerances made equal.

    Raises `InputError` for fewer than two, for a folder without results or named twice, and where no number is in two
    of them.
    """
    if len(folders) < ENOUGH:
        raise InputError(f"{len(folders)} dataset to compare; name two or more")
    twice = [own for own, count in Counter(folder.resolve() for folder in folders).items() if count > 1]
    if twice:
        raise InputError(f"{twice[0]}: named twice; a dataset is compared with others")
    sets = _aligned([_read(folder) for folder in folders])
    names = Counter(own.folder.name for own in sets)
    sets = [own if names[own.folder.name] == 1 else own._replace(label=str(own.folder)) for own in sets]
    if not common(sets):
        raise InputError(
            f"{' and '.join(own.label for own in sets)} have no number in common; compare datasets of one kind, at"
            " conditions that they share"
        )
    return sets


def common(sets: Sequence[Set]) -> list[Name]:
    """Numbers that two datasets or more have in one unit, in the order of their groups."""
    count = Counter(name for own in sets for name in own.numbers)
    units = {name: {own.numbers[name].units for own in sets if name in own.numbers} for name in count}
    shared = [name for name in count if count[name] >= ENOUGH and len(units[name]) == 1]
    return sorted(shared, key=lambda name: GROUPS.index(name.group))


def in_other_units(sets: Sequence[Set]) -> list[str]:
    """Sentences on numbers that cannot be compared because their units differ."""
    said = []
    for name in dict.fromkeys(name for own in sets for name in own.numbers):
        units = {own.label: own.numbers[name].units for own in sets if name in own.numbers}
        if len(set(units.values())) > 1:
            listed = ", ".join(f"{unit} in {label}" for label, unit in units.items())
            said.append(f"{name.what} is not compared: it is in {listed}")
    return said


def _read(folder: Path) -> Set:
    if not (folder / "frames.nc").is_file():
        raise InputError(f"{folder}: holds no results of a dataset (no frames.nc); run the workflow on it first")
    files = {}
    for path in files_in(folder):
        if path.suffix == ".nc":
            with store.read(path) as ds:
                files[path.stem] = ds[_small(ds)].load()
    verdict = folder / "verdict.json"
    found = json.loads(verdict.read_text(encoding="utf-8")) if verdict.is_file() else None
    table = files["frames"]
    return Set(
        folder=folder,
        label=folder.name or str(folder),
        title=str(table.attrs["title"]),
        frames=dict(Counter(table["kind"].values.astype(str).tolist())),
        taken=_taken(table),
        verdict=found,
        numbers=numbers_of(files, found),
        skipped={name: str(ds.attrs["skipped"]) for name, ds in files.items() if "skipped" in ds.attrs},
    )


def _small(ds: xr.Dataset) -> list[str]:
    """The variables of a file that are numbers or names and no images."""
    return [str(name) for name in ds.data_vars if not {"x", "y"} & set(ds[name].dims)]


def _taken(table: xr.Dataset) -> datetime | None:
    """Mean of the dates of the frames; None where a frame has none, or one that is not ISO 8601."""
    if DATE not in table.variables:
        return None
    try:
        dates = [datetime.fromisoformat(text) for text in table[DATE].values.astype(str)]
    except ValueError:
        return None
    # A time without a zone counts as UTC: a difference of hours does not matter to a trend over days.
    stamps = [own.replace(tzinfo=own.tzinfo or UTC).timestamp() for own in dates]
    return datetime.fromtimestamp(float(np.mean(stamps)), UTC)


def _aligned(sets: Sequence[Set]) -> list[Set]:
    """The sets with each condition at the value that it has in all of them."""
    values: dict[str, set[float]] = {}
    for axis, value, _ in (own for one in sets for name in one.numbers for own in name.where):
        values.setdefault(axis, set()).add(value)
    same: dict[str, dict[float, float]] = {}
    for axis, known in values.items():
        given = sorted(known)
        one = merge_values(COLUMNS.get(axis, axis), given).values
        same[axis] = {own: own if mean is None else mean for own, mean in zip(given, one, strict=True)}
    return [own._replace(numbers={_at(name, same): number for name, number in own.numbers.items()}) for own in sets]


def _at(name: Name, same: Mapping[str, Mapping[float, float]]) -> Name:
    """A name at the values that its conditions have in all sets."""
    return name._replace(where=tuple((axis, same[axis][value], unit) for axis, value, unit in name.where))


def sources_of(folders: Sequence[Path]) -> list[Path]:
    """Every file that `read_sets` takes."""
    return [path for folder in folders for path in files_in(folder)]
