"""Frames in .npy and HDF5 files: which numbers, which pages, which dataset; what is broken ends in a sentence."""

import os
import signal

import h5py
import numpy as np
import pytest
import xarray as xr

from spotcheck.cli import main
from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.dataset.metadata.entry import resolve_entries
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.errors import InputError
from spotcheck.io.formats import files, hdf5
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.formats.page import Page

STACK = np.arange(3 * 20 * 32, dtype=np.uint16).reshape(3, 20, 32) * 6


def npy(base, pixels):
    """A .npy file."""
    np.save(base / "a.npy", pixels)
    return base / "a.npy"


def h5(base, pixels, path: str = "entry/data", name: str = "a.h5", **options):
    """An HDF5 file with a dataset."""
    with h5py.File(base / name, "a") as file:
        file.create_dataset(path, data=pixels, **options)
    return base / name


@pytest.mark.parametrize("saved", [npy, h5])
@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2"])
def test_pages_are_counted_over_the_leading_axes(tmp_path, saved, dtype):
    """The last of them fastest, as NumPy flattens; a single image is one page."""
    pixels = STACK.astype(dtype)
    path = saved(tmp_path, np.stack([pixels, pixels + 1]))
    assert files.list_pages(path, "a") == [Page((20, 32), 8 * pixels.itemsize)] * 6
    read = files.read_pixels(path, 4, "a")
    np.testing.assert_array_equal(read, pixels[1] + 1)
    assert read.dtype == pixels.dtype.newbyteorder("=")


def test_npy_with_its_first_axis_fastest(tmp_path):
    """As MATLAB and Fortran lay arrays out."""
    np.testing.assert_array_equal(files.read_pixels(npy(tmp_path, np.asfortranarray(STACK)), 2, "a"), STACK[2])


@pytest.mark.parametrize("options", [{"chunks": (1, 8, 16), "compression": "gzip", "shuffle": True, "fletcher32": True},
                                     {"chunks": (2, 20, 32), "compression": "lzf"}, {}])  # fmt: skip
def test_packed_datasets(tmp_path, options):
    """Chunks that fit neither frame nor stack, and what packs without loss."""
    np.testing.assert_array_equal(files.read_pixels(h5(tmp_path, STACK, **options), 1, "a"), STACK[1])


def test_netcdf(tmp_path):
    """A variable that xarray wrote, beside its coordinates."""
    array = xr.DataArray(STACK, dims=("z", "y", "x"), coords={"z": [1.0, 2.0, 3.0]}, name="image")
    array.to_netcdf(tmp_path / "a.nc")
    assert files.list_stacks(tmp_path / "a.nc", "a.nc") == ["a.nc#/image"]
    np.testing.assert_array_equal(files.read_pixels(tmp_path / "a.nc", 2, "a"), STACK[2])


def test_a_dataset_is_named_where_there_are_several(tmp_path):
    """In any way of writing its path; tables beside the frames are none."""
    h5(tmp_path, STACK)
    h5(tmp_path, np.zeros((5, 2), np.uint8), "entry/flags")
    assert files.list_stacks(tmp_path / "a.h5", "a.h5") == ["a.h5#/entry/data"]
    h5(tmp_path, STACK + 1, "other")
    with pytest.raises(InputError, match=r"a: holds frames in /other, /entry/data; name one, such as /other behind #"):
        files.list_pages(tmp_path / "a.h5", "a")
    for name in ("a.h5#/other", "a.h5#other", "a.h5#//other"):
        np.testing.assert_array_equal(files.read_pixels(tmp_path / name, 1, "a"), STACK[1] + 1)


def test_a_hash_in_other_names_is_a_letter():
    """Only behind the ending of an HDF5 file it parts the path inside."""
    assert split_inner_path("scan.h5#/entry/data") == ("scan.h5", "/entry/data")
    assert split_inner_path("a#b/scan.NXS#x") == ("a#b/scan.NXS", "/x")
    assert split_inner_path("#1.tif") == ("#1.tif", "") and split_inner_path("run#2.h5") == ("run#2.h5", "")


def unwritten(base):
    """A dataset of which only one frame was written."""
    with h5py.File(base / "a.h5", "w") as file:
        file.create_dataset("d", (3, 20, 32), "u2", chunks=(1, 20, 32))[0] = STACK[0]
    return base / "a.h5"


def elsewhere(base, kind: str):
    """A dataset whose pixels lie in another file."""
    h5(base, STACK, name="b.h5")
    with h5py.File(base / "a.h5", "w") as file:
        if kind == "link":
            file["d"] = h5py.ExternalLink("b.h5", "/entry/data")
        else:
            layout = h5py.VirtualLayout(STACK.shape, "u2")
            layout[:] = h5py.VirtualSource(base / "b.h5", "entry/data", STACK.shape)
            file.create_virtual_dataset("d", layout)
    return base / "a.h5#/d"


def with_attribute(base, name: str, value):
    """A dataset with an attribute."""
    path = h5(base, STACK, "d")
    with h5py.File(path, "a") as file:
        file["d"].attrs[name] = value
    return path


def cut(path, part: float = 0.6):
    """The first part of a file."""
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    return path


def claiming(base, shape):
    """A .npy file whose header claims a shape, with no number behind it."""
    with (base / "a.npy").open("wb") as out:
        np.lib.format.write_array_header_1_0(out, {"descr": "<u2", "fortran_order": False, "shape": shape})
    return base / "a.npy"


def inside(path, name: str):
    """The path of a dataset in a file."""
    return path.parent / f"{path.name}#{name}"


REFUSED = {
    "signed numbers": (lambda f: npy(f, STACK.astype(np.int32)), "holds int32 pixels"),
    "objects": (lambda f: npy(f, np.array([[{}]])), "holds object pixels"),
    "a line": (lambda f: npy(f, STACK[0, 0]), "has 1 dimension; it must have rows and columns"),
    "no pages": (lambda f: npy(f, STACK[:0]), "has no pages"),
    "cut": (lambda f: cut(npy(f, STACK)), "is cut short: its pixels need"),
    "a claim": (lambda f: claiming(f, (10**6, 10**6)), "claims 1000000 × 1000000 px"),
    "many pages": (lambda f: claiming(f, (10**9, 20, 32)), "claims 1000000000 pages"),
    "floats in HDF5": (lambda f: h5(f, STACK / 2, "d"), "holds no frames of 8 or 16 bits"),
    "named floats": (lambda f: inside(h5(f, STACK / 2, "d"), "/d"), "holds floating-point pixels"),
    "cut HDF5": (lambda f: cut(h5(f, STACK)), "cannot be read as HDF5 .*truncated"),
    "nothing there": (lambda f: inside(h5(f, STACK), "/x"), "has nothing at /x; it holds frames in /entry/data"),
    "a group": (lambda f: inside(h5(f, STACK), "/entry"), "/entry is a group; name one of /entry/data"),
    "a link": (lambda f: elsewhere(f, "link"), "a link into another file, 'b.h5'; name that file"),
    "a view": (lambda f: elsewhere(f, "view"), "/d lies in other files"),
    "unwritten": (unwritten, "/d has parts that were never written"),
    "scaled": (lambda f: with_attribute(f, "scale_factor", 0.5), "attribute scale_factor: its numbers are no readings"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_reading_is_refused(tmp_path, kind):
    """In one sentence."""
    make, words = REFUSED[kind]
    with pytest.raises(InputError, match=rf"^a: .*{words}") as caught:
        files.list_pages(make(tmp_path), "a")
    assert "\n" not in str(caught.value)


def test_missing_pixels_are_no_readings(tmp_path):
    """A netCDF variable marks them by a value."""
    path = with_attribute(tmp_path, "_FillValue", np.uint16(6 * 45))
    with pytest.raises(InputError, match=r"holds pixels that are missing \(_FillValue\)"):
        files.read_pixels(path, 0, "a")
    np.testing.assert_array_equal(files.read_pixels(path, 1, "a"), STACK[1])


def test_a_crash_of_the_library_is_a_sentence(tmp_path):
    """And the next question is answered: here the process is killed, as a broken file may do."""
    path = h5(tmp_path, STACK)
    files.list_pages(path, "a")
    process = hdf5._workers[os.getpid()]
    process.send_signal(signal.SIGKILL)
    process.wait()
    with pytest.raises(InputError, match="a: cannot be read as HDF5: the library that reads it crashes or takes too"):
        files.list_pages(path, "a")
    assert len(files.list_pages(path, "a")) == 3


def test_the_texts_around_the_frames(tmp_path):
    """Attributes, single numbers and one number a frame, with their units."""
    path = h5(tmp_path, STACK)
    with h5py.File(path, "a") as file:
        file["entry"].attrs["wavelength"] = "632.8 nm"
        file["entry/count_time"], file["entry/z"] = 2.5, [1.0, 2.0, 3.0]
        file["entry/exposure_time"] = 20
        file["entry/z"].attrs["units"], file["entry/exposure_time"].attrs["units"] = "mm", "ms"
    taken, _ = resolve_entries(read_metadata(path, inner_path="/entry/data"), 1)
    values = {column: label.value for column, label in taken.items()}
    assert values == {"laser.wavelength_m": 6.328e-7, "exposure_s": 0.02, "z_m": 2e-3}


def test_a_dataset_of_hdf5_and_npy(tmp_path, capsys):
    """From new-dataset to ingest: names of rows, digests of files."""
    rng = np.random.default_rng(1)
    noisy = STACK + rng.integers(0, 5, (4, *STACK.shape)).astype(np.uint16)
    h5(tmp_path, noisy[0], "a")
    h5(tmp_path, noisy[1], "b")
    np.save(tmp_path / "c.npy", noisy[2])
    main(["new-dataset", str(tmp_path)])
    found = dataset.load(tmp_path)
    assert [(f.file, f.page) for f in found.frames] == [
        (name, page) for name in ("a.h5#/a", "a.h5#/b", "c.npy") for page in range(3)
    ]
    assert found.frames[4].label == "a.h5#/b, page 1"
    table = ingest_frames(found)
    assert len(set(table["sha256"].values)) == 2 and set(table["copy_of"].values) == {-1}
    np.testing.assert_array_equal(frames.read_image(found, found.frames[4]), noisy[1, 1])
