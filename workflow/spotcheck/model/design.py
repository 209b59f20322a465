"""Simulate the frames of a design, and write them as a dataset that all stages accept."""

from pathlib import Path

import numpy as np

from spotcheck.dataset.folder import Dataset, load
from spotcheck.dataset.instrument import Instrument
from spotcheck.errors import InputError
from spotcheck.io import provenance
from spotcheck.model.baseline import of_instrument
from spotcheck.model.light import ExposureLaw
from spotcheck.model.model_file import ExtendedModel, read_model
from spotcheck.model.simulation import CANVAS, Destination, simulate_extended
from spotcheck.sensor import SensorModel
from spotcheck.sensor.model import check_sensor

# File of the mean light and the mean reading of every crop.
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
    width of the laser if instrument.yaml gives laser and optics. Its peak follows from the exposure. With a model.yaml
    the file gives spots and effects. Equal seeds give equal frames.

    Parameters
    ----------
    design : dataset folder whose manifest.csv names the frames and whose instrument.yaml describes camera and optics;
        its own images need not exist.
    folder : folder to write, which must not hold a dataset yet: manifest.csv, instrument.yaml, one TIFF stack in
        frames/, and expected.nc with the mean light and the mean reading of every crop.
    p1_px, p2_px : parameters of the width [px].
    peak_dn : peak of the Gaussian at the longest exposure [DN].
    model : model.yaml, such as a verdict writes, in place of these three.
    sensor : the camera; by default the one of instrument.yaml, which must then give gain, read noise and bit depth.
    seed : seed of all random numbers.

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
    measured, out = load(design), Path(folder)
    if (out / "manifest.csv").exists():
        raise InputError(f"{out}: holds a dataset; name another folder, or remove this one first")
    law = [p1_px, p2_px, peak_dn]
    if model is None:
        if None in law:
            raise InputError("simulate_dataset: p1_px, p2_px or peak_dn is missing; give all three, or a model.yaml")
        numbers = [float(value) for value in law if value is not None]
        name, extended = "simulate_dataset", _build_baseline_model(measured, ExposureLaw(*numbers))
    else:
        if law != [None] * 3:
            raise InputError("simulate_dataset: a model has p1_px, p2_px and peak_dn of its own; give it or these")
        name, extended = Path(model).name, read_model(Path(model))
    camera = read_data_sheet(measured.instrument) if sensor is None else check_sensor(sensor)
    if not np.isfinite(camera.full_scale_dn):
        raise InputError("sensor: full_scale_dn is infinite; give the largest reading, such as 1023 for 10 bit")
    inputs = [] if model is None else [model]
    destination = Destination(out, out / EXPECTED, seed, provenance.code_digest(__name__), inputs)
    simulate_extended(measured, extended, camera, destination, name)
    return load(out)


def read_data_sheet(instrument: Instrument) -> SensorModel:
    """Return the sensor of instrument.yaml. Raises `InputError` if gain, read noise or bit depth is missing."""
    sheet = instrument.sensor
    for key in ("gain_dn_per_e", "read_noise_e", "bit_depth"):
        if getattr(sheet, key) is None:
            raise InputError(f"instrument.yaml: key sensor.{key} is missing; give it, or a sensor")
    assert sheet.gain_dn_per_e is not None and sheet.read_noise_e is not None and sheet.bit_depth is not None
    return SensorModel(
        sheet.gain_dn_per_e,
        sheet.read_noise_e,
        sheet.dark_current_e_per_s,
        np.inf if sheet.full_well_e is None else sheet.full_well_e,
        sheet.black_level_dn,
        sheet.full_scale_dn or 2.0**sheet.bit_depth - 1,
        sheet.quantum_efficiency,
        sheet.response_bend,
    )


def _build_baseline_model(design: Dataset, law: ExposureLaw) -> ExtendedModel:
    """Return the paper's model without effects, with every spot in the middle of a frame larger than its crop."""
    baseline = of_instrument(design.instrument, design.exposures)
    if baseline.photon_budget == "free":
        raise InputError(
            "simulate_dataset: p1_px, p2_px and peak_dn are a law in exposure, and the design has no exposures or"
            " the photon budget free; give a model.yaml with a peak and a width for every spot"
        )
    widths = [float(baseline.sigma(t, law.p1, law.p2)) for t in design.exposures]
    if not (law.peak_dn > 0 and min(widths) > 0):
        raise InputError(
            f"simulate_dataset: peak_dn is {law.peak_dn:g} and the least width {min(widths):g} px; both must be above 0"
        )
    side = CANVAS * design.instrument.crop_px
    return ExtendedModel(law, baseline.longest_s, baseline.longest_s, side, side, (), {})
