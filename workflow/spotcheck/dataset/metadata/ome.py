"""OME-XML in a TIFF file: metadata of every plane (OME schema 2016-06, elements Pixels, Plane and TiffData).

A plane is a two-dimensional image at one focus (Z), channel (C) and time (T); it is stored as a page of a file.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import islice, product
from xml.etree.ElementTree import Element, fromstring

from spotcheck.dataset.metadata import units
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.dataset.metadata.key_values import LONGEST_SHOWN, parse_date, parse_pair

# Most planes that are read, and most digits of a whole number.
MOST_PLANES, MOST_DIGITS = 100_000, 9
# Longest delay of a plane that is believed [s], some 30 years; much longer ones would exceed the range of dates.
LONGEST_DELAY_S = 1e9
# Elements and attributes that are shown to the user, but not used.
SHOWN = (("Detector", "Gain"), ("DetectorSettings", "Gain"), ("DetectorSettings", "Offset"), ("Detector", "Model"))


def parse_ome_xml(text: str) -> Iterator[MetadataEntry]:
    """Yield the metadata of the pages that an OME-XML text describes.

    Raises
    ------
    xml.etree.ElementTree.ParseError
        If the text is not XML.
    ValueError
        If the text declares entities, or if its planes cannot be assigned to the pages of this file.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares entities, which are not read")
    root = fromstring(text)
    for image in _find_all(root, "Image"):
        for pixels in _find_all(image, "Pixels"):
            yield from _parse_pixels(image, pixels)
    for settings in _find_all(root, "DetectorSettings"):
        if binning := settings.get("Binning"):
            yield parse_pair("Binning", binning, "OME-XML DetectorSettings")
    for tag, name in SHOWN:
        for element in _find_all(root, tag):
            if value := element.get(name):
                yield MetadataEntry(None, None, f"{tag} {name} = {value}"[:LONGEST_SHOWN], f"OME-XML {tag}")


def _parse_pixels(image: Element, pixels: Element) -> Iterator[MetadataEntry]:
    """Yield the metadata of an element Pixels, which belongs to an element Image, and of its planes."""
    page_of_plane = _assign_pages(pixels)
    if pixels.get("SignificantBits", "").isdecimal():
        bits = pixels.get("SignificantBits", "")[:4]
        source = "OME-XML Pixels SignificantBits"
        yield MetadataEntry("sensor.bit_depth", int(bits), f"SignificantBits = {bits}", source)
    if size := _parse_quantity(pixels, "PhysicalSizeX", "m", "µm"):
        # The size in the sample, which is the pixel pitch only at magnification 1: shown, not used.
        yield replace(size, value=None)
    date = next((parse_date(element.text or "") for element in _find_all(image, "AcquisitionDate")), None)
    for plane in islice(_find_all(pixels, "Plane"), MOST_PLANES):
        page = page_of_plane.get(tuple(_parse_integer(plane, f"The{axis}") for axis in "ZCT"))
        if page is not None:
            yield from _parse_plane(plane, page, date)


def _parse_plane(plane: Element, page: int, date: str | None) -> Iterator[MetadataEntry]:
    """Yield exposure time, position and date of a plane, which is a page of this file.

    `date` is that of the whole image in ISO 8601; without it (None), the plane has none.
    """
    if exposure := _parse_quantity(plane, "ExposureTime", "s", "s"):
        yield replace(exposure, column="exposure_s", page=page)
    # A position without a unit is in the unit of the stage (schema: "reference frame"), which the file does not state.
    if position := _parse_quantity(plane, "PositionZ", "m", ""):
        yield replace(position, column="z_m", page=page)
    if date is None:
        return
    # DeltaT is the time between AcquisitionDate and the plane.
    delay = _parse_quantity(plane, "DeltaT", "s", "s")
    if delay and isinstance(delay.value, float) and 0 <= delay.value < LONGEST_DELAY_S:
        time = datetime.fromisoformat(date) + timedelta(seconds=delay.value)
        source = "OME-XML AcquisitionDate + Plane DeltaT"
        yield MetadataEntry("date", time.isoformat(), f"{date} + {delay.text}", source, page)
    else:
        yield MetadataEntry("date", date, date, "OME-XML AcquisitionDate", page)


def _parse_quantity(element: Element, name: str, dimension: str, default_unit: str) -> MetadataEntry | None:
    """Return an attribute that is a number with a unit, as an entry without a column; None without the attribute.

    `dimension` is a key of `units.UNITS`. The value of the entry is None if its unit is missing or unknown.
    """
    text, unit = element.get(name), element.get(f"{name}Unit", default_unit)
    if text is None:
        return None
    value = units.convert_quantity(text, unit, dimension)
    source = f"OME-XML {element.tag.rpartition('}')[2]} {name}"
    number = "" if unit or not re.fullmatch(units.NUMBER_PATTERN, text) else text
    return MetadataEntry(None, value, f"{name} = {text} {unit}".strip()[:LONGEST_SHOWN], source, number=number)


def _assign_pages(pixels: Element) -> dict[tuple[int, ...], int]:
    """Return the page of this file that holds each plane (Z, C, T).

    Raises `ValueError` for an unknown order of dimensions, and for planes that are spread over several files.
    """
    sizes = {axis: min(max(_parse_integer(pixels, f"Size{axis}", 1), 1), MOST_PLANES) for axis in "ZCT"}
    order = [axis for axis in pixels.get("DimensionOrder", "XYZCT")[2:] if axis in "ZCT"]
    if sorted(order) != ["C", "T", "Z"]:
        raise ValueError("its DimensionOrder is none")
    # The first axis of the order runs fastest, but `product` varies its last argument fastest.
    slowest_first = order[::-1]
    indices = islice(product(*(range(sizes[axis]) for axis in slowest_first)), MOST_PLANES)
    planes = [tuple(index[slowest_first.index(axis)] for axis in "ZCT") for index in indices]
    position_of = {plane: position for position, plane in enumerate(planes)}
    page_of: dict[tuple[int, ...], int] = {}
    # Each element TiffData assigns a run of planes to pages (IFD); without such elements the planes are the pages.
    elements = list(_find_all(pixels, "TiffData"))
    file_names = {uuid.get("FileName") for uuid in _find_all(pixels, "UUID")}
    if len(elements) > 1 and len(file_names) > 1:
        raise ValueError("it describes planes of several files, which are not told apart")
    for element in elements:
        first_position = position_of.get(tuple(_parse_integer(element, f"First{axis}") for axis in "ZCT"), 0)
        plane_count = _parse_integer(element, "PlaneCount", 1 if element.get("IFD") is not None else len(planes))
        for offset in range(min(plane_count, len(planes) - first_position)):
            page_of.setdefault(planes[first_position + offset], _parse_integer(element, "IFD") + offset)
    return page_of or position_of


def _parse_integer(element: Element, name: str, default: int = 0) -> int:
    """Return an attribute that is a whole number of at most `MOST_DIGITS` digits, or else the default."""
    text = element.get(name, "")
    return int(text) if text.isdecimal() and len(text) <= MOST_DIGITS else default


def _find_all(element: Element, tag: str) -> Iterator[Element]:
    """Yield the elements below an element whose tag is `tag`, in any version of the schema's namespace."""
    return (child for child in element.iter() if isinstance(child.tag, str) and child.tag.rpartition("}")[2] == tag)
