"""What a run of the workflow costs: time, engine overhead, memory and its growth with the number of frames, disk.

Times are of this machine and moment; what is comparable between machines are the ratios: work of the jobs to wall time,
memory of ten times the frames to memory of the frames, both of one run.
"""

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.conftest import SNAKEMAKE, environment, small_rig_dataset
from tests.validation.benchmarks import peak
from tests.validation.benchmarks.table import Figure, Limit, Part, Table

ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent
STAGES = ("ingest", "crop", "sensor", "fit", "calibrate", "simulate", "metrics", "precision")


def run_default(cores: int, results: Path) -> float:
    """Wall time [s] of the default dataset from its plan to the report, frames made anew."""
    start = time.monotonic()
    command = [*SNAKEMAKE, "--cores", str(cores), "--forceall", "--quiet", "all", "--config", f"results={results}"]
    subprocess.run(command, cwd=ROOT, check=True, env=environment(), capture_output=True)
    return time.monotonic() - start


def job_costs(results: Path) -> dict[str, tuple[float, float]]:
    """Seconds and largest resident memory [MB] of every job, from Snakemake's benchmark files."""
    costs = {}
    for path in sorted((results / "virtual-rig" / "benchmarks").glob("*.tsv")):
        row = next(csv.DictReader(path.open(), delimiter="\t"))
        costs[path.stem] = (float(row["s"]), float(row["max_rss"] if row["max_rss"] not in ("NA", "-") else 0))
    return costs


def disk(path: Path) -> float:
    """Bytes of all files below a folder, in MB."""
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) / 1e6


def command_of(stage: str, data: Path, out: Path) -> list[str]:
    """The command line of a stage, as its rule calls it; the simulated folder is compared with itself."""
    given = {
        name: str(out / f"{name}.nc") for name in ("frames", "crops", "sensor", "fits", "calibration", "simulated")
    }
    sensor = ["--sensor", given["sensor"]]
    crops, fits = ["--crops", given["crops"]], ["--fits", given["fits"]]
    return {
        "ingest": ["ingest", str(data), "--output", given["frames"]],
        "crop": ["crop", str(data), "--frames", given["frames"], "--output", given["crops"]],
        "sensor": ["sensor", str(data), *crops, "--frames", given["frames"], "--output", given["sensor"]],
        "fit": ["fit", str(data), *crops, *sensor, "--output", given["fits"]],
        "calibrate": ["calibrate", str(data), *crops, *fits, *sensor, "--output", given["calibration"]],
        "simulate": [
            *("simulate", str(data), "--calibration", given["calibration"], *fits, *sensor, "--seed", "1"),
            *("--folder", str(out / "simulated"), "--output", given["simulated"]),
        ],
        "metrics": [
            *("metrics", *crops, given["crops"], *fits, given["fits"], *sensor),
            *("--output", str(out / "metrics.nc")),
        ],
        "precision": [
            *("precision", str(data), *fits, given["fits"], "--calibration", given["calibration"], *sensor),
            *("--output", str(out / "precision.nc")),
        ],
    }[stage]


def stage_memory(data: Path, out: Path) -> dict[str, float]:
    """Largest resident memory [MB] of each stage, run one after the other."""
    out.mkdir()
    return {stage: peak.run([str(BIN / "spotcheck"), *command_of(stage, data, out)])[1] for stage in STAGES}


def growing_dataset(folder: Path, repeats: int) -> Path:
    """A small dataset of the rig with 3 frames a repeat."""
    small_rig_dataset(folder, angles=(0,), repeats=repeats)
    arguments = ["--settings", str(folder / "rig.yaml"), "--truth", str(folder / "truth.json")]
    subprocess.run([str(BIN / "rig"), "expose", str(folder), *arguments], check=True, capture_output=True)
    return folder


def measure() -> Part:
    """The default dataset on two cores and on one, and every stage on a few frames and on ten times as many."""
    with tempfile.TemporaryDirectory() as scratch:
        base = Path(scratch)
        print("workflow: default dataset on 2 cores, then on 1", file=sys.stderr)
        wall = run_default(2, base / "two")
        alone = run_default(1, base / "one")
        overhead = 1 - sum(seconds for seconds, _ in job_costs(base / "one").values()) / alone
        costs = job_costs(base / "two")
        hungry = max(costs, key=lambda name: costs[name][1])
        largest = costs[hungry][1]
        used = disk(base / "two") + disk(ROOT / "data" / "virtual-rig")
        figures = [
            Figure("default dataset, 2 cores, frames made anew", wall, f"{wall:.0f} s", Limit("≤", 240, " s")),
            Figure(
                "engine overhead, 1 core: 1 − work of the jobs / wall", overhead, f"{overhead:.1%}", Limit("≤", 0.25)
            ),
            Figure(f"largest memory of a job ({hungry})", largest, f"{largest:.0f} MB", Limit("≤", 1000, " MB")),
            Figure("disk after the default run, frames included", used, f"{used:.0f} MB", Limit("≤", 1000, " MB")),
        ]
        print("workflow: memory of every stage", file=sys.stderr)
        few = stage_memory(growing_dataset(base / "few", 12), base / "few-results")
        many = stage_memory(growing_dataset(base / "many", 120), base / "many-results")
    for stage in STAGES:
        ratio = many[stage] / few[stage]
        name, shown = f"memory of ten times the frames: {stage}", f"× {ratio:.2f}, {many[stage]:.0f} MB"
        figures.append(Figure(name, ratio, shown, Limit("≤", 1.15)))
    slowest = sorted(costs.items(), key=lambda item: -item[1][0])[:5]
    jobs = Table("Slowest jobs on 2 cores", ("job", "time"), [[name, f"{s:.0f} s"] for name, (s, _) in slowest])
    return Part("What a run of the workflow costs", figures, [jobs])
