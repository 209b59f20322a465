"""`spotcheck bounds`: writes bounds.nc, the Cramér-Rao bounds of fits over exposure time.

A bound is the smallest standard error that an unbiased fit can have. σ_g is the width of the Gaussian spot.

Examples
--------
spotcheck bounds my-frames --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc \\
    --output out/my-frames/bounds.nc
"""

import argparse

import numpy as np

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.bounds import compute_bounds
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--calibration", required=True, help="calibration.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="bounds.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write the bounds of the photons at the peak and of σ_g [px] over exposure time.

    Prints the number of exposures, or why there are no bounds.
    """
    dataset = folder.load(args.dataset)
    instrument, exposures_s = dataset.instrument, np.array(dataset.exposures)
    with store.read(args.calibration) as calibration, store.read(args.sensor) as sensor:
        # Without a sensor model (None) or a calibration, the attribute `skipped` says why there are no bounds.
        result = compute_bounds(calibration, instrument, exposures_s, read_sensor_model(sensor), instrument.crop_px)
    store.write(result, args.output, code=provenance.code_digest(__name__), inputs=[args.calibration, args.sensor])
    print(result.attrs.get("skipped", f"bounds at {result.sizes.get('fine_exposure', 0)} exposures"))
