"""`spotcheck look`: widths, shape, clip and camera of images without a description."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from spotcheck.dataset.metadata import units
from spotcheck.errors import InputError
from spotcheck.quicklook.first_look import look
from spotcheck.quicklook.images import find_folder

EXAMPLES = """spotcheck look my-frames/frames                # all images of a folder
spotcheck look my-frames/frames --pixel-um 3.75 --json"""
OUTPUT = "look"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument(
        "images", nargs="+", metavar="IMAGE", help="image files, or a folder of them: TIFF, PNG, PGM, HDF5, .npy"
    )
    parser.add_argument(
        "--z",
        type=lambda text: [_length_parser("m")(part) for part in text.split(",") if part.strip()],
        metavar="Z,Z,…",
        help="position of each image along the beam [m], or with a unit as in 176mm, in the order of the images"
        " (default: from names such as z_176mm.tif); --z=-0.1,0,0.1 if the first is below 0",
    )
    parser.add_argument(
        "--wavelength-nm",
        dest="wavelength_m",
        type=_length_parser("nm"),
        metavar="NM",
        help="wavelength [nm], for M² of a scan",
    )
    parser.add_argument(
        "--pixel-um",
        dest="pixel_pitch_m",
        type=_length_parser("µm"),
        metavar="UM",
        help="distance of two pixels [µm], for widths in µm and M²",
    )
    parser.add_argument("--json", action="store_true", help="print JSON; a page is then written only with --output")
    parser.add_argument(
        "--output", type=Path, metavar="FOLDER", help=f"folder for the page and its first picture (default: {OUTPUT})"
    )


def _length_parser(unit: str) -> Callable[[str], float]:
    """Return a function that parses a length [m], written with its unit or in `unit`."""

    def parse_length(text: str) -> float:
        number = units.parse_quantity(text)
        length_m = None if number is None else units.convert_quantity(number[0], number[1] or unit, "m")
        if length_m is None:
            raise argparse.ArgumentTypeError(f"is {text!r}; it must be a number in {unit}, or with a unit as in 3 mm")
        return length_m

    return parse_length


def run(args: argparse.Namespace) -> None:
    """Measure the images, print the results and write the page."""
    folder = args.output or (None if args.json else Path(OUTPUT))
    if not args.output and folder and folder.resolve() in (find_folder(Path(path)) for path in args.images):
        raise InputError(f"{OUTPUT}: holds the images; name another folder for the page with --output")
    result = look(args.images, z_m=args.z, pixel_pitch_m=args.pixel_pitch_m, wavelength_m=args.wavelength_m)
    page = None if folder is None else result.write(folder)
    if args.json:
        content = result.to_dict() | {"page": None if page is None else str(page)}
        print(json.dumps(content, indent=1, ensure_ascii=False))
        return
    print(result)
    is_scan = any(image.z_m is not None for image in result.images)
    options = (("--wavelength-nm", result.wavelength_m or not is_scan), ("--pixel-um", result.pixel_pitch_m))
    if missing := [option for option, value in options if not value]:
        print(f"for {'M²' if is_scan else 'widths in µm'} add your {' and '.join(missing)}")
    print(f"\npage: {page}    (spotcheck open {page})")
