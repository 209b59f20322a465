"""All metadata of an image file: inside it, beside it, and in its name."""

from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from spotcheck.dataset.metadata import file_names, key_values, sidecar, tags
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.dataset.metadata.log_tables import TableReader
from spotcheck.io.formats import files, hdf5, png, tiff

# First bytes of a file, name in messages, and reader of each image format with metadata. HDF5 has a reader of another
# form, which also needs the path inside the file.
READERS: tuple[tuple[tuple[bytes, ...], str, Callable[[Path], Iterator[MetadataEntry]]], ...] = (
    (tiff.SIGNATURES, "TIFF tags", tags.read_tiff_tags),
    ((png.SIGNATURE,), "PNG texts", tags.read_png_texts),
)


def read_metadata(
    path: Path,
    root: Path | None = None,
    inner_path: str = "",
    page_count: int | None = None,
    tables: TableReader | None = None,
) -> tuple[MetadataEntry, ...]:
    """Return the metadata of an image file, the most exact sources first: tags, sidecar files, tables, then names.

    Parameters
    ----------
    path : the image file.
    root : folder below which names of folders are parsed too; None for the file name alone.
    inner_path : path of the frames inside an HDF5 file; "" for other files and for the only frames of a file.
    page_count : number of pages of these frames; None if it is not known.
    tables : reader that has read the tables of folders for other images; None to read them for this image alone.

    Returns
    -------
    tuple of MetadataEntry
        For each source that cannot be read, an entry without a column gives the reason.
    """
    entries: list[MetadataEntry] = []
    with path.open("rb") as stream:
        first_bytes = stream.read(files.SIGNATURE_BYTES)
    for signatures, source, reader in READERS:
        if first_bytes.startswith(signatures):
            entries += _collect(reader(path), source)
    if first_bytes.startswith(hdf5.SIGNATURE):
        entries += _collect(_read_hdf5(path, inner_path), "HDF5")
    entries += _collect(sidecar.read_sidecars(path), "side file")
    entries += _collect((tables or TableReader()).read_entries(path, page_count), "table")
    entries += file_names.parse_path(path.relative_to(root) if root else PurePath(path.name), inner_path)
    return tuple(entries)


def _read_hdf5(path: Path, inner_path: str) -> Iterator[MetadataEntry]:
    """Yield the attributes of the frames in an HDF5 file, and the numbers and texts beside them."""
    for key, value, page in hdf5.read_metadata(path, inner_path):
        yield from key_values.parse_pairs([(key, value)], "HDF5", page)


def _collect(entries: Iterator[MetadataEntry], source: str) -> list[MetadataEntry]:
    """Return the entries up to the first error; then an entry without a column, from `source`, gives its reason."""
    collected_entries: list[MetadataEntry] = []
    try:
        collected_entries.extend(entries)
    except Exception as error:  # neither tifffile, Pillow nor the XML parser documents what it raises
        text = f"cannot be read ({files.describe_error(error)})"
        collected_entries.append(MetadataEntry(None, None, text, source))
    return collected_entries
