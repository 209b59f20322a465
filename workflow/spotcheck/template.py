"""A new dataset folder: manifest.csv with a row for every image that is there, and an instrument.yaml of comments."""

from pathlib import Path

from spotcheck import store
from spotcheck.errors import InputError
from spotcheck.manifest import IMAGE_SUFFIXES, REQUIRED_COLUMNS
from spotcheck.schema import read_schema


def write(folder: Path) -> list[str]:
    """Write manifest.csv and instrument.yaml; raises `InputError` when one of them is already there."""
    for name in ("manifest.csv", "instrument.yaml"):
        if (folder / name).exists():
            raise InputError(f"{folder / name}: is already there; choose another folder or move it away")
    frames = folder / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    images = sorted(p for p in frames.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    store.write_text(folder / "manifest.csv", manifest([p.relative_to(folder).as_posix() for p in images]))
    store.write_text(folder / "instrument.yaml", instrument())
    return ["manifest.csv", "instrument.yaml"]


def manifest(files: list[str]) -> str:
    """Header, and a row a file: kind spot, repeat counting up, angle and exposure blank to be filled in.

    Without files, one example row that `spotcheck check` will ask to replace.
    """
    rows = [f"{file},spot,,,{k}" for k, file in enumerate(files)] or ["frames/first.tif,spot,0,0.0001,0"]
    comments = [
        "# One row a frame, in the order of acquisition. Lines that start with # are comments.",
        "# file: relative to this folder. kind: spot, dark (no light) or flat (homogeneous light).",
        "# angle_deg: orientation of the sample; exposure_s: in seconds. Leave either blank in every row where it was",
        "# not recorded, and in rows of dark and flat frames where it has no meaning.",
        "# repeat: 0, 1, 2 ... within a condition; frames of one angle and repeat look at the same site.",
        "# page: add this column for stacks, counted from 0. Other columns are carried along; name those that are axes",
        "# of the experiment under `conditions` in instrument.yaml.",
    ]
    return "\n".join([*comments, ",".join(REQUIRED_COLUMNS), *rows]) + "\n"


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
