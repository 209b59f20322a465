"""instrument.yaml: its keys with their defaults, and one message for each possible mistake.

A condition is a column of the manifest that instrument.yaml declares as an axis of the experiment.
"""

import math
import re
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from spotcheck.dataset.manifest import REQUIRED_COLUMNS
from spotcheck.dataset.plausibility import USUAL_RANGES, suggest_unit
from spotcheck.errors import InputError
from spotcheck.io.schema import find_violation, read_keys

# Names of standard columns, and of dimensions and variables of the results, which no condition may have.
RESERVED = {
    *REQUIRED_COLUMNS,
    *"page angle exposure repeat y x row column block_y block_x source parameter status left_out centring fit".split(),
    *"estimator frame registration data_range image top left block_mean row_mean column_mean amplitude".split(),
    *"x_centre y_centre sigma_major sigma_minor orientation offset sigma_mean chi2_reduced p1 p2 peak".split(),
    *"laser_width likelihood_converged mean_light sigma maximum sum speckle_contrast peak_ratio psnr law".split(),
    *"fine_exposure photons axis power other_power coefficient origin scatter mean_reading azimuth".split(),
    *"psnr_repeats cut_reading".split(),
}


@dataclass(frozen=True)
class Sensor:
    """Section `sensor`; None marks a missing key without a default."""

    pixel_pitch_m: float | None = None  # pixel pitch [m]; with `bayer` that of a colour plane: twice the sensor's
    bit_depth: int | None = None  # bits of the analogue-to-digital converter
    full_scale_dn: int | None = None  # largest reading if the converter stops below its bits [DN]
    gain_dn_per_e: float | None = None  # system gain K [DN/e-]
    read_noise_e: float | None = None  # read noise, rms [e-]
    dark_current_e_per_s: float = 0.0  # mean dark current of a pixel [e-/s]
    quantum_efficiency: float = 1.0  # electrons per photon
    full_well_e: float | None = None  # saturation capacity [e-]
    black_level_dn: float = 0.0  # reading without light [DN]
    response_bend: float = 0.0  # curvature q: a signal y above black is read as y - q y²/full scale
    value_shift_bits: int = 0  # unused low bits of left-aligned readings
    gain_dn_per_e_stderr: float = 0.0  # standard error of `gain_dn_per_e` [DN/e-]
    read_noise_e_stderr: float = 0.0  # standard error of `read_noise_e` [e-]
    black_level_dn_stderr: float = 0.0  # standard error of `black_level_dn` [DN]
    channel: str | None = None  # colour to read: red, green or blue; on a Bayer sensor green_r or green_b, not green
    bayer: str | None = None  # filter colours of the upper left 2 x 2 pixels, row by row, such as RGGB; None: no Bayer


@dataclass(frozen=True)
class Optics:
    """Section `optics`; None marks a missing key."""

    focal_length_m: float | None = None  # focal length of the lens [m]
    working_distance_m: float | None = None  # distance from sample to lens [m]
    f_number: float | None = None  # focal length over the diameter of the pupil
    filter_transmission: float | None = None  # transmission of the filter in front of the sensor, 0 to 1
    pixel_integration: bool = False  # whether a pixel reads the mean of the light over its area


@dataclass(frozen=True)
class Laser:
    """Section `laser`; None marks a missing key."""

    power_w: float | None = None  # power [W]
    wavelength_m: float | None = None  # wavelength [m]
    fwhm_x_m: float | None = None  # full width at half maximum on the sample along x [m]
    fwhm_y_m: float | None = None  # full width at half maximum on the sample along y [m]


@dataclass(frozen=True)
class Material:
    """Section `material`; None marks a missing key."""

    reflectance: float | None = None  # fraction of the light that the sample reflects


@dataclass(frozen=True)
class ModelChoice:
    """Section `model`: the baseline model of the simulation."""

    photon_budget: str = "linear"  # law of the peak over exposure time: spot_area, linear or free
    top_hat: bool = False  # whether the peak is cut at exp(-1/4) of it (Eqs. 39-40 of the paper)


@dataclass(frozen=True)
class Light:
    """Section `light`; None marks a missing key."""

    profile: str | None = None  # file with a light shape that was learned before; absolute path once read


@dataclass(frozen=True)
class BadPixels:
    """Section `bad_pixels`: pixels that are not used, by their column x and row y [px] from 0."""

    mask: str | None = None  # image whose non-zero pixels are bad; absolute path once read
    columns: tuple[int, ...] = ()  # x of whole columns
    rows: tuple[int, ...] = ()  # y of whole rows
    pixels: tuple[tuple[int, int], ...] = ()  # (x, y) of single pixels


# Source of a value that no file gives.
DEFAULT = "default"


@dataclass(frozen=True)
class Instrument:
    """The content of instrument.yaml with its defaults."""

    based_on: str | None = None  # shared instrument file that gives the missing keys; absolute path once read
    name: str | None = None  # title of the dataset
    order_known: bool = True  # whether the rows of the manifest are in the order of acquisition
    conditions: tuple[str, ...] = ()  # names of the declared conditions
    crop_px: int = 240  # side of the crops around spots [px]
    sensor: Sensor = field(default_factory=Sensor)  # section `sensor`
    optics: Optics = field(default_factory=Optics)  # section `optics`
    laser: Laser = field(default_factory=Laser)  # section `laser`
    material: Material = field(default_factory=Material)  # section `material`
    model: ModelChoice = field(default_factory=ModelChoice)  # section `model`
    light: Light = field(default_factory=Light)  # section `light`
    bad_pixels: BadPixels = field(default_factory=BadPixels)  # section `bad_pixels`
    given_keys: frozenset[str] = frozenset()  # keys that have a value in a file, such as "sensor.bit_depth"
    inherited_keys: frozenset[str] = frozenset()  # those of `given_keys` that only the shared file has

    def get_source(self, key: str) -> str:
        """Return the source of a key such as "sensor.gain_dn_per_e": `DEFAULT`, or the file as a phrase."""
        if key not in self.given_keys:
            return DEFAULT
        return self.get_file_name(key) + (", on which instrument.yaml is based" if key in self.inherited_keys else "")

    @property
    def files(self) -> list[Path]:
        """Existing files that instrument.yaml names: shared file, light profile, mask of bad pixels."""
        names = (self.based_on, self.light.profile, self.bad_pixels.mask)
        return [path for name in names if name and (path := Path(name)).exists()]

    def get_file_name(self, key: str) -> str:
        """Return the name of the file that has a key such as "sensor.bit_depth", or to which it should be added."""
        return Path(self.based_on).name if key in self.inherited_keys and self.based_on else "instrument.yaml"

    @property
    def laser_sigma_m(self) -> float | None:
        """Standard deviation σ_la of the laser [m]: the mean of both FWHM over 2√(2 ln 2); None if one is missing."""
        if self.laser.fwhm_x_m is None or self.laser.fwhm_y_m is None:
            return None
        return (self.laser.fwhm_x_m + self.laser.fwhm_y_m) / 2 / math.sqrt(8 * math.log(2))


# Dataclass of each section of instrument.yaml, by name.
SECTIONS: dict[str, Any] = {entry.name: entry.type for entry in fields(Instrument) if is_dataclass(entry.type)}
# Keys of sections and of the top level whose values are integers, or lists of them.
INTEGER_KEYS = ("crop_px", "bit_depth", "full_scale_dn", "value_shift_bits", "columns", "rows", "pixels")


def read_instrument(path: Path) -> Instrument:
    """Read and check instrument.yaml.

    Parameters
    ----------
    path : path of the file. If it does not exist, all keys have their defaults; a broken link is an error.

    Raises
    ------
    InputError
        For the first mistake, with its key.
    """
    if not path.exists() and not path.is_symlink():
        return Instrument()
    content = _read_content(path)
    keys_of_this_file = _list_keys(content)
    if "based_on" in content:
        content = _merge_shared_file(path, content)
    given_keys = _list_keys(content)
    sections = {name: section(**_convert_values(content.pop(name, {}))) for name, section in SECTIONS.items()}
    if sections["optics"].pixel_integration and sections["model"].top_hat:
        raise InputError(
            f"{path.name}: keys optics.pixel_integration and model.top_hat are both true; one of them must be false"
        )
    sections["sensor"] = _adapt_to_colour_plane(path, sections["sensor"], sections["optics"])
    content["conditions"] = tuple(content.get("conditions", ()))
    _check_conditions(path, content["conditions"])
    inherited_keys = given_keys - keys_of_this_file
    return Instrument(**_convert_values(content), **sections, given_keys=given_keys, inherited_keys=inherited_keys)


def _read_content(path: Path) -> dict[str, Any]:
    """Return the keys of one file, valid by the schema, with absolute paths of the files that it names.

    Sections are dictionaries. Raises `InputError`.
    """
    # A section without keys below it (`sensor:`) is an empty section, not an error.
    content = {key: ({} if value is None and key in SECTIONS else value) for key, value in read_keys(path).items()}
    if violation := find_violation(content, "instrument"):
        raise InputError(f"{path.name}: {violation}{_suggest_unit_for(content, violation)}")
    _resolve_path(path, content, "", "based_on", "an instrument file")
    _resolve_path(path, content, "light", "profile", "a light.nc")
    _resolve_path(path, content, "bad_pixels", "mask", "an image")
    return content


def _suggest_unit_for(content: dict[str, Any], violation: str) -> str:
    """Return in brackets the units in which a number outside its bounds would be usual; "" if there are none.

    `violation` is the sentence of `find_violation` on it; for other violations the result is "".
    """
    for key, usual_range in USUAL_RANGES.items():
        section, _, name = key.partition(".")
        if f"key {key} is " in violation and isinstance(content[section][name], int | float):
            suggestion = suggest_unit(content[section][name], usual_range)
            return f" ({suggestion})" if suggestion else ""
    return ""


def _resolve_path(path: Path, content: dict[str, Any], section: str, key: str, expected: str) -> None:
    """Replace the value of a key in `content`, if it is there, by an absolute path. Raises `InputError`.

    The value is a path relative to the folder of the file `path`. `section` is "" for a key of the top level, and
    `expected` says in a message what the file must be.
    """
    keys = content.get(section, {}) if section else content
    if key not in keys:
        return
    name, full_key = keys[key], f"{section}.{key}" if section else key
    # Snakemake takes braces for wildcards, and no path can contain NUL.
    if re.search("[{}\0]", name):
        raise InputError(f"{path.name}: key {full_key} is {name!r}; it must be a path without braces")
    file = path.parent / name
    if not name or not file.is_file():
        raise InputError(
            f"{path.name}: key {full_key} names {name!r}, which is not there; it must be the path of {expected},"
            " relative to the dataset folder"
        )
    keys[key] = str(file.resolve())


def _merge_shared_file(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a file, completed by those of the shared file on which it is based.

    The keys of the file itself take precedence, also within each section. The result has every section, perhaps empty.
    `content` is that of the file `path`, which a message names. Raises `InputError` if the shared file is based on
    another one.
    """
    shared = _read_content(Path(content["based_on"]))
    if "based_on" in shared:
        raise InputError(
            f"{path.name}: key based_on names {Path(content['based_on']).name}, which has such a key itself; a shared"
            " file must not be based on another one"
        )
    sections = {name: shared.get(name, {}) | content.get(name, {}) for name in SECTIONS}
    return shared | content | sections


def _list_keys(content: dict[str, Any]) -> frozenset[str]:
    """Return the names of the keys that have a value, with their section: "sensor.bit_depth"."""
    top_level = {name for name in content if name not in SECTIONS}
    return frozenset(top_level | {f"{name}.{key}" for name in SECTIONS for key in content.get(name, {})})


def _adapt_to_colour_plane(path: Path, sensor: Sensor, optics: Optics) -> Sensor:
    """Return the sensor with the pixel pitch of a colour plane, which is twice that of a Bayer sensor.

    Raises `InputError` for keys that exclude each other.
    """
    if sensor.bayer is None:
        if sensor.channel in ("green_r", "green_b"):
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


def _check_conditions(path: Path, conditions: tuple[str, ...]) -> None:
    """Raise `InputError` for the name of a condition that is reserved or not a word."""
    for condition in conditions:
        if condition in RESERVED:
            raise InputError(
                f"{path.name}: key conditions names {condition}, which has a meaning of its own; rename it"
            )
        if not re.fullmatch(r"[A-Za-z]\w{0,99}", condition):
            raise InputError(
                f"{path.name}: key conditions names {condition!r}; it must be a word of letters, digits and underscores"
            )


def _convert_values(section: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a section with the values of `INTEGER_KEYS` as integers, and their lists as tuples.

    The schema accepts a float such as 240.0, but indices of arrays must be integers.
    """
    return {key: _convert_integers(value) if key in INTEGER_KEYS else value for key, value in section.items()}


def _convert_integers(value: Any) -> Any:
    """Return a whole number as an integer, and nested lists of such numbers as nested tuples of integers."""
    return tuple(map(_convert_integers, value)) if isinstance(value, list) else int(value)
