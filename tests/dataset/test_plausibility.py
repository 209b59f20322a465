"""Units that are off by 1e3 or 1e6: a remark with the key and the unit that would make it right, and no refusal."""

import shutil

import pytest
import yaml

from spotcheck.cli import main
from spotcheck.dataset.folder import load
from spotcheck.dataset.plausibility import USUAL_RANGES, list_unusual_values
from spotcheck.errors import InputError
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


# A number that the schema refuses: the refusal says the unit.
REFUSED = {
    "sensor.pixel_pitch_m": (4.8, "4.8 µm would be 4.8e-06"),
    "laser.wavelength_m": (405, "405 nm would be 4.05e-07"),
}


@pytest.mark.parametrize(("key", "given"), REFUSED.items(), ids=REFUSED)
def test_a_refusal_says_the_unit(tmp_path, key, given):
    """Beside what the schema allows."""
    section, name = key.split(".")
    with pytest.raises(InputError, match=f"key {key} is {given[0]}; it must be at most .*{given[1]}"):
        said(tmp_path, {section: {name: given[0]}})


@pytest.mark.parametrize(
    ("exposure", "words"),
    [("250", ("250 ms would be 0.25", "250 µs would be 0.00025")), ("1e5", ("100000 µs would be 0.1",))],
)
def test_exposures_in_another_unit(tmp_path, exposure, words):
    """By the largest; one of half a minute is usual."""
    (text,) = said(tmp_path / "a", {}, [f"frames/a.tif,spot,0,{exposure},0", "frames/b.tif,spot,0,20,0"])
    assert text.startswith(f"manifest.csv: the largest exposure_s is {float(exposure):g}") and all(
        w in text for w in words
    )
    assert said(tmp_path / "b", {}, ["frames/a.tif,spot,0,30,0"]) == []


def test_positions_and_angles(tmp_path):
    """z in mm, on both sides of its zero; an angle of more than a turn."""
    rows = [f"frames/{k}.tif,spot,0,0.002,{k},{z}" for k, z in enumerate((-240, -80, 80))]
    (text,) = said(tmp_path / "z", {"conditions": ["z_m"]}, rows, f"{HEADER},z_m")
    assert "the largest z_m is 240" in text and "240 mm would be 0.24" in text
    (text,) = said(tmp_path / "angle", {}, ["frames/a.tif,spot,900,0.002,0"])
    assert "angle_deg is 900" in text


def test_an_object_nearer_than_the_focal_length(tmp_path):
    """Has no image."""
    (text,) = said(tmp_path, {"optics": {"focal_length_m": 0.05, "working_distance_m": 0.03}})
    assert "working_distance_m is 0.03" in text and "focal_length_m 0.05" in text


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
