"""Results of a dataset by the command lines of the workflow, without Snakemake."""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path

from spotcheck import cli

# Results that a stage reads, and the one that it writes.
STAGES = {
    "ingest": ((), "frames"),
    "transfer": (("frames",), "transfer"),
    "crop": (("frames",), "crops"),
    "sensor": (("crops", "frames"), "sensor"),
    "fit": (("crops", "sensor"), "fits"),
    "calibrate": (("crops", "fits", "sensor"), "calibration"),
    "bounds": (("calibration", "sensor"), "bounds"),
    "caustic": (("fits",), "caustic"),
}
# Stages of a dataset of spots up to p1 and p2.
SPOTS = ("ingest", "crop", "sensor", "fit", "calibrate")


def run_stages(data: Path, out: Path, stages: Sequence[str] = SPOTS) -> Path:
    """Run stages on a dataset folder, without their words on the terminal, and return the results folder `out`."""
    for stage in stages:
        needs, written = STAGES[stage]
        options = [word for name in needs for word in (f"--{name}", str(out / f"{name}.nc"))]
        with redirect_stdout(io.StringIO()):
            cli.run([stage, str(data), *options, "--output", str(out / f"{written}.nc")])
    return out
