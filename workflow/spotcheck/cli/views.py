"""`spotcheck views`: views.nc."""

import argparse
from pathlib import Path

from spotcheck import dataset, provenance, store, views
from spotcheck.cli import vocabulary
from spotcheck.cli.judged import open_set
from spotcheck.old_engine.boundary import check_model
from spotcheck.old_engine.model.extended import read_model, why_none
from spotcheck.old_engine.model.light_file import LIGHT

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
    ready, why_not = open_set(found, files["crops"], files["sensor"]), why_none(args.model)
    inputs = [*paths.values(), args.model, *args.effects]
    frames, model = None, None
    if isinstance(ready, str):
        why_not = why_not or ready
    else:
        frames = (ready.shots, ready.setting)
        if not why_not:
            model = read_model(args.model)
            check_model(found, model, ready.setting.baseline, ready.setting.sensor, args.model.name)
            inputs += [args.model.with_name(LIGHT)] if model.lights else []
    code = provenance.code_digest(__name__)
    views.write(found, files, frames, model, args.output, why_not=why_not, code=code, inputs=inputs)
    for ds in files.values():
        ds.close()
    print(f"{found.name}: views of {len(found.spots)} frames")
