"""instrument.yaml: its keys with their defaults, and one sentence for each thing that can be wrong with it."""

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from spotcheck.dataset.manifest import REQUIRED_COLUMNS
from spotcheck.dataset.plausible import USUAL, hint
from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation, read_keys

# No condition may bear the name of a standard column, or of a dimension or variable of the results.
RESERVED = {
    *REQUIRED_COLUMNS,
    *("page", "angle", "exposure", "repeat", "y", "x", "row", "column", "block_y", "block_x", "source", "parameter"),
    *(
        "status",
        "left_out",
        "centring",
        "fit",
        "estimator",
        "frame",
        "registration",
        "data_range",
        "image",
        "top",
        "left",
        "block_mean",
    ),
    *("row_mean", "column_mean", "amplitude", "x_centre", "y_centre", "sigma_major", "sigma_minor", "orientation"),
    *("offset", "sigma_mean", "chi2_reduced", "p1", "p2", "peak", "laser_width", "likelihood_converged", "mean_light"),
    *("sigma", "maximum", "sum", "speckle_contrast", "peak_ratio", "psnr", "law", "fine_exposure", "photons"),
    *("axis", "power", "other_power", "coefficient", "origin", "scatter", "mean_reading", "azimuth"),
}


@dataclass(frozen=True)
class Sensor:
    """Section `sensor`; None marks a key without a default that was not given. Once read, `pixel_pitch_m` is that of
    the plane of a colour: twice the sensor's where `bayer` is given."""

    pixel_pitch_m: float | None = None
    bit_depth: int | None = None
    full_scale_dn: int | None = None
    gain_dn_per_e: float | None = None
    read_noise_e: float | None = None
    dark_current_e_per_s: float = 0.0
    quantum_efficiency: float = 1.0
    full_well_e: float | None = None
    black_level_dn: float = 0.0
    response_bend: float = 0.0
    value_shift_bits: int = 0
    gain_dn_per_e_stderr: float = 0.0
    read_noise_e_stderr: float = 0.0
    black_level_dn_stderr: float = 0.0
    channel: str | None = None
    bayer: str | None = None


@dataclass(frozen=True)
class Optics:
    """Section `optics`."""

    focal_length_m: float | None = None
    working_distance_m: float | None = None
    f_number: float | None = None
    filter_transmission: float | None = None
    pixel_integration: bool = False


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
class Light:
    """Section `light`: the file of a shape that was learned before; once read, its absolute path."""

    profile: str | None = None


@dataclass(frozen=True)
class BadPixels:
    """Section `bad_pixels`: what of the sensor is not measured. An image, once read by its absolute path, whose pixels
    other than 0 are bad; whole columns and rows; and single pixels (x, y)."""

    mask: str | None = None
    columns: tuple[int, ...] = ()
    rows: tuple[int, ...] = ()
    pixels: tuple[tuple[int, int], ...] = ()


DEFAULT = "default"


@dataclass(frozen=True)
class Instrument:
    """The content of instrument.yaml with its defaults; `based_on`, once read, is an absolute path. `given` are the
    keys that have a value, `shared` those of them that only the file below has."""

    based_on: str | None = None
    name: str | None = None
    order_known: bool = True
    conditions: tuple[str, ...] = ()
    crop_px: int = 240
    sensor: Sensor = field(default_factory=Sensor)
    optics: Optics = field(default_factory=Optics)
    laser: Laser = field(default_factory=Laser)
    material: Material = field(default_factory=Material)
    model: ModelChoice = field(default_factory=ModelChoice)
    light: Light = field(default_factory=Light)
    bad_pixels: BadPixels = field(default_factory=BadPixels)
    given: frozenset[str] = frozenset()
    shared: frozenset[str] = frozenset()

    def source(self, key: str) -> str:
        """Where the value of a key such as "sensor.gain_dn_per_e" comes from: `DEFAULT`, or the name of a file."""
        if key not in self.given:
            return DEFAULT
        return self.file_of(key) + (", on which instrument.yaml is based" if key in self.shared else "")

    @property
    def files(self) -> list[Path]:
        """Files that it names and that are there: the shared sheet, the light's profile, the mask of bad pixels."""
        named = (self.based_on, self.light.profile, self.bad_pixels.mask)
        return [path for own in named if own and (path := Path(own)).exists()]

    def file_of(self, key: str) -> str:
        """Name of the file in which a key is, or would have to be."""
        return Path(self.based_on).name if key in self.shared and self.based_on else "instrument.yaml"

    @property
    def laser_sigma_m(self) -> float | None:
        """σ_la [m], the mean of both FWHM over 2√(2 ln 2); None when a width is missing."""
        if self.laser.fwhm_x_m is None or self.laser.fwhm_y_m is None:
            return None
        return (self.laser.fwhm_x_m + self.laser.fwhm_y_m) / 2 / math.sqrt(8 * math.log(2))


SECTIONS = {
    "sensor": Sensor,
    "optics": Optics,
    "laser": Laser,
    "material": Material,
    "model": ModelChoice,
    "light": Light,
    "bad_pixels": BadPixels,
}


def read_instrument(path: Path) -> Instrument:
    """Instrument of `path`; all defaults when the file does not exist. Raises `InputError`."""
    if not path.exists() and not path.is_symlink():
        return Instrument()
    content = _content(path)
    own = _names(content)
    if "based_on" in content:
        shared = _content(Path(content["based_on"]))
        if "based_on" in shared:
            raise InputError(
                f"{path.name}: key based_on names {Path(content['based_on']).name}, which has such a key itself; one"
                " file may stand below another, and no third"
            )
        content = shared | content | {k: shared.get(k, {}) | content.get(k, {}) for k in SECTIONS}
    given = _names(content)
    sections = {name: kind(**_whole(content.pop(name, {}))) for name, kind in SECTIONS.items()}
    if sections["optics"].pixel_integration and sections["model"].top_hat:
        raise InputError(
            f"{path.name}: keys optics.pixel_integration and model.top_hat are both true; one of them must be false"
        )
    sections["sensor"] = _of_colour(path, sections["sensor"], sections["optics"])
    content = _whole(content)
    content["conditions"] = tuple(content.get("conditions", ()))
    for condition in content["conditions"]:
        if condition in RESERVED:
            raise InputError(
                f"{path.name}: key conditions names {condition}, which has a meaning of its own; rename it"
            )
        if not re.fullmatch(r"[A-Za-z]\w{0,99}", condition):
            raise InputError(
                f"{path.name}: key conditions names {condition!r}; it must be a word of letters, digits and underscores"
            )
    return Instrument(**content, **sections, given=given, shared=given - own)


def _names(content: dict[str, Any]) -> frozenset[str]:
    """Keys that have a value, those of sections as "sensor.bit_depth"."""
    return frozenset(
        f"{name}.{key}" if key else name for name, own in content.items() for key in (own if name in SECTIONS else [""])
    )


def _of_colour(path: Path, sensor: Sensor, optics: Optics) -> Sensor:
    """The sensor as a plane of one colour has it. Raises `InputError` for keys that do not go together."""
    greens = sensor.channel in ("green_r", "green_b")
    if sensor.bayer is None:
        if greens:
            raise InputError(
                f"{path.name}: key sensor.channel is {sensor.channel}; it must be green without sensor.bayer"
            )
        return sensor
    if sensor.channel in (None, "green"):
        raise InputError(
            f"{path.name}: key sensor.bayer is {sensor.bayer}, but sensor.channel is {sensor.channel or 'missing'};"
            " it must be red, green_r (in rows with red), green_b (in rows with blue) or blue"
        )
    if optics.pixel_integration:
        raise InputError(
            f"{path.name}: key optics.pixel_integration is true, but the pixels of one colour (sensor.bayer) cover a"
            " quarter of the frame; it must be false"
        )
    return replace(sensor, pixel_pitch_m=None if sensor.pixel_pitch_m is None else 2 * sensor.pixel_pitch_m)


def _content(path: Path) -> dict[str, Any]:
    """Keys of one file, with absolute paths of the files that it names. Raises `InputError`."""
    # A section without keys below it (`sensor:`) is an empty section, not a wrong one.
    content = {k: ({} if v is None and k in SECTIONS else v) for k, v in read_keys(path).items()}
    if breach := find_violation(content, "instrument"):
        raise InputError(f"{path.name}: {breach}{_in_another_unit(content, breach)}")
    _find(path, content, "", "based_on", "an instrument file")
    _find(path, content, "light", "profile", "a light.nc")
    _find(path, content, "bad_pixels", "mask", "an image")
    return content


def _in_another_unit(content: dict[str, Any], breach: str) -> str:
    """In which unit a number that is refused would be a usual one; "" where in none."""
    for key, usual in USUAL.items():
        section, _, name = key.partition(".")
        if f"key {key} is " in breach and isinstance(content[section][name], int | float):
            right = hint(content[section][name], usual)
            return f" ({right})" if right else ""
    return ""


def _find(path: Path, content: dict[str, Any], section: str, key: str, wanted: str) -> None:
    """Put a file's own path in the place of that from the dataset's folder. Raises `InputError`."""
    own = content.get(section, {}) if section else content
    if key not in own:
        return
    name, place = own[key], f"{section}.{key}" if section else key
    if re.search("[{}\0]", name):
        raise InputError(f"{path.name}: key {place} is {name!r}; it must be a path without braces")
    file = path.parent / name
    if not name or not file.is_file():
        raise InputError(
            f"{path.name}: key {place} names {name!r}, which is not there; it must be the path of {wanted},"
            " relative to the dataset folder"
        )
    own[key] = str(file.resolve())


def _whole(section: dict[str, Any]) -> dict[str, Any]:
    """Whole numbers written as 240.0 as integers: the schema takes them for such, slices do not; lists as tuples."""
    whole = ("crop_px", "bit_depth", "full_scale_dn", "value_shift_bits", "columns", "rows", "pixels")
    return {key: _integers(value) if key in whole else value for key, value in section.items()}


def _integers(value: Any) -> Any:
    return tuple(map(_integers, value)) if isinstance(value, list) else int(value)
