"""`spotcheck look`: measures widths, shape, clipping and camera noise of images without a description.

A scan is a series of images at positions z along the beam, from which the beam quality M² is fitted.

Examples
--------
spotcheck look my-frames/frames                # all images of a folder
spotcheck look my-frames/frames --pixel-um 3.75 --json
"""

import argparse
import json
from functools import partial
from pathlib import Path

from spotcheck.dataset.metadata import units
from spotcheck.errors import InputError
from spotcheck.quicklook.first_look import look
from spotcheck.quicklook.images import find_folder

# Default folder of the page.
FOLDER = "look"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument(
        "images", nargs="+", metavar="IMAGE", help="image files, or a folder of them: TIFF, PNG, PGM, HDF5, .npy"
    )
    parser.add_argument(
        "--z",
        type=lambda text: [_parse_length("m", position) for position in text.split(",") if position.strip()],
        metavar="Z,Z,…",
        help="position of each image along the beam [m], or with a unit as in 176mm, in the order of the images"
        " (default: from names such as z_176mm.tif); --z=-0.1,0,0.1 if the first is below 0",
    )
    for option, name, unit, text in (
        ("--wavelength-nm", "wavelength_m", "nm", "wavelength [nm], for M² of a scan"),
        ("--pixel-um", "pixel_pitch_m", "µm", "distance of two pixels [µm], for widths in µm and M²"),
    ):
        parse = partial(_parse_length, unit)
        parser.add_argument(option, dest=name, type=parse, metavar=option[-2:].upper(), help=text)
    parser.add_argument("--json", action="store_true", help="print JSON; a page is then written only with --output")
    parser.add_argument(
        "--output", type=Path, metavar="FOLDER", help=f"folder for the page and its first picture (default: {FOLDER})"
    )


def _parse_length(unit: str, text: str) -> float:
    """Return the length [m] of a text such as "3 mm", or of a number without a unit, which is in `unit`."""
    quantity = units.parse_quantity(text)
    length_m = None if quantity is None else units.convert_quantity(quantity[0], quantity[1] or unit, "m")
    if length_m is None:
        raise argparse.ArgumentTypeError(f"is {text!r}; it must be a number in {unit}, or with a unit as in 3 mm")
    return length_m


def run(args: argparse.Namespace) -> None:
    """Measure the images, print the results as text or JSON, and write the page.

    With --json a page is written only with --output. Raises `InputError` if the default folder of the page holds the
    images.
    """
    folder = args.output or (None if args.json else Path(FOLDER))
    # `find_folder` returns the absolute path of a folder, or of the folder that holds an image.
    if not args.output and folder and folder.resolve() in (find_folder(Path(path)) for path in args.images):
        raise InputError(f"{FOLDER}: holds the images; name another folder for the page with --output")
    result = look(args.images, z_m=args.z, pixel_pitch_m=args.pixel_pitch_m, wavelength_m=args.wavelength_m)
    page = None if folder is None else result.write(folder)
    if args.json:
        content = result.to_dict() | {"page": None if page is None else str(page)}
        print(json.dumps(content, indent=1, ensure_ascii=False))
        return
    print(result)
    is_scan = any(image.z_m is not None for image in result.images)
    # The wavelength is needed for M² of a scan only.
    needed_values = {"--wavelength-nm": result.wavelength_m} if is_scan else {}
    needed_values["--pixel-um"] = result.pixel_pitch_m
    if missing := [option for option, value in needed_values.items() if not value]:
        print(f"for {'M²' if is_scan else 'widths in µm'} add your {' and '.join(missing)}")
    print(f"\npage: {page}    (spotcheck open {page})")
