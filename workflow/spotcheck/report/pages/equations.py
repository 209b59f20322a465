"""Tables from the docstrings: which function implements each of the paper's equations, and which test holds it.

A docstring claims an equation by naming it: "Eq. 12", "Eqs. 9–14", "Eqs. 16, 24 and 29". Tests claim it in the same
way.
"""

import ast
import re
from pathlib import Path
from typing import NamedTuple

from spotcheck.errors import InputError
from spotcheck.io.provenance import PACKAGE
from spotcheck.io.schema import read_yaml
from spotcheck.report.pages import write_page

EQUATIONS = range(1, 41)
_CLAIM = re.compile(r"Eqs?\.\s*(\d+(?:\s*(?:[–-]|,\s*(?:and)?|and|to)\s*\d+)*)")


class Claim(NamedTuple):
    """A function and the first sentence of its docstring."""

    where: str
    sentence: str


def equations_in(text: str) -> set[int]:
    """Numbers of the equations that a text names; "9–14" stands for all of them."""
    found: set[int] = set()
    for claim in _CLAIM.findall(text):
        for part in re.split(r",|and", claim):
            ends = [int(n) for n in re.findall(r"\d+", part)]
            found.update(range(ends[0], ends[-1] + 1) if ends else ())
    return found


def claims(root: Path, prefix: str = "", only_functions: str = "") -> dict[int, list[Claim]]:
    """Equations named in docstrings of the functions and classes below `root`, whose names start with
    `only_functions`."""
    out: dict[int, list[Claim]] = {}
    for path in sorted(root.rglob("*.py")):
        module = ".".join(filter(None, (prefix, *path.relative_to(root).with_suffix("").parts)))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name.startswith(only_functions):
                text = ast.get_docstring(node) or ""
                for number in equations_in(text):
                    sentence = " ".join(text.split("\n\n")[0].split())
                    out.setdefault(number, []).append(Claim(f"{module}.{node.name}", sentence))
    return out


def write(symbols: Path, tests: Path, folder: Path) -> None:
    """Write equations.html and symbols.html. Raises `InputError` when an equation has no function or no test."""
    code = claims(PACKAGE, PACKAGE.name)
    held = claims(tests, tests.name, "test_")
    for what, found in (("function", code), ("test", held)):
        missing = [n for n in EQUATIONS if n not in found]
        if missing:
            raise InputError(
                f"docstrings: no {what} names Eq. {', '.join(map(str, missing))}; every equation needs one"
            )
    rows = [(n, code[n], held[n]) for n in EQUATIONS]
    write_page(folder / "equations.html", "equations.html", title="Equation → function → test", rows=rows)
    entries = read_yaml(symbols)
    write_page(folder / "symbols.html", "symbols.html", title="Symbol → name in code → unit → equation", rows=entries)
