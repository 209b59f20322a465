"""Provenance of results: digests of code and of inputs, and the sidecar file of what changes from run to run.

The digest of a module covers every module of this package that it imports, directly or not. It is a parameter of the
workflow rules, so that an edit re-runs only the stages that it affects, and the `code_version` of result files.
"""

import ast
import hashlib
import importlib.metadata
import json
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from itertools import accumulate
from pathlib import Path

from spotcheck.io import atomic_files

# Folder of this package, and the folder from which it is imported.
PACKAGE = Path(__file__).parents[1]
ROOT = PACKAGE.parent
# Packages whose versions the sidecar file states.
VERSIONED_PACKAGES = ("numpy", "scipy", "xarray", "netCDF4", "scikit-image", "matplotlib")

# Fields of the nodes of a syntax tree that hold lists of statements, or of nodes with such a list.
STATEMENT_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")


@cache
def list_imports(path: Path, root: Path = ROOT) -> set[str]:
    """Return the dotted names of the modules below `root` that a Python file imports, also inside functions.

    Imports for type checkers only do not count.
    """
    return _list_imports_of_source(path.read_text(encoding="utf-8"), root)


def list_notebook_imports(path: Path, root: Path = ROOT) -> list[str]:
    """Return the sorted dotted names of the modules below `root` that the code cells of a notebook import."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return sorted(_list_imports_of_source(code, root))


def walk_executed(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements of a syntax tree except those below `if TYPE_CHECKING:`, which never run."""
    yield tree
    blocks: Iterable[str] = STATEMENT_BLOCKS
    if isinstance(tree, ast.If) and ast.unparse(tree.test) == "TYPE_CHECKING":
        blocks = ("orelse",)
    for block in blocks:
        for statement in getattr(tree, block, ()):
            yield from walk_executed(statement)


def _find_module_file(module: str, root: Path) -> Path | None:
    """Return the source file of a dotted module below `root`; None if there is none."""
    path = root.joinpath(*module.split("."))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in candidates if file.is_file()), None)


def _list_imports_of_source(source: str, root: Path) -> set[str]:
    """Return the dotted names of the modules below `root` that a source text imports when it runs.

    `source` is Python code. Its relative imports are not followed.
    """
    # Candidates: `from a import b` imports the module a.b, or a name of a, which has no file.
    names: set[str] = set()
    for node in walk_executed(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.update((node.module, *(f"{node.module}.{alias.name}" for alias in node.names)))
    modules = {name: file for name in names if (file := _find_module_file(name, root))}
    imports = set(modules)
    for name, file in modules.items():
        imports.update(f"{name}.{member}" for member in _list_discovered_modules(file))
    # Importing a.b.c imports a and a.b as well.
    return {prefix for name in imports for prefix in accumulate(name.split("."), "{}.{}".format)}


def _list_discovered_modules(file: Path) -> list[str]:
    """Return the names of the modules that a package imports by `iter_modules`: all modules in its folder.

    The list is empty for a file that is not the `__init__.py` of such a package.
    """
    if file.name != "__init__.py" or "iter_modules" not in file.read_text(encoding="utf-8"):
        return []
    return [member.stem for member in file.parent.glob("*.py") if member != file]


def list_sources(module: str, root: Path = ROOT) -> list[Path]:
    """Return the sorted source files of a module and of all modules below `root` that it imports, directly or not.

    Raises
    ------
    ModuleNotFoundError
        If there is no such module below `root`.
    """
    start_file = _find_module_file(module, root)
    if start_file is None:
        raise ModuleNotFoundError(f"{module}: no module below {root.name}/")
    files, unread = set[Path](), {start_file}
    while unread:
        files |= unread
        names = {name for file in unread for name in list_imports(file, root)}
        unread = {file for name in names if (file := _find_module_file(name, root))} - files
    return sorted(files)


@cache
def code_digest(*modules: str, root: Path = ROOT) -> str:
    """Return the digest (12 hexadecimal digits) of the source files of modules such as "spotcheck.cli.fit".

    It includes all modules below `root` that they import, directly or not.
    """
    digest = hashlib.sha256()
    for path in sorted({path for module in modules for path in list_sources(module, root)}):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def file_digest(path: str | Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def make_attributes(code: str, inputs: Sequence[str | Path]) -> dict[str, str]:
    """Return the attributes that state how a result was made.

    Parameters
    ----------
    code : str
        Digest of the code (`code_digest`).
    inputs : sequence of str or Path
        Files from which the result was made; those that do not exist are skipped.

    Returns
    -------
    dict
        `code_version`, and `inputs`: name and first 16 digits of the SHA-256 of each file.
    """
    digests = [f"{Path(path).name} {file_digest(path)[:16]}" for path in inputs if Path(path).is_file()]
    return {"code_version": code, "inputs": "; ".join(digests)}


def write_sidecar(path: Path, attributes: Mapping[str, str]) -> None:
    """Write `.runs/NAME.json` beside a result: when, where, by which command and with which versions it was made.

    Parameters
    ----------
    path : Path
        Path of the result. The result itself contains none of this, so that equal inputs give equal files.
    attributes : Mapping
        Further entries, for results that cannot hold attributes.
    """
    record = {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "command": sys.argv,
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in VERSIONED_PACKAGES},
        **attributes,
    }
    atomic_files.write_text(path.parent / ".runs" / f"{path.name}.json", json.dumps(record, indent=1) + "\n")
