"""A new dataset folder: manifest.csv with a row for every frame that was found, and a commented instrument.yaml."""

import csv
import io
from pathlib import Path

from spotcheck.dataset.manifest import REQUIRED_COLUMNS
from spotcheck.dataset.survey.rows import Rows
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.io.schema import read_schema

NUMBERS = ("number", "integer")
# Lines on what the files say beside what is used.
MOST_SAID = 30


EXAMPLE = {"file": "frames/first.tif", "kind": "spot", "angle_deg": "0", "exposure_s": "0.0001", "repeat": "0"}


def check_free(folder: Path) -> None:
    """Raise `InputError` where a folder holds a manifest or a data sheet: neither is ever overwritten."""
    for name in ("manifest.csv", "instrument.yaml"):
        if (folder / name).exists():
            raise InputError(f"{folder / name}: is already there; choose another folder or move it away")


def write(folder: Path, rows: Rows | None = None, crop_px: int | None = None) -> None:
    """Write manifest.csv and instrument.yaml: of the frames that were found, else empty ones to fill in.

    Raises `InputError` when one of them is already there.
    """
    check_free(folder)
    if rows is None:
        (folder / "frames").mkdir(parents=True, exist_ok=True)
    store.write_text(folder / "manifest.csv", manifest(rows))
    store.write_text(folder / "instrument.yaml", instrument(rows, crop_px))


def manifest(rows: Rows | None) -> str:
    """Header and a row a frame; without frames one example row that `spotcheck check` will ask to replace."""
    comments = [
        "# One row a frame, in the order of acquisition. Lines that start with # are comments.",
        "# file: relative to this folder. kind: spot, dark (no light) or flat (homogeneous light).",
        "# angle_deg: orientation of the sample; exposure_s: in seconds. Leave either blank in every row where it was",
        "# not recorded, and in rows of dark and flat frames where it has no meaning.",
        "# repeat: 0, 1, 2 ... within a condition; frames of one angle and repeat look at the same site. Number on",
        "# through all exposures where the sample moved between them.",
        "# page: of a stack, counted from 0; other files need no such column. Other columns are carried along; name",
        "# those that are axes of the experiment under `conditions` in instrument.yaml.",
    ]
    text = io.StringIO("\n".join(comments) + "\n")
    text.seek(0, io.SEEK_END)
    columns = rows.columns if rows else REQUIRED_COLUMNS
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows.cells if rows else [EXAMPLE])
    return text.getvalue()


def instrument(rows: Rows | None = None, crop_px: int | None = None) -> str:
    """Every key of the schema: those that were found with their value and its origin, the others as comments with their
    meaning and default."""
    schema = read_schema("instrument")
    known = _known(rows, crop_px)
    lines = [
        "# Take the # off the keys that you know. A missing key is never an error: it is taken from the frames",
        "# where they allow it, else the report says what could not be computed for want of it.",
        "",
    ]
    for name, key in schema["properties"].items():
        if key["type"] != "object":
            lines.append(_given(name, *known[name]) if name in known else f"# {_line(name, key)}")
            continue
        own = {inner: known.get(f"{name}.{inner}") for inner in key["properties"]}
        lines.append(f"\n{name}:" if any(own.values()) else f"\n# {name}:")
        for inner, content in key["properties"].items():
            found = own[inner]
            lines.append(f"  {_given(inner, *found)}" if found else f"#   {_line(inner, content)}")
    if rows and rows.also:
        lines += ["", "# Said by the files as well, and not used:"]
        lines += [f"#   {own.text} ({own.where})" for own in rows.also[:MOST_SAID]]
    return "\n".join(lines) + "\n"


def keys() -> dict[str, dict]:
    """Every key of instrument.yaml that holds a number or one of some words, with what the schema says of it."""
    sections = read_schema("instrument")["properties"]
    own = {f"{name}.{key}": kind for name, held in sections.items() for key, kind in held.get("properties", {}).items()}
    return {key: kind for key, kind in own.items() if kind["type"] in NUMBERS or "enum" in kind}


def _known(rows: Rows | None, crop_px: int | None) -> dict[str, tuple[object, str]]:
    """Value and origin of every key that the frames tell."""
    known: dict[str, tuple[object, str]] = {}
    if rows is None:
        return known
    if not rows.order_known:
        known["order_known"] = "false", "neither times nor one running number tell the order"
    if rows.conditions:
        known["conditions"] = f"[{', '.join(rows.conditions)}]", "takes more than one value"
    if crop_px:
        known["crop_px"] = crop_px, "ten times the widest spot's standard deviation, as far as the frames reach"
    if rows.spots and all(cell["exposure_s"] == "" for cell in rows.cells if cell["kind"] == "spot"):
        known["model.photon_budget"] = "free", "without exposures no law links the peaks of the frames"
    for key, label in rows.keys.items():
        known[key] = label.value, f"{label.where}: {label.text}"
    return known


def _given(name: str, value: object, origin: str) -> str:
    return f"{name}: {value}".ljust(34) + f"# {origin}"


def _line(name: str, key: dict) -> str:
    choices = f" ({', '.join(key['enum'])})" if "enum" in key else ""
    default = key.get("default", "")
    shown = {True: "true", False: "false"}.get(default, default) if isinstance(default, bool) else default
    return f"{name}: {shown}".ljust(34) + f"# {key.get('description', '')}{choices}"
