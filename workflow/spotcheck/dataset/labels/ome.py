"""OME-XML of a TIFF: what it says of every plane (OME schema 2016-06, elements Pixels, Plane and TiffData)."""

from collections.abc import Iterator
from datetime import datetime, timedelta
from itertools import islice, product
from xml.etree import ElementTree

from spotcheck.dataset.labels import units
from spotcheck.dataset.labels.label import Label
from spotcheck.dataset.labels.words import date_in

# Planes that are looked at.
MOST_PLANES = 100_000
# What else the header of an image says, as we show it.
BESIDE = (("Detector", "Gain"), ("DetectorSettings", "Gain"), ("DetectorSettings", "Offset"), ("Detector", "Model"))


def labels_in(text: str) -> Iterator[Label]:
    """Labels of the pages that OME-XML describes. Raises what the parser of XML raises, and `ValueError`."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares entities, which are not read")
    root = ElementTree.fromstring(text)
    for image in _all(root, "Image"):
        for pixels in _all(image, "Pixels"):
            yield from _of_pixels(image, pixels)
    for element, name in BESIDE:
        for own in _all(root, element):
            if value := own.get(name):
                yield Label(None, None, f"{element} {name} = {value}"[:60], f"OME-XML {element}")


def _of_pixels(image: ElementTree.Element, pixels: ElementTree.Element) -> Iterator[Label]:
    page_of = _pages(pixels)
    if pixels.get("SignificantBits", "").isdecimal():
        bits = pixels.get("SignificantBits", "")[:4]
        yield Label("sensor.bit_depth", int(bits), f"SignificantBits = {bits}", "OME-XML Pixels SignificantBits")
    if size := _number(pixels, "PhysicalSizeX", "m", "µm"):
        # What lies on a pixel, not the pixel: both are one only where nothing magnifies.
        yield Label(None, None, size.text, size.where)
    date = next((date_in(own.text or "") for own in _all(image, "AcquisitionDate")), None)
    for plane in islice(_all(pixels, "Plane"), MOST_PLANES):
        page = page_of.get(tuple(_whole(plane, f"The{axis}") for axis in "ZCT"))
        if page is None:
            continue
        for name, column, kind, default in (
            ("ExposureTime", "exposure_s", "s", "s"),
            # Without a unit it is in that of the stage, which the file does not say (schema: "reference frame").
            ("PositionZ", "z_m", "m", ""),
        ):
            if found := _number(plane, name, kind, default):
                yield found._replace(column=column, page=page)
        delta = _number(plane, "DeltaT", "s", "s")
        if date and delta and isinstance(delta.value, float) and 0 <= delta.value < 1e9:
            at = datetime.fromisoformat(date) + timedelta(seconds=delta.value)
            where = "OME-XML AcquisitionDate + Plane DeltaT"
            yield Label("date", at.isoformat(), f"{date} + {delta.text}", where, page)
        elif date:
            yield Label("date", date, date, "OME-XML AcquisitionDate", page)


def _number(element: ElementTree.Element, name: str, kind: str, default: str) -> Label | None:
    """A number with its unit, whose column is to be set; its value is None where it has no unit."""
    value, unit = element.get(name), element.get(f"{name}Unit", default)
    if value is None:
        return None
    known = units.kind_of(unit) == kind
    where = f"OME-XML {element.tag.rpartition('}')[2]} {name}"
    return Label(
        None, units.scaled(value, unit, kind) if known else None, f"{name} = {value} {unit}".strip()[:60], where
    )


def _pages(pixels: ElementTree.Element) -> dict[tuple[int, ...], int]:
    """Page of this file for every plane (Z, C, T)."""
    sizes = {axis: min(max(_whole(pixels, f"Size{axis}", 1), 1), MOST_PLANES) for axis in "ZCT"}
    order = [axis for axis in pixels.get("DimensionOrder", "XYZCT")[2:] if axis in "ZCT"]
    if sorted(order) != ["C", "T", "Z"]:
        raise ValueError("its DimensionOrder is none")
    # The first axis of the order runs fastest.
    ordered = (
        dict(zip(reversed(order), place, strict=True)) for place in product(*(range(sizes[a]) for a in reversed(order)))
    )
    planes = [tuple(own[axis] for axis in "ZCT") for own in islice(ordered, MOST_PLANES)]
    place_of = {plane: place for place, plane in enumerate(planes)}
    found: dict[tuple[int, ...], int] = {}
    for data in _all(pixels, "TiffData"):
        if any(own.get("FileName") for own in _all(data, "UUID")) and len(list(_all(pixels, "TiffData"))) > 1:
            # Of a dataset in several files: ours is not told from the others' by what stands here.
            names = {own.get("FileName") for own in _all(pixels, "UUID")}
            if len(names) > 1:
                raise ValueError("it describes planes of several files, which are not told apart")
        first = place_of.get(tuple(_whole(data, f"First{axis}") for axis in "ZCT"), 0)
        count = _whole(data, "PlaneCount", 1 if data.get("IFD") is not None else len(planes))
        for step in range(min(count, len(planes) - first)):
            found.setdefault(planes[first + step], _whole(data, "IFD") + step)
    return found or place_of


def _whole(element: ElementTree.Element, name: str, default: int = 0) -> int:
    text = element.get(name, "")
    return int(text) if text.isdecimal() and len(text) < 10 else default


def _all(element: ElementTree.Element, tag: str) -> Iterator[ElementTree.Element]:
    """Elements of that name below one, in whichever version of the schema's name space."""
    return (own for own in element.iter() if isinstance(own.tag, str) and own.tag.rpartition("}")[2] == tag)
