"""`spotcheck bounds`: bounds.nc."""

import argparse

import numpy as np

from spotcheck.characterization.sensor_choice import model_of
from spotcheck.dataset import folder as dataset
from spotcheck.fitting.bounds import compute_bounds
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck bounds my-frames --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc \\
      --output out/my-frames/bounds.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--calibration", required=True, help="calibration.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="bounds.nc to write")


def run(args: argparse.Namespace) -> None:
    """Bounds of the peak's photons and of σ_g."""
    found = dataset.load(args.dataset)
    exposures = np.array(found.exposures)
    with store.read(args.calibration) as calibration, store.read(args.sensor) as sensor:
        result = compute_bounds(calibration, found.instrument, exposures, model_of(sensor), found.instrument.crop_px)
    store.write(result, args.output, code=provenance.code_digest(__name__), inputs=[args.calibration, args.sensor])
    print(result.attrs.get("skipped", f"bounds at {result.sizes.get('fine_exposure', 0)} exposures"))
