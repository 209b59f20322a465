"""Tables from docstrings: the functions that implement each of the paper's equations, and the tests that check them.

A docstring cites an equation by its number: "Eq. 12", "Eqs. 9–14", "Eqs. 16, 24 and 29". Tests cite equations in the
same way.
"""

import ast
import re
from pathlib import Path
from typing import NamedTuple

import spotcheck
from spotcheck.errors import InputError
from spotcheck.io.provenance import PACKAGE
from spotcheck.io.schema import read_yaml
from spotcheck.report.pages import write_page

# Numbers of the equations of the paper.
EQUATIONS = range(1, 41)
# A citation with one or more numbers or ranges: "Eqs. 9–14, 16 and 24".
CITATION = re.compile(r"Eqs?\.\s*(\d+(?:\s*(?:[–-]|,\s*(?:and)?|and|to)\s*\d+)*)")


class Citation(NamedTuple):
    """A function or class that cites an equation."""

    where: str  # dotted name of the function or class
    sentence: str  # first paragraph of its docstring, in one line

    @property
    def name(self) -> str:
        """The name of the function or class without its module."""
        return self.where.rpartition(".")[2]


def find_equations(text: str) -> set[int]:
    """Return the numbers of the equations that a text cites; a range such as "9–14" includes all its numbers."""
    numbers: set[int] = set()
    for citation in CITATION.findall(text):
        for number_or_range in re.split(r",|and", citation):
            ends = [int(digits) for digits in re.findall(r"\d+", number_or_range)]
            numbers.update(range(ends[0], ends[-1] + 1) if ends else ())
    return numbers


def collect_citations(root: Path, prefix: str = "", only_functions: str = "") -> dict[int, list[Citation]]:
    """Return the functions and classes whose docstrings cite an equation, by its number.

    Parameters
    ----------
    root : Path
        Folder of Python files, which are read recursively.
    prefix : str
        Dotted name of the folder; "" for none.
    only_functions : str
        Prefix of the names of the functions and classes that are read; "" for all.
    """
    citations: dict[int, list[Citation]] = {}
    for path in sorted(root.rglob("*.py")):
        module = ".".join(filter(None, (prefix, *path.relative_to(root).with_suffix("").parts)))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name.startswith(only_functions):
                docstring = ast.get_docstring(node) or ""
                sentence = " ".join(docstring.split("\n\n")[0].split())
                for number in find_equations(docstring):
                    citations.setdefault(number, []).append(Citation(f"{module}.{node.name}", sentence))
    return citations


def find_used_names(root: Path) -> set[str]:
    """Return all names and attributes that the code of Python files in a folder reads.

    A function whose name is not among them is called by tests or users alone.
    """
    return {
        node.id if isinstance(node, ast.Name) else node.attr
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Load)
    }


def write_equation_pages(symbols: Path, tests: Path, folder: Path) -> None:
    """Write equations.html, with the functions and tests of each equation, and symbols.html.

    Parameters
    ----------
    symbols : Path
        YAML file of the paper's symbols.
    tests : Path
        Folder of the tests.
    folder : Path
        Folder of the pages.

    Raises
    ------
    InputError
        If no function or no test cites an equation.
    """
    functions = collect_citations(PACKAGE, PACKAGE.name)
    test_functions = collect_citations(tests, tests.name, "test_")
    for kind, citations in (("function", functions), ("test", test_functions)):
        missing = [number for number in EQUATIONS if number not in citations]
        if missing:
            raise InputError(
                f"docstrings: no {kind} cites Eq. {', '.join(map(str, missing))}; every equation needs a {kind} whose"
                " docstring cites it"
            )
    rows = [(number, functions[number], test_functions[number]) for number in EQUATIONS]
    # Functions of the package `paper` are called by the ids of data/published.yaml.
    of_paper = {citation.name for cited in functions.values() for citation in cited if ".paper." in citation.where}
    content = {"rows": rows, "used_names": find_used_names(PACKAGE) | of_paper | set(spotcheck.__all__)}
    write_page(folder / "equations.html", "equations.html", title="Equation → function → test", **content)
    title = "Symbol → name in code → unit → equation"
    write_page(folder / "symbols.html", "symbols.html", title=title, rows=read_yaml(symbols))
