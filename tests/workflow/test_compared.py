"""Several datasets side by side by the workflow: the call that the pages name."""

import json
import re

import pytest
import xarray as xr

from tests.conftest import planned, snakemake
from tests.report.test_comparison import flats_folder
from tests.rules.test_datasets import SAMPLE, plan

GAINS = {"before": 0.30, "after": 0.36}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Folder of results of two small datasets of flats, whose gains differ by 20 %, and what the run printed."""
    base = tmp_path_factory.mktemp("compared")
    folders = [flats_folder(base / name, gain, seed) for seed, (name, gain) in enumerate(GAINS.items(), start=1)]
    names = json.dumps([str(folder) for folder in folders])
    run = snakemake("compare", config={"datasets": names, "results": base / "out"})
    return base / "out", run


@pytest.mark.slow
def test_the_page_and_its_numbers_come_out(compared):
    """The gain is marked, every link leads to a report, and a second call has nothing to do."""
    out, run = compared
    assert run.returncode == 0, run.stdout + run.stderr
    with xr.open_dataset(out / "comparison.nc") as ds:
        assert ds["dataset"].values.tolist() == list(GAINS)
        own = ds.sel(quantity="overall gain, K", dataset="after")
        assert int(own["changed"]) == 1
        assert float(own["difference"]) == pytest.approx(0.06, abs=4 * float(own["difference_stderr"]))
        assert ds.attrs["inputs"].count("transfer.nc") == 2
    text = (out / "comparison.html").read_text(encoding="utf-8").split("<script")[0]
    links = re.findall(r'href="([^"#]+)"', text)
    assert links == [f"{name}/report.html" for name in GAINS] and all((out / link).exists() for link in links)
    names = json.dumps([str(out.parent / name) for name in GAINS])
    again = snakemake("compare", config={"datasets": names, "results": out})
    assert "Nothing to be done" in again.stdout + again.stderr


def test_a_run_of_all_does_not_ask_for_it(tmp_path):
    """Two datasets of spots: one comparison, by its name alone."""
    jobs = planned(plan([SAMPLE, SAMPLE.parent / "virtual-rig"], tmp_path / "out", "compare").stdout)
    assert (jobs["compare"], jobs["metrics"], jobs["report"]) == (1, 2, 2)
    assert "compare" not in planned(plan([SAMPLE, SAMPLE.parent / "virtual-rig"], tmp_path / "out").stdout)


def test_one_dataset_alone_ends_in_a_sentence(tmp_path):
    """It asks for a second one before any job."""
    run = plan([SAMPLE], tmp_path / "out", "compare")
    assert run.returncode != 0 and "Traceback" not in run.stderr
    said = [line for line in run.stderr.splitlines() if line.startswith("spotcheck: ")]
    assert said == [
        "spotcheck: config: zscan-sample is one dataset alone; name two or more to compare, as in"
        ' --config "datasets=[before, after]"'
    ]
