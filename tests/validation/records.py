"""Records: one JSON line a job, in a file that later calls at the same commit add to; and the file of records that the
published scores follow from."""

import json
import lzma
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from spotcheck import provenance
from tests.validation.protocol import Record

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "validation"
# Replaced at a release: its first line says where the records are from, each other is one of them.
PUBLISHED = Path(__file__).parent / "published.jsonl.xz"
# What the scores are made of, by key, and to how many digits; of objects in a list the same keys are kept in each.
# Scores have three digits; a strength may be known to a part in 100,000.
FEW, MANY = 4, 8
READ: dict[str, Any] = {
    "job": {"seed": FEW, "kind": FEW, "design": FEW, "budget": FEW},
    "truth": {
        "effects": {"name": FEW, "form": FEW, "parameters": MANY, "snr_beyond": FEW},
        "base": {"photon_budget": FEW, "top_hat": FEW, "bit_depth": FEW, "peak_dn": FEW, "sigma_px": FEW},
        "snr": FEW,
        "limit": FEW,
    },
    "verdict": {
        "status": FEW,
        "detection": {"p_value": FEW},
        "effects": {"name": FEW, "candidates": FEW, "parameters": MANY},
        "gap": {"closed": FEW},
    },
    "outcome": FEW,
    "error": FEW,
    "seconds": FEW,
}


def code(name: str) -> list[str]:
    """Files that a generator's records depend on: what makes sets, the judge, and what the command line imports; not
    what only reads records."""
    here = Path(__file__).parent
    folders = ("light", "names", "rig", "second") if name == "names" else (name,)
    made = [path for own in folders for path in sorted((here / "generators" / own).rglob("*.py"))]
    makers = [here / "judge.py", *(path for path in made if path.name not in ("score.py", "picture.py"))]
    stages = ("ingest", "crop", "sensor", "judge", "flats")
    modules = {module for path in makers for module in provenance.imported_modules(path)}
    modules |= {f"spotcheck.cli.{stage}" for stage in stages}
    files = {*makers, *(path for module in modules for path in provenance.sources(module))}
    return sorted(str(path.relative_to(ROOT)) for path in files)


def commit(name: str) -> str:
    """Short hash of the last commit that touched what a generator's records depend on; `-dirty` where files differ from
    it."""
    files = code(name)
    last = _git("rev-list", "-1", "--abbrev-commit", "--abbrev=12", "HEAD", "--", *files).strip()
    return last + ("-dirty" if _git("status", "--porcelain", "--", *files).strip() else "")


def drawn(first: int, commit: str) -> int:
    """The first seed of a score at a commit: nobody who tunes knows it."""
    return first + int(commit[:6], 16)


def read(path: Path) -> list[Record]:
    """All records of a file, none if there is no file; a line cut short by a crash is left out."""
    return list(_lines(path.read_text(encoding="utf-8"))) if path.exists() else []


def publish(records: Sequence[Record], commit: str, times: dict[str, list[float]]) -> None:
    """Keep what the scores read of records, in place of those of the last release."""
    scored = [own for own in records if own["outcome"] != "passed over"]
    head = {"commit": commit, "first": first_of(records), "times": times}
    lines = [json.dumps(own, separators=(",", ":"), allow_nan=False) for own in (head, *map(reduced, scored))]
    packed = lzma.compress("".join(f"{line}\n" for line in lines).encode(), preset=9 | lzma.PRESET_EXTREME)
    PUBLISHED.write_bytes(packed)


def published() -> tuple[dict[str, Any], list[Record]]:
    """The records that the published scores follow from; before them their commit, first seed and times."""
    head, *rows = _lines(lzma.decompress(PUBLISHED.read_bytes()).decode())
    return head, rows


def first_of(records: Sequence[Record]) -> int:
    """The seed that a plan began with."""
    return min(int(own["job"]["seed"] - own["job"]["number"]) for own in records)


def reduced(record: Record) -> Record:
    """What the scores read of a record; of widths that is the largest."""
    out = _picked(record, READ)
    base = (out["truth"] or {}).get("base")
    if base:
        base["sigma_px"] = [max(base["sigma_px"])]
    return out


def _picked(value: Any, keys: Any) -> Any:
    """The keys that are to be kept; where `keys` is a number, all, to so many digits."""
    if isinstance(value, list):
        return [_picked(own, keys) for own in value]
    if isinstance(value, dict):
        wanted = dict.fromkeys(value, keys) if isinstance(keys, int) else keys
        return {key: _picked(own, wanted[key]) for key, own in value.items() if key in wanted}
    return float(f"{value:.{keys}g}") if isinstance(value, float) else value


def _lines(text: str) -> Iterator[Record]:
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
