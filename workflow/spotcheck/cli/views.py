"""`spotcheck views`: views.nc."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.cli.judged import prepare_dataset
from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import read_model, reason_without_model
from spotcheck.model.simulation import check_model
from spotcheck.report import views

EXAMPLE = """Example:
  spotcheck views my-frames --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc \\
      --calibration out/my-frames/calibration.nc --sensor out/my-frames/sensor.nc --model out/my-frames/model.yaml \\
      --output out/my-frames/views.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    for name in ("crops", "fits", "calibration", "sensor"):
        parser.add_argument(f"--{name}", required=True, help=f"{name}.nc")
    parser.add_argument("--model", required=True, type=Path, help="model.yaml")
    parser.add_argument("--output", required=True, type=Path, help="views.nc to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Evaluate the models on every measured crop."""
    vocabulary.choose(args)
    found = dataset.load(args.dataset)
    paths = {name: getattr(args, name) for name in ("crops", "fits", "calibration", "sensor")}
    files = {name: store.read(path) for name, path in paths.items()}
    ready = prepare_dataset(found, files["crops"], files["sensor"], files["fits"])
    why_not = reason_without_model(args.model)
    inputs = [*paths.values(), args.model, *args.effects]
    viewed, model = None, None
    if isinstance(ready, str):
        why_not = why_not or ready
    else:
        baseline, sensor = ready.setting.baseline, ready.setting.sensor
        viewed = views.ViewedFrames(ready.frames, ready.cells, ready.spots, baseline, sensor)
        if not why_not:
            model = read_model(args.model)
            check_model(found, model, baseline, sensor, args.model.name)
            inputs += [args.model.with_name(LIGHT)] if model.lights else []
    code = provenance.code_digest(__name__)
    views.write_views(found, files, viewed, model, args.output, reason=why_not, code=code, inputs=inputs)
    for ds in files.values():
        ds.close()
    print(f"{found.name}: views of {len(found.spots)} frames")
