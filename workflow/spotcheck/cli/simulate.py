"""`spotcheck simulate`: simulated.nc and the folder of simulated frames."""

import argparse
from pathlib import Path

from spotcheck import dataset, provenance, simulation, store
from spotcheck.estimate.calibration import USED
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
    with store.read(args.calibration) as calibration, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        lawful = simulation.has_law(calibration)
        states = simulation.spot_states(found, calibration, fits)
        model, full_scale = model_of(sensor), int(sensor["full_scale_dn"])
    simulation.simulate(
        found,
        states,
        model,
        full_scale,
        Path(args.folder),
        Path(args.output),
        seed=args.seed,
        attributes={"calibration": USED if lawful else "none: each frame's own fit"},
        code=provenance.code_digest(__name__),
        inputs=[args.calibration, args.fits, args.sensor],
    )
    print(f"{found.name}: {len(found.spots)} frames simulated")
