"""`spotcheck extended`: simulates frames by the extended model, and compares their metrics with the measured ones.

The declared model is the simulation from calibration and data sheet. The extended model, in model.yaml, has in addition
the physical effects that the verdict detected.

Examples
--------
spotcheck extended my-frames --model out/my-frames/model.yaml --sensor out/my-frames/sensor.nc \\
    --crops out/my-frames/crops.nc --fits out/my-frames/fits.nc --metrics out/my-frames/metrics.nc --seed 1 \\
    --folder out/my-frames/extended --images out/my-frames/extended.nc --output out/my-frames/extended_metrics.nc \\
    --table out/my-frames/model_comparison.csv
"""

import argparse
from pathlib import Path

import xarray as xr

from spotcheck.cli import effect_options, pipeline
from spotcheck.io import provenance, store
from spotcheck.metrics.model_comparison import compare_models, comparison_csv, summarise_comparison
from spotcheck.model.model_file import reason_without_model


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--model", required=True, type=Path, help="model.yaml of the verdict")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--crops", required=True, help="crops.nc of the measured frames")
    parser.add_argument("--fits", required=True, help="fits.nc of the measured frames")
    parser.add_argument("--metrics", required=True, help="metrics.nc of the measured and the declared model's frames")
    parser.add_argument("--seed", type=int, required=True, help="seed of the random draws")
    parser.add_argument("--folder", required=True, type=Path, help="folder of the simulated dataset and its results")
    parser.add_argument("--images", required=True, help="extended.nc to write: mean images")
    parser.add_argument("--output", required=True, help="extended_metrics.nc to write")
    parser.add_argument("--table", required=True, help="model_comparison.csv to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Simulate and evaluate the extended model, and print how far each model is from the measured frames.

    If the verdict gives no extended model, files without content are written, and the reason is printed.
    """
    code, inputs = provenance.code_digest(__name__), [args.model, args.metrics, args.crops, args.fits]
    args.folder.mkdir(parents=True, exist_ok=True)
    if reason := reason_without_model(args.model):
        with store.read(args.metrics) as declared:
            titles = {name: declared.attrs[name] for name in ("title", "dataset")}
        for path in (args.images, args.output):
            store.write(xr.Dataset(attrs=titles | {"skipped": reason}), path, code=code, inputs=inputs)
        store.write_text(args.table, comparison_csv([]), code=code, inputs=inputs)
        print(f"no extended model: {reason}")
        return
    pipeline.evaluate_extended_model(args)
    with store.read(args.metrics) as declared, store.read(args.output) as extended:
        rows = compare_models(declared, extended)
    store.write_text(args.table, comparison_csv(rows), code=code, inputs=[*inputs, args.output])
    # Distances of both models from the measured frames, in standard deviations of the repeats.
    for metric, (declared_distance, extended_distance) in summarise_comparison(rows).items():
        distances = f"declared {declared_distance:.2f}, extended {extended_distance:.2f} sd of repeats"
        print(f"{metric:17} distance from measured: {distances}")
