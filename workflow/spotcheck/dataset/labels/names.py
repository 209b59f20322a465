"""Names of files and folders: `45deg/100us_003.tif`, `t=1.5ms`, `z_176mm`, `dark_07`."""

import re
from collections.abc import Iterator
from pathlib import PurePath

from spotcheck.dataset.labels import units
from spotcheck.dataset.labels.label import Label
from spotcheck.dataset.labels.words import KEYS, KINDS, date_in

FILE, FOLDER = "file name", "folder name"
# A number with its unit, and the word before it. 1p5 is how names write 1.5.
_QUANTITY = re.compile(
    rf"(?<![A-Za-z0-9.])(?:(?P<key>[^\W\d_]+)(?P<gap>\s*=\s*|[\s_-]*))?(?P<sign>[-+]?)(?P<number>\d+(?:[.,p]\d+)?)"
    rf"[\s_]?(?P<unit>(?i:{units.ANY}))(?![^\W_])"
)
# A word and a number without a unit.
_NUMBERED = re.compile(r"(?<![A-Za-z0-9.])(?P<key>[^\W\d_]+)(?P<gap>[\s_=-]*)(?P<number>\d+(?:[.,p]\d+)?)(?![^\W_])")
_LAST = re.compile(r"(?:^|[\s_.()-])(\d{1,6})\)?$")
# What a length or a time in a name is where no key says so.
_MEANT = {"s": "exposure_s", "m": "z_m", "deg": "angle_deg"}
# Words whose number is that of a repeat, and words that merely count files.
# Words before a number with a unit by which it is neither exposure, position nor angle of the sample.
OTHER = (
    *(
        "x",
        "y",
        "f",
        "d",
        "w",
        "dx",
        "dy",
        "lens",
        "focal",
        "fl",
        "dia",
        "diameter",
        "pinhole",
        "slit",
        "fwhm",
        "waist",
    ),
    *("delay", "period", "interval", "pulse", "wait", "dt", "tilt", "pol", "polarizer", "polariser", "hwp", "qwp"),
)
# A day, perhaps with a time: 20260131, 2026-01-31_143000.
_DAY = re.compile(
    r"(?<!\d)((?:19|20)\d\d)([-_.]?)([01]\d)\2([0-3]\d)(?:[-_T ]*(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d))?(?!\d)"
)
COUNTED = ("r", "rep", "repeat", "shot", "run")
NUMBERED = ("snap", "img", "image", "frame", "pic", "no", "nr", "n", "page")
# Light of a laser that silicon sees [m]: a length in nanometres within it is the wavelength.
LIGHT_M = (1.5e-7, 1.2e-6)


def labels_of(name: str, where: str = FILE) -> Iterator[Label]:
    """Labels of a file's stem or of a folder's name."""
    name = name[:250]
    rest = name
    for found in _QUANTITY.finditer(name):
        if label := _quantity(found, where):
            yield label
            rest = rest.replace(label.text, " ", 1)
    if day := _DAY.search(rest):
        year, _, month, date, *time = day.groups()
        if value := date_in(f"{year}-{month}-{date}" + (f"T{':'.join(time)}" if time[0] else "")):
            yield Label("date", value, day[0], where)
            rest = rest.replace(day[0], " ", 1)
    for word in re.findall(r"[^\W\d_]+", rest):
        if word.lower() in KINDS:
            yield Label("kind", KINDS[word.lower()], word, where)
    for found in list(_NUMBERED.finditer(rest)):
        key, number = found["key"].lower(), found["number"].replace("p", ".")
        if key in COUNTED and number.isdecimal():
            yield Label("repeat", int(number), found[0], where)
        elif key in KEYS and KEYS[key][1] in units.UNITS:
            column, kind = KEYS[key]
            yield Label(column, units.scaled(number, "deg", kind) if kind == "deg" else None, found[0], where)
        elif key in (*KINDS, *NUMBERED) or (found["gap"] and found.end() == len(rest)):
            continue
        else:
            yield Label(None, None, found[0], where)
        rest = rest.replace(found[0], " ", 1)
    if (last := _LAST.search(rest.rstrip())) and where == FILE:
        yield Label("number", int(last[1]), last[1], where)


def of_path(path: PurePath) -> Iterator[Label]:
    """Labels of a path relative to the folder of the frames: its file first, then its folders from below."""
    yield from labels_of(path.stem, FILE)
    for folder in reversed(path.parts[:-1]):
        if folder not in ("..", "/"):
            yield from labels_of(folder, FOLDER)


def _quantity(found: re.Match, where: str) -> Label | None:
    """The label of a number with a unit; None where the word before it measures something else."""
    unit, key = found["unit"], (found["key"] or "").lower()
    kind = units.kind_of(unit)
    if kind is None:
        return None
    # A hyphen alone between a word and a number parts them; behind another sign, or behind none, it is a minus.
    gap = found["gap"]
    minus = found["sign"] == "-" or (gap is not None and len(gap) > 1 and gap.endswith("-"))
    sign = "-" if minus else ""
    number = units.scaled(sign + found["number"].replace("p", "."), unit, kind)
    if number is None:
        return None
    column = _MEANT.get(kind)
    joined = key in KEYS or found["gap"] == "" or "=" in (found["gap"] or "")
    text = found[0] if joined else found[0][found.start("number") - found.start() :]
    if key in OTHER:
        return Label(None, None, found[0], where)
    if key in KEYS:
        column, own = KEYS[key]
        if own != kind:
            return Label(None, None, found[0], where)
    elif kind == "m" and unit.lower() == "nm" and LIGHT_M[0] <= number <= LIGHT_M[1]:
        column = "laser.wavelength_m"
    return Label(column, number, text.strip(" _-"), where) if column else None


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people count, 2 before 10, whatever their capitals."""
    return [
        (int(part), "") if part.isdecimal() and len(part) < 20 else (-1, part.casefold())
        for part in re.split(r"(\d+)", name)
    ]
