"""Characterisation of a sensor by its flats and darks after EMVA 1288, from arrays or from a dataset folder.

Flats are frames of uniform light, darks are frames without light. A level is all frames of one light and one exposure.
Photon transfer is the analysis of the noise of levels against their mean reading, which gives the gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.levels import add_common_drift, list_response_remarks, measure_level, measure_levels
from spotcheck.characterization.photon_transfer import Transfer, analyse_photon_transfer
from spotcheck.characterization.transfer_data import build_transfer_dataset
from spotcheck.crops.ingest import exclude_copies, ingest_frames
from spotcheck.dataset.folder import Dataset, load
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text


class Characterisation(dict[str, Quantity]):
    """Quantities of EMVA 1288 of a sensor by name, from its flats and darks.

    The value of each name has the attributes `value`, `stderr`, `unit`, `symbol` (of the standard) and `why`: the
    reason why the value is unknown (NaN), or "" if it is known. `list` of the object gives all names, `print` a table.

    Parameters
    ----------
    transfer : Transfer
        Photon transfer of the flats and darks.
    title, name : str
        Title and folder name of the dataset, for the table and for transfer.nc.

    Attributes
    ----------
    remarks : sentences on what could not be used.
    levels : the photon transfer, with lists of levels in its attributes `flats` and `darks`.

    Examples
    --------
    >>> import spotcheck
    >>> quantities = spotcheck.characterise_dataset("my-flats")
    >>> full_well = quantities["full_well"]
    >>> print(f"{full_well.value:.0f} ± {full_well.stderr:.0f} {full_well.unit}")
    12592 ± 260 e-
    >>> [name for name in quantities if quantities[name].why]
    []
    """

    def __init__(self, transfer: Transfer, title: str, name: str) -> None:
        super().__init__(transfer.quantities)
        self.levels, self.remarks = transfer, transfer.remarks
        self._title, self._name = title, name

    def __repr__(self) -> str:
        """Return a table: a title, one line for each quantity, and the remarks."""
        flat_count, dark_count = len(self.levels.flats), len(self.levels.darks)
        lines = [f"EMVA 1288 of {self._title}: {flat_count} levels of light, {dark_count} dark levels"]
        for quantity in self.values():
            value_text = f"unknown: {quantity.why}"
            if np.isfinite(quantity.value):
                value_text = quantity_text(quantity.value, quantity.stderr, quantity.unit)
            lines.append(f"{quantity.name:<24} {quantity.symbol:<9} {value_text}")
        return "\n".join([*lines, *self.remarks])

    def to_dataset(self) -> xr.Dataset:
        """Return the content of transfer.nc: quantities over `quantity`, levels over `flat` and `dark`, with units."""
        return build_transfer_dataset(self.levels, self._title, self._name)


def characterise_sensor(
    bright: Sequence[ArrayLike],
    dark: Sequence[ArrayLike],
    exposure_s: ArrayLike,
    photons: ArrayLike | None = None,
    *,
    bit_depth: int,
    dark_exposure_s: ArrayLike | None = None,
) -> Characterisation:
    """Characterise a sensor by EMVA 1288 from flats and darks, of which each level has two frames or more.

    The analysis follows EMVA 1288 Release 4.0 Linear: gain, dark noise, dark current, full well, quantum efficiency,
    sensitivity and linearity (sections 8.1 to 8.4), and non-uniformity as DSNU and PRNU. Each quantity has a standard
    error, or the reason why it is unknown. The standard asks for 50 levels from dark to saturation; quantities that
    fewer levels do not determine stay unknown.

    Parameters
    ----------
    bright : sequence of array_like
        Levels of light, each [frame, row, column] in DN with two frames or more of the same light; or all levels in one
        array [level, frame, row, column].
    dark : sequence of array_like
        Dark levels in the same form, one for each exposure.
    exposure_s : float or array_like
        Exposure of each level of light [s], or one number for all.
    photons : float or array_like, optional
        Mean number of photons on a pixel during the exposure, for each level of light, or one number for all. Without
        it quantum efficiency and responsivity are unknown, and linearity is that over exposure.
    bit_depth : int
        Bits of the converter, whose largest reading is 2^bit_depth − 1.
    dark_exposure_s : float or array_like, optional
        Exposure of each dark level [s]. It may be left out if the exposures are those of `bright`.

    Returns
    -------
    Characterisation
        Quantities by name.

    Raises
    ------
    ValueError
        Levels are not [frame, row, column], differ in size or have a single frame; there is not one exposure or photon
        number for each level; or readings exceed the bit depth. The message names the argument and the level.

    Examples
    --------
    Twelve levels of a sensor with 0.25 DN/e-, two frames each:

    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(0.25, 12, black_level_dn=40, full_scale_dn=4095, quantum_efficiency=0.6)
    >>> rng, photons = np.random.default_rng(1), np.linspace(2500, 30000, 12)
    >>> bright = [sensor.draw(np.full((2, 60, 80), mean), rng) for mean in photons]
    >>> dark = [sensor.draw(np.zeros((2, 60, 80)), rng) for mean in photons]
    >>> quantities = spotcheck.characterise_sensor(bright, dark, exposure_s=1e-3, photons=photons, bit_depth=12)
    >>> print(quantities["gain"])
    K = 0.2493 ± 0.0027 DN/e-
    >>> print(quantities["quantum_efficiency"])
    η = 0.601 ± 0.007
    >>> print(quantities["dark_current"])
    μ_I is unknown: fewer than three exposures of darks
    """
    if not 1 <= bit_depth <= 16:
        raise ValueError(f"bit_depth: is {bit_depth!r}; it must be from 1 to 16")
    full_scale_dn = 2.0**bit_depth - 1
    # Lists of arrays [frame, row, column], one for each level.
    flats, darks = _check_levels(bright, "bright", full_scale_dn), _check_levels(dark, "dark", full_scale_dn)
    sizes = {stack.shape[1:] for stack in (*flats, *darks)}
    if len(sizes) > 1:
        shapes = " and ".join(f"{rows} × {columns}" for rows, columns in sorted(sizes)[:2])
        raise ValueError(f"bright, dark: have frames of {shapes} pixels; all must have one size")
    flat_exposures_s = _expand_to_levels(exposure_s, len(flats), "exposure_s", "bright")
    if dark_exposure_s is None:
        if np.ndim(exposure_s) and len(darks) != len(flats):
            raise ValueError(
                f"dark_exposure_s: is missing, and dark has {len(darks)} levels where bright has {len(flats)};"
                " give the exposure of every dark level"
            )
        dark_exposure_s = exposure_s
    dark_exposures_s = _expand_to_levels(dark_exposure_s, len(darks), "dark_exposure_s", "dark")
    flat_photons = np.full(len(flats), np.nan)
    if photons is not None:
        flat_photons = _expand_to_levels(photons, len(flats), "photons", "bright")
    # The kind, and of each level the frames, the exposure [s] and the photons.
    kinds = (("dark", darks, dark_exposures_s, [0.0] * len(darks)), ("flat", flats, flat_exposures_s, flat_photons))
    levels = [
        measure_level(stack, kind, level_exposure_s, level_photons, full_scale_dn)
        for kind, *columns in kinds
        for stack, level_exposure_s, level_photons in zip(*columns, strict=True)
    ]
    transfer = analyse_photon_transfer(add_common_drift(levels), full_scale_dn)
    return Characterisation(transfer, "frames in memory", "frames in memory")


def characterise_dataset(folder: str | Path) -> Characterisation:
    """Characterise the sensor of a dataset folder by its flats and darks, as `characterise_sensor` does for arrays.

    Frames with the same light (column `photons_per_px` of manifest.csv) and exposure form a level; without the column,
    those with the same exposure. Noise needs two or more frames of a level; a remark counts the levels with a single
    frame. Copies of frames are left out, and frames with keep = no in manifest.csv.

    Raises
    ------
    InputError
        The folder lacks the required form (manifest.csv, instrument.yaml and frames), or has neither flats nor darks.

    Examples
    --------
    >>> import spotcheck
    >>> quantities = spotcheck.characterise_dataset("my-flats")
    >>> print(quantities["gain"])
    K = 0.304 ± 0.004 DN/e-
    """
    dataset = load(folder)
    if not any(frame.kind in ("flat", "dark") for frame in dataset.frames):
        raise InputError(
            "manifest.csv: has no frame of kind flat or dark; there is nothing to characterise a sensor by"
        )
    frame_table = ingest_frames(dataset)
    transfer = analyse_ingested_frames(exclude_copies(dataset, frame_table), float(frame_table["full_scale"]))
    transfer.remarks.extend(store.remarks_of(frame_table))
    return Characterisation(transfer, dataset.title, dataset.name)


def analyse_ingested_frames(dataset: Dataset, full_scale_dn: float) -> Transfer:
    """Return the photon transfer of the flats and darks of a dataset.

    Parameters
    ----------
    dataset : Dataset
        Dataset without the frames that are copies or have keep = no, see `exclude_copies`.
    full_scale_dn : float
        Largest reading of the converter [DN].

    Returns
    -------
    Transfer
        Its remarks say what could not be used, and whether the response curvature of the data sheet was corrected.
    """
    transfer = analyse_photon_transfer(measure_levels(dataset, full_scale_dn), full_scale_dn)
    transfer.remarks.extend(list_response_remarks(dataset))
    return transfer


def _check_levels(levels: Sequence[ArrayLike], name: str, full_scale_dn: float) -> list[np.ndarray]:
    """Return levels as arrays [frame, row, column]; raise ValueError if one cannot be used.

    Readings in DN must be finite and at most `full_scale_dn`, and each level needs two frames. `name` is that of the
    argument in the message.
    """
    stacks = [np.asarray(level) for level in levels]
    if not stacks:
        raise ValueError(f"{name}: holds no level; give at least one pair of frames")
    for index, stack in enumerate(stacks):
        where = f"{name}: level {index}"
        if stack.ndim != 3 or not stack.size:
            raise ValueError(f"{where} has the shape {stack.shape}; it must be [frame, row, column] with two frames")
        if len(stack) < 2:
            raise ValueError(f"{where} has a single frame, and noise needs two of one light")
        if not np.isfinite(stack).all():
            raise ValueError(f"{where} holds NaN or infinity; every pixel must have a reading")
        if stack.max() > full_scale_dn:
            raise ValueError(f"{where} holds {stack.max():g} DN, above the {full_scale_dn:g} of bit_depth; correct it")
    return stacks


def _expand_to_levels(values: ArrayLike, count: int, name: str, levels_name: str) -> np.ndarray:
    """Return one number for each level [level] from a number for all levels or an array [level].

    Raises ValueError if the array has another length than `count`, or a number is negative or not finite. `name` and
    `levels_name` are those of the arguments in the message.
    """
    numbers = np.asarray(values, dtype=float)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != count):
        raise ValueError(
            f"{name}: has the shape {numbers.shape}, but {levels_name} has {count} levels; give one number a level"
        )
    if not (np.isfinite(numbers) & (numbers >= 0)).all():
        raise ValueError(f"{name}: holds a number that is not finite, or below 0")
    return np.broadcast_to(numbers, (count,))
