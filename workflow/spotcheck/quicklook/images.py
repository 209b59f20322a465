"""Input images of a first look: arrays, files or folders, with the metadata that their files state.

Impossible readings are constants in place of measured readings (`dataset.impossible_readings`). Most are in the `mask`
of `ImpossibleReadings`; those of faint light that a threshold cut off are in `is_cut`.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePath

import numpy as np

from spotcheck.dataset.impossible_readings import ImpossibleReadings, find_impossible_readings
from spotcheck.dataset.metadata.entry import MetadataEntry, resolve_entries
from spotcheck.dataset.metadata.file_names import find_signed_words, natural_sort_key, parse_name, restore_sign
from spotcheck.dataset.metadata.log_tables import TableReader
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import CHANNELS, MONOCHROME, Colour
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.formats.page import ImageError, Page
from spotcheck.io.formats.pixel_checks import check_byte_order

# Column and key of the metadata that a first look uses beside the pixel pitch: position along the beam, wavelength.
Z, WAVELENGTH = "z_m", "laser.wavelength_m"
# Most unreadable pages of a file that are reported one by one.
MOST_ERRORS = 5

# Most bits of a reading of a camera.
CAMERA_BITS = 16
NO_IMPOSSIBLE_READINGS = ImpossibleReadings(np.zeros((0, 0), bool), np.zeros((0, 0), bool), {})

ImageInput = str | Path | np.ndarray | Iterable[str | Path | np.ndarray]


@dataclass(frozen=True, eq=False)
class Image:
    """One image: an array, or a page of a file."""

    name: str  # file name, with the page of a stack; "image N" for an array
    source: np.ndarray | Path  # readings [rows, columns] in DN, or the path of the file or stack
    shape: tuple[int, ...]  # rows, columns [px]
    page: int = 0  # page of the stack, from 0
    bits: int | None = None  # bits of a stored pixel; None unless pixels are unsigned integers
    metadata: dict[str, MetadataEntry] = field(default_factory=dict)  # what the file states, by column or key
    colour: Colour = MONOCHROME  # channel to read from a colour image
    unclear: dict[str, str] = field(default_factory=dict)  # what the file states and is not used, by column or key

    def read(self) -> np.ndarray:
        """Return the readings [rows, columns] in DN as a new float64 array, NaN where not measured.

        Pixels that were not measured are masked ones, infinite or NaN ones, and those with impossible readings. Raises
        `InputError` if no reading is finite.
        """
        pixels, is_finite = self._read_finite()
        if not is_finite.any():
            raise InputError(f"{self.name}: has no pixel that was measured; leave it out")
        if self.impossible_readings.counts:
            is_finite &= ~self.impossible_readings.is_unmeasured
        return np.where(is_finite, pixels, np.nan)

    @cached_property
    def impossible_readings(self) -> ImpossibleReadings:
        """Impossible readings; none unless pixels are unsigned integers of at most 16 bits, as cameras give them."""
        pixels, is_finite = self._read_finite()
        # ASSUME: other numbers are results of a computation, in which any number may be frequent.
        if self.bits is None or self.bits > CAMERA_BITS:
            return NO_IMPOSSIBLE_READINGS
        impossible = find_impossible_readings(np.where(is_finite, pixels, 0).astype(np.uint16), ~is_finite)
        # An empty mask takes no memory while other images are analysed.
        return impossible if impossible.counts else NO_IMPOSSIBLE_READINGS

    def _read_finite(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the readings [rows, columns] in DN as float64, and the mask of those that are finite."""
        if isinstance(self.source, Path):
            stored_pixels = files.read_pixels(self.source, self.page, self.name, self.colour, allow_floats=True)
        else:
            stored_pixels = self.source
        # A damaged file may hold signalling NaN, which would warn.
        with np.errstate(invalid="ignore"):
            pixels = np.ma.filled(np.ma.asanyarray(stored_pixels).astype(float), np.nan)
        return pixels, np.isfinite(pixels)

    def stated_value(self, key: str) -> float | None:
        """Return the number that the file states for a column or key, in its unit; None if it states none."""
        entry = self.metadata.get(key)
        return float(entry.value) if entry is not None and entry.value is not None else None


def open_images(inputs: ImageInput) -> tuple[list[Image], list[str]]:
    """Open images and check that their pixels can be read.

    Every page of a stack is an image. The files of a folder are sorted by name, with numbers in numerical order.
    Unreadable files and pages are skipped if at least one image is readable.

    Parameters
    ----------
    inputs : array [rows, columns] in DN, file, folder, or several of them.

    Returns
    -------
    images : list of Image
        The images, in the order of the inputs.
    errors : list of str
        One sentence for each skipped file or page; those of a file with many skipped pages end in their number.

    Raises
    ------
    InputError
        A file is missing, a folder holds no image, an array is not an image, or no file is readable.
    """
    if isinstance(inputs, str | Path) or getattr(inputs, "ndim", None) == 2:
        inputs = [inputs]  # type: ignore[list-item]
    images: list[Image] = []
    errors: list[InputError] = []
    tables = TableReader()
    items = list(inputs)
    files_of_item = [_list_files(Path(item)) if isinstance(item, str | Path) else [] for item in items]
    names = {PurePath(split_inner_path(file.as_posix())[0]).stem for listed in files_of_item for file in listed}
    signed_words = find_signed_words(entry for name in names for entry in parse_name(name))
    for number, (item, listed_files) in enumerate(zip(items, files_of_item, strict=True)):
        if not isinstance(item, str | Path):
            images.append(_wrap_array(item, number))
            images[-1].read()
            continue
        for file in listed_files:
            try:
                pages = list(_open_pages(file, tables, signed_words))
            except InputError as error:
                errors.append(error)
                continue
            readable_pages, page_errors = _select_readable(pages, file.name)
            images += readable_pages
            errors += page_errors
    if not images:
        raise errors[0] if errors else InputError("images: none is given; name image files or a folder of them")
    return images, [str(error) for error in errors]


def _select_readable(pages: Sequence[Image], name: str) -> tuple[list[Image], list[InputError]]:
    """Return the pages of a file whose pixels can be decoded and hold a reading, and the errors of the others.

    If no page is readable, only the first error is returned. If more than `MOST_ERRORS` pages are not, one error with
    their number replaces those beyond the first `MOST_ERRORS`. `name` is the name of the file in that error.
    """
    readable_pages: list[Image] = []
    errors: list[InputError] = []
    for image in pages:
        try:
            image.read()
            readable_pages.append(image)
        except InputError as error:
            errors.append(error)
    if not readable_pages:
        return [], errors[:1]
    more = len(errors) - MOST_ERRORS
    if more > 0:
        errors[MOST_ERRORS:] = [InputError(f"{name}: {more} more pages cannot be read; leave them out")]
    return readable_pages, errors


def find_folder(path: Path) -> Path:
    """Return the absolute path of a folder, or of the folder that holds an image file."""
    return (path if path.is_dir() else Path(split_inner_path(path.as_posix())[0]).parent).resolve()


def find_common_value(images: Sequence[Image], key: str) -> tuple[float | None, str]:
    """Return the number that files state for a column or key, in its unit, and its source in words.

    Images whose file does not state it do not count. Returns (None, "") if no file states it or files disagree.
    """
    entries = [entry for image in images if (entry := image.metadata.get(key)) is not None]
    if not entries or len({entry.value for entry in entries}) > 1:
        return None, ""
    return float(entries[0].value or 0.0), str(entries[0])


def _list_files(path: Path) -> list[Path]:
    """Return the image files of a folder in natural order, or the file itself, perhaps with a path inside it.

    Raises `InputError` for a missing file and for a folder without images.
    """
    if not path.is_dir():
        if not (file := Path(split_inner_path(path.as_posix())[0])).exists():
            raise InputError(f"{file}: no such file; name image files or a folder of them")
        return [path]
    images = [p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "." and p.is_file()]
    if not images:
        frames = path / "frames"
        hint = f"; look at {frames}" if frames.is_dir() else "; name a folder with TIFF, PNG, PGM, HDF5 or .npy files"
        raise InputError(f"{path}: holds no image{hint}")
    return sorted(images, key=lambda file: natural_sort_key(file.name))


def _open_pages(path: Path, tables: TableReader, signed_words: Collection[str]) -> Iterator[Image]:
    """Yield every page of every stack of a file, or of the stack at the path inside it, without previews.

    `tables` has read the tables of the folders for earlier files. `signed_words` are those of
    `file_names.find_signed_words`. Raises `InputError`.
    """
    name, inner_path = split_inner_path(path.as_posix())
    file = Path(name)
    for stack in [f"{file.name}#{inner_path}"] if inner_path else files.list_stacks(file, file.name):
        source = file.parent / stack
        pages, colour = _list_pages(source, stack)
        stated = read_metadata(file, None, split_inner_path(stack)[1], len(pages), tables)
        entries = [restore_sign(entry, signed_words) for entry in stated]
        image_pages = [(page_number, page) for page_number, page in enumerate(pages) if not page.preview]
        for page_number, page in image_pages:
            title = stack if len(image_pages) == 1 else f"{stack} page {page_number}"
            metadata, conflicts = resolve_entries(entries, page_number)
            unclear = _describe_unclear([entry for entry in entries if entry.page in (None, page_number)])
            unclear |= {column: f"{first}, but {second}" for column, (first, second) in conflicts.items()}
            # Pages of floating-point numbers have 0 bits.
            yield Image(title, source, page.shape, page_number, page.bits or None, metadata, colour, unclear)


def _describe_unclear(entries: Sequence[MetadataEntry]) -> dict[str, str]:
    """Return for each column the first entry without a value as a clause that says what it leaves open."""
    return {
        entry.column: f"{entry}: {entry.question or ('which unit?' if entry.number else 'no value with a known unit')}"
        for entry in reversed(entries)
        if entry.column and entry.value is None
    }


def _list_pages(path: Path, name: str) -> tuple[list[Page], Colour]:
    """Return the page headers of a stack, and the colour plane to read from its pages.

    The plane is `MONOCHROME` for images without colours. For RGB images it is the channel that is brightest on the
    first page, since a laser excites mainly one. `name` is the name of the stack in messages. Raises `InputError` if
    the stack is neither of one channel nor of RGB.
    """
    try:
        return files.list_pages(path, name, allow_floats=True), MONOCHROME
    except InputError as monochrome_error:
        # The headers of RGB images are the same for each channel.
        try:
            pages = files.list_pages(path, name, Colour(CHANNELS[0]), allow_floats=True)
        except InputError:
            raise monochrome_error from None
    sums = {channel: files.read_pixels(path, 0, name, Colour(channel), allow_floats=True).sum(dtype=float)
            for channel in CHANNELS}  # fmt: skip
    return pages, Colour(max(sums, key=sums.__getitem__))


def _wrap_array(pixels: np.ndarray, number: int) -> Image:
    """Return an array as an image; `number` is its position in the inputs, from 0.

    Raises `InputError` if it is not two-dimensional and numeric, or if its readings of 16 bits were decoded in the
    wrong byte order.
    """
    array = np.ma.asanyarray(pixels)
    if array.ndim != 2 or array.dtype.kind not in "uif" or not array.size:
        raise InputError(
            f"images: number {number} has the shape {array.shape} and the type {array.dtype}; each must be numbers"
            " [rows, columns]"
        )
    # The check takes numbers in native order. It finds bytes that are swapped in the numbers themselves.
    try:
        check_byte_order(np.ma.getdata(array).astype(array.dtype.newbyteorder("="), copy=False))
    except ImageError as error:
        raise InputError(f"image {number}: {error}") from None
    bits = 8 * array.dtype.itemsize if array.dtype.kind == "u" else None
    return Image(f"image {number}", array, array.shape, 0, bits)
