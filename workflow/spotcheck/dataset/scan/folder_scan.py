"""The frames in a folder of images, page by page, with their metadata."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from spotcheck.dataset.folder import is_hidden
from spotcheck.dataset.metadata import sidecar
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.dataset.metadata.file_names import find_signed_words, natural_sort_key, restore_sign
from spotcheck.dataset.metadata.log_tables import TableReader
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.text import join_first, replace_unprintable

# Most names of rows that a remark lists.
MOST_LISTED = 5


@dataclass(frozen=True)
class ScannedFrame:
    """One frame of a folder of images."""

    file: str  # path relative to the folder, perhaps with a path inside an HDF5 file behind #
    page: int  # page of the file, from 0
    shape: tuple[int, int]  # rows and columns [px]
    bits: int  # bits of a stored pixel
    metadata: tuple[MetadataEntry, ...]  # what all sources give about this page, the most exact first


class FolderScan(NamedTuple):
    """The result of scanning a folder."""

    frames: tuple[ScannedFrame, ...]  # in the natural order of their file names
    unread_files: tuple[str, ...]  # paths of files that are neither images nor metadata
    errors: tuple[str, ...]  # one message for each image that cannot be read
    table_remarks: tuple[str, ...] = ()  # one sentence for each table with rows that describe no image


def scan_folder(folder: Path, colour: Colour = MONOCHROME) -> FolderScan:
    """Return the frames and metadata of a folder of images. Images that cannot be read are listed as errors.

    Parameters
    ----------
    folder : folder whose frames/ is searched for images, or the whole tree below it if frames/ has none.
    colour : colour plane to read from images with colours.

    Raises
    ------
    InputError
        If the name of an image contains characters that cannot be printed.
    """
    visible_files = [path for path in folder.rglob("*") if path.is_file() and not is_hidden(path.relative_to(folder))]
    images = _select_images(folder, visible_files)
    frames, errors, read_files = list[ScannedFrame](), list[str](), set(images)
    tables, table_folders = TableReader(), set[Path]()
    for image in images:
        name = image.relative_to(folder).as_posix()
        if not name.isprintable():
            raise InputError(f"{name!r}: the name contains characters that cannot be printed; rename the file")
        try:
            frames += _scan_image(image, folder, colour, tables)
        except InputError as error:
            errors.append(str(error))
            continue
        read_files.update(sidecar.find_sidecars(image))
        # Tables are searched in the folder of an image and in its parent.
        table_folders.update(image.parents[:2])
    for table_folder in table_folders:
        read_files.update(tables.find_tables(table_folder))
    # The results of an earlier scan are no sources.
    read_files.update((folder / "manifest.csv", folder / "instrument.yaml"))
    unread_paths = (path.relative_to(folder).as_posix() for path in visible_files if path not in read_files)
    unread_files = sorted(map(replace_unprintable, unread_paths))
    signed_words = find_signed_words(entry for frame in frames for entry in frame.metadata)
    signed_frames = (
        replace(frame, metadata=tuple(restore_sign(entry, signed_words) for entry in frame.metadata))
        for frame in frames
    )
    files_with_frames = {split_inner_path(frame.file)[0] for frame in frames}
    unread_images = [image for image in images if image.relative_to(folder).as_posix() not in files_with_frames]
    table_remarks = _remark_on_tables(folder, images, tables, table_folders, unread_images)
    return FolderScan(tuple(signed_frames), tuple(unread_files), tuple(errors), tuple(table_remarks))


def _remark_on_tables(
    folder: Path,
    images: Sequence[Path],
    tables: TableReader,
    table_folders: Collection[Path],
    unread_images: Sequence[Path],
) -> Iterator[str]:
    """Yield a sentence for each table below a folder with rows that describe no image.

    `tables` has read the tables of `table_folders` for all images but `unread_images`, whose rows do not count. Tables
    elsewhere count if they name an image.
    """
    names = {name.casefold() for image in images for name in (image.name, image.stem)}
    unread_names = {name.casefold() for image in unread_images for name in (image.name, image.stem)}
    for table_folder in sorted({parent for image in images for parent in image.parents}):
        if not table_folder.is_relative_to(folder):
            continue
        for table, (unused_rows, row_count) in tables.list_unused_rows(table_folder).items():
            name = table.relative_to(folder).as_posix()
            rows = [row for row in unused_rows if row.path[-1].casefold() not in unread_names]
            if table_folder not in table_folders:
                if any(row.path[-1].casefold() in names for row in rows):
                    yield f"{name}: its images are more than one folder below it; move it to them, or one folder above"
                continue
            if not rows:
                continue
            listed = join_first([row.name for row in rows], MOST_LISTED)
            if len(rows) == row_count:
                yield f"{name}: no row matches an image ({listed}); write the file names of the images"
            else:
                yield f"{name}: {len(rows)} of {row_count} rows match no image ({listed})"


def _select_images(folder: Path, visible_files: list[Path]) -> list[Path]:
    """Return the images in frames/, or all images below the folder if frames/ has none, in natural order."""
    images = [path for path in visible_files if path.suffix.lower() in IMAGE_SUFFIXES]
    # A manifest names no file outside its folder, so links to such files are dropped.
    images = [path for path in images if path.resolve().is_relative_to(folder.resolve())]
    images = [path for path in images if (folder / "frames") in path.parents] or images
    return sorted(images, key=lambda path: natural_sort_key(path.relative_to(folder).as_posix()))


def _scan_image(image: Path, folder: Path, colour: Colour, tables: TableReader) -> Iterator[ScannedFrame]:
    """Yield the frames of all stacks in an image file, without previews. Raises `InputError` if one is unreadable.

    `tables` has read the tables of the folders for earlier images.
    """
    stacks = files.list_stacks(image, image.relative_to(folder).as_posix())
    # The headers of all stacks are read first, so that a file with an unreadable stack gives no frame.
    pages_by_stack = {stack: files.list_pages(folder / stack, stack, colour) for stack in stacks}
    for stack, pages in pages_by_stack.items():
        entries = read_metadata(image, folder, split_inner_path(stack)[1], len(pages), tables)
        for page_number, page in enumerate(pages):
            if not page.preview:
                page_entries = tuple(entry for entry in entries if entry.page in (None, page_number))
                yield ScannedFrame(stack, page_number, page.shape, page.bits, page_entries)
