"""Ten times the frames: time ten times, memory flat. Each run is a process of its own.

`python -m tests.validation.benchmarks.growth fit|simulate COUNT` prints the processor time [s] of the work itself, and
`… growth peak COMMAND …` what a command prints and its largest resident memory [MB]. On Linux, the peak memory of a
process is at least that of the process that started it. A benchmark that has loaded much therefore starts this small
process, which starts the command.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from spotcheck.fitting.fit_results import SpotFits
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.model.forward import RandomStreams
from spotcheck.sensor import ReadingDistribution
from tests.validation.benchmarks.simulator import FAINT_NOISE, SCENES
from tests.validation.benchmarks.spots import chunks
from tests.validation.benchmarks.table import Figure, Limit, Part, spread

CHUNK = 16
COUNTS = {"fit": 300, "simulate": 300}
TIME, MEMORY = Limit("≤", 0.1), Limit("≤", 1.15)


def simulate(count: int) -> Iterator[list[np.ndarray]]:
    """Random frames, chunk after chunk."""
    scene = SCENES[FAINT_NOISE]
    light, reading = scene.sensor.gain_dn_per_e * scene.light_e(), ReadingDistribution(scene.sensor)
    for number, size in enumerate(chunks(count, CHUNK)):
        yield [reading.sample(light, RandomStreams(number, frame, 0).readings()) for frame in range(size)]


def fit(count: int) -> Iterator[SpotFits]:
    """Fits of frames, chunk after chunk: copies of a few, which cost nothing to make."""
    stack = next(simulate(CHUNK))
    for size in chunks(count, CHUNK):
        yield fit_spots([frame.copy() for frame in stack[:size]], SCENES[FAINT_NOISE].sensor)


TASKS = {"fit": fit, "simulate": simulate}


def work(task: str, count: int) -> float:
    """Processor time [s] of a task on `count` frames."""
    start = time.process_time()
    for _ in TASKS[task](count):
        pass
    return time.process_time() - start


def run(task: str, count: int) -> tuple[float, float]:
    """Processor time [s] and largest resident memory [MB] of a process of its own."""
    module = [sys.executable, "-m", "tests.validation.benchmarks.growth"]
    command = [*module, "peak", *module, task, str(count)]
    seconds, memory = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()
    return float(seconds), float(memory)


def print_peak(command: list[str]) -> None:
    """Run a command and print its largest resident memory [MB]; exit with its status."""
    job = os.posix_spawn(command[0], command, os.environ)
    _, status, usage = os.wait4(job, 0)
    print(usage.ru_maxrss / 1024)
    sys.exit(os.waitstatus_to_exitcode(status))


def measure(rounds: int = 3) -> Part:
    """Ratios of ten times the frames to the frames, median of some rounds."""
    figures = []
    for task, count in COUNTS.items():
        pairs = []
        for number in range(rounds):
            print(f"growth, {task}: round {number + 1} of {rounds}", file=sys.stderr)
            pairs.append((run(task, count), run(task, 10 * count)))
        few, many = np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])
        times, memory = spread(many[:, 0] / few[:, 0]), spread(many[:, 1] / few[:, 1])
        deviation, frames = abs(times.middle / 10 - 1), f"{task}, {10 * count} frames"
        shown = f"{deviation:.1%} (× {times.shown()})"
        figures.append(Figure(f"{frames}: time / that of {count}, off from 10 by", deviation, shown, TIME))
        shown = f"× {memory.shown()}, {np.median(many[:, 1]):.0f} MB"
        figures.append(Figure(f"{frames}: memory / that of {count}", memory.middle, shown, MEMORY))
    return Part("Growth with the number of frames", figures)


if __name__ == "__main__":
    if sys.argv[1] == "peak":
        print_peak(sys.argv[2:])
    # Compiles, and touches what memory a chunk needs.
    work(sys.argv[1], CHUNK)
    print(work(sys.argv[1], int(sys.argv[2])))
