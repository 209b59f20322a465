"""The estimator against those of other packages: time of a fit, and its error in units of the bound.

All take turns on the same few images, in another order each round, so that the noise of the machine hits all alike; a
ratio of times is taken within its round.
"""

import sys
import time
from functools import partial
from importlib.metadata import version

import numpy as np

from spotcheck.fitting.spotfit import fit_spots
from spotcheck.sensor import SensorModel
from tests.validation.benchmarks import peers, spots
from tests.validation.benchmarks.peers import Answers, Estimator, Sample
from tests.validation.benchmarks.spots import MAJOR, MINOR
from tests.validation.benchmarks.table import Figure, Limit, Part, Point, Table, ratio_figure, spread

SEED = 20260101
# As accurate as can be: 1 but for the statistical error. At the optimum of least squares it is about 1.6.
EFFICIENT, AT_OPTIMUM = 1.1, 2.0
# A counter of electrons: K = 1 DN/e-, no read noise, no black level, no clip.
COUNTER = SensorModel(1.0, 0.0)
OURS = "ours"
COLUMNS = ("estimator", "free", "ms per image", "rms z", "mean z", "|z| > 10", "says converged", "how")


def sample(count: int, rng: np.random.Generator, integrated: bool) -> Sample:
    """Random images: set A, or the same along the axes and integrated over pixels."""
    images, widths, bounds = [], [], []
    for _ in range(count):
        truth = spots.set_a(rng)
        if integrated:
            mean, slopes = spots.integrated_image(truth)
        else:
            mean, slopes = spots.mean_image(truth), spots.slopes(truth)
        images.append(rng.poisson(mean).astype(float))
        widths.append(truth[[MAJOR, MINOR]])
        bounds.append(spots.bounds(slopes, 1 / mean)[[MAJOR, MINOR]])
    starts = [spots.start_of(image) for image in images]
    return Sample(*(np.array(part) for part in (images, widths, bounds, starts)))


def _ours(given: Sample, weighting: str, integrated: bool = False) -> Answers:
    fits = fit_spots(given.images, COUNTER, weighting=weighting, integrated=integrated)
    return fits.value[:, [MAJOR, MINOR]], fits.flags == 0


_START = "finds its own start"
OWN = (
    Estimator(OURS, "", peers.LIKELIHOOD, 7, partial(_ours, weighting="likelihood"), _START),
    Estimator("ours, equal weights", "", peers.LEAST_SQUARES, 7, partial(_ours, weighting="equal"), _START),
    Estimator("ours, integrated", "", peers.LIKELIHOOD, 7,
              partial(_ours, weighting="likelihood", integrated=True), f"pixel-integrated; {_START}", integrated=True),
)  # fmt: skip


class Runs:
    """Times [ms/image] round by round, errors in bounds, and convergence of one entrant."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self.z: list[np.ndarray] = []
        self.converged: list[bool | None] = []

    def add(self, entrant: Estimator, given: Sample) -> None:
        """Run once."""
        start = time.perf_counter()
        widths, converged = entrant.run(given)
        self.ms.append((time.perf_counter() - start) * 1e3 / len(given.images))
        self.z.append((widths - given.widths) / given.bounds)
        self.converged += list(converged)

    @property
    def rms(self) -> float:
        """Root mean square error of the widths in bounds; a fit that failed makes it NaN."""
        return float(np.sqrt(np.mean(np.square(self.z))))


def race(everyone: list[Estimator], rounds: int, batch: int) -> tuple[dict[str, Runs], dict[str, str]]:
    """Results of all that can run, and the reasons of those that cannot."""
    rng = np.random.default_rng(SEED)
    able, absent = [], {}
    warm = {integrated: sample(1, rng, integrated) for integrated in (False, True)}
    for entrant in everyone:
        try:
            # Also compiles: that is not timed.
            entrant.run(warm[entrant.integrated])
            able.append(entrant)
        except ImportError as error:
            absent[entrant.name] = f"not run: {error}"
    runs = {entrant.name: Runs() for entrant in able}
    for number in range(rounds):
        print(f"estimator: round {number + 1} of {rounds}", file=sys.stderr)
        given = {integrated: sample(batch, rng, integrated) for integrated in (False, True)}
        for k in rng.permutation(len(able)):
            runs[able[k].name].add(able[k], given[able[k].integrated])
    return runs, absent


def _row(entrant: Estimator, runs: Runs) -> list[str]:
    z = np.concatenate(runs.z)
    said = [c for c in runs.converged if c is not None]
    return [
        entrant.name,
        str(entrant.parameters),
        spread(runs.ms).shown(),
        f"{runs.rms:.2f}",
        f"{z.mean():+.2f}",
        str(int(np.sum(~(np.abs(z) <= 10)))),
        f"{sum(said)} of {len(said)}" if said else "does not say",
        entrant.remark,
    ]


def _figures(everyone: list[Estimator], runs: dict[str, Runs]) -> list[Figure]:
    """Times of the fastest peers over ours: of those that are as accurate, and of those that reach the optimum of least
    squares."""
    ms = {name: np.array(run.ms) for name, run in runs.items()}
    rivals = [e for e in everyone if e.name in runs and e.package and not e.integrated]
    rivals.sort(key=lambda e: np.median(ms[e.name]))
    efficient = [e.name for e in rivals if runs[e.name].rms <= EFFICIENT]
    squares = [e.name for e in rivals if e.kind == peers.LEAST_SQUARES and runs[e.name].rms <= AT_OPTIMUM]
    likely = ("as accurate", efficient, Limit("≥", 10), Limit("≥", 20))
    figures = []
    for what, names, must, aim in (likely, ("at the optimum of least squares", squares, Limit("≥", 3), Limit("≥", 6))):
        if names:
            name = f"time of the fastest peer {what} ({names[0]}) / ours"
            figures.append(ratio_figure(name, ms[names[0]] / ms[OURS], must, aim))
        else:
            figures.append(Figure(f"time of the fastest peer {what} / ours", np.nan, "no peer ran", must, aim))
    figures += [ratio_figure(f"time of {name} / ours", ms[name] / ms[OURS]) for name in efficient[1:]]
    rms = runs[OURS].rms
    return [*figures, Figure("rms error of the widths, ours", rms, f"{rms:.2f} bounds", Limit("≤", EFFICIENT))]


def measure(rounds: int = 24, batch: int = 4) -> Part:
    """Race all entrants over `rounds` × `batch` images."""
    everyone = [*OWN, *peers.PEERS]
    runs, absent = race(everyone, rounds, batch)
    count = rounds * batch
    note = (
        f"z is the error of a width in units of its bound, over {2 * count} widths (statistical error of rms z: "
        f"{1 / np.sqrt(4 * count):.2f}). Times are medians and 10–90 % over {rounds} rounds of {batch} images, without "
        "compilation. Peers that take a start get the same one, from the pixels above half maximum, whose "
        "computation is not timed; ours finds its own in the timed call."
    )
    tables = []
    for integrated, title in (
        (False, f"Fits of {count} images of 240 × 240 px, Poisson electrons"),
        (True, "The same along the axes, light integrated over pixels"),
    ):
        these = [e for e in everyone if e.integrated == integrated]
        rows = [_row(e, runs[e.name]) for e in these if e.name in runs]
        rows += [[e.name, "", absent[e.name], "", "", "", "", e.remark] for e in these if e.name in absent]
        rows += [] if integrated else [["pyxel-sim, prysm, emva1288", "", "no fit of a spot", "", "", "", "", ""]]
        tables.append(Table(title, COLUMNS, rows, "" if integrated else note))
    points = [
        Point("fit", e.kind if e.package else "ours", e.name, *spread(runs[e.name].ms), runs[e.name].rms)
        for e in everyone
        if e.name in runs
    ]
    return Part("Estimator against peers", _figures(everyone, runs), tables, points)


def versions() -> str:
    """Packages and their versions, as far as they are installed."""
    names = dict.fromkeys(["numpy", "numba", *(p.package for p in peers.PEERS), "pyxel-sim", "prysm", "emva1288"])
    found = []
    for name in names:
        try:
            found.append(f"{name} {version(name)}")
        except ImportError:
            found.append(f"{name} (not installed)")
    return ", ".join(found)
