"""Corrected frames: electrons that were there, with the variance that is stated."""

import csv
import hashlib
import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import tifffile
from scipy import stats

from spotcheck.cli import run
from spotcheck.cli.pipeline import judge_dataset
from spotcheck.errors import InputError
from spotcheck.export.frame_correction import compute_response_curve, correct_frame
from spotcheck.sensor import SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps
from tests.samples.model_files import applied

SENSOR = SensorModel(0.25, 8.0, 200.0, np.inf, 60.0, 1023.0)
SHAPE, EXPOSURE, BEND = (120, 160), 0.1, 0.05
# Light [e-] from some times the noise up: the variance takes a reading for its mean, which is a bias of 1/n.
LIGHT = np.linspace(400.0, 2800.0, SHAPE[0] * SHAPE[1]).reshape(SHAPE)


def drawn(rng, bend=0.0, dsnu=0.0, prnu=0.0):
    """Readings [DN] of known light by the closed form, offsets and gains of the pixels."""
    offset, gain = rng.normal(0, dsnu, SHAPE), rng.normal(1, prnu, SHAPE)
    electrons = rng.poisson(gain * LIGHT + SENSOR.dark_current_e_per_s * EXPOSURE) + rng.normal(0, 8.0, SHAPE)
    signal = SENSOR.gain_dn_per_e * electrons
    signal = signal - bend * signal**2 / SENSOR.full_scale_dn
    return np.clip(np.rint(signal + SENSOR.black_level_dn + offset), 0, SENSOR.full_scale_dn), offset, gain


@pytest.mark.parametrize(("bend", "dsnu", "prnu"), [(0.0, 0.0, 0.0), (BEND, 0.0, 0.0), (BEND, 5.0, 0.03)])
def test_pulls_are_standard_normal(bend, dsnu, prnu):
    """Of 19,200 pixels of known light, through a bent response and pixels of their own whose maps are uncertain.

    The mean pull is 0 to five errors and 0.02 (half of a pull's skewness 1/√n), the variance 1 to five errors (1 in
    2e6) and 1 % (the reading itself in the variance, and a response that is straight over its noise)."""
    rng = np.random.default_rng(7)
    image, offset, gain = drawn(rng, bend, dsnu, prnu)
    error = (1.0, 0.01) if dsnu else (0.0, 0.0)
    maps = PixelMaps(offset + rng.normal(0, error[0], SHAPE), gain + rng.normal(0, error[1], SHAPE), *error)
    effects = [applied("nonlinearity", q=bend)] if bend else []
    own = correct_frame(image, SENSOR, compute_response_curve(SENSOR, effects), maps if dsnu else None, EXPOSURE)
    pull = ((own.electrons - LIGHT) / np.sqrt(own.variance)).ravel()
    assert own.clipped_count == 0 and np.isfinite(pull).all()
    assert abs(pull.mean()) < 0.02 + 5 / np.sqrt(pull.size)
    assert pull.var() == pytest.approx(1, abs=0.01 + 5 * np.sqrt(2 / pull.size))
    assert stats.kurtosis(pull) == pytest.approx(0, abs=5 * np.sqrt(24 / pull.size) + 0.02)


def test_what_cannot_be_told_is_marked():
    """Bad pixels, full scale, and what lies within three noises of a well are NaN, on both pages."""
    level = 300.0
    image = np.array([[60.0, 160.0, np.nan, 1023.0, 60 + level - 1, 60 + level - 30]])
    for effects, marked in (
        ([], [0, 0, 1, 1, 0, 0]),
        ([applied("saturation", "sharp", level=level)], [0, 0, 1, 1, 1, 0]),
    ):
        own = correct_frame(image, SENSOR, compute_response_curve(SENSOR, effects))
        assert np.isnan(own.electrons[0]).tolist() == np.isnan(own.variance[0]).tolist() == [bool(m) for m in marked]
        assert own.clipped_count == sum(marked) - 1
        assert own.electrons[0, :2] == pytest.approx([0, 400], abs=1e-6)
    well = compute_response_curve(replace(SENSOR, full_well_e=1200.0), [])
    assert np.isnan(correct_frame(image, replace(SENSOR, full_well_e=1200.0), well).electrons[0, 4])


@pytest.fixture(scope="module")
def flats(shelf, tmp_path_factory):
    """Results of the flats that the API page speaks of."""
    out = tmp_path_factory.mktemp("out")
    judge_dataset(shelf / "my-flats", out)
    return shelf / "my-flats", out / "my-flats"


def test_a_folder_of_corrected_frames(flats, tmp_path):
    """Electrons and variance as float pages, a manifest that names them, provenance in the file, equal files again; the
    mean of each flat is the light it was drawn with, to 3 % for gain and quantum efficiency of so few frames."""
    base, results = flats
    for name in ("a", "b"):
        run(["correct", str(base), "--results", str(results), "--output", str(tmp_path / name)])
    lines = [line for line in (tmp_path / "a" / "manifest.csv").read_text().splitlines() if line[0] != "#"]
    rows = list(csv.DictReader(lines))
    assert len(rows) == 80 and {row["kind"] for row in rows} == {"dark", "flat"}
    for row in rows[::7]:
        with tifffile.TiffFile(tmp_path / "a" / row["file"]) as tiff:
            electrons, variance = (page.asarray() for page in tiff.pages)
            told = json.loads(tiff.pages[0].description)
        assert electrons.dtype == np.float32 and told["source"] == row["source"] and "transfer.nc" in told["results"]
        photons = float(row["photons_per_px"] or 0)
        assert int(row["clipped_px"]) == np.count_nonzero(np.isnan(electrons))
        if not int(row["clipped_px"]):
            assert electrons.mean() == pytest.approx(0.5 * photons, rel=0.03, abs=1.0)
            # Of noise in time alone: pixels of this camera are alike.
            assert np.var(electrons) == pytest.approx(variance.mean(), rel=0.05 + 5 * np.sqrt(2 / electrons.size))
        assert (tmp_path / "a" / row["file"]).read_bytes() == (tmp_path / "b" / row["file"]).read_bytes()


def test_pages_of_a_stack_inside_a_file(flats, tmp_path):
    """Of HDF5: a file for each page, told apart by its path inside, and the digest of the one file that there is."""
    base = tmp_path / "stack"
    (base / "frames").mkdir(parents=True)
    with h5py.File(base / "frames" / "scan.h5", "w") as file:
        for name in ("entry/data", "dark"):
            file.create_dataset(name, data=np.full((2, 48, 64), 100, np.uint16))
    names = [f"frames/scan.h5#{inside}" for inside in ("/entry/data", "/dark")]
    rows = [f"{name},dark,,1e-3,{2 * k + page},{page}" for k, name in enumerate(names) for page in (0, 1)]
    (base / "manifest.csv").write_text("\n".join(["file,kind,angle_deg,exposure_s,repeat,page", *rows]) + "\n")
    run(["correct", str(base), "--results", str(flats[1]), "--output", str(tmp_path / "out")])
    written = sorted((tmp_path / "out" / "frames").iterdir())
    assert [path.name for path in written] == [
        f"scan_{own}_p{page}.tif" for own in ("dark", "entry_data") for page in (0, 1)
    ]
    wanted = hashlib.sha256((base / "frames" / "scan.h5").read_bytes()).hexdigest()
    for path in written:
        with tifffile.TiffFile(path) as tiff:
            assert json.loads(tiff.pages[0].description)["source_sha256"] == wanted


def test_what_is_refused(flats, tmp_path):
    """A folder that is not empty, and results that tell no gain."""
    base, results = flats
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty; name a new folder"):
        run(["correct", str(base), "--results", str(results), "--output", str(tmp_path)])
    with pytest.raises(InputError, match="holds no gain and read noise"):
        run(["correct", str(base), "--results", str(tmp_path), "--output", str(tmp_path / "new")])
