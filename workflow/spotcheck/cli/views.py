"""`spotcheck views`: writes views.nc, the frames that each model expects beside the measured ones, for the report.

The models are the paper's one, with the law of calibration.nc, and the extended model of model.yaml.

Examples
--------
spotcheck views my-frames --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc \\
    --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc --model out/my-frames/model.yaml \\
    --output out/my-frames/views.nc
"""

import argparse
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.dataset import folder
from spotcheck.discrepancy.ready_frames import prepare_dataset
from spotcheck.io import provenance, store
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import read_model, reason_without_model
from spotcheck.model.simulation import check_model
from spotcheck.report import views


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("dataset", help="dataset folder")
    for name in ("crops", "fits", "calibration", "sensor"):
        parser.add_argument(f"--{name}", required=True, help=f"{name}.nc")
    parser.add_argument("--model", required=True, type=Path, help="model.yaml")
    parser.add_argument("--output", required=True, type=Path, help="views.nc to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Evaluate the models on every measured crop, write the expected frames, and print their number."""
    effect_options.apply_options(args)
    dataset = folder.load(args.dataset)
    paths = {name: getattr(args, name) for name in ("crops", "fits", "calibration", "sensor")}
    with store.read_files(paths) as files:
        # A record: the frames, their cells on the grid, the spot of each, and the `setting` (declared model of the
        # light and sensor model). It is a sentence with the reason if the frames cannot be analysed.
        ready = prepare_dataset(dataset, files["crops"], files["sensor"], files["fits"])
        # Why there is no extended model; "" if there is one.
        reason = reason_without_model(args.model)
        inputs = [*paths.values(), args.model, *args.effects]
        frames, model = None, None
        if isinstance(ready, str):
            reason = reason or ready
        else:
            baseline, sensor = ready.setting.baseline, ready.setting.sensor
            frames = views.ViewedFrames(ready.frames, ready.cells, ready.spots, baseline, sensor)
            if not reason:
                model = read_model(args.model)
                check_model(dataset, model, baseline, sensor, args.model.name)
                # A learned shape of the light is in light.nc beside model.yaml.
                inputs += [args.model.with_name(LIGHT)] if model.lights else []
        code = provenance.code_digest(__name__)
        views.write_views(dataset, files, frames, model, args.output, reason=reason, code=code, inputs=inputs)
    print(f"{dataset.name}: views of {len(dataset.spots)} frames")
