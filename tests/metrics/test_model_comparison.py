"""The comparison of both models with the measured frames: held-out means, distances, and the table."""

import csv

import numpy as np
import pytest
import xarray as xr

from spotcheck.dataset.conditions import held_out_repeats
from spotcheck.metrics.model_comparison import METRICS, compare_models, comparison_csv, summarise_comparison

REPEATS = 6
ANGLES, EXPOSURES = (0.0, 90.0), (1e-4,)


def make_metrics(simulated: float) -> xr.Dataset:
    """Metrics whose measured values are 10, 11, … by repeat, and whose simulated ones are all alike."""
    grid, sizes = ("angle", "exposure", "repeat"), (len(ANGLES), len(EXPOSURES), REPEATS)
    measured = np.broadcast_to(10.0 + np.arange(REPEATS), sizes)
    both = np.stack([measured, np.full(sizes, simulated)])
    ds = xr.Dataset(coords={"angle": list(ANGLES), "exposure": list(EXPOSURES), "source": ["measured", "simulated"]})
    for name in ("maximum", "sum", "speckle_contrast"):
        ds[name] = (("source", *grid, "centring"), both[..., None])
    for name in ("amplitude", "sigma_mean"):
        ds[name] = (("source", *grid, "centring", "fit"), both[..., None, None])
    for name, values in (("psnr", both[1]), ("psnr_repeats", both[0])):
        ds[name] = ((*grid, "registration", "data_range"), values[..., None, None])
    labels = {"centring": "maximum", "fit": "least_squares", "registration": "maximum", "data_range": "container"}
    return ds.assign_coords({dim: [label] for dim, label in labels.items()})


@pytest.mark.parametrize(("repeats", "held_out"), [(5, []), (6, [2, 5]), (9, [2, 5, 8])])
def test_every_third_repeat_of_six_or_more_is_held_out(repeats, held_out):
    assert list(np.flatnonzero(held_out_repeats(np.arange(repeats)))) == held_out


def test_measured_means_are_those_of_held_out_repeats():
    """Repeats 2 and 5 read 12 and 15; the standard deviation is that of all six."""
    rows = compare_models(make_metrics(20.0), make_metrics(14.5))
    assert len(rows) == len(METRICS) * len(ANGLES)
    sd = np.std(10.0 + np.arange(REPEATS), ddof=1)
    for row in rows:
        assert (row.measured, row.declared, row.extended) == (13.5, 20.0, 14.5)
        assert row.measured_sd == pytest.approx(sd) and row.distances() == pytest.approx((6.5 / sd, 1.0 / sd))
    assert summarise_comparison(rows)["width_px"] == pytest.approx((6.5 / sd, 1.0 / sd))


def test_values_that_are_missing_leave_no_number():
    """Without any simulated value, or with one repeat, no distance is known; conditions without frames have no row."""
    declared, extended = make_metrics(20.0), make_metrics(np.nan)
    declared["maximum"][:, 0] = np.nan
    declared["psnr_repeats"][..., 1:, :, :] = np.nan
    rows = compare_models(declared, extended)
    assert sum(row.metric == "maximum_dn" for row in rows) == 1
    (psnr, *_) = (row for row in rows if row.metric == "psnr_db")
    assert psnr.measured == 10.0 and np.isnan(psnr.measured_sd) and np.isnan(psnr.distances()).all()
    assert np.isnan(summarise_comparison(rows)["sum_dn"]).all()


def test_the_table_can_be_read_again():
    """One line for each metric and condition, with an empty cell for what is unknown."""
    text = comparison_csv(compare_models(make_metrics(20.0), make_metrics(np.nan)))
    rows = list(csv.DictReader(text.splitlines()))
    assert rows[0] == {
        "metric": "psnr_db", "angle_deg": "0", "exposure_s": "0.0001", "measured": "13.5",
        "measured_sd": "1.87082869", "declared": "20", "extended": "",
    }  # fmt: skip
    assert {row["metric"] for row in rows} == set(METRICS.values())
    assert comparison_csv([]).count("\n") == 1
