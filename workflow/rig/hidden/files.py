"""A case as a dataset folder; its truth goes elsewhere."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import yaml

from rig.errors import RigError
from rig.hidden.case import Case, frames
from rig.imagefile import write_frame, write_whole

COLUMNS = ("file", "kind", "angle_deg", "exposure_s", "repeat")


def write(case: Case, folder: Path, truth: Path) -> None:
    """Write manifest.csv, instrument.yaml and frames into `folder`, and the truth to a file that is not inside it."""
    folder, truth = Path(folder), Path(truth)
    if truth.resolve().is_relative_to(folder.resolve()):
        raise RigError(f"{truth}: the truth must not lie in the dataset folder {folder}")
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(case.manifest)
    write_whole(folder / "manifest.csv", table.getvalue().encode())
    write_whole(folder / "instrument.yaml", yaml.safe_dump(case.instrument, sort_keys=False).encode())
    for row, frame in frames(case):
        write_frame(folder / row["file"], frame, case.instrument["sensor"]["bit_depth"])
    write_whole(truth, (json.dumps(case.truth, indent=2, allow_nan=False) + "\n").encode())
