"""`spotcheck new-dataset`: writes manifest and instrument file of a folder of images, or empty ones to fill in.

The manifest (manifest.csv) has a row per frame, the instrument file (instrument.yaml) has keys such as
sensor.pixel_pitch_m. An answer is a column or key with its value, which the user gives where files state none.

Examples
--------
spotcheck new-dataset new-frames
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from spotcheck.crops.crop_size import propose_crop_size
from spotcheck.dataset import completion, template
from spotcheck.dataset.instrument import read_instrument
from spotcheck.dataset.scan.answers import COLOUR_KEYS, check_answers
from spotcheck.dataset.scan.draft import METADATA_COLUMNS, POSITION, ManifestDraft, draft_manifest
from spotcheck.dataset.scan.folder_scan import FolderScan, scan_folder
from spotcheck.dataset.scan.summary import summarize_scan
from spotcheck.errors import InputError
from spotcheck.io import configuration
from spotcheck.io.formats.colour import Colour

# Column or key that the user is asked for → (example of an answer, meaning of the column or key).
QUESTIONS = {
    "exposure_s": ("2 ms", "exposure time of all frames"),
    POSITION: ("mm", "unit of the positions in the names"),
    "sensor.pixel_pitch_m": ("3.45 um", "pixel pitch of the camera"),
    "laser.wavelength_m": ("632.8 nm", "wavelength of the laser"),
}
# Largest number of files without an image, and of unreadable frames, that are listed.
MAX_LISTED = 5


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
    """Read what the images state, ask for what is missing, and write both files, or complete them if they exist.

    Raises `InputError` if an existing file cannot be read, if no image can be read although there are images or files
    to complete, or if an answer is impossible.
    """
    folder, answers = args.folder, dict(_parse_answer(word) for word in args.answers)
    written_names = completion.list_written_names(folder)
    sensor = read_instrument(folder / completion.INSTRUMENT).sensor
    colour = Colour(answers.get(COLOUR_KEYS[0], sensor.channel), answers.get(COLOUR_KEYS[1], sensor.bayer))
    # Frames of the folder, files that are neither images nor metadata, and a message for each unreadable image.
    scan = scan_folder(folder, colour) if folder.is_dir() else FolderScan((), (), ())
    if scan.errors and not scan.frames:
        hint = ", such as by --set sensor.channel=red" if COLOUR_KEYS[0] in scan.errors[0] else ""
        count = f"; of {len(scan.errors)} images none is read" if len(scan.errors) > 1 else ""
        raise InputError(f"{scan.errors[0]}{hint}{count}")
    check_answers(scan, answers)
    if scan.frames:
        _write_rows(folder, scan, answers, colour, written_names)
    else:
        if folder.is_dir():
            others = f" that is read, but {', '.join(scan.unread_files[:MAX_LISTED])}" if scan.unread_files else ""
            print(f"{folder}: holds no image{others}")
        for name in (completion.MANIFEST, completion.INSTRUMENT):
            if (folder / name).exists():
                raise InputError(f"{folder / name}: is there, and no image by which it could be completed; add images")
        template.write_template(folder)
        print(f"{folder}: wrote manifest.csv, instrument.yaml; fill in the blanks, then: spotcheck check {folder}")
    if remark := configuration.remark_on_quotes(str(folder)):
        print(remark)


def _write_rows(
    folder: Path, scan: FolderScan, answers: dict[str, str], colour: Colour, written_names: set[str]
) -> None:
    """Print what the images state, ask for what is missing, write or complete both files, and print what has changed.

    `scan` is the content of the folder, `answers` the value of each column or key that the user gave. `colour` says
    which channel of colour images is read, and `written_names` are the columns and keys that have a value in existing
    files. The user is asked only at a terminal.
    """
    # The draft has the rows of the manifest and the keys of the instrument file.
    draft = draft_manifest(scan, answers)
    # The side of the crop is None if the default is large enough or no spot was found.
    proposal = propose_crop_size(folder, draft, colour)
    if proposal.errors:
        # Files whose pixels cannot be read are left out, as those whose headers cannot be read are.
        errors = (*scan.errors, *proposal.errors.values())
        scan = scan._replace(
            frames=tuple(frame for frame in scan.frames if frame.file not in proposal.errors), errors=errors
        )
        if not scan.frames:
            raise InputError(f"{errors[0]}{f'; of {len(errors)} images none is read' if len(errors) > 1 else ''}")
        draft = draft_manifest(scan, answers)
    print(*summarize_scan(str(folder), scan, draft), sep="\n")
    if missing_keys := [key for key in _list_missing_keys(draft) if key not in written_names]:
        if sys.stdin.isatty():
            answers |= dict(pair for key in missing_keys if (pair := _ask_user(scan, key)))
            draft = draft_manifest(scan, answers)
        else:
            example = f"{missing_keys[0]}={QUESTIONS[missing_keys[0]][0].replace(' ', '')}"
            print(f"Not found: {', '.join(missing_keys)}.")
            print(f"Give what you know by options such as --set {example}, or write it into manifest.csv and")
            print("instrument.yaml. Without it the frames are evaluated as far as possible.")
    if not proposal.has_spot:
        print("No spot stands out in these frames. Mark darks and flats by the words dark and flat in names of")
        print("files or folders, or in the column kind.")
    written, changes, remarks = completion.write_or_complete(folder, draft, proposal.side_px, answers)
    for sentence in (*changes, *remarks):
        print(sentence)
    done = [f"wrote {', '.join(written)}"] if written else []
    done += ["completed what was there"] if changes else []
    done = done or ["nothing is missing that these images or --set give"]
    print(f"{folder}: {', '.join(done)}; next: spotcheck check {folder}")


def _ask_user(scan: FolderScan, key: str) -> tuple[str, str] | None:
    """Return `key`, one of `QUESTIONS`, with the answer of the user; None after an empty answer, if it is not known.

    The user is asked again after an invalid answer.
    """
    example, meaning = QUESTIONS[key]
    while answer := input(f"{key}: {meaning}, such as {example} (Enter if it is not known): ").strip():
        try:
            pair = _parse_answer(f"{key}={answer}")
            check_answers(scan, dict([pair]))
            return pair
        except InputError as error:
            print(str(error).removeprefix("--set "))
    return None


def _list_missing_keys(draft: ManifestDraft) -> Iterator[str]:
    """Yield the columns of the manifest and keys of the instrument file to ask the user for.

    The frames need them, but no file states them, or what the files state cannot be used.
    """
    # Columns for which files state values that cannot be used, since a unit is missing or sources disagree.
    unclear_columns = {record.column for record in draft.unused} | {conflict.column for conflict in draft.conflicts}
    # `missing` lists the files without a value, for each column. The exposure is asked for only if all rows lack it.
    if len(draft.missing["exposure_s"]) == len(draft.rows) and "exposure_s" not in unclear_columns:
        yield "exposure_s"
    # `columns` has the position if at least one frame has a usable value of it. A unit does not settle a question.
    has_question = any(record.column == POSITION and record.question for record in draft.unused)
    if POSITION in unclear_columns and POSITION not in draft.columns and not has_question:
        yield POSITION
    if draft.has_spots:
        yield from (key for key in ("sensor.pixel_pitch_m", "laser.wavelength_m") if key not in draft.instrument_keys)


def _parse_answer(word: str) -> tuple[str, str]:
    """Return column or key, and value, of a word KEY=VALUE.

    Raises `InputError` if the word is not of this form, the key is unknown, or the value is not among the choices of
    the key. The value is not checked further.
    """
    key, equals, value = (part.strip() for part in word.partition("="))
    # JSON schema of each key; `enum` lists the choices, if the key has any.
    schema_by_key = template.list_settable_keys()
    if not equals or key not in (*METADATA_COLUMNS, *schema_by_key) or not value:
        raise InputError(
            f"--set {word}: must be KEY=VALUE, with a KEY of {', '.join(METADATA_COLUMNS)} or of a number of"
            " instrument.yaml; write others into that file"
        )
    choices = schema_by_key.get(key, {}).get("enum", [value])
    if value not in choices:
        raise InputError(f"--set {word}: must be one of {', '.join(choices)}")
    return key, value
