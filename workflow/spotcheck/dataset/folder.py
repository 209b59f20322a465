"""A dataset folder that keeps the contract (workflow/docs/dataset-contract.md): manifest.csv, instrument.yaml, frames/,
and the grid that its spots span.

Everything that can be said without decoding a pixel is checked on loading; a breach raises `InputError`.
"""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from spotcheck.dataset.instrument import Instrument, read_instrument
from spotcheck.dataset.manifest import KINDS, Frame, number_in, read_manifest
from spotcheck.errors import InputError
from spotcheck.io.formats.names import IMAGE_SUFFIXES

UNIT_OF_SUFFIX = {"_m": "m", "_s": "s", "_k": "K", "_deg": "degree"}


@dataclass(frozen=True)
class Axis:
    """An axis of the grid of spots; `values` is None when it was not recorded (then its length is 1)."""

    name: str
    values: tuple[float, ...] | None
    units: str
    long_name: str

    @property
    def size(self) -> int:
        """Length of the axis."""
        return 1 if self.values is None else len(self.values)

    def index(self, value: float | None) -> int:
        """Place of a value on the axis."""
        return 0 if self.values is None or value is None else bisect_left(self.values, value)


@dataclass(frozen=True, repr=False)
class Dataset:
    """A folder of frames: what its manifest.csv and instrument.yaml say, as workflow/docs/dataset-contract.md explains.

    Attributes
    ----------
    folder : the folder.
    instrument : the content of instrument.yaml, in sections such as `instrument.sensor`, with defaults.
    frames : every row of the manifest, in its order: `file`, `kind`, `angle_deg`, `exposure_s`, `repeat` and others.
    spots : the frames of kind `spot`. `read_image` gives the pixels of a frame.
    axes : the grid that the spots span: angle, exposure, repeat, and the declared conditions.
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
        counts = {kind: sum(frame.kind == kind for frame in self.frames) for kind in KINDS}
        held = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in counts.items() if count)
        along = ", ".join(f"{axis.name} ({axis.size})" for axis in self.axes if axis.values is not None)
        return f"<Dataset {self.name}: {held}{' over ' if along else ''}{along}>"

    @property
    def name(self) -> str:
        """The folder's name, under which results are filed."""
        return self.folder.name

    @property
    def sheets(self) -> list[Path]:
        """instrument.yaml, whether it is there or not, and the files that it names."""
        return [self.folder / "instrument.yaml", *self.instrument.files]

    @property
    def title(self) -> str:
        """What a person calls it."""
        return self.instrument.name or self.name

    @cached_property
    def spots(self) -> tuple[Frame, ...]:
        """The frames of kind `spot`, in manifest order."""
        return tuple(f for f in self.frames if f.kind == "spot")

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of the grid of spots: angle, exposure, repeat, then the declared conditions."""
        axes = [
            _axis("angle", [f.angle_deg for f in self.spots], "degree", "fibre orientation"),
            _axis("exposure", [f.exposure_s for f in self.spots], "s", "exposure time"),
            _axis("repeat", [f.repeat for f in self.spots], "1", "site or repetition within a condition"),
        ]
        for name in self.instrument.conditions:
            values = [number_in(f.extra[name]) for f in self.spots]
            axes.append(_axis(name, values, unit_of(name), name))
        return tuple(axes)

    @property
    def exposures(self) -> tuple[float, ...]:
        """Exposure times of the spots [s], ascending; empty where they were not recorded."""
        return next(axis for axis in self.axes if axis.name == "exposure").values or ()

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Lengths of `axes`."""
        return tuple(axis.size for axis in self.axes)

    def cells(self) -> Iterator[tuple[tuple[int, ...], Frame]]:
        """Index on the grid and frame, for every spot."""
        angle, exposure, repeat, *conditions = self.axes
        for frame in self.spots:
            own = [angle.index(frame.angle_deg), exposure.index(frame.exposure_s), repeat.index(frame.repeat)]
            own += [axis.index(number_in(frame.extra[axis.name])) for axis in conditions]
            yield tuple(own), frame


def unit_of(column: str) -> str:
    """Unit of an extra manifest column, from its suffix (`_m`, `_s`, `_k`, `_deg`), else `1`."""
    return next((unit for suffix, unit in UNIT_OF_SUFFIX.items() if column.endswith(suffix)), "1")


def load(folder: str | Path) -> Dataset:
    """Read and check manifest.csv and instrument.yaml of a folder of frames; no image is opened.

    Raises `InputError` for whatever is wrong with them: one sentence with the file, the row or key, and what would be
    right.

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


def check_files(dataset: Dataset) -> None:
    """Every named frame is there, and every image in frames/ is named. Raises `InputError`."""
    for frame in dataset.frames:
        if not (dataset.folder / frame.path).is_file():
            near = _near(dataset.folder, frame.path)
            said = f", but {near} is; correct the row" if near else "; add the file or drop the row"
            raise InputError(f"manifest.csv line {frame.line}: {frame.path} is not there{said}")
    named = {(dataset.folder / frame.path).resolve() for frame in dataset.frames}
    for image in sorted((dataset.folder / "frames").rglob("*")):
        # Names that start with a dot are the system's, such as the ._a.tif of macOS.
        hidden = any(part.startswith(".") for part in image.relative_to(dataset.folder).parts)
        if image.suffix.lower() in IMAGE_SUFFIXES and image.is_file() and not hidden and image.resolve() not in named:
            raise InputError(
                f"{image.relative_to(dataset.folder).as_posix()}: an image that manifest.csv does not name;"
                f" add a row or move it out of frames/"
            )


def _near(folder: Path, file: str) -> str | None:
    """A file of that name, whatever its capitals, in the folder of a dataset or its frames/."""
    for own in (*folder.glob("*"), *folder.glob("frames/*")):
        if own.name.lower() == Path(file).name.lower() and own.is_file():
            return own.relative_to(folder).as_posix()
    return None


def in_frames(file: str) -> bool:
    """Whether a path of the manifest leads into frames/, where nothing goes unnamed."""
    return Path(file).parts[0] == "frames"


def find(name: str, shelf: Path) -> Path:
    """Folder of a dataset given by path, or by its name on a shelf of datasets. Raises `InputError`."""
    for folder in (Path(name), shelf / name):
        if (folder / "manifest.csv").is_file():
            if set("{}") & set(str(folder.resolve())):
                raise InputError(f"{folder}: has braces in its path; rename it")
            return folder.resolve()
    raise InputError(f"{name}: no folder with a manifest.csv, neither as a path nor as a name in {shelf.name}/")


def _axis(name: str, values: list, units: str, long_name: str) -> Axis:
    known = sorted({v for v in values if v is not None})
    return Axis(name, tuple(known) if known else None, units, long_name)
