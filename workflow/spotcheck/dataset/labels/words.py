"""Texts of the kind `key = value`, JSON or XML, as cameras and programs put them into tags and beside images."""

import json
import re
from collections.abc import Iterable, Iterator
from datetime import datetime
from typing import Any
from xml.etree import ElementTree

from spotcheck.dataset.labels import units
from spotcheck.dataset.labels.label import Label

# Characters of a text that are looked at, keys that are taken from one, and characters that a message shows.
LONGEST_TEXT, MOST_KEYS, LONGEST_SHOWN = 1_000_000, 2000, 60
# Keys without spaces, signs and capitals; what they mean, and what their numbers measure.
KEYS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(
        (
            *("exposure", "exposuretime", "exptime", "exp", "texp", "shutter", "shutterspeed", "shuttertime", "tint"),
            *("integrationtime", "inttime", "exposuretimeabs", "detectorexposuretime", "cameraexposure"),
        ),
        ("exposure_s", "s"),
    ),
    **dict.fromkeys(("angle", "ang", "rotation", "theta", "rotationangle", "fibreangle"), ("angle_deg", "deg")),
    **dict.fromkeys(
        ("z", "zpos", "zposition", "positionz", "posz", "stagez", "zstage", "distance", "dist", "defocus"),
        ("z_m", "m"),
    ),
    **dict.fromkeys(("pixelsize", "pixelpitch", "pitch", "sensorpixelsize"), ("sensor.pixel_pitch_m", "m")),
    **dict.fromkeys(("wavelength", "laserwavelength", "lambda"), ("laser.wavelength_m", "m")),
    "gain": ("sensor.gain_dn_per_e", "dn_per_e"),
    **dict.fromkeys(("repeat", "rep", "shot", "run"), ("repeat", "count")),
    **dict.fromkeys(("bitdepth", "significantbits", "adcbitdepth"), ("sensor.bit_depth", "count")),
    **dict.fromkeys(("kind", "frametype", "imagetype", "imagetyp"), ("kind", "kind")),
    **dict.fromkeys(
        ("date", "datetime", "dateobs", "datetimeoriginal", "acquisitiondate", "acquisitiontime", "timestamp"),
        ("date", "date"),
    ),
}
KINDS = {
    **dict.fromkeys(("dark", "darks", "darkframe", "bias", "background", "bg", "bkg"), "dark"),
    **dict.fromkeys(("flat", "flats", "flatfield", "flatframe"), "flat"),
    **dict.fromkeys(("spot", "spots", "light"), "spot"),
}
# Keys by which tifffile and ImageJ lay out a stack or its display: they say nothing of a frame.
LAYOUT = (
    *("imagej", "images", "slices", "frames", "channels", "hyperstack", "mode", "loop", "min", "max", "axes", "shape"),
    *("unit", "spacing", "finterval", "fps", "labels", "ranges", "luts", "ij", "c0", "c1", "cf", "vunit", "software"),
)
# Attributes of XML that name what an element says.
NAMED = ("name", "key", "id")
_LINE = re.compile(r"([^\W\d][^=:]{0,59})[=:](.+)")
# A unit at the end of a key: Exposure-ms, exposure_s, ZPositionUm, Exposure (ms).
_KEY_UNIT = re.compile(
    rf"(.*?)(?:[\s_-]*[(\[]|[\s_-]|(?<=[a-z])(?=[A-Z]))((?i:{units.ANY})|dn_per_e)[)\]]?",
)
_DATE = re.compile(r"(\d{4})[-:/.](\d\d)[-:/.](\d\d)(?:[T ](\d\d:\d\d(?::\d\d(?:\.\d{1,6})?)?))?.*")


def labels_in(text: str, where: str, page: int | None = None) -> Iterator[Label]:
    """Labels of a text: JSON, XML, else a line or a part between semicolons for each key."""
    text = text[:LONGEST_TEXT]
    if text.lstrip()[:1] in ("{", "["):
        try:
            yield from of_keys(flat(json.loads(text)), where, page)
            return
        except (ValueError, RecursionError):
            pass
    if text.lstrip()[:1] == "<" and "<!DOCTYPE" not in text and "<!ENTITY" not in text:
        try:
            yield from of_keys(_of_xml(ElementTree.fromstring(text.strip())), where, page)
            return
        except ElementTree.ParseError:
            pass
    parts = (part.strip("\0# \t\r") for part in re.split(r"[\n\r;]", text))
    pairs = ((found[1].strip(), found[2].strip()) for part in parts if (found := _LINE.fullmatch(part)))
    yield from of_keys(pairs, where, page)


def flat(content: Any) -> Iterator[tuple[str, Any]]:
    """Keys and single values of nested keys and lists."""
    waiting = [("", content)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, dict):
            waiting += [(str(name), own) for name, own in reversed(value.items())]
        elif isinstance(value, list):
            waiting += [(key, own) for own in value[:MOST_KEYS] if isinstance(own, dict)]
        elif value is not None:
            yield key, value


def _of_xml(root: ElementTree.Element) -> Iterator[tuple[str, Any]]:
    """Keys and values: an element's name and text, its attributes, and `<Property name="Exposure" value="10 ms"/>`."""
    for element in root.iter():
        if not isinstance(element.tag, str):
            continue
        said = {name.rpartition("}")[2].lower(): value for name, value in element.items()}
        name = next((said.pop(key) for key in NAMED if key in said), element.tag.rpartition("}")[2])
        text = (element.text or "").strip() or said.pop("value", "")
        # <Exposure unit="ms">10</Exposure>
        unit = said.pop("unit", said.pop("units", ""))
        if text:
            yield name, f"{text} {unit}".strip()
        yield from said.items()


def of_keys(pairs: Iterable[tuple[str, Any]], where: str, page: int | None = None) -> Iterator[Label]:
    """Labels of keys and values; keys that are not understood have the column None."""
    for count, (key, value) in enumerate(pairs):
        if count == MOST_KEYS:
            return
        if plain(key) not in LAYOUT and plain(key):
            yield of_key(key[:LONGEST_SHOWN], str(value).strip("\" '\t"), where, page)


def plain(key: str) -> str:
    """A key without spaces, signs and capitals."""
    return re.sub(r"[\W_]", "", key).lower()


def of_key(key: str, value: str, where: str, page: int | None = None) -> Label:
    """The label of one key and its value."""
    text = f"{key} = {value}".replace("\n", " ")
    text = text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"
    known, unit = KEYS.get(plain(key)), ""
    if known is None and (found := _KEY_UNIT.fullmatch(key.strip())):
        known, unit = KEYS.get(plain(found[1])), found[2].replace("_per_", "/")
    if known is None:
        return Label(None, None, text, where, page)
    column, kind = known
    return Label(column, valued(value, unit, kind), text, where, page)


def valued(value: str, unit: str, kind: str) -> float | int | str | None:
    """A value as its column has it; None for a number without the unit that it needs, or what is none."""
    if kind == "kind":
        return KINDS.get(plain(value))
    if kind == "date":
        return date_in(value)
    parted = units.parted(value)
    if parted is None:
        return None
    number, own = parted
    if kind == "count":
        whole = number.isdecimal() and len(number) < 10 and not own
        return int(number) if whole else None
    # ASSUME: an angle without a unit is in degrees, as no instrument shows radians.
    scaled = units.scaled(number, own or unit or ("deg" if kind == "deg" else ""), kind)
    return None if kind == "s" and scaled is not None and scaled < 0 else scaled


def date_in(text: str) -> str | None:
    """ISO 8601 of a date, with its time where it has one; TIFF and EXIF part days by colons."""
    found = _DATE.fullmatch(text.strip()[:40])
    if found is None:
        return None
    year, month, day, time = found.groups()
    written = f"{year}-{month}-{day}" + (f"T{time}" if time else "")
    try:
        datetime.fromisoformat(written)
    except ValueError:
        return None
    return written
