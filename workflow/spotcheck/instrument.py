"""instrument.yaml: its keys with their defaults, and one sentence for each thing that can be wrong with it."""

import math
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, best_match

from spotcheck.errors import InputError
from spotcheck.manifest import REQUIRED_COLUMNS

SCHEMAS = Path(__file__).parents[1] / "schemas"
# No condition may bear the name of a standard column, or of a dimension or variable of the results.
RESERVED = {*REQUIRED_COLUMNS, "page", "angle", "exposure", "repeat", "y", "x", "row", "column", "block_y", "block_x"}
RESERVED |= {"status", "centring", "source", "parameter", "estimator", "frame", "registration", "data_range"}


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
