"""`spotcheck new-dataset`: manifest and instrument file of a folder of images, or empty ones to fill in."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from spotcheck.crops import proposal
from spotcheck.dataset import template
from spotcheck.dataset.survey.rows import LABELLED, POSITION, Rows, rows_of
from spotcheck.dataset.survey.scan import COLOUR, Scan, check, scan
from spotcheck.dataset.survey.told import told
from spotcheck.errors import InputError
from spotcheck.io import configuration
from spotcheck.io.formats.colour import Colour

# Example of an answer, and question, for each column or key that the user is asked for.
QUESTIONS = {
    "exposure_s": ("2 ms", "exposure time of all frames"),
    POSITION: ("mm", "unit of the positions in the names"),
    "sensor.pixel_pitch_m": ("3.45 um", "pixel pitch of the camera"),
    "laser.wavelength_m": ("632.8 nm", "wavelength of the laser"),
}
# Files of other formats that a message lists.
MOST_OTHERS = 5
EXAMPLES = "spotcheck new-dataset new-frames"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("folder", type=Path, help="folder of images, or one to make")
    parser.add_argument(
        "--set",
        dest="answers",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="what no file states, for all frames: exposure_s=2ms; the unit of numbers without one: z_m=mm; or which"
        ' source is right: "exposure_s=file name"; also keys such as laser.wavelength_m=632.8nm',
    )


def run(args: argparse.Namespace) -> None:
    """Read what the files state, ask for what is missing, and write both files; existing files are never replaced."""
    folder, answers = args.folder, dict(_parse_answer(word) for word in args.answers)
    template.check_free(folder)
    colour = Colour(*(answers.get(key) for key in COLOUR))
    images = scan(folder, colour) if folder.is_dir() else Scan((), (), ())
    if images.broken and not images.shots:
        hint = ", such as by --set sensor.channel=red" if COLOUR[0] in images.broken[0] else ""
        count = f"; of {len(images.broken)} images none is read" if len(images.broken) > 1 else ""
        raise InputError(f"{images.broken[0]}{hint}{count}")
    check(images, answers)
    if images.shots:
        _write_rows(folder, images, answers, colour)
        next_step = "next"
    else:
        if folder.is_dir():
            others = f" that is read, but {', '.join(images.others[:MOST_OTHERS])}" if images.others else ""
            print(f"{folder}: holds no image{others}")
        template.write(folder)
        next_step = "fill in the blanks, then"
    print(f"{folder}: wrote manifest.csv, instrument.yaml; {next_step}: spotcheck check {folder}")
    if remark := configuration.remark_on(str(folder)):
        print(remark)


def _write_rows(folder: Path, images: Scan, answers: dict[str, str], colour: Colour) -> None:
    """Print what the files state, ask for what is missing, and write both files with a row per frame."""
    rows = rows_of(images, answers)
    print(*told(str(folder), images, rows), sep="\n")
    if missing := list(_list_missing(rows)):
        if sys.stdin.isatty():
            rows = rows_of(images, answers | dict(pair for key in missing if (pair := _ask(images, key))))
        else:
            example = f"{missing[0]}={QUESTIONS[missing[0]][0].replace(' ', '')}"
            print(f"Not found: {', '.join(missing)}.")
            print(f"Give what you know by options such as --set {example}, or write it into manifest.csv and")
            print("instrument.yaml. Without it the frames are evaluated as far as possible.")
    crop_px, has_spot = proposal.look(folder, rows, colour)
    if not has_spot:
        print("No spot stands out in these frames. Mark darks and flats by the words dark and flat in names of")
        print("files or folders, or in the column kind.")
    template.write(folder, rows, crop_px)


def _ask(images: Scan, key: str) -> tuple[str, str] | None:
    """Return a key with the answer of the user, who is asked again after an invalid one; None if it is unknown."""
    example, question = QUESTIONS[key]
    while answer := input(f"{key}: {question}, such as {example} (Enter if it is not known): ").strip():
        try:
            pair = _parse_answer(f"{key}={answer}")
            check(images, dict([pair]))
            return pair
        except InputError as error:
            print(str(error).removeprefix("--set "))
    return None


def _list_missing(rows: Rows) -> Iterator[str]:
    """Yield the columns and keys that these frames need and no file states."""
    unclear = {statement.column for statement in rows.also}
    unclear |= {sentence.partition(":")[0] for sentence in rows.contradictions}
    if len(rows.missing["exposure_s"]) == len(rows.cells) and "exposure_s" not in unclear:
        yield "exposure_s"
    if POSITION in unclear and POSITION not in rows.columns:
        yield POSITION
    if rows.spots:
        yield from (key for key in ("sensor.pixel_pitch_m", "laser.wavelength_m") if key not in rows.keys)


def _parse_answer(word: str) -> tuple[str, str]:
    """Return key and value of KEY=VALUE. Raises `InputError` for an unknown key or an impossible value."""
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
