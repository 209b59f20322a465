"""Compare the paper's six metrics of measured frames with those of frames simulated by two models.

The declared model is the paper's, with p1 and p2 of the calibration. The extended model has the effects that the
verdict added. A mean is that over the repeats of a condition. Measured means are those of held-out repeats if the
dataset has some, so that nothing was selected or fitted by them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from spotcheck.dataset.conditions import held_out_repeats

# Columns before and after those of conditions that the instrument declares.
FIRST_COLUMNS = ("metric", "angle_deg", "exposure_s")
LAST_COLUMNS = ("measured", "measured_sd", "declared", "extended")
# Variable of metrics.nc → name of the metric with its unit; PSNR is that of crops around the maximum in the range of
# the container, and the fit is that of least squares, as in the paper.
METRICS = {
    "psnr": "psnr_db",
    "speckle_contrast": "speckle_contrast",
    "maximum": "maximum_dn",
    "amplitude": "amplitude_dn",
    "sigma_mean": "width_px",
    "sum": "sum_dn",
}
PAPER_CHOICE = {
    "centring": "maximum",
    "fit": "least_squares",
    "registration": "maximum",
    "data_range": "container",
}


@dataclass(frozen=True)
class ComparedMetric:
    """A metric in one condition."""

    metric: str  # value of `METRICS`
    conditions: dict[
        str, float
    ]  # angle [degree], exposure [s] and declared conditions that were recorded, by dimension
    measured: float  # mean over held-out measured repeats, or over all
    measured_sd: float  # standard deviation over all measured repeats (n − 1)
    declared: float  # mean over repeats simulated by the declared model
    extended: float  # mean over repeats simulated by the extended model

    def distances(self) -> tuple[float, float]:
        """Return how far declared and extended model are from the measured mean, in standard deviations of repeats."""
        if not self.measured_sd > 0:
            return np.nan, np.nan
        declared, extended = (abs(value - self.measured) for value in (self.declared, self.extended))
        return declared / self.measured_sd, extended / self.measured_sd


def compare_models(declared: xr.Dataset, extended: xr.Dataset) -> list[ComparedMetric]:
    """Return each metric in each condition, of measured frames and of both simulations.

    PSNR compares a simulated frame with the measured one. Its measured values compare repeats of a condition, since new
    speckle lowers PSNR even for a true model.

    Parameters
    ----------
    declared, extended : Dataset
        metrics.nc of the measured frames with those of the declared and of the extended model.
    """
    rows = []
    for variable, metric in METRICS.items():
        if variable == "psnr":
            series = (declared["psnr_repeats"], declared["psnr"], extended["psnr"])
        else:
            series = (
                declared[variable].sel(source="measured"),
                declared[variable].sel(source="simulated"),
                extended[variable].sel(source="simulated"),
            )
        values = [_choose_as_paper(values) for values in series]
        dims = [str(dim) for dim in values[0].dims if dim != "repeat"]
        for index in _iterate_conditions(values[0], dims):
            measured, *simulated = (array.isel(index).values.astype(float) for array in values)
            is_held_out = held_out_repeats(np.arange(len(measured)))
            tested = measured[is_held_out] if np.isfinite(measured[is_held_out]).any() else measured
            conditions = {dim: float(declared[dim][k]) for dim, k in index.items() if dim in declared.coords}
            means = (_finite_mean(sample) for sample in simulated)
            rows.append(ComparedMetric(metric, conditions, _finite_mean(tested), _finite_sd(measured), *means))
    return rows


def summarise_comparison(rows: Sequence[ComparedMetric]) -> dict[str, tuple[float, float]]:
    """Return the mean distance over conditions of declared and extended model, by metric; NaN if it is unknown."""
    distances: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        distances.setdefault(row.metric, []).append(row.distances())
    summary = {}
    for metric, pairs in distances.items():
        known = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
        summary[metric] = (float(known[:, 0].mean()), float(known[:, 1].mean())) if len(known) else (np.nan, np.nan)
    return summary


def comparison_csv(rows: Sequence[ComparedMetric]) -> str:
    """Return model_comparison.csv: one line for each metric and condition; an unknown value is empty."""
    others = list(dict.fromkeys(dim for row in rows for dim in row.conditions if dim not in ("angle", "exposure")))
    lines = [",".join([*FIRST_COLUMNS, *others, *LAST_COLUMNS])]
    for row in rows:
        conditions = [row.conditions.get(dim, np.nan) for dim in ("angle", "exposure", *others)]
        numbers = [*conditions, row.measured, row.measured_sd, row.declared, row.extended]
        lines.append(",".join([row.metric, *("" if np.isnan(number) else f"{number:.9g}" for number in numbers)]))
    return "\n".join(lines) + "\n"


def _choose_as_paper(values: xr.DataArray) -> xr.DataArray:
    """Return the values on the grid alone, with `PAPER_CHOICE` along all other dimensions."""
    return values.sel({dim: label for dim, label in PAPER_CHOICE.items() if dim in values.dims})


def _iterate_conditions(values: xr.DataArray, dims: Sequence[str]) -> Iterator[dict[str, int]]:
    """Yield the index of each condition with a measured frame."""
    for position in np.ndindex(*(values.sizes[dim] for dim in dims)):
        index = dict(zip(dims, position, strict=True))
        if np.isfinite(values.isel(index)).any():
            yield index


def _finite_mean(sample: np.ndarray) -> float:
    """Return the mean of the finite values [repeat]; NaN without any."""
    finite = sample[np.isfinite(sample)]
    return float(finite.mean()) if finite.size else np.nan


def _finite_sd(sample: np.ndarray) -> float:
    """Return the standard deviation (n − 1) of the finite values [repeat]; NaN of fewer than two."""
    finite = sample[np.isfinite(sample)]
    return float(finite.std(ddof=1)) if finite.size > 1 else np.nan
