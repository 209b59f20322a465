"""Pages equations.html and symbols.html: the functions and tests of each equation of the paper, and its symbols.

The docstring of a function or test cites an equation by its number: "Eq. 12", "Eqs. 9–14", "Eqs. 16, 24 and 29".
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
            # One number, both ends of a range, or nothing between a comma and "and".
            ends = [int(digits) for digits in re.findall(r"\d+", number_or_range)]
            numbers.update(range(ends[0], ends[-1] + 1) if ends else ())
    return numbers


def collect_citations(root: Path, prefix: str = "", only_functions: str = "") -> dict[int, list[Citation]]:
    """Return the functions and classes that cite each equation in their docstrings.

    Parameters
    ----------
    root : Path
        Folder of Python files, which is read with its subfolders.
    prefix : str
        Dotted name of the folder, with which names of modules start; "" for none.
    only_functions : str
        Text with which names of functions and classes must start; "" for all.

    Returns
    -------
    dict of int to list of Citation
        Citations by the number of the equation. Equations that nothing cites are missing.
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
    """Return all names of variables, functions and attributes that the code of a folder and its subfolders reads.

    If the name of a function is not among them, only tests or users call it.
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
        YAML file with a list of the symbols of the paper.
    tests : Path
        Folder of the tests.
    folder : Path
        Folder to which the pages are written.

    Raises
    ------
    InputError
        If no function or no test cites an equation.
    """
    functions = collect_citations(PACKAGE, PACKAGE.name)
    test_functions = collect_citations(tests, tests.name, "test_")
    for kind, citations in (("function", functions), ("test", test_functions)):
        if missing := [number for number in EQUATIONS if number not in citations]:
            fault = f"docstrings: no {kind} cites Eq. {', '.join(map(str, missing))}"
            raise InputError(f"{fault}; every equation needs a {kind} whose docstring cites it")
    rows = [(number, functions[number], test_functions[number]) for number in EQUATIONS]
    # Functions of the package `paper` are called by their names in data/published.yaml, which no code reads.
    all_citations = (citation for citations in functions.values() for citation in citations)
    paper_names = {citation.name for citation in all_citations if ".paper." in citation.where}
    # The page marks functions that only tests or users call.
    used_names = find_used_names(PACKAGE) | paper_names | set(spotcheck.__all__)
    content = {"rows": rows, "used_names": used_names}
    write_page(folder / "equations.html", "equations.html", title="Equation → function → test", **content)
    title = "Symbol → name in code → unit → equation"
    write_page(folder / "symbols.html", "symbols.html", title=title, rows=read_yaml(symbols))
