"""Tags and texts inside TIFF and PNG files."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import tifffile
from PIL import ExifTags, Image

from spotcheck.dataset.labels import ome, words
from spotcheck.dataset.labels.label import Label
from spotcheck.io.formats import tiff

# Tags of TIFF and EXIF that say something of a frame: number, name, column and what its number measures.
TAGS = (
    (33434, "ExposureTime", "exposure_s", "s"),
    (36867, "DateTimeOriginal", "date", "date"),
    (306, "DateTime", "date", "date"),
)
# Tags that are shown as they are: what they mean for the gain depends on the camera.
SHOWN = ((271, "Make"), (272, "Model"), (34855, "ISOSpeedRatings"), (41991, "GainControl"))
EXIF = 34665
# Metres in a resolution's unit (TIFF 6.0, ResolutionUnit), and pixels that sensors have [m].
RESOLUTION_M = {2: 0.0254, 3: 0.01}
PITCH_M = (0.5e-6, 100e-6)


def of_tiff(path: Path) -> Iterator[Label]:
    """Labels of every page of a TIFF file. Raises what tifffile raises for a broken file."""
    found = list[Label]()
    with tiff.open_directories(path) as (file, directories):
        described = ""
        for number, page in enumerate(directories):
            found += _of_tags(page, number)
            text = page.tags.valueof(270, "")
            if not isinstance(text, str) or not text or text == described:
                continue
            described = text
            if text.lstrip().startswith("<") and "<OME" in text[:2000]:
                found += ome.labels_in(text[: words.LONGEST_TEXT])
            elif number == 0 and text.startswith("ImageJ="):
                found += _of_imagej(file, text)
            else:
                found += words.labels_in(text, "TIFF tag 270 ImageDescription", number)
    # What stands on the first page alone is said of the whole stack.
    later = {label.where for label in found if label.page}
    yield from (label if label.where in later else label._replace(page=label.page or None) for label in found)


def _of_tags(page: tifffile.TiffPage, number: int) -> Iterator[Label]:
    exif = page.tags.valueof(EXIF, {})
    exif = exif if isinstance(exif, dict) else {}
    for code, name, column, kind in TAGS:
        for value, where in ((page.tags.valueof(code), f"TIFF tag {code} {name}"), (exif.get(name), f"EXIF {name}")):
            if value is not None:
                yield _label(value, name, where, column, kind, number)
    for code, name in SHOWN:
        value = page.tags.valueof(code)
        if value is None:
            value = exif.get(name)
        if value is not None:
            yield Label(None, None, f"{name} = {value}"[: words.LONGEST_SHOWN], f"TIFF tag {code}", number)
    yield from _of_resolution(page, number)


def _label(value: Any, name: str, where: str, column: str, kind: str, number: int | None) -> Label:
    """Label of a tag: EXIF's times are fractions of seconds, its dates texts."""
    text = str(value).strip("\0 ")
    if kind == "s":
        ratio = _ratio(value)
        text = f"{ratio:g} s" if ratio else text
        return Label(column, ratio, text[: words.LONGEST_SHOWN], where, number)
    return Label(column, words.date_in(text), text[: words.LONGEST_SHOWN], where, number)


def _ratio(value: Any) -> float | None:
    """A number above 0 that is stored as one, or as numerator and denominator; None for what is none."""
    if isinstance(value, str | bytes):
        return None
    try:
        exact = Fraction(*value) if isinstance(value, tuple) and len(value) == 2 else Fraction(value)
        return float(exact) if 0 < exact < 10**6 else None
    except (ValueError, TypeError, ZeroDivisionError, OverflowError):
        return None


def _of_resolution(page: tifffile.TiffPage, number: int) -> Iterator[Label]:
    """The pitch that a resolution stands for, where a sensor may have it: most programs write that of a printer."""
    ratio, unit = _ratio(page.tags.valueof(282)), page.tags.valueof(296, 2)
    if (
        ratio
        and isinstance(unit, int)
        and unit in RESOLUTION_M
        and PITCH_M[0] <= RESOLUTION_M[unit] / ratio <= PITCH_M[1]
    ):
        said = f"{1e6 * RESOLUTION_M[unit] / ratio:.6g} µm a pixel"
        yield Label(None, None, said, "TIFF tag 282 XResolution", number)


def _of_imagej(file: tifffile.TiffFile, text: str) -> Iterator[Label]:
    """Labels of ImageJ's description and of its block of Info, and of each slice's own text."""
    yield from words.labels_in(text, "ImageJ description")
    found = file.imagej_metadata or {}
    if isinstance(found.get("Info"), str):
        yield from words.labels_in(found["Info"], "ImageJ Info")
    for page, own in enumerate(found.get("Labels") or ()):
        if isinstance(own, str):
            yield from words.labels_in(own, "ImageJ label of the slice", page)


def of_png(path: Path) -> Iterator[Label]:
    """Labels of the texts and the EXIF of a PNG file. Raises what Pillow raises for a broken file."""
    with Image.open(path, formats=("PNG",)) as image:
        exif = image.getexif()
        inner = exif.get_ifd(EXIF)
        pairs = [(key, value) for key, value in image.info.items() if isinstance(key, str) and isinstance(value, str)]
    # What ImageMagick writes of the file, not of the frame.
    pairs = [(key, value) for key, value in pairs if not key.lower().startswith(("date:", "tiff:", "png:", "software"))]
    for key, value in pairs:
        if "\n" in value or value.lstrip()[:1] == "{":
            yield from words.labels_in(value, f"PNG text {key[:40]}")
        elif words.plain(key) in ("description", "comment"):
            yield from words.labels_in(value, f"PNG text {key[:40]}")
        else:
            yield from words.of_keys([(key, value)], "PNG text")
    for code, name, column, kind in TAGS:
        if (own := inner.get(code, exif.get(code))) is not None:
            yield _label(own, name, f"EXIF {name}", column, kind, None)
    for code, name in SHOWN:
        if (own := inner.get(code, exif.get(code))) is not None:
            yield Label(None, None, f"{ExifTags.TAGS.get(code, name)} = {own}"[: words.LONGEST_SHOWN], "EXIF")
