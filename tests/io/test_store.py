"""The netCDF contract, on write and on read; whole files or none; equal inputs, equal bytes."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from spotcheck.dataset import folder as dataset
from spotcheck.errors import InputError
from spotcheck.io import store
from tests.samples.small_datasets import ROOT, folder

ROWS = ["frames/a.tif,spot,0,1e-4,0", "frames/b.tif,spot,90,9e-4,1"]
VARIABLES = {
    "image": store.Variable(("y",), "f4", "DN", "some pixels"),
    "top": store.Variable((), "i4", "pixel", "a place"),
    "status": store.Variable((), "i4", "1", "status flags"),
}


def good() -> xr.Dataset:
    """A small result that keeps the contract."""
    ds = xr.Dataset(attrs={"title": "T", "dataset": "d"})
    ds["x"] = ("x", np.arange(3), {"units": "pixel", "long_name": "column"})
    ds["value"] = ("x", [1.0, np.nan, 3.0], {"units": "DN", "long_name": "a value"})
    ds["name"] = ("x", np.array(["a", "b", "c"], dtype=object), {"units": "1", "long_name": "a name"})
    return ds


def extra() -> xr.Dataset:
    """Coordinates beyond the grid."""
    ds = xr.Dataset()
    ds["y"] = ("y", np.arange(4), {"units": "pixel", "long_name": "row"})
    return ds


@pytest.mark.parametrize("name", ["value", "x", "name"])
@pytest.mark.parametrize("attribute", ["units", "long_name"])
@pytest.mark.parametrize("how", ["missing", "blank"])
def test_units_and_long_name_on_every_variable(tmp_path, name, attribute, how):
    """On write and on read; the message names file, variable and attribute; nothing is left behind."""
    ds, path = good(), tmp_path / "r.nc"
    ds[name].attrs[attribute] = " "
    if how == "missing":
        del ds[name].attrs[attribute]
    with pytest.raises(store.ContractError, match=rf"r\.nc: variable {name} has no {attribute}"):
        store.write(ds, path, code="c")
    assert list(tmp_path.iterdir()) == []
    ds.to_netcdf(path)
    with pytest.raises(store.ContractError, match=rf"variable {name} has no {attribute}"):
        store.read(path)


@pytest.mark.parametrize("attribute", ["title", "dataset"])
def test_title_and_dataset_are_there(tmp_path, attribute):
    """A result says whose it is."""
    ds = good()
    del ds.attrs[attribute]
    with pytest.raises(store.ContractError, match=f"attribute {attribute} is missing"):
        store.write(ds, tmp_path / "r.nc", code="c")


def test_what_is_read_is_what_was_written(tmp_path):
    """Values, types, NaN, attributes and the digests of code and inputs."""
    source = tmp_path / "in.txt"
    source.write_text("input")
    store.write(good(), tmp_path / "r.nc", code="abc", inputs=[source])
    with store.read(tmp_path / "r.nc") as ds:
        np.testing.assert_array_equal(ds["value"], [1, np.nan, 3])
        assert ds["x"].dtype.kind == "i" and ds["name"].values.tolist() == ["a", "b", "c"]
        assert ds.attrs["code_version"] == "abc"
        assert ds.attrs["inputs"] == f"in.txt {hashlib.sha256(b'input').hexdigest()[:16]}"


def test_equal_inputs_give_equal_bytes(tmp_path):
    """Written twice, by both writers; what changes from run to run lies in the sidecar."""
    ds = dataset.load(folder(tmp_path / "data", ROWS))
    for name in ("one", "two"):
        store.write(good(), tmp_path / name / "r.nc", code="c")
        with store.frame_writer(tmp_path / name / "f.nc", ds, extra(), VARIABLES, code="c") as writer:
            writer.put((1, 0, 1), {"image": np.arange(4), "top": 3, "status": 0})
    for file in ("r.nc", "f.nc"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
        sidecar = json.loads((tmp_path / "one" / ".runs" / f"{file}.json").read_text())
        assert {"written", "host", "python", "packages"} <= set(sidecar)


def test_cells_never_written_are_nan_and_missing(tmp_path):
    """Floats NaN, integers −1, status the flag `missing`; the one cell that was written holds what it was given."""
    ds = dataset.load(folder(tmp_path, ROWS))
    with store.frame_writer(tmp_path / "f.nc", ds, extra(), VARIABLES, code="c") as writer:
        writer.put((0, 1, 1), {"image": [1, 2, np.nan, 4], "top": 7, "status": 16})
    with store.read(tmp_path / "f.nc") as out:
        assert out["image"].dims == ("angle", "exposure", "repeat", "y") and out["image"].shape == (2, 2, 2, 4)
        assert out["status"].dtype.kind == "i"
        written = np.zeros((2, 2, 2), bool)
        written[0, 1, 1] = True
        assert np.isnan(out["image"].values[~written]).all()
        np.testing.assert_array_equal(out["image"].values[0, 1, 1], [1, 2, np.nan, 4])
        assert (out["status"].values[~written] == store.flag("missing")).all() and out["status"].values[0, 1, 1] == 16
        assert (out["top"].values[~written] == -1).all() and out["top"].values[0, 1, 1] == 7
        assert out["exposure"].values.tolist() == [1e-4, 9e-4] and out["exposure"].attrs["units"] == "s"


def test_an_axis_that_was_not_recorded(tmp_path):
    """Length 1, no coordinate, and its name in an attribute."""
    rows = ["frames/a.tif,spot,,,0", "frames/b.tif,spot,,,1"]
    ds = dataset.load(folder(tmp_path, rows))
    with store.frame_writer(tmp_path / "f.nc", ds, extra(), VARIABLES, code="c") as writer:
        writer.put((0, 0, 1), {"image": np.zeros(4), "top": 0, "status": 0})
    with store.read(tmp_path / "f.nc") as out:
        assert out.attrs["not_recorded"] == "angle exposure"
        assert out.sizes["angle"] == out.sizes["exposure"] == 1
        assert [axis in out.coords for axis in ("angle", "exposure", "repeat")] == [False, False, True]
        assert store.grid_dims(out) == ("angle", "exposure", "repeat")


@pytest.mark.parametrize("earlier", [False, True])
def test_an_interrupted_file_does_not_appear(tmp_path, earlier):
    """Neither half a file nor a scratch name, and an earlier result stays as it was."""
    ds = dataset.load(folder(tmp_path / "data", ROWS))
    path = tmp_path / "out" / "f.nc"
    if earlier:
        store.write(good(), path, code="c")
    before = {p: p.read_bytes() for p in path.parent.rglob("*") if p.is_file()}
    with pytest.raises(KeyboardInterrupt), store.frame_writer(path, ds, extra(), VARIABLES, code="c") as writer:
        writer.put((0, 0, 0), {"image": np.zeros(4), "top": 0, "status": 0})
        raise KeyboardInterrupt
    after = {p: p.read_bytes() for p in path.parent.rglob("*") if p.is_file()}
    assert after == before


def test_variables_of_frames_are_checked_on_write(tmp_path):
    """The contract binds what is filled frame by frame as well."""
    ds = dataset.load(folder(tmp_path / "data", ROWS))
    bad = {"image": store.Variable(("y",), "f4", "", "some pixels")}
    with (
        pytest.raises(store.ContractError),
        store.frame_writer(tmp_path / "f.nc", ds, extra(), bad, code="c") as writer,
    ):
        writer.put((0, 0, 0), {"image": np.zeros(4)})


def test_flags_are_single_bits_and_described():
    """Each flag its own bit; the CF attributes list them in one order."""
    attrs = store.status_attributes()
    masks = attrs["flag_masks"].tolist()
    assert all(m & (m - 1) == 0 and m for m in masks) and len(set(masks)) == len(masks)
    assert [store.flag(name) for name in attrs["flag_meanings"].split()] == masks


def test_a_results_folder_belongs_to_one_dataset(tmp_path):
    """The same dataset may come again; another of the same name may not."""
    results = tmp_path / "results" / "a"
    (tmp_path / "here" / "a").mkdir(parents=True)
    store.claim(results, tmp_path / "here" / "a")
    store.claim(results, tmp_path / "here" / "a")
    with pytest.raises(InputError, match=r"holds the results of .*here/a, another folder of the same name"):
        store.claim(results, tmp_path / "there" / "a")
    # Moved, and its results with it.
    (tmp_path / "here" / "a").rmdir()
    store.claim(results, tmp_path / "there" / "a")
    (results / ".dataset").write_text("")
    store.claim(results, tmp_path / "there" / "a")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        store.claim(tmp_path / "file" / "a", tmp_path)


def test_asking_whose_a_results_folder_is_writes_nothing(tmp_path):
    """Planning asks; only a run writes."""
    (tmp_path / "a").mkdir()
    store.check_claim(tmp_path / "results" / "a", tmp_path / "a")
    assert not (tmp_path / "results").exists()


LIMITED = """
import resource
from tests.io.test_store import good
from spotcheck import cli
from spotcheck.io import store
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
cli.run = lambda words: {write}
cli.main(["ingest"])
"""
# A file of a kind, and how large it may grow at most [byte]: less than it needs.
WRITES = {
    "netCDF": ('store.write(good(), "{path}", code="c")', 4096),
    "text": ('store.write_text("{path}", "long" * 5000)', 4096),
    "nothing": ('store.write_text("{path}", "long")', 0),
}


@pytest.mark.parametrize("kind", WRITES)
def test_a_file_that_finds_no_room_ends_in_one_sentence(tmp_path, kind):
    """Here the limit on the size of files stands for a full disk; the earlier file stays, and nothing half written."""
    path = tmp_path / "r.nc"
    path.write_bytes(b"the earlier result")
    write, limit = WRITES[kind]
    code = LIMITED.format(limit=limit, write=write.format(path=path))
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stderr.splitlines() == [
        f"spotcheck: {path}: cannot be written (File too large); raise the limit on the size of files (`ulimit -f`) and"
        " run again"
    ]
    assert [own.name for own in tmp_path.iterdir()] == ["r.nc"]
    assert path.read_bytes() == b"the earlier result"


@pytest.mark.parametrize(("number", "way_out"), [(errno.ENOSPC, "room on the disk"), (errno.EDQUOT, "your quota")])
@pytest.mark.parametrize("kind", ["text", "netCDF"])
def test_a_full_disk_is_told_by_its_cause(tmp_path, monkeypatch, number, way_out, kind):
    """Text says why by itself; of netCDF, which does not, the disk is asked."""

    def full(*arguments, **names):
        raise OSError(number, os.strerror(number))

    def dumped(*arguments, **names):
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr(Path, "write_text", full)
    monkeypatch.setattr(xr.Dataset, "dump_to_store", dumped)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match=rf"r\.x: cannot be written \({os.strerror(number)}\); .*{way_out}"):
        if kind == "text":
            store.write_text(tmp_path / "r.x", "text")
        else:
            store.write(good(), tmp_path / "r.x", code="c")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_folder_that_takes_no_file(tmp_path, monkeypatch, number):
    def refused(path, *arguments, **names):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(InputError, match=rf"deep/r\.txt: cannot be written \({os.strerror(number)}\); "):
        store.write_text(tmp_path / "deep" / "r.txt", "text")


def test_other_errors_keep_their_names(tmp_path, monkeypatch):
    """What netCDF refuses on a disk with room, and what cannot be read meanwhile, is no fault of the file's place."""
    with pytest.raises(RuntimeError, match="NetCDF: bad"), store.write_with_sidecar(tmp_path / "r.nc"):
        raise RuntimeError("NetCDF: bad type")
    with pytest.raises(PermissionError), store.write_with_sidecar(tmp_path / "r.nc"):
        raise PermissionError(errno.EACCES, "Permission denied", "/data/frames/a.tif")
    assert list(tmp_path.iterdir()) == []


STOPPED = """
import time
from pathlib import Path
from spotcheck import cli
from spotcheck.io import store
def run(words):
    with store.write_with_sidecar(Path("{path}")) as scratch:
        scratch.write_text("half")
        print(1, flush=True)
        time.sleep(60)
cli.run = run
cli.main(["ingest"])
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_command_takes_its_half_file_with_it(tmp_path, number):
    """Without a traceback, and with the status that a shell gives to what a signal ended."""
    command = [sys.executable, "-c", STOPPED.format(path=tmp_path / "r.nc")]

    def heard() -> None:
        # What a shell starts in the background, and so all that it starts, does not hear SIGINT.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(command, cwd=ROOT, stdout=-1, stderr=-1, text=True, preexec_fn=heard) as job:
        assert job.stdout.readline() and len(list(tmp_path.iterdir())) == 1
        job.send_signal(number)
        assert job.wait(timeout=20) == 128 + number
        assert job.stderr.read() == ""
    assert list(tmp_path.iterdir()) == []
