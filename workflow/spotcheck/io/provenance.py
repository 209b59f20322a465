"""Where a result comes from: digests of code and inputs, and the sidecar for what changes from run to run.

The digest of a module covers every module of this package that it imports, directly or not. It is a rule parameter, so
that an edit re-runs just the stages that it touches, and the code version in the files' attributes.
"""

import ast
import hashlib
import importlib.metadata
import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from spotcheck.io import writing

PACKAGE = Path(__file__).parents[1]
ROOT = PACKAGE.parent


def module_file(module: str, root: Path = ROOT) -> Path | None:
    """Source of a dotted module below `root`, None when it is not ours."""
    path = root.joinpath(*module.split("."))
    if path.with_suffix(".py").is_file():
        return path.with_suffix(".py")
    return path / "__init__.py" if (path / "__init__.py").is_file() else None


@cache
def imported_modules(path: Path, root: Path = ROOT) -> set[str]:
    """Dotted names of our own modules that the file at `path` imports anywhere, also inside functions, when it runs."""
    return _imports(path.read_text(encoding="utf-8"), root)


def notebook_modules(path: Path, root: Path = ROOT) -> list[str]:
    """Dotted names of our own modules that a notebook imports."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return sorted(_imports(code, root))


def _discovered(path: Path | None) -> list[Path]:
    """Files that a package imports because they lie in its folder, as the vocabulary of effects does."""
    if path is None or path.name != "__init__.py" or "iter_modules" not in path.read_text(encoding="utf-8"):
        return []
    return sorted(own for own in path.parent.glob("*.py") if own != path)


def running(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a syntax tree but those below `if TYPE_CHECKING:`, which never runs."""
    yield tree
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for own in node.orelse:
                yield from running(own)
        else:
            yield from running(node)


def _imports(source: str, root: Path) -> set[str]:
    found: set[str] = set()
    for node in running(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        found.update(name for name in names if module_file(name, root))
    found |= {f"{name}.{own.stem}" for name in found for own in _discovered(module_file(name, root))}
    # Importing a.b.c runs a/__init__.py and a/b/__init__.py as well.
    return found | {name.rsplit(".", k)[0] for name in found for k in range(1, name.count(".") + 1)}


def sources(module: str, root: Path = ROOT) -> list[Path]:
    """Files that a module is made of: itself and all that it imports of ours, sorted."""
    start = module_file(module, root)
    if start is None:
        raise ModuleNotFoundError(f"{module}: no module below {root.name}/")
    seen, todo = {start}, [start]
    while todo:
        for name in imported_modules(todo.pop(), root):
            file = module_file(name, root)
            if file and file not in seen:
                seen.add(file)
                todo.append(file)
    return sorted(seen)


@cache
def code_digest(*modules: str, root: Path = ROOT) -> str:
    """Digest (12 hex digits) of the sources of one or more modules, e.g. "spotcheck.cli.fit"."""
    digest = hashlib.sha256()
    for path in sorted({path for module in modules for path in sources(module, root)}):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def file_digest(path: str | Path) -> str:
    """SHA-256 of a file, in hex."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def attributes(code: str, inputs: Sequence[str | Path]) -> dict[str, str]:
    """What a result says of its making: the digest of the code, and names and digests of the files it was made from."""
    digests = [f"{Path(p).name} {file_digest(p)[:16]}" for p in inputs if Path(p).is_file()]
    return {"code_version": code, "inputs": "; ".join(digests)}


def write_sidecar(path: Path, more: Mapping[str, str]) -> None:
    """Beside `path`: when, where and with which versions it was made; kept out of the file so that it stays equal.

    `more` is what the file itself has no place for.
    """
    packages = ("numpy", "scipy", "xarray", "netCDF4", "scikit-image", "matplotlib")
    record = {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "command": sys.argv,
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in packages},
        **more,
    }
    writing.text(path.parent / ".runs" / f"{path.name}.json", json.dumps(record, indent=1) + "\n")
