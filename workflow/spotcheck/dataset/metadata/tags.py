"""Tags and texts inside TIFF and PNG files."""

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import tifffile
from PIL import Image

from spotcheck.dataset.manifest import DATE
from spotcheck.dataset.metadata import key_values, ome
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.io.formats import tiff

# TIFF and EXIF tags: number, name and column. Those without a column are only shown to the user: what they mean for the
# gain depends on the camera.
TAGS = (
    (33434, "ExposureTime", "exposure_s"),
    (36867, "DateTimeOriginal", DATE),
    (306, "DateTime", DATE),
    (271, "Make", None),
    (272, "Model", None),
    (34855, "ISOSpeedRatings", None),
    (41991, "GainControl", None),
)
# TIFF tags: block of EXIF tags, ImageDescription, XResolution and ResolutionUnit.
EXIF, DESCRIPTION, X_RESOLUTION, RESOLUTION_UNIT = 34665, 270, 282, 296
# Characters of a description within which OME-XML begins.
OME_START = 2000
# Metres per unit of the tag ResolutionUnit (TIFF 6.0).
RESOLUTION_UNIT_M = {2: 0.0254, 3: 0.01}
# Range of pixel pitches of sensors [m]: outside it, the resolution is that of a printer, which most programs write.
PITCHES_M = (0.5e-6, 100e-6)
# Larger numbers in tags are rejected as misread.
LARGEST_NUMBER = 10**6
# Beginnings of keys that ImageMagick writes about the file, not the frame.
IMAGEMAGICK_KEYS = ("date:", "tiff:", "png:", "software")


def read_tiff_tags(path: Path) -> Iterator[MetadataEntry]:
    """Yield the metadata of every page of a TIFF file.

    Raises `ImageError` if the chain of its pages is broken, and what tifffile raises for a file that is broken
    otherwise.
    """
    entries = list[MetadataEntry]()
    with tiff.open_directories(path) as (file, directories):
        previous_text = ""
        for page_number, page in enumerate(directories):
            entries += _read_page_tags(page, page_number)
            text = page.tags.valueof(DESCRIPTION, "")
            # A description that all pages repeat is read on the first page alone, as it describes the whole stack.
            if not isinstance(text, str) or not text or text == previous_text:
                continue
            previous_text = text
            if text.lstrip().startswith("<") and "<OME" in text[:OME_START]:
                entries += ome.parse_ome_xml(text[: key_values.LONGEST_TEXT])
            elif page_number == 0 and text.startswith("ImageJ="):
                entries += _read_imagej(file, text)
            else:
                entries += key_values.parse_text(text, "TIFF tag 270 ImageDescription", page_number)
    # A source that occurs on the first page alone describes the whole stack.
    sources_of_later_pages = {entry.source for entry in entries if entry.page}
    for entry in entries:
        is_of_stack = entry.page == 0 and entry.source not in sources_of_later_pages
        yield replace(entry, page=None) if is_of_stack else entry


def _read_page_tags(page: tifffile.TiffPage, page_number: int) -> Iterator[MetadataEntry]:
    """Yield the metadata in the tags and the EXIF block of a page, and the pixel pitch of its resolution."""
    exif = page.tags.valueof(EXIF, {})
    exif = exif if isinstance(exif, dict) else {}
    for code, name, column in TAGS:
        yield from _convert_tag(page.tags.valueof(code), f"TIFF tag {code}", name, column, page_number)
        yield from _convert_tag(exif.get(name), "EXIF", name, column, page_number)
    yield from _read_resolution(page, page_number)


def _convert_tag(value: Any, source: str, name: str, column: str | None, page: int | None) -> Iterator[MetadataEntry]:
    """Yield the entry of one of `TAGS`; none for the value None of a missing tag.

    EXIF stores times as fractions of seconds, and dates as texts. `source` is where the tag was found.
    """
    if value is None:
        return
    text = str(value).strip("\0 ")
    converted: float | str | None = None
    if column is None:
        text = f"{name} = {text}"
    elif column == DATE:
        converted = key_values.parse_date(text)
    else:
        converted = _convert_ratio(value)
        text = f"{converted:g} s" if converted else text
    yield MetadataEntry(column, converted, text[: key_values.LONGEST_SHOWN], f"{source} {name}", page)


def _convert_ratio(value: Any) -> float | None:
    """Return a positive number below `LARGEST_NUMBER`, stored as a number or as a pair (numerator, denominator).

    Returns None for any other value.
    """
    if isinstance(value, str | bytes):
        return None
    try:
        exact = Fraction(*value) if isinstance(value, tuple) and len(value) == 2 else Fraction(value)
        return float(exact) if 0 < exact < LARGEST_NUMBER else None
    except (ValueError, TypeError, ZeroDivisionError, OverflowError):
        return None


def _read_resolution(page: tifffile.TiffPage, page_number: int) -> Iterator[MetadataEntry]:
    """Yield the pixel pitch of the resolution tags, if it is one of a sensor, as an entry that is only shown."""
    # The unit is the inch (2) unless another one is stated (TIFF 6.0).
    pixels_per_unit = _convert_ratio(page.tags.valueof(X_RESOLUTION))
    unit = page.tags.valueof(RESOLUTION_UNIT, 2)
    if pixels_per_unit and isinstance(unit, int) and unit in RESOLUTION_UNIT_M:
        pitch_m = RESOLUTION_UNIT_M[unit] / pixels_per_unit
        if PITCHES_M[0] <= pitch_m <= PITCHES_M[1]:
            text = f"{1e6 * pitch_m:.6g} µm a pixel"
            yield MetadataEntry(None, None, text, "TIFF tag 282 XResolution", page_number)


def _read_imagej(file: tifffile.TiffFile, description: str) -> Iterator[MetadataEntry]:
    """Yield the metadata in ImageJ's description, its Info block, and the label of each slice."""
    yield from key_values.parse_text(description, "ImageJ description")
    metadata = file.imagej_metadata or {}
    if isinstance(metadata.get("Info"), str):
        yield from key_values.parse_text(metadata["Info"], "ImageJ Info")
    for page, label in enumerate(metadata.get("Labels") or ()):
        if isinstance(label, str):
            yield from key_values.parse_text(label, "ImageJ label of the slice", page)


def read_png_texts(path: Path) -> Iterator[MetadataEntry]:
    """Yield the metadata in the texts and the EXIF block of a PNG file. Raises what Pillow raises for a broken file."""
    with Image.open(path, formats=("PNG",)) as image:
        exif = image.getexif()
        inner_exif = exif.get_ifd(EXIF)
        texts = {key: text for key, text in image.info.items() if isinstance(key, str) and isinstance(text, str)}
    for key, text in texts.items():
        if key.lower().startswith(IMAGEMAGICK_KEYS):
            continue
        is_description = key_values.normalize_key(key) in ("description", "comment")
        if is_description or "\n" in text or text.lstrip()[:1] == "{":
            yield from key_values.parse_text(text, f"PNG text {key[:40]}")
        else:
            yield from key_values.parse_pairs([(key, text)], "PNG text")
    for code, name, column in TAGS:
        yield from _convert_tag(inner_exif.get(code, exif.get(code)), "EXIF", name, column, None)
