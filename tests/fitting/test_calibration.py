"""p1 and p2 from widths, averages over sites, the peak from maxima, and what is skipped with which reason."""

import numpy as np
import pytest
import xarray as xr

from spotcheck.crops.cropping import CENTRINGS
from spotcheck.dataset.instrument import Instrument, ModelChoice
from spotcheck.fitting.calibration import calibrate
from spotcheck.fitting.crop_fits import FITS, fit_crops, read_fit_in_crop, select_preferred_fits
from spotcheck.fitting.fit_results import NAMES
from spotcheck.fitting.width_law import WidthLaw, find_peak, fit_simulated_widths, regress_widths, render_spot
from spotcheck.io import store
from spotcheck.model.baseline import Baseline
from spotcheck.sensor import ReadingDistribution
from tests.samples.small_datasets import SENSOR, crops_of, gaussian, loaded, noisy

EXPOSURES = np.array([1e-4, 5e-4, 9e-4])


def test_regress_recovers_exact_widths():
    """Eqs. 7–8 backwards: widths on the line give p1 and p2 back, whatever the laser's own width."""
    p1, p2 = np.array([[2.48, 1.0], [0.0, -0.5]]), np.array([[34.55, 20.0], [9.0, 4.0]])
    width = p1[..., None] * np.log(EXPOSURES) + p2[..., None] + 1.19
    got = regress_widths(width, EXPOSURES, 1.19)
    np.testing.assert_allclose(got, [p1, p2], atol=1e-11)
    # Nothing subtracted: p2 takes the laser's width.
    np.testing.assert_allclose(regress_widths(width, EXPOSURES, 0.0)[1], p2 + 1.19, atol=1e-11)


def test_regress_is_the_straight_line_of_least_squares():
    """Slope and intercept by the textbook sums, on scattered widths with gaps."""
    width = np.random.default_rng(1).normal(15, 2, (6, 3))
    width[1, 0] = np.nan
    width[2, :2] = np.nan
    got = np.array(regress_widths(width, EXPOSURES, 1.0)).T
    for own, w in zip(got, width, strict=True):
        known = np.isfinite(w)
        if known.sum() < 2:
            assert np.isnan(own).all()
            continue
        u, v = np.log(EXPOSURES[known]), w[known] - 1.0
        slope = ((u - u.mean()) * (v - v.mean())).sum() / ((u - u.mean()) ** 2).sum()
        np.testing.assert_allclose(own, [slope, v.mean() - slope * u.mean()], rtol=1e-9)


def fits_of(width: np.ndarray, exposures=EXPOSURES, status=None) -> xr.Dataset:
    """A fits file [angle, exposure, repeat] with given widths by least squares, as `fit` would write it.

    The likelihood, which the file prefers, finds others: the paper's regression is of its own estimator.
    """
    dims = ("angle", "exposure", "repeat", "centring", "fit")
    ds = xr.Dataset(attrs={"title": "T", "dataset": "d", "not_recorded": "", "preferred": "likelihood"})
    ds["centring"] = ("centring", np.array(CENTRINGS, dtype=object))
    ds["fit"] = ("fit", np.array(list(FITS), dtype=object))
    if exposures is not None:
        ds["exposure"] = ("exposure", exposures)
    state = np.zeros(width.shape, "i4") if status is None else status
    # In the order of `FITS`: likelihood, least squares.
    for name, both in (("sigma_mean", (3 * width + 1, width)), ("status", (np.zeros_like(state), state))):
        ds[name] = (dims, np.repeat(np.stack(both, -1)[..., None, :], 2, -2))
    return ds


def empty_crops(shape) -> xr.Dataset:
    """Crops without a usable pixel: the averages need none."""
    ds = xr.Dataset()
    ds["centring"] = ("centring", np.array(CENTRINGS, dtype=object))
    dims = ("angle", "exposure", "repeat", "centring")
    ds["status"] = (dims, np.full((*shape, 2), store.flag("missing"), "i4"))
    ds["image"] = ((*dims, "y", "x"), np.full((*shape, 2, 8, 8), np.nan))
    return ds


def test_averages_over_repeats_angles_and_sites():
    """Means and standard deviations (n − 1), each taken again from the sites' own p1 and p2."""
    rng = np.random.default_rng(3)
    p = rng.normal([[[2.5, 34.0]]], [[[0.3, 1.2]]], (4, 5, 2))  # angle, repeat, (p1, p2)
    width = p[:, None, :, 0] * np.log(EXPOSURES)[None, :, None] + p[:, None, :, 1]
    width[2, :, 4] = np.nan  # a site without fits
    ds = calibrate(empty_crops(width.shape), fits_of(width), Instrument(), None).sel(estimator="regression")
    p[2, 4] = np.nan
    for name, values in zip(("p1", "p2"), np.moveaxis(p, -1, 0), strict=True):
        by_angle, sd = np.nanmean(values, axis=1), np.nanstd(values, ddof=1)
        for suffix, want in (
            ("", values), ("_mean", np.nanmean(values)), ("_sd_all", sd), ("_stderr", sd / np.sqrt(19)),
            ("_by_angle", by_angle), ("_sd_repeats", np.nanstd(values, axis=1, ddof=1)),
            ("_sd_angles", np.std(by_angle, ddof=1)),
        ):  # fmt: skip
            np.testing.assert_allclose(ds[name + suffix], want, rtol=1e-9, err_msg=suffix)
    assert np.isnan(ds["peak"]) and int(ds["likelihood_converged"]) == 0


@pytest.mark.parametrize("name", ["not_converged", "at_limit", "black", "saturated"])
def test_flagged_widths_are_left_out(name):
    """A fit with a flag that forbids trust does not enter p1 and p2."""
    width = np.full((1, 3, 2), 10.0) + np.log(EXPOSURES)[None, :, None]
    width[0, 0, 1] = 90.0
    status = np.zeros(width.shape, "i4")
    status[0, 0, 1] = store.flag(name)
    ds = calibrate(empty_crops(width.shape), fits_of(width, status=status), Instrument(), None)
    np.testing.assert_allclose(ds["p1"].sel(estimator="regression"), [[1.0, 1.0]], rtol=1e-9)


SKIPPED = {
    "blank exposures": (fits_of(np.ones((1, 1, 2)), None), Instrument(), "need exposure times"),
    "one exposure": (fits_of(np.ones((1, 1, 2)), EXPOSURES[:1]), Instrument(), "two exposures or more"),
    "one usable": (fits_of(np.array([[[9.0], [np.nan], [np.nan]]])), Instrument(), "two exposures or more"),
    "free": (fits_of(np.ones((1, 3, 2))), Instrument(model=ModelChoice("free")), "photon_budget is free"),
}


@pytest.mark.parametrize(("fits", "given", "reason"), SKIPPED.values(), ids=SKIPPED)
def test_what_the_design_does_not_support_is_skipped_with_its_reason(fits, given, reason):
    """The reason stands in the attributes, and the file holds no number."""
    ds = calibrate(empty_crops(fits["status"].shape[:3]), fits, given, None)
    assert reason in ds.attrs["skipped"] and not ds.data_vars


@pytest.mark.parametrize("top_hat", [False, True])
@pytest.mark.parametrize("sensor", [None, SENSOR])
def test_peak_from_maxima_round_trip(top_hat, sensor):
    """Maxima of the model itself give its peak back; the shorter half of the exposures has no say."""
    own, side = Baseline(1.19, "spot_area", top_hat, 9e-4), 120
    maxima = []
    for t in EXPOSURES:
        light = render_spot(own, WidthLaw(2.48, 34.55, 700.0), t, side)
        maxima.append(ReadingDistribution(sensor, t).expected_maximum(light) if sensor else light.max())
    args = own, 2.48, 34.55, EXPOSURES
    # xtol of the root is 1e-3 DN.
    assert find_peak(*args, maxima, sensor, side) == pytest.approx(700, abs=0.01)
    assert find_peak(*args, [5.0, *maxima[1:]], sensor, side) == pytest.approx(700, abs=0.01)


def test_maxima_at_full_scale_say_nothing():
    """Left out; when all are, there is no peak."""
    own = Baseline(0.0, "linear", False, 9e-4)
    args = own, 0.6, 10.0, EXPOSURES
    assert np.isnan(find_peak(*args, [1023.0] * 3, SENSOR, 60))
    assert np.isnan(find_peak(*args, [np.nan] * 3, SENSOR, 60))
    assert np.isfinite(find_peak(*args, [300.0, 1023.0, 1023.0], SENSOR, 60))


@pytest.mark.parametrize("top_hat", [False, True])
def test_simulate_and_fit_misses_its_input_under_a_top_hat_only(top_hat):
    """Without a top hat the fit of a mean image returns σ_g; with it, some 4 % more (Eqs. 39–40)."""
    own = Baseline(1.19, "spot_area", top_hat, 9e-4)
    got = fit_simulated_widths(own, WidthLaw(2.48, 34.55, 700.0), EXPOSURES, 240)
    want = (2.48 * np.log(EXPOSURES) + 34.55 + 1.19) * (1.043 if top_hat else 1.0)
    # Steps of 1e-6 of a width; with the top hat, the third digit of 1.043 and the grid of its rim.
    np.testing.assert_allclose(got, want, rtol=3e-3 if top_hat else 1e-5)


def test_the_whole_stage_on_frames_of_the_model(tmp_path):
    """Ingest, crop, fit, calibrate: regression and likelihood return p1, p2 and the peak within 4 standard errors."""
    p1, p2, peak = 0.6, 10.0, 700.0
    sigma = p1 * np.log(EXPOSURES) + p2
    amplitude = peak * (EXPOSURES / sigma**2) / (EXPOSURES / sigma**2)[-1]
    spots = zip(EXPOSURES, amplitude, sigma, strict=True)
    images = [noisy(gaussian(110, a, 52.4, 58.7, s), k, SENSOR, t) for k, (t, a, s) in enumerate(spots)]
    sheet = "crop_px: 60\nsensor: {bit_depth: 10, black_level_dn: 40}"
    ds = loaded(tmp_path / "d", images, sheet, EXPOSURES.tolist())
    crops = crops_of(ds)
    fits = fit_crops(crops, SENSOR)
    out = calibrate(crops, fits, ds.instrument, SENSOR)
    cell = {"angle": 0, "exposure": 2, "repeat": 0, "centring": 0}
    for k in range(len(FITS)):
        again, stored = read_fit_in_crop(fits.isel(fit=k), crops, cell), fits.isel(cell | {"fit": k})
        shift = np.zeros(8)
        shift[1], shift[2] = int(crops["left"].isel(cell)), int(crops["top"].isel(cell))
        np.testing.assert_allclose(again.value + shift, [float(stored[n]) for n in NAMES], rtol=1e-12)
        np.testing.assert_array_equal(again.stderr, [float(stored[f"{n}_stderr"]) for n in NAMES])
        assert (again.chi2_reduced, again.status) == (float(stored["chi2_reduced"]), int(stored["status"]))
    flat = fit_crops(crops, SENSOR, top_hat=True)
    # The instrument's top hat is in the likelihood; the paper's estimator fits a Gaussian to whatever it sees.
    xr.testing.assert_identical(flat.sel(fit="least_squares"), fits.sel(fit="least_squares"))
    assert (np.abs(flat["sigma_mean"] / fits["sigma_mean"] - 1).sel(fit="likelihood") > 0.01).all()
    store.check(fits, "fits")
    store.check(out, "calibration")
    for name, want in (("x_centre", 52.4), ("y_centre", 58.7), ("sigma_mean", sigma[2]), ("amplitude", peak)):
        at = fits.isel(angle=0, exposure=2, repeat=0).sel(centring="light")
        assert (np.abs(at[name] - want) < 4 * at[f"{name}_stderr"]).all()
    xr.testing.assert_identical(select_preferred_fits(fits), fits.sel(centring="light", fit="likelihood"))
    joint = out.sel(estimator="likelihood")
    assert int(out["likelihood_converged"]) == 1
    for name, want in (("p1", p1), ("p2", p2)):
        assert abs(float(joint[f"{name}_mean"]) - want) < 4 * float(joint[f"{name}_stderr"])
    # One site: the regression has no scatter to take an error from; its error follows from that of the widths.
    error = fits["sigma_mean_stderr"].sel(centring="light", fit="least_squares").values.ravel()
    u = np.log(EXPOSURES)
    weight = (u - u.mean()) / ((u - u.mean()) ** 2).sum()
    assert abs(float(out["p1_mean"].sel(estimator="regression")) - p1) < 4 * np.sqrt((weight**2 * error**2).sum())


def test_fits_of_a_sensor_that_is_unknown_and_of_an_empty_frame(tmp_path):
    """Least squares alone, preferred, with the reason in the other's flags; no fit of a frame without light."""
    dark = np.full((110, 110), 40, np.uint16)
    ds = loaded(tmp_path / "d", [noisy(gaussian(110, 600.0, 52.4, 58.7, 6.0), 1), dark], "crop_px: 60")
    crops = crops_of(ds)
    fits = store.check(fit_crops(crops, None), "fits")
    cell = {"angle": 0, "exposure": 0, "repeat": 0, "centring": 0}
    assert read_fit_in_crop(fits.sel(fit="likelihood"), crops, cell) is None
    assert read_fit_in_crop(fits.sel(fit="least_squares"), crops, cell | {"repeat": 1}) is None
    known = read_fit_in_crop(fits.sel(fit="least_squares"), crops, cell)
    assert known.value[7] == pytest.approx(6.0, abs=0.05) and np.isnan(known.chi2_reduced) and known.status == 0
    assert fits.attrs["preferred"] == "least_squares" and select_preferred_fits(fits)["fit"].item() == "least_squares"
    assert (fits["status"].sel(fit="likelihood") & store.flag("no_noise")).all()
    assert not (fits["status"].sel(fit="least_squares") & store.flag("no_noise")).any()
    assert np.isnan(fits["sigma_mean"].sel(fit="likelihood")).all()
