"""Files of a new dataset: manifest.csv with a row per frame, and a commented instrument.yaml."""

import csv
import io
from pathlib import Path

from spotcheck.dataset.manifest import REQUIRED_COLUMNS
from spotcheck.dataset.scan.draft import ManifestDraft
from spotcheck.io import store
from spotcheck.io.schema import read_schema, read_yaml

# Most entries of unused metadata that instrument.yaml lists.
MOST_UNUSED = 30
# Column at which comments of instrument.yaml start.
COMMENT_COLUMN = 34
# Row of a manifest without frames; `spotcheck check` asks to replace it.
EXAMPLE_ROW = {"file": "frames/first.tif", "kind": "spot", "angle_deg": "0", "exposure_s": "0.0001", "repeat": "0"}
# File of the comments at the start of manifest.csv and of instrument.yaml, by the keys "manifest" and "instrument".
COMMENTS = Path(__file__).with_name("template_comments.yaml")
# Value and source of each known key of instrument.yaml, such as "sensor.bit_depth".
KnownKeys = dict[str, tuple[object, str]]
# Key of the law of the peak over exposure time, and its value and source where exposure times are missing.
FREE_BUDGET = "model.photon_budget"
FREE_BUDGET_VALUE = ("free", "without exposures no law links the peaks of the frames")


def write_template(folder: Path) -> None:
    """Write manifest.csv and instrument.yaml of a new dataset, which the user fills in, and make its folder frames/."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    store.write_text(folder / "manifest.csv", format_manifest(None))
    store.write_text(folder / "instrument.yaml", format_instrument(None, None))


def list_settable_keys() -> dict[str, dict]:
    """Return the JSON schema of each key in a section of instrument.yaml that takes a number or one of a few words.

    The names of the keys include their section: "sensor.bit_depth".
    """
    return {
        f"{section}.{name}": key_schema
        for section, section_schema in read_schema("instrument")["properties"].items()
        for name, key_schema in section_schema.get("properties", {}).items()
        if key_schema["type"] in ("number", "integer") or "enum" in key_schema
    }


def format_comments(file: str) -> str:
    """Return the comments at the start of a new file, "manifest" or "instrument"."""
    return read_yaml(COMMENTS)[file]


def format_manifest(draft: ManifestDraft | None) -> str:
    """Return the text of manifest.csv: comments, header, and the rows of the draft or else an example."""
    text = io.StringIO()
    text.write(format_comments("manifest"))
    columns = draft.columns if draft else REQUIRED_COLUMNS
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(draft.rows if draft else [EXAMPLE_ROW])
    return text.getvalue()


def format_instrument(draft: ManifestDraft | None, crop_px: int | None) -> str:
    """Return the text of instrument.yaml: known keys with their source, the others as comments with their meaning."""
    known_keys = collect_known_keys(draft, crop_px) if draft else {}
    lines = [format_comments("instrument")]
    for name, schema in read_schema("instrument")["properties"].items():
        if schema["type"] == "object":
            section = {f"{name}.{key}": key_schema for key, key_schema in schema["properties"].items()}
            lines.append(f"\n{name}:" if known_keys.keys() & section else f"\n# {name}:")
            lines += [format_key(full_key, key_schema, known_keys) for full_key, key_schema in section.items()]
        else:
            lines.append(format_key(name, schema, known_keys))
    if draft and draft.unused:
        lines += ["", "# Other metadata in the files, which is not used:"]
        lines += [f"#   {unused.text} ({unused.source})" for unused in draft.unused[:MOST_UNUSED]]
    return "\n".join(lines) + "\n"


def collect_known_keys(draft: ManifestDraft, crop_px: int | None) -> KnownKeys:
    """Return value and source of each key that the frames determine, such as "sensor.bit_depth"."""
    known_keys: KnownKeys = {}
    if not draft.is_order_known:
        known_keys["order_known"] = "false", "neither times nor one running number tell the order"
    if draft.conditions:
        known_keys["conditions"] = f"[{', '.join(draft.conditions)}]", "takes more than one value"
    if crop_px:
        known_keys["crop_px"] = crop_px, "ten times the widest spot's standard deviation, as far as the frames reach"
    if draft.has_spots and all(row["exposure_s"] == "" for row in draft.rows if row["kind"] == "spot"):
        known_keys[FREE_BUDGET] = FREE_BUDGET_VALUE
    for key, entry in draft.instrument_keys.items():
        known_keys[key] = entry.value, f"{entry.source}: {entry.text}"
    return known_keys


def format_key(full_key: str, key_schema: dict, known_keys: KnownKeys) -> str:
    """Return the line of a key: its value and source if it is known, else a comment with its default and meaning.

    `full_key` includes the section: "sensor.bit_depth".
    """
    section, _, name = full_key.rpartition(".")
    if full_key in known_keys:
        value, source = known_keys[full_key]
        return ("  " if section else "") + f"{name}: {value}".ljust(COMMENT_COLUMN) + f"# {source}"
    default = key_schema.get("default", "")
    # YAML writes true and false in lower case.
    default = str(default).lower() if isinstance(default, bool) else default
    choices = f" ({', '.join(key_schema['enum'])})" if "enum" in key_schema else ""
    indent = "#   " if section else "# "
    return indent + f"{name}: {default}".ljust(COMMENT_COLUMN) + f"# {key_schema.get('description', '')}{choices}"
