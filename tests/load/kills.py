"""Runs that are killed at random moments, and the same call once more: `python -m tests.load.kills --tries 50`.

Each try starts the documented call on a small dataset, ends it by a signal, to Snakemake alone or to all its processes,
makes the same call again and compares every value of every netCDF, JSON and YAML file with those of a run that nobody
disturbed. It prints what happened how often, and writes it to tests/load/measured/kills.json.
"""

import argparse
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from itertools import cycle, islice, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.io import run_control
from tests.conftest import ROOT, SNAKEMAKE, environment
from tests.load.rows import Row, write
from tests.load.values import differing, values_of

SAMPLE = ROOT / "data" / "zscan-sample"
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
WHOM = ("Snakemake", "all its processes")
# A run that is asked to end must have ended by then [s].
LIMIT_S = 10.0
WELL = "the same call finished, all values equal"


class Try(NamedTuple):
    """What was done, what came of it, and how long the run took to end [s]."""

    what: str
    happened: str
    ended_s: float


def call(folder: Path, results: Path, words: list[str]) -> list[str]:
    """The documented call on two cores."""
    return [*SNAKEMAKE, "--cores", "2", *words, "--config", f"dataset={folder}", f"results={results}"]


def start(command: list[str], log: Path) -> subprocess.Popen:
    """Start a call in a process group of its own."""
    with log.open("a") as stream:
        return subprocess.Popen(
            command, cwd=ROOT, env=environment(), stdout=stream, stderr=stream, start_new_session=True
        )


def killed(command: list[str], log: Path, number: signal.Signals, whom: str, after_s: float) -> float:
    """Start a call, end it after a while, and say how long that took [s]; 0 where it was through before."""
    run = start(command, log)
    try:
        run.wait(timeout=after_s)
        return 0.0
    except subprocess.TimeoutExpired:
        pass
    begin = time.monotonic()
    os.kill(run.pid, number) if whom == WHOM[0] else os.killpg(run.pid, number)
    try:
        run.wait(timeout=10 * LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    return time.monotonic() - begin


def outcome(results: Path, command: list[str], log: Path, wanted: dict[str, object], ended_s: float) -> str:
    """What the same call makes of what the killed run left."""
    if ended_s > LIMIT_S:
        return f"took more than {LIMIT_S:g} s to end"
    if code := start(command, log).wait():
        return f"the same call ended with {code}: {log.read_text().strip().splitlines()[-1]}"
    if left := [path.name for path in results.rglob("*.part*")]:
        return f"left behind: {', '.join(left)}"
    if run_control.find_jobs(run_control.get_lock_path(next(results.iterdir())).read_text()):
        return "jobs survived"
    if other := differing(wanted, values_of(results)):
        return f"other values: {', '.join(other)}"
    return WELL


def beside(folder: Path, base: Path, words: list[str]) -> Try:
    """A second call while a first one works in the same results folder."""
    results, log = base / "beside", base / "beside.log"
    command = call(folder, results, words)
    first = start(command, log)
    while first.poll() is None and not run_control.get_lock_path(results / folder.name).exists():
        time.sleep(0.1)
    second = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    begin = time.monotonic()
    first.terminate()
    first.wait()
    said = [line for line in second.stderr.splitlines() if line.startswith("spotcheck: ")]
    well = second.returncode and len(said) == 1 and "another run is working there" in said[0]
    happened = "refused in one sentence" if well else f"ended with {second.returncode}: {' '.join(said)}"
    return Try("a second call beside a first", happened, time.monotonic() - begin)


def tried(folder: Path, base: Path, words: list[str], tries: int, seed: int) -> list[Try]:
    """All tries: signals and whom they are sent to take turns, moments are random."""
    rng = np.random.default_rng(seed)
    undisturbed = base / "undisturbed"
    begin = time.monotonic()
    if code := start(call(folder, undisturbed, words), base / "undisturbed.log").wait():
        raise SystemExit(f"the undisturbed run ended with {code}: {(base / 'undisturbed.log').read_text()}")
    lasted_s, wanted = time.monotonic() - begin, values_of(undisturbed)
    found = []
    for k, (number, whom) in enumerate(islice(cycle(product(SIGNALS, WHOM)), tries)):
        results, log = base / f"try{k}", base / f"try{k}.log"
        command, after_s = call(folder, results, words), rng.uniform(0.0, lasted_s)
        ended_s = killed(command, log, number, whom, after_s)
        happened = outcome(results, command, log, wanted, ended_s)
        found.append(Try(f"{number.name} to {whom}", happened, ended_s))
        print(f"{k + 1}/{tries}: {number.name} to {whom} after {after_s:.1f} s: {happened}", flush=True)
        if happened == WELL:
            shutil.rmtree(results)
    return [*found, beside(folder, base, words)]


def rows(found: list[Try]) -> list[Row]:
    """What was done, how often, what happened how often, and the longest that a run took to end."""
    out = []
    for what in dict.fromkeys(one.what for one in found):
        own = [one for one in found if one.what == what]
        happened = "; ".join(f"{count} × {said}" for said, count in Counter(one.happened for one in own).items())
        out.append(Row(what, len(own), f"{happened} (ended within {max(one.ended_s for one in own):.1f} s)"))
    return out


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=50, help="how many runs are killed")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    parser.add_argument("--until", nargs="+", default=[], help="stages to run up to; default all")
    args = parser.parse_args()
    base = Path(tempfile.mkdtemp(prefix="spotcheck-kills-"))
    folder = shutil.copytree(SAMPLE, base / "sample")
    words = ["--until", *args.until] if args.until else []
    found = tried(folder, base, words, args.tries, args.seed)
    write("kills", rows(found))
    if all(one.happened == WELL for one in found[:-1]):
        shutil.rmtree(base)
    else:
        print(f"logs and results of the others lie in {base}")


if __name__ == "__main__":
    main()
