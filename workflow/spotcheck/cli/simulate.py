"""`spotcheck simulate`: a file of mean images and the folder of simulated frames."""

import argparse
from pathlib import Path

from spotcheck.characterization.sensor_choice import model_of
from spotcheck.cli import vocabulary
from spotcheck.dataset import folder as dataset
from spotcheck.errors import InputError
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR, read_width_law
from spotcheck.fitting.spot_states import list_spot_states
from spotcheck.io import provenance, store
from spotcheck.model import simulation
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import read_model

EXAMPLE = """Example:
  spotcheck simulate my-frames --calibration out/my-frames/calibration.nc --fits out/my-frames/fits.nc \\
      --sensor out/my-frames/sensor.nc --seed 1 --folder out/my-frames/simulated --output out/my-frames/simulated.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--calibration", help="calibration.nc; not with --model")
    parser.add_argument("--fits", help="fits.nc; not with --model")
    parser.add_argument("--model", help="model.yaml: simulate the extended model instead of the paper's")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--seed", type=int, required=True, help="seed of the random draws")
    parser.add_argument("--folder", required=True, help="folder of the simulated dataset")
    parser.add_argument("--output", required=True, help="simulated.nc or extended.nc to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Simulate every frame of the grid."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    if args.seed < 0:
        raise InputError(f"--seed: is {args.seed}; it must be 0 or above")
    (_extended if args.model else _paper)(args, found)
    print(f"{found.name}: {len(found.spots)} frames simulated")


def _paper(args: argparse.Namespace, found: dataset.Dataset) -> None:
    if not args.calibration or not args.fits:
        raise InputError("simulate: what to simulate is missing; give --calibration and --fits, or --model")
    with store.read(args.calibration) as calibration, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        is_law_found = read_width_law(calibration) is not None
        states = list_spot_states(found, calibration, fits)
        model, full_scale = model_of(sensor), int(sensor["full_scale_dn"])
    attributes = {"calibration": SIMULATION_ESTIMATOR if is_law_found else "none: each frame's own fit"}
    destination = _destination(args, [args.calibration, args.fits, args.sensor])
    simulation.simulate(found, states, model, full_scale, destination, attributes)


def _extended(args: argparse.Namespace, found: dataset.Dataset) -> None:
    if args.calibration or args.fits:
        raise InputError("simulate: --model holds all parameters; give either it, or --calibration and --fits")
    path = Path(args.model)
    model = read_model(path)
    light = [path.with_name(LIGHT)] if model.lights else []
    with store.read(args.sensor) as sensor:
        camera = model_of(sensor)
    if camera is None:
        raise InputError(f"{Path(args.sensor).name}: gain or read noise is unknown, and {path.name} cannot do without")
    destination = _destination(args, [args.model, args.sensor, *light, *args.effects])
    simulation.simulate_extended(found, model, camera, destination, path.name)


def _destination(args: argparse.Namespace, inputs: list[str | Path]) -> simulation.Destination:
    code = provenance.code_digest(__name__)
    return simulation.Destination(Path(args.folder), Path(args.output), args.seed, code, inputs)
