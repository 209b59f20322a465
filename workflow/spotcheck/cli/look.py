"""`spotcheck look`: widths, shape, clip and camera of images that nobody has described."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from spotcheck.dataset.labels import units
from spotcheck.errors import InputError
from spotcheck.quicklook.first_look import look
from spotcheck.quicklook.images import find_folder

EXAMPLES = """Examples:
  spotcheck look my-frames/frames                # all images of a folder
  spotcheck look my-frames/frames --pixel-um 3.75 --json

With --wavelength-nm as well, positions along the beam give M²: those that names say, as z_176mm.tif does, or --z.
"""
OUTPUT = "look"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "images", nargs="+", metavar="IMAGE", help="image files, or a folder of them: TIFF, PNG, PGM, HDF5, .npy"
    )
    parser.add_argument(
        "--z",
        type=positions,
        metavar="Z,Z,…",
        help="position of each image along the beam [m], or with a unit as in 176mm, in the order of the images;"
        " --z=-0.1,0,0.1 where the first is below 0",
    )
    parser.add_argument(
        "--wavelength-nm", dest="wavelength_m", type=length("nm"), metavar="NM", help="wavelength [nm], for M²"
    )
    parser.add_argument(
        "--pixel-um",
        dest="pixel_pitch_m",
        type=length("µm"),
        metavar="UM",
        help="distance of two pixels [µm], for widths in µm",
    )
    parser.add_argument("--json", action="store_true", help="print JSON; a page is then written only with --output")
    parser.add_argument(
        "--output", type=Path, metavar="FOLDER", help=f"folder for the page and its first picture (default: {OUTPUT})"
    )


def positions(text: str) -> list[float]:
    """Positions [m] between commas."""
    return [length("m")(part) for part in text.split(",") if part.strip()]


def length(unit: str) -> Callable[[str], float]:
    """What reads a length [m], written with its unit or in `unit`."""

    def read(text: str) -> float:
        found = units.parted(text)
        value = None if found is None else units.scaled(found[0], found[1] or unit, "m")
        if value is None:
            raise argparse.ArgumentTypeError(f"is {text!r}; it must be a number in {unit}, or with a unit as in 3 mm")
        return value

    return read


def run(args: argparse.Namespace) -> None:
    """Look, print, and write the page."""
    folder = args.output or (None if args.json else Path(OUTPUT))
    if args.output is None and folder is not None and folder.resolve() in map(find_folder, map(Path, args.images)):
        raise InputError(f"{OUTPUT}: holds the images; name another folder for the page with --output")
    found = look(
        args.images,
        z_m=args.z,
        pixel_pitch_m=args.pixel_pitch_m,
        wavelength_m=args.wavelength_m,
    )
    page = None if folder is None else found.write(folder)
    if args.json:
        print(json.dumps(found.to_dict() | {"page": None if page is None else str(page)}, indent=1, ensure_ascii=False))
        return
    print(found)
    if asked := _asked(found.wavelength_m, found.pixel_pitch_m, any(one.z_m is not None for one in found.images)):
        print(asked)
    print(f"\npage: {page}    (spotcheck open {page})")


def _asked(wavelength_m: float | None, pitch_m: float | None, scan: bool) -> str:
    """Which options would tell more, in one sentence."""
    options = (("--wavelength-nm", not scan or wavelength_m), ("--pixel-um", pitch_m))
    missing = [option for option, value in options if not value]
    if not missing:
        return ""
    return f"for {'M²' if scan else 'widths in µm'} add your {' and '.join(missing)}"
