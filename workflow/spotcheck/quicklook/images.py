"""The images of a first look: arrays, files or a folder, and what their files say beside the pixels."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.metadata.entry import MetadataEntry, resolve_entries
from spotcheck.dataset.metadata.file_names import natural_sort_key
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import CHANNELS, MONOCHROME, Colour
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.formats.page import Page

# What of the labels a first look uses.
Z, PITCH, WAVELENGTH = "z_m", "sensor.pixel_pitch_m", "laser.wavelength_m"

Given = str | Path | np.ndarray | Iterable[str | Path | np.ndarray]


class Image(NamedTuple):
    """One image: its name, an array or a page of a file, rows and columns, the bits of a stored pixel (None: not whole
    numbers), what the file says of it, and which channel is taken of one that has colours."""

    name: str
    source: np.ndarray | Path
    shape: tuple[int, ...]
    page: int = 0
    bits: int | None = None
    labels: dict[str, MetadataEntry] | None = None
    colour: Colour = MONOCHROME

    def read(self) -> np.ndarray:
        """Pixels [rows, columns] in DN, NaN where masked or infinite. Raises `InputError` where all of them are."""
        if isinstance(self.source, Path):
            stored = files.read_pixels(self.source, self.page, self.name, self.colour, allow_floats=True)
        else:
            stored = self.source
        # A broken file may hold numbers that signal.
        with np.errstate(invalid="ignore"):
            pixels = np.ma.filled(np.ma.asanyarray(stored).astype(float), np.nan)
        known = np.isfinite(pixels)
        if not known.any():
            raise InputError(f"{self.name}: has no pixel that was measured; leave it out")
        return np.where(known, pixels, np.nan)

    def says(self, what: str) -> float | None:
        """What the file says of a quantity, by the name of its label."""
        label = (self.labels or {}).get(what)
        return float(label.value) if label is not None and label.value is not None else None


def images_of(given: Given) -> tuple[list[Image], list[str]]:
    """The images that are given, in their order; those of a folder by their names, numbers in the order of counting.

    Every page of a stack is an image. Files that cannot be read beside others that can are left out, and a sentence
    says why. Raises `InputError`.
    """
    if isinstance(given, str | Path) or getattr(given, "ndim", None) == 2:
        given = [given]  # type: ignore[list-item]
    out: list[Image] = []
    refused: list[InputError] = []
    for number, own in enumerate(given):
        if isinstance(own, str | Path):
            path = Path(own)
            for file in _in_folder(path) if path.is_dir() else [path]:
                if not (name := Path(split_inner_path(file.as_posix())[0])).exists():
                    raise InputError(f"{name}: no such file; name image files or a folder of them")
                try:
                    pages = list(_pages(file))
                    # What is broken may show only where pixels are read.
                    for image in pages:
                        image.read()
                    out += pages
                except InputError as error:
                    refused.append(error)
        else:
            out.append(_array(own, number))
            out[-1].read()
    if not out:
        raise refused[0] if refused else InputError("images: none is given; name image files or a folder of them")
    return out, [str(error) for error in refused]


def folder_of(path: Path) -> Path:
    """The folder that an image file lies in, or that is given itself."""
    return (path if path.is_dir() else Path(split_inner_path(path.as_posix())[0]).parent).resolve()


def common(images: Sequence[Image], what: str) -> tuple[float | None, str]:
    """What all files that speak of a quantity say of it, and where the first says so; None where they differ."""
    said = [label for image in images if (label := (image.labels or {}).get(what)) is not None]
    if not said or len({label.value for label in said}) > 1:
        return None, ""
    return float(said[0].value or 0.0), str(said[0])


def _in_folder(folder: Path) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "." and p.is_file()]
    if not found:
        below = next((p for p in sorted(folder.iterdir()) if p.is_dir() and p.name == "frames"), None)
        hint = f"; look at {below}" if below else "; name a folder with TIFF, PNG, PGM, HDF5 or .npy files"
        raise InputError(f"{folder}: holds no image{hint}")
    return sorted(found, key=lambda path: natural_sort_key(path.name))


def _pages(path: Path) -> Iterator[Image]:
    """Every page of every stack of a file that is an image of its own."""
    name, inside = split_inner_path(path.as_posix())
    file = Path(name)
    for stack in [f"{file.name}#{inside}"] if inside else files.list_stacks(file, file.name):
        source, labels = file.parent / stack, read_metadata(file, inner_path=split_inner_path(stack)[1])
        pages, colour = _coloured(source, stack)
        own = [(number, page) for number, page in enumerate(pages) if not page.preview]
        for number, page in own:
            name = stack if len(own) == 1 else f"{stack} page {number}"
            yield Image(name, source, page.shape, number, page.bits or None, resolve_entries(labels, number)[0], colour)


def _coloured(path: Path, name: str) -> tuple[list[Page], Colour]:
    """Pages of a stack, and of one with red, green and blue the channel that reads most: a laser lights one of them."""
    try:
        return files.list_pages(path, name, allow_floats=True), MONOCHROME
    except InputError as refused:
        try:
            pages = files.list_pages(path, name, Colour(CHANNELS[0]), allow_floats=True)
        except InputError:
            raise refused from None
    light = {own: files.read_pixels(path, 0, name, Colour(own), allow_floats=True).sum(dtype=float) for own in CHANNELS}
    return pages, Colour(max(light, key=light.__getitem__))


def _array(pixels: np.ndarray, number: int) -> Image:
    array = np.ma.asanyarray(pixels)
    if array.ndim != 2 or array.dtype.kind not in "uif" or not array.size:
        raise InputError(
            f"images: number {number} has the shape {array.shape} and the type {array.dtype}; each must be numbers"
            " [rows, columns]"
        )
    bits = 8 * array.dtype.itemsize if array.dtype.kind == "u" else None
    return Image(f"image {number}", array, array.shape, 0, bits)
