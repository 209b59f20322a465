"""From what is settled of each frame to the rows of a manifest and the keys of a data sheet."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from spotcheck.dataset.labels.label import Label
from spotcheck.dataset.manifest import DATE, PHOTONS, REQUIRED_COLUMNS
from spotcheck.dataset.survey.scan import Scan, Settled, Shot, breach_of_key, contradiction, settle, source

# Columns that a label may fill, in the order of the manifest.
LABELLED = ("kind", "angle_deg", "exposure_s", "repeat", "z_m", PHOTONS, DATE)
# The position along the beam: a condition wherever it takes more than one value.
POSITION = "z_m"
ASSUMED, COUNTED = "assumed: nothing says dark or flat", "counted within each condition"


class Said(NamedTuple):
    """What files say and nothing takes up: the column that it was meant for (its number lacks a unit; None where it is
    not understood), text and source of the first, and how many frames say the like."""

    column: str | None
    text: str
    where: str
    frames: int


class Rows(NamedTuple):
    """A manifest in the making.

    `cells` are the texts of each row by column, in the order of `shots`; `origin` says of each column how many of its
    values come from which source, with an example; `keys` are those of instrument.yaml on which all frames agree;
    `contradictions` and `missing` (frames without a value, by column) are what is left to the user, and `also` is what
    else the files say: columns, text and source of the first of those that differ only in their numbers.
    """

    shots: tuple[Shot, ...]
    columns: tuple[str, ...]
    cells: tuple[dict[str, str], ...]
    origin: dict[str, Counter[tuple[str, str]]]
    keys: dict[str, Label]
    conditions: tuple[str, ...]
    order_known: bool
    contradictions: tuple[str, ...]
    missing: dict[str, tuple[str, ...]]
    also: tuple[Said, ...]

    @property
    def spots(self) -> bool:
        """Whether there are frames of spots."""
        return any(cell["kind"] == "spot" for cell in self.cells)


def rows_of(scan: Scan, given: Mapping[str, str]) -> Rows:
    """Rows of all frames of a folder, with the answers of a user by column or key (see `settle`)."""
    settled = [settle(shot, given) for shot in scan.shots]
    order, known = _ordered(scan.shots, settled)
    shots, found = tuple(scan.shots[k] for k in order), [settled[k].labels for k in order]
    kinds = [str(own["kind"].value) if "kind" in own else "spot" for own in found]
    for kind, own in zip(kinds, found, strict=True):
        if kind != "spot":
            own.pop("angle_deg", None)
        elif "exposure_s" in own and not own["exposure_s"].value:
            del own["exposure_s"]
    cells = [
        {name: _written(own.get(name)) for name in LABELLED} | {"kind": kind, "file": shot.file, "page": str(shot.page)}
        for shot, own, kind in zip(shots, found, kinds, strict=True)
    ]
    taken = {name for name in LABELLED if any(name in own for own in found)}
    repeats, repeats_from = _repeats(cells, found)
    for cell, repeat in zip(cells, repeats, strict=True):
        cell["repeat"] = str(repeat)
    extra = [name for name in LABELLED if name not in REQUIRED_COLUMNS and name in taken]
    if DATE in extra and not all(DATE in own for own in found):
        extra.remove(DATE)
    missing = {name: _without(name, shots, cells) for name in ("exposure_s", "angle_deg", POSITION)}
    positions = {cell[POSITION] for cell in cells if cell["kind"] == "spot"}
    return Rows(
        shots=shots,
        columns=(*REQUIRED_COLUMNS, *(["page"] if any(shot.page for shot in shots) else []), *extra),
        cells=tuple(cells),
        origin=_origin(found, repeats_from),
        keys=_keys(shots, found),
        conditions=(POSITION,) if len(positions) > 1 and not missing[POSITION] else (),
        order_known=known,
        contradictions=_contradictions(settled),
        missing=missing,
        also=_also(shots, found),
    )


def _written(label: Label | None) -> str:
    """A value as the manifest has it: the shortest number that reads back as the same."""
    return "" if label is None else repr(label.value) if isinstance(label.value, float) else str(label.value)


def _ordered(shots: Sequence[Shot], settled: Sequence[Settled]) -> tuple[list[int], bool]:
    """The order of the rows, and whether it is that of acquisition: by times, by one running number, by the pages of a
    single stack; else by name, of which nobody knows."""
    every = list(range(len(shots)))
    dates = [str(own.labels[DATE].value) if DATE in own.labels else "" for own in settled]
    if all("T" in date for date in dates) and len(set(dates)) > len(dates) / 2:
        return sorted(every, key=lambda k: dates[k]), True
    numbers = [own.labels["number"].value if "number" in own.labels else None for own in settled]
    counted = [number for number in numbers if isinstance(number, int)]
    if len(counted) == len(shots) == len(set(counted)):
        return sorted(every, key=lambda k: counted[k]), True
    return every, len({shot.file for shot in shots}) == 1


def _without(column: str, shots: Sequence[Shot], cells: Sequence[Mapping[str, str]]) -> tuple[str, ...]:
    """Files of the frames without a value in a column: of all kinds for an exposure, of spots for the others."""
    return tuple(
        shot.file
        for shot, cell in zip(shots, cells, strict=True)
        if cell[column] == "" and (column == "exposure_s" or cell["kind"] == "spot")
    )


def _condition(cell: Mapping[str, str]) -> tuple[str, ...]:
    """What a repeat is counted within."""
    return tuple(cell[name] for name in ("kind", "angle_deg", "exposure_s", POSITION, PHOTONS))


def _repeats(cells: Sequence[Mapping[str, str]], found: Sequence[Mapping[str, Label]]) -> tuple[list[int], str | None]:
    """The repeat of each frame, and the column that it is from: what its files say, where that tells all frames of a
    condition apart; else counted, from none.

    A running number says so where it starts anew in each condition, not where it runs on through all of them.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for k, cell in enumerate(cells):
        groups.setdefault(_condition(cell), []).append(k)
    for name in ("repeat", "number"):
        own = [labels[name].value if name in labels else None for labels in found]
        told = [value for value in own if isinstance(value, int)]
        apart = len(told) == len(own) and all(len({own[k] for k in group}) == len(group) for group in groups.values())
        if apart and (name == "repeat" or len(set(told)) <= max(map(len, groups.values()))):
            first = 0 if name == "repeat" else min(told)
            return [value - first for value in told], name
    place = {k: number for group in groups.values() for number, k in enumerate(group)}
    return [place[k] for k in range(len(cells))], None


def _origin(found: Sequence[Mapping[str, Label]], repeats_from: str | None) -> dict[str, Counter[tuple[str, str]]]:
    """Of each column how many values come from where, with the text of the first."""
    first: dict[tuple[str, str], str] = {}
    out: dict[str, Counter[tuple[str, str]]] = {}
    for own in found:
        taken = {column: label for column, label in own.items() if column not in ("repeat", "number")}
        taken = {"kind": Label("kind", "spot", "", ASSUMED), **taken}
        taken["repeat"] = own[repeats_from] if repeats_from else Label("repeat", 0, "", COUNTED)
        for column, label in taken.items():
            text = first.setdefault((column, source(label)), label.text)
            out.setdefault(column, Counter())[source(label), text] += 1
    return out


def _keys(shots: Sequence[Shot], found: Sequence[Mapping[str, Label]]) -> dict[str, Label]:
    """Keys of instrument.yaml that every frame which speaks of them gives the same value, one that can be."""
    held = min(shot.bits for shot in shots)
    out: dict[str, Label] = {}
    for column in sorted({column for own in found for column in own if "." in column}):
        own = [labels[column] for labels in found if column in labels]
        value = own[0].value
        deep = column == "sensor.bit_depth" and isinstance(value, int) and value > held
        if len({label.value for label in own}) == 1 and not deep and not breach_of_key(column, value):
            out[column] = own[0]
    return out


def _contradictions(settled: Sequence[Settled]) -> tuple[str, ...]:
    """A sentence for each pair of sources that contradict each other in a column."""
    seen: dict[tuple[str, str, str], tuple[tuple[Label, Label], int]] = {}
    for own in settled:
        for column, pair in own.against.items():
            key = column, source(pair[0]), source(pair[1])
            seen[key] = seen[key][0] if key in seen else pair, seen[key][1] + 1 if key in seen else 1
    return tuple(contradiction(column, pair, count) for (column, _, _), (pair, count) in seen.items())


def _also(shots: Sequence[Shot], found: Sequence[Mapping[str, Label]]) -> tuple[Said, ...]:
    """What else the files say, and what has no unit; texts that differ in their numbers alone are one."""
    out: dict[tuple[str, str], Said] = {}
    for shot, own in zip(shots, found, strict=True):
        for label in shot.labels:
            if label.value is None and (label.column is None or label.column not in own):
                key = re.sub(r"\d+", "0", label.text), source(label)
                first = out.get(key, Said(label.column, label.text, key[1], 0))
                out[key] = first._replace(frames=first.frames + 1)
    return tuple(sorted(out.values(), key=lambda said: -said.frames))
