"""Records: one JSON line a job, in a file that later calls at the same commit add to."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from spotcheck import provenance

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "blind"
Record = dict[str, Any]


# Files that make records; what they import of the library counts as well, but for the command line: what is judged
# there is held against what is judged here.
MAKERS = [ROOT / "tests" / "blind" / f"{name}.py"
          for name in ("plan", "judge_case", "crops", "by_command", "told", "advised", "limit")]  # fmt: skip


def code() -> list[str]:
    """Files that records depend on."""
    modules = {name for path in MAKERS for name in provenance.imported_modules(path)}
    modules = {name for name in modules if name.split(".")[:2] != ["spotcheck", "cli"]}
    files = {*MAKERS, *(path for name in modules for path in provenance.sources(name))}
    return sorted(str(path.relative_to(ROOT)) for path in files)


def commit() -> str:
    """Short hash of the last commit that touched what records depend on; `-dirty` where files differ from it."""
    files = code()
    last = _git("rev-list", "-1", "--abbrev-commit", "--abbrev=12", "HEAD", "--", *files).strip()
    return last + ("-dirty" if _git("status", "--porcelain", "--", *files).strip() else "")


def read(path: Path) -> list[Record]:
    """All records of a file, none if there is no file; a line cut short by a crash is left out."""
    return list(_lines(path)) if path.exists() else []


def _lines(path: Path) -> Iterator[Record]:
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


class Writer:
    """Adds records to a file, each on disk before the next."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = not path.exists() or path.read_bytes()[-1:] in (b"", b"\n")
        self._stream = path.open("a", encoding="utf-8")
        if not whole:
            self._stream.write("\n")

    def add(self, record: Record) -> None:
        """Write one record."""
        self._stream.write(json.dumps(record, allow_nan=False) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout
