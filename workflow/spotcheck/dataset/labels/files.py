"""All that is said of an image file: in it, beside it, and by its name."""

from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

from spotcheck.dataset.labels import beside, names, tags, words
from spotcheck.dataset.labels.label import Label
from spotcheck.io.formats import hdf5, png, tiff

READERS: tuple[tuple[tuple[bytes, ...], str, Callable[[Path], Iterator[Label]]], ...] = (
    (tiff.SIGNATURES, "TIFF tags", tags.of_tiff),
    ((png.SIGNATURE,), "PNG texts", tags.of_png),
)


def labels_of(path: Path, root: Path | None = None, inside: str = "") -> tuple[Label, ...]:
    """Labels of an image file, the most exact sources first: tags, side files, then its name and, below `root`, those
    of its folders. Of an HDF5 file `inside` is the path of the frames in it.

    Nothing is raised for a file that is broken: a label without a column says what could not be read.
    """
    found: list[Label] = []
    with path.open("rb") as stream:
        start = stream.read(16)
    for signatures, what, reader in READERS:
        if start.startswith(signatures):
            found += _safely(reader, path, what)
    if start.startswith(hdf5.SIGNATURE):
        found += _safely(lambda own: _of_hdf5(own, inside), path, "HDF5")
    found += _safely(beside.labels_of, path, "side file")
    found += names.of_path(path.relative_to(root) if root else PurePath(path.name))
    return tuple(found)


def _of_hdf5(path: Path, inside: str) -> Iterator[Label]:
    """Labels of the attributes, numbers and texts around the frames in an HDF5 file."""
    for key, value, page in hdf5.read_metadata(path, inside):
        yield from words.of_keys([(key, value)], "HDF5", page)


def _safely(read: Callable[[Path], Iterator[Label]], path: Path, what: str) -> list[Label]:
    """Labels up to the first that cannot be read: neither tifffile, Pillow nor XML promise a class of error."""
    found: list[Label] = []
    try:
        found.extend(read(path))
    except Exception as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        found.append(Label(None, None, f"cannot be read ({reason})", what))
    return found
