"""What is odd about the numbers of a dataset before any pixel is read: a unit that is off by 1e3 or 1e6, an exposure of
its own for every frame. Such numbers are possible, so these are remarks and not refusals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.dataset import conditions

if TYPE_CHECKING:
    from spotcheck.dataset.folder import Dataset


class Usual(NamedTuple):
    """From where to where a number usually lies, in the unit of its key; and how much of that unit others are."""

    low: float
    high: float
    units: Mapping[str, float] = MappingProxyType({})


LENGTH = {"mm": 1e-3, "µm": 1e-6, "nm": 1e-9}
TIME = {"ms": 1e-3, "µs": 1e-6}

# Ranges of the field, each wide enough that what lies outside is worth a second look: cameras from mobile phones to
# uncooled InGaAs, light from deep ultraviolet to CO2 lasers.
USUAL = {
    "sensor.pixel_pitch_m": Usual(0.5e-6, 100e-6, LENGTH),
    "sensor.gain_dn_per_e": Usual(1e-4, 1e2),
    "sensor.read_noise_e": Usual(0.1, 2e3),
    "sensor.dark_current_e_per_s": Usual(0.0, 1e7),
    "sensor.full_well_e": Usual(200.0, 1e7, {"ke-": 1e3}),
    "optics.focal_length_m": Usual(0.5e-3, 5.0, LENGTH),
    "optics.working_distance_m": Usual(0.5e-3, 20.0, LENGTH),
    "optics.f_number": Usual(0.5, 128.0),
    "laser.power_w": Usual(1e-9, 50.0, {"mW": 1e-3, "µW": 1e-6}),
    "laser.wavelength_m": Usual(100e-9, 20e-6, LENGTH),
    "laser.fwhm_x_m": Usual(0.2e-6, 0.5, LENGTH),
    "laser.fwhm_y_m": Usual(0.2e-6, 0.5, LENGTH),
    "exposure_s": Usual(0.0, 60.0, TIME),
    "angle_deg": Usual(-360.0, 360.0),
}
# A declared condition in metres is a distance on an optical bench; by its largest number, whatever its sign.
POSITION = Usual(0.0, 20.0, LENGTH)


def hint(value: float, usual: Usual) -> str:
    """In which other units a number would be a usual one, as half a sentence; "" where in none."""
    within = [(unit, value * size) for unit, size in usual.units.items() if usual.low <= value * size <= usual.high]
    return ", ".join(f"{value:g} {unit} would be {right:.6g}" for unit, right in within)


def remark(where: str, value: float, usual: Usual) -> str:
    """The sentence on a number that is not usual; "" where it is."""
    if usual.low <= value <= usual.high:
        return ""
    right = hint(value, usual)
    return f"{where} is {value:g}, and {usual.low:g} to {usual.high:g} is usual{f'; {right}' if right else ''}"


def remarks_on(dataset: Dataset) -> list[str]:
    """All that is odd about the data sheet and the manifest of a dataset, a sentence each."""
    return [text for text in (*_on_the_sheet(dataset), *_on_the_manifest(dataset)) if text]


def _on_the_sheet(dataset: Dataset) -> Iterator[str]:
    instrument = dataset.instrument
    for key, usual in USUAL.items():
        section, _, name = key.partition(".")
        if key in instrument.given:
            yield remark(f"{instrument.file_of(key)}: {key}", getattr(getattr(instrument, section), name), usual)
    focal, distance = instrument.optics.focal_length_m, instrument.optics.working_distance_m
    if focal is not None and distance is not None and distance <= focal:
        yield (
            f"instrument.yaml: optics.working_distance_m is {distance:g} and optics.focal_length_m {focal:g}; a lens"
            " makes an image on a sensor only of what is farther away than its focal length"
        )


def _on_the_manifest(dataset: Dataset) -> Iterator[str]:
    for column in ("exposure_s", "angle_deg"):
        values = [value for frame in dataset.frames if (value := getattr(frame, column)) is not None]
        if values:
            yield remark(f"manifest.csv: the largest {column}", max(values, key=abs), USUAL[column])
    for axis in dataset.axes:
        if axis.units == "m" and axis.values is not None:
            yield remark(f"manifest.csv: the largest {axis.name}", max(map(abs, axis.values)), POSITION)
    for column in ("exposure_s", "angle_deg"):
        yield from conditions.remarks_on(column, [getattr(frame, column) for frame in dataset.spots])
    for name in dataset.instrument.conditions:
        yield from conditions.remarks_on(name, [float(frame.extra[name]) for frame in dataset.spots])
