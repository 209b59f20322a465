"""One piece of metadata about a frame, and the comparison of pieces from several sources."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from spotcheck.io.text import replace_unprintable

# Numbers that differ by less than this fraction are equal: file names round what tags store to more digits.
ROUNDING_TOLERANCE = 0.01
# Key of the pixel pitch, and the column of the binning: side of the square of sensor pixels that are read as one.
PITCH, BINNING = "sensor.pixel_pitch_m", "binning"


@dataclass(frozen=True)
class MetadataEntry:
    """One piece of metadata that a file gives about its frames.

    Attributes
    ----------
    column : column of manifest.csv (`kind`, `angle_deg`, `exposure_s`, `repeat`, `z_m`, `date`, `photons_per_px`), key
        of instrument.yaml (`sensor.pixel_pitch_m`, …), `number` for the number at the end of a file name, or
        `binning`. None if the text was not understood.
    value : number in the unit of `column`, or a word or date. None if the unit of the number is missing, the text was
        not understood or can be read in several ways, or the binning differs between rows and columns.
    text : the text that was read, as messages show it.
    source : where the text was found, such as "TIFF tag 306 DateTime".
    page : page of the stack that the entry describes; None for all pages.
    includes_binning : whether a pixel pitch is that of the binned pixels, not of the pixels of the sensor.
    number : the number in the text, with a decimal point, if nothing but its unit is missing; otherwise "".
    question : the question that a text with several readings leaves open, such as "1.5 or 5?"; otherwise "". A unit
        does not answer it.
    """

    column: str | None
    value: float | int | str | None
    text: str
    source: str
    page: int | None = None
    includes_binning: bool = False
    number: str = ""
    question: str = ""

    def __post_init__(self) -> None:
        """Replace characters that would change a terminal, and that YAML refuses even in comments."""
        for name in ("text", "source", "question"):
            object.__setattr__(self, name, replace_unprintable(getattr(self, name)))

    @property
    def source_pattern(self) -> str:
        """The source in a form that is common to all frames: a sidecar file is named by its suffix alone, `*.json`."""
        return re.sub(r"^side file .*(\.\w+)$", r"side file *\1", self.source)

    def __str__(self) -> str:
        """Return the source and the text of the entry as a clause of a message."""
        return f"{self.source} says {self.text!r}"


def group_by_column(entries: Iterable[MetadataEntry]) -> dict[str, list[MetadataEntry]]:
    """Return the entries of each column in their order, by column; entries without a column are dropped."""
    entries_by_column: dict[str, list[MetadataEntry]] = {}
    for entry in entries:
        if entry.column:
            entries_by_column.setdefault(entry.column, []).append(entry)
    return entries_by_column


def resolve_entries(
    entries: Iterable[MetadataEntry], page: int = 0
) -> tuple[dict[str, MetadataEntry], dict[str, tuple[MetadataEntry, MetadataEntry]]]:
    """Return, for one page, the metadata on which its sources agree, and the conflicts between sources.

    Parameters
    ----------
    entries : metadata of a file, the most exact sources first; entries without a value do not count.
    page : page of the stack, from 0.

    Returns
    -------
    agreed : dict
        By column, the first entry of each column whose entries are all consistent with it. The pixel pitch is that of
        the image: multiplied by the binning, and missing if rows and columns are binned differently.
    conflicts : dict
        By column, the first entry of each other column, and the first that contradicts it.
    """
    agreed: dict[str, MetadataEntry] = {}
    conflicts: dict[str, tuple[MetadataEntry, MetadataEntry]] = {}
    of_page = [entry for entry in entries if entry.page in (None, page)]
    binned = _apply_binning(of_page)
    for column, candidates in group_by_column(entry for entry in binned if entry.value is not None).items():
        first_entry = candidates[0]
        contradicting = next((entry for entry in candidates if not is_consistent(first_entry, entry)), None)
        if contradicting is None:
            agreed[column] = first_entry
        else:
            conflicts[column] = first_entry, contradicting
    if len(binned) == len(of_page):
        # A binning on which the sources disagree matters only to the pixel pitch.
        conflicts.pop(BINNING, None)
    return agreed, conflicts


def _apply_binning(entries: list[MetadataEntry]) -> list[MetadataEntry]:
    """Return the entries of a page with pixel pitches multiplied by the binning, or removed if that is not one number.

    Pitches that include the binning are returned as they are.
    """
    binnings = {entry.value: entry for entry in entries if entry.column == BINNING}
    if not set(binnings) - {1}:
        return entries
    factor, binning = next(iter(binnings.items()))
    if len(binnings) > 1 or not isinstance(factor, int):
        return [entry for entry in entries if not _is_sensor_pitch(entry)]
    return [
        replace(entry, value=entry.value * factor, text=f"{entry.text} × {factor} ({binning.text})")
        if _is_sensor_pitch(entry) and isinstance(entry.value, float)
        else entry
        for entry in entries
    ]


def _is_sensor_pitch(entry: MetadataEntry) -> bool:
    """Return whether an entry is the pixel pitch of the sensor, before binning."""
    # ASSUME: cameras and their programs state the pixel size of the sensor, which binning does not change.
    return entry.column == PITCH and not entry.includes_binning


def is_consistent(first: MetadataEntry, second: MetadataEntry) -> bool:
    """Return whether two entries of a column agree: numbers within `ROUNDING_TOLERANCE`, dates by their day."""
    if first.column == "date":
        return str(first.value)[: len("2026-01-31")] == str(second.value)[: len("2026-01-31")]
    if isinstance(first.value, float) and isinstance(second.value, float):
        return math.isclose(first.value, second.value, rel_tol=ROUNDING_TOLERANCE)
    return first.value == second.value
