"""How time and memory grow with frames and with datasets: `python -m tests.load.scale [--frames 10,100,1000,10000]
[--datasets 1,10,100]`.

Each stage runs in a process of its own, of which its processor time and peak memory are taken: other work on the
machine moves them little. Nothing of the library makes the frames.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile

from tests.conftest import ROOT, environment
from tests.load.rows import Row, write

# Stages that look at every frame, in their order, each with its options by file.
STAGES: dict[str, tuple[str, ...]] = {
    "ingest": (),
    "crop": ("frames",),
    "sensor": ("crops", "frames"),
    "fit": ("crops", "sensor"),
}
OUTPUTS = {"ingest": "frames", "crop": "crops", "sensor": "sensor", "fit": "fits"}
ANGLES, EXPOSURES = (0.0, 90.0), (2e-4, 4e-4, 6e-4, 8e-4, 1e-3)


class Cost(NamedTuple):
    """Processor seconds and peak memory [MB] of a process, and its wall-clock seconds."""

    seconds: float
    megabytes: float
    wall: float


def main() -> None:
    """Measure and write the rows."""
    parser = argparse.ArgumentParser(prog="python -m tests.load.scale", description=__doc__)
    parser.add_argument("--frames", default="10,100,1000,10000", help="sizes of datasets (default 10,100,1000,10000)")
    parser.add_argument("--datasets", default="1,10,100", help="datasets in one call (default 1,10,100)")
    args = parser.parse_args()
    frames, datasets = ([int(number) for number in own.split(",")] for own in (args.frames, args.datasets))
    with tempfile.TemporaryDirectory(prefix="scale-") as base:
        rows = [*of_frames(Path(base), frames), *of_datasets(Path(base), datasets)]
        write("scale", rows)


def of_frames(base: Path, counts: Sequence[int]) -> list[Row]:
    """A row a stage, and one on planning."""
    costs: dict[str, list[Cost]] = {stage: [] for stage in (*STAGES, "planning")}
    # The first run on a machine compiles.
    staged(write_set(base / "first", counts[0]), base / "first-out")
    for count in counts:
        folder, out = write_set(base / f"set{count}", count), base / f"out{count}"
        for stage, own in staged(folder, out).items():
            costs[stage].append(own)
        costs["planning"].append(cost(plan([folder], out)))
        walls = ", ".join(f"{name} {runs[-1].wall:.1f} s" for name, runs in costs.items())
        print(f"{count} frames: {walls}", flush=True)
    return [Row(f"{stage}, {', '.join(f'{own:,}' for own in counts)} frames", len(counts), growth(counts, own))
            for stage, own in costs.items()]  # fmt: skip


def staged(folder: Path, out: Path) -> dict[str, Cost]:
    """Each stage on a dataset, by name."""
    out.mkdir()
    costs = {}
    for stage, needs in STAGES.items():
        given = [word for name in needs for word in (f"--{name}", str(out / f"{name}.nc"))]
        costs[stage] = cost(["spotcheck", stage, folder, *given, "--output", out / f"{OUTPUTS[stage]}.nc"])
    return costs


def of_datasets(base: Path, counts: Sequence[int]) -> list[Row]:
    """Planning of many datasets in one call, and running them up to the fit."""
    folders = [write_set(base / f"many{k:03d}", 10) for k in range(max(counts))]
    planning, running = [], []
    for count in counts:
        planning.append(cost(plan(folders[:count], base / f"plan{count}")))
        run = [*plan(folders[:count], base / f"many{count}")[:-1], "--until", "fit"]
        running.append(cost(run))
        print(f"{count} datasets: planned in {planning[-1].wall:.1f} s, run in {running[-1].wall:.1f} s", flush=True)
    said = f"{', '.join(map(str, counts))} datasets of 10 frames in one call"
    return [Row(f"planning, {said}", len(counts), growth(counts, planning)),
            Row(f"up to the fit, {said}", len(counts), growth(counts, running))]  # fmt: skip


def growth(counts: Sequence[int], costs: Sequence[Cost]) -> str:
    """How time and memory grow, in words: a fixed start and so much each, from the smallest two, held against the
    largest."""
    each = (costs[-2].seconds - costs[0].seconds) / (counts[-2] - counts[0]) if len(counts) > 2 else np.nan
    foretold = costs[-2].seconds + each * (counts[-1] - counts[-2])
    more = costs[-1].seconds / foretold - 1
    memory = costs[-1].megabytes / costs[0].megabytes - 1
    wall = ", ".join(f"{own.wall:.1f}" for own in costs)
    peaks = ", ".join(f"{own.megabytes:.0f}" for own in costs)
    return f"{wall} s; the last {100 * more:+.0f} % off a straight line; {peaks} MB ({100 * memory:+.0f} %)"


def plan(folders: Sequence[Path], results: Path) -> list[str | Path]:
    """The command that plans a run and does nothing."""
    config = [f"datasets=[{', '.join(map(str, folders))}]", f"results={results}"]
    options = ["--cores", "2", "--nolock", "--quiet", "all"]
    return [sys.executable, "-m", "snakemake", *options, "--config", *config, "--dry-run"]


def cost(command: Sequence[str | Path]) -> Cost:
    """Run a command from the repository. RuntimeError with what it said where it fails."""
    started = time.monotonic()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(list(map(str, command)), cwd=ROOT, stdout=said, stderr=said,
                                   env=environment() | {"PATH": path})  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
        if status:
            said.seek(0)
            raise RuntimeError(f"{command[1]} failed:\n" + "\n".join(said.read().splitlines()[-20:]))
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, time.monotonic() - started)


def write_set(folder: Path, count: int) -> Path:
    """A dataset of small frames: a round spot that grows with exposure, Poisson electrons, read noise, 12 bit."""
    (folder / "frames").mkdir(parents=True)
    rng = np.random.default_rng(count)
    y, x = np.mgrid[:64, :64].astype(float)
    rows = ["file,kind,angle_deg,exposure_s,repeat"]
    cells = [(angle, exposure) for angle in ANGLES for exposure in EXPOSURES]
    for k in range(count):
        angle, exposure = cells[k % len(cells)]
        sigma = 4.0 + 0.5 * np.log(exposure / EXPOSURES[0])
        x0, y0 = rng.normal(32.0, 0.5, 2)
        light = 1.2e7 * exposure * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / sigma**2)
        dn = 0.2 * (rng.poisson(light) + rng.normal(0, 5, x.shape)) + 40
        tifffile.imwrite(folder / "frames" / f"{k:05d}.tif", np.clip(np.rint(dn), 0, 4095).astype(np.uint16))
        rows.append(f"frames/{k:05d}.tif,spot,{angle:g},{exposure:g},{k // len(cells)}")
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")
    sensor = "{bit_depth: 12, gain_dn_per_e: 0.2, read_noise_e: 5, black_level_dn: 40}"
    (folder / "instrument.yaml").write_text(f"crop_px: 48\nsensor: {sensor}\n")
    return folder


if __name__ == "__main__":
    main()
