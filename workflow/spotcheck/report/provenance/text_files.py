"""Numbers in text files: verdict.json and paper_numbers.csv of the results, and the instrument file of the dataset."""

import ast
import csv
import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from spotcheck.dataset.instrument import read_instrument
from spotcheck.io.provenance import PACKAGE
from spotcheck.io.schema import read_schema
from spotcheck.model.effects import built_in
from spotcheck.report.provenance.records import CatalogEntry, StoredNumber

# Keys that name an item of a list.
ITEM_NAME_KEYS = ("name", "effect")
# A word of a path that is left out of names.
OMITTED_WORD = "parameters"
# Keys of numbers whose unit is the key `unit` of the same object.
KEYS_WITH_UNIT = ("value", "low", "high", "measured", "declared", "extended")
# Keys of standard errors, which belong to other numbers.
STDERR_KEYS = ("stderr", "error", "stated_stderr")
# Description of a key in the schema of the instrument file, with the unit in brackets.
DESCRIPTION = re.compile(r"(?P<words>[^\[]+?)(?: \[(?P<unit>[^\]]+)\].*)?")

NamedNumbers = Iterator[tuple[CatalogEntry, StoredNumber]]
Schema = dict[str, Any]
Words = tuple[str, ...]


def read_verdict(path: Path) -> NamedNumbers:
    """Yield all numbers of verdict.json; unit, description and key of the error are those of its schema."""
    verdict = json.loads(path.read_text(encoding="utf-8"))
    return _walk(verdict, _resolve(_verdict_schema()), (path.stem,), ())


def _walk(parent: Any, schema: Schema, path: Words, words: Words) -> NamedNumbers:
    """Yield all numbers below an object or list; `path` leads to it, and `words` describe it."""
    for key, child, names in _list_children(parent):
        child_schema = _child_schema(schema, key, isinstance(parent, list))
        child_path = (*path, *names)
        # The name of an item replaces the name of its list.
        is_named_item = isinstance(parent, list) and names[0] != str(key)
        child_words = (*(words[:-1] if is_named_item else words), *names)
        if isinstance(child, dict | list):
            yield from _walk(child, child_schema, child_path, child_words)
        elif type(child) in (int, float) and key not in STDERR_KEYS and "const" not in child_schema:
            # The last word of a path alone is ambiguous: most objects have a `value` or a `z`.
            yield (
                CatalogEntry(tuple(word for word in child_path if word != OMITTED_WORD), min_words=2),
                _number_of_verdict(parent, schema, key, child_schema, child_path, child_words),
            )


def _list_children(parent: Any) -> Iterator[tuple[Any, Any, Words]]:
    """Yield key or index, value, and the words that it adds to the path, for each child of an object or list."""
    if isinstance(parent, dict):
        yield from ((key, child, () if key == "value" else (str(key),)) for key, child in parent.items())
        return
    for k, item in enumerate(parent):
        keys = item.keys() if isinstance(item, dict) else ()
        name = next((str(item[key]) for key in ITEM_NAME_KEYS if key in keys), str(k))
        yield k, item, (name, str(item["parameter"])) if "parameter" in keys else (name,)


def _number_of_verdict(
    parent: Any, schema: Schema, key: Any, child_schema: Schema, path: Words, words: Words
) -> StoredNumber:
    """Return the number at `key` of an object or list."""
    siblings = parent if isinstance(parent, dict) else {}
    # The schema describes an object {value, stderr} as a whole.
    described = schema | child_schema if key == "value" else child_schema
    stderr_key = described.get("error", "stderr" if key == "value" else "")
    unit = described.get("unit") or (siblings.get("unit") if stderr_key or key in KEYS_WITH_UNIT else None)
    effects = built_in()
    sentence = next((effects[word].sentence for word in words if word in effects), "")
    name = " ".join(word.replace("_", " ") for word in words if word != OMITTED_WORD)
    return StoredNumber(
        value=parent[key],
        stderr=siblings.get(stderr_key),
        unit=str(unit or "1"),
        description=": ".join(filter(None, (name, described.get("description") or sentence))),
        variable=".".join(path[1:]),
    )


def _child_schema(schema: Schema, key: Any, is_list: bool) -> Schema:
    """Return the schema of a child of an object or list; {} if there is none."""
    if is_list:
        return _resolve(schema.get("items", {}))
    additional = schema.get("additionalProperties")
    return _resolve(schema.get("properties", {}).get(key) or (additional if isinstance(additional, dict) else {}))


def _resolve(schema: Schema) -> Schema:
    """Return a schema merged with the definition that it refers to."""
    name = str(schema.get("$ref", "")).removeprefix("#/$defs/")
    return _verdict_schema()["$defs"][name] | schema if name else schema


@cache
def _verdict_schema() -> Schema:
    """Return the JSON schema of verdict.json."""
    return read_schema("verdict")


def read_paper_numbers(path: Path) -> NamedNumbers:
    """Yield our value of each number of the paper."""
    with path.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            name = row["id"]
            number = StoredNumber(
                value=float(row["ours"]),
                stderr=None,
                unit=row["unit"],
                description=f"{name.replace('_', ' ')}; the paper prints {row['printed']} (section {row['section']})",
                variable=f"ours[id={name}]",
                method=_paper_docstrings().get(name, ""),
            )
            yield CatalogEntry((path.stem, name), is_secondary=True), number


@cache
def _paper_docstrings() -> Mapping[str, str]:
    """Return the first paragraph of the docstring of each function that computes a number of the paper, by name."""
    return {
        node.name: " ".join(text.split("\n\n")[0].split())
        for path in (PACKAGE / "paper").glob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef) and (text := ast.get_docstring(node))
    }


def read_instrument_numbers(path: Path) -> NamedNumbers:
    """Yield all numbers of an instrument file, including defaults. Raises `InputError` if it cannot be read."""
    instrument = read_instrument(path)
    for key, schema in _list_instrument_keys(read_schema("instrument")):
        section, _, name = key.rpartition(".")
        owner = getattr(instrument, section) if section else instrument
        value = getattr(owner, name)
        if schema["type"] not in ("number", "integer") or value is None or name.endswith("_stderr"):
            continue
        description = DESCRIPTION.fullmatch(schema["description"])
        assert description is not None, key
        method = "" if key in instrument.given_keys else f"the default: {path.name} does not give it"
        if key in instrument.inherited_keys:
            method = f"given by {instrument.based_on}, on which {path.name} is based"
        number = StoredNumber(
            value=float(value),
            stderr=getattr(owner, f"{name}_stderr", 0.0) or None,
            unit=description["unit"] or "1",
            description=description["words"],
            variable=key,
            method=method,
        )
        # Results take precedence over the instrument file for a shared short name.
        yield CatalogEntry((path.stem, *key.split(".")), is_secondary=True), number


def _list_instrument_keys(schema: Schema) -> Iterator[tuple[str, Schema]]:
    """Yield the keys of the instrument file, such as "sensor.bit_depth", with their schemas."""
    for name, section in schema["properties"].items():
        keys = section.get("properties")
        yield from ((f"{name}.{key}", inner) for key, inner in keys.items()) if keys else ((name, section),)
