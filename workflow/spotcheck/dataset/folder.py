"""A dataset folder with manifest.csv, instrument.yaml and frames/ (workflow/docs/dataset-contract.md), and its grid.

Loading checks everything that does not need a pixel, and raises `InputError` for a mistake.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from spotcheck.dataset.instrument import Instrument, read_instrument
from spotcheck.dataset.manifest import KINDS, Frame, read_manifest
from spotcheck.errors import InputError
from spotcheck.io.formats.names import IMAGE_SUFFIXES
from spotcheck.io.store import Axis

# Unit of a manifest column by the suffix of its name.
UNIT_OF_SUFFIX = {"_m": "m", "_s": "s", "_k": "K", "_deg": "degree"}


@dataclass(frozen=True, repr=False)
class Dataset:
    """A folder of frames with the content of its manifest.csv and instrument.yaml.

    The keys and columns are explained in workflow/docs/dataset-contract.md.

    Attributes
    ----------
    folder : absolute path of the folder.
    instrument : the content of instrument.yaml, in sections such as `instrument.sensor`, with defaults.
    frames : every row of the manifest, in its order: `file`, `kind`, `angle_deg`, `exposure_s`, `repeat` and others.
    spots : the frames of kind `spot`. `read_image` gives the pixels of a frame.
    axes : axes of the grid that the spots span: angle, exposure, repeat, and the declared conditions, which are further
        columns of the manifest that instrument.yaml names.
    exposures : exposure times of the spots [s], ascending.

    Examples
    --------
    >>> import spotcheck
    >>> dataset = spotcheck.read_dataset("my-frames")
    >>> dataset.instrument.sensor.gain_dn_per_e
    0.11
    >>> dataset.spots[0].exposure_s
    0.0001
    """

    folder: Path
    instrument: Instrument
    frames: tuple[Frame, ...]

    def __repr__(self) -> str:
        """Return the name, the number of frames of each kind, and the recorded axes with their lengths."""
        counts = {kind: sum(frame.kind == kind for frame in self.frames) for kind in KINDS}
        kinds = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in counts.items() if count)
        axes = ", ".join(f"{axis.name} ({axis.size})" for axis in self.axes if axis.values is not None)
        return f"<Dataset {self.name}: {kinds}{' over ' if axes else ''}{axes}>"

    @property
    def name(self) -> str:
        """Name of the folder, which is also the name of its results folder."""
        return self.folder.name

    @property
    def instrument_files(self) -> list[Path]:
        """Paths of instrument.yaml, which need not exist, and of the existing files that it names."""
        return [self.folder / "instrument.yaml", *self.instrument.files]

    @property
    def title(self) -> str:
        """Title in instrument.yaml, or else the name of the folder."""
        return self.instrument.name or self.name

    @cached_property
    def spots(self) -> tuple[Frame, ...]:
        """The frames of kind `spot`, in manifest order."""
        return tuple(frame for frame in self.frames if frame.kind == "spot")

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of the grid of spots: angle, exposure, repeat, then the declared conditions."""
        quantities = [
            ("angle", "degree", "fibre orientation"),
            ("exposure", "s", "exposure time"),
            ("repeat", "1", "site or repetition within a condition"),
            *((column, get_column_unit(column), column) for column in self.instrument.conditions),
        ]
        coordinates = [frame.get_coordinates(self.instrument.conditions) for frame in self.spots]
        axes = []
        for position, (name, units, long_name) in enumerate(quantities):
            values = {of_frame[position] for of_frame in coordinates}
            recorded_values = sorted(value for value in values if value is not None)
            axes.append(Axis(name, tuple(recorded_values) or None, units, long_name))
        return tuple(axes)

    @property
    def exposures(self) -> tuple[float, ...]:
        """Exposure times of the spots [s], ascending; empty if they were not recorded."""
        return next(axis for axis in self.axes if axis.name == "exposure").values or ()

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Lengths of `axes`."""
        return tuple(axis.size for axis in self.axes)

    def cells(self) -> Iterator[tuple[tuple[int, ...], Frame]]:
        """Yield the index on the grid, a position on each of `axes`, and the frame of every spot, in manifest order."""
        for frame in self.spots:
            coordinates = frame.get_coordinates(self.instrument.conditions)
            yield tuple(axis.index(value) for axis, value in zip(self.axes, coordinates, strict=True)), frame


def get_column_unit(column: str) -> str:
    """Return the unit of a manifest column by its suffix (`_m`, `_s`, `_k`, `_deg`), else `1`."""
    return next((unit for suffix, unit in UNIT_OF_SUFFIX.items() if column.endswith(suffix)), "1")


def load(folder: str | Path) -> Dataset:
    """Read and check manifest.csv and instrument.yaml of a folder of frames; no image is opened.

    Parameters
    ----------
    folder : str or Path
        Folder with manifest.csv.

    Raises
    ------
    InputError
        For the first mistake: the file, the row or key, what is wrong and what would be right.

    Examples
    --------
    >>> import spotcheck
    >>> dataset = spotcheck.read_dataset("my-frames")
    >>> dataset
    <Dataset my-frames: 18 spots over angle (2), exposure (3), repeat (3)>
    >>> dataset.exposures
    (0.0001, 0.0003, 0.0009)
    >>> len([frame for frame in dataset.spots if frame.angle_deg == 90])
    9
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; a dataset is a folder with manifest.csv and frames/")
    instrument = read_instrument(folder / "instrument.yaml")
    frames = read_manifest(folder / "manifest.csv", instrument.conditions)
    return Dataset(folder, instrument, frames)


def find_dataset(name: str, datasets_folder: Path) -> Path:
    """Return the absolute path of the folder of a dataset.

    Parameters
    ----------
    name : path of the dataset, which takes precedence, or its name in `datasets_folder`.
    datasets_folder : folder that holds dataset folders.

    Raises
    ------
    InputError
        If there is no such dataset, or if its path contains braces, which Snakemake takes for wildcards.
    """
    for folder in (Path(name), datasets_folder / name):
        if (folder / "manifest.csv").is_file():
            if set("{}") & set(str(folder.resolve())):
                raise InputError(f"{folder}: has braces in its path; rename it")
            return folder.resolve()
    raise InputError(
        f"{name}: no folder with a manifest.csv, neither as a path nor as a name in {datasets_folder.name}/"
    )


def check_files(dataset: Dataset) -> None:
    """Check that every file in the manifest exists, and that the manifest names every image in frames/.

    Raises
    ------
    InputError
        For the first file of the manifest that does not exist, or the first image in frames/ without a row.
    """
    for frame in dataset.frames:
        if not (dataset.folder / frame.path).is_file():
            similar = _find_similar_file(dataset.folder, frame.path)
            advice = f", but {similar} is; correct the row" if similar else "; add the file or drop the row"
            raise InputError(f"manifest.csv line {frame.line}: {frame.path} is not there{advice}")
    named_files = {(dataset.folder / frame.path).resolve() for frame in dataset.frames}
    for image in sorted((dataset.folder / "frames").rglob("*")):
        path = image.relative_to(dataset.folder)
        is_image = image.suffix.lower() in IMAGE_SUFFIXES and image.is_file()
        if is_image and not is_hidden(path) and image.resolve() not in named_files:
            raise InputError(
                f"{path.as_posix()}: an image that manifest.csv does not name; add a row or move it out of frames/"
            )


def _find_similar_file(folder: Path, file: str) -> str | None:
    """Return the relative path of a file with the same name, ignoring case, in the dataset folder or frames/.

    Returns None if there is none.
    """
    for path in (*folder.glob("*"), *folder.glob("frames/*")):
        if path.name.lower() == Path(file).name.lower() and path.is_file():
            return path.relative_to(folder).as_posix()
    return None


def is_hidden(path: Path) -> bool:
    """Return whether a part of a relative path starts with a dot, as in system files such as ._a.tif of macOS."""
    return any(part.startswith(".") for part in path.parts)
