"""`spotcheck simulate`: simulated.nc and the folder of simulated frames."""

import argparse
from pathlib import Path

from spotcheck import dataset, provenance, simulation, store
from spotcheck.estimate.sensor import model_of


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--calibration", required=True, help="calibration.nc")
    parser.add_argument("--fits", required=True, help="fits.nc")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--seed", type=int, required=True, help="seed of the random draws")
    parser.add_argument("--folder", required=True, help="folder of the simulated dataset")
    parser.add_argument("--output", required=True, help="simulated.nc to write")


def run(args: argparse.Namespace) -> None:
    """Simulate every frame of the grid."""
    found = dataset.load(args.dataset)
    folder = Path(args.folder)
    with (
        store.read(args.calibration) as calibration,
        store.read(args.fits) as fits,
        store.read(args.sensor) as sensor,
    ):
        images = simulation.simulate(found, calibration, fits, model_of(sensor), folder, args.seed)
    inputs = [args.calibration, args.fits, args.sensor]
    store.write(images, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(f"{found.name}: {len(found.spots)} frames simulated")
