"""Are p-values of detection uniform where nothing is odd, and tiny where something is? By brute force, to be run by
hand: `python -m tests.validation.p_values null 120`, `… single 300`, `… learned 40`, `… power 3`, `… time`.

Rates below 1 % and 5 % with their 95 % intervals (Clopper & Pearson), Kolmogorov's p, the same of every part.
"""

import sys
import time
from collections import defaultdict

import numpy as np
from scipy import stats

from spotcheck.old_engine.conclude.detect import Detection, detect
from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.numbers import fit_numbers
from spotcheck.old_engine.observe.pixels import Lights
from tests.reference.spot_draws import Setup, any_setup, draw

STRANGE = {
    "pedestal 0.2 DN": {"pedestal": 0.2},
    "clip at 560 DN": {"clip": 560.0},
    "stripes 2 %": {"stripes": 0.02},
    "rows 0.5 DN": {"rows": 0.5},
    "read noise +10 %": {"noise": 1.1},
}


def law_line(name: str, values) -> str:
    """One line of the table."""
    p = np.array(values)
    rates = []
    for level in (0.01, 0.05):
        hits = int((p < level).sum())
        low, high = stats.binomtest(hits, len(p)).proportion_ci()
        rates.append(f"{100 * hits / len(p):5.1f} % ({100 * low:.1f}–{100 * high:.1f})")
    return f"{name:42s} n {len(p):4d}  KS {stats.kstest(p, 'uniform').pvalue:8.2g}  <1 %: {rates[0]}  <5 %: {rates[1]}"


def null(sets: int, single: bool, first: int = 0, learned: bool = False) -> None:
    """Sets without any effect, each of another camera; `learned`: of 24 frames, beside a shape that is learned anew."""
    parts: dict[str, list[float]] = defaultdict(list)
    low = []
    for k in range(first, first + sets):
        rng = np.random.default_rng([k, single])
        setup = any_setup(rng, single)
        frames, model, groups = draw(rng, setup._replace(repeats=2) if learned else setup)
        found = detect(frames, shape_of(frames, model) if learned else model, groups)
        parts["ALL"].append(found.p_value)
        for own in found.parts:
            parts[own.name].append(own.p_value)
        if found.p_value < 0.02:
            low.append((found.p_value, setup, found.worst))
    print(*(law_line(name, parts[name]) for name in sorted(parts, key=str.lower)), sep="\n")
    for p, setup, worst in low:
        print(f"{p:.2g}", setup, worst)


def shape_of(frames, model) -> Fitted:
    """A fit with nodes each 0.3 σ, from numbers that are already near."""
    numbered = fit_numbers(frames, model).model
    empty = light_shape.empty(0.3, 5.1)
    return fit(frames, numbered._replace(lights=Lights.common(empty, len(frames))), 1.0)


def power(sets: int) -> None:
    """Sets with something odd, 48 frames each."""
    for name, effect in STRANGE.items():
        for k in range(sets):
            rng = np.random.default_rng([k, 99])
            found = detect(*draw(rng, Setup(), effect))
            print(f"{name:20s} p {found.p_value:.2g}:", *(
                f"{own.name} {own.statistic:.1f}σ [{own.where}];" for own in found.parts[:3]))  # fmt: skip


def clock() -> Detection:
    """Seconds for 96 frames of 240 × 240 px."""
    rng = np.random.default_rng(1)
    frames, model, groups = draw(rng, Setup(side=240, repeats=8))
    detect(*draw(rng, Setup()))
    start = time.perf_counter()
    numbered = fit_numbers(frames, model)
    fitted = time.perf_counter()
    found = detect(frames, numbered, groups)
    print(f"fit {fitted - start:.2f} s, detection {time.perf_counter() - fitted:.2f} s; p {found.p_value:.3g}")
    return found


if __name__ == "__main__":
    what, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 1
    begin = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    if what == "power":
        power(count)
    elif what == "time":
        clock()
    else:
        null(count, what == "single", begin, what == "learned")
