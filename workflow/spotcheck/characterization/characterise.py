"""A sensor by its flats and darks after EMVA 1288, from arrays or from a dataset folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from spotcheck.characterization.levels import Level, level_of, levels_of, on_response, with_common_drift
from spotcheck.characterization.photon_transfer import Quantity, Transfer, transfer_of
from spotcheck.characterization.transfer_data import dataset_of, quantities_in
from spotcheck.crops.ingest import exclude_copies, ingest_frames
from spotcheck.dataset.folder import load
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.io.plus_minus import plus_minus


class Characterisation(Mapping[str, Quantity]):
    """What flats and darks tell of a sensor: the quantities of EMVA 1288 by name.

    A mapping: `found["gain"]` has `value`, `stderr`, `unit`, `symbol` of the standard, and `why` it is not known ("" if
    it is; the value is then NaN). `list(found)` has all names, and `print(found)` a table.

    Attributes
    ----------
    remarks : sentences on what could not be used.
    levels : the levels of light and the dark levels that all of it rests on, with their signal and noise over dark.

    Examples
    --------
    >>> import spotcheck
    >>> found = spotcheck.characterise_dataset("my-flats")
    >>> full_well = found["full_well"]
    >>> print(f"{full_well.value:.0f} ± {full_well.stderr:.0f} {full_well.unit}")
    12592 ± 260 e-
    >>> [name for name in found if found[name].why]
    []
    """

    def __init__(self, levels: Transfer, title: str, name: str) -> None:
        self.levels, self.remarks = levels, levels.remarks
        self._title, self._name = title, name
        self._quantities = quantities_in(levels)

    def __getitem__(self, name: str) -> Quantity:
        return self._quantities[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._quantities)

    def __len__(self) -> int:
        return len(self._quantities)

    def __repr__(self) -> str:
        flats, darks = len(self.levels.flats), len(self.levels.darks)
        lines = [f"EMVA 1288 of {self._title}: {flats} levels of light, {darks} dark levels"]
        for own in self.values():
            known = np.isfinite(own.value)
            unit = "" if own.unit == "1" else own.unit
            text = plus_minus(own.value, own.stderr, unit) if known else f"unknown: {own.why}"
            lines.append(f"{own.name:<24} {own.symbol:<9} {text}")
        return "\n".join([*lines, *self.remarks])

    def to_dataset(self) -> xr.Dataset:
        """All quantities over `quantity` and every level over `flat` and `dark`, with units and long names, as in
        transfer.nc."""
        return dataset_of(self.levels, self._title, self._name)


def characterise_sensor(
    bright: Sequence[ArrayLike],
    dark: Sequence[ArrayLike],
    exposure_s: ArrayLike,
    photons: ArrayLike | None = None,
    *,
    bit_depth: int,
    dark_exposure_s: ArrayLike | None = None,
) -> Characterisation:
    """Characterise a sensor by pairs of evenly lit frames and pairs of dark frames (EMVA 1288 Release 4.0 Linear).

    Gain, dark noise, dark current, full well, quantum efficiency, sensitivity, linearity (sections 8.1 to 8.4), and
    non-uniformity as DSNU and PRNU, each with a standard error or the reason why it is not known. The standard asks for
    50 levels from dark to saturation; what fewer do not tell stays unknown.

    Parameters
    ----------
    bright : levels of light, each [frame, row, column] in DN with two frames or more of one light; or all in one array
        [level, frame, row, column].
    dark : the same without light, a level an exposure.
    exposure_s : exposure of every level of light [s], or one number for all.
    photons : mean number of photons on a pixel during the exposure, for every level of light. Without it nothing is
        said of quantum efficiency, and linearity is that over exposure.
    bit_depth : bits of the converter: readings end at 2^bit_depth − 1.
    dark_exposure_s : exposure of every dark level [s]; not needed where there are as many as levels of light, at the
        same exposures.

    Returns
    -------
    Characterisation
        Quantities by name.

    Raises
    ------
    ValueError
        Levels that are not [frame, row, column], of different sizes, or of a single frame; exposures or photons that
        are not one a level; readings above the bit depth. The text says which.

    Examples
    --------
    Twelve levels of a sensor with 0.25 DN/e-, two frames each:

    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(0.25, 12, black_level_dn=40, full_scale_dn=4095, quantum_efficiency=0.6)
    >>> rng, photons = np.random.default_rng(1), np.linspace(2500, 30000, 12)
    >>> bright = [sensor.draw(np.full((2, 60, 80), mean), rng) for mean in photons]
    >>> dark = [sensor.draw(np.zeros((2, 60, 80)), rng) for mean in photons]
    >>> found = spotcheck.characterise_sensor(bright, dark, exposure_s=1e-3, photons=photons, bit_depth=12)
    >>> print(found["gain"])
    K = 0.2493 ± 0.0027 DN/e-
    >>> print(found["quantum_efficiency"])
    η = 0.6015 ± 0.0066
    >>> print(found["dark_current"])
    μ_I is unknown: fewer than three exposures of darks
    """
    full_scale = _full_scale(bit_depth)
    light, unlit = _stacks(bright, "bright", full_scale), _stacks(dark, "dark", full_scale)
    sizes = {stack.shape[1:] for stack in (*light, *unlit)}
    if len(sizes) > 1:
        shapes = " and ".join(f"{rows} × {columns}" for rows, columns in sorted(sizes)[:2])
        raise ValueError(f"bright, dark: have frames of {shapes} pixels; all must have one size")
    seconds = _each(exposure_s, len(light), "exposure_s", "bright")
    if dark_exposure_s is None and np.ndim(exposure_s) and len(unlit) != len(light):
        raise ValueError(
            f"dark_exposure_s: is missing, and dark has {len(unlit)} levels where bright has {len(light)};"
            " give the exposure of every dark level"
        )
    dark_seconds = _each(exposure_s if dark_exposure_s is None else dark_exposure_s, len(unlit), "dark_exposure_s",
                         "dark")  # fmt: skip
    quanta = np.full(len(light), np.nan) if photons is None else _each(photons, len(light), "photons", "bright")
    levels: list[Level] = []
    for kind, stacks, times, numbers in (
        ("dark", unlit, dark_seconds, np.zeros(len(unlit))),
        ("flat", light, seconds, quanta),
    ):
        for stack, time, number in zip(stacks, times, numbers, strict=True):
            levels.append(level_of(stack, kind, float(time), float(number), full_scale))
    found = transfer_of(with_common_drift(levels), full_scale)
    return Characterisation(found, "frames in memory", "frames in memory")


def characterise_dataset(folder: str | Path) -> Characterisation:
    """Characterise the sensor of a dataset folder by its frames of kind `flat` and `dark`, as `characterise_sensor`.

    Frames of one light (column `photons_per_px`) and one exposure are a level; two or more of each are needed. Raises
    `InputError` for a folder that breaks the dataset contract or has neither flats nor darks.

    Examples
    --------
    >>> import spotcheck
    >>> found = spotcheck.characterise_dataset("my-flats")
    >>> print(found["gain"])
    K = 0.3038 ± 0.0036 DN/e-
    """
    dataset = load(folder)
    if not any(frame.kind in ("flat", "dark") for frame in dataset.frames):
        raise InputError(
            "manifest.csv: has no frame of kind flat or dark; there is nothing to characterise a sensor by"
        )
    table = ingest_frames(dataset)
    full_scale = float(table["full_scale"])
    found = transfer_of(levels_of(exclude_copies(dataset, table), full_scale), full_scale)
    found.remarks.extend([*on_response(dataset), *store.remarks_of(table)])
    return Characterisation(found, dataset.title, dataset.name)


def _full_scale(bit_depth: int) -> float:
    if not 1 <= bit_depth <= 16:
        raise ValueError(f"bit_depth: is {bit_depth!r}; it must be from 1 to 16")
    return 2.0**bit_depth - 1


def _stacks(levels: Sequence[ArrayLike], name: str, full_scale: float) -> list[np.ndarray]:
    """Every level as [frame, row, column]."""
    out = [np.asarray(level) for level in levels]
    if not out:
        raise ValueError(f"{name}: holds no level; give at least one pair of frames")
    for number, stack in enumerate(out):
        if stack.ndim != 3 or not stack.size:
            raise ValueError(
                f"{name}: level {number} has the shape {stack.shape}; it must be [frame, row, column] with two frames"
            )
        if len(stack) < 2:
            raise ValueError(f"{name}: level {number} has a single frame, and noise needs two of one light")
        if not np.isfinite(stack).all():
            raise ValueError(f"{name}: level {number} holds NaN or infinity; every pixel must have a reading")
        if stack.max() > full_scale:
            raise ValueError(
                f"{name}: level {number} holds {stack.max():g} DN, above the {full_scale:g} of bit_depth; correct it"
            )
    return out


def _each(values: ArrayLike, count: int, name: str, of: str) -> np.ndarray:
    """One number a level, 0 or above."""
    out = np.asarray(values, dtype=float)
    if out.ndim > 1 or (out.ndim == 1 and len(out) != count):
        raise ValueError(f"{name}: has the shape {out.shape}, but {of} has {count} levels; give one number a level")
    if not (np.isfinite(out) & (out >= 0)).all():
        raise ValueError(f"{name}: holds a number that is not finite, or below 0")
    return np.broadcast_to(out, (count,))
