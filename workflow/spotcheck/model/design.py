"""Simulate the frames of a design, and write them as a dataset that all stages of the workflow accept.

A design is a dataset folder whose manifest and instrument file describe frames and camera; its images are not read. The
baseline is the paper's model without effects.
"""

from dataclasses import fields
from pathlib import Path

import numpy as np

from spotcheck.dataset.folder import Dataset, load
from spotcheck.dataset.instrument import Instrument
from spotcheck.errors import InputError
from spotcheck.io import provenance
from spotcheck.model.baseline import build_baseline
from spotcheck.model.light import ExposureLaw
from spotcheck.model.model_file import ExtendedModel, read_model
from spotcheck.model.simulation import CANVAS, Destination, simulate_extended
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor

# Name of the file with the mean light and the mean reading of every crop.
EXPECTED = "expected.nc"


def simulate_dataset(
    design: str | Path,
    folder: str | Path,
    *,
    p1_px: float | None = None,
    p2_px: float | None = None,
    peak_dn: float | None = None,
    model: str | Path | None = None,
    sensor: SensorModel | None = None,
    seed: int = 0,
) -> Dataset:
    """Simulate random frames of a design and write them as a dataset folder.

    With p1, p2 and a peak, each spot is a round Gaussian whose width at an exposure t is p1 ln(t / 1 s) + p2, plus the
    width of the laser if instrument.yaml gives laser and optics. Its peak follows from the exposure. With a model.yaml,
    spots and effects (deviations from the baseline) are those of the file. Equal seeds give equal frames.

    Parameters
    ----------
    design : str or Path
        Dataset folder whose manifest.csv names the frames and whose instrument.yaml describes camera and optics; its
        own images need not exist.
    folder : str or Path
        Folder to write, which must not hold a dataset yet: manifest.csv, instrument.yaml, one TIFF stack in frames/,
        and expected.nc with the mean light and the mean reading of every crop.
    p1_px, p2_px : float, optional
        Parameters of the width [px].
    peak_dn : float, optional
        Peak of the Gaussian at the longest exposure [DN].
    model : str or Path, optional
        model.yaml, such as a verdict writes, in place of these three.
    sensor : SensorModel, optional
        The camera; by default the one of instrument.yaml, which must then give gain, read noise and bit depth.
    seed : int
        Seed of all random numbers.

    Returns
    -------
    Dataset
        The simulated dataset, as `read_dataset` gives it.

    Raises
    ------
    InputError
        If the design violates the dataset contract or has no spots, if the model does not fit the design, if the
        sensor is unknown, or if the folder holds a dataset already.

    Examples
    --------
    >>> import spotcheck
    >>> drawn = spotcheck.simulate_dataset("my-frames", "simulated", p1_px=1.2, p2_px=18, peak_dn=600, seed=1)
    >>> drawn
    <Dataset simulated: 18 spots over angle (2), exposure (3), repeat (3)>
    >>> spotcheck.read_image(drawn, drawn.spots[0]).shape
    (96, 96)
    """
    dataset, new_folder = load(design), Path(folder)
    if (new_folder / "manifest.csv").exists():
        raise InputError(f"{new_folder}: holds a dataset; name another folder, or remove this one first")
    name, extended = _choose_model(dataset, [p1_px, p2_px, peak_dn], model)
    camera = read_data_sheet(dataset.instrument) if sensor is None else check_sensor(sensor)
    if not np.isfinite(camera.full_scale_dn):
        raise InputError("sensor: full_scale_dn is infinite; give the largest reading, such as 1023 for 10 bit")
    inputs = [] if model is None else [model]
    destination = Destination(new_folder, new_folder / EXPECTED, seed, provenance.code_digest(__name__), inputs)
    simulate_extended(dataset, extended, camera, destination, name)
    return load(new_folder)


def _choose_model(design: Dataset, law: list[float | None], model: str | Path | None) -> tuple[str, ExtendedModel]:
    """Return a name for messages and the model to simulate: that of a model.yaml, or the baseline with an exposure law.

    `law` is p1 [px], p2 [px] and peak [DN]. Raises `InputError` unless either all three or `model` are given.
    """
    if model is not None:
        if law != [None] * 3:
            raise InputError("simulate_dataset: a model has p1_px, p2_px and peak_dn of its own; give it or these")
        return Path(model).name, read_model(Path(model))
    if None in law:
        raise InputError("simulate_dataset: p1_px, p2_px or peak_dn is missing; give all three, or a model.yaml")
    exposure_law = ExposureLaw(*(float(value) for value in law if value is not None))
    return "simulate_dataset", _build_baseline_model(design, exposure_law)


def read_data_sheet(instrument: Instrument) -> SensorModel:
    """Return the sensor of instrument.yaml. Raises `InputError` if gain, read noise or bit depth is missing."""
    sheet = instrument.sensor
    for key in ("gain_dn_per_e", "read_noise_e", "bit_depth"):
        if getattr(sheet, key) is None:
            raise InputError(f"instrument.yaml: key sensor.{key} is missing; give it, or a sensor")
    assert sheet.bit_depth is not None
    # `sheet` has all attributes of SensorModel under the same names; full well and full scale are None if unknown.
    numbers = {field.name: getattr(sheet, field.name) for field in fields(SensorModel)}
    numbers["full_well_e"] = np.inf if sheet.full_well_e is None else sheet.full_well_e
    numbers["full_scale_dn"] = sheet.full_scale_dn or 2.0**sheet.bit_depth - 1
    return SensorModel(**numbers)


def _build_baseline_model(design: Dataset, law: ExposureLaw) -> ExtendedModel:
    """Return the baseline of a design as a model without effects or known spots, for frames larger than a crop.

    Spots without a known place are simulated in the middle of the frame. Raises `InputError` if the design has no
    exposure law, or if the law gives a peak or a width that is not above 0.
    """
    baseline = build_baseline(design.instrument, design.exposures)
    if baseline.photon_budget == "free":
        raise InputError(
            "simulate_dataset: p1_px, p2_px and peak_dn are a law in exposure, and the design has no exposures or"
            " the photon budget free; give a model.yaml with a peak and a width for every spot"
        )
    least_px = min(float(baseline.sigma(exposure_s, law.p1, law.p2)) for exposure_s in design.exposures)
    if not (law.peak_dn > 0 and least_px > 0):
        raise InputError(
            f"simulate_dataset: peak_dn is {law.peak_dn:g} and the least width {least_px:g} px; both must be above 0"
        )
    # The law states the peak at the longest exposure. The reference exposure, which effects use, has no meaning here.
    side = CANVAS * design.instrument.crop_px
    return ExtendedModel(law, baseline.longest_s, baseline.longest_s, rows=side, columns=side, effects=(), spots={})
