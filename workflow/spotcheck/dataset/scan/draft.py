"""Draft of the manifest and of the known keys of instrument.yaml for a folder of images.

A condition is a combination of kind, angle, exposure time, position and light; frames of one condition are repeats.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from spotcheck.dataset.manifest import DATE, KINDS, PHOTONS, REQUIRED_COLUMNS
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.dataset.scan.answers import find_schema_violation, resolve_frame
from spotcheck.dataset.scan.folder_scan import FolderScan, ScannedFrame

# Column of the position along the beam, which is declared as an axis of the experiment if it has more than one value.
POSITION = "z_m"
# Columns that metadata may fill, in the order of the manifest.
METADATA_COLUMNS = ("kind", "angle_deg", "exposure_s", "repeat", POSITION, PHOTONS, DATE)
# Columns that define a condition; repeats are counted within one.
CONDITION_COLUMNS = ("kind", "angle_deg", "exposure_s", POSITION, PHOTONS)
# Sources of kinds and of repeats that no file gives.
ASSUMED, COUNTED = "assumed: nothing says dark or flat", "counted within each condition"

# Metadata of a frame by column or key, without conflicting entries.
FrameMetadata = Mapping[str, MetadataEntry]


class Conflict(NamedTuple):
    """Two sources that disagree about a column."""

    column: str  # column or key
    first: MetadataEntry  # entry of the first source in one of the frames
    second: MetadataEntry  # contradicting entry in the same frame
    frames: int  # number of frames in which the two sources disagree


class UnusedMetadata(NamedTuple):
    """Metadata that the draft does not use; entries that differ only in their numbers are counted as one."""

    column: str | None  # column whose unit is missing; None for metadata that was not understood
    text: str  # text of the first such entry
    source: str  # its source
    frames: int  # number of frames with such an entry
    question: str  # question that a text with several readings leaves open; "" for other texts
    lacks_unit: bool  # whether nothing but the unit of its number is missing


@dataclass(frozen=True)
class ManifestDraft:
    """A draft of the manifest, and of the keys of instrument.yaml that the files give."""

    frames: tuple[ScannedFrame, ...]  # in the order of the rows
    columns: tuple[str, ...]  # columns of the manifest
    rows: tuple[dict[str, str], ...]  # cells of each frame, by column
    provenance: dict[str, Counter[tuple[str, str]]]  # number of frames by (source, its first text), for each column
    instrument_keys: dict[str, MetadataEntry]  # keys of instrument.yaml on which all frames agree
    conditions: tuple[str, ...]  # columns that instrument.yaml declares as axes of the experiment
    is_order_known: bool  # whether the rows are in the order of acquisition
    conflicts: tuple[Conflict, ...]  # columns left blank in some frames because sources disagree
    missing: dict[str, tuple[str, ...]]  # files of the frames without a value, by column
    unused: tuple[UnusedMetadata, ...]  # remaining metadata, the most frequent first
    unclear_frames: dict[str, int]  # number of frames with remaining metadata, by column

    @property
    def has_spots(self) -> bool:
        """Whether there are frames of spots."""
        return any(row["kind"] == "spot" for row in self.rows)


def draft_manifest(scan: FolderScan, answers: Mapping[str, str]) -> ManifestDraft:
    """Return the draft of a manifest for the frames of a folder.

    Parameters
    ----------
    scan : frames and metadata of the folder; at least one frame.
    answers : the user's answers by column or key; see `answers.check_answers`.
    """
    # Metadata and conflicts of each frame, in the order of the scan.
    resolved_frames = [resolve_frame(frame, answers) for frame in scan.frames]
    order, is_order_known = _order_frames(scan.frames, [agreed for agreed, _ in resolved_frames])
    frames = tuple(scan.frames[index] for index in order)
    metadata = [_drop_meaningless(resolved_frames[index][0]) for index in order]
    rows = [_draft_row(frame, entries) for frame, entries in zip(frames, metadata, strict=True)]
    repeats, repeat_column = _number_repeats(rows, metadata)
    for row, repeat in zip(rows, repeats, strict=True):
        row["repeat"] = str(repeat)
    available_columns = {column for entries in metadata for column in entries}
    # A date in some frames only is of no use.
    if not all(DATE in entries for entries in metadata):
        available_columns.discard(DATE)
    missing = {column: _find_missing(column, rows) for column in ("exposure_s", "angle_deg", POSITION)}
    positions = {row[POSITION] for row in rows if row["kind"] == "spot"}
    return ManifestDraft(
        frames=frames,
        columns=(
            *REQUIRED_COLUMNS,
            *(["page"] if any(frame.page for frame in frames) else []),
            *(column for column in METADATA_COLUMNS if column in available_columns - set(REQUIRED_COLUMNS)),
        ),
        rows=tuple(rows),
        provenance=_collect_provenance(metadata, repeat_column),
        instrument_keys=_collect_instrument_keys(frames, metadata),
        conditions=(POSITION,) if len(positions) > 1 and not missing[POSITION] else (),
        is_order_known=is_order_known,
        conflicts=_collect_conflicts(conflicts for _, conflicts in resolved_frames),
        missing=missing,
        unused=_collect_unused(frames, metadata),
        unclear_frames=_count_unclear_frames(frames, metadata),
    )


def _order_frames(frames: Sequence[ScannedFrame], metadata: Sequence[FrameMetadata]) -> tuple[list[int], bool]:
    """Return the indices of the frames in the order of the rows, and whether that is the order of acquisition.

    The order of acquisition is that of the times, of a unique running number, or of the pages of a single stack. If it
    is not known, the frames keep their order.
    """
    indices = list(range(len(frames)))
    # ISO 8601 with a time has a T, and sorts as text.
    dates = [str(entries[DATE].value) if DATE in entries else "" for entries in metadata]
    # Cameras may write the time of a whole series into all its frames.
    if all("T" in date for date in dates) and len(set(dates)) > len(dates) / 2:
        return sorted(indices, key=lambda index: dates[index]), True
    numbers = _collect_integers("number", metadata)
    if len(numbers) == len(frames) == len(set(numbers)):
        return sorted(indices, key=lambda index: numbers[index]), True
    return indices, len({frame.file for frame in frames}) == 1


def _collect_integers(column: str, metadata: Sequence[FrameMetadata]) -> list[int]:
    """Return the integer values of a column, in the order of the frames; frames without one are skipped."""
    values = (entries[column].value for entries in metadata if column in entries)
    return [value for value in values if isinstance(value, int)]


def _drop_meaningless(entries: dict[str, MetadataEntry]) -> dict[str, MetadataEntry]:
    """Return the metadata without the angle of a dark or flat, and without an exposure time of zero of a spot."""
    meaningful = dict(entries)
    if "kind" in meaningful and meaningful["kind"].value != "spot":
        meaningful.pop("angle_deg", None)
    elif "exposure_s" in meaningful and not meaningful["exposure_s"].value:
        del meaningful["exposure_s"]
    return meaningful


def _draft_row(frame: ScannedFrame, entries: FrameMetadata) -> dict[str, str]:
    """Return the cells of a frame by column: "" if unknown, the kind spot if no kind is known.

    Numbers are written in the shortest form that reads back as the same value.
    """
    row = {column: str(entries[column].value) if column in entries else "" for column in METADATA_COLUMNS}
    return row | {"kind": row["kind"] or "spot", "file": frame.file, "page": str(frame.page)}


def _find_missing(column: str, rows: Sequence[Mapping[str, str]]) -> tuple[str, ...]:
    """Return the files of the frames without a value: of all kinds for the exposure time, only of spots otherwise."""
    kinds = KINDS if column == "exposure_s" else ("spot",)
    return tuple(row["file"] for row in rows if row[column] == "" and row["kind"] in kinds)


def _number_repeats(
    rows: Sequence[Mapping[str, str]], metadata: Sequence[FrameMetadata]
) -> tuple[list[int], str | None]:
    """Return the repeat of each frame within its condition, and the column of metadata that gives it.

    The column is "repeat", or "number" for the number at the end of file names. It is None if neither is unique within
    each condition; the frames of a condition are then counted from 0.
    """
    # Indices of the frames of each condition.
    groups: dict[tuple[str, ...], list[int]] = {}
    for index, row in enumerate(rows):
        groups.setdefault(tuple(row[column] for column in CONDITION_COLUMNS), []).append(index)
    largest_group = max(map(len, groups.values()))
    for column in ("repeat", "number"):
        numbers = _collect_integers(column, metadata)
        is_unique = len(numbers) == len(rows) and all(
            len({numbers[index] for index in group}) == len(group) for group in groups.values()
        )
        # A running number gives the repeat only if it starts anew in each condition.
        if is_unique and (column == "repeat" or len(set(numbers)) <= largest_group):
            first = 0 if column == "repeat" else min(numbers)
            return [number - first for number in numbers], column
    repeat_of = {index: repeat for group in groups.values() for repeat, index in enumerate(group)}
    return [repeat_of[index] for index in range(len(rows))], None


def _collect_provenance(
    metadata: Sequence[FrameMetadata], repeat_column: str | None
) -> dict[str, Counter[tuple[str, str]]]:
    """Return for each column the number of frames by source, with the first text that was read from that source.

    A source has the form that is common to all frames (`MetadataEntry.source_pattern`): the sidecar files of all frames
    are one source.

    Parameters
    ----------
    metadata : metadata of each frame, by column.
    repeat_column : column of metadata that gives the repeats, "repeat" or "number"; None if frames are counted.

    Returns
    -------
    dict
        By column, the number of frames by (source, text); frames without a value of the column do not count.
    """
    # Entries of a frame whose metadata give no kind, and of frames whose repeats are counted.
    defaults = {"kind": MetadataEntry("kind", "spot", "", ASSUMED), "repeat": MetadataEntry("repeat", 0, "", COUNTED)}
    first_texts: dict[tuple[str, str], str] = {}
    provenance: dict[str, Counter[tuple[str, str]]] = {}
    for entries in metadata:
        entry_of = defaults | {column: entry for column, entry in entries.items() if column not in ("repeat", "number")}
        # The repeats of all frames come from one column, even if a frame has both.
        if repeat_column:
            entry_of["repeat"] = entries[repeat_column]
        for column, entry in entry_of.items():
            text = first_texts.setdefault((column, entry.source_pattern), entry.text)
            provenance.setdefault(column, Counter())[entry.source_pattern, text] += 1
    return provenance


def _collect_instrument_keys(
    frames: Sequence[ScannedFrame], metadata: Sequence[FrameMetadata]
) -> dict[str, MetadataEntry]:
    """Return the valid keys of instrument.yaml on whose value all frames that have them agree, with the first entry."""
    container_bits = min(frame.bits for frame in frames)
    keys: dict[str, MetadataEntry] = {}
    for key in sorted({column for entries in metadata for column in entries if "." in column}):
        candidates = [entries[key] for entries in metadata if key in entries]
        value = candidates[0].value
        is_too_deep = key == "sensor.bit_depth" and isinstance(value, int) and value > container_bits
        is_unanimous = len({entry.value for entry in candidates}) == 1
        if is_unanimous and not is_too_deep and not find_schema_violation(key, value):
            keys[key] = candidates[0]
    return keys


def _collect_conflicts(
    conflicts_by_frame: Iterable[Mapping[str, tuple[MetadataEntry, MetadataEntry]]],
) -> tuple[Conflict, ...]:
    """Return one conflict for each column and pair of sources, with the number of frames that have it.

    `conflicts_by_frame` has for each frame, by column, two entries that contradict each other. Sources are the same if
    their form that is common to all frames is (`MetadataEntry.source_pattern`).
    """
    conflict_of: dict[tuple[str, str, str], Conflict] = {}
    for conflicts in conflicts_by_frame:
        for column, (first, second) in conflicts.items():
            key = column, first.source_pattern, second.source_pattern
            earlier = conflict_of.get(key, Conflict(column, first, second, 0))
            conflict_of[key] = earlier._replace(frames=earlier.frames + 1)
    return tuple(conflict_of.values())


def _collect_unused(frames: Sequence[ScannedFrame], metadata: Sequence[FrameMetadata]) -> tuple[UnusedMetadata, ...]:
    """Return the metadata without a column or unit that the rows do not use, the most frequent first.

    `metadata` is that of the rows, while `frames` have the entries of all sources.
    """
    unused_of: dict[tuple[str, str], UnusedMetadata] = {}
    for frame, entries in zip(frames, metadata, strict=True):
        for entry in _select_unused(frame, entries):
            # Texts that differ only in their numbers have the same key.
            key = re.sub(r"\d+", "0", entry.text), entry.source_pattern
            new = UnusedMetadata(entry.column, entry.text, entry.source_pattern, 0, entry.question, bool(entry.number))
            first = unused_of.get(key, new)
            unused_of[key] = first._replace(frames=first.frames + 1)
    return tuple(sorted(unused_of.values(), key=lambda unused: -unused.frames))


def _count_unclear_frames(frames: Sequence[ScannedFrame], metadata: Sequence[FrameMetadata]) -> dict[str, int]:
    """Return the number of frames with unused metadata of each column; arguments are those of `_collect_unused`."""
    return Counter(
        column
        for frame, entries in zip(frames, metadata, strict=True)
        for column in {entry.column for entry in _select_unused(frame, entries) if entry.column}
    )


def _select_unused(frame: ScannedFrame, entries: FrameMetadata) -> list[MetadataEntry]:
    """Return the entries of a frame without a value whose column is unknown, or not among `entries`."""
    return [entry for entry in frame.metadata if entry.value is None and entry.column not in entries]
