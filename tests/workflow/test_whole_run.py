"""The whole workflow on a small dataset of the virtual rig."""

import hashlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import numpy as np
import pytest
import xarray as xr

from spotcheck.io import store
from tests.conftest import ROOT, environment, planned, snakemake


def test_everything_comes_out(small_run):
    """Report, figures, tables, notebooks and every intermediate result."""
    for name in ("report.html", "figures/index.json", "figures/fig06.svg", "docs/equations.html", "docs/symbols.html"):
        assert (small_run / name).stat().st_size > 0, name
    index = json.loads((small_run / "figures" / "index.json").read_text())
    papers = {f["paper"] for f in index["figures"]}
    wanted = {"5", "7", "8a", "8b", "8c", "9a", "9b", "10a", "10b", "11", "12", "13a", "13b"}
    assert {f"Fig. {n}" for n in wanted} <= papers
    for figure in index["figures"]:
        for suffix in ("svg", "png"):
            assert (small_run / "figures" / f"{figure['name']}.{suffix}").stat().st_size > 0
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        notebook = nbformat.read(small_run / "notebooks" / path.name, as_version=4)
        assert all(cell.get("execution_count") for cell in notebook.cells if cell.cell_type == "code")
    # The report links the page of every notebook; the page asks for nothing from the network when it is opened.
    report = (small_run / "report.html").read_text(encoding="utf-8")
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f'href="notebooks/{path.stem}.html"' in report
        page = (small_run / "notebooks" / f"{path.stem}.html").read_text(encoding="utf-8")
        assert not re.search(r'<(?:script|img)[^>]* src="(?!data:|")|<link[^>]* href="', page)


def test_second_call_has_nothing_to_do(small_run):
    """Nothing is left to be done, and nothing is done twice."""
    dataset = small_run.parents[1] / "small"
    run = snakemake(config={"dataset": dataset, "results": small_run.parent})
    assert run.returncode == 0
    assert "Nothing to be done" in run.stdout + run.stderr


def test_equal_inputs_give_equal_files(small_run, tmp_path):
    """Another run, on one core, gives every netCDF file and every frame byte by byte again; those of the verdict are
    held against each other in tests/discrepancy/test_equal_verdicts.py, on a set that is judged sooner."""
    dataset = small_run.parents[1] / "small"
    twin = tmp_path / "small"
    twin.mkdir()
    for name in ("manifest.csv", "instrument.yaml", "rig.yaml"):
        (twin / name).write_bytes((dataset / name).read_bytes())
    where = {"dataset": twin, "results": tmp_path / "results"}
    run = snakemake("--until", "metrics", "bounds", "precision", "--cores", "1", config=where)
    assert run.returncode == 0, run.stdout + run.stderr
    first, second = (sorted(p.rglob("*.tif")) for p in (dataset, twin))
    assert len(first) == 18
    assert [digest(p) for p in first] == [digest(p) for p in second]
    again = tmp_path / "results" / "small"
    names = [p.relative_to(again) for p in again.rglob("*.nc")]
    assert len(names) >= 9
    for name in names:
        assert digest(small_run / name) == digest(again / name), name


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_killed_job_leaves_the_old_result(small_frames, small_run, tmp_path):
    """SIGKILL in the middle of writing: the earlier file is untouched, and nothing half written bears its name."""
    target = tmp_path / "crops.nc"
    target.write_bytes(b"the earlier result")
    command = [Path(sys.executable).parent / "spotcheck", "crop", small_frames, "--frames", small_run / "frames.nc"]
    job = subprocess.Popen([*command, "--output", target], env=environment(), stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".*.part")) and time.monotonic() < deadline and job.poll() is None:
        time.sleep(0.002)
    job.send_signal(signal.SIGKILL)
    job.wait()
    assert job.returncode == -signal.SIGKILL, "the job ended before it could be killed"
    assert target.read_bytes() == b"the earlier result"


def test_intermediate_results_keep_the_contract(small_run):
    """Every netCDF file: units and long_name on everything, provenance in the attributes, axes as the contract says."""
    for path in small_run.rglob("*.nc"):
        with store.read(path) as ds:
            assert ds.attrs["code_version"]
            assert "inputs" in ds.attrs
    for name in ("crops", "fits", "simulated", "metrics"):
        with xr.open_dataset(small_run / f"{name}.nc") as ds:
            assert list(ds["angle"].values) == [0, 90]
            assert np.allclose(ds["exposure"].values, [1e-4, 5e-4, 9e-4])
            assert list(ds["repeat"].values) == [0, 1, 2]


@pytest.mark.parametrize(
    ("notebook", "parameters"),
    [
        ("spot", {"angle": 1, "exposure": 2, "repeat": 1}),
        ("calibration", {"angle": 1}),
        ("sensor", {"photons": 500.0, "exposure_s": 1e-3, "seed": 7}),
    ],
)
def test_notebooks_take_other_parameters(notebook, parameters, small_run, tmp_path):
    """Each notebook runs with parameters other than its defaults, and shows them."""
    given = {"dataset": small_run.parents[1] / "small", "results": small_run} | parameters
    command = [sys.executable, "-m", "papermill", ROOT / "notebooks" / f"{notebook}.ipynb", tmp_path / "out.ipynb"]
    command += ["-k", "python3", "--no-progress-bar"]
    for key, value in given.items():
        command += ["-p", key, str(value)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    assert run.returncode == 0, run.stderr
    executed = nbformat.read(tmp_path / "out.ipynb", as_version=4)
    injected = next(c.source for c in executed.cells if "injected-parameters" in c.metadata.get("tags", []))
    assert all(f"{key} = {value}" in injected for key, value in parameters.items())


@pytest.mark.slow
def test_default_dataset_is_planned_whole():
    """A dry run of the default dataset plans every stage once."""
    run = snakemake("--dry-run", "--forceall")
    assert run.returncode == 0, run.stdout + run.stderr
    jobs = planned(run.stdout + run.stderr)
    assert {"expose", "paper", "report", "extended", "tables"} <= set(jobs)
    assert jobs["notebook"] == len(list((ROOT / "notebooks").glob("*.ipynb")))
    assert all(n == 1 for name, n in jobs.items() if name != "notebook")
