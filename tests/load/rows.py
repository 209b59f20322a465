"""Rows of the table: what was tried, how many times, and what happened; one JSON file a programme, kept beside this one
with the page that quotes it."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
MEASURED = Path(__file__).parent / "measured"


class Row(NamedTuple):
    """What was tried, how many times, and what happened in words."""

    what: str
    tries: int
    happened: str


def write(programme: str, rows: Sequence[Row]) -> None:
    """Keep the rows of a programme, in place of those of its last run."""
    MEASURED.mkdir(parents=True, exist_ok=True)
    text = json.dumps([row._asdict() for row in rows], indent=1, ensure_ascii=False)
    (MEASURED / f"{programme}.json").write_text(text + "\n", encoding="utf-8")


def read(programme: str) -> list[Row]:
    """The rows of a programme's last run; none where it did not run."""
    path = MEASURED / f"{programme}.json"
    return [Row(**row) for row in json.loads(path.read_text(encoding="utf-8"))] if path.exists() else []
