"""Whole datasets: equal seeds, workers, the truth file, plans of any shape, errors."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from skimage import io

from rig import beam, cli, expose
from rig import plan as plan_module
from rig.errors import RigError
from rig.settings import Settings, from_dict, load, replace, to_dict

ROOT = Path(__file__).parents[2]
SMALL = {
    "seed": 11,
    "frame": {"width_px": 180, "height_px": 160, "window_px": 128},
    "pointing": {"border_px": 60, "wander_px": 5},
    "speckle": {"patterns": 2, "field_px": 64},
    "sensor": {"clip_level_e": 7000.0, "clip_pixel_scatter": 0.01},
    "material": {"site_reflectance_scatter": 0.3, "spread_along_m": 150e-6, "spread_across_m": 130e-6},
}
HEADER = "file,kind,angle_deg,exposure_s,repeat\n"
ROWS = [f"frames/a{a:03d}_r{r}_t{t}.tif,spot,{a},{t}e-4,{r}\n" for r in (0, 1) for a in (0, 90) for t in (1, 5)]


MANIFEST = HEADER + "".join(ROWS)


def dataset(folder, manifest=MANIFEST, settings=SMALL):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "manifest.csv").write_text(manifest, encoding="utf-8")
    (folder / "rig.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    return folder


def run(folder, *more):
    truth = folder / "truth.json"
    return cli.main(["expose", str(folder), "--settings", str(folder / "rig.yaml"), "--truth", str(truth), *more])


def test_equal_seeds_give_equal_files_with_one_and_two_workers(tmp_path):
    one, two = dataset(tmp_path / "one"), dataset(tmp_path / "two")
    assert run(one) == 0
    assert run(two, "--workers", "2") == 0
    files = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(two) for path in two.rglob("*") if path.is_file())
    assert len(files) == len(ROWS) + 3
    for file in files:
        assert (one / file).read_bytes() == (two / file).read_bytes(), file


def test_another_seed_gives_other_frames(tmp_path):
    one = dataset(tmp_path / "one")
    two = dataset(tmp_path / "two", settings=SMALL | {"seed": 12})
    run(one)
    run(two)
    name = "frames/a000_r0_t1.tif"
    assert not np.array_equal(tifffile.imread(one / name), tifffile.imread(two / name))


def test_the_truth_is_complete_plain_and_matches_the_frames(tmp_path):
    folder = dataset(tmp_path / "set")
    run(folder)
    truth = json.loads((folder / "truth.json").read_text(), parse_constant=pytest.fail)
    assert truth["settings"] == json.loads(json.dumps(to_dict(load(folder / "rig.yaml"))))
    assert truth["seed"] == 11
    told = sorted(frame["file"] for site in truth["sites"] for frame in site["frames"])
    assert told == sorted(row.split(",")[0] for row in ROWS)
    for site in truth["sites"]:
        assert {"x_px", "y_px", "sigma_long_px", "sigma_short_px", "relative_light", "angle_deg"} <= set(site)
        first, second = site["frames"]
        assert second["photons"] == pytest.approx(5 * first["photons"])
        frame = tifffile.imread(folder / first["file"]).astype(float)
        y, x = np.indices(frame.shape)
        light = np.where(frame > 10, frame, 0)
        # The centre of light, moved about by some 500 speckle grains of a 7 px wide spot.
        assert (light * x).sum() / light.sum() == pytest.approx(site["x_px"], abs=2.0)
        assert (light * y).sum() / light.sum() == pytest.approx(site["y_px"], abs=2.0)


def test_files_are_single_page_16_bit_without_dates(tmp_path):
    folder = dataset(tmp_path / "set")
    run(folder)
    with tifffile.TiffFile(folder / "frames/a000_r0_t1.tif") as tif:
        assert len(tif.pages) == 1
        page = tif.pages[0]
        assert page.dtype == np.uint16
        assert page.shape == (160, 180)
        assert not {"DateTime", "Software", "ImageDescription"} & {
            tag.name for tag in page.tags if tag.value not in ("", None)
        }
    assert not list(folder.rglob("*.part"))


@pytest.mark.parametrize("suffix", ["png", "pgm"])
@pytest.mark.parametrize("bits", [8, 12])
def test_other_formats_hold_the_same_pixels(tmp_path, suffix, bits):
    settings = SMALL | {"sensor": {"bit_depth": bits}}
    rows = ["frames/f.tif,spot,0,1e-4,0\n", f"frames/f.{suffix},spot,0,1e-4,0\n"]
    same = dataset(tmp_path / "tif", HEADER + rows[0], settings)
    other = dataset(tmp_path / "other", HEADER + rows[1], settings)
    assert run(same) == run(other) == 0
    frame = io.imread(other / f"frames/f.{suffix}")
    np.testing.assert_array_equal(frame, tifffile.imread(same / "frames/f.tif"))
    assert frame.max() > 2 ** (bits - 2)


def test_blank_cells_darks_and_flats(tmp_path):
    manifest = HEADER.strip() + ",photons_per_px,remark\n"
    manifest += "s.tif,spot,,,0,,first\nd.tif,dark,,2e-4,0,,\nf.tif,flat,,2e-4,0,5000,\n"
    folder = dataset(tmp_path / "set", manifest)
    assert run(folder) == 0
    frames = {name: tifffile.imread(folder / f"{name}.tif").astype(float) for name in "sdf"}
    assert frames["d"].max() < 15
    # 5000 photons · 0.38 · 0.11 DN; 28,800 pixels know the mean to 0.03 DN: 5 standard errors.
    assert frames["f"].mean() == pytest.approx(209.0, abs=0.15)
    assert frames["s"].max() > 600
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["sites"][0]["frames"][0]["exposure_recorded"] is False


def test_a_beam_follows_its_caustic_and_peaks_where_wanted(tmp_path):
    wavelength, waist, z_r = 6.328e-7, 60e-6, math.pi * 60e-6**2 / 6.328e-7
    assert beam.radius_m(0.2, waist, 0.2, 1.0, wavelength) == pytest.approx(waist)
    assert beam.radius_m(0.2 + z_r, waist, 0.2, 1.0, wavelength) == pytest.approx(math.sqrt(2) * waist)
    assert beam.radius_m(9.0, waist, 0.0, 2.0, wavelength) == pytest.approx(
        18 * wavelength / (math.pi * waist), rel=1e-4
    )
    settings = load(ROOT / "data/zscan-sample/made-with.yaml")
    plain = replace(settings, {"beam.peak_scatter": 0.0})
    manifest = HEADER.strip() + ",z_m\n" + "".join(f"z{k}.png,spot,0,,0,{0.19 + 0.01 * k}\n" for k in range(3))
    folder = dataset(tmp_path / "scan", manifest, to_dict(plain))
    assert run(folder) == 0
    for k in range(3):
        frame = io.imread(folder / f"z{k}.png")
        # 70 % of the range above black; the brightest pixel gains up to 4.5 σ of noise, 2.5 DN each.
        assert 0.66 * 255 < frame.max() < 0.7 * 255 + 4 + 12


def test_the_sample_scan_is_what_its_recipe_makes(tmp_path):
    sample = ROOT / "data/zscan-sample"
    for name, own in (("manifest.csv", "manifest.csv"), ("made-with.yaml", "rig.yaml")):
        (tmp_path / own).write_bytes((sample / name).read_bytes())
    assert run(tmp_path) == 0
    for shot in plan_module.read_plan(sample):
        np.testing.assert_array_equal(io.imread(sample / shot.file), io.imread(tmp_path / shot.file))
    assert sum(path.stat().st_size for path in sample.rglob("*")) < 40_000


def test_the_default_rig_reads(tmp_path):
    settings = load(ROOT / "data/virtual-rig/rig.yaml")
    assert len(plan_module.sites(plan_module.read_plan(ROOT / "data/virtual-rig"))) == 32
    assert settings.frame.width_px == 4096
    assert settings.sensor.bit_depth == 10
    assert settings.pointing.border_px >= 200


BAD_PLANS = {
    "missing column": ("file,angle_deg\na.tif,0\n", "column kind is missing"),
    "no rows": (HEADER, "plans no frame"),
    "outside": (HEADER + "../a.tif,spot,0,1e-4,0\n", "must lie inside"),
    "twice": (HEADER + "a.tif,spot,0,1e-4,0\na.tif,spot,0,1e-4,1\n", "rows 1 and 2 both write a.tif"),
    "kind": (HEADER + "a.tif,spott,0,1e-4,0\n", "kind must be one of"),
    "number": (HEADER + "a.tif,spot,0,fast,0\n", "'fast' is not a number"),
    "negative": (HEADER + "a.tif,spot,0,-1,0\n", "must not be negative"),
    "format": (HEADER + "a.jpg,spot,0,1e-4,0\n", "must end in one of"),
    "flat": (HEADER + "a.tif,flat,,1e-4,0\n", "needs photons_per_px"),
}


@pytest.mark.parametrize("manifest, message", BAD_PLANS.values(), ids=BAD_PLANS)
def test_a_bad_plan_ends_in_one_line(tmp_path, capsys, manifest, message):
    assert run(dataset(tmp_path / "set", manifest)) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


BAD_SETTINGS = {
    "unknown": ({"sensor": {"gain": 1}}, "sensor.gain: unknown key"),
    "text": ({"optics": {"f_number": "wide"}}, "optics.f_number: must be a number"),
    "range": ({"sensor": {"bit_depth": 7}}, "sensor.bit_depth: must be a finite number from 8 to 16"),
    "nan": ({"laser": {"power_w": float("nan")}}, "laser.power_w: must be a finite number"),
    "whole": ({"seed": 1.5}, "seed: must be a whole number"),
    "source": ({"source": "sun"}, "source: must be fibres or beam"),
    "tree": ({"sensor": 3}, "sensor: must be a mapping"),
    "border": ({"frame": {"width_px": 64}, "pointing": {"border_px": 40}}, "leaves no room in 64 px"),
}


@pytest.mark.parametrize("settings, message", BAD_SETTINGS.values(), ids=BAD_SETTINGS)
def test_bad_settings_end_in_one_line(tmp_path, capsys, settings, message):
    assert run(dataset(tmp_path / "set", settings=settings)) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_workers_below_one_are_refused(tmp_path):
    with pytest.raises(RigError, match="at least 1"):
        expose.expose_dataset(dataset(tmp_path / "set"), Settings(), tmp_path / "truth.json", 0)


def test_numbers_written_as_yaml_text_are_read():
    assert from_dict({"laser": {"power_w": "1e-3"}}).laser.power_w == 1e-3
