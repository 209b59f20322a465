"""Records: one JSON line a job, in a file that later calls at the same commit add to."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

from spotcheck.io import provenance
from tests.validation.protocol import Record

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "validation"


def code(name: str) -> list[str]:
    """Files that a generator's records depend on: what makes sets, the judge, and what the command line imports; not
    what only reads records."""
    here = Path(__file__).parent / "generators"
    folders = ("light", "second") if name == "light" else (name,)
    made = [path for folder in folders for path in sorted((here / folder).rglob("*.py"))]
    # These only read records.
    reading = ("score.py", "page.py", "reading.py")
    makers = [Path(__file__).with_name("judge.py"), *(path for path in made if path.name not in reading)]
    stages = ("ingest", "crop", "sensor", "judge", "flats")
    modules = {module for path in makers for module in provenance.list_imports(path)}
    modules |= {f"spotcheck.cli.{stage}" for stage in stages}
    files = {*makers, *(path for module in modules for path in provenance.list_sources(module))}
    return sorted(str(path.relative_to(ROOT)) for path in files)


def commit(name: str) -> str:
    """Short hash of the last commit that touched what a generator's records depend on; `-dirty` where files differ from
    it."""
    files = code(name)
    last = _git("rev-list", "-1", "--abbrev-commit", "--abbrev=12", "HEAD", "--", *files).strip()
    return last + ("-dirty" if _git("status", "--porcelain", "--", *files).strip() else "")


def draw_first_seed(first: int, commit: str) -> int:
    """The first seed of a score at a commit: nobody who tunes knows it."""
    return first + int(commit[:6], 16)


def read(path: Path) -> list[Record]:
    """All records of a file, none if there is no file; a line cut short by a crash is left out."""
    return list(_lines(path.read_text(encoding="utf-8"))) if path.exists() else []


def _lines(text: str) -> Iterator[Record]:
    for line in text.splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def add(path: Path, record: Record) -> None:
    """Add a record to a file, behind what a crash may have cut short."""
    path.parent.mkdir(parents=True, exist_ok=True)
    start = "" if not path.exists() or path.read_bytes()[-1:] in (b"", b"\n") else "\n"
    line = json.dumps(record, allow_nan=False)
    with path.open("a", encoding="utf-8") as stream:
        stream.write(f"{start}{line}\n")


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout
