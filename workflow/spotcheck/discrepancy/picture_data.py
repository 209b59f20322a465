"""discrepancy.nc: all that the pictures of a verdict show, over the grid of conditions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.extend import Findings
from spotcheck.discrepancy.locate import Bin, Grid, grid
from spotcheck.discrepancy.look import Look
from spotcheck.discrepancy.modes import RINGS
from spotcheck.discrepancy.name import TIED
from spotcheck.discrepancy.refit import Refit
from spotcheck.discrepancy.shots import Design, Shot, design_of
from spotcheck.discrepancy.verdict import Judgement
from spotcheck.discrepancy.verify import Gap
from spotcheck.manifest import number_in
from spotcheck.model.chain import spot_state

# Excess χ² of the means, in its own standard deviations, from which on one may say what part of it an effect closes.
CLEAR = 3.0
BEFORE, AFTER = "before", "after"


class _Canvas(NamedTuple):
    """Names and lengths of the grid's dimensions without repeats, and each condition's place on it."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    places: list[tuple[int, ...]]

    def spread(self, values: np.ndarray, fill: Any = np.nan) -> np.ndarray:
        """Values [condition, …] on the grid; cells without a condition are `fill`."""
        out = np.full((*self.shape, *values.shape[1:]), fill, dtype=values.dtype)
        for place, own in zip(self.places, values, strict=True):
            out[place] = own
        return out


def dataset_of(
    judgement: Judgement, verdict: dict[str, Any], dataset: Dataset, shots: Sequence[Shot] | None = None
) -> xr.Dataset:
    """The pictures' data of a judgement; what was not assessed leaves only attributes, with the reason in `skipped`.

    `shots` are those that were judged. Without them every spot frame of the dataset counts as one, which only matters
    where a whole place of a declared condition could not be used.
    """
    out = store.grid(dataset).drop_vars("repeat", errors="ignore")
    out.attrs |= {"status": verdict["status"], "alpha": verdict["detection"]["alpha"]}
    found = judgement.findings
    if found is None:
        why = "; ".join(own["why"] for own in verdict["not_assessed"] if own["effect"] == "all")
        return out.assign_attrs(skipped=why or judgement.why_not)
    canvas = _canvas(found.look.measured.design, dataset, shots)
    _add_spots(out, canvas, found.look)
    _add_residuals(out, canvas, found, judgement.gap)
    _add_candidates(out, found)
    _add_places(out, canvas, grid(found.look, found.base, verdict["detection"]["alpha"], found.detection, found.around))
    return out


def _canvas(design: Design, dataset: Dataset, shots: Sequence[Shot] | None) -> _Canvas:
    axes = [axis for axis in dataset.axes if axis.name != "repeat"]
    if shots is None:
        names = dataset.instrument.conditions
        shots = [
            Shot(
                f.angle_deg, f.exposure_s, f.repeat or 0, None, tuple(number_in(f.extra[n]) for n in names), 0, 0, _none
            )
            for f in dataset.spots
        ]
    condition = design_of(shots).condition
    first = [shots[int(np.flatnonzero(condition == c)[0])] for c in range(int(condition.max()) + 1)]
    if len(first) != design.conditions and len(axes) == 2:
        # Conditions without a usable frame: angle and exposure tell which.
        pairs = list(zip(design.angle_deg, design.exposure_s, strict=True))
        known = {_pair(*pair) for pair in pairs}
        first = [own for own in first if _pair(_float(own.angle_deg), _float(own.exposure_s)) in known]
    if len(first) != design.conditions:
        raise ValueError(f"{len(first)} conditions of frames, {design.conditions} that were judged: pass the shots")
    places = [
        tuple(
            axis.index(value)
            for axis, value in zip(axes, (own.angle_deg, own.exposure_s, *own.conditions), strict=True)
        )
        for own in first
    ]
    return _Canvas(tuple(axis.name for axis in axes), tuple(axis.size for axis in axes), places)


def _none() -> np.ndarray:
    raise AssertionError("a shot without pixels was opened")


def _float(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _pair(angle: float, exposure: float) -> tuple[str, str]:
    """NaN equals NaN."""
    return repr(float(angle)), repr(float(exposure))


def _put(out: xr.Dataset, name: str, dims: tuple[str, ...], values: Any, units: str, long_name: str) -> None:
    values = np.asarray(values)
    if values.dtype.kind == "f" and values.ndim > 2:
        values = values.astype("f4")
    out[name] = (dims, values, {"units": units, "long_name": long_name})


def _add_spots(out: xr.Dataset, canvas: _Canvas, look: Look) -> None:
    """Where the spot lies in the crop, how wide it is, and how bright the brightest is."""
    view, side, count = look.cells.view, look.measured.side, look.measured.design.conditions
    sigma = spot_state(view, look.setting.baseline, look.cells.base, ())[1]
    # The first point of a view lies half a block's spread before the middle of the first block.
    inner = (side - 1) / 2 - np.sqrt((side**2 - 1) / 12)
    x = (view.x0 - view.x[:, :, :1] + inner).ravel()
    y = (view.y0 - view.y[:, :1, :] + inner).ravel()
    width = np.broadcast_to(sigma, (count, 1, 1)).ravel()
    for name, values, long_name in (
        ("spot_x", x, "column of the spot's centre in the crop, mean over frames"),
        ("spot_y", y, "row of the spot's centre in the crop, mean over frames"),
        ("sigma", width.astype(float), "width sigma_g of the base model"),
    ):
        _put(out, name, canvas.dims, canvas.spread(values), "pixel", long_name)
    _put(out, "peak", (), float(np.max(look.light)), "DN", "brightest light of the base model")


def _add_residuals(out: xr.Dataset, canvas: _Canvas, found: Findings, gap: Gap | None) -> None:
    """Maps, radial profiles and the gap by condition, before and (where something was added) after."""
    stages: dict[str, tuple[Look, Refit]] = {BEFORE: (found.look, found.base.refit)}
    if found.best is not None:
        stages[AFTER] = (found.best[0], found.best[1].refit)
    elif found.left is not None:
        stages[AFTER] = (found.left.look, found.left.refit)
    side = found.look.measured.side
    rows, columns = found.look.cells.residual.shape[1:]
    for axis, count in (("block_y", rows), ("block_x", columns)):
        along = "rows" if axis == "block_y" else "columns"
        values = side * np.arange(count) + (side - 1) / 2
        out.coords[axis] = (axis, values, {"units": "pixel", "long_name": f"middle of a block of pixels along {along}"})
    first = found.base.refit
    reading = pooled(first.moments.mean) + _median(found.look, first)
    _put(out, "reading", (*canvas.dims, "block_y", "block_x"), canvas.spread(reading), "DN",
         "median over the frames that chose the model, laid on the mean of their centres")  # fmt: skip
    edges = side * np.arange(max(min(rows, columns) // 2, 1) + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    out.coords["radius"] = ("radius", middle, {"units": "pixel", "long_name": "distance from the spot's centre"})
    for name, (look, fit) in stages.items():
        text = "base model" if name == BEFORE else "extended model"
        _put(out, f"residual_{name}", (*canvas.dims, "block_y", "block_x"), canvas.spread(_median(look, fit)), "DN",
             f"measured less {text}, median over the frames that chose the model")  # fmt: skip
        value, error = _profile(look, fit, edges)
        dims = (*canvas.dims, "radius")
        _put(
            out,
            f"profile_{name}",
            dims,
            canvas.spread(value),
            "DN",
            f"measured less {text}, mean over a ring and frames",
        )
        _put(out, f"profile_{name}_stderr", dims, canvas.spread(error), "DN", f"standard error of profile_{name}")
    _add_gap(out, canvas, found, stages, gap)


def _median(look: Look, fit: Refit) -> np.ndarray:
    """Median over the frames of each condition [condition, row, column] of measured less model [DN]."""
    sums, condition = look.measured.sums, look.measured.design.condition
    change = pooled(fit.moments.mean) - look.problem.mean_start
    out = np.full(look.cells.residual.shape, np.nan)
    frames = np.where(sums.pixels > 0, sums.residual, np.nan)
    for c in range(len(out)):
        own = frames[condition == c]
        known = np.isfinite(own).any(axis=0) if len(own) else np.zeros(out.shape[1:], bool)
        out[c][known] = np.nanmedian(own[:, known], axis=0) - change[c][known]
    return out


def _profile(look: Look, fit: Refit, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean residual [condition, ring] and its standard error [DN]."""
    view, count = look.cells.view, look.cells.pixels
    dx, dy = pooled((view.x - view.x0) * np.ones_like(view.y)), pooled((view.y - view.y0) * np.ones_like(view.x))
    ring = np.digitize(np.hypot(dx, dy), edges) - 1
    known = (count > 0) & (ring < len(edges) - 1)
    size = len(edges) - 1
    flat = (np.arange(len(count))[:, None, None] * size + ring)[known]

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(flat, values[known], minlength=len(count) * size).reshape(len(count), size)

    with np.errstate(invalid="ignore"):
        weight = total(count)
        mean = np.where(weight > 0, total(count * fit.residual) / weight, np.nan)
        error = np.where(weight > 0, np.sqrt(total(count**2 * np.where(known, fit.variance, 0.0))) / weight, np.nan)
    return mean, error


def _add_gap(
    out: xr.Dataset, canvas: _Canvas, found: Findings, stages: dict[str, tuple[Look, Refit]], gap: Gap | None
) -> None:
    """Mean squared standardised residual by condition: on unseen data where its variances are known, else on the frames
    that chose the model."""
    used = found.look.problem.used
    squares = {name: np.where(used, fit.residual**2 / fit.variance, np.nan) for name, (_, fit) in stages.items()}
    floor = 1 - found.base.refit.freedom / max(int(used.sum()), 1)
    on = "frames that chose the model"
    keys = [f"variance_{name}" for name in stages]
    if gap is not None and all(key in gap.maps for key in keys):
        squares = {name: gap.maps[name] ** 2 / gap.maps[key] for name, key in zip(stages, keys, strict=True)}
        floor, on = gap.noise_floor, gap.on
    out.attrs["gap_on"] = on
    number = np.isfinite(squares[BEFORE]).sum(axis=(1, 2))
    known = np.where(number > 0, number, np.nan)
    for name, values in squares.items():
        mean = np.nansum(values, axis=(1, 2)) / known
        _put(
            out,
            f"gap_{name}",
            canvas.dims,
            canvas.spread(mean),
            "1",
            f"mean squared standardised residual {name}, on {on}",
        )
    _put(out, "gap_stderr", canvas.dims, canvas.spread(floor * np.sqrt(2 / known)), "1",
         "by how much noise alone makes the mean squared standardised residual scatter")  # fmt: skip
    _put(out, "gap_floor", (), float(floor), "1", "mean squared standardised residual where only noise is left")


def _add_candidates(out: xr.Dataset, found: Findings) -> None:
    """How far each effect alone, and each set that holds, explains what was seen."""
    if not found.evidence:
        return
    held = [own.names for own in found.explanations] if found.status in ("named", "ambiguous") else []
    rows: list[tuple[tuple[str, ...], float, float]]
    rows = [((name,), score, chi2) for name, (score, chi2) in found.evidence.items()]
    rows += [
        (own.names, own.score - found.base.score, own.refit.chi2) for own in found.explanations if len(own.names) > 1
    ]
    best = min(score for _, score, _ in rows)
    # A set that holds is not behind: its own first look may be, by what blocks blur.
    rows.sort(key=lambda row: (row[0] not in held, row[1]))
    blocks = int(found.look.problem.used.sum())
    excess = found.base.refit.chi2 - blocks
    closed = np.array([(found.base.refit.chi2 - chi2) / excess for _, _, chi2 in rows])
    if excess < CLEAR * np.sqrt(2 * blocks):
        closed[:] = np.nan
    best_set = set(held[0]) if held else set()
    role = [1 if names in held else 2 if len(names) == 1 and names[0] in best_set else 0 for names, _, _ in rows]
    dims = ("candidate",)
    texts = np.array([" + ".join(names) for names, _, _ in rows])
    out.coords["candidate"] = (dims, texts, {"units": "1", "long_name": "effect, or set of effects"})
    _put(out, "candidate_closed", dims, closed, "1", "part of the excess chi-square of the mean images that it closes")
    _put(out, "candidate_behind", dims, np.array([score - best for _, score, _ in rows]), "1",
         "-2 ln L, with 2 a free number, behind the best, at the first look")  # fmt: skip
    _put(
        out,
        "candidate_role",
        dims,
        np.array(role, "i1"),
        "1",
        "1: holds; 2: part of the best set that holds; 0: neither",
    )
    _put(out, "nothing_behind", (), float(-best), "1", "-2 ln L of the base model behind the best")
    _put(out, "tied", (), TIED, "1", "-2 ln L within which the data cannot tell two apart")


def _add_places(out: xr.Dataset, canvas: _Canvas, own: Grid) -> None:
    """z by condition and ring, and of all that is not the mean."""
    out.coords["ring"] = (
        "ring",
        np.arange(len(RINGS) - 1),
        {"units": "1", "long_name": "ring around the spot's centre"},
    )
    ends = np.where(np.isfinite(RINGS), RINGS, np.nan)
    _put(out, "ring_low", ("ring",), ends[:-1], "1", "inner radius in widths sigma_g")
    _put(out, "ring_high", ("ring",), ends[1:], "1", "outer radius in widths sigma_g; missing: open")
    dims = (*canvas.dims, "ring")
    _put(out, "z_radial", dims, canvas.spread(own.radial), "1", "z of the mean residual of a ring")
    _put(out, "z_azimuthal", dims, canvas.spread(own.azimuthal), "1", "z of the strongest azimuthal order of a ring")
    _put(out, "z_order", dims, canvas.spread(own.order.astype("i1"), 0), "1", "that order")
    _put(out, "z_threshold", (), own.threshold, "1", "z from which a bin stands out, all bins together")
    dims = ("bin",)
    bins = own.blocks
    for name, texts, long_name in (
        ("bin_block", [b.block for b in bins], "kind of trace"),
        ("bin_label", [_label(b) for b in bins], "what was looked at"),
    ):
        _put(out, name, dims, np.array(texts, dtype=str), "1", long_name)
    _put(out, "bin_z", dims, np.array([b.z for b in bins], float), "1", "z over all frames")


# Short names for an axis.
SHORT = {
    "fine structure that the exposures of a site share": "site",
    "fine structure that all sites share on the sensor": "sensor",
    "fine structure that goes with the spot": "spot",
    "rows of a frame": "rows, frame",
    "rows of the sensor": "rows, sensor",
    "columns of a frame": "columns, frame",
    "columns of the sensor": "columns, sensor",
    "hottest pixel": "hot pixel",
}


def _label(own: Bin) -> str:
    if own.quantity.startswith("level of light"):
        return f"{100 * (own.low or 0):.3g}–{100 * (own.high or 1):.3g} %"
    if own.quantity == "period":
        return f"{own.low:.2g}–{own.high:.2g} px"
    if own.quantity == "code of the converter":
        return f"code {own.low:.0f}"
    return SHORT.get(own.quantity, own.quantity.removeprefix("scatter of the ").removeprefix("scatter of "))
