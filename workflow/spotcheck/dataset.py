"""The dataset contract: a folder with manifest.csv, instrument.yaml and frames/.

Everything that can be said without decoding a pixel is checked here; a breach raises `InputError`, whose text is one
sentence naming the file, the row or key, what is wrong and what would be right.
"""

import csv
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, best_match

SCHEMAS = Path(__file__).parents[1] / "schemas"
KINDS = ("spot", "dark", "flat")
REQUIRED_COLUMNS = ("file", "kind", "angle_deg", "exposure_s", "repeat")
# No condition may bear the name of a standard column, or of a dimension or variable of the results.
RESERVED = {*REQUIRED_COLUMNS, "page", "angle", "exposure", "repeat", "y", "x", "row", "column", "block_y", "block_x"}
RESERVED |= {"status", "centring", "source", "parameter", "estimator", "frame", "registration", "data_range"}
IMAGE_SUFFIXES = (".tif", ".tiff", ".png", ".pgm")
UNIT_OF_SUFFIX = {"_m": "m", "_s": "s", "_k": "K", "_deg": "degree"}


class InputError(ValueError):
    """What the user gave cannot be used; the text is one sentence for them."""


@dataclass(frozen=True)
class Sensor:
    """Section `sensor`; None marks a key without a default that was not given."""

    pixel_pitch_m: float | None = None
    bit_depth: int | None = None
    gain_dn_per_e: float | None = None
    read_noise_e: float | None = None
    dark_current_e_per_s: float = 0.0
    quantum_efficiency: float = 1.0
    full_well_e: float | None = None
    black_level_dn: float = 0.0
    value_shift_bits: int = 0


@dataclass(frozen=True)
class Optics:
    """Section `optics`."""

    focal_length_m: float | None = None
    working_distance_m: float | None = None
    f_number: float | None = None
    filter_transmission: float | None = None


@dataclass(frozen=True)
class Laser:
    """Section `laser`."""

    power_w: float | None = None
    wavelength_m: float | None = None
    fwhm_x_m: float | None = None
    fwhm_y_m: float | None = None


@dataclass(frozen=True)
class Material:
    """Section `material`."""

    reflectance: float | None = None


@dataclass(frozen=True)
class ModelChoice:
    """Section `model`: which baseline the simulation uses."""

    photon_budget: str = "linear"
    top_hat: bool = False


@dataclass(frozen=True)
class Instrument:
    """The content of instrument.yaml with its defaults."""

    name: str | None = None
    order_known: bool = True
    conditions: tuple[str, ...] = ()
    crop_px: int = 240
    sensor: Sensor = field(default_factory=Sensor)
    optics: Optics = field(default_factory=Optics)
    laser: Laser = field(default_factory=Laser)
    material: Material = field(default_factory=Material)
    model: ModelChoice = field(default_factory=ModelChoice)

    @property
    def laser_sigma_m(self) -> float | None:
        """σ_la [m], the mean of both FWHM over 2√(2 ln 2); None when a width is missing."""
        if self.laser.fwhm_x_m is None or self.laser.fwhm_y_m is None:
            return None
        return (self.laser.fwhm_x_m + self.laser.fwhm_y_m) / 2 / math.sqrt(8 * math.log(2))


SECTIONS = {"sensor": Sensor, "optics": Optics, "laser": Laser, "material": Material, "model": ModelChoice}


@dataclass(frozen=True)
class Frame:
    """One row of the manifest. `line` counts lines of the file from 1, the header being line 1."""

    line: int
    file: str
    page: int
    kind: str
    angle_deg: float | None
    exposure_s: float | None
    repeat: int | None
    extra: dict[str, str]

    @property
    def label(self) -> str:
        """How messages name the frame."""
        return f"{self.file}, page {self.page}" if self.page else self.file


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
        return 0 if self.values is None or value is None else self.values.index(value)


@dataclass(frozen=True)
class Dataset:
    """A dataset folder that keeps the contract."""

    folder: Path
    instrument: Instrument
    frames: tuple[Frame, ...]

    @property
    def name(self) -> str:
        """The folder's name, under which results are filed."""
        return self.folder.name

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
            values = [_number(f.extra[name]) for f in self.spots]
            axes.append(_axis(name, values, unit_of(name), name))
        return tuple(axes)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Lengths of `axes`."""
        return tuple(axis.size for axis in self.axes)

    def cells(self) -> Iterator[tuple[tuple[int, ...], Frame]]:
        """Index on the grid and frame, for every spot."""
        angle, exposure, repeat, *conditions = self.axes
        for frame in self.spots:
            own = [angle.index(frame.angle_deg), exposure.index(frame.exposure_s), repeat.index(frame.repeat)]
            own += [axis.index(_number(frame.extra[axis.name])) for axis in conditions]
            yield tuple(own), frame


def unit_of(column: str) -> str:
    """Unit of an extra manifest column, from its suffix (`_m`, `_s`, `_k`, `_deg`), else `1`."""
    return next((unit for suffix, unit in UNIT_OF_SUFFIX.items() if column.endswith(suffix)), "1")


def load(folder: str | Path) -> Dataset:
    """Read and check manifest.csv and instrument.yaml of a dataset folder.

    Raises `InputError` for anything the contract forbids and that shows without decoding pixels.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; a dataset is a folder with manifest.csv and frames/")
    instrument = read_instrument(folder / "instrument.yaml")
    frames = read_manifest(folder / "manifest.csv", instrument.conditions)
    return Dataset(folder, instrument, frames)


def read_instrument(path: Path) -> Instrument:
    """Instrument of `path`; all defaults when the file does not exist. Raises `InputError`."""
    if not path.exists():
        return Instrument()
    try:
        content = read_yaml(path) or {}
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError(f"{path.name}{line}: {problem}; it must be YAML with `key: value` lines") from None
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: not UTF-8 text; save it as UTF-8") from None
    if not isinstance(content, dict):
        raise InputError(f"{path.name}: holds no keys; it must be YAML with `key: value` lines")
    schema = yaml.safe_load((SCHEMAS / "instrument.schema.yaml").read_text(encoding="utf-8"))
    # A section without keys below it (`sensor:`) is an empty section, not a wrong one.
    content = {k: ({} if v is None and k in SECTIONS else v) for k, v in content.items()}
    breach = best_match(Draft202012Validator(schema).iter_errors(content))
    if breach is not None:
        raise InputError(f"{path.name}: {_explain(breach)}")
    sections = {name: kind(**_whole(content.pop(name, {}))) for name, kind in SECTIONS.items()}
    content = _whole(content)
    content["conditions"] = tuple(content.get("conditions", ()))
    for condition in content["conditions"]:
        if condition in RESERVED:
            raise InputError(
                f"{path.name}: key conditions names {condition}, which has a meaning of its own; rename it"
            )
    return Instrument(**content, **sections)


def _whole(section: dict[str, Any]) -> dict[str, Any]:
    """Whole numbers written as 240.0 as integers: the schema takes them for such, slices do not."""
    whole = ("crop_px", "bit_depth", "value_shift_bits")
    return {key: int(value) if key in whole else value for key, value in section.items()}


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, with numbers such as 5e-6 read as numbers and doubled keys refused."""
    return yaml.load(path.read_text(encoding="utf-8"), _Loader)


class _Loader(yaml.SafeLoader):
    """YAML 1.2 numbers and no doubled keys: YAML 1.1 reads 5e-6 as text and keeps the last of two equal keys."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen: set = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=deep)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(problem=f"key {key} is no word", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key} stands twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def _construct_float(loader: _Loader, node: Any) -> float:
    value = loader.construct_yaml_float(node)
    if not math.isfinite(value):
        raise yaml.MarkedYAMLError(problem=f"{node.value} is no number to reckon with", problem_mark=node.start_mark)
    return value


_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def _explain(error: ValidationError) -> str:
    """One sentence for a schema error: key, what is wrong, what would be right."""
    key = ".".join(str(part) for part in error.absolute_path)
    if error.validator == "additionalProperties":
        known = error.schema["properties"]
        unknown = next(k for k in error.instance if k not in known)
        home = next((s for s, kind in SECTIONS.items() if unknown in {f.name for f in fields(kind)}), None)
        if home and not key:
            return f"key {unknown} stands outside its section; put it under `{home}:`"
        where = f"{key}.{unknown}" if key else unknown
        return f"unknown key {where}; known keys here: {', '.join(known)}"
    if error.validator == "type":
        kind = {"object": "a section with keys below it", "array": "a list", "number": "a number"}
        kind |= {"integer": "a whole number", "boolean": "true or false", "string": "text"}
        return f"key {key} is {error.instance!r}; it must be {kind[error.validator_value]}"
    if error.validator == "enum":
        return f"key {key} is {error.instance!r}; it must be one of {', '.join(error.validator_value)}"
    bound = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most"}.get(str(error.validator))
    if bound:
        return f"key {key} is {error.instance!r}; it must be {bound} {error.validator_value}"
    return f"key {key}: {error.message}"


def read_manifest(path: Path, conditions: tuple[str, ...] = ()) -> tuple[Frame, ...]:
    """Rows of manifest.csv in their order, checked among themselves and against the files of the folder."""
    if not path.exists():
        raise InputError(f"{path.name}: not there; a dataset needs it ({', '.join(REQUIRED_COLUMNS)})")
    try:
        lines = list(enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1))
        # Lines that start with # are comments, as `new-dataset` writes them.
        lines = [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]
        reader = csv.DictReader([line for _, line in lines], skipinitialspace=True)
        rows = [(lines[reader.line_num - 1][0], row) for row in reader]
        columns = [name.strip() for name in reader.fieldnames or ()]
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: not UTF-8 text; save it as UTF-8 CSV") from None
    for column in columns:
        if columns.count(column) > 1:
            raise InputError(f"{path.name}: column {column} stands twice; keep one of them")
    for column in REQUIRED_COLUMNS:
        if column not in columns:
            raise InputError(
                f"{path.name}: column {column} is missing; the header must name {','.join(REQUIRED_COLUMNS)}"
            )
    for condition in conditions:
        if condition not in columns:
            raise InputError(
                f"instrument.yaml: key conditions names {condition}, which is no column of {path.name};"
                f" add the column or drop the name"
            )
    if not rows:
        raise InputError(f"{path.name}: no rows; it must name at least one frame")
    frames = tuple(_frame(path, line, row, conditions) for line, row in rows)
    _check_rows(path, frames, conditions)
    return frames


def _frame(path: Path, line: int, row: dict[str | None, Any], conditions: tuple[str, ...]) -> Frame:
    where = f"{path.name} line {line}"
    if None in row or None in row.values():
        raise InputError(f"{where}: {'more' if None in row else 'fewer'} cells than the header has columns")
    cell = {name.strip(): value.strip() for name, value in row.items() if name is not None}
    if cell["kind"] not in KINDS:
        raise InputError(f"{where}: kind is {cell['kind']!r}; it must be one of {', '.join(KINDS)}")
    spot = cell["kind"] == "spot"

    def number(column: str) -> float | None:
        if not cell[column]:
            return None
        value = _number(cell[column])
        if value is None:
            raise InputError(f"{where}: {column} is {cell[column]!r}; it must be a number or blank")
        return value

    def count(column: str) -> int | None:
        text = cell.get(column, "")
        if text and not text.isdecimal():
            raise InputError(f"{where}: {column} is {text!r}; it must be a whole number from 0")
        return int(text) if text else None

    exposure = number("exposure_s")
    if exposure is not None and (exposure < 0 or (spot and exposure == 0)):
        raise InputError(f"{where}: exposure_s is {cell['exposure_s']}; it must be positive, in seconds")
    for condition in conditions:
        if spot and number(condition) is None:
            raise InputError(f"{where}: {condition} is blank; it is declared in conditions and needs a number")
    file = cell["file"]
    folder = path.parent
    if (
        not file
        or "\0" in file
        or Path(file).is_absolute()
        or not (folder / file).resolve().is_relative_to(folder.resolve())
    ):
        raise InputError(f"{where}: file is {file!r}; it must be a path inside the dataset folder")
    if Path(file).suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"{where}: {file} is no image; it must end in one of {', '.join(IMAGE_SUFFIXES)}")
    extra = {name: value for name, value in cell.items() if name not in (*REQUIRED_COLUMNS, "page")}
    return Frame(
        line=line,
        file=Path(os.path.normpath(file)).as_posix(),
        page=count("page") or 0,
        kind=cell["kind"],
        angle_deg=number("angle_deg"),
        exposure_s=exposure,
        repeat=count("repeat"),
        extra=extra,
    )


def _check_rows(path: Path, frames: tuple[Frame, ...], conditions: tuple[str, ...]) -> None:
    by_page: dict[tuple, Frame] = {}
    by_cell: dict[tuple, Frame] = {}
    for frame in frames:
        at = tuple(_number(frame.extra[name]) for name in conditions)
        cell = (frame.kind, frame.angle_deg, frame.exposure_s, frame.repeat, at)
        for seen, key, what in (
            (by_page, (frame.file, frame.page), "file and page"),
            (by_cell, cell, "kind, angle, exposure, repeat and conditions"),
        ):
            if key in seen:
                raise InputError(
                    f"{path.name} lines {seen[key].line} and {frame.line} agree in {what};"
                    f" every frame must be named once"
                )
            seen[key] = frame
    spots = [frame for frame in frames if frame.kind == "spot"]
    for column in ("angle_deg", "exposure_s", "repeat"):
        blank = [frame for frame in spots if getattr(frame, column) is None]
        if blank and len(blank) < len(spots):
            raise InputError(
                f"{path.name} line {blank[0].line}: {column} is blank here and given in other spot rows;"
                f" give it in all of them or in none"
            )


def check_files(dataset: Dataset) -> None:
    """Every named frame is there, and every image in frames/ is named. Raises `InputError`."""
    for frame in dataset.frames:
        if not (dataset.folder / frame.file).is_file():
            raise InputError(f"manifest.csv line {frame.line}: {frame.file} is not there; add the file or drop the row")
    named = {(dataset.folder / frame.file).resolve() for frame in dataset.frames}
    for image in sorted((dataset.folder / "frames").rglob("*")):
        if image.suffix.lower() in IMAGE_SUFFIXES and image.resolve() not in named:
            raise InputError(
                f"{image.relative_to(dataset.folder).as_posix()}: an image that manifest.csv does not name;"
                f" add a row or move it out of frames/"
            )


def _axis(name: str, values: list, units: str, long_name: str) -> Axis:
    known = sorted({v for v in values if v is not None})
    return Axis(name, tuple(known) if known else None, units, long_name)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def find(name: str, shelf: Path) -> Path:
    """Folder of a dataset given by path, or by its name on a shelf of datasets. Raises `InputError`."""
    for folder in (Path(name), shelf / name):
        if (folder / "manifest.csv").is_file():
            return folder.resolve()
    raise InputError(f"{name}: no folder with a manifest.csv, neither as a path nor as a name in {shelf.name}/")
