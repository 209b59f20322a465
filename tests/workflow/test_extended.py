"""The extended model by the workflow: model.yaml comes with the verdict, and one target simulates it."""

import shutil

import pytest
import xarray as xr

from spotcheck.cli import main
from spotcheck.dataset.folder import load
from spotcheck.model.model_file import read_model
from tests.conftest import planned, snakemake

# One copy of the small run serves all.
pytestmark = pytest.mark.xdist_group("extended")


@pytest.fixture(scope="module")
def run(small_run, tmp_path_factory):
    """A copy of the small run, with the target on top; where the dataset lies, results, and what was planned."""
    root, dataset = tmp_path_factory.mktemp("extended"), small_run.parents[1] / "small"
    shutil.copytree(small_run, root / "small")
    where = {"dataset": dataset, "results": root}
    plan = snakemake("extended", "--dry-run", config=where)
    done = snakemake("extended", config=where)
    assert done.returncode == 0, done.stdout + done.stderr
    return dataset, root / "small", planned(plan.stdout + plan.stderr)


def test_it_comes_after_the_verdict_and_nothing_waits_for_it(run):
    """The whole run leaves model.yaml; the target adds one job, and the whole run does not ask for it."""
    dataset, results, plan = run
    assert plan == {"simulate_extended": 1, "extended": 1}
    assert (results / "model.yaml").exists()
    whole = snakemake("--dry-run", "--forceall", config={"dataset": dataset, "results": results.parent})
    assert "simulate_extended" not in planned(whole.stdout + whole.stderr)


def test_the_simulated_folder_is_a_dataset(run, tmp_path, capsys):
    """With the measured design, in the sensor's own place; `check` and `ingest` take it."""
    dataset, results, _ = run
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
