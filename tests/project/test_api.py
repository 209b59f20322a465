"""The public names: all there, imported when asked for, and doing what their page and their examples show."""

import ast
import doctest
import importlib
import importlib.metadata
import re
import subprocess
import sys
from io import StringIO
from pathlib import Path

import pytest

import spotcheck
from tests.project.test_docs import run_blocks
from tests.samples.small_datasets import ROOT

PAGE = ROOT / "workflow" / "docs" / "api.md"
FUNCTIONS = [name for name in spotcheck.__all__ if name != "__version__"]


def test_all_names_are_there_and_no_others():
    """In `__all__`, for type checkers, for the interpreter, and in the page's table."""
    assert spotcheck.__all__ == sorted(spotcheck.__all__) and set(spotcheck.__all__) <= set(dir(spotcheck))
    tree = ast.parse(Path(spotcheck.__file__).read_text(encoding="utf-8"))
    (branch,) = (node for node in tree.body if isinstance(node, ast.If))
    typed = {own.asname or own.name for node in branch.body if isinstance(node, ast.ImportFrom) for own in node.names}
    assert typed == set(FUNCTIONS)
    table = re.findall(r"^\| (`.*?) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(name for cell in table for name in re.findall(r"`(\w+)`", cell)) == spotcheck.__all__


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_name_is_what_type_checkers_take_it_for(name):
    """The object of the module that `if TYPE_CHECKING:` names."""
    tree = ast.parse(Path(spotcheck.__file__).read_text(encoding="utf-8"))
    ((module, own),) = {
        (node.module, own.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for own in node.names
        if (own.asname or own.name) == name
    }
    assert getattr(spotcheck, name) is getattr(importlib.import_module(module), own)


def test_importing_costs_nothing():
    """No numpy, numba or xarray before a name is asked for, nor for the names that need none."""
    code = "import sys, spotcheck; spotcheck.InputError; dir(spotcheck); print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "spotcheck.errors" in run.stdout.split()
    assert not {"numpy", "numba", "xarray", "scipy"} & set(run.stdout.split())


def test_other_names():
    """A module can be imported, the version is that of the package, and a wrong name is an AttributeError."""
    from spotcheck.model import optics

    assert optics.__name__ == "spotcheck.model.optics"
    assert spotcheck.__version__ == importlib.metadata.version("laser-spotcheck")
    with pytest.raises(AttributeError, match=r"module 'spotcheck' has no attribute 'fit_spot'"):
        _ = spotcheck.fit_spot  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_examples_of_docstrings(name, there):
    """Every public object has one, and its output is what stands there."""
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(spotcheck, name), name)
    assert test.examples
    said = StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    assert runner.run(test, out=said.write).failed == 0, said.getvalue()


def test_the_page_runs(there):
    """Every block of code prints what the page says."""
    run_blocks(PAGE)
    assert PAGE.read_text(encoding="utf-8").count("\n") < 170
