"""`spotcheck correct`: frames in electrons, with their variance."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.dataset import folder as dataset
from spotcheck.export.corrected_folder import read_calibration, write_corrected_frames


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--results", type=Path, required=True, help="results folder that tells the sensor")
    parser.add_argument("--output", type=Path, required=True, help="folder to write, new or empty")
    vocabulary.arguments(parser)
    parser.epilog = "Example:\n  spotcheck correct my-frames --results out/my-frames --output corrected\n"


def run(args: argparse.Namespace) -> None:
    """Write every frame corrected, and say by what."""
    vocabulary.choose(args)
    found, calibration = dataset.load(args.dataset), read_calibration(args.results)
    count = write_corrected_frames(found, calibration, args.output)
    sensor, maps = calibration.sensor, calibration.maps
    response = ", ".join(applied.effect.name for applied in calibration.effects) or "straight"
    mapped = "no maps of pixels" if maps is None else f"maps of offset{' and gain' if maps.gain else ''}"
    print(f"{found.name}: {count} frames in electrons, in {args.output}")
    print(
        f"K {sensor.gain_dn_per_e:.4g} DN/e-, black level {sensor.black_level_dn:.4g} DN, {mapped}, response {response}"
    )
