"""Remarks on numbers of a dataset that are possible but unusual, found before any pixel is read.

Examples are a unit that is wrong by a factor of 1e3 or 1e6, and a slightly different exposure time in each frame.
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
    """Usual range of a number, in the unit of its key or column."""

    low: float  # smallest usual number
    high: float  # largest usual number
    units: Mapping[str, float] = MappingProxyType({})  # other units that users may mean: factor to the unit of the key


# Other units of lengths and times, with their factors to m and s.
LENGTH = {"mm": 1e-3, "µm": 1e-6, "nm": 1e-9}
TIME = {"ms": 1e-3, "µs": 1e-6}

# Usual ranges by key of instrument.yaml or column of manifest.csv. They are wide: cameras from mobile phones to
# uncooled InGaAs, light from deep ultraviolet to CO2 lasers.
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
# Usual absolute values of an axis in metres: a distance on an optical bench.
POSITION_RANGE = UsualRange(0.0, 20.0, LENGTH)


def suggest_unit(value: float, usual_range: UsualRange) -> str:
    """Return the other units in which a number would be in its usual range: "3.45 µm would be 3.45e-06".

    Several are separated by commas; "" if there are none.
    """
    low, high, units = usual_range
    converted = {unit: value * factor for unit, factor in units.items()}
    return ", ".join(
        f"{value:g} {unit} would be {number:.6g}" for unit, number in converted.items() if low <= number <= high
    )


def list_unusual_values(dataset: Dataset) -> list[str]:
    """Return a remark on each number of instrument.yaml and manifest.csv that is possible, but unusual."""
    return [*_check_instrument(dataset.instrument), *_check_manifest(dataset)]


def _check_range(name: str, value: float, usual_range: UsualRange) -> Iterator[str]:
    """Yield a remark on a number if it is outside its usual range; `name` says where it stands."""
    low, high, _ = usual_range
    if not low <= value <= high:
        suggestion = suggest_unit(value, usual_range)
        advice = f"; {suggestion}" if suggestion else ""
        yield f"{name} is {value:g}, and {low:g} to {high:g} is usual{advice}"


def _check_instrument(instrument: Instrument) -> Iterator[str]:
    """Yield remarks on the keys of instrument.yaml."""
    for key, usual_range in USUAL_RANGES.items():
        section, _, name = key.partition(".")
        if key in instrument.given_keys:
            value = getattr(getattr(instrument, section), name)
            yield from _check_range(f"{instrument.get_file_name(key)}: {key}", value, usual_range)
    focal_m, distance_m = instrument.optics.focal_length_m, instrument.optics.working_distance_m
    if focal_m is not None and distance_m is not None and distance_m <= focal_m:
        yield (
            f"instrument.yaml: optics.working_distance_m is {distance_m:g} and optics.focal_length_m {focal_m:g};"
            " a lens makes an image on a sensor only of what is farther away than its focal length"
        )


def _check_manifest(dataset: Dataset) -> Iterator[str]:
    """Yield remarks on the largest value and the spread of each column of manifest.csv that holds numbers."""
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
