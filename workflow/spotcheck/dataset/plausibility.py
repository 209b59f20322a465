"""Remarks on numbers of a dataset that are possible but unusual, found before any pixel is read.

Examples are a unit that is off by 1e3 or 1e6, and an exposure time of its own for every frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.dataset.conditions import check_spread

if TYPE_CHECKING:
    from spotcheck.dataset.folder import Dataset
    from spotcheck.dataset.instrument import Instrument


class UsualRange(NamedTuple):
    """Usual range of a number, in the unit of its key."""

    low: float  # smallest usual number
    high: float  # largest usual number
    units: Mapping[str, float] = MappingProxyType({})  # other units that users may mean: factor to the unit of the key


LENGTH = {"mm": 1e-3, "µm": 1e-6, "nm": 1e-9}
TIME = {"ms": 1e-3, "µs": 1e-6}

# Wide ranges: cameras from mobile phones to uncooled InGaAs, light from deep ultraviolet to CO2 lasers. A number
# outside is worth a second look.
USUAL_RANGES = {
    "sensor.pixel_pitch_m": UsualRange(0.5e-6, 100e-6, LENGTH),
    "sensor.gain_dn_per_e": UsualRange(1e-4, 1e2),
    "sensor.read_noise_e": UsualRange(0.1, 2e3),
    "sensor.dark_current_e_per_s": UsualRange(0.0, 1e7),
    "sensor.full_well_e": UsualRange(200.0, 1e7, {"ke-": 1e3}),
    "optics.focal_length_m": UsualRange(0.5e-3, 5.0, LENGTH),
    "optics.working_distance_m": UsualRange(0.5e-3, 20.0, LENGTH),
    "optics.f_number": UsualRange(0.5, 128.0),
    "laser.power_w": UsualRange(1e-9, 50.0, {"mW": 1e-3, "µW": 1e-6}),
    "laser.wavelength_m": UsualRange(100e-9, 20e-6, LENGTH),
    "laser.fwhm_x_m": UsualRange(0.2e-6, 0.5, LENGTH),
    "laser.fwhm_y_m": UsualRange(0.2e-6, 0.5, LENGTH),
    "exposure_s": UsualRange(0.0, 60.0, TIME),
    "angle_deg": UsualRange(-360.0, 360.0),
}
# Largest absolute value of a declared condition in metres: a distance on an optical bench.
POSITION_RANGE = UsualRange(0.0, 20.0, LENGTH)


def suggest_unit(value: float, usual: UsualRange) -> str:
    """Return in which other units a number would lie in its usual range, such as "3.45 µm would be 3.45e-06"."""
    converted = {unit: value * factor for unit, factor in usual.units.items()}
    return ", ".join(
        f"{value:g} {unit} would be {number:.6g}"
        for unit, number in converted.items()
        if usual.low <= number <= usual.high
    )


def list_unusual_values(dataset: Dataset) -> list[str]:
    """Return a remark on each number of instrument.yaml and manifest.csv that is possible, but unusual."""
    return [*_check_instrument(dataset.instrument), *_check_manifest(dataset)]


def _check_range(name: str, value: float, usual: UsualRange) -> Iterator[str]:
    """Yield a remark on a number outside its usual range."""
    if not usual.low <= value <= usual.high:
        suggestion = suggest_unit(value, usual)
        advice = f"; {suggestion}" if suggestion else ""
        yield f"{name} is {value:g}, and {usual.low:g} to {usual.high:g} is usual{advice}"


def _check_instrument(instrument: Instrument) -> Iterator[str]:
    """Yield remarks on the keys of instrument.yaml."""
    for key, usual in USUAL_RANGES.items():
        section, _, name = key.partition(".")
        if key in instrument.given_keys:
            value = getattr(getattr(instrument, section), name)
            yield from _check_range(f"{instrument.get_file_name(key)}: {key}", value, usual)
    focal, distance = instrument.optics.focal_length_m, instrument.optics.working_distance_m
    if focal is not None and distance is not None and distance <= focal:
        yield (
            f"instrument.yaml: optics.working_distance_m is {distance:g} and optics.focal_length_m {focal:g}; a lens"
            " makes an image on a sensor only of what is farther away than its focal length"
        )


def _check_manifest(dataset: Dataset) -> Iterator[str]:
    """Yield remarks on the columns of manifest.csv."""
    for column in ("exposure_s", "angle_deg"):
        values = [value for frame in dataset.frames if (value := getattr(frame, column)) is not None]
        if values:
            yield from _check_range(f"manifest.csv: the largest {column}", max(values, key=abs), USUAL_RANGES[column])
        yield from check_spread(column, [getattr(frame, column) for frame in dataset.spots])
    for axis in dataset.axes:
        if axis.units == "m" and axis.values is not None:
            largest = max(map(abs, axis.values))
            yield from _check_range(f"manifest.csv: the largest {axis.name}", largest, POSITION_RANGE)
    for column in dataset.instrument.conditions:
        yield from check_spread(column, [float(frame.extra[column]) for frame in dataset.spots])
