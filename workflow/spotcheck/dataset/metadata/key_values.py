"""Keys and values in texts: `key = value` lines, JSON and XML, as cameras and programs write them."""

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import datetime
from itertools import islice
from typing import Any
from xml.etree import ElementTree

from spotcheck.dataset.metadata import units
from spotcheck.dataset.metadata.entry import BINNING, PITCH, MetadataEntry

# Limits: characters of a text that are parsed, keys that are read from it, characters of an entry that a message shows.
LONGEST_TEXT, MOST_KEYS, LONGEST_SHOWN = 1_000_000, 2000, 60
# Most characters of a date, and most digits of a count.
LONGEST_DATE, MOST_DIGITS = 40, 9
# Column and the dimension or type of its values, by known key in the spelling of `normalize_key`.
KEYS: dict[str, tuple[str, str]] = {
    key: column_and_dimension
    for column_and_dimension, keys in {
        ("exposure_s", "s"): (
            "exposure exposuretime exptime exp texp shutter shutterspeed shuttertime tint integrationtime inttime"
            " exposuretimeabs detectorexposuretime cameraexposure"
        ),
        ("angle_deg", "deg"): "angle ang rotation theta rotationangle fibreangle",
        ("z_m", "m"): "z zpos zposition positionz posz stagez zstage distance dist defocus",
        (PITCH, "m"): "pixelsize pixelpitch pitch sensorpixelsize",
        (BINNING, BINNING): (
            "binning bin binningx binningy xbinning ybinning binningmode camerabinning detectorbinning pixelbinning"
            " binninghorizontal binningvertical horizontalbinning verticalbinning hbin vbin binx biny xbin ybin"
        ),
        ("laser.wavelength_m", "m"): "wavelength laserwavelength lambda",
        ("sensor.gain_dn_per_e", "dn_per_e"): "gain",
        ("repeat", "count"): "repeat rep shot run",
        ("sensor.bit_depth", "count"): "bitdepth significantbits adcbitdepth",
        ("kind", "kind"): "kind frametype imagetype imagetyp",
        ("date", "date"): "date datetime dateobs datetimeoriginal acquisitiondate acquisitiontime timestamp",
    }.items()
    for key in keys.split()
}
# Keys of pixel sizes that include the binning, in the spelling of `normalize_key`: Micro-Manager's PixelSizeUm.
BINNED_PITCH_KEYS = ("pixelsizeum",)
# Binning off, as words.
NO_BINNING = ("none", "off", "no", "false")
# Kind of a frame by the words that name it.
KIND_WORDS = {
    **dict.fromkeys("dark darks darkframe bias background bg bkg".split(), "dark"),
    **dict.fromkeys("flat flats flatfield flatframe".split(), "flat"),
    **dict.fromkeys("spot spots light".split(), "spot"),
}
# Keys with which tifffile and ImageJ describe the layout of a stack or its display, not the frame.
LAYOUT = set(
    "imagej images slices frames channels hyperstack mode loop min max axes shape unit spacing finterval fps labels"
    " ranges luts ij c0 c1 cf vunit software".split()
)
# XML attributes that hold the key of an element.
KEY_ATTRIBUTES = ("name", "key", "id")
# A line `key = value` or `key: value`.
_LINE = re.compile(r"([^\W\d][^=:]{0,59})[=:](.+)")
# A unit at the end of a key: Exposure-ms, exposure_s, ZPositionUm, Exposure (ms).
_KEY_UNIT = re.compile(
    rf"(.*?)(?:[\s_-]*[(\[]|[\s_-]|(?<=[a-z])(?=[A-Z]))((?i:{units.UNIT_PATTERN})|dn_per_e)[)\]]?",
)
# Binning of columns and perhaps of rows: 2, 2x2, 2 × 2, 2,2, (2, 2), "Bin2x2".
_BINNING = re.compile(r"(?i:bin(?:ning)?)?\s*[\[({]?\s*(\d{1,2})(?:\s*(?:[x×*,:]|\s|by)\s*(\d{1,2}))?\s*[\])}]?", re.I)
# A date with a four-digit year first, perhaps with a time.
_DATE = re.compile(r"(\d{4})[-:/.](\d\d)[-:/.](\d\d)(?:[T ](\d\d:\d\d(?::\d\d(?:\.\d{1,6})?)?))?.*")


def parse_text(text: str, source: str, page: int | None = None) -> Iterator[MetadataEntry]:
    """Yield the metadata of a JSON or XML text, or else of `key = value` parts between line ends and semicolons.

    Parameters
    ----------
    text : the text; the part beyond `LONGEST_TEXT` characters is ignored.
    source : where the text was found.
    page : page that the text describes; None for all pages.
    """
    yield from parse_pairs(_split_pairs(text[:LONGEST_TEXT]), source, page)


def _split_pairs(text: str) -> Iterable[tuple[str, Any]]:
    """Return keys and values of a JSON, XML or line-based text; values are JSON scalars or texts.

    A text that is no valid JSON or XML is read as lines.
    """
    first_character = text.lstrip()[:1]
    if first_character in ("{", "["):
        with suppress(ValueError, RecursionError):
            return list(flatten_keys(json.loads(text)))
    # A text that declares entities is not parsed as XML: entities can expand to more than memory holds.
    if first_character == "<" and "<!DOCTYPE" not in text and "<!ENTITY" not in text:
        with suppress(ElementTree.ParseError):
            return _flatten_xml(ElementTree.fromstring(text.strip()))
    segments = (segment.strip("\0# \t\r") for segment in re.split(r"[\n\r;]", text))
    return ((match[1].strip(), match[2].strip()) for segment in segments if (match := _LINE.fullmatch(segment)))


def flatten_keys(content: Any) -> Iterator[tuple[str, Any]]:
    """Yield the keys and scalar values of nested dictionaries, and of dictionaries in lists; None is skipped.

    Keys are those of the innermost dictionary. Numbers and texts in lists are dropped, except those of the binning.
    """
    # A stack instead of recursion, which deep nesting would exhaust.
    stack = [("", content)]
    while stack:
        key, value = stack.pop()
        if isinstance(value, dict):
            stack += [(str(name), item) for name, item in reversed(value.items())]
        elif isinstance(value, list) and KEYS.get(normalize_key(key), ("",))[0] == BINNING:
            yield key, ",".join(map(str, value))
        elif isinstance(value, list):
            stack += [(key, item) for item in value[:MOST_KEYS] if isinstance(item, dict)]
        elif value is not None:
            yield key, value


def _flatten_xml(root: ElementTree.Element) -> Iterator[tuple[str, Any]]:
    """Yield keys and values of all elements: name and text of each, then its attributes.

    `<Property name="Exposure" value="10 ms"/>` gives the key Exposure.
    """
    for element in root.iter():
        # Comments and processing instructions have no tag.
        if not isinstance(element.tag, str):
            continue
        attributes = {name.rpartition("}")[2].lower(): value for name, value in element.items()}
        tag = element.tag.rpartition("}")[2]
        name = next((attributes.pop(key) for key in KEY_ATTRIBUTES if key in attributes), tag)
        text = (element.text or "").strip() or attributes.pop("value", "")
        # An attribute may hold the unit: <Exposure unit="ms">10</Exposure>.
        unit = attributes.pop("unit", attributes.pop("units", ""))
        if text:
            yield name, f"{text} {unit}".strip()
        yield from attributes.items()


def parse_pairs(pairs: Iterable[tuple[str, Any]], source: str, page: int | None = None) -> Iterator[MetadataEntry]:
    """Yield an entry for each of the first `MOST_KEYS` keys and values, without keys that only describe a layout."""
    for key, value in islice(pairs, MOST_KEYS):
        name = normalize_key(key)
        if name and name not in LAYOUT:
            yield parse_pair(key[:LONGEST_SHOWN], str(value).strip("\"' \t"), source, page)


def normalize_key(key: str) -> str:
    """Return a key in lower case, without spaces and punctuation."""
    return re.sub(r"[\W_]", "", key).lower()


def parse_pair(key: str, value: str, source: str, page: int | None = None) -> MetadataEntry:
    """Return the entry of one key and its value; its column is None for an unknown key.

    `source` and `page` are as in `parse_text`.
    """
    text = f"{key} = {value}".replace("\n", " ")
    text = text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"
    column_and_dimension, unit = _parse_key(key)
    if column_and_dimension is None:
        return MetadataEntry(None, None, text, source, page)
    column, dimension = column_and_dimension
    if dimension == BINNING:
        return _parse_binning(value, text, source, page)
    includes_binning = normalize_key(key) in BINNED_PITCH_KEYS
    parsed_value, number, question = parse_value(value, unit, dimension), "", ""
    quantity = units.parse_quantity(value) if dimension in units.UNITS else None
    if parsed_value is None and quantity is not None:
        question = units.ask_about_comma(quantity[0])
        number = "" if unit or quantity[1] or question else quantity[0].replace(",", ".")
    return MetadataEntry(column, parsed_value, text, source, page, includes_binning, number, question)


def _parse_binning(value: str, text: str, source: str, page: int | None) -> MetadataEntry:
    """Return the entry of a binning; its column is None for a text that is no binning.

    The value is None if rows and columns are binned differently. `text`, `source` and `page` are those of the entry.
    """
    if normalize_key(value) in NO_BINNING:
        return MetadataEntry(BINNING, 1, text, source, page)
    match = _BINNING.fullmatch(value.strip())
    if match is None or not all(int(number) for number in match.groups(default="1")):
        return MetadataEntry(None, None, text, source, page)
    columns, rows = match[1], match[2] or match[1]
    return MetadataEntry(BINNING, int(columns) if columns == rows else None, text, source, page)


def is_quantity(key: str) -> bool:
    """Return whether the values of a key are numbers with a unit."""
    column_and_dimension, _ = _parse_key(key)
    return column_and_dimension is not None and column_and_dimension[1] in units.UNITS


def _parse_key(key: str) -> tuple[tuple[str, str] | None, str]:
    """Return the item of `KEYS` for a key, None if it is unknown, and the unit in the key, "" if it has none."""
    column_and_dimension = KEYS.get(normalize_key(key))
    if column_and_dimension is None and (match := _KEY_UNIT.fullmatch(key.strip())):
        return KEYS.get(normalize_key(match[1])), match[2].replace("_per_", "/")
    return column_and_dimension, ""


def parse_value(value: str, unit: str, dimension: str) -> float | int | str | None:
    """Return the value of a column: a number in the unit of the column, a count, a kind, or a date in ISO 8601.

    Parameters
    ----------
    value : text of the value, perhaps with a unit.
    unit : unit of a number without a unit in `value`; "" if unknown.
    dimension : key of `units.UNITS`, or "kind", "date" or "count".

    Returns
    -------
    float, int, str or None
        None if the text is not such a value, a number lacks the unit that it needs, or a time is negative.
    """
    if dimension == "kind":
        return KIND_WORDS.get(normalize_key(value))
    if dimension == "date":
        return parse_date(value)
    quantity = units.parse_quantity(value)
    if quantity is None:
        return None
    number, stated_unit = quantity
    if dimension == "count":
        is_count = number.isdecimal() and len(number) <= MOST_DIGITS and not stated_unit
        return int(number) if is_count else None
    # ASSUME: an angle without a unit is in degrees, as no instrument shows radians.
    unit = stated_unit or unit or ("deg" if dimension == "deg" else "")
    converted = units.convert_quantity(number, unit, dimension)
    return None if dimension == "s" and converted is not None and converted < 0 else converted


def parse_date(text: str) -> str | None:
    """Return a date, with its time if there is one, in ISO 8601; None for any other text.

    Year, month and day may be separated by colons, as in EXIF.
    """
    match = _DATE.fullmatch(text.strip()[:LONGEST_DATE])
    if match is None:
        return None
    year, month, day, time = match.groups()
    iso = f"{year}-{month}-{day}" + (f"T{time}" if time else "")
    try:
        datetime.fromisoformat(iso)
    except ValueError:
        return None
    return iso
