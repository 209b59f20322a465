"""Scatter against bound, and the best exposure: synthetic fits whose scatter is known, and limits with closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.calibration import SIMULATION_ESTIMATOR
from spotcheck.fitting.fit_results import NAMES
from spotcheck.fitting.precision import (
    BOUND_TOLERANCE,
    SCATTERED,
    compute_frame_bounds,
    compute_precision,
    pool_ratios,
    summarize_precision,
)
from spotcheck.fitting.spot_bounds import spot_bounds
from spotcheck.io import store
from spotcheck.model.baseline import Baseline
from spotcheck.sensor import SensorModel

SENSOR = SensorModel(0.11, 13.0, 70.0, full_scale_dn=1023.0)
EXPOSURES = np.array([1e-4, 5e-4, 9e-4])
FRAMES = 200


def fits_of(excess: float, frames: int = FRAMES, flagged: int = 0) -> xr.Dataset:
    """Fits over exposure and repeat whose values scatter by `excess` times their standard errors."""
    rng = np.random.default_rng(4)
    ds = xr.Dataset(
        coords={"exposure": ("exposure", EXPOSURES, {"units": "s"}), "repeat": np.arange(frames)},
        attrs={"title": "t", "dataset": "d", "not_recorded": "", "preferred": "likelihood"},
    )
    shape, dims = (3, frames, 1, 1), ("exposure", "repeat", "centring", "fit")
    for k, name in enumerate(NAMES):
        error = np.full(shape, 0.01 * (k + 1))
        ds[name] = (dims, 10.0 + excess * error * rng.standard_normal(shape))
        ds[f"{name}_stderr"] = (dims, error)
    status = np.zeros(shape, int)
    status[:, :flagged] = store.flag("not_converged")
    for name in NAMES:
        ds[name][:, :flagged] = 1e6
    ds["status"] = (dims, status)
    return ds.assign_coords(centring=["light"], fit=["likelihood"])


def calibration_of(p1: float, p2: float, peak: float) -> xr.Dataset:
    """A calibration with these three numbers."""
    values = {"p1_mean": p1, "p2_mean": p2, "peak": peak}
    data = {name: ("estimator", [value]) for name, value in values.items()}
    return xr.Dataset(data, {"estimator": [SIMULATION_ESTIMATOR]})


def found(excess=(1.0, 1.0), sensor=SENSOR, calibration=None, **options) -> xr.Dataset:
    fits = dict(zip(("measured", "simulated"), (fits_of(e, **options) for e in excess), strict=True))
    if calibration is None:
        calibration = calibration_of(0.5, 16.0, 900.0)
    return compute_precision(fits, calibration, Instrument(), EXPOSURES, sensor, 141)


def test_ratio_is_the_excess_of_the_scatter():
    """A ratio from n frames has a relative standard error of 1/√(2(n − 1)); five of it: false alarm 6e-7 each of 42."""
    ds = found(excess=(3.0, 1.0))
    for source, want in (("measured", 3.0), ("simulated", 1.0)):
        limit = 5 / np.sqrt(2 * (FRAMES - 1))
        np.testing.assert_allclose(ds[f"ratio_{source}"], want, rtol=limit)
        np.testing.assert_allclose(ds[f"ratio_stderr_{source}"], ds[f"ratio_{source}"] / np.sqrt(2 * (FRAMES - 1)))
        np.testing.assert_allclose(ds[f"scatter_{source}"] / ds[f"bound_{source}"], ds[f"ratio_{source}"])
        assert list(ds["parameter"].values) == list(SCATTERED)
        pooled, error = pool_ratios(ds, source, "sigma_mean")
        assert error == pytest.approx(pooled / np.sqrt(2 * 3 * (FRAMES - 1)))
        assert pooled == pytest.approx(want, abs=5 * error)


def test_fits_that_are_not_to_be_trusted_do_not_count():
    """Their values are far off here, so that one of them would be seen at once."""
    ds = found(flagged=3)
    assert (ds["frames_measured"] == FRAMES - 3).all()
    assert float(ds["ratio_measured"].max()) < 2


def test_one_frame_has_no_scatter():
    """With a single repeat nothing scatters: ratios are NaN, and the sentence does not speak of them."""
    ds = found(frames=1)
    assert np.isnan(ds["ratio_measured"]).all()
    assert np.isnan(pool_ratios(ds, "measured", "sigma_mean")).all()
    assert "scatter" not in summarize_precision(ds) and "One frame" in summarize_precision(ds)


def test_unknown_noise_and_no_law_are_said():
    """Without a sensor the stage is skipped; without a law in t only the design is left out."""
    assert "gain and read noise" in found(sensor=None).attrs["skipped"]
    ds = found(calibration=xr.Dataset(attrs={"skipped": "no exposure times"}))
    assert ds.attrs["no_design"].endswith("no exposure times") and "best_exposure" not in ds
    assert summarize_precision(ds).startswith("Measured widths scatter")


def test_frame_bounds_against_the_closed_form():
    """Shot noise alone, N electrons, no background: var A = 2A²/N, var x = σ²/N, var σ = σ²/4N.

    A free offset costs a little: the closed form, for which it is known, lies below; far pixels without an electron
    settle it, so the two agree to 1 %.
    """
    sensor = SensorModel(5.0, 0.0)
    amplitude, sigma = 20000.0, 6.0
    got = compute_frame_bounds(Baseline(0.0, "linear", False, 1.0), amplitude, sigma, 1.0, sensor, 121)
    electrons = 2 * np.pi * sigma**2 * amplitude / 5.0
    want = [amplitude * np.sqrt(2 / electrons), *(2 * [sigma / np.sqrt(electrons)]), sigma / np.sqrt(4 * electrons)]
    np.testing.assert_allclose(got[:4], want, rtol=0.01)


@pytest.mark.parametrize("top_hat", [False, True])
@pytest.mark.parametrize("full_scale", [1023.0, 400.0])
def test_frame_bounds_are_those_of_a_round_spot(top_hat, full_scale):
    """Those of `spot_bounds`, which fits reach, clipped (400 DN) or not; the mean width is that of a round spot."""
    baseline, sensor = Baseline(0.0, "linear", top_hat, 1e-3), replace(SENSOR, full_scale_dn=full_scale)
    got = compute_frame_bounds(baseline, 600.0, 9.0, 1e-3, sensor, 101)
    spot = spot_bounds(sensor, (101, 101), amplitude=600.0, sigma_major=9.0, exposure_s=1e-3, top_hat=top_hat)
    np.testing.assert_allclose(got, [spot.amplitude, spot.x_centre, spot.y_centre, spot.sigma_mean, spot.offset], 1e-6)


def test_the_bound_stops_falling_where_the_sensor_saturates():
    """Linear budget: the bound on the width falls while light grows, and no longer once the core reads full scale.

    Peak 900 DN at 900 µs, full scale 1023 DN: the best exposure lies beyond 900 µs, and from little above on nothing is
    gained; without a converter's end the longest exposure is the best.
    """
    ds = found()
    best, enough = float(ds["best_exposure"]), float(ds["enough_exposure"])
    fine, bound = ds["fine_exposure"].values, ds["sigma_bound_over_fine_exposure"].values
    assert 9e-4 < best < 3.6e-3 and enough <= best
    assert (np.diff(bound[fine < 8e-4]) < 0).all()
    assert bound[-1] > bound.min()
    assert (bound[fine < enough] > (1 + BOUND_TOLERANCE) * bound.min()).all()
    endless = found(sensor=replace(SENSOR, full_scale_dn=np.inf))
    assert float(endless["best_exposure"]) == pytest.approx(3.6e-3)
    assert "the longest that was looked at" in summarize_precision(endless)
