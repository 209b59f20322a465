"""Numbers of text files: verdict.json and paper_numbers.csv of the results, and the data sheet that they were given."""

import ast
import csv
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from spotcheck.dataset.instrument import read_instrument
from spotcheck.io.provenance import PACKAGE
from spotcheck.io.schema import read_schema
from spotcheck.model.effects import built_in
from spotcheck.report.origin.number import Entry
from spotcheck.report.origin.tables import Cell

# Keys by which the entries of a list are told apart.
NAMES = ("name", "effect")
# A word of a path that says nothing to a person.
SILENT = ("parameters",)
# Keys whose numbers have the unit that stands beside them.
MEASURED = ("value", "low", "high", "measured", "declared", "extended")
# Keys whose numbers are the errors of others.
ERRORS = ("stderr", "error", "stated_stderr")
# A description of a key of the data sheet: words, and the unit in brackets.
DESCRIBED = re.compile(r"(?P<words>[^\[]+?)(?: \[(?P<unit>[^\]]+)\].*)?")

Words = tuple[str, ...]
Schema = dict[str, Any]


def of_verdict(path: Path) -> Iterator[tuple[Entry, Cell]]:
    """All numbers of a verdict, with what its schema says of them."""
    verdict = json.loads(path.read_text(encoding="utf-8"))
    for place, said, cell in _numbers(verdict, _resolved(schema()), (), ()):
        # A word of a verdict alone does not say whose it is.
        yield Entry((path.stem, *(word for word in place if word not in SILENT)), least=2), _in_words(cell, said)


def _numbers(value: Any, told: Schema, place: Words, said: Words) -> Iterator[tuple[Words, Words, Cell]]:
    """Path, words of it that a person needs, and number, for all below an object or list of the verdict; `told` is its
    schema."""
    for key, own, names in _inside(value):
        below = _child(told, key, isinstance(value, list))
        here = (*place, *names)
        spoken = (*(said[:-1] if isinstance(value, list) and names[0] != str(key) else said), *names)
        if isinstance(own, dict | list):
            yield from _numbers(own, below, here, spoken)
        elif isinstance(own, int | float) and not isinstance(own, bool) and "const" not in below:
            if key not in ERRORS:
                yield here, spoken, _cell(value, key, told, below, ".".join((*place, *names)))


def _inside(value: Any) -> Iterator[tuple[Any, Any, Words]]:
    """Key, value and the words that it adds to a path, of the items of an object or list."""
    if isinstance(value, list):
        for k, own in enumerate(value):
            known = [str(own[name]) for name in NAMES if isinstance(own, dict) and name in own]
            yield (
                k,
                own,
                tuple(known[:1] or [str(k)])
                + tuple([str(own["parameter"])] if isinstance(own, dict) and "parameter" in own else []),
            )
    else:
        for key, own in value.items():
            yield key, own, () if key == "value" else (str(key),)


def _cell(around: Any, key: Any, outer: Schema, own: Schema, variable: str) -> Cell:
    """A number of the verdict; its unit and error stand in its schema or beside it."""
    beside = around if isinstance(around, dict) else {}
    # Of an object {value, stderr} the schema speaks as a whole.
    told = outer | own if key == "value" else own
    error = told.get("error", "stderr" if key == "value" else "")
    unit = told.get("unit") or (beside.get("unit") if error or key in MEASURED else None)
    return Cell(around[key], beside.get(error), str(unit or "1"), str(told.get("description", "")), variable, "", {})


def _in_words(cell: Cell, said: Words) -> Cell:
    known = built_in()
    sentence = next((known[word].sentence for word in said if word in known), "")
    name = " ".join(word.replace("_", " ") for word in said if word not in SILENT)
    return cell._replace(words=": ".join(filter(None, (name, cell.words or sentence))))


def _child(told: Schema, key: Any, is_list: bool) -> Schema:
    """Schema of an item."""
    if is_list:
        return _resolved(told.get("items", {}))
    more = told.get("additionalProperties")
    return _resolved(told.get("properties", {}).get(key) or (more if isinstance(more, dict) else {}))


def _resolved(told: Schema) -> Schema:
    """A schema with what it refers to."""
    name = str(told.get("$ref", "")).removeprefix("#/$defs/")
    return schema()["$defs"][name] | told if name else told


def of_paper(path: Path) -> Iterator[tuple[Entry, Cell]]:
    """Ours of all numbers of the paper."""
    with path.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            words = f"{row['id'].replace('_', ' ')}; the paper prints {row['printed']} (section {row['section']})"
            how = docstrings().get(row["id"], "")
            own = Cell(float(row["ours"]), None, row["unit"], words, f"ours[id={row['id']}]", how, {})
            # A short name is ours before it is the paper's.
            yield Entry((path.stem, row["id"]), behind=True), own


def of_sheet(path: Path) -> Iterator[tuple[Entry, Cell]]:
    """All numbers of a data sheet, given or by default. Raises `InputError` where it cannot be read."""
    sheet = read_instrument(path)
    for key, told in _keys(read_schema("instrument")):
        section, _, name = key.rpartition(".")
        around = getattr(sheet, section) if section else sheet
        value = getattr(around, name)
        if told["type"] not in ("number", "integer") or value is None or name.endswith("_stderr"):
            continue
        said = DESCRIBED.fullmatch(told["description"])
        assert said is not None, key
        how = "" if key in sheet.given_keys else f"the default: {path.name} does not give it"
        if key in sheet.inherited_keys:
            how = f"given by {sheet.based_on}, on which {path.name} is based"
        stderr = getattr(around, f"{name}_stderr", 0.0) or None
        own = Cell(float(value), stderr, said["unit"] or "1", said["words"], key, how, {})
        # A short name is that of a result before it is the sheet's.
        yield Entry((path.stem, *key.split(".")), behind=True), own


def _keys(told: Schema) -> Iterator[tuple[str, Schema]]:
    """Keys of the data sheet such as "sensor.bit_depth" and what the schema says of each."""
    for name, own in told["properties"].items():
        inside = own.get("properties", {})
        yield from ((f"{name}.{key}", below) for key, below in inside.items()) if inside else ((name, own),)


@cache
def docstrings() -> dict[str, str]:
    """First sentences of the functions that compute the paper's numbers, by name."""
    found = {}
    for path in (PACKAGE / "paper").glob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and (text := ast.get_docstring(node)):
                found[node.name] = " ".join(text.split("\n\n")[0].split())
    return found


@cache
def schema() -> Schema:
    """The contract of verdict.json, which says what each number is."""
    return read_schema("verdict")
