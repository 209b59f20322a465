"""Invariants of what a whole run built. As a scorer, this file may read what the rig put in."""

import csv
import json

import numpy as np
import pytest
import tifffile
import xarray as xr

from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.dataset.instrument import RESERVED
from spotcheck.io import store
from spotcheck.metrics.crop_metrics import PER_IMAGE
from spotcheck.sensor import ReadingDistribution


@pytest.fixture(scope="module")
def opened(small_run):
    """The netCDF results by name."""
    return {path.stem: xr.load_dataset(path) for path in small_run.glob("*.nc")}


@pytest.fixture(scope="module")
def rows(small_run):
    """Rows of the manifest."""
    return list(csv.DictReader((small_run.parents[1] / "small" / "manifest.csv").read_text().splitlines()))


def place(row) -> dict:
    """Labels of a row on the grid."""
    return {"angle": float(row["angle_deg"]), "exposure": float(row["exposure_s"]), "repeat": int(row["repeat"])}


def test_crops_are_cut_from_the_frames(opened, rows, small_run):
    """Each crop holds the very pixels of its frame at the place that it claims; row means are those of the frame."""
    for row in rows:
        frame = tifffile.imread(small_run.parents[1] / "small" / row["file"])
        crop = opened["crops"].sel(place(row))
        for centring in ("light", "maximum"):
            own = crop.sel(centring=centring)
            top, left = int(own["top"]), int(own["left"])
            image = own["image"].values
            part = frame[max(top, 0) : top + 120, max(left, 0) : left + 120]
            assert np.array_equal(image[np.isfinite(image)], part.ravel())
        assert np.allclose(crop["row_mean"].values, frame.mean(axis=1), rtol=1e-6)
        assert np.allclose(crop["column_mean"].values, frame.mean(axis=0), rtol=1e-6)


def test_maximum_sits_where_the_paper_puts_it(opened):
    """The pixel at (side/2, side/2) of a crop at the maximum is the largest, and none left of it is equal."""
    images = opened["crops"]["image"].sel(centring="maximum").values.reshape(-1, 120, 120)
    for image in images:
        assert image[60, 60] == np.nanmax(image)
        assert not (image[:, :60] == image[60, 60]).any()
        assert not (image[:60, 60] == image[60, 60]).any()


def test_fitted_centres_lie_where_the_rig_put_the_spots(opened, small_run):
    """Within 2 px: speckle of half a width's contrast moves the centroid of some ten grains a side by about 1 px."""
    truth = json.loads((small_run.parents[1] / "small" / "truth.json").read_text())
    fits = opened["fits"].sel(centring="light")
    assert len(truth["sites"]) == 6
    for site in truth["sites"]:
        own = fits.sel(angle=site["angle_deg"], repeat=int(site["repeat"]))
        assert np.allclose(own["x_centre"], site["x_px"], atol=2)
        assert np.allclose(own["y_centre"], site["y_px"], atol=2)


def test_psnr_ranges_differ_by_their_ratio(opened):
    """20 log10(65535/1023) = 36.13 dB between the two data ranges, for every frame and registration."""
    psnr = opened["metrics"]["psnr"]
    gain = psnr.sel(data_range="container") - psnr.sel(data_range="sensor")
    assert np.allclose(gain, 20 * np.log10(65535 / 1023))


def test_simulated_frames_have_the_mean_and_variance_of_the_model(opened, small_run):
    """Standardised residuals of all simulated pixels: mean 0 ± 5/√n and mean square 1 ± 2 %.

    n = 18 · 120² = 2.6e5; five standard errors are a false alarm in 2e6. The 2 % is for the skewness of few electrons.
    """
    with store.read(small_run / "sensor.nc") as ds:
        sensor = read_sensor_model(ds)
    simulated = opened["simulated"]
    stack = tifffile.imread(small_run / "simulated" / "frames" / "simulated.tif").astype(float)
    residuals = []
    manifest = list(csv.DictReader((small_run / "simulated" / "manifest.csv").read_text().splitlines()))
    for row in manifest:
        page = stack[int(row["page"])]
        side = page.shape[0] // 4
        light = simulated["mean_light"].sel(place(row)).values.astype(float)
        distribution = ReadingDistribution(sensor, exposure_s=float(row["exposure_s"]))
        moments = distribution.tabulate(light.max()).moments(light)
        inner = page[side : side + 120, side : side + 120]
        residuals.append((inner - moments.mean) / np.sqrt(moments.variance))
    z = np.concatenate([r.ravel() for r in residuals])
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert z.var() == pytest.approx(1, abs=0.02)


def test_every_frame_is_recorded(opened, rows):
    """One row of frames.nc a row of the manifest, with digests of 64 hex digits."""
    table = opened["frames"]
    assert list(table["file"].values) == [row["file"] for row in rows]
    assert all(len(str(d)) == 64 for d in table["sha256"].values)
    assert (table["maximum"] <= 1023).all()


def test_no_condition_can_bear_the_name_of_a_variable(opened):
    """Names in the files that have the grid's dimensions are refused as conditions, by the instrument file's reader or,
    of metrics, by `metrics`; derived names follow from these."""
    derived = ("_stderr", "_mean", "_sd", "_by_angle", "_sd_all", "_sd_angles", "_sd_repeats", "_miss")
    taken = RESERVED | {metric.name for metric in PER_IMAGE}
    for name in ("crops", "fits", "calibration", "simulated", "metrics"):
        own = {str(v) for v in (*opened[name].variables, *opened[name].dims)}
        assert {v for v in own if v == "sigma_mean" or not v.endswith(derived)} <= taken, name
