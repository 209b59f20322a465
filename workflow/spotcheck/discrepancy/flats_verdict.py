"""The verdict on a dataset without spots: where flats depart from a straight line, and what makes up for it."""

from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.flats import FlatFit, Series, explanations, fitted, foretold, shown
from spotcheck.discrepancy.locate import holm
from spotcheck.discrepancy.sentence import value_text
from spotcheck.estimate.photon_transfer import Quantity
from spotcheck.model.effect import NO_SPOT
from spotcheck.model.effects import vocabulary

NOTHING = {"before": None, "after": None, "stderr": None, "unit": "px"}
MOST_ROWS = 40
CAVEAT = (
    "A closed gap does not prove a name: whatever else leaves the same trace in these levels would close it as well."
)


def verdict_of(
    series: Series, name: str, tolerance: Tolerance, gain: Quantity, simulations: int, seed: int
) -> dict[str, Any]:
    """verdict.json with its sentence; `gain` is that of photon transfer."""
    plain = fitted(series, ())
    p_value = p_of(series, plain, simulations, seed)
    of_peak, of_noise = size_of(series, plain)
    agrees = p_value >= tolerance.alpha or (of_peak < tolerance.of_peak and abs(of_noise) < 2 * tolerance.of_noise)
    found = [plain] if agrees else explanations(series)
    best, kept = found[0], [own for own in found if own.present]
    rest_peak, rest_noise = size_of(series, best)
    rest_p = p_of(series, best, simulations, seed + 1)
    left = rest_p < tolerance.alpha and not (rest_peak < tolerance.of_peak and abs(rest_noise) < 2 * tolerance.of_noise)
    status = "consistent" if agrees else "unknown" if left or not kept else "named" if len(kept) == 1 else "ambiguous"
    total = int(series.unseen.sum()) * 2
    before, after = plain.unseen / total, best.unseen / total
    closed = (before - after) / (before - 1) if kept and before > 1 else None
    most = max(plain.chi2 - _freedom(series), 1.0)
    out: dict[str, Any] = {
        "schema": 1,
        "dataset": name,
        "status": status,
        "detection": {"p_value": p_value, "n_simulations": simulations, "alpha": tolerance.alpha,
                      "rms_residual_percent_of_peak": 100 * of_peak, "excess_variance_fraction": of_noise},
        "where": where(series, plain, tolerance.alpha),
        "effects": _effects(series, kept, plain),
        "explanations": [list(own.names) for own in kept],
        "baseline_shift": {"p1": NOTHING, "p2": dict(NOTHING)},
        "unexplained": {"p_value": rest_p if kept else p_value,
                        "share": float(np.clip((best.chi2 - _freedom(series)) / most, 0, 1))},
        "gap": {"before": before, "after": after if kept else before, "noise_floor": 1.0, "closed": closed,
                "rms_dn_before": _rms(series, plain), "rms_dn_after": _rms(series, best if kept else plain),
                "on": "unseen conditions"},
        "advice": [],
        "not_assessed": [{"effect": own, "why": effect.flats or NO_SPOT} for own, effect in vocabulary().items()
                         if own not in shown(series)],
    }  # fmt: skip
    return out | {"sentence": _sentence(series, out, kept, gain)}


def _pulls(series: Series, fit: FlatFit) -> tuple[np.ndarray, np.ndarray]:
    signal, excess = foretold(series, fit.present, fit.peak, fit.gain)
    return (series.signal - signal) / series.signal_error, (series.excess - excess) / series.excess_error


def _freedom(series: Series) -> int:
    return int((~series.unseen).sum()) * 2 - 2


def p_of(series: Series, fit: FlatFit, simulations: int, seed: int) -> float:
    """Rank of χ² of the unseen levels among those of drawn ones: what a fit foretells of them has no freedom there."""
    rng = np.random.Generator(np.random.SFC64(seed))
    drawn = stats.chi2.rvs(2 * int(series.unseen.sum()), size=simulations, random_state=rng)
    return float((1 + np.count_nonzero(drawn >= fit.unseen)) / (1 + simulations))


def size_of(series: Series, fit: FlatFit) -> tuple[float, float]:
    """Rms of the mean's residual as a part of the highest signal, noise taken off; and the mean excess of variance."""
    signal, excess = foretold(series, fit.present, fit.peak, fit.gain)
    square = np.mean((series.signal - signal) ** 2 - series.signal_error**2)
    dark = (series.sensor.gain_dn_per_e * series.sensor.read_noise_e) ** 2
    return (
        float(np.sqrt(max(square, 0.0)) / series.signal.max()),
        float(np.mean((series.excess - excess) / (excess + dark))),
    )


def _rms(series: Series, fit: FlatFit) -> float:
    signal, _ = foretold(series, fit.present, fit.peak, fit.gain)
    return float(np.sqrt(np.mean((series.signal - signal)[series.unseen] ** 2)))


def where(series: Series, fit: FlatFit, alpha: float) -> list[dict[str, Any]]:
    """Levels whose mean or variance the baseline misses, strongest first, with Holm's correction over all."""
    rows = []
    for block, pulls in zip(("mean", "variance"), _pulls(series, fit), strict=True):
        for k, z in enumerate(pulls):
            rows.append((block, k, float(z)))
    log_p = np.array([np.log(2) + stats.norm.logsf(abs(z)) for _, _, z in rows])
    adjusted = holm(np.minimum(log_p, 0.0))
    total = max(sum(z * z - 1 for *_, z in rows), 1.0)
    edges = np.concatenate([[0.0], (series.signal[1:] + series.signal[:-1]) / 2, [series.signal[-1]]])
    order = np.argsort(log_p)
    return [
        {
            "block": rows[i][0],
            "angle_deg": None,
            "exposure_s": float(series.light[rows[i][1]] * series.longest_s) if series.timed else None,
            "bin": {"quantity": "grey level", "low": float(f"{edges[rows[i][1]]:.4g}"),
                    "high": float(f"{edges[rows[i][1] + 1]:.4g}"), "unit": "DN"},
            "z": rows[i][2],
            "p_adjusted": max(float(np.exp(adjusted[i])), 1e-300),
            "share": float(np.clip((rows[i][2] ** 2 - 1) / total, 0, 1)),
        }
        for i in order
        if adjusted[i] < np.log(alpha)
    ][:MOST_ROWS]  # fmt: skip


def _effects(series: Series, kept: list[FlatFit], plain: FlatFit) -> list[dict[str, Any]]:
    """The effects of the best set in order, each with what it closes on top of those before it."""
    if not kept:
        return []
    best = kept[0]
    stages = [plain, *(fitted(series, best.present[:k]) for k in range(1, len(best.present))), best]
    gap = max(plain.unseen - int(series.unseen.sum()) * 2, 1.0)
    closed = [(before.unseen - after.unseen) / gap for before, after in pairwise(stages)]
    return [_effect(kept, k, float(own)) for k, own in enumerate(closed)]


def _effect(kept: list[FlatFit], k: int, closed: float) -> dict[str, Any]:
    """An effect of the best set with its candidates: what stands in its place in a tied set."""
    best, own = kept[0], kept[0].present[k]
    names = [own.effect.name]
    for other in kept[1:]:
        fresh = set(other.names) - set(best.names)
        if own.effect.name not in other.names:
            names += sorted(fresh - set(names))
    return {
        "name": own.effect.name,
        "candidates": names,
        "parameters": {
            p.name: {"value": float(v), "stderr": float(e) if e > 0 else None, "unit": p.unit}
            for p, v, e in zip(own.effect.parameters, own.values, best.errors[k], strict=True)
            if np.isfinite(e)
        },
        "gap_closed": closed,
    }


def _sentence(series: Series, verdict: dict[str, Any], kept: list[FlatFit], gain: Quantity) -> str:
    detection = verdict["detection"]
    rms = detection["rms_residual_percent_of_peak"]
    off = f"{rms:.2g} % of the highest signal (rms)" if rms else "what noise brings"
    by_line = f"K = {value_text(gain.value, gain.stderr, 'DN/e-')}, of the levels up to 70 % of saturation"
    if verdict["status"] == "consistent":
        return (
            f"Flats and darks agree with a linear sensor: mean and noise of every level lie on straight lines within"
            f" {off} (p = {detection['p_value']:.2g}). {by_line}."
        )
    out = [f"Flats and darks disagree with a linear sensor: p = {detection['p_value']:.2g}, and the response is off by"]
    out.append(f"{off}.")
    if not kept:
        return " ".join([*out, f"No effect that levels can show explains it. A straight line gives {by_line}."])
    said = []
    for own in verdict["effects"]:
        numbers = ", ".join(
            f"{key} {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()
        )
        said.append(f"{own['name']} ({vocabulary()[own['name']].sentence}; {numbers})")
    out.append(f"Levels that had no part in it are foretold best with {' and '.join(said)}.")
    if len(kept) > 1:
        sets = "; ".join(" + ".join(own.names) for own in kept[1:])
        out.append(f"They cannot tell this from: {sets}.")
    gap = verdict["gap"]
    out.append(f"The rms of what they miss falls from {gap['rms_dn_before']:.2g} to {gap['rms_dn_after']:.2g} DN.")
    out.append(
        f"With it K = {value_text(kept[0].gain, kept[0].gain_error, 'DN/e-')} from all {len(series.light)} levels"
    )
    out.append(f"below saturation, where a straight line through 0 gives {by_line}.")
    return " ".join([*out, CAVEAT])
