"""`spotcheck calibrate`: calibration.nc."""

import argparse

from spotcheck.characterization.sensor_choice import model_of
from spotcheck.dataset import folder as dataset
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR, calibrate
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck calibrate my-frames --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc \\
      --sensor out/my-frames/sensor.nc --output out/my-frames/calibration.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="calibration.nc to write")


def run(args: argparse.Namespace) -> None:
    """Calibrate and say p1 and p2, or why not."""
    instrument = dataset.load(args.dataset).instrument
    with store.read(args.crops) as crops, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        found = calibrate(crops, fits, instrument, model_of(sensor))
    inputs = [args.crops, args.fits, args.sensor]
    store.write(found, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    if "skipped" in found.attrs:
        print(f"skipped: {found.attrs['skipped']}")
    else:
        own = found.sel(estimator=SIMULATION_ESTIMATOR)
        for p in ("p1", "p2"):
            spread = float(own[f"{p}_sd_all"])
            print(
                f"{p} = {float(own[f'{p}_mean']):.3f}"
                + (f" ± {spread:.3f} px" if spread == spread else " px (one site)")
            )
