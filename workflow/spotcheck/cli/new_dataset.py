"""`spotcheck new-dataset`: manifest and instrument file of a folder of images, or empty ones to fill in."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from spotcheck.crops.crop_size import propose_crop_size
from spotcheck.dataset import template
from spotcheck.dataset.scan.answers import COLOUR_KEYS, check_answers
from spotcheck.dataset.scan.draft import METADATA_COLUMNS, POSITION, ManifestDraft, draft_manifest
from spotcheck.dataset.scan.folder_scan import FolderScan, scan_folder
from spotcheck.dataset.scan.summary import summarize_scan
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
    template.check_absent(folder)
    colour = Colour(*(given.get(key) for key in COLOUR_KEYS))
    found = scan_folder(folder, colour) if folder.is_dir() else FolderScan((), (), ())
    if found.errors and not found.frames:
        more = f"; of {len(found.errors)} images none is read" if len(found.errors) > 1 else ""
        keys = ", such as by --set sensor.channel=red" if COLOUR_KEYS[0] in found.errors[0] else ""
        raise InputError(f"{found.errors[0]}{keys}{more}")
    check_answers(found, given)
    rows = draft_manifest(found, given) if found.frames else None
    if rows is None:
        if found.unread_files:
            print(f"{folder}: holds no image that is read, but {', '.join(found.unread_files[:MOST_OTHERS])}")
        elif folder.is_dir():
            print(f"{folder}: holds no image")
        template.write_template(folder)
    else:
        print(*summarize_scan(str(folder), found, rows), sep="\n")
        rows = _completed(found, rows, given)
        proposal = propose_crop_size(folder, rows, colour)
        if not proposal.has_spot:
            print(
                "No spot stands out in these frames. Darks and flats are told by those words in the names of files or"
            )
            print("folders, or in the column kind.")
        template.write_template(folder, rows, proposal.side_px)
    then = "next" if rows else "fill in the blanks, then"
    print(f"{folder}: wrote manifest.csv, instrument.yaml; {then}: spotcheck check {folder}")
    if remark := configuration.remark_on_quotes(str(folder)):
        print(remark)


def _completed(found: FolderScan, rows: ManifestDraft, given: dict[str, str]) -> ManifestDraft:
    """The rows with what a person answers at a terminal; without one, a sentence names what is missing."""
    missing = list(_missing(rows))
    if not missing:
        return rows
    if sys.stdin.isatty():
        return draft_manifest(found, given | dict(own for key in missing if (own := _asked(found, key))))
    print(f"Not found: {', '.join(missing)}.")
    print(f"What is known can be given, such as --set {_example(missing[0])}, or written into manifest.csv and")
    print("instrument.yaml; without it the frames are evaluated as far as that goes.")
    return rows


def _asked(found: FolderScan, key: str) -> tuple[str, str] | None:
    """A key and what a person answers, asked anew where nothing can be made of it; None where it is not known."""
    while answer := input(f"{key}: {QUESTIONS[key]} (Enter where it is not known): ").strip():
        try:
            pair = _pair(f"{key}={answer}")
            check_answers(found, dict([pair]))
            return pair
        except InputError as error:
            print(str(error).removeprefix("--set "))
    return None


def _missing(rows: ManifestDraft) -> Iterator[str]:
    """Columns and keys that matter for these frames and that nothing tells."""
    unclear = {own.column for own in rows.unused} | {own.column for own in rows.conflicts}
    if len(rows.missing["exposure_s"]) == len(rows.rows) and "exposure_s" not in unclear:
        yield "exposure_s"
    if POSITION in unclear and POSITION not in rows.columns:
        yield POSITION
    if rows.has_spots:
        yield from (key for key in ("sensor.pixel_pitch_m", "laser.wavelength_m") if key not in rows.instrument_keys)


def _example(key: str) -> str:
    """An answer to a question, as an option."""
    return f"{key}={QUESTIONS[key].rpartition('such as ')[2].replace(' ', '')}"


def _pair(word: str) -> tuple[str, str]:
    """Key and value of an answer. Raises `InputError`."""
    key, equals, value = (part.strip() for part in word.partition("="))
    keys = template.list_settable_keys()
    if not equals or key not in (*METADATA_COLUMNS, *keys) or not value:
        raise InputError(
            f"--set {word}: must be KEY=VALUE, with a KEY of {', '.join(METADATA_COLUMNS)} or of a number of"
            " instrument.yaml; write others into that file"
        )
    choices = keys.get(key, {}).get("enum", [value])
    if value not in choices:
        raise InputError(f"--set {word}: must be one of {', '.join(choices)}")
    return key, value
