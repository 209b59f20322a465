"""Summary of a folder scan and its draft for a terminal: a table and messages."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence

from spotcheck.dataset.manifest import parse_number
from spotcheck.dataset.metadata.entry import BINNING, PITCH
from spotcheck.dataset.metadata.units import UNDECIDABLE_SEPARATOR
from spotcheck.dataset.scan.answers import get_column_dimension
from spotcheck.dataset.scan.draft import METADATA_COLUMNS, Conflict, ManifestDraft, UnusedMetadata
from spotcheck.dataset.scan.folder_scan import FolderScan
from spotcheck.io.number_text import count_text
from spotcheck.io.text import replace_unprintable

# Most different values that a line lists, and most examples of a longer list.
MOST_VALUES, MOST_EXAMPLES = 6, 5
# What an unclear binning means for the pixel pitch.
PITCH_LEFT_BLANK = f"{PITCH} is left blank: give the pitch of the frames by --set {PITCH}=6.9um"


def summarize_scan(name: str, scan: FolderScan, draft: ManifestDraft) -> Iterator[str]:
    """Yield lines on the frames of a folder, the values and sources of each column, and unused files and metadata.

    Parameters
    ----------
    name : name of the folder.
    scan : frames and metadata of the folder.
    draft : draft of its manifest.
    """
    file_count = len({frame.file for frame in draft.frames})
    # Number of frames by size and bit depth.
    formats = Counter((frame.shape, frame.bits) for frame in draft.frames)
    yield f"{name}: {len(draft.frames)} frames in {count_text(file_count, 'file')}, " + ", ".join(
        f"{shape[1]} × {shape[0]} px of {bits} bit{f' ({count})' if len(formats) > 1 else ''}"
        for (shape, bits), count in formats.most_common(MOST_EXAMPLES)
    )
    if len(formats) > 1:
        yield "All frames of a dataset must have one size and depth: move the others out of the folder."
    yield ""
    yield from _format_table(draft)
    yield ""
    yield from map(_format_conflict, draft.conflicts)
    yield from _list_gaps(draft)
    yield from scan.errors
    yield from map(replace_unprintable, scan.table_remarks)
    if scan.unread_files:
        yield f"Not read: {_join_examples(scan.unread_files)}"
    if unknown_texts := [_format_unused(unused) for unused in draft.unused if unused.column is None]:
        yield f"Not understood: {_join_examples(unknown_texts)}"


def _format_table(draft: ManifestDraft) -> Iterator[str]:
    """Yield the lines of a table with values, sources and doubts of each column and key, after a line of headings."""
    doubts = _collect_doubts(draft)
    lines = [("column", "values", "from")]
    for column in METADATA_COLUMNS:
        is_listed = column in draft.columns or column in draft.provenance or column in doubts
        # Only spots have an angle.
        if is_listed and (column != "angle_deg" or draft.has_spots):
            values = _summarize_values([row[column] for row in draft.rows if row[column] != ""])
            lines.append((column, values, "; ".join([*_format_sources(column, draft), *doubts.pop(column, ())])))
    for key, entry in draft.instrument_keys.items():
        value = f"{entry.value:g}" if isinstance(entry.value, float) else str(entry.value)
        lines.append((key, value, "; ".join([f"{entry.source} ({entry.text})", *doubts.pop(key, ())])))
    for key, texts in doubts.items():
        lines.append((key, "left blank", "; ".join([*_format_sources(key, draft), *texts])))
    widths = [max(len(line[column]) for line in lines) for column in (0, 1)]
    for name, values, source in lines:
        yield f"  {name:{widths[0]}}  {values:{widths[1]}}  {source}".rstrip()


def _collect_doubts(draft: ManifestDraft) -> dict[str, list[str]]:
    """Return why values of a column or key are left blank in some frames, by column or key."""
    doubts: dict[str, list[str]] = {}
    for conflict in draft.conflicts:
        doubts.setdefault(conflict.column, []).append(f"contradictory in {count_text(conflict.frames, 'frame')}")
    for column, frames in draft.unclear_frames.items():
        doubts.setdefault(column, []).append(f"unclear in {count_text(frames, 'frame')}")
    for key in draft.provenance:
        if "." in key and key not in draft.instrument_keys:
            doubts.setdefault(key, []).append("differs between frames or is out of range")
    if PITCH in draft.instrument_keys:
        # The binning matters to nothing else.
        doubts.pop(BINNING, None)
    return doubts


def _format_sources(column: str, draft: ManifestDraft) -> list[str]:
    """Return the sources of a column or key, the most frequent first, each with the text of its first value."""
    sources = draft.provenance.get(column, Counter()).most_common(MOST_EXAMPLES)
    # The text of a value that was assumed is "".
    return [
        f"{source} ({example}{', …' if count > 1 else ''})" if example else source
        for (source, example), count in sources
    ]


def _summarize_values(values: Sequence[str]) -> str:
    """Return the values of a column (numbers, or words with their counts) if they are few, else number and range."""
    counts = Counter(values)
    if not counts:
        return "not found"
    numbers = sorted({number for value in counts if (number := parse_number(value)) is not None})
    if len(numbers) == len(counts):
        if len(numbers) <= MOST_VALUES:
            return ", ".join(f"{number:g}" for number in numbers)
        return f"{len(numbers)} values from {numbers[0]:g} to {numbers[-1]:g}"
    if len(counts) <= MOST_VALUES:
        return ", ".join(f"{count} {value}" for value, count in counts.items())
    return f"{len(counts)} values from {min(counts)} to {max(counts)}"


def _format_conflict(conflict: Conflict) -> str:
    """Return the message on two sources that disagree, with the answers that resolve it."""
    column, first, second, frames = conflict
    disagreement = f"{column}: {first}, but {second}{f' ({frames} frames)' if frames > 1 else ''}"
    if column == BINNING:
        return f"{disagreement}; {PITCH_LEFT_BLANK}"
    if first.source_pattern == second.source_pattern:
        return (
            f"{disagreement}; left blank: correct it there, with one row for each image by its folder and name or for"
            f" each page of a stack, or give the value of all frames by --set {column}=VALUE"
        )
    return (
        f"{disagreement}; left blank: say which is right"
        f' by --set "{column}={first.source_pattern}" or --set "{column}={second.source_pattern}"'
    )


def _list_gaps(draft: ManifestDraft) -> Iterator[str]:
    """Yield messages on columns that only some frames have, and on numbers without a unit."""
    for column, files in draft.missing.items():
        if files and len(files) < len(draft.rows) and any(row[column] for row in draft.rows):
            yield f"{column}: not found for {len(files)} of {len(draft.rows)} frames ({_join_examples(files)})"
    for unused in _merge_undecidable(draft.unused):
        if unused.column == BINNING:
            if PITCH in draft.instrument_keys:
                continue
            yield f"{_format_unused(unused)}: rows and columns are binned differently; {PITCH_LEFT_BLANK}"
        elif unused.column and UNDECIDABLE_SEPARATOR in unused.text:
            text = _format_unused(unused).replace(f" {UNDECIDABLE_SEPARATOR}", "")
            cause = "commas or points may separate thousands or decimals; write the column without them"
            yield f"{unused.column}: {text}: {cause}"
        elif unused.question:
            place = (
                f"column {unused.column} of manifest.csv" if unused.column in METADATA_COLUMNS else "instrument.yaml"
            )
            yield (
                f"{unused.column}: {_format_unused(unused)}: {unused.question} Left blank; write the value into"
                f" {place}, or change the text so that it has one meaning"
            )
        elif unused.column and not unused.lacks_unit:
            yield f"{unused.column}: {_format_unused(unused)} is no value with a unit that is known"
        elif unused.column:
            dimension = get_column_dimension(unused.column) if unused.column in METADATA_COLUMNS else None
            example_unit = {"s": "ms", "m": "mm"}.get(dimension or "")
            advice = f"; give it by --set {unused.column}={example_unit}" if example_unit else ""
            yield f"{unused.column}: {_format_unused(unused)} has no unit that is known{advice}"


def _merge_undecidable(unused: Sequence[UnusedMetadata]) -> list[UnusedMetadata]:
    """Return unused metadata with the cells of a column of undecidable separators as one.

    Its text is that of a cell with such a separator, if there is one.
    """
    merged: dict[tuple[str | None, str, str], UnusedMetadata] = {}
    for record in unused:
        is_undecidable = UNDECIDABLE_SEPARATOR in record.text
        key = record.column, record.source, "" if is_undecidable else record.text
        first = merged.get(key, record)
        frames = first.frames + (0 if first is record else record.frames)
        has_separator = re.search(r"\d[.,]\d", first.text) is not None
        merged[key] = (first if has_separator else record)._replace(frames=frames)
    return list(merged.values())


def _format_unused(unused: UnusedMetadata) -> str:
    """Return the text and source of unused metadata, and the number of other frames with such an entry."""
    return f"{unused.text} ({unused.source}{f', and {unused.frames - 1} like it' if unused.frames > 1 else ''})"


def _join_examples(texts: Sequence[str]) -> str:
    """Return the first `MOST_EXAMPLES` texts, separated by commas, and the number of the others."""
    more = f" and {len(texts) - MOST_EXAMPLES} more" if len(texts) > MOST_EXAMPLES else ""
    return ", ".join(texts[:MOST_EXAMPLES]) + more
