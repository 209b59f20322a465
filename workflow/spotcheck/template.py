"""A new dataset folder: manifest.csv with a row for every image that is there, and an instrument.yaml of comments."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from spotcheck import store
from spotcheck.errors import InputError
from spotcheck.formats import files
from spotcheck.manifest import IMAGE_SUFFIXES, REQUIRED_COLUMNS
from spotcheck.schema import read_schema


def write(folder: Path) -> list[str]:
    """Write manifest.csv and instrument.yaml; raises `InputError` when one of them is already there."""
    for name in ("manifest.csv", "instrument.yaml"):
        if (folder / name).exists():
            raise InputError(f"{folder / name}: is already there; choose another folder or move it away")
    frames = folder / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    images = _images(frames.rglob("*")) or _images(folder.glob("*"))
    pages = [(image.relative_to(folder).as_posix(), page) for image in images for page in _pages(image)]
    store.write_text(folder / "manifest.csv", manifest(pages))
    store.write_text(folder / "instrument.yaml", instrument())
    return ["manifest.csv", "instrument.yaml"]


def _images(paths: Iterable[Path]) -> list[Path]:
    """Those that are images by their endings, sorted. Raises `InputError` for a name that no text file can hold."""
    found = sorted(
        p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".") and p.is_file()
    )
    for image in found:
        if not image.name.isprintable():
            raise InputError(f"{str(image)!r}: its name holds what is no letter; rename it")
    return found


def others(folder: Path) -> list[str]:
    """Endings of the files in frames/ and beside it that are not read, hidden and dataset's own files apart."""
    found = {p.suffix for p in (*folder.glob("*"), *folder.glob("frames/**/*")) if p.is_file() and p.name[0] != "."}
    return sorted(found - {".csv", ".yaml", ""} - {own for own in found if own.lower() in IMAGE_SUFFIXES})


def _pages(image: Path) -> list[int]:
    """Numbers of the pages of a file; of one that cannot be read the first, and `spotcheck check` will say why."""
    try:
        return [number for number, page in enumerate(files.pages(image, image.name)) if not page.preview]
    except InputError:
        return [0]


def manifest(pages: Sequence[tuple[str, int]]) -> str:
    """Header, and a row a page of a file: kind spot, repeat counting up, angle and exposure blank to be filled in.

    Without files, one example row that `spotcheck check` will ask to replace.
    """
    comments = [
        "# One row a frame, in the order of acquisition. Lines that start with # are comments.",
        "# file: relative to this folder. kind: spot, dark (no light) or flat (homogeneous light).",
        "# angle_deg: orientation of the sample; exposure_s: in seconds. Leave either blank in every row where it was",
        "# not recorded, and in rows of dark and flat frames where it has no meaning.",
        "# repeat: 0, 1, 2 ... within a condition; frames of one angle and repeat look at the same site.",
        "# page: of a stack, counted from 0; other files need no such column. Other columns are carried along; name",
        "# those that are axes of the experiment under `conditions` in instrument.yaml.",
    ]
    stacks = any(page for _, page in pages)
    text = io.StringIO("\n".join(comments) + "\n")
    text.seek(0, io.SEEK_END)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*REQUIRED_COLUMNS, *(["page"] if stacks else [])])
    for repeat, (file, page) in enumerate(pages):
        writer.writerow([file, "spot", "", "", repeat, *([page] if stacks else [])])
    if not pages:
        writer.writerow(["frames/first.tif", "spot", 0, 0.0001, 0])
    return text.getvalue()


def instrument() -> str:
    """Every key of the schema as a comment with its meaning and default."""
    schema = read_schema("instrument")
    lines = [
        "# Take the # off the keys that you know. A missing key is never an error: it is taken from the frames",
        "# where they allow it, else the report says what could not be computed for want of it.",
        "",
    ]
    for name, key in schema["properties"].items():
        if key["type"] == "object":
            lines.append(f"\n# {name}:")
            lines += [f"#   {_line(own, content)}" for own, content in key["properties"].items()]
        else:
            lines.append(f"# {_line(name, key)}")
    return "\n".join(lines) + "\n"


def _line(name: str, key: dict) -> str:
    choices = f" ({', '.join(key['enum'])})" if "enum" in key else ""
    default = key.get("default", "")
    shown = {True: "true", False: "false"}.get(default, default) if isinstance(default, bool) else default
    return f"{name}: {shown}".ljust(34) + f"# {key.get('description', '')}{choices}"
