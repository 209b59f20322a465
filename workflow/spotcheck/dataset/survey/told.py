"""What a survey found, as a table and sentences for a terminal."""

from collections import Counter
from collections.abc import Iterator, Sequence

from spotcheck.dataset.labels.label import Label
from spotcheck.dataset.manifest import number_in
from spotcheck.dataset.survey.rows import LABELLED, Rows, Said
from spotcheck.dataset.survey.scan import Scan, kind_of

# Different values that a line lists, and examples of a longer list.
MOST_VALUES, MOST_EXAMPLES = 6, 5


def told(name: str, scan: Scan, rows: Rows) -> Iterator[str]:
    """Lines on a folder of that name: what it holds, each column with where it comes from, and what is not read."""
    files = len({shot.file for shot in rows.shots})
    sizes = Counter((shot.shape, shot.bits) for shot in rows.shots)
    yield f"{name}: {len(rows.shots)} frames in {files} file{'s' if files > 1 else ''}, " + ", ".join(
        f"{shape[1]} × {shape[0]} px of {bits} bit{f' ({count})' if len(sizes) > 1 else ''}"
        for (shape, bits), count in sizes.most_common(MOST_EXAMPLES)
    )
    if len(sizes) > 1:
        yield "All frames of a dataset must have one size and depth: move the others out of the folder."
    yield ""
    yield from _table(rows)
    yield ""
    yield from rows.contradictions
    yield from _gaps(rows)
    yield from scan.broken
    if scan.others:
        yield f"Not read: {_some(scan.others)}"
    if said := [_also(own) for own in rows.also if own.column is None]:
        yield f"Said, but not understood: {_some(said)}"


def _gaps(rows: Rows) -> Iterator[str]:
    """Sentences on columns that some frames have and others lack, and on numbers without a unit."""
    for column, files in rows.missing.items():
        if files and len(files) < len(rows.cells) and any(cell[column] for cell in rows.cells):
            yield f"{column}: not found for {len(files)} of {len(rows.cells)} frames ({_some(files)})"
    for own in rows.also:
        if own.column:
            example = {"s": "ms", "m": "mm"}.get(kind_of(own.column) or "", "")
            right = f"; give it by --set {own.column}={example}" if example and own.column in LABELLED else ""
            yield f"{own.column}: {_also(own)} has no unit that is known{right}"


def _also(said: Said) -> str:
    return f"{said.text} ({said.where}{f', and {said.frames - 1} like it' if said.frames > 1 else ''})"


def _table(rows: Rows) -> Iterator[str]:
    lines = [("column", "values", "from")]
    for column in LABELLED:
        if column == "angle_deg" and not rows.spots:
            continue
        if column in rows.columns or column in rows.origin:
            values = [cell[column] for cell in rows.cells if cell[column] != ""]
            lines.append((column, values_of(values), _from(rows.origin.get(column, Counter()))))
    for key, label in rows.keys.items():
        lines.append((key, _shown(label), f"{label.where} ({label.text})"))
    wide = [max(len(line[k]) for line in lines) for k in (0, 1)]
    for line in lines:
        yield f"  {line[0]:{wide[0]}}  {line[1]:{wide[1]}}  {line[2]}".rstrip()


def values_of(values: Sequence[str]) -> str:
    """The values of a column in a few words: all of them where they are few, else how many and from where to where."""
    counts = Counter(values)
    if not counts:
        return "not found"
    numbers = sorted({number for value in counts if (number := number_in(value)) is not None})
    if len(numbers) == len(counts):
        if len(numbers) <= MOST_VALUES:
            return ", ".join(f"{number:g}" for number in numbers)
        return f"{len(numbers)} values from {numbers[0]:g} to {numbers[-1]:g}"
    if len(counts) <= MOST_VALUES:
        return ", ".join(f"{count} {value}" for value, count in counts.items())
    return f"{len(counts)} values from {min(counts)} to {max(counts)}"


def _from(origin: Counter[tuple[str, str]]) -> str:
    said = [
        f"{where}{f' ({text}' + (', …' if count > 1 else '') + ')' if text else ''}"
        for (where, text), count in origin.most_common(MOST_EXAMPLES)
    ]
    return "; ".join(said)


def _shown(label: Label) -> str:
    return f"{label.value:g}" if isinstance(label.value, float) else str(label.value)


def _some(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - MOST_EXAMPLES} more" if len(texts) > MOST_EXAMPLES else ""
    return ", ".join(texts[:MOST_EXAMPLES]) + more
