"""What a run costs: time, engine overhead, memory and its growth with the number of frames, disk.

`make bench` prints one table and ends with a summary line; status 1 when a bound is missed. Times are of this machine
and moment; what is comparable between machines are the ratios: work of the jobs to wall time, memory of ten times the
frames to memory of the frames, both of one run.
"""

import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.conftest import SNAKEMAKE, environment, small_rig_dataset  # noqa: E402

BIN = Path(sys.executable).parent
STAGES = ("ingest", "crop", "sensor", "fit", "calibrate", "simulate", "compare")


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
        "fit": ["fit", given["crops"], *sensor, "--output", given["fits"]],
        "calibrate": ["calibrate", str(data), *crops, *fits, *sensor, "--output", given["calibration"]],
        "simulate": [
            *("simulate", str(data), "--calibration", given["calibration"], *fits, *sensor, "--seed", "1"),
            *("--folder", str(out / "simulated"), "--output", given["simulated"]),
        ],
        "compare": [
            *("compare", *crops, given["crops"], *fits, given["fits"], *sensor),
            *("--output", str(out / "metrics.nc")),
        ],
    }[stage]


def stage_memory(data: Path, out: Path) -> dict[str, float]:
    """Largest resident memory [MB] of each stage, run one after the other."""
    out.mkdir()
    peaks = {}
    for stage in STAGES:
        job = subprocess.Popen([BIN / "spotcheck", *command_of(stage, data, out)], stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(job.pid, 0)
        job.returncode = os.waitstatus_to_exitcode(status)
        assert job.returncode == 0, stage
        peaks[stage] = usage.ru_maxrss / 1024
    return peaks


def growing_dataset(folder: Path, repeats: int) -> Path:
    """A small dataset of the rig with 3 frames a repeat."""
    small_rig_dataset(folder, angles=(0,), repeats=repeats)
    arguments = [folder, "--settings", folder / "rig.yaml", "--truth", folder / "truth.json"]
    subprocess.run([BIN / "rig", "expose", *arguments], check=True, capture_output=True)
    return folder


def main() -> None:
    """Measure, print, judge."""
    rows: list[tuple[str, str, str, bool]] = []
    with tempfile.TemporaryDirectory() as scratch:
        base = Path(scratch)
        wall = run_default(2, base / "two")
        rows.append(("default dataset, 2 cores, frames made anew", f"{wall:.0f} s", "at most 240 s", wall <= 240))
        alone = run_default(1, base / "one")
        work = sum(seconds for seconds, _ in job_costs(base / "one").values())
        overhead = 1 - work / alone
        rows.append(
            ("engine overhead, 1 core: 1 − work of the jobs / wall", f"{overhead:.1%}", "below 25 %", overhead < 0.25)
        )
        costs = job_costs(base / "two")
        hungry = max(costs, key=lambda name: costs[name][1])
        rows.append(
            (
                f"largest memory of a job ({hungry})",
                f"{costs[hungry][1]:.0f} MB",
                "below 1000 MB",
                costs[hungry][1] < 1000,
            )
        )
        used = disk(base / "two") + disk(ROOT / "data" / "virtual-rig")
        rows.append(("disk after the default run, frames included", f"{used:.0f} MB", "below 1000 MB", used < 1000))
        few = stage_memory(growing_dataset(base / "few", 12), base / "few-results")
        many = stage_memory(growing_dataset(base / "many", 120), base / "many-results")
        for stage in STAGES:
            ratio = many[stage] / few[stage]
            rows.append(
                (
                    f"memory of ten times the frames: {stage}",
                    f"× {ratio:.2f} ({few[stage]:.0f} MB)",
                    "at most × 1.15",
                    ratio <= 1.15,
                )
            )
    width = max(len(row[0]) for row in rows)
    for name, value, bound, good in rows:
        print(f"{name:{width}}  {value:>15}  {bound:>15}  {'reached' if good else 'MISSED'}")
    print(
        "\nslowest jobs on 2 cores: "
        + ", ".join(f"{n} {s:.0f} s" for n, (s, _) in sorted(costs.items(), key=lambda i: -i[1][0])[:5])
    )
    reached = sum(row[3] for row in rows)
    print(f"{reached} of {len(rows)} bounds reached")
    sys.exit(reached < len(rows))


if __name__ == "__main__":
    main()
