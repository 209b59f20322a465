"""`spotcheck metrics`: writes metrics.nc, image metrics of measured and simulated frames side by side.

A pair is a measured frame and the simulated frame of the same conditions. Its PSNR is the peak signal-to-noise ratio.

Examples
--------
spotcheck metrics --crops out/my-frames/crops.nc out/my-frames/simulated/crops.nc \\
    --fits out/my-frames/fits.nc out/my-frames/simulated/fits.nc --sensor out/my-frames/sensor.nc \\
    --output out/my-frames/metrics.nc
"""

import argparse

from spotcheck.io import provenance, store
from spotcheck.metrics.metrics_table import compute_metrics


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--crops", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="crops.nc of both")
    parser.add_argument("--fits", nargs=2, required=True, metavar=("MEASURED", "SIMULATED"), help="fits.nc of both")
    parser.add_argument("--sensor", required=True, help="sensor.nc")
    parser.add_argument("--output", required=True, help="metrics.nc to write")


def run(args: argparse.Namespace) -> None:
    """Evaluate measured and simulated frames by the same functions, and print the number of pairs."""
    names = ("measured", "simulated")
    with (
        store.read_files(dict(zip(names, args.crops, strict=True))) as crops,
        store.read_files(dict(zip(names, args.fits, strict=True))) as fits,
        store.read(args.sensor) as sensor,
    ):
        metrics = compute_metrics(crops, fits, float(sensor["full_scale_dn"]))
    inputs = [*args.crops, *args.fits, args.sensor]
    store.write(metrics, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    # A pair has a PSNR for each registration (alignment) of its crops and each data range, the peak value that the PSNR
    # refers to. Without a fit it lacks some of them (NaN).
    is_pair = metrics["psnr"].notnull().any(("registration", "data_range"))
    print(f"{int(is_pair.sum())} pairs of frames evaluated")
