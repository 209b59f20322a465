"""The user's answers about a folder of images (`--set KEY=VALUE`), and the metadata of a frame after these answers.

KEY is a column of manifest.csv or a key of instrument.yaml. An answer is its value, the unit of numbers that have none,
or the source that is right if two sources disagree. A source has the form of `MetadataEntry.source_pattern`.
"""

from collections.abc import Mapping
from dataclasses import replace

from spotcheck.dataset.folder import get_column_unit
from spotcheck.dataset.manifest import DATE, KINDS
from spotcheck.dataset.metadata import units
from spotcheck.dataset.metadata.entry import BINNING, PITCH, MetadataEntry, group_by_column, resolve_entries
from spotcheck.dataset.metadata.key_values import parse_date
from spotcheck.dataset.scan.folder_scan import FolderScan, ScannedFrame
from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation

# Keys that select a colour plane; their answers are checked by the schema alone.
COLOUR_KEYS = ("sensor.channel", "sensor.bayer")
# Description of valid answers, by column or dimension.
EXPECTED_ANSWERS = {
    "kind": "spot, dark or flat",
    DATE: "a date such as 2026-01-31 or 2026-01-31T09:30:00",
    "s": "a time such as 2ms",
    "m": "a length such as 3.45um",
    "deg": "an angle such as 45deg",
}


def resolve_frame(
    frame: ScannedFrame, answers: Mapping[str, str]
) -> tuple[dict[str, MetadataEntry], dict[str, tuple[MetadataEntry, MetadataEntry]]]:
    """Return the metadata of a frame on which its sources agree, after the user's answers, and remaining conflicts.

    Parameters
    ----------
    frame : frame with the metadata of all sources.
    answers : valid answers (see `check_answers`) by column or key.

    Returns
    -------
    agreed : dict
        One entry for each column on which all sources agree, or for which the user gives the value or the source.
    conflicts : dict
        Two contradicting entries for each other column.
    """
    entries = list[MetadataEntry]()
    for column, candidates in group_by_column(frame.metadata).items():
        if column == BINNING:
            # Also a binning without a value decides about the pixel pitch.
            entries += candidates
            continue
        answer = answers.get(column, "")
        # The answer is used as a unit only if no source gives a value, and as a source only if it is one.
        with_value = [entry for entry in candidates if entry.value is not None] or _apply_unit(candidates, answer)
        entries += [entry for entry in with_value if entry.source_pattern == answer] or with_value
    agreed, conflicts = resolve_entries(entries, frame.page)
    for column, answer in answers.items():
        value = _parse_answer(column, answer)
        if value is not None:
            agreed[column] = MetadataEntry(column, value, answer, "as you said")
            conflicts.pop(column, None)
            if column == PITCH:
                # The answer is the pitch of the frames, so that their binning no longer matters.
                conflicts.pop(BINNING, None)
    return agreed, conflicts


def check_answers(scan: FolderScan, answers: Mapping[str, str]) -> None:
    """Check that each answer is a value, a unit or a source.

    Parameters
    ----------
    scan : frames and metadata of the folder, which give the sources.
    answers : answers by column or key.

    Raises
    ------
    InputError
        For an answer that is none of these, or a value that instrument.yaml cannot have.
    """
    for column, answer in answers.items():
        value, dimension = _parse_answer(column, answer), get_column_dimension(column)
        entries = (entry for frame in scan.frames for entry in frame.metadata)
        sources = {entry.source_pattern for entry in entries if entry.column == column}
        is_unit = dimension is not None and units.get_dimension(answer) == dimension
        if value is None and answer not in sources and not is_unit:
            expected = EXPECTED_ANSWERS.get(dimension or column, "a number")
            listed = f", or which source is right: {', '.join(sorted(sources))}" if sources else ""
            raise InputError(f"--set {column}={answer}: must be {expected}{listed}")
        if violation := find_schema_violation(column, value):
            raise InputError(f"--set {column}={answer}: {violation}")


def find_schema_violation(column: str, value: float | int | str | None) -> str | None:
    """Return what is wrong with the value of a key of instrument.yaml such as "sensor.bit_depth".

    Returns None if the value is valid or None, and for columns of the manifest.
    """
    section, dot, key = column.partition(".")
    return find_violation({section: {key: value}}, "instrument") if dot and value is not None else None


def get_column_dimension(column: str) -> str | None:
    """Return the dimension (s, m or deg, as in `units.UNITS`) of a column or key; None if its values have no unit."""
    return units.get_dimension(get_column_unit(column))


def _parse_answer(column: str, answer: str) -> float | int | str | None:
    """Return the value that an answer gives for a column, in the unit of the column.

    Returns None for an answer that is a unit, a source or invalid.
    """
    if column == "kind":
        return answer if answer in KINDS else None
    if column == DATE:
        return parse_date(answer)
    if column in COLOUR_KEYS:
        return answer
    quantity = units.parse_quantity(answer)
    if quantity is None:
        return None
    number, unit = quantity
    dimension = get_column_dimension(column)
    if dimension and unit:
        return units.convert_quantity(number, unit, dimension)
    value = float(number.replace(",", "."))
    return int(value) if column in ("repeat", "sensor.bit_depth") else value


def _apply_unit(entries: list[MetadataEntry], unit: str) -> list[MetadataEntry]:
    """Return the entries that lack nothing but a unit, with the value of their number in `unit`.

    Returns no entry if `unit` is not a unit of their column, and none whose text has several readings, which a unit
    does not decide.
    """
    converted_entries = []
    for entry in entries:
        dimension = get_column_dimension(entry.column or "")
        value = units.convert_quantity(entry.number, unit, dimension) if dimension and entry.number else None
        # No exposure time is negative.
        if value is not None and (value >= 0 or dimension != "s"):
            converted_entries.append(replace(entry, value=value))
    return converted_entries
