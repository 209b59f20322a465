"""Numbers in text files: verdict.json and paper_numbers.csv of the results, and the instrument file of the dataset.

Each number is yielded with its catalogue entry, whose path are the words of its name: the file without suffix, then the
keys and the names of list items that lead to the number. JSON schemas describe the keys of verdict.json and of the
instrument file.
"""

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

# Keys of verdict.json whose value is the name of an item of a list.
ITEM_NAME_KEYS = ("name", "effect")
# Key of verdict.json that is left out of the names of numbers.
OMITTED_WORD = "parameters"
# Keys of verdict.json of numbers whose unit is in the key `unit` of the same object.
KEYS_WITH_UNIT = ("value", "low", "high", "measured", "declared", "extended")
# Keys of standard errors, which are no numbers of their own but belong to other numbers.
STDERR_KEYS = ("stderr", "error", "stated_stderr")
# Description of a key in the schema of the instrument file, with the unit in brackets.
DESCRIPTION = re.compile(r"(?P<words>[^\[]+?)(?: \[(?P<unit>[^\]]+)\].*)?")

NamedNumbers = Iterator[tuple[CatalogEntry, StoredNumber]]
Schema = dict[str, Any]  # JSON schema of a value
Words = tuple[str, ...]  # words of the name or of the description of a number


def read_verdict(path: Path) -> NamedNumbers:
    """Yield all numbers of verdict.json; its schema gives their units, descriptions and keys of standard errors."""
    verdict = json.loads(path.read_text(encoding="utf-8"))
    return _walk(verdict, _resolve(_verdict_schema()), (path.stem,), ())


def _walk(parent: Any, schema: Schema, path: Words, words: Words) -> NamedNumbers:
    """Yield all numbers in an object or list `parent` and its children.

    `schema` is the JSON schema of `parent`, `path` are the words of the name of `parent`, and `words` describe it.
    """
    for key, child, new_words in _list_children(parent):
        child_schema = _child_schema(schema, key, isinstance(parent, list))
        child_path = (*path, *new_words)
        # In a description the name of an item replaces the name of its list.
        is_named_item = isinstance(parent, list) and new_words[0] != str(key)
        child_words = (*(words[:-1] if is_named_item else words), *new_words)
        if isinstance(child, dict | list):
            yield from _walk(child, child_schema, child_path, child_words)
        # Booleans are not numbers, and a constant of the schema is not a result.
        elif type(child) in (int, float) and key not in STDERR_KEYS and "const" not in child_schema:
            # The last word of a path alone is ambiguous: most objects have a `value` or a `z`.
            yield (
                CatalogEntry(tuple(word for word in child_path if word != OMITTED_WORD), min_words=2),
                _number_of_verdict(parent, schema, key, child_schema, child_path, child_words),
            )


def _list_children(parent: Any) -> Iterator[tuple[Any, Any, Words]]:
    """Yield (key or index, value, words that are added to the path) for each child of an object or list.

    The key `value` adds no word: the number is named like its object. An item of a list adds its name and, if it has
    one, its parameter. An item without a name adds its index.
    """
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
    """Return the number at `key` of an object or list `parent`.

    `schema` and `child_schema` are the JSON schemas of `parent` and of the number, `path` are the words of the name of
    the number, and `words` describe it.
    """
    siblings = parent if isinstance(parent, dict) else {}
    # The schema describes an object {value, stderr} as a whole.
    number_schema = schema | child_schema if key == "value" else child_schema
    stderr_key = number_schema.get("error", "stderr" if key == "value" else "")
    unit = number_schema.get("unit") or (siblings.get("unit") if stderr_key or key in KEYS_WITH_UNIT else None)
    effects = built_in()
    # A number of an effect that the schema does not describe is described by the sentence of the effect.
    sentence = next((effects[word].sentence for word in words if word in effects), "")
    name = " ".join(word.replace("_", " ") for word in words if word != OMITTED_WORD)
    return StoredNumber(
        value=parent[key],
        stderr=siblings.get(stderr_key),
        unit=str(unit or "1"),
        description=": ".join(filter(None, (name, number_schema.get("description") or sentence))),
        variable=".".join(path[1:]),
    )


def _child_schema(schema: Schema, key: Any, is_list: bool) -> Schema:
    """Return the schema of a child at a key of an object, or at an index of a list; {} if there is none."""
    if is_list:
        return _resolve(schema.get("items", {}))
    additional = schema.get("additionalProperties")
    return _resolve(schema.get("properties", {}).get(key) or (additional if isinstance(additional, dict) else {}))


def _resolve(schema: Schema) -> Schema:
    """Return a schema merged with the definition of the verdict's schema that it refers to, if it refers to one."""
    name = str(schema.get("$ref", "")).removeprefix("#/$defs/")
    return _verdict_schema()["$defs"][name] | schema if name else schema


@cache
def _verdict_schema() -> Schema:
    """Return the JSON schema of verdict.json."""
    return read_schema("verdict")


def read_paper_numbers(path: Path) -> NamedNumbers:
    """Yield the value of the results for each number of the paper, from paper_numbers.csv."""
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
    """Yield all numbers of an instrument file that have a value, including defaults.

    Standard errors are part of their numbers. Raises `InputError` when the first number is requested, if the file
    cannot be read.
    """
    instrument = read_instrument(path)
    for key, key_schema in _list_instrument_keys(read_schema("instrument")):
        section_name, _, name = key.rpartition(".")
        section = getattr(instrument, section_name) if section_name else instrument
        value = getattr(section, name)
        if key_schema["type"] not in ("number", "integer") or value is None or name.endswith("_stderr"):
            continue
        description = DESCRIPTION.fullmatch(key_schema["description"])
        assert description is not None, key
        method = "" if key in instrument.given_keys else f"the default: {path.name} does not give it"
        if key in instrument.inherited_keys:
            method = f"given by {instrument.based_on}, on which {path.name} is based"
        number = StoredNumber(
            value=float(value),
            # A standard error of 0 is the default and means unknown.
            stderr=getattr(section, f"{name}_stderr", 0.0) or None,
            unit=description["unit"] or "1",
            description=description["words"],
            variable=key,
            method=method,
        )
        # If a number of the results has the same short name, the name means that number.
        yield CatalogEntry((path.stem, *key.split(".")), is_secondary=True), number


def _list_instrument_keys(schema: Schema) -> Iterator[tuple[str, Schema]]:
    """Yield each key of the instrument file, such as "sensor.bit_depth", with its schema; `schema` is the whole one."""
    for section, section_schema in schema["properties"].items():
        keys = section_schema.get("properties")
        yield from [(f"{section}.{key}", keys[key]) for key in keys] if keys else [(section, section_schema)]
