"""The structure of the code: contracts of imports, the virtual rig apart, small files, documented functions."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import spotcheck
from spotcheck.io.provenance import walk_executed
from tests.samples.small_datasets import ROOT

WORKFLOW = ROOT / "workflow"
FILES = sorted((WORKFLOW / "spotcheck").rglob("*.py"))
RIG = sorted((WORKFLOW / "rig").rglob("*.py"))


def module_of(path: Path) -> str:
    """Dotted name of a file below workflow/."""
    parts = path.relative_to(WORKFLOW).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree_of(path: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path, when_running: bool = False) -> set[str]:
    """Dotted names that a file imports anywhere; of `from a import b` both a and a.b. With `when_running` without those
    that only a type checker reads."""
    found = set()
    for node in walk_executed(tree_of(path)) if when_running else ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path.name} line {node.lineno}: a relative import, which the digests do not follow"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_contracts_of_imports_are_kept():
    """Packages import only from those below, the sensor stands alone, nothing imports itself: see pyproject.toml."""
    checked = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_modules_do_not_import_public_names_of_the_package(path):
    """`spotcheck/__init__.py` names what all packages offer; a module that imports from it would import them all."""
    if module_of(path) == "spotcheck":
        # Names for type checkers; a module is imported when one of its names is asked for.
        assert not {name for name in imports(path, when_running=True) if name.startswith("spotcheck.")}
    else:
        assert not imports(path) & {f"spotcheck.{name}" for name in spotcheck.__all__}


@pytest.mark.parametrize("path", RIG, ids=module_of)
def test_the_rig_knows_nothing_of_the_library(path):
    """Or the workflow would find only what it put there itself."""
    assert not {i for i in imports(path) if i.split(".")[0] == "spotcheck"}


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_the_library_knows_nothing_of_the_rig(path):
    """Neither its code nor its settings nor its truth."""
    assert not {i for i in imports(path) if i.split(".")[0] == "rig"}
    text = path.read_text(encoding="utf-8")
    assert "truth.json" not in text and "rig.yaml" not in text


def test_the_library_knows_no_workflow_engine():
    """Nothing in it imports Snakemake."""
    assert not [p for p in FILES if {i for i in imports(p) if i.split(".")[0] == "snakemake"}]


def test_files_stay_small():
    """Nothing under workflow/ reaches 1,000 lines."""
    texts = [p for p in WORKFLOW.rglob("*") if p.suffix in (".py", ".smk", ".html", ".yaml", ".rst", ".md")]
    assert len(texts) > 50
    assert [p.name for p in texts if len(p.read_text(encoding="utf-8").splitlines()) >= 1000] == []


def test_modules_of_the_verdict_are_small():
    """No module of discrepancy is over 450 lines, and no function over 60."""
    modules = [path for path in FILES if module_of(path).startswith("spotcheck.discrepancy")]
    assert len(modules) > 20
    for path in modules:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 450, path.name
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno is not None and node.end_lineno - node.lineno < 60, (path.name, node.name)


def public(path: Path) -> list[ast.FunctionDef | ast.ClassDef]:
    """Functions, classes and methods whose name does not start with an underscore, at module or class level."""
    out = []
    for node in tree_of(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            out.append(node)
            if isinstance(node, ast.ClassDef):
                out += [m for m in node.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")]
    return out


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_everything_public_is_documented(path):
    """Module, functions, classes and methods."""
    assert ast.get_docstring(tree_of(path))
    assert [node.name for node in public(path) if not ast.get_docstring(node)] == []


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_no_work_at_import(path):
    """At module level: definitions, constants, nothing that reads a file or draws a number."""
    for node in tree_of(path).body:
        calls = [n for n in ast.walk(node) if isinstance(n, ast.Call)] if isinstance(node, ast.Assign) else []
        named = {getattr(c.func, "attr", getattr(c.func, "id", "")) for c in calls}
        assert not named & {"open", "read_text", "read_yaml", "default_rng", "seed", "load", "read"}
        assert not isinstance(node, ast.For | ast.While | ast.With)


def test_random_numbers_come_from_generators():
    """No call of numpy's global state anywhere in the workflow."""
    for path in (*FILES, *RIG):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random"):
                allowed = ("default_rng", "Generator", "SeedSequence", "PCG64", "SFC64")
                assert node.attr in allowed, (path.name, node.lineno)
