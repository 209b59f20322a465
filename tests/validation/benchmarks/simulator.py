"""The simulator against plain numpy and against other packages: time of one random frame, its mean light included.

tests/sensor/test_reading_samples.py compares its readings with the exact distribution.
"""

import sys
import time
from collections.abc import Callable

import numpy as np

from spotcheck.model.forward import RandomStreams
from spotcheck.sensor import ReadingDistribution, SensorModel
from tests.validation.benchmarks import spots
from tests.validation.benchmarks.simulators import SIMULATORS, Scene
from tests.validation.benchmarks.table import Limit, Part, Point, Spread, Table, ratio_figure, spread

SEED = 20260104
OURS, NUMPY, MEAN = "ours", "numpy", "mean model alone"
CENTRE = (spots.SIDE - 1) / 2
FAINT_NOISE, STRONG_NOISE = "read noise 2 e-, offset 10 e-, 12 bit", "read noise 13 e-, no offset, 10 bit"
SCENES = {
    FAINT_NOISE: Scene(9091.0, CENTRE, CENTRE, 15.0, 10.0, SensorModel(0.11, 2.0, 0.0, 15000.0, 0.0, 4095.0), 12),
    STRONG_NOISE: Scene(9091.0, CENTRE, CENTRE, 15.0, 0.0, SensorModel(0.11, 13.0, 0.0, 15000.0, 0.0, 1023.0), 10),
}
# The time of a frame by numpy over ours.
FASTER, MUCH_FASTER = Limit("≥", 6), Limit("≥", 8)
Makers = dict[str, Callable[[], object]]


def makers(scene: Scene) -> tuple[Makers, dict[str, str]]:
    """What makes one frame, by name, and the reasons of those that cannot."""
    # The same fast generator and the same mean light for both.
    own, plain = (RandomStreams(SEED, number, 0).readings() for number in range(2))
    gain, reading = scene.sensor.gain_dn_per_e, ReadingDistribution(scene.sensor)
    out: Makers = {
        OURS: lambda: reading.sample(gain * scene.light_e(), own),
        NUMPY: lambda: spots.frame(scene.light_e(), scene.sensor, plain),
        MEAN: scene.light_e,
    }
    absent = {}
    for name, (make, _) in SIMULATORS.items():
        try:
            out[name] = make(scene, SEED)
        except ImportError as error:
            absent[name] = f"not run: {error}"
    return out, absent


def race(out: Makers, rounds: int, batch: int, label: str) -> dict[str, np.ndarray]:
    """Times [ms/frame] of each, round by round, in another order each round."""
    rng = np.random.default_rng(SEED)
    ms: dict[str, list[float]] = {name: [] for name in out}
    for make in out.values():
        make()
    for number in range(rounds):
        if number % 10 == 9:
            print(f"simulator, {label}: round {number + 1} of {rounds}", file=sys.stderr)
        for name in rng.permutation(list(out)):
            start = time.perf_counter()
            for _ in range(batch):
                out[name]()
            ms[name].append((time.perf_counter() - start) * 1e3 / batch)
    return {name: np.array(values) for name, values in ms.items()}


def measure(rounds: int = 30, batch: int = 8) -> Part:
    """Race all over `rounds` × `batch` frames of each scene."""
    figures, rows = [], []
    lacks = dict.fromkeys((OURS, NUMPY, MEAN), "") | {name: lack for name, (_, lack) in SIMULATORS.items()}
    absent: dict[str, str] = {}
    times: dict[str, dict[str, Spread]] = {}
    for label, scene in SCENES.items():
        out, absent = makers(scene)
        ms = race(out, rounds, batch, label)
        name = f"time of a frame by numpy / ours, {label}"
        figures.append(ratio_figure(name, ms[NUMPY] / ms[OURS], FASTER, MUCH_FASTER))
        times[label] = {name: spread(values) for name, values in ms.items()}
    for name, lack in lacks.items():
        if name in absent:
            rows.append([name, *[absent[name]] * len(SCENES), lack])
        else:
            rows.append([name, *(times[label][name].shown() for label in SCENES), lack])
    rows.append(["scipy, lmfit, astropy, iminuit, picasso", *["no sensor chain"] * len(SCENES), ""])
    # The first scene has room for every package: nothing of it clips.
    first = times[FAINT_NOISE]
    points = [
        Point("frame", "ours" if name == OURS else "simulator", name, *first[name]) for name in first if name != MEAN
    ]
    note = (
        f"Medians and 10–90 % over {rounds} rounds of {batch} frames. The chain: Poisson electrons, full well, read "
        "noise, gain, black level, one rounding, clips. Ours and numpy compute the same mean and draw from the same "
        "kind of generator."
    )
    columns = ("simulator", *(f"ms, {label}" for label in SCENES), "lacks")
    return Part("Simulator against peers", figures, [Table("One frame of 240 × 240 px", columns, rows, note)], points)
