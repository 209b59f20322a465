"""The list of frames of a dataset folder, row by row as it stands."""

import csv
from pathlib import Path


def rows_of(folder: Path) -> list[dict[str, str]]:
    """The rows of a folder's manifest."""
    with (folder / "manifest.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))
