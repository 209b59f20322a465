"""Where measurement and model disagree: every bin of the first look as a z-score, with multiplicity under control.

Each bin has a two-sided p-value by the normal law: bins of the mean are sums of many pixels; those of noise, which
follow a χ² law, are first made normal (Wilson and Hilferty 1931, doi:10.1073/pnas.17.12.684); both directions of an
azimuthal order are one bin of two degrees of freedom. What has no error of its own (stripes, hot pixels, outliers, the
converter's code) takes its p-value from the null sets. Then Holm's correction over all bins that were looked at, whose
overlap only makes it stricter: among rows of a set where nothing disagrees, any at all is as rare as alpha.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from spotcheck.discrepancy import stripes
from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.detect import Detection, cubic
from spotcheck.discrepancy.explain import Account
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.modes import GREYS, ORDERS, RINGS, modes_of
from spotcheck.discrepancy.noise import Observable
from spotcheck.discrepancy.surround import SIDES, Surround
from spotcheck.model.chain import spot_state

# The strongest row of every quantity is shown; then the table is filled by strength.
MOST_ROWS = 40
# Widths that differ by less than this part count as one: then rings are given in pixels.
SAME_WIDTH = 0.01
# Bins that only sum others up.
POOLED = ("level of light, all conditions",)
IN_ORDER = ("variance", "spectrum", "line", "frame", "surround")
# A wave counts in a ring if it keeps this part of itself beside the waves of lower order.
OWN = 0.3
WIDEST = 4.0
# What a p-value is called that is smaller than a float can hold.
SMALLEST = 1e-300


class Bin(NamedTuple):
    """One number that was looked at: contract's block, quantity with bounds (None: open) and unit, angle [deg] and
    exposure [s] (None: all), z, ln p, and excess χ² over what chance brings (None: it has none)."""

    block: str
    quantity: str
    low: float | None
    high: float | None
    unit: str
    angle_deg: float | None
    exposure_s: float | None
    z: float
    log_p: float
    excess: float | None


class Grid(NamedTuple):
    """z for the picture: `radial` [condition, ring] signed; `azimuthal` [condition, ring] of the strongest order, which
    is `order`; NaN where a ring is empty. `blocks` are all bins but the mean's, pooled over conditions; `threshold`
    is the |z| from which a bin alone would stand out."""

    radial: np.ndarray
    azimuthal: np.ndarray
    order: np.ndarray
    blocks: list[Bin]
    threshold: float


def where(
    look: Look,
    account: Account,
    alpha: float,
    detection: Detection | None = None,
    around: Surround | None = None,
) -> list[dict[str, Any]]:
    """Rows of the contract's `where` table, strongest first: bins of a look that disagree with an account (the base's)
    at `alpha` for all of them together.

    With `detection` also what only null sets can judge. `share` is a bin's part of all excess χ²; bins overlap (a
    condition lies in its angle and its exposure), so shares do not add up to 1.
    """
    bins = bins_of(look, account, detection, around)
    adjusted = holm(np.array([own.log_p for own in bins]))
    total = total_excess(look, account, bins)
    found = [(own, p) for own, p in zip(bins, adjusted, strict=True) if p < np.log(alpha)]
    found.sort(key=lambda item: (item[0].log_p, -abs(item[0].z)))
    quantities: set[tuple[str, str]] = set()
    first: list[tuple[Bin, float]] = []
    rest: list[tuple[Bin, float]] = []
    for item in found:
        key = item[0].block, item[0].quantity
        (rest if key in quantities else first).append(item)
        quantities.add(key)
    kept = (first + rest)[:MOST_ROWS]
    kept.sort(key=lambda item: (item[0].log_p, -abs(item[0].z)))
    return [_row(own, float(p), total, look) for own, p in kept]


def grid(
    look: Look,
    account: Account,
    alpha: float,
    detection: Detection | None = None,
    around: Surround | None = None,
) -> Grid:
    """The same numbers by condition and ring, for the picture."""
    z = _pulls(look, account).z(np.arange(look.measured.design.conditions))
    pairs = np.hypot(z[..., 1::2], z[..., 2::2])
    strongest = pairs.argmax(axis=-1)
    empty = (z == 0).all(axis=-1)
    azimuthal = _equivalent(-(pairs.max(axis=-1) ** 2) / 2)
    bins = bins_of(look, account, detection, around)
    one = look.measured.design.conditions == 1
    blocks = [own for own in bins if own.block not in ("mean", "variance")]
    blocks += [own for own in bins if own.block == "variance" and (one or own.quantity in POOLED)]
    blocks.sort(key=lambda own: IN_ORDER.index(own.block))
    threshold = float(_equivalent(np.log(alpha / len(bins))))
    return Grid(
        np.where(empty, np.nan, z[..., 0]),
        np.where(empty, np.nan, azimuthal),
        np.where(empty, 0, strongest + 1),
        blocks,
        threshold,
    )


def bins_of(
    look: Look, account: Account, detection: Detection | None = None, around: Surround | None = None
) -> list[Bin]:
    """Every number that was looked at."""
    own = [*_of_mean(look, account), *_of_noise(look, account), *_of_marks(account, detection)]
    return own if around is None else [*own, *_of_surround(around)]


def _of_surround(around: Surround) -> list[Bin]:
    """Blocks beside the crops, by side."""
    out = []
    for k, name in enumerate(SIDES):
        chi2, freedom = around.pull(k)
        if freedom:
            z = cubic(chi2, freedom)
            out.append(
                Bin("surround", f"blocks {name}", None, None, "1", None, None, z, float(_two_sided(z)), chi2 - freedom)
            )
    return out


def holm(log_p: np.ndarray) -> np.ndarray:
    """ln of p-values adjusted by Holm's step-down (1979): controls the chance of any false one, whatever depends on
    what."""
    order = np.argsort(log_p, kind="stable")
    count = len(log_p)
    stepped = np.maximum.accumulate(log_p[order] + np.log(count - np.arange(count)))
    out = np.empty(count)
    out[order] = np.minimum(stepped, 0.0)
    return out


def total_excess(look: Look, account: Account, bins: list[Bin]) -> float:
    """All χ² beyond what chance brings: of the mean in every block, and of each observable of noise."""
    fit = account.refit
    freedom = int(look.problem.used.sum()) - fit.freedom
    single = [
        own.excess for own in bins if own.block != "mean" and own.quantity not in POOLED and own.excess is not None
    ]
    return max(fit.chi2 - freedom, 0.0) + sum(max(e, 0.0) for e in single)


def _row(own: Bin, log_p: float, total: float, look: Look) -> dict[str, Any]:
    low, high = own.low, own.high
    if own.quantity == "stripes":
        low = high = float(stripes.peak(look.measured).period)
    share = None if own.excess is None or total <= 0 else float(np.clip(own.excess / total, 0.0, 1.0))
    quantity = own.quantity.removesuffix(", all conditions")
    return {
        "block": own.block,
        "angle_deg": own.angle_deg,
        "exposure_s": own.exposure_s,
        "bin": {"quantity": quantity, "low": _short(low), "high": _short(high), "unit": own.unit},
        "z": own.z,
        "p_adjusted": max(float(np.exp(log_p)), SMALLEST),
        "share": share,
    }


def _short(bound: float | None) -> float | None:
    """A bound to four digits: bins are not known better."""
    return None if bound is None else float(f"{bound:.4g}")


def _equivalent(log_p):
    """|z| of a two-sided ln p."""
    return -ndtri_exp(np.minimum(log_p, 0.0) - np.log(2))


def _two_sided(z):
    """ln p of |z|, two-sided."""
    return np.minimum(np.log(2) + log_ndtr(-np.abs(z)), 0.0)


class _Pulls(NamedTuple):
    """Projections [condition, ring, wave] of the residual on 1, cos φ, sin φ, cos 2φ, … and their variances; 0 where a
    ring has too few blocks to tell a wave from what comes before it."""

    pull: np.ndarray
    norm: np.ndarray

    def z(self, group: np.ndarray) -> np.ndarray:
        """z [member, ring, wave] of the members of a grouping of conditions."""
        pull, norm = (np.zeros((group.max() + 1, *self.pull.shape[1:])) for _ in range(2))
        np.add.at(pull, group, self.pull)
        np.add.at(norm, group, self.norm)
        return np.where(norm > 0, pull / np.sqrt(np.where(norm > 0, norm, 1.0)), 0.0)


def _pulls(look: Look, account: Account) -> _Pulls:
    """Projections of an account's residual. In a ring of few blocks waves are not orthogonal: what a lower order or a
    course in radius explains is taken off the higher ones, or a round residual would look fourfold."""
    view, fit = look.cells.view, account.refit
    shape = fit.residual.shape
    sigma = np.broadcast_to(spot_state(view, look.setting.baseline, look.cells.base, ())[1], (shape[0], 1, 1))
    ones = np.ones((1, view.y.shape[1], view.x.shape[2]))
    dx, dy = pooled((view.x - view.x0) * ones), pooled((view.y - view.y0) * ones)
    radius, azimuth = np.hypot(dx, dy) / sigma, np.arctan2(dy, dx)
    ring = np.digitize(radius, RINGS) - 1
    # From −1 to 1 across a ring; the last is open.
    across = 2 * (radius - RINGS[ring]) / np.minimum(np.diff(RINGS), WIDEST)[ring] - 1
    waves = [np.ones(shape), across, across**2]
    waves += [wave(m * azimuth) for m in range(1, ORDERS + 1) for wave in (np.cos, np.sin)]
    weight = np.where(look.problem.used, 1 / fit.variance, 0.0)
    rings = len(RINGS) - 1
    flat = (np.arange(shape[0])[:, None, None] * rings + ring).ravel()

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(flat, (weight * values).ravel(), shape[0] * rings)

    pull = np.array([total(wave * fit.residual) for wave in waves])
    gram = np.array([[total(a * b) for b in waves] for a in waves])
    alone = np.array([gram[k, k] for k in range(len(waves))])
    for k in range(len(waves)):
        pivot = gram[k, k] > OWN * alone[k]
        slope = np.where(pivot, gram[k] / np.where(pivot, gram[k, k], 1.0), 0.0)
        pull[k + 1 :] -= slope[k + 1 :] * pull[k]
        gram[k + 1 :, k + 1 :] -= slope[k + 1 :, None] * gram[k, None, k + 1 :]
    norm = np.array([gram[k, k] for k in range(len(waves))])
    told = norm > OWN * alone
    parts = (np.where(told, v, 0.0).T.reshape(shape[0], rings, len(waves)) for v in (pull, norm))
    return _Pulls(*(np.delete(part, (1, 2), axis=-1) for part in parts))


def _of_mean(look: Look, account: Account) -> list[Bin]:
    """Rings and azimuthal orders of every condition, exposure, place and all together, and grey levels by exposure."""
    pulls = _pulls(look, account)
    design, view = look.measured.design, look.cells.view
    amplitude, sigma = (np.broadcast_to(v, (design.conditions, 1, 1)).ravel() for v in
                        spot_state(view, look.setting.baseline, look.cells.base, ()))  # fmt: skip
    times = np.unique(np.nan_to_num(view.exposure_s.ravel()), return_inverse=True)[1]
    count = design.conditions
    groupings = (np.arange(count), times, look.cells.place, np.zeros(count, int))
    out: list[Bin] = []
    seen: list[np.ndarray] = []
    for group in groupings:
        # Where a design has one angle or one exposure, two groupings are one.
        same = np.unique(group, return_inverse=True)[1]
        if any((same == other).all() for other in seen):
            continue
        seen.append(same)
        z = pulls.z(group)
        for g in range(len(z)):
            own = group == g
            if own.any():
                out += _rings(z[g], _common(design.angle_deg[own]), _common(design.exposure_s[own]), sigma[own])
    brightest = float(np.max(amplitude))
    fit = account.refit
    for t, row in enumerate(modes_of(look.cells, look.setting, fit.residual, fit.variance, look.problem.used).grey):
        exposure = _common(design.exposure_s[times == t])
        for k in np.flatnonzero(row):
            low, high = max(GREYS[k], 0.0) * brightest, min(GREYS[k + 1], 1.0) * brightest
            out.append(_normal("mean", "grey level", float(low), float(high), "DN", None, exposure, float(row[k])))
    return out


def _rings(z: np.ndarray, angle: float | None, exposure: float | None, sigma: np.ndarray) -> list[Bin]:
    """Bins of one member of a grouping; `sigma` [px] are the widths of its conditions."""
    alike = np.ptp(sigma) < SAME_WIDTH * np.min(sigma)
    scale, unit = (float(np.mean(sigma)), "px") if alike else (1.0, "σ_g")
    out = []
    for k, ring in enumerate(z):
        low = float(RINGS[k] * scale)
        high = float(RINGS[k + 1] * scale) if np.isfinite(RINGS[k + 1]) else None
        if ring[0] != 0:
            out.append(_normal("mean", "radius", low, high, unit, angle, exposure, float(ring[0])))
        for m in range(1, ORDERS + 1):
            square = float(ring[2 * m - 1] ** 2 + ring[2 * m] ** 2)
            if square > 0:
                log_p = -square / 2
                name = f"radius, azimuthal order {m}"
                out.append(
                    Bin("mean", name, low, high, unit, angle, exposure, float(_equivalent(log_p)), log_p, square - 2)
                )
    return out


def _normal(
    block: str, quantity: str, low: float | None, high: float | None, unit: str,
    angle: float | None, exposure: float | None, z: float,
) -> Bin:  # fmt: skip
    return Bin(block, quantity, low, high, unit, angle, exposure, z, float(_two_sided(z)), z * z - 1)


def _common(values: np.ndarray) -> float | None:
    """The value that all share; None where they differ or none was recorded."""
    return float(values[0]) if np.isfinite(values).all() and np.ptp(values) == 0 else None


# What an observable's label is called in the table.
QUANTITY = {
    "band": "period",
    "site": "fine structure that the exposures of a site share",
    "sensor": "fine structure that all sites share on the sensor",
    "spot": "fine structure that goes with the spot",
    "brightness": "scatter of brightness",
    "centre": "scatter of the centre",
    "width": "scatter of the width",
    "roundness": "scatter of the roundness",
    "pedestal": "scatter of the pedestal",
    "hot": "hottest pixel",
}
# Observables without an error of their own.
MARKS = ("stripes", "hot", "outliers")


def _is_mark(own: Observable) -> bool:
    return own.label in MARKS or own.label.startswith("code")


def _of_noise(look: Look, account: Account) -> list[Bin]:
    """Observables that have an error; those of a level of light also pooled over conditions."""
    design = look.measured.design
    out = []
    levels: dict[str, list[Observable]] = {}
    for own in account.observables:
        if _is_mark(own):
            continue
        if own.block == "variance":
            levels.setdefault(own.label, []).append(own)
        out.append(_of_one(own, design))
    if design.conditions > 1:
        for label in sorted(levels):
            alike = levels[label]
            weight = np.array([o.error**-2 for o in alike])
            value = float(weight @ [o.value for o in alike] / weight.sum())
            together = alike[0]._replace(value=value, error=float(weight.sum() ** -0.5), condition=None)
            out.append(_of_one(together, design)._replace(quantity="level of light, all conditions"))
    return out


def _of_one(own: Observable, design) -> Bin:
    known = own.condition is not None
    angle = _common(design.angle_deg[[own.condition]]) if known else None
    exposure = _common(design.exposure_s[[own.condition]]) if known else None
    name = "level of light" if own.block == "variance" else QUANTITY.get(own.label, own.label)
    low, high = (float(v) if np.isfinite(v) else None for v in (own.low, own.high))
    unit = own.unit.removesuffix(" period") or "1"
    return _normal(own.block, name, low, high, unit, angle, exposure, _normal_score(own))


def _normal_score(own: Observable) -> float:
    """z of an observable; an excess over a floor of noise is χ² with as many degrees of freedom as its error tells."""
    if own.label in ("skewness", "site", "sensor", "spot"):  # sums of products of both signs: no χ²
        return own.value / own.error
    spread = (own.error / own.floor) ** 2 / 9
    return float((np.cbrt(max(1 + own.value / own.floor, 0.0)) - 1 + spread) / np.sqrt(spread))


def _of_marks(account: Account, detection: Detection | None) -> list[Bin]:
    """What only null sets can judge, at the p-value that they give it."""
    if detection is None:
        return []
    out = []
    for own in filter(_is_mark, account.observables):
        depth = detection.by_statistic.get(f"{own.block}: {own.label}")
        if depth is not None:
            code = own.label.startswith("code")
            name = "code of the converter" if code else QUANTITY.get(own.label, own.label)
            step = float(own.label.split()[1]) if code else None
            unit = "DN" if code else "px" if own.label == "stripes" else "1"
            log_p = -depth * float(np.log(10))
            out.append(Bin(own.block, name, step, step, unit, None, None, float(_equivalent(log_p)), log_p, None))
    return out
