"""`spotcheck precision`: precision.nc."""

import argparse

import numpy as np

from spotcheck.characterization.sensor_choice import model_of
from spotcheck.dataset import folder as dataset
from spotcheck.fitting.precision import compute_precision
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck precision my-frames --fits out/my-frames/fits.nc out/my-frames/simulated/fits.nc \\
      --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc --output out/my-frames/precision.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--fits", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="fits.nc of both")
    parser.add_argument("--calibration", required=True, help="calibration.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="precision.nc to write")


def run(args: argparse.Namespace) -> None:
    """Scatter over repeats against the bound, and the bound over exposure."""
    found = dataset.load(args.dataset)
    fits = {name: store.read(path) for name, path in zip(("measured", "simulated"), args.fits, strict=True)}
    with store.read(args.calibration) as calibration, store.read(args.sensor) as sensor:
        result = compute_precision(
            fits,
            calibration,
            found.instrument,
            np.array(found.exposures),
            model_of(sensor),
            found.instrument.crop_px,
        )
    inputs = [*args.fits, args.calibration, args.sensor]
    store.write(result, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(result.attrs.get("skipped") or result.attrs.get("no_design") or "scatter and bounds written")
