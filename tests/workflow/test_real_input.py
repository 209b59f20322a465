"""Frames that no rig of ours made: a HeNe beam at nine distances; and the small set that stands in for it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from PIL import Image

from spotcheck.fitting.crop_fits import select_preferred_fits
from tests.conftest import ROOT, SHARED, snakemake

pytestmark = pytest.mark.slow


def judged(folder: Path, root: Path, *targets: str) -> tuple[Path, Path]:
    """Folder and results of a z-scan."""
    run = snakemake(*targets, config={"dataset": folder, "results": root})
    assert run.returncode == 0, run.stdout + run.stderr
    return folder, root / folder.name


@pytest.fixture
def sample(sample_run):
    """All that is made of the sample."""
    return ROOT / "data" / "zscan-sample", sample_run


@pytest.fixture(scope="module")
def hene(tmp_path_factory):
    """Of the real beam what only its frames can show; skipped where the shared folder is not there."""
    folder = SHARED / "data" / "hene-zscan"
    if not folder.exists():
        pytest.skip(f"{folder.name}: the real frames are not on this machine")
    return judged(folder, tmp_path_factory.mktemp("hene"), "--until", "metrics", "caustic")


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.xdist_group(name)) for name in ("sample", "hene")])
def zscan(request):
    """Either."""
    return request.getfixturevalue(request.param)


@pytest.mark.xdist_group("sample")
def test_the_report_says_what_is_skipped_and_what_the_beam_is(sample):
    """Why there are no p1, p2 and bounds; waist, divergence and M², with a figure."""
    _, results = sample
    page = (results / "report.html").read_text()
    assert "p1 and p2 need exposure times, and the manifest gives none" in page
    for word in ("waist", "divergence", "M²"):
        assert word in page
    assert (results / "figures" / "caustic.svg").exists()


def test_without_exposures_there_are_fits_and_metrics(zscan):
    """Crops, fits and metrics come out of what has no exposure."""
    _, results = zscan
    with xr.open_dataset(results / "fits.nc") as fits, xr.open_dataset(results / "metrics.nc") as metrics:
        assert fits.sizes["z_m"] == 9 and fits["z_m"].attrs["units"] == "m"
        assert fits.attrs["not_recorded"] == "exposure"
        assert "exposure" not in fits.coords and fits.sizes["exposure"] == 1
        # Least squares needs no noise, which frames of 48 px do not tell.
        assert np.isfinite(select_preferred_fits(fits)["sigma_mean"]).all()
        assert np.isfinite(metrics["psnr"].sel(registration="fitted")).all()


def test_caustic(zscan):
    """The beam of made-with.yaml: both waists, where they lie, M² and direction, each within four standard errors (of
    nine numbers one in 2000 sets misses by chance). Of a real beam nobody knows them; it is no better than a Gaussian.
    """
    folder, results = zscan
    with xr.open_dataset(results / "caustic.nc") as estimates:
        # The estimator to quote is the first.
        caustic = estimates.isel(estimator=0)
        if not (folder / "made-with.yaml").exists():
            assert (caustic["m2"] + 3 * caustic["m2_stderr"]).min() > 1
            return
        assert caustic["beam"] == "simple astigmatic"
        want = {"waist_radius": (56e-6, 60e-6), "waist_position": (0.198, 0.204), "m2": (1.1, 1.1)}
        for name, values in want.items():
            own = caustic.sel(axis=["x", "y"])
            assert (abs(own[name] - values) < 4 * own[f"{name}_stderr"]).all(), name
        assert abs(float(caustic["azimuth"]) - 20) < 4 * float(caustic["azimuth_stderr"])
        assert np.isnan(caustic["m2"].sel(axis="mean"))


def test_one_stack_gives_equal_values(zscan, tmp_path):
    """The same frames as pages of one TIFF give the same crops and fits."""
    folder, results = zscan
    lines = (folder / "manifest.csv").read_text().splitlines()
    header, *rows = [line.split(",") for line in lines if not line.startswith("#")]
    copy = tmp_path / folder.name
    (copy / "frames").mkdir(parents=True)
    shutil.copy(folder / "instrument.yaml", copy)
    pages = [np.asarray(Image.open(folder / row[header.index("file")])) for row in rows]
    tifffile.imwrite(copy / "frames" / "all.tif", np.stack(pages))
    text = [",".join([*header, "page"])]
    for page, row in enumerate(rows):
        row[header.index("file")] = "frames/all.tif"
        text.append(",".join([*row, str(page)]))
    (copy / "manifest.csv").write_text("\n".join(text) + "\n")
    run = snakemake("--until", "fit", config={"dataset": copy, "results": tmp_path / "out"})
    assert run.returncode == 0, run.stdout + run.stderr
    for name in ("crops", "fits"):
        with (
            xr.open_dataset(results / f"{name}.nc") as one,
            xr.open_dataset(tmp_path / "out" / folder.name / f"{name}.nc") as other,
        ):
            xr.testing.assert_equal(one, other)
