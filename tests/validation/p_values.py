"""Are p-values of detection uniform without any effect, and tiny with one? By brute force, to be run by hand.

`python -m tests.validation.p_values null 120`, `… single 300`, `… learned 40`, `… power 3`, `… time`; a further number
is the first seed. Rates below 1 % and 5 % have their 95 % intervals (Clopper & Pearson); KS is Kolmogorov's p-value.
The p-values of all tests together (ALL) and of each test are listed.
"""

import sys
import time
from collections import defaultdict
from dataclasses import replace

import numpy as np
from scipy import stats

from spotcheck.discrepancy.detection import test_residuals as detect
from spotcheck.discrepancy.findings import Detection
from spotcheck.discrepancy.frames import select_pixels
from spotcheck.discrepancy.joint_fit import JointFit, fit_jointly
from spotcheck.discrepancy.light_shape import fit_free_shape
from spotcheck.discrepancy.residuals import measure_residuals
from tests.samples.drawn_frames import BLACK, DrawnCamera, DrawnFrames, DrawnLight, draw_frames, lay_out
from tests.samples.models_of_frames import SENSOR, frame_set, starting_model

# Departures from the plain model.
DEPARTURES = {
    "pedestal 0.2 DN": (DrawnLight(pedestal_dn=0.2), DrawnCamera()),
    "clip at 560 DN": (DrawnLight(), DrawnCamera(clip_dn=560.0)),
    "ellipse 1 %": (DrawnLight(ratio=1.01), DrawnCamera()),
    "rows 0.5 DN": (DrawnLight(), DrawnCamera(row_dn=0.5)),
    "bend 5 %": (DrawnLight(), DrawnCamera(bend=0.05)),
}
# Ranges of the read noise [e-] and of the peak over that of the law, over which cameras are drawn.
READ_NOISES_E, PEAKS = (2.0, 13.0), (0.3, 1.15)
ONE_FRAME = {"exposures_s": (9e-4,), "angles_deg": (0.0,), "repeats": 1}


def rate_line(name: str, values: list[float]) -> str:
    """Return one line of the table: rates of small p-values."""
    p = np.array(values)
    rates = []
    for level in (0.01, 0.05):
        hits = int((p < level).sum())
        low, high = stats.binomtest(hits, len(p)).proportion_ci()
        rates.append(f"{100 * hits / len(p):5.1f} % ({100 * low:.1f}–{100 * high:.1f})")
    return f"{name:42s} n {len(p):4d}  KS {stats.kstest(p, 'uniform').pvalue:8.2g}  <1 %: {rates[0]}  <5 %: {rates[1]}"


def fit_frames(drawn: DrawnFrames, read_noise_e: float) -> JointFit:
    """Fit drawn frames of a camera with a stated read noise [e-]."""
    model = starting_model(drawn, sensor=replace(SENSOR, read_noise_e=read_noise_e))
    return fit_jointly(model, select_pixels(frame_set(drawn), model.spots))


def detect_in(drawn: DrawnFrames, fit: JointFit) -> Detection:
    """Return the detection in the residuals of a fit."""
    return detect(measure_residuals(fit.model, frame_set(drawn)), BLACK)


def draw_null(sets: int, kind: str, first: int = 0) -> None:
    """Print rates for sets without any effect, each of another camera; `learned`: beside a free light shape."""
    values: dict[str, list[float]] = defaultdict(list)
    for seed in range(first, first + sets):
        rng = np.random.default_rng([seed, kind == "single"])
        noise = float(np.exp(rng.uniform(*np.log(READ_NOISES_E))))
        conditions = lay_out(**ONE_FRAME) if kind == "single" else lay_out()
        drawn = draw_frames(seed, conditions, camera=DrawnCamera(noise), peak_factor=float(rng.uniform(*PEAKS)))
        fit = fit_frames(drawn, noise)
        found = detect_in(drawn, fit_free_shape(fit) if kind == "learned" else fit)
        values["ALL"].append(found.p_value)
        for test in found.tests:
            values[test.name].append(test.p_value)
        if found.p_value < 0.02:
            print(f"seed {seed}: p {found.p_value:.2g}, read noise {noise:.1f} e-, {found.tests[0]}")
    print(*(rate_line(name, values[name]) for name in sorted(values, key=str.lower)), sep="\n")


def draw_power(sets: int) -> None:
    """Print p-values of sets with a departure from the model, 24 frames each."""
    for name, (light, camera) in DEPARTURES.items():
        for seed in range(sets):
            drawn = draw_frames(seed, lay_out(), light, camera)
            found = detect_in(drawn, fit_frames(drawn, camera.read_noise_e))
            tests = "; ".join(f"{test.name} {test.statistic:.1f}σ [{test.where}]" for test in found.tests[:3])
            print(f"{name:20s} p {found.p_value:.2g}: {tests}")


def measure_time() -> None:
    """Print the seconds for 96 frames."""
    drawn = draw_frames(1, lay_out(repeats=8))
    start = time.perf_counter()
    fit = fit_frames(drawn, SENSOR.read_noise_e)
    fitted = time.perf_counter()
    found = detect_in(drawn, fit)
    print(f"fit {fitted - start:.2f} s, detection {time.perf_counter() - fitted:.2f} s; p {found.p_value:.3g}")


if __name__ == "__main__":
    what, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 1
    if what == "power":
        draw_power(count)
    elif what == "time":
        measure_time()
    else:
        draw_null(count, what, int(sys.argv[3]) if len(sys.argv) > 3 else 0)
