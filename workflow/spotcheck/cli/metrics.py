"""`spotcheck metrics`: writes metrics.nc, image metrics of measured and simulated frames side by side."""

import argparse

from spotcheck.io import provenance, store
from spotcheck.metrics.metrics_table import compute_metrics

EXAMPLES = """spotcheck metrics --crops out/my-frames/crops.nc out/my-frames/simulated/crops.nc \\
    --fits out/my-frames/fits.nc out/my-frames/simulated/fits.nc --sensor out/my-frames/sensor.nc \\
    --output out/my-frames/metrics.nc"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--crops", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="crops.nc of both")
    parser.add_argument("--fits", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="fits.nc of both")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="metrics.nc to write")


def run(args: argparse.Namespace) -> None:
    """Evaluate measured and simulated frames by the same functions, and print the number of pairs."""
    names = ("measured", "simulated")
    crops = {name: store.read(path) for name, path in zip(names, args.crops, strict=True)}
    fits = {name: store.read(path) for name, path in zip(names, args.fits, strict=True)}
    with store.read(args.sensor) as sensor:
        metrics = compute_metrics(crops, fits, float(sensor["full_scale_dn"]))
    inputs = [*args.crops, *args.fits, args.sensor]
    store.write(metrics, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    # Each pair has a signal-to-noise ratio PSNR for each registration of the two crops and each data range.
    values_per_pair = metrics.sizes["registration"] * metrics.sizes["data_range"]
    print(f"{int(metrics['psnr'].notnull().sum() / values_per_pair)} pairs of frames evaluated")
