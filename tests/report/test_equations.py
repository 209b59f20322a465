"""Which function and which test cites which equation."""

import ast

import pytest

from spotcheck.errors import InputError
from spotcheck.report.pages import equations
from tests.samples.small_datasets import ROOT

# Written in parts, so that these examples claim nothing themselves when a docstring is what names an equation.
TEXTS = {
    "one, Eq" + ". 12": {12},
    "Eqs" + ". 9–11": {9, 10, 11},
    "Eqs" + ". 5-7 with a hyphen": {5, 6, 7},
    "Eqs" + ". 9 to 11": {9, 10, 11},
    "Eqs" + ". 16, 24 and 29": {16, 24, 29},
    "Eqs" + ". 1, 3–6 and 10 of the paper": {1, 3, 4, 5, 6, 10},
    "across\nlines, Eq" + ".\n    7": {7},
    "twice: Eq" + ". 2, then Eqs" + ". 30–31": {2, 30, 31},
    "no equation, see Section 3.1 and Table 3": set(),
    "EQ 5 and eq. 6 in other spellings": set(),
    "the serial comma, Eqs" + ". 1, 3, and 5": {1, 3, 5},
}


@pytest.mark.parametrize(("text", "numbers"), TEXTS.items(), ids=[str(sorted(n)) for n in TEXTS.values()])
def test_numbers_that_a_text_names(text, numbers):
    """Single numbers, ranges and lists, across a line's end."""
    assert equations.find_equations(text) == numbers


def test_claims_read_docstrings_of_functions_methods_and_classes(tmp_path):
    """Names with their module, first sentence only; comments, code and other functions do not claim."""
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "a.py").write_text(
        '"""Module: Eq. 1."""\n'
        'def f():\n    """First line\n    (Eq. 2).\n\n    Later: Eq. 3.\n    """\n    return "Eq. 4"  # Eq. 5\n'
        'class C:\n    """Eq. 6."""\n    def test_m(self):\n        """Eq. 7."""\n'
    )
    found = equations.collect_citations(tmp_path, "pkg")
    assert {n: [c.where for c in own] for n, own in found.items()} == {
        2: ["pkg.room.a.f"],
        3: ["pkg.room.a.f"],
        6: ["pkg.room.a.C"],
        7: ["pkg.room.a.test_m"],
    }
    assert found[2][0].sentence == "First line (Eq. 2)."
    assert set(equations.collect_citations(tmp_path, only_functions="test_")) == {7}


def test_tests_that_cite_an_equation_assert_something():
    """That each has a function and a test, the page itself checks."""
    held = equations.collect_citations(ROOT / "tests", "tests", "test_")
    sources = {p: ast.parse(p.read_text()) for p in (ROOT / "tests").rglob("test_*.py")}
    asserting = {
        node.name
        for tree in sources.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(n, ast.Assert) or "assert" in getattr(n, "attr", "") for n in ast.walk(node))
    }
    citing = {citation.where.rsplit(".", 1)[1] for citations in held.values() for citation in citations}
    assert citing <= asserting


def test_a_gap_is_refused(tmp_path):
    """Without tests the pages are not written, and the sentence names what is missing."""
    with pytest.raises(InputError, match=r"no test cites Eq\. 1, 2, .*40; every equation needs a test"):
        equations.write_equation_pages(ROOT / "data" / "symbols.yaml", tmp_path, tmp_path / "docs")
    assert not (tmp_path / "docs").exists()


def test_pages_name_every_equation(tmp_path):
    """Both pages, from the repository's own docstrings."""
    equations.write_equation_pages(ROOT / "data" / "symbols.yaml", ROOT / "tests", tmp_path)
    page = (tmp_path / "equations.html").read_text()
    for where in ("optics.speckle_grain", "test_top_hat_cuts_at_a_quarter"):
        assert where in page
    assert (tmp_path / "symbols.html").stat().st_size > 1000


def test_names_that_code_reads(tmp_path):
    """Calls, attributes and passed functions; not definitions, assignments or texts."""
    (tmp_path / "a.py").write_text("def f():\n    g(h.k)\n    x = 'text'\n    return m\n")
    assert equations.find_used_names(tmp_path) == {"g", "h", "k", "m"}
