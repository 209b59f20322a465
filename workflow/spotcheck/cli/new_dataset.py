"""`spotcheck new-dataset`: manifest and instrument file of a folder of images, or empty ones to fill in."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from spotcheck.crops.crop_size import propose_crop_size
from spotcheck.dataset import template
from spotcheck.dataset.survey.rows import LABELLED, POSITION, Rows, rows_of
from spotcheck.dataset.survey.scan import COLOUR, Scan, check, scan
from spotcheck.dataset.survey.told import told
from spotcheck.errors import InputError
from spotcheck.io import configuration
from spotcheck.io.formats.colour import Colour

# What a person is asked for where no file says it: column or key, and the question.
QUESTIONS = {
    "exposure_s": "exposure time of all frames, such as 2 ms",
    POSITION: "unit of the positions in the names, such as mm",
    "sensor.pixel_pitch_m": "pixel pitch of the camera, such as 3.45 um",
    "laser.wavelength_m": "wavelength of the laser, such as 632.8 nm",
}

# Files of other formats that a message lists.
MOST_OTHERS = 5

EXAMPLE = """Example:
  spotcheck new-dataset new-frames
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("folder", type=Path, help="folder of images, or one to make")
    parser.add_argument(
        "--set",
        dest="given",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="what no file says, for all frames: exposure_s=2ms; the unit of numbers that have none: z_m=mm; or which"
        ' source is right: "exposure_s=file name"; also keys such as laser.wavelength_m=632.8nm',
    )


def run(args: argparse.Namespace) -> None:
    """Say what the files tell, ask for what is missing, write both files; nothing that is there is overwritten."""
    folder, given = args.folder, dict(_pair(word) for word in args.given)
    template.check_free(folder)
    colour = Colour(*(given.get(key) for key in COLOUR))
    found = scan(folder, colour) if folder.is_dir() else Scan((), (), ())
    if found.broken and not found.shots:
        more = f"; of {len(found.broken)} images none is read" if len(found.broken) > 1 else ""
        keys = ", such as by --set sensor.channel=red" if COLOUR[0] in found.broken[0] else ""
        raise InputError(f"{found.broken[0]}{keys}{more}")
    check(found, given)
    rows = rows_of(found, given) if found.shots else None
    if rows is None:
        if found.others:
            print(f"{folder}: holds no image that is read, but {', '.join(found.others[:MOST_OTHERS])}")
        elif folder.is_dir():
            print(f"{folder}: holds no image")
        template.write(folder)
    else:
        print(*told(str(folder), found, rows), sep="\n")
        rows = _completed(found, rows, given)
        proposal = propose_crop_size(folder, rows, colour)
        if not proposal.has_spot:
            print(
                "No spot stands out in these frames. Darks and flats are told by those words in the names of files or"
            )
            print("folders, or in the column kind.")
        template.write(folder, rows, proposal.side_px)
    then = "next" if rows else "fill in the blanks, then"
    print(f"{folder}: wrote manifest.csv, instrument.yaml; {then}: spotcheck check {folder}")
    if remark := configuration.remark_on(str(folder)):
        print(remark)


def _completed(found: Scan, rows: Rows, given: dict[str, str]) -> Rows:
    """The rows with what a person answers at a terminal; without one, a sentence names what is missing."""
    missing = list(_missing(rows))
    if not missing:
        return rows
    if sys.stdin.isatty():
        return rows_of(found, given | dict(own for key in missing if (own := _asked(found, key))))
    print(f"Not found: {', '.join(missing)}.")
    print(f"What is known can be given, such as --set {_example(missing[0])}, or written into manifest.csv and")
    print("instrument.yaml; without it the frames are evaluated as far as that goes.")
    return rows


def _asked(found: Scan, key: str) -> tuple[str, str] | None:
    """A key and what a person answers, asked anew where nothing can be made of it; None where it is not known."""
    while answer := input(f"{key}: {QUESTIONS[key]} (Enter where it is not known): ").strip():
        try:
            pair = _pair(f"{key}={answer}")
            check(found, dict([pair]))
            return pair
        except InputError as error:
            print(str(error).removeprefix("--set "))
    return None


def _missing(rows: Rows) -> Iterator[str]:
    """Columns and keys that matter for these frames and that nothing tells."""
    unclear = {own.column for own in rows.also} | {own.partition(":")[0] for own in rows.contradictions}
    if len(rows.missing["exposure_s"]) == len(rows.cells) and "exposure_s" not in unclear:
        yield "exposure_s"
    if POSITION in unclear and POSITION not in rows.columns:
        yield POSITION
    if rows.spots:
        yield from (key for key in ("sensor.pixel_pitch_m", "laser.wavelength_m") if key not in rows.keys)


def _example(key: str) -> str:
    """An answer to a question, as an option."""
    return f"{key}={QUESTIONS[key].rpartition('such as ')[2].replace(' ', '')}"


def _pair(word: str) -> tuple[str, str]:
    """Key and value of an answer. Raises `InputError`."""
    key, equals, value = (part.strip() for part in word.partition("="))
    keys = template.keys()
    if not equals or key not in (*LABELLED, *keys) or not value:
        raise InputError(
            f"--set {word}: must be KEY=VALUE, with a KEY of {', '.join(LABELLED)} or of a number of instrument.yaml;"
            " write others into that file"
        )
    choices = keys.get(key, {}).get("enum", [value])
    if value not in choices:
        raise InputError(f"--set {word}: must be one of {', '.join(choices)}")
    return key, value
