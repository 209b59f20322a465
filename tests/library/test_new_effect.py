"""An effect from a file outside the repository is simulated; the verdict does not search for it, and says so."""

import hashlib
import json

import numpy as np
import pytest
import tifffile

from spotcheck import store
from spotcheck.cli import main
from spotcheck.cli.vocabulary import set_choice
from spotcheck.model.effects import Choice
from spotcheck.pages.effects import RANDOM_EXAMPLE
from spotcheck.simulation import STACK
from tests.library import small_set as small
from tests.library.conftest import folder
from tests.library.effect_cases import written


@pytest.fixture(autouse=True)
def the_librarys_again():
    """A command chooses the vocabulary of its process, which here is that of all tests."""
    yield
    set_choice(Choice())


# Brightness of the two modes about their mean.
HOP = 0.04
HOPS = {"angles": [0.0], "repeats": 8}


def hops():
    """Frames of a laser that hops between two modes as a coin has it, and the setting."""
    coin = np.random.default_rng(5)

    def hopping(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + HOP * coin.choice((-1, 1)))

    shots, _, setting = small.frames(hopping, **HOPS)
    return shots, setting


@pytest.mark.slow
def test_a_file_of_ones_own_by_command_line(tmp_path, monkeypatch, capsys):
    """From images to verdict.json and to simulated frames: `judge` says that it does not search for the effect; every
    stage that needs the file is given it, and says so where it is not."""
    monkeypatch.chdir(tmp_path)
    shots, _ = hops()
    rows = [f"frames/f{k}.tif,spot,{s.angle_deg:g},{s.exposure_s:g},{s.repeat}" for k, s in enumerate(shots)]
    sensor = "{bit_depth: 10, gain_dn_per_e: 0.11, read_noise_e: 6.0, black_level_dn: 12.0}"
    folder(tmp_path / "hops", rows, f"{{crop_px: 56, sensor: {sensor}, model: {{photon_budget: linear}}}}")
    for k, shot in enumerate(shots):
        tifffile.imwrite(tmp_path / f"hops/frames/f{k}.tif", shot.pixels().astype(np.uint16))
    file = written(tmp_path, "mode_hopping", RANDOM_EXAMPLE)
    own = ["--effects", "mode_hopping.py", "--without", "power_fluctuation"]
    main(["ingest", "hops", "--output", "frames.nc"])
    main(["crop", "hops", "--frames", "frames.nc", "--output", "crops.nc"])
    main(["sensor", "hops", "--crops", "crops.nc", "--frames", "frames.nc", "--output", "sensor.nc"])
    read = ["hops", "--crops", "crops.nc", "--sensor", "sensor.nc"]
    read += ["--pictures", "discrepancy.nc", "--model", "model.yaml", "--light", "light.nc"]
    main(["judge", *read, "--output", "verdict.json", *own])
    verdict = json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["status"] == "unknown" and not verdict["effects"]
    said = "effects from files are simulated but not searched for in this version: mode_hopping"
    assert {"effect": "all", "why": said} in verdict["not_assessed"] and f"Beware: {said}." in verdict["sentence"]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert verdict["vocabulary"] == {
        "own": [{"name": "mode_hopping", "file": "mode_hopping.py", "sha256": digest}],
        "left_out": ["power_fluctuation"],
    }
    with pytest.raises(SystemExit) as stopped:
        main(["report", "--dataset", "hops", "--results", ".", "--output", "report.html"])
    assert stopped.value.code == 2 and "give every stage the same --effects" in capsys.readouterr().err
    model = tmp_path / "model.yaml"
    plain, hopping = model.read_text(encoding="utf-8"), f"  - name: mode_hopping\n    parameters:\n      rms: {HOP}\n"
    assert "effects: []\n" in plain
    model.write_text(plain.replace("effects: []\n", f"effects:\n{hopping}"), encoding="utf-8")
    simulate = [
        "simulate",
        "hops",
        "--model",
        "model.yaml",
        "--sensor",
        "sensor.nc",
        "--seed",
        "1",
        "--folder",
        "again",
    ]
    with pytest.raises(SystemExit):
        main([*simulate, "--output", "again.nc"])
    assert "model.yaml: effects.0.name is mode_hopping, which is no effect" in capsys.readouterr().err
    main([*simulate, "--output", "again.nc", *own])
    with store.read("again.nc") as ds:
        assert f"mode_hopping.py {digest[:16]}" in ds.attrs["inputs"] and ds.attrs["effects"] == "mode_hopping"
    brightest = np.array([page.max() for page in tifffile.imread(tmp_path / "again" / STACK)], float)
    at = np.array([s.exposure_s == small.EXPOSURES[-1] for s in shots])
    # Two levels, drawn anew: over 8 frames both turn up but once in 2⁷ seeds.
    level = brightest[at] / brightest[at].mean() - 1
    assert level.max() > HOP / 2 and level.min() < -HOP / 2
