"""All images of a folder, page by page, with what is said of each."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from spotcheck.dataset.labels import beside, units
from spotcheck.dataset.labels.files import labels_of
from spotcheck.dataset.labels.label import Label, agree, shown
from spotcheck.dataset.labels.names import FILE, FOLDER, natural
from spotcheck.dataset.manifest import KINDS
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.schema import find_violation

# Keys by which frames with colours are read, and columns and keys that hold words.
COLOUR = ("sensor.channel", "sensor.bayer")
WORDS = ("kind", "date", *COLOUR)
# Units of columns and keys, by the ends of their names.
KIND_OF = {"_s": "s", "_m": "m", "_deg": "deg"}


class Shot(NamedTuple):
    """A frame: its file relative to the folder, page, rows and columns [px], bits, and all that is said of it."""

    file: str
    page: int
    shape: tuple[int, int]
    bits: int
    labels: tuple[Label, ...]


class Scan(NamedTuple):
    """Frames in the order of their names, files that are not read, and a sentence for each image that cannot be."""

    shots: tuple[Shot, ...]
    others: tuple[str, ...]
    broken: tuple[str, ...]


def scan(folder: Path, colour: Colour = MONOCHROME) -> Scan:
    """Every image in frames/, else anywhere below a folder; of images with colours the plane of `colour`.

    Raises `InputError` for a name that no text can hold.
    """
    home = folder.resolve()
    visible = [path for path in folder.rglob("*") if path.is_file() and not _hidden(path.relative_to(folder))]
    images = [path for path in visible if path.suffix.lower() in IMAGE_SUFFIXES]
    # A manifest names nothing outside its folder.
    images = [path for path in images if path.resolve().is_relative_to(home)]
    images = [path for path in images if (folder / "frames") in path.parents] or images
    images.sort(key=lambda path: natural(path.relative_to(folder).as_posix()))
    shots, broken, read = list[Shot](), list[str](), set(images)
    for image in images:
        name = image.relative_to(folder).as_posix()
        if not name.isprintable():
            raise InputError(f"{name!r}: its name holds what is no letter; rename it")
        try:
            names = files.list_stacks(image, name)
            stacks = [(stack, files.list_pages(folder / stack, stack, colour)) for stack in names]
        except InputError as error:
            broken.append(str(error))
            continue
        for stack, pages in stacks:
            labels = labels_of(image, folder, split_inner_path(stack)[1])
            for number, page in enumerate(pages):
                own = tuple(label for label in labels if label.page in (None, number))
                if not page.preview:
                    shots.append(Shot(stack, number, page.shape, page.bits, own))
        read |= {*beside.files_of(image), *(own for up in image.parents[:2] for own in beside.lists_in(up))}
    others = sorted(path.relative_to(folder).as_posix() for path in visible if path not in read)
    return Scan(_signed(shots), tuple(others), tuple(broken))


def _signed(shots: list[Shot]) -> tuple[Shot, ...]:
    """The shots with a minus where hyphens in their names are one: `z-5mm` beside `z+5mm` or `z0mm`."""
    texts = {label.text for shot in shots for label in shot.labels if label.where in (FILE, FOLDER)}
    both = {word[1] for text in texts if (word := re.match(r"([^\W\d_]+)\+?\d", text))}

    def signed(label: Label) -> Label:
        word = re.match(r"([^\W\d_]+)-\d", label.text) if label.where in (FILE, FOLDER) else None
        minus = word is not None and word[1] in both
        return label._replace(value=-label.value) if minus and isinstance(label.value, float) else label

    return tuple(shot._replace(labels=tuple(map(signed, shot.labels))) for shot in shots)


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


class Settled(NamedTuple):
    """What is settled of a frame by column, and the pairs of labels that contradict each other by column."""

    labels: dict[str, Label]
    against: dict[str, tuple[Label, Label]]


def settle(shot: Shot, given: Mapping[str, str]) -> Settled:
    """What the labels of a frame agree on, with the answers that a user gave by column.

    An answer is a value, the unit of numbers that have none, or the source that is right where two contradict each
    other. Raises `InputError` for one that is none of these.
    """
    labels, against = dict[str, Label](), dict[str, tuple[Label, Label]]()
    by_column = dict[str, list[Label]]()
    for label in shot.labels:
        if label.column:
            by_column.setdefault(label.column, []).append(label)
    for column, own in by_column.items():
        answer = given.get(column, "")
        known = [label for label in own if label.value is not None] or _in_unit(own, answer)
        known = [label for label in known if source(label) == answer] or known
        if not known:
            continue
        other = next((label for label in known if not agree(known[0], label)), None)
        if other is None:
            labels[column] = known[0]
        else:
            against[column] = known[0], other
    for column, answer in given.items():
        value = answered(column, answer)
        if value is not None:
            labels[column] = Label(column, value, answer, "as you said")
            against.pop(column, None)
    return Settled(labels, against)


def check(scan: Scan, given: Mapping[str, str]) -> None:
    """Raise `InputError` for an answer that nothing can be made of."""
    for column, answer in given.items():
        sources = {
            word for shot in scan.shots for own in shot.labels if own.column == column for word in (source(own),)
        }
        kind = kind_of(column)
        if answered(column, answer) is None and answer not in sources and not (kind and units.kind_of(answer) == kind):
            also = f", or which source is right: {', '.join(sorted(sources))}" if sources else ""
            right = {
                "kind": "spot, dark or flat",
                "s": "a time such as 2ms",
                "m": "a length such as 3.45um",
                "deg": "an angle such as 45deg",
            }
            raise InputError(f"--set {column}={answer}: must be {right.get(kind or column, 'a number')}{also}")
        if breach := breach_of_key(column, answered(column, answer)):
            raise InputError(f"--set {column}={answer}: {breach}")


def breach_of_key(column: str, value: float | int | str | None) -> str | None:
    """What is wrong with the value of a key of instrument.yaml, in a sentence; None for a good one, and for columns."""
    section, dot, key = column.partition(".")
    return find_violation({section: {key: value}}, "instrument") if dot and value is not None else None


def source(label: Label) -> str:
    """Where a label comes from, the same for all files: of a file beside an image only its ending."""
    return re.sub(r"^side file .*(\.\w+)$", r"side file *\1", label.where)


def answered(column: str, answer: str) -> float | int | str | None:
    """The value that an answer gives for a column; None where it is a unit or the name of a source."""
    if column in WORDS:
        return answer if column in ("date", *COLOUR) or answer in KINDS else None
    parted = units.parted(answer)
    if parted is None:
        return None
    number, unit = parted
    kind = kind_of(column)
    if kind and unit:
        return units.scaled(number, unit, kind)
    value = float(number.replace(",", "."))
    return int(value) if column in ("repeat", "sensor.bit_depth") else value


def kind_of(column: str) -> str | None:
    """What a column or key measures: s, m or deg; None for what has no unit that is written behind it."""
    return next((kind for end, kind in KIND_OF.items() if column.endswith(end)), None)


def _in_unit(labels: list[Label], unit: str) -> list[Label]:
    """Labels whose numbers lack a unit, in that unit; none where it does not measure them."""
    found = []
    for label in labels:
        kind, number = kind_of(label.column or ""), re.search(rf"{units.NUMBER}$", label.text)
        value = (
            units.scaled(number[0].lstrip("-_"), unit, kind)
            if kind and number and units.kind_of(unit) == kind
            else None
        )
        if value is not None:
            found.append(label._replace(value=value))
    return found


def contradiction(column: str, pair: tuple[Label, Label], count: int) -> str:
    """Two labels that contradict each other in a column, in a sentence."""
    return (
        f"{column}: {shown(pair[0])}, but {shown(pair[1])}{f' ({count} frames)' if count > 1 else ''}; left blank:"
        f' say which is right by --set "{column}={source(pair[0])}" or --set "{column}={source(pair[1])}"'
    )
