"""`spotcheck correct`: writes the frames in electrons, with their variance.

A calibration is what results say about the sensor: its parameters, the maps of offset and gain of its pixels, and the
detected effects on well and response.

Examples
--------
spotcheck correct my-frames --results out/my-frames --output corrected
"""

import argparse
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.dataset import folder
from spotcheck.export.corrected_folder import read_calibration, write_corrected_frames


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--results", type=Path, required=True, help="results folder with the sensor's parameters")
    parser.add_argument("--output", type=Path, required=True, help="folder to write, new or empty")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write every corrected frame, and print the gain K, black level, maps of pixels and response that were used."""
    effect_options.apply_options(args)
    dataset, calibration = folder.load(args.dataset), read_calibration(args.results)
    count = write_corrected_frames(dataset, calibration, args.output)
    sensor, maps = calibration.sensor, calibration.maps
    response = ", ".join(applied.effect.name for applied in calibration.effects) or "linear"
    mapped = "no maps of pixels" if maps is None else f"maps of offset{' and gain' if maps.gain else ''}"
    print(f"{dataset.name}: {count} frames in electrons, in {args.output}")
    print(
        f"K {sensor.gain_dn_per_e:.4g} DN/e-, black level {sensor.black_level_dn:.4g} DN, {mapped}, response {response}"
    )
