"""The measurement plan: the rows of `manifest.csv`, and the sites that they look at."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from rig.errors import RigError

KINDS = ("spot", "dark", "flat")
SUFFIXES = (".tif", ".tiff", ".png", ".pgm")
_KNOWN = ("file", "kind", "angle_deg", "exposure_s", "repeat")


@dataclass(frozen=True)
class Shot:
    """One planned frame. `index` is its row from 0; a blank angle or exposure is None (not recorded)."""

    index: int
    file: str
    kind: str
    angle_deg: float | None
    exposure_s: float | None
    repeat: str
    others: dict[str, str] = field(default_factory=dict)

    def other(self, column: str) -> float | None:
        """A further column as a number, None when it is missing or blank."""
        text = self.others.get(column, "")
        return _number(text, f"row {self.index + 1}, {column}") if text else None


@dataclass(frozen=True)
class Site:
    """All frames that look at the same point: equal but for the exposure. `index` counts first appearances."""

    index: int
    shots: tuple[Shot, ...]


def read_plan(folder: Path) -> list[Shot]:
    """The rows of `folder/manifest.csv`; the frames themselves need not exist yet."""
    path = folder / "manifest.csv"
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            columns = reader.fieldnames or []
            missing = [name for name in ("file", "kind") if name not in columns]
            if missing:
                raise RigError(f"{path}: column {missing[0]} is missing")
            shots = [_shot(row, index, path) for index, row in enumerate(reader)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RigError(f"{path}: cannot be read ({error})") from error
    if not shots:
        raise RigError(f"{path}: plans no frame")
    seen: dict[str, int] = {}
    for shot in shots:
        if shot.file in seen:
            raise RigError(f"{path}: rows {seen[shot.file] + 1} and {shot.index + 1} both write {shot.file}")
        seen[shot.file] = shot.index
    return shots


def sites(shots: list[Shot]) -> list[Site]:
    """The plan's sites in the order of their first frame."""
    groups: dict[tuple, list[Shot]] = {}
    for shot in shots:
        # Only a condition that moves the camera makes another site; a time stamp, say, does not.
        key = (shot.kind, shot.angle_deg, shot.repeat, shot.others.get("z_m", ""))
        groups.setdefault(key, []).append(shot)
    return [Site(index, tuple(group)) for index, group in enumerate(groups.values())]


def _shot(row: dict[str, str], index: int, path: Path) -> Shot:
    where = f"{path}: row {index + 1}"
    cells = {key: (value or "").strip() for key, value in row.items() if key is not None}
    file, kind = cells["file"], cells["kind"]
    parts = PurePosixPath(file)
    if not file or parts.is_absolute() or ".." in parts.parts:
        raise RigError(f"{where}: file {file!r} must lie inside the dataset folder")
    if parts.suffix.lower() not in SUFFIXES:
        raise RigError(f"{where}: {file!r} must end in one of {', '.join(SUFFIXES)}")
    if kind not in KINDS:
        raise RigError(f"{where}: kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if cells.get("page"):
        raise RigError(f"{where}: the rig writes one frame a file; leave page blank")
    exposure = _optional(cells.get("exposure_s", ""), f"{where}, exposure_s")
    if exposure is not None and exposure < 0:
        raise RigError(f"{where}: exposure_s must not be negative")
    others = {key: value for key, value in cells.items() if key not in _KNOWN and value}
    angle = _optional(cells.get("angle_deg", ""), f"{where}, angle_deg")
    return Shot(index, file, kind, angle, exposure, cells.get("repeat", ""), others)


def _optional(text: str, where: str) -> float | None:
    return _number(text, where) if text else None


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise RigError(f"{where}: {text!r} is not a number") from None
    if not math.isfinite(value):
        raise RigError(f"{where}: {text!r} is not finite")
    return value
