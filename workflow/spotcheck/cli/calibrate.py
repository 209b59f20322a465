"""`spotcheck calibrate`: calibration.nc."""

import argparse
import math

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset import folder
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR, calibrate
from spotcheck.io import provenance, store

EXAMPLES = """spotcheck calibrate my-frames --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc \\
    --sensor out/my-frames/sensor.nc --output out/my-frames/calibration.nc"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="calibration.nc to write")


def run(args: argparse.Namespace) -> None:
    """Calibrate, and print p1 and p2 or why they are unknown."""
    instrument = folder.load(args.dataset).instrument
    with store.read(args.crops) as crops, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        calibration = calibrate(crops, fits, instrument, read_sensor_model(sensor))
    inputs = [args.crops, args.fits, args.sensor]
    store.write(calibration, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    if "skipped" in calibration.attrs:
        print(f"skipped: {calibration.attrs['skipped']}")
    else:
        used = calibration.sel(estimator=SIMULATION_ESTIMATOR)
        for name in ("p1", "p2"):
            scatter = float(used[f"{name}_sd_all"])
            error = " px (one site)" if math.isnan(scatter) else f" ± {scatter:.3f} px"
            print(f"{name} = {float(used[f'{name}_mean']):.3f}{error}")
