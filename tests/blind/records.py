"""Records: one JSON line a job, in a file that later calls at the same commit add to. Those that the published scores
rest on are in the repository."""

import json
import lzma
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from spotcheck import provenance, store

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "blind"
# One folder, named like that of the results it was copied from.
KEPT = ROOT / "tests" / "blind" / "published"
# Null laws, in a folder of results; they take longer than a quarter of a call to make.
LAWS = "_calibration"
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


def begin(folder: Path) -> Path:
    """The file of records of a folder of results. It begins with what is published of the same commit; null laws, which
    are found by their content, with those of any."""
    path, kept = folder / "jobs.jsonl", published()
    if not path.exists() and kept is not None:
        folder.mkdir(parents=True, exist_ok=True)
        with tarfile.open(kept / "laws.tar.xz") as packed:
            packed.extractall(folder, filter="data")
        if kept.name == folder.name:
            path.write_bytes(lzma.decompress((kept / "jobs.jsonl.xz").read_bytes()))
            for other in kept.glob("*.json"):
                shutil.copyfile(other, folder / other.name)
    return path


def keep(folder: Path) -> None:
    """Put the records of a folder of results into the repository, in place of all that was there."""
    shutil.rmtree(KEPT, ignore_errors=True)
    (KEPT / folder.name).mkdir(parents=True)
    (KEPT / folder.name / "jobs.jsonl.xz").write_bytes(lzma.compress((folder / "jobs.jsonl").read_bytes()))
    for other in folder.glob("*.json"):
        shutil.copyfile(other, KEPT / folder.name / other.name)
    # Laws of earlier code are of no more use.
    code = provenance.code_digest("spotcheck.discrepancy.calibration")
    with tarfile.open(KEPT / folder.name / "laws.tar.xz", "w:xz") as packed:
        for law in sorted((folder / LAWS).glob("*/null.nc")):
            with store.read(law) as ds:
                useful = ds.attrs["code_version"] == code
            if useful:
                packed.add(law, law.relative_to(folder))


def published() -> Path | None:
    """The folder that published scores rest on; None before any."""
    return next(KEPT.iterdir(), None) if KEPT.exists() else None


def base_of(rows: list[Record]) -> int:
    """The seed that a plan began with."""
    return min(int(row["job"]["seed"] - row["job"]["number"]) for row in rows)


def read(path: Path) -> list[Record]:
    """All records of a file, packed or not, none if there is no file; a line cut short by a crash is left out."""
    return list(_lines(path)) if path.exists() else []


def _lines(path: Path) -> Iterator[Record]:
    with lzma.open(path, "rb") if path.suffix == ".xz" else path.open("rb") as stream:
        text = stream.read().decode()
    for line in text.splitlines():
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
