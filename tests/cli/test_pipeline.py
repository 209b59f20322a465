"""The verdict of one call beside that of the commands."""

import json
from pathlib import Path

import pytest

from spotcheck.cli import main
from spotcheck.cli.pipeline import judge_dataset
from spotcheck.errors import InputError
from spotcheck.model.design import simulate_dataset
from spotcheck.model.effects import chosen
from tests.samples.effect_cases import MEAN_EXAMPLE, written
from tests.samples.example_datasets import design


def test_the_verdict_on_flats_is_that_of_the_command(there, tmp_path, capsys):
    """The content of verdict.json, without a word on the terminal; results lie where they are asked for."""
    verdict = judge_dataset("my-flats", tmp_path / "out")
    assert capsys.readouterr().out == ""
    written = (tmp_path / "out" / "my-flats" / "verdict.json").read_text(encoding="utf-8")
    assert verdict == json.loads(written) and verdict["status"] == "consistent"
    frames, again = str(tmp_path / "frames.nc"), tmp_path / "again.json"
    main(["ingest", "my-flats", "--output", frames])
    main(["flats", "my-flats", "--frames", frames, "--output", str(again)])
    assert again.read_text(encoding="utf-8") == written


SEEN = "--crops again/crops.nc --sensor again/sensor.nc"
COMMANDS = {
    "ingest": "--output again/frames.nc",
    "crop": "--frames again/frames.nc --output again/crops.nc",
    "sensor": "--crops again/crops.nc --frames again/frames.nc --output again/sensor.nc",
    "fit": f"{SEEN} --output again/fits.nc",
    "judge": f"{SEEN} --fits again/fits.nc --pictures again/discrepancy.nc --model again/model.yaml"
    " --light again/light.nc --output again/verdict.json",
}


@pytest.mark.slow
def test_the_verdict_on_spots_is_that_of_the_commands(tmp_path, monkeypatch):
    """All stages, in their order: every number of the verdict of a small design."""
    monkeypatch.chdir(tmp_path)
    made = design(tmp_path / "design", exposures=(9e-4,), crop_px=24)
    simulate_dataset(made, tmp_path / "drawn", p1_px=0.0, p2_px=3.0, peak_dn=600, seed=2)
    verdict = judge_dataset(tmp_path / "drawn", tmp_path / "out")
    assert verdict["status"] == "consistent" and (tmp_path / "out" / "drawn" / "model.yaml").exists()
    # One exposure tells a width, neither p1 nor p2.
    assert {row["before"] for row in verdict["baseline_shift"].values()} == {None}
    for command, options in COMMANDS.items():
        main([command, "drawn", *options.split()])
    assert verdict == json.loads(Path("again", "verdict.json").read_text(encoding="utf-8"))


def test_a_vocabulary_is_that_of_the_call(there, tmp_path):
    """It is written into the verdict, and the process has the one it had before."""
    before = chosen()
    verdict = judge_dataset("my-flats", without=["nonlinearity"])
    assert verdict["vocabulary"] == {"own": [], "left_out": ["nonlinearity"]}
    assert chosen() == before
    with pytest.raises(InputError, match="without names unknown, which is no effect"):
        judge_dataset("my-flats", without=["unknown"])


def test_effects_from_files_take_part(there, tmp_path):
    """They are listed in the vocabulary; all else in this verdict is as without them."""
    path = written(tmp_path, "lens", MEAN_EXAMPLE)
    verdict, plain = judge_dataset("my-flats", effects=[path]), judge_dataset("my-flats")
    assert [effect["name"] for effect in verdict["vocabulary"]["own"]] == ["vignetting"]
    # Flats and darks have no spot, whose light it changes.
    rows = [row for row in verdict["not_assessed"] if row["effect"] == "vignetting"]
    assert rows == [{"effect": "vignetting", "why": "there is no spot"}]
    assert (verdict["status"], verdict["limits"]) == (plain["status"], plain["limits"])


def test_a_folder_that_cannot_be_judged(there, tmp_path):
    """The user's error as it is, no exit."""
    with pytest.raises(InputError, match="no such folder; a dataset is a folder with manifest"):
        judge_dataset(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"frames/0_0_0\.0001\.tif is not there; add the file"):
        judge_dataset("design")
