"""Numbers of text results: verdict.json and paper_numbers.csv."""

import ast
import csv
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from spotcheck.origin.number import Entry
from spotcheck.origin.tables import Cell
from spotcheck.provenance import PACKAGE
from spotcheck.schema import read_schema

# Keys by which the entries of a list are told apart.
NAMES = ("name", "effect")
# A word of a path that says nothing to a person.
SILENT = ("parameters",)


def of_verdict(path: Path) -> Iterator[tuple[Entry, Cell]]:
    """All numbers of a verdict."""
    verdict = json.loads(path.read_text(encoding="utf-8"))
    for place, own in _numbers(verdict, (), {}):
        yield Entry((path.stem, *(word for word in place if word not in SILENT)), least=2), own


def _numbers(value: Any, place: tuple[str, ...], around: dict[str, Any]) -> Iterator[tuple[tuple[str, ...], Cell]]:
    """Paths and numbers below a value of the verdict; `around` is the object that it stands in."""
    if isinstance(value, dict):
        if {"value", "unit"} <= value.keys():
            yield from _number(value["value"], (*place, value.get("parameter", "")), value)
            return
        for key, own in value.items():
            yield from _numbers(own, (*place, key), value)
    elif isinstance(value, list):
        for k, own in enumerate(value):
            name = next((str(own[key]) for key in NAMES if isinstance(own, dict) and key in own), str(k))
            yield from _numbers(own, (*place, name), around)
    elif place[-1] not in ("stderr", "error"):
        yield from _number(value, place, around)


def _number(value: Any, place: tuple[str, ...], around: dict[str, Any]) -> Iterator[tuple[tuple[str, ...], Cell]]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    place = tuple(filter(None, place))
    stderr = around.get("stderr", around.get("error"))
    if place[-1] == "before":
        stderr = None
    words = " ".join(word.replace("_", " ") for word in place)
    yield place, Cell(value, stderr, str(around.get("unit", "1")), words, ".".join(place), "", {})


def of_paper(path: Path) -> Iterator[tuple[Entry, Cell]]:
    """Ours of all numbers of the paper."""
    with path.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            words = f"{row['id'].replace('_', ' ')}; the paper prints {row['printed']} (section {row['section']})"
            how = docstrings().get(row["id"], "")
            own = Cell(float(row["ours"]), None, row["unit"], words, f"ours[id={row['id']}]", how, {})
            # A short name is ours before it is the paper's.
            yield Entry((path.stem, row["id"]), behind=True), own


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
def schema() -> dict[str, Any]:
    """The contract of verdict.json, which says what each number is."""
    return read_schema("verdict")
