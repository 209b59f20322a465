"""Metadata in names of files, folders and HDF5 datasets: `45deg/100us_003.tif`, `t=1.5ms`, `scan.h5#/dark_07`."""

import re
from collections.abc import Iterator
from pathlib import PurePath

from spotcheck.dataset.metadata import units
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.dataset.metadata.key_values import KEYS, KIND_WORDS, parse_date

# Sources of entries from names; a dataset is an array in an HDF5 file, and a group is a folder in it.
FILE, FOLDER = "file name", "folder name"
DATASET, GROUP = "name of the HDF5 dataset", "name of the HDF5 group"
NAME_SOURCES = (FILE, FOLDER, DATASET, GROUP)
# Most characters of a name that are parsed; longer runs of digits than MOST_DIGITS are sorted as text.
LONGEST_NAME, MOST_DIGITS = 250, 19
# A number with its unit, perhaps with a word before it and a gap between them. Some names write 1p5 for 1.5.
_QUANTITY = re.compile(
    rf"(?<![A-Za-z0-9.])(?:(?P<key>[^\W\d_]+)(?P<gap>\s*=\s*|[\s_-]*))?(?P<sign>[-+]?)"
    rf"(?P<number>\d+(?:[.,p]\d+)?(?:[eE][-+]?\d+)?)"
    rf"[\s_]?(?P<unit>(?i:{units.UNIT_PATTERN}))(?![^\W_])"
)
# Digits and a separator right before a number, perhaps with a word before them: exp_2_ in exp_2_5ms, 1- in 1-200s.
_NUMBER_HEAD = re.compile(r"(?:(?<![^\W_])(?P<word>[^\W\d_]+)[\s_=-]*)?(?<![\d.,])(?P<head>\d+)(?P<separator>[-_,])$")
# A word and a number without a unit, and the gap between them.
_NUMBERED_WORD = re.compile(
    r"(?<![A-Za-z0-9.])(?P<key>[^\W\d_]+)(?P<gap>[\s_=-]*)(?P<number>\d+(?:[.,p]\d+)?)(?![^\W_])"
)
# The number at the end of a name, perhaps in brackets.
_TRAILING_NUMBER = re.compile(r"(?:^|[\s_.()-])(\d{1,6})\)?$")
# A date, perhaps with a time: 20260131, 2026-01-31_143000.
_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)([-_.]?)([01]\d)\2([0-3]\d)(?:[-_T ]*(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d))?(?!\d)"
)
# Column of a quantity without a known word before it, by dimension.
_DEFAULT_COLUMNS = {"s": "exposure_s", "m": "z_m", "deg": "angle_deg"}
# Words before a quantity that is neither exposure, position nor angle of the sample.
OTHER_QUANTITIES = set(
    "x y f d w dx dy lens focal fl dia diameter pinhole slit fwhm waist delay period interval pulse wait dt tilt pol"
    " polarizer polariser hwp qwp".split()
)
# Words whose number is the repeat, and words whose number only counts files.
REPEAT_WORDS = ("r", "rep", "repeat", "shot", "run")
COUNTER_WORDS = ("snap", "img", "image", "frame", "pic", "no", "nr", "n", "page")
# Most digits after an underscore or a hyphen that may be decimals.
MOST_DECIMALS = 2
# Range of laser wavelengths that silicon detects [m]: a length in nm within it is the wavelength.
WAVELENGTHS_M = (1.5e-7, 1.2e-6)


def parse_name(name: str, source: str = FILE) -> Iterator[MetadataEntry]:
    """Yield the metadata in the stem of a file name, or in the name of a folder, HDF5 dataset or HDF5 group.

    Parameters
    ----------
    name : the name without suffix.
    source : one of `NAME_SOURCES`; the number at the end of a folder or group is not read.
    """
    # The part of the name that is not understood so far.
    rest = name = name[:LONGEST_NAME]
    # 1. Numbers with a unit.
    for match in _QUANTITY.finditer(name):
        entry = _parse_quantity(match, source)
        if entry and entry.column and _may_be_tail(match):
            entry = MetadataEntry(None, None, entry.text, source)
        if entry:
            yield entry
            rest = rest.replace(entry.text, " ", 1)
    # 2. A date.
    if date_match := _DATE.search(rest):
        year, _, month, day, *time = date_match.groups()
        if date := parse_date(f"{year}-{month}-{day}" + (f"T{':'.join(time)}" if time[0] else "")):
            yield MetadataEntry("date", date, date_match[0], source)
            rest = rest.replace(date_match[0], " ", 1)
    # 3. Words for the kind of frame, and words with a number.
    for word in re.findall(r"[^\W\d_]+", rest):
        if word.lower() in KIND_WORDS:
            yield MetadataEntry("kind", KIND_WORDS[word.lower()], word, source)
    for match in _NUMBERED_WORD.finditer(rest):
        is_separated_end = match["gap"] != "" and match.end() == len(match.string)
        if entry := _parse_numbered_word(match, is_separated_end, source):
            yield entry
            rest = rest.replace(match[0], " ", 1)
    # 4. The running number at the end.
    if source in (FILE, DATASET) and (number_match := _TRAILING_NUMBER.search(rest.rstrip())):
        yield MetadataEntry("number", int(number_match[1]), number_match[1], source)


def parse_path(path: PurePath, inner_path: str = "") -> Iterator[MetadataEntry]:
    """Yield the metadata in the names of a path, from the innermost outwards.

    Parameters
    ----------
    path : relative path of a file.
    inner_path : path of a dataset inside an HDF5 file; "" for other files.
    """
    file_entries = list(parse_name(path.stem, FILE))
    if inner_path:
        *groups, dataset = PurePath(inner_path).parts
        inner_entries = list(parse_name(dataset, DATASET))
        for group in reversed(groups):
            inner_entries += parse_name(group, GROUP)
        inner_columns = {entry.column for entry in inner_entries}
        # The name of a file may list the kinds of its datasets: dark_and_flat.h5.
        if "kind" in inner_columns and len({entry.value for entry in file_entries if entry.column == "kind"}) > 1:
            file_entries = [entry for entry in file_entries if entry.column != "kind"]
        # Files are counted rather than datasets: many programs give the only dataset of each file the same number.
        if any(entry.column == "number" for entry in file_entries):
            inner_entries = [entry for entry in inner_entries if entry.column != "number"]
        yield from inner_entries
    yield from file_entries
    for folder in reversed(path.parts[:-1]):
        if folder not in ("..", "/"):
            yield from parse_name(folder, FOLDER)


def _parse_quantity(match: re.Match, source: str) -> MetadataEntry | None:
    """Return the entry of a number with a unit, with its value in the unit of manifest columns.

    Parameters
    ----------
    match : match of `_QUANTITY` in a name.
    source : one of `NAME_SOURCES`.

    Returns
    -------
    MetadataEntry or None
        The entry has no column if the word before the number names a quantity that no column holds, such as a focal
        length, or one of another dimension than the unit. None if no column has a value of this unit, or if the number
        is ambiguous (see `units.convert_quantity`).
    """
    unit, key, gap = match["unit"], (match["key"] or "").lower(), match["gap"]
    dimension = units.get_dimension(unit)
    if dimension is None:
        return None
    # A single hyphen between a word and a number separates them (z-5mm). After another separator (z_-5mm), or without a
    # word, it is a minus. `_QUANTITY` has a hyphen after a word in the gap, and any other one as the sign.
    is_negative = match["sign"] == "-" or (gap is not None and len(gap) > 1 and gap.endswith("-"))
    number = ("-" if is_negative else "") + match["number"].replace("p", ".")
    value = units.convert_quantity(number, unit, dimension)
    if value is None:
        return None
    is_known_word = key in KEYS
    column, expected_dimension = KEYS[key] if is_known_word else (_DEFAULT_COLUMNS.get(dimension), dimension)
    if key in OTHER_QUANTITIES or dimension != expected_dimension:
        return MetadataEntry(None, None, match[0], source)
    if not is_known_word and unit.lower() == "nm" and WAVELENGTHS_M[0] <= value <= WAVELENGTHS_M[1]:
        column = "laser.wavelength_m"
    if column is None:
        return None
    # A word without a quantity that is separated from the number (dark_5ms) is left for the next steps of the parsing.
    belongs_to_word = is_known_word or gap == "" or "=" in (gap or "")
    text = match[0] if belongs_to_word else match[0][match.start("number") - match.start() :]
    return MetadataEntry(column, value, text.strip(" _-"), source)


def _may_be_tail(match: re.Match) -> bool:
    """Return whether the number of a match of `_QUANTITY` may be only the end of a decimal number or a fraction.

    Both 1-200s (1/200 s) and exp_2_5ms (2.5 ms) can also be a counter and a quantity. A head that belongs to a date or
    to the word of a counter or repeat, or that starts with zeros (003_5ms), is a number of its own.
    """
    start = match.start("sign")
    if match["key"] or (head_match := _NUMBER_HEAD.search(match.string[:start])) is None:
        return False
    if any(date.end() >= head_match.end("head") > date.start() for date in _DATE.finditer(match.string)):
        return False
    word, head = (head_match["word"] or "").lower(), head_match["head"]
    if word in (*REPEAT_WORDS, *COUNTER_WORDS) or (len(head) > 1 and head.startswith("0")):
        return False
    # Decimals after an underscore are few; a longer number is a fraction of one second, or stands alone.
    has_few_digits = len(match["number"]) <= MOST_DECIMALS
    is_fraction = head == "1" and units.convert_quantity("1", match["unit"], "s") == 1
    return has_few_digits or is_fraction or head_match["separator"] == ","


def _parse_numbered_word(match: re.Match, is_separated_end: bool, source: str) -> MetadataEntry | None:
    """Return the entry of a word with a number without unit, a match of `_NUMBERED_WORD`.

    Returns None if the number may only count files, as one that is separated from the word and ends the name
    (`is_separated_end`) does. The entry of an unknown word has no column.
    """
    key, number = match["key"].lower(), match["number"].replace("p", ".")
    if key in REPEAT_WORDS and number.isdecimal():
        return MetadataEntry("repeat", int(number), match[0], source)
    if key in KEYS and KEYS[key][1] in units.UNITS:
        column, dimension = KEYS[key]
        # ASSUME: an angle without a unit is in degrees.
        value = units.convert_quantity(number, "deg", dimension) if dimension == "deg" else None
        return MetadataEntry(column, value, match[0], source)
    if key in (*KIND_WORDS, *COUNTER_WORDS) or is_separated_end:
        return None
    return MetadataEntry(None, None, match[0], source)


def natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts 2 before 10 and ignores case: a pair for each run of digits or of other characters.

    The first of a pair is the number, -1 for text; the second is the text, "" for a number.
    """
    return [
        (int(part), "") if part.isdecimal() and len(part) <= MOST_DIGITS else (-1, part.casefold())
        for part in re.split(r"(\d+)", name)
    ]
