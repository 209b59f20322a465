"""Metadata in names of files, folders and HDF5 datasets: `45deg/100us_003.tif`, `t=1.5ms`, `scan.h5#/dark_07`."""

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
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
# The power of ten in 2x10^-3.
_POWER_OF_TEN = r"[x×*·]10\^"
# A number with its unit, perhaps with a word before it and a gap between them. Some names write 1p5 for 1.5.
_QUANTITY = re.compile(
    rf"(?<![A-Za-z0-9.])(?:(?P<key>[^\W\d_]+)(?P<gap>\s*=\s*|[\s_-]*))?(?P<sign>[-+]?)"
    rf"(?P<number>\d+(?:[.,p]\d+)?(?:(?:[eE]|{_POWER_OF_TEN})[-+]?\d+)?)"
    rf"[\s_]?(?P<unit>(?i:{units.UNIT_PATTERN}))(?![^\W_])"
)
# Signs of a computation between two numbers.
_OPERATORS = "^*/+'’×·"
# Numbers and separators right before a number, perhaps with a word before them: exp_2_ in exp_2_5ms, 1- in 1-200s.
_NUMBER_HEAD = re.compile(
    r"(?:(?<![^\W_])(?P<word>[^\W\d_]+)[\s_=-]*)?(?<![\d.,])"
    rf"(?P<heads>(?:\d+(?:[.p]\d+)?[eE]?(?P<separator>[-_,\s{re.escape(_OPERATORS)}]|x(?=\d)))+)$"
)
# A word and a number without a unit, the gap between them, and digits behind them that may belong to the number.
_NUMBERED_WORD = re.compile(
    r"(?<![A-Za-z0-9.])(?P<key>[^\W\d_]+)(?P<gap>[\s_=-]*)\+?(?P<number>\d+(?:[.,p]\d+)?)(?![^\W_])"
    r"(?P<tail>[-_]\d+(?![^\W_]))?"
)
# A word at the end of a text, perhaps with a separator.
_LAST_WORD = re.compile(r"(?<![^\W_])([^\W\d_]+)[\s_=-]*$")
# The number at the end of a name, perhaps in brackets.
_TRAILING_NUMBER = re.compile(r"(?:^|[\s_.()-])(\d{1,6})\)?$")
# A date, perhaps with a time: 20260131, 2026-01-31_143000.
_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)([-_.]?)([01]\d)\2([0-3]\d)(?:[-_T ]*(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d))?(?!\d)"
)
# Column of a quantity without a known word before it, by dimension.
_DEFAULT_COLUMNS = {"s": "exposure_s", "m": "z_m", "deg": "angle_deg"}
# Words before a quantity that is neither exposure, position nor angle of the sample.
OTHER_TIMES = set("delay period interval pulse wait dt".split())
OTHER_QUANTITIES = OTHER_TIMES | set(
    "x y f d w dx dy lens focal fl dia diameter pinhole slit fwhm waist tilt pol polarizer polariser hwp qwp".split()
)
# Words for the sign of a number, and letters that may be one: z_m15mm.
MINUS_WORDS, PLUS_WORDS, MINUS_LETTERS = ("minus", "neg"), ("plus", "pos", "p"), ("m", "n")
# Words whose number is the repeat, and words whose number only counts files.
REPEAT_WORDS = ("r", "rep", "repeat", "shot", "run")
COUNTER_WORDS = ("snap", "img", "image", "frame", "pic", "no", "nr", "n", "page")
# Most digits after an underscore or a hyphen that may be decimals, unless the number before them is 0.
MOST_DECIMALS = 2
# Digits between two separators of thousands.
GROUP_DIGITS = 3
# Question on a text of which it is not clear where its numbers begin and end.
OPEN_EXPRESSION = "one number or several?"
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
        if entry and (head := _find_number_head(match)):
            entry = _leave_open(entry, match, head)
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
        is_separated_end = match["gap"] != "" and match.end("number") == len(match.string)
        if entry := _parse_numbered_word(match, is_separated_end, source):
            yield entry
            rest = rest.replace(entry.text, " ", 1)
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
        length, or one of another dimension than the unit. It has no value, but a question, if the sign of the number
        or its comma can be read in two ways. None if no column has a value of this unit.
    """
    unit, gap, (key, start) = match["unit"], match["gap"], _find_key(match)
    dimension = units.get_dimension(unit)
    if dimension is None:
        return None
    # A single hyphen between a word and a number separates them (z-5mm). After another separator (z_-5mm), or without a
    # word, it is a minus. `_QUANTITY` has a hyphen after a word in the gap, and any other one as the sign.
    is_negative = match["sign"] == "-" or _ends_in_minus(gap) or _get_sign_word(match) in MINUS_WORDS
    digits = re.sub(_POWER_OF_TEN, "e", match["number"]).replace("p", ".")
    value = units.convert_quantity(f"-{digits}" if is_negative else digits, unit, dimension)
    question = units.ask_about_comma(digits)
    if value is None and not question:
        return None
    is_known_word = key in KEYS
    column, expected_dimension = KEYS[key] if is_known_word else (_DEFAULT_COLUMNS.get(dimension), dimension)
    if key in OTHER_QUANTITIES or dimension != expected_dimension:
        return MetadataEntry(None, None, match.string[start : match.end()].strip(" _-"), source)
    if value and not is_known_word and unit.lower() == "nm" and WAVELENGTHS_M[0] <= value <= WAVELENGTHS_M[1]:
        column = "laser.wavelength_m"
    if column is None:
        return None
    if _get_sign_word(match) in MINUS_LETTERS or (is_negative and dimension == "s"):
        question = f"-{digits} or {digits}?"
    # A word without a quantity that is separated from the number (dark_5ms) is left for the next steps of the parsing.
    belongs_to_word = is_known_word or gap == "" or "=" in (gap or "")
    text = match.string[start if belongs_to_word else match.start("number") : match.end()]
    return MetadataEntry(column, None if question else value, text.strip(" _-"), source, question=question)


def _get_sign_word(match: re.Match) -> str:
    """Return the word directly before the number of a match of `_QUANTITY` if it may be its sign, else ""."""
    word = (match["key"] or "").lower()
    return word if match["gap"] == "" and word in (*MINUS_WORDS, *PLUS_WORDS, *MINUS_LETTERS) else ""


def _find_key(match: re.Match) -> tuple[str, int]:
    """Return the word in lower case that says which quantity a match of `_QUANTITY` is, and the start of its text.

    It is the word before the sign if that is a word: z in z_minus15mm.
    """
    sign_word = _get_sign_word(match)
    before = _LAST_WORD.search(match.string[: match.start()]) if sign_word else None
    if before and (before[1].lower() in KEYS or before[1].lower() in OTHER_QUANTITIES):
        return before[1].lower(), before.start()
    return (match["key"] or "").lower(), match.start()


def _ends_in_minus(gap: str | None) -> bool:
    """Return whether a gap between a word and a number ends in a minus, not in a single hyphen as a separator."""
    return gap is not None and len(gap) > 1 and gap.endswith("-")


def _find_number_head(match: re.Match) -> re.Match | None:
    """Return the digits before the number of a match of `_QUANTITY` if it may be only the end of a longer number.

    Both 1-200s (1/200 s) and exp_2_5ms (2.5 ms) can also be a counter and a quantity. A head that belongs to a date, to
    the word of a counter, of a repeat or of a quantity with another unit, or that starts with zeros (003_5ms), is a
    number of its own.
    """
    head_match = None if match["key"] else _NUMBER_HEAD.search(match.string[: match.start("sign")])
    if head_match is None:
        return None
    separator, word, (*earlier, head) = (
        head_match["separator"],
        (head_match["word"] or "").lower(),
        _split_head(head_match),
    )
    if separator in _OPERATORS:
        return head_match
    last_digit = head_match.end() - len(separator)
    if any(date.end() >= last_digit > date.start() for date in _DATE.finditer(match.string)):
        return None
    dimension = units.get_dimension(match["unit"])
    if word and (_get_word_dimension(word) == dimension or _names_other_quantity(word, dimension)):
        return head_match
    has_own_word = word in (*REPEAT_WORDS, *COUNTER_WORDS) or _get_word_dimension(word) is not None
    if (has_own_word and not earlier) or (len(head) > 1 and head.isdecimal() and head.startswith("0")):
        return None
    digits = re.match(r"\d+", match["number"])[0]  # type: ignore[index]
    if separator.isspace():
        return head_match if digits.startswith("0") and len(digits) == GROUP_DIGITS else None
    if separator == ",":
        return head_match
    if not head.isdecimal() or re.search("[.,p]", match["number"]):
        # A decimal number neither goes on behind a separator nor is the end of another one.
        return head_match if head_match["heads"][-2:-1] in ("e", "E") else None
    # Decimals after an underscore are few; a longer number is a fraction of one second, or stands alone.
    has_few_digits = len(digits) <= MOST_DECIMALS or digits.startswith("0") or head == "0"
    return head_match if has_few_digits or _is_fraction(head, match) else None


def _split_head(head_match: re.Match) -> list[str]:
    """Return the numbers of a match of `_NUMBER_HEAD`."""
    return re.findall(r"\d+(?:[.p]\d+)?", head_match["heads"])


def _get_word_dimension(word: str) -> str | None:
    """Return the dimension of the quantity that a word in lower case names; None if it names none with a unit."""
    dimension = "s" if word == "t" else KEYS.get(word, ("", ""))[1]
    return dimension if dimension in units.UNITS else None


def _names_other_quantity(word: str, dimension: str | None) -> bool:
    """Return whether a word in lower case names a quantity of this dimension that no column holds."""
    return word in OTHER_QUANTITIES and (word in OTHER_TIMES) == (dimension == "s")


def _is_fraction(head: str, match: re.Match) -> bool:
    """Return whether `head` and the number of a match of `_QUANTITY` may be a fraction of one second."""
    return head == "1" and units.convert_quantity("1", match["unit"], "s") == 1


def _leave_open(entry: MetadataEntry, match: re.Match, head_match: re.Match) -> MetadataEntry:
    """Return an entry without a value, with the question how the number after a match of `_NUMBER_HEAD` is meant.

    `entry` and `match` are the entry and the match of `_QUANTITY` if the number stood alone.
    """
    word, heads, separator = (head_match["word"] or "").lower(), _split_head(head_match), head_match["separator"]
    dimension = units.get_dimension(match["unit"])
    is_known_word = _get_word_dimension(word) == dimension or _names_other_quantity(word, dimension)
    start = head_match.start() if is_known_word else head_match.start("heads")
    text = match.string[start : match.end()]
    if _names_other_quantity(word, dimension) or entry.column is None:
        return MetadataEntry(None, None, text, entry.source)
    column = KEYS[word][0] if word in KEYS and is_known_word else entry.column
    digits, exponent = re.fullmatch(r"(\d*)(.*)", match["number"]).groups()  # type: ignore[union-attr]
    head, question = heads[-1], OPEN_EXPRESSION
    # One whole number and a separator, before digits without decimals.
    is_plain = head_match["heads"] == head + separator and head.isdecimal() and exponent[:1] not in (".", ",", "p")
    if is_plain and separator not in _OPERATORS and match["sign"] == "":
        readings = [] if separator.isspace() else [f"{head}.{digits}"]
        if len(digits) == GROUP_DIGITS and len(head) <= GROUP_DIGITS and head != "0":
            readings.append(f"{head}{digits}")
        if _is_fraction(head, match):
            readings.append(f"{head}/{digits}")
        readings.append(digits.lstrip("0") or "0")
        question = ", ".join(reading + exponent for reading in readings[:-1]) + f" or {readings[-1]}{exponent}?"
    return MetadataEntry(column, None, text, entry.source, question=question)


def _parse_numbered_word(match: re.Match, is_separated_end: bool, source: str) -> MetadataEntry | None:
    """Return the entry of a word with a number without unit, a match of `_NUMBERED_WORD`.

    Returns None if the number may only count files, as one that is separated from the word and ends the name
    (`is_separated_end`) does. The entry of an unknown word has no column.
    """
    key, number, text = (
        match["key"].lower(),
        match["number"].replace("p", "."),
        match[0][: match.end("number") - match.start()],
    )
    if key in REPEAT_WORDS and number.isdecimal():
        return MetadataEntry("repeat", int(number), text, source)
    if key in KEYS and KEYS[key][1] in units.UNITS:
        column, dimension = KEYS[key]
        question, tail = units.ask_about_comma(number), (match["tail"] or "")[1:]
        # Longer numbers behind a separator count files.
        if number.isdecimal() and tail and (len(tail) <= MOST_DECIMALS or number == "0"):
            question, text = f"{number}.{tail} or {number}?", match[0]
        if question:
            return MetadataEntry(column, None, text, source, question=question)
        number = f"-{number}" if _ends_in_minus(match["gap"]) else number
        if dimension != "deg":
            return MetadataEntry(column, None, text, source, number=number)
        # ASSUME: an angle without a unit is in degrees.
        return MetadataEntry(column, units.convert_quantity(number, "deg", dimension), text, source)
    if key in (*KIND_WORDS, *COUNTER_WORDS) or is_separated_end:
        return None
    return MetadataEntry(None, None, text, source)


def find_signed_words(entries: Iterable[MetadataEntry]) -> set[str]:
    """Return the words in names that are directly followed by a number or a plus: a hyphen behind them is a minus.

    `entries` are those of all images of a series. `z-5mm` is -5 mm beside `z+5mm` or `z0mm`, and otherwise 5 mm.
    """
    texts = {entry.text for entry in entries if entry.source in NAME_SOURCES}
    return {match[1] for text in texts if (match := re.match(r"([^\W\d_]+)\+?\d", text))}


def restore_sign(entry: MetadataEntry, signed_words: Collection[str]) -> MetadataEntry:
    """Return an entry from a name with a negative number if its text has one of `signed_words` and a hyphen.

    Other entries are returned as they are. `signed_words` are those of `find_signed_words`.
    """
    match = re.match(r"([^\W\d_]+)-\d", entry.text)
    if match is None or match[1] not in signed_words or entry.source not in NAME_SOURCES:
        return entry
    # A number without a unit has no value yet.
    number = f"-{entry.number}" if entry.number else ""
    return replace(entry, value=-entry.value if isinstance(entry.value, float) else entry.value, number=number)


def natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts 2 before 10 and ignores case: a pair for each run of digits or of other characters.

    The first of a pair is the number, -1 for text; the second is the text, "" for a number.
    """
    return [
        (int(part), "") if part.isdecimal() and len(part) <= MOST_DIGITS else (-1, part.casefold())
        for part in re.split(r"(\d+)", name)
    ]
