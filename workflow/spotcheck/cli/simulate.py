"""`spotcheck simulate`: writes a file of mean images, and the folder of a simulated dataset.

The paper's model is a Gaussian spot whose width follows a law over exposure time, from calibration.nc. The extended
model, from model.yaml, has further physical effects. calibration.nc has the law by several estimators;
SIMULATION_ESTIMATOR is the name of the one that the simulation uses.

Examples
--------
spotcheck simulate my-frames --calibration out/my-frames/calibration.nc --fits out/my-frames/fits.nc \\
    --sensor out/my-frames/sensor.nc --seed 1 --folder out/my-frames/simulated --output out/my-frames/simulated.nc
"""

import argparse
from pathlib import Path

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.cli import effect_options
from spotcheck.dataset import folder
from spotcheck.errors import InputError
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR, read_width_law
from spotcheck.fitting.spot_states import list_spot_states
from spotcheck.io import provenance, store
from spotcheck.model import simulation
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import read_model


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--calibration", help="calibration.nc; not with --model")
    parser.add_argument("--fits", help="fits.nc; not with --model")
    parser.add_argument("--model", help="model.yaml: simulate the extended model instead of the paper's")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--seed", type=int, required=True, help="seed of the random draws")
    parser.add_argument("--folder", required=True, help="folder of the simulated dataset")
    parser.add_argument("--output", required=True, help="simulated.nc or extended.nc to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Simulate every spot frame of the dataset and write the simulated dataset.

    Raises `InputError` for a negative seed, or options that do not go together.
    """
    effect_options.apply_options(args)
    dataset = folder.load(args.dataset)
    if args.seed < 0:
        raise InputError(f"--seed: is {args.seed}; it must be 0 or above")
    simulate = _simulate_extended_model if args.model else _simulate_paper_model
    simulate(args, dataset)
    print(f"{dataset.name}: {len(dataset.spots)} frames simulated")


def _simulate_paper_model(args: argparse.Namespace, dataset: folder.Dataset) -> None:
    """Simulate with the law of calibration.nc, or with the fit of each frame in fits.nc if there is no law.

    Raises `InputError` without --calibration and --fits.
    """
    if not args.calibration or not args.fits:
        raise InputError("simulate: the model is missing; give --calibration and --fits, or --model")
    with store.read(args.calibration) as calibration, store.read(args.fits) as fits, store.read(args.sensor) as sensor:
        source = SIMULATION_ESTIMATOR if read_width_law(calibration) is not None else "none: each frame's own fit"
        # Peak [DN] and width [px] of the spot in each frame.
        states = list_spot_states(dataset, calibration, fits)
        sensor_model, full_scale_dn = read_sensor_model(sensor), int(sensor["full_scale_dn"])
    destination = _make_destination(args, [args.calibration, args.fits, args.sensor])
    simulation.simulate(dataset, states, sensor_model, full_scale_dn, destination, {"calibration": source})


def _simulate_extended_model(args: argparse.Namespace, dataset: folder.Dataset) -> None:
    """Simulate with the parameters of model.yaml.

    Raises `InputError` with --calibration or --fits, or if gain or read noise is unknown.
    """
    if args.calibration or args.fits:
        raise InputError("simulate: --model has all parameters; leave out --calibration and --fits, or --model")
    model_path = Path(args.model)
    model = read_model(model_path)
    # A learned shape of the light is in light.nc beside model.yaml.
    light_paths = [model_path.with_name(LIGHT)] if model.lights else []
    with store.read(args.sensor) as sensor:
        sensor_model = read_sensor_model(sensor)
    if sensor_model is None:
        raise InputError(f"{Path(args.sensor).name}: gain or read noise is unknown, but {model_path.name} needs them")
    destination = _make_destination(args, [args.model, args.sensor, *light_paths, *args.effects])
    simulation.simulate_extended(dataset, model, sensor_model, destination, model_path.name)


def _make_destination(args: argparse.Namespace, inputs: list[str | Path]) -> simulation.Destination:
    """Return where the simulated frames are written, with their seed and provenance; `inputs` are the files read."""
    code = provenance.code_digest(__name__)
    return simulation.Destination(Path(args.folder), Path(args.output), args.seed, code, inputs)
