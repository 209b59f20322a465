"""Metadata in sidecar files: texts beside an image that have its name."""

from collections.abc import Iterator
from pathlib import Path

from spotcheck.dataset.metadata import key_values
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.errors import InputError
from spotcheck.io import schema
from spotcheck.io.text import read_text

TEXT_SUFFIXES = (".txt", ".json", ".yaml", ".yml", ".xml")


def find_sidecars(image: Path) -> list[Path]:
    """Return the text files with the name of an image: a.json and a.tif.json for a.tif."""
    paths = [image.with_suffix(suffix) for suffix in TEXT_SUFFIXES]
    paths += [image.with_name(image.name + suffix) for suffix in TEXT_SUFFIXES]
    return [path for path in paths if path.is_file()]


def read_sidecars(image: Path) -> Iterator[MetadataEntry]:
    """Yield the metadata that sidecar files give for an image. Raises `InputError` if one cannot be read."""
    for path in find_sidecars(image):
        source = f"side file {path.name}"
        size = path.stat().st_size
        if size > key_values.LONGEST_TEXT:
            raise InputError(
                f"{path.name}: has {size} bytes, but a text beside an image has at most {key_values.LONGEST_TEXT};"
                " move it away"
            )
        if path.suffix.lower() in (".yaml", ".yml"):
            yield from key_values.parse_pairs(key_values.flatten_keys(schema.read_keys(path)), source)
        else:
            yield from key_values.parse_text(read_text(path), source)
