"""Units that are off by 1e3 or 1e6: a remark with the key and the unit that would make it right, and no refusal."""

import shutil

import pytest
import yaml

from spotcheck.cli import main
from spotcheck.dataset.folder import load
from spotcheck.dataset.plausibility import USUAL_RANGES, list_unusual_values
from tests.samples.small_datasets import HEADER, ROOT, folder

ROW = "frames/a.tif,spot,0,0.002,0"


def said(base, instrument: dict, rows=(ROW,), header=HEADER) -> list[str]:
    """Remarks on a dataset."""
    return list_unusual_values(load(folder(base, list(rows), yaml.safe_dump(instrument), header)))


# A number of the right key in a wrong unit that the schema lets through, and what the sentence must say.
WRONG_UNIT = {
    "sensor.pixel_pitch_m": (0.0055, "0.0055 mm would be 5.5e-06"),
    "sensor.full_well_e": (10.5, "10.5 ke- would be 10500"),
    "optics.focal_length_m": (25, "25 mm would be 0.025"),
    "optics.working_distance_m": (350, "350 mm would be 0.35"),
    "laser.power_w": (120, "120 mW would be 0.12"),
    "laser.wavelength_m": (0.000532, "0.000532 mm would be 5.32e-07"),
    "laser.fwhm_x_m": (3, "3 mm would be 0.003"),
    "laser.fwhm_y_m": (3, "3 mm would be 0.003"),
    "sensor.gain_dn_per_e": (5e3, "0.0001 to 100 is usual"),
    "sensor.read_noise_e": (0.004, "0.1 to 2000 is usual"),
    "sensor.dark_current_e_per_s": (3e8, "0 to 1e+07 is usual"),
    "optics.f_number": (0.05, "0.5 to 128 is usual"),
}


@pytest.mark.parametrize(("key", "given"), WRONG_UNIT.items(), ids=WRONG_UNIT)
def test_a_number_in_another_unit_is_remarked(tmp_path, key, given):
    """One sentence with the key, the number, and the unit in which it would be usual."""
    section, name = key.split(".")
    (text,) = said(tmp_path, {section: {name: given[0]}})
    assert text.startswith(f"instrument.yaml: {key} is {given[0]:g}, and") and given[1] in text


def test_every_range_has_a_wrong_number_here():
    """So that none is forgotten; the manifest's are below."""
    assert set(USUAL_RANGES) == {*WRONG_UNIT, "exposure_s", "angle_deg"}


SCAN = {"conditions": ["z_m"]}
NEARER = {"optics": {"focal_length_m": 0.05, "working_distance_m": 0.03}}
# Instrument file, first cells of the rows (exposure, angle, z), and what the only sentence says; none for None.
UNUSUAL = {
    "exposure in ms or µs": ({}, ["250,0,", "20,0,"], ["largest exposure_s is 250", "250 ms would be 0.25", "250 µs"]),
    "exposure in µs": ({}, ["1e5,0,", "20,0,"], ["largest exposure_s is 100000", "100000 µs would be 0.1"]),
    "half a minute": ({}, ["30,0,"], None),
    "z in mm": (SCAN, ["1,0,-240", "1,0,-80", "1,0,80"], ["the largest z_m is 240", "240 mm would be 0.24"]),
    "more than a turn": ({}, ["0.002,900,"], ["angle_deg is 900"]),
    "an object too near": (NEARER, ["0.002,0,"], ["working_distance_m is 0.03", "focal_length_m 0.05"]),
}


@pytest.mark.parametrize(("instrument", "cells", "words"), UNUSUAL.values(), ids=UNUSUAL)
def test_unusual_numbers(tmp_path, instrument, cells, words):
    """By the largest of a column."""
    rows = [f"{k},frames/{k}.tif,spot,{row}" for k, row in enumerate(cells)]
    texts = said(tmp_path, instrument, rows, "repeat,file,kind,exposure_s,angle_deg,z_m")
    assert len(texts) == (words is not None)
    assert [word for word in words or () if word not in texts[0]] == []


@pytest.mark.parametrize("name", ["virtual-rig", "zscan-sample"])
def test_the_shelf_is_plausible(name):
    """Nothing to remark on the datasets of the repository."""
    assert list_unusual_values(load(ROOT / "data" / name)) == []


def test_check_says_the_remarks_and_ends_well(shelf, tmp_path, capsys):
    """Status 0: a remark is no mistake."""
    shutil.copytree(shelf / "my-frames", tmp_path / "mine")
    path = tmp_path / "mine" / "instrument.yaml"
    keys = yaml.safe_load(path.read_text()) | {"laser": {"wavelength_m": 0.00065}}
    path.write_text(yaml.safe_dump(keys))
    assert not main(["check", str(tmp_path / "mine")])
    assert "0.00065 mm would be 6.5e-07" in capsys.readouterr().out
