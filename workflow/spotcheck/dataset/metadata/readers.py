"""All metadata of an image file: inside it, beside it, and in its name."""

from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from spotcheck.dataset.metadata import file_names, key_values, sidecar, tags
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.io.formats import hdf5, png, tiff

# Signatures, name in messages, and reader of each image format with metadata; HDF5 needs the path inside the file too.
READERS: tuple[tuple[tuple[bytes, ...], str, Callable[[Path], Iterator[MetadataEntry]]], ...] = (
    (tiff.SIGNATURES, "TIFF tags", tags.read_tiff_tags),
    ((png.SIGNATURE,), "PNG texts", tags.read_png_texts),
)


def read_metadata(path: Path, root: Path | None = None, inner_path: str = "") -> tuple[MetadataEntry, ...]:
    """Return the metadata of an image file, the most exact sources first: tags, sidecar files, then names.

    Parameters
    ----------
    path : the image file.
    root : folder below which names of folders are parsed too; None for the file name alone.
    inner_path : path of the frames inside an HDF5 file.

    Returns
    -------
    tuple of MetadataEntry
        For each source that cannot be read, an entry without a column gives the reason.
    """
    entries: list[MetadataEntry] = []
    with path.open("rb") as stream:
        start = stream.read(16)
    for signatures, source, reader in READERS:
        if start.startswith(signatures):
            entries += _collect(reader(path), source)
    if start.startswith(hdf5.SIGNATURE):
        entries += _collect(_read_hdf5(path, inner_path), "HDF5")
    entries += _collect(sidecar.read_sidecars(path), "side file")
    entries += file_names.parse_path(path.relative_to(root) if root else PurePath(path.name))
    return tuple(entries)


def _read_hdf5(path: Path, inner_path: str) -> Iterator[MetadataEntry]:
    """Yield the attributes, numbers and texts around the frames in an HDF5 file."""
    for key, value, page in hdf5.read_metadata(path, inner_path):
        yield from key_values.parse_pairs([(key, value)], "HDF5", page)


def _collect(entries: Iterator[MetadataEntry], source: str) -> list[MetadataEntry]:
    """Return the entries up to the first error, and its reason."""
    collected: list[MetadataEntry] = []
    try:
        collected.extend(entries)
    except Exception as error:  # neither tifffile, Pillow nor the XML parser documents what it raises
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        collected.append(MetadataEntry(None, None, f"cannot be read ({reason})", source))
    return collected
