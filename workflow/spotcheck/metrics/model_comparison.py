"""Compare the paper's six metrics of measured frames with those of frames simulated by two models.

The declared model is the paper's; the parameters of its width, p_b = p1 ln t + p2 over the exposure t, come from the
calibration. The extended model also has the effects that the verdict added. A condition is an angle, an exposure and
a value of each declared condition; a mean is over its repeats. Measured means are over held-out repeats if the dataset
has some: no effect was selected or fitted with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from spotcheck.dataset.conditions import held_out_repeats

# Columns of model_comparison.csv before and after those of conditions that the instrument declares.
FIRST_COLUMNS = ("metric", "angle_deg", "exposure_s")
LAST_COLUMNS = ("measured", "measured_sd", "declared", "extended")
# Variable of metrics.nc → name of the metric with its unit.
METRICS = {
    "psnr": "psnr_db",
    "speckle_contrast": "speckle_contrast",
    "maximum": "maximum_dn",
    "amplitude": "amplitude_dn",
    "sigma_mean": "width_px",
    "sum": "sum_dn",
}
# Dimension of metrics.nc → label of the paper's choice: crops around the maximum, not shifted for PSNR, fits by least
# squares, and PSNR for the range of the 16-bit container.
PAPER_CHOICE = {"centring": "maximum", "fit": "least_squares", "registration": "maximum", "data_range": "container"}


@dataclass(frozen=True)
class ComparedMetric:
    """A metric in one condition."""

    metric: str  # value of `METRICS`
    index: dict[str, int]  # position of the condition along each dimension of the grid but the repeat
    # Dimension → value: angle [degree], exposure [s] and declared conditions, without those that were not recorded.
    conditions: dict[str, float]
    # The values below are in the unit of the metric, NaN if unknown.
    measured: float  # mean over held-out measured repeats; over all if none is held out
    measured_sd: float  # standard deviation over all measured repeats (n − 1)
    declared: float  # mean over repeats simulated by the declared model
    extended: float  # mean over repeats simulated by the extended model

    def distances(self) -> tuple[float, float]:
        """Return how far declared and extended model are from the measured mean, in units of `measured_sd` [1].

        Both are NaN if the measured standard deviation is 0 or unknown.
        """
        if not self.measured_sd > 0:
            return np.nan, np.nan
        declared, extended = (abs(value - self.measured) for value in (self.declared, self.extended))
        return declared / self.measured_sd, extended / self.measured_sd


def compare_models(declared: xr.Dataset, extended: xr.Dataset) -> list[ComparedMetric]:
    """Return each metric in each condition, of measured frames and of both simulations.

    The PSNR of a model is that between measured and simulated frames. The measured PSNR is that between two measured
    repeats of a condition, which differ in speckle as a simulated frame does even if its model is true.

    Parameters
    ----------
    declared, extended : Dataset
        Contents of metrics.nc for the same measured frames; the simulated frames are those of the declared model in
        one, and of the extended model in the other.
    """
    rows = []
    for variable, metric in METRICS.items():
        # Values of measured frames, then of both simulations [grid..., and dimensions of `PAPER_CHOICE`].
        if variable == "psnr":
            series = [declared["psnr_repeats"], declared["psnr"], extended["psnr"]]
        else:
            sources = ((declared, "measured"), (declared, "simulated"), (extended, "simulated"))
            series = [ds[variable].sel(source=source) for ds, source in sources]
        choice = {dim: label for dim, label in PAPER_CHOICE.items() if dim in series[0].dims}
        measured, *simulated = (values.sel(choice).astype(float).where(np.isfinite) for values in series)
        # The position of a repeat on the grid is its number, which decides whether it is held out.
        is_held_out = held_out_repeats(np.arange(measured.sizes["repeat"]))
        # Mean over held-out repeats; over all in conditions where none of those has a value.
        measured_mean = measured.isel(repeat=is_held_out).mean("repeat").fillna(measured.mean("repeat"))
        statistics = (measured_mean, measured.std("repeat", ddof=1), *(values.mean("repeat") for values in simulated))
        for position in np.argwhere(measured_mean.notnull().values).tolist():
            index = dict(zip(map(str, measured_mean.dims), position, strict=True))
            # Dimensions without a coordinate were not recorded.
            conditions = {dim: float(declared[dim][k]) for dim, k in index.items() if dim in declared.coords}
            rows.append(
                ComparedMetric(metric, index, conditions, *(float(values.isel(index)) for values in statistics))
            )
    return rows


def summarise_comparison(rows: Sequence[ComparedMetric]) -> dict[str, tuple[float, float]]:
    """Return for each metric the mean distances of declared and extended model [1] over conditions; NaN if unknown.

    Distances are those of `ComparedMetric.distances`; conditions where they are NaN are left out.
    """
    summary = {}
    for metric in dict.fromkeys(row.metric for row in rows):
        distances = np.array([row.distances() for row in rows if row.metric == metric])
        known = distances[np.isfinite(distances).all(axis=1)]
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
