"""The extended model in the default run: simulated, evaluated as the measured frames, and compared with them."""

import csv

import numpy as np
import pytest
import xarray as xr

from spotcheck.cli import main
from spotcheck.dataset.folder import load
from spotcheck.metrics.model_comparison import METRICS
from spotcheck.model.model_file import read_model


@pytest.fixture(scope="module")
def run(small_run):
    """Folder of the dataset and folder of its results."""
    return small_run.parents[1] / "small", small_run


def test_both_models_are_compared_with_the_measured_frames(run):
    """A line for each of six metrics in each condition, with finite numbers."""
    rows = list(csv.DictReader((run[1] / "model_comparison.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["metric"] for row in rows} == set(METRICS.values())
    for row in rows:
        assert all(np.isfinite(float(row[name])) for name in ("measured", "measured_sd", "declared", "extended"))


def test_the_simulated_folder_is_a_dataset(run, tmp_path, capsys):
    """With the measured design, in the sensor's own place; `check` and `ingest` take it."""
    dataset, results = run
    main(["check", str(results / "extended")])
    main(["ingest", str(results / "extended"), "--output", str(tmp_path / "frames.nc")])
    assert "18 spot" in capsys.readouterr().out
    assert [f.exposure_s for f in load(results / "extended").frames] == [f.exposure_s for f in load(dataset).frames]
    model = read_model(results / "model.yaml")
    # A site each, or without a law a frame each.
    assert (model.rows, model.columns, len(model.spots)) == (360, 400, 6 if model.law else 18)
    with xr.open_dataset(results / "extended.nc") as own, xr.open_dataset(results / "crops.nc") as crops:
        # Where the fits found the spot and where the light's centroid lies: within a few pixels.
        apart = own["left"] - crops["left"].sel(centring="light")
        assert abs(apart).max() < 10
        assert own["mean_reading"].sizes["y"] == 120
