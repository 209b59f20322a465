"""The true physical settings of a rig, read from `rig.yaml`: SI units, checked, unknown keys refused."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from rig.errors import RigError


def _within(low: float, high: float, default: Any) -> Any:
    """A field whose value must lie between two bounds, both included; others must only be finite."""
    return field(default=default, metadata={"bounds": (low, high)})


@dataclass(frozen=True)
class Frame:
    """The frame as it is read out; `window_px` is the side of the square in which light is followed."""

    width_px: int = _within(16, 65536, 4096)
    height_px: int = _within(16, 65536, 3072)
    window_px: int = _within(16, 4096, 320)


@dataclass(frozen=True)
class Sensor:
    """Chip and converter. The clip level is given in electrons and as relative scatter (rms)."""

    pixel_pitch_m: float = _within(1e-9, 1, 5.5e-6)  # distance of pixels [m]
    bit_depth: int = _within(8, 16, 10)  # bits of the converter
    gain_dn_per_e: float = _within(1e-9, 1e6, 0.11)  # gain K [DN/e-]
    quantum_efficiency: float = _within(0, 1, 0.38)  # electrons per photon [1]
    read_noise_e: float = _within(0, 1e6, 13.0)  # rms read noise [e-]
    dark_current_e_per_s: float = _within(0, 1e12, 70.0)  # dark current of a pixel [e-/s]
    black_level_dn: float = 0.0  # reading without light [DN]
    # mean level at which the signal stops [e-]; None for no clip below the converter
    clip_level_e: float | None = _within(0, 1e9, None)
    clip_pixel_scatter: float = _within(0, 0.2, 0.0)  # rms scatter of the level between pixels, relative [1]
    clip_row_scatter: float = _within(0, 0.2, 0.0)  # rms scatter of the level between rows, relative [1]
    # excess of the level in every `clip_row_period_px`-th row, relative [1]
    clip_row_step: float = _within(-0.5, 0.5, 0.0)
    clip_row_period_px: int = _within(2, 4096, 2)  # distance of rows with that excess [px]
    clip_screen_sigma: float = _within(0.5, 8, 3.0)  # largest deviation of a level in units of its scatter [1]


@dataclass(frozen=True)
class Optics:
    """Lens and filter in front of the chip."""

    focal_length_m: float = _within(1e-6, 1e3, 0.0502)  # focal length [m]
    working_distance_m: float = _within(1e-6, 1e6, 0.25)  # distance from lens to sample [m]
    f_number: float = _within(0.1, 1e3, 11.0)  # aperture f-number [1]
    filter_transmission: float = _within(0, 1, 0.9193)  # transmission of the filter [1]
    lens_transmission: float = _within(0, 1, 1.0)  # transmission of the lens [1]


@dataclass(frozen=True)
class Laser:
    """The spot laser; the polarisation's direction is counted like the fibre angle."""

    power_w: float = _within(0, 1e6, 1e-3)  # power [W]
    wavelength_m: float = _within(1e-8, 1e-3, 650e-9)  # wavelength [m]
    fwhm_x_m: float = _within(0, 1, 72.8e-6)  # full width at half maximum along x on the sample [m]
    fwhm_y_m: float = _within(0, 1, 80.4e-6)  # the same along y [m]
    polarisation_deg: float = 0.0  # direction of the polarisation [deg]


@dataclass(frozen=True)
class Material:
    """The composite: how much light comes back towards the lens, and how far it spreads before."""

    reflectance: float = _within(0, 1, 0.02)  # part of the light that is reflected [1]
    # With the lens and distance of Table 3, the paper's factor 1/f_a².
    # Light that the lens collects over that of a Lambertian surface [1].
    specular_gain: float = _within(0, 1e8, (2 * 0.25 / 0.0502) ** 2)
    # standard deviation of the spread of light along the fibres on the sample [m]
    spread_along_m: float = _within(0, 1, 280e-6)
    spread_across_m: float = _within(0, 1, 280e-6)  # the same across the fibres [m]
    # Relative amplitude of the spread over twice the angle between fibres and polarisation [1].
    spread_polarisation: float = _within(-0.9, 0.9, 0.0)
    reflectance_polarisation: float = _within(-0.99, 0.99, 0.0)  # the same of the reflectance [1]
    fibre_zero_deg: float = 0.0  # direction of the fibres in the image at angle_deg 0, from +x towards +y [deg]
    site_reflectance_scatter: float = _within(0, 3, 0.0)  # standard deviation of ln reflectance between sites [1]
    site_spread_scatter: float = _within(0, 3, 0.0)  # standard deviation of ln spread between sites [1]
    # exponent of reflectance to which the spread of a site is proportional [1]
    site_spread_exponent: float = _within(-3, 3, 0.0)


@dataclass(frozen=True)
class Pointing:
    """Place of the spot: mean offset from the frame's centre, walk from site to site, nearest border."""

    offset_x_px: float = 0.0
    offset_y_px: float = 0.0
    wander_px: float = _within(0, 1e5, 0.0)
    border_px: float = _within(0, 1e5, 200.0)


@dataclass(frozen=True)
class Speckle:
    """Independent patterns that add in intensity (0: no speckle), samples a pixel (per axis), side of the field."""

    patterns: int = _within(0, 10_000, 0)
    field_px: int = _within(16, 4096, 160)
    oversampling: int = _within(1, 8, 2)


@dataclass(frozen=True)
class Beam:
    """A plain beam falling on the camera: caustic w(z) for each axis, brightness by a target peak."""

    waist_x_m: float = _within(1e-7, 1, 60e-6)  # 1/e² radius of the waist along the first axis [m]
    waist_y_m: float = _within(1e-7, 1, 60e-6)  # the same along the second axis [m]
    focus_x_m: float = 0.0  # position of the waist of the first axis [m]
    focus_y_m: float = 0.0  # the same of the second axis [m]
    m2: float = _within(1, 1e3, 1.0)  # beam quality M² [1]
    axis_deg: float = 0.0  # direction of the first axis [deg]
    peak_fraction: float = _within(0, 100, 0.7)  # mean peak as a part of the range above the black level [1]
    peak_scatter: float = _within(0, 1, 0.0)  # relative scatter of the peak, cut at two standard deviations [1]


@dataclass(frozen=True)
class Settings:
    """Everything that is true of one rig. `source` is `fibres` (reflected spot) or `beam` (plain beam)."""

    seed: int = _within(0, 2**63, 0)  # seed of all random numbers
    source: str = "fibres"  # "fibres" or "beam"
    unrecorded_exposure_s: float = _within(0, math.inf, 1e-3)  # exposure where the manifest leaves it blank [s]
    frame: Frame = field(default_factory=Frame)  # size of the frame
    sensor: Sensor = field(default_factory=Sensor)  # chip and converter
    optics: Optics = field(default_factory=Optics)  # lens and filter
    laser: Laser = field(default_factory=Laser)  # spot laser
    material: Material = field(default_factory=Material)  # composite
    pointing: Pointing = field(default_factory=Pointing)  # place of the spot
    speckle: Speckle = field(default_factory=Speckle)  # granular light
    beam: Beam = field(default_factory=Beam)  # plain beam, if it is the source


def load(path: Path) -> Settings:
    """Settings from a YAML file; every fault is a `RigError` that names file and key."""
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RigError(f"{path}: is not YAML ({str(error).splitlines()[0]})") from error
    try:
        return from_dict(tree if tree is not None else {})
    except RigError as error:
        raise RigError(f"{path}: {error}") from error


def from_dict(tree: Any) -> Settings:
    """Settings from a plain tree, as YAML or JSON gives it."""
    settings = _build(Settings, tree, "")
    if settings.source not in ("fibres", "beam"):
        raise RigError(f"source: must be fibres or beam, not {settings.source!r}")
    return settings


def to_dict(settings: Settings) -> dict[str, Any]:
    """The plain tree of the settings, for the truth file."""
    return dataclasses.asdict(settings)


def replace(settings: Settings, changes: dict[str, Any]) -> Settings:
    """A copy with some dotted keys changed, e.g. `{"material.reflectance": 0.03}`."""
    tree = to_dict(settings)
    for key, value in changes.items():
        *branches, leaf = key.split(".")
        node = tree
        for branch in branches:
            node = node[branch]
        if leaf not in node:
            raise RigError(f"{key}: unknown key")
        node[leaf] = value
    return from_dict(tree)


def _build(cls: Any, tree: Any, where: str) -> Any:
    if not isinstance(tree, dict):
        raise RigError(f"{where.rstrip('.') or 'settings'}: must be a mapping of keys to values")
    hints = typing.get_type_hints(cls)
    unknown = [str(key) for key in tree if key not in hints]
    if unknown:
        raise RigError(f"{where}{unknown[0]}: unknown key")
    bounds = {item.name: item.metadata.get("bounds", (-math.inf, math.inf)) for item in dataclasses.fields(cls)}
    values = {}
    for key, value in tree.items():
        kind = hints[key]
        if dataclasses.is_dataclass(kind):
            values[key] = _build(kind, value, f"{where}{key}.")
        else:
            values[key] = _leaf(kind, value, f"{where}{key}", bounds[key])
    return cls(**values)


def _leaf(kind: Any, value: Any, name: str, bounds: tuple[float, float]) -> Any:
    optional = isinstance(kind, types.UnionType)
    if optional and value is None:
        return None
    wanted = typing.get_args(kind)[0] if optional else kind
    if wanted is str:
        if not isinstance(value, str):
            raise RigError(f"{name}: must be text, not {value!r}")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise RigError(f"{name}: must be a number, not {value!r}")
    try:
        # YAML 1.1 reads 1e-3 (no point) as text.
        number = float(value)
    except ValueError:
        raise RigError(f"{name}: must be a number, not {value!r}") from None
    low, high = bounds
    if not math.isfinite(number) or not low <= number <= high:
        raise RigError(f"{name}: must be a finite number from {low:g} to {high:g}, not {value!r}")
    if wanted is int:
        if number != int(number):
            raise RigError(f"{name}: must be a whole number, not {value!r}")
        return int(value)
    return number
