"""`spotcheck precision`: writes precision.nc, the scatter of fits over repeats beside the Cramér-Rao bound.

The bound is the smallest standard error that an unbiased fit can have.

Examples
--------
spotcheck precision my-frames --fits out/my-frames/fits.nc out/my-frames/simulated/fits.nc \\
    --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc --output out/my-frames/precision.nc
"""

import argparse

import numpy as np

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.precision import compute_precision
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--fits", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="fits.nc of both")
    parser.add_argument("--calibration", required=True, help="calibration.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="precision.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write scatter and bounds of measured and simulated fits, and the bound over exposure time.

    Prints the reason if there is no scatter (`skipped`), or no bound over exposure time (`no_design`).
    """
    dataset = folder.load(args.dataset)
    with (
        store.read_files(dict(zip(("measured", "simulated"), args.fits, strict=True))) as fits,
        store.read(args.calibration) as calibration,
        store.read(args.sensor) as sensor,
    ):
        exposures_s, side = np.array(dataset.exposures), dataset.instrument.crop_px
        result = compute_precision(fits, calibration, dataset.instrument, exposures_s, read_sensor_model(sensor), side)
    inputs = [*args.fits, args.calibration, args.sensor]
    store.write(result, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(result.attrs.get("skipped") or result.attrs.get("no_design") or "scatter and bounds written")
