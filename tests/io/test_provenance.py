"""Digests of code: what an edit of one module touches, and what not."""

import json
from pathlib import Path

import pytest

from spotcheck.io import provenance

FILES = {
    "pkg/__init__.py": "",
    "pkg/leaf.py": "X = 1\n",
    "pkg/middle.py": "from pkg import leaf\n",
    "pkg/lazy.py": "def f():\n    import pkg.middle\n    return pkg.middle\n",
    "pkg/names.py": "import numpy\nfrom pkg.leaf import X\n",
    "pkg/alone.py": "import json\n",
    "pkg/ring.py": "from pkg import gnir\n",
    "pkg/gnir.py": "from pkg import ring\n",
    "pkg/room/__init__.py": "from pkg import alone\n",
    "pkg/room/inside.py": "Y = 2\n",
    "pkg/user.py": "from pkg.room import inside\n",
    "pkg/typed.py": "if TYPE_CHECKING:\n    import pkg.leaf\nelse:\n    import pkg.alone\n",
}


def tree(base: Path, **changes: str) -> Path:
    """The small package below a folder of its own, with some files changed (results are cached by folder)."""
    for name, text in FILES.items():
        path = base / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(changes.get(path.stem, text))
    return base


MODULES = ["leaf", "middle", "lazy", "names", "alone", "ring", "gnir", "user", "typed"]
EDITS = {
    "leaf": {"leaf", "middle", "lazy", "names"},
    "middle": {"middle", "lazy"},
    "alone": {"alone", "user", "typed"},
    "inside": {"user"},
    "ring": {"ring", "gnir"},
    "lazy": {"lazy"},
}


@pytest.mark.parametrize(("edited", "touched"), EDITS.items(), ids=EDITS)
def test_an_edit_changes_just_what_imports_it(tmp_path, edited, touched):
    """Directly, through others, inside functions, in a ring; not what types alone need, which never runs.

    Equal sources in two folders have equal digests, so that results travel.
    """
    text = next(t for name, t in FILES.items() if Path(name).stem == edited)
    before, after = tree(tmp_path / "a"), tree(tmp_path / "b", **{edited: text + "# edited\n"})
    changed = {
        m
        for m in MODULES
        if provenance.code_digest(f"pkg.{m}", root=before) != provenance.code_digest(f"pkg.{m}", root=after)
    }
    assert changed == touched


def test_a_renamed_module_changes_the_digest(tmp_path):
    """The digest covers paths as well as contents, and the order of modules does not matter."""
    base = tree(tmp_path)
    (base / "pkg" / "leaf2.py").write_text(FILES["pkg/leaf.py"])
    digest = provenance.code_digest
    assert digest("pkg.leaf", root=base) != digest("pkg.leaf2", root=base)
    assert digest("pkg.leaf", "pkg.alone", root=base) == digest("pkg.alone", "pkg.leaf", root=base)


def test_the_packages_above_a_module_count(tmp_path):
    """Python runs pkg/room/__init__.py before pkg/room/inside.py, whatever the import looks like."""
    base = tree(tmp_path)
    (base / "pkg" / "plain.py").write_text("import pkg.room.inside\n")
    assert base / "pkg" / "room" / "__init__.py" in provenance.list_sources("pkg.plain", base)


def test_an_unknown_module(tmp_path):
    """Named, with the folder it was looked for in."""
    with pytest.raises(ModuleNotFoundError, match=r"pkg\.none: no module below"):
        provenance.list_sources("pkg.none", tree(tmp_path))


def test_what_a_notebook_imports(tmp_path):
    """Modules of ours in code cells; markdown and other packages do not count."""
    cells = [
        {"cell_type": "markdown", "source": ["import pkg.alone"]},
        {"cell_type": "code", "source": ["import numpy\n", "from pkg import leaf\n"]},
        {"cell_type": "code", "source": "import pkg.middle"},
    ]
    path = tree(tmp_path) / "n.ipynb"
    path.write_text(json.dumps({"cells": cells}))
    assert provenance.list_notebook_imports(path, tmp_path) == ["pkg", "pkg.leaf", "pkg.middle"]


@pytest.mark.parametrize("stage", ["fit", "crop", "simulate"])
def test_real_stages_cover_what_they_compute_with(stage):
    """The sensor belongs to fit and simulate, the forward model to simulate, the parser to none."""
    names = {p.relative_to(provenance.ROOT).as_posix() for p in provenance.list_sources(f"spotcheck.cli.{stage}")}
    assert {"spotcheck/io/store.py", "spotcheck/dataset/folder.py"} <= names
    assert ("spotcheck/sensor/distribution.py" in names) == (stage != "crop")
    assert ("spotcheck/model/forward.py" in names) == (stage == "simulate")
    assert "spotcheck/cli/fit.py" not in names or stage == "fit"
