"""How many of the paper's numbers and statements hold with other seeds of the virtual rig: data/published_seeds.csv.

`python -m tests.validation.published_seeds [--seeds 10]` exposes the default dataset with seeds 1, 2, 3 … in place of
the searched one, runs the stages up to the metrics, and checks data/published.yaml against each. A later call continues
where the last one stopped.
"""

import argparse
import csv
import re
import shutil
import sys
import tempfile
from pathlib import Path

from spotcheck.dataset import folder
from spotcheck.io.schema import read_yaml
from spotcheck.paper.number_checks import GROUPS, check_numbers, count_met
from spotcheck.paper.results import Results
from tests.conftest import ROOT, snakemake

TABLE = ROOT / "data" / "published_seeds.csv"
DEFAULT = ROOT / "data" / "virtual-rig"
# What the checks read of a results folder.
STAGES = ("metrics.nc", "calibration.nc", "bounds.nc", "sensor.nc", "simulated/fits.nc")


def main() -> None:
    """Add the rows of the seeds that the table does not have."""
    parser = argparse.ArgumentParser(prog="python -m tests.validation.published_seeds", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds (default 10)")
    seeds = parser.parse_args().seeds
    with TABLE.open(encoding="utf-8", newline="") as stream:
        done = {int(row["seed"]) for row in csv.DictReader(stream)}
    for seed in sorted(set(range(1, seeds + 1)) - done):
        with tempfile.TemporaryDirectory() as scratch:
            counts = count_with_seed(seed, Path(scratch))
        with TABLE.open("a", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerow([seed, *(counts[group] for group in GROUPS)])
        print(f"seed {seed}: {counts}", flush=True)


def count_with_seed(seed: int, scratch: Path) -> dict[str, int]:
    """Return the number of met entries of each group with a seed of the rig; files are written to `scratch`."""
    dataset = scratch / f"seed-{seed}"
    dataset.mkdir()
    for name in ("manifest.csv", "instrument.yaml"):
        shutil.copy(DEFAULT / name, dataset / name)
    settings, replaced = re.subn(r"(?m)^seed: \d+", f"seed: {seed}", (DEFAULT / "rig.yaml").read_text(encoding="utf-8"))
    if replaced != 1:
        sys.exit(f"{DEFAULT / 'rig.yaml'}: expected one line with the seed")
    (dataset / "rig.yaml").write_text(settings, encoding="utf-8")
    results = scratch / "results"
    targets = [str(results / dataset.name / name) for name in STAGES]
    # The dataset has a rig.yaml, so that the workflow exposes its frames first.
    done = snakemake(*targets, config={"dataset": dataset, "results": results})
    if done.returncode:
        sys.exit(done.stdout + done.stderr)
    with Results(folder.load(dataset), results / dataset.name) as made:
        checks = check_numbers(read_yaml(ROOT / "data" / "published.yaml"), made)
    return {group: met for group, (met, _) in count_met(checks).items()}


if __name__ == "__main__":
    main()
