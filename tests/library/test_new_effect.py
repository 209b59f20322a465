"""Mechanisms outside the vocabulary: `unknown` until one file, outside the repository, says what it is; then named."""

import hashlib
import json
from functools import partial

import numpy as np
import pytest
import tifffile

from rig import hidden
from spotcheck import store
from spotcheck.cli import main
from spotcheck.discrepancy.calibration import Kind, calibrate, canonical
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.verdict import discovery_design, judge, verdict_json
from spotcheck.model import effects
from spotcheck.pages.effects import SCATTER
from spotcheck.simulation import STACK
from tests.library import small_verdict as small
from tests.library.conftest import folder
from tests.library.effect_cases import knowing, written
from tests.library.hidden_set import set_of
from tests.library.null_laws import null_law

COMA = '''"""Coma: the flanks reach further on one side."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Place


def tail(view, half, *, c, direction):
    """Exponent of the shape with ρ over 1 + c ρ² cos(θ − direction)/(1 + ρ²)."""
    theta = np.arctan2(view.y - view.y0, view.x - view.x0) - np.deg2rad(direction)
    return half / (1 + c * 2 * half * np.cos(theta) / (1 + 2 * half)) ** 2


EFFECT = Effect(
    name="coma",
    sentence="the spot's flanks reach further on one side",
    place=Place.PROFILE,
    parameters=(Parameter("c", "1", 0.0, 0.9), Parameter("direction", "deg", -np.inf, np.inf)),
    starts=lambda c: [(0.02, angle) for angle in range(0, 360, 45)],
    function=tail,
)
'''


@pytest.fixture(autouse=True)
def the_librarys_again():
    """A command chooses the vocabulary of its process, which here is that of all tests."""
    yield
    effects.choose()


@pytest.mark.slow
def test_what_was_unknown_is_named_by_one_new_file(tmp_path, laws):
    """Frames of the rig: by name, with the strength that it drew within 4 standard errors (false alarm 6e-5)."""
    case = hidden.draw_case(8, "outside:coma:strong", "one_site")
    seen = set_of(case)

    def verdict():
        # Each vocabulary has a null law of its own.
        return verdict_json(
            judge(seen.shots, seen.setting, seen.kind, partial(null_law, laws), Tolerance()), "8", Tolerance()
        )

    before = verdict()
    assert before["status"] == "unknown" and not before["effects"]
    with knowing(written(tmp_path, "coma", COMA)):
        after = verdict()
    assert after["status"] == "named" and [own["name"] for own in after["effects"]] == ["coma"]
    found, drawn = after["effects"][0]["parameters"]["c"], case.truth["outside"]["settings"]["c"]
    assert abs(found["value"] - drawn) < 4 * found["stderr"]
    assert after["gap"]["closed"] > 0.98


# Brightness of the two modes about their mean.
HOP = 0.04


def hops():
    """Frames of a laser that hops between two modes as a coin has it, each with the setting of the base model."""
    coin = np.random.default_rng(5)

    def hopping(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + HOP * coin.choice((-1, 1)))

    shots, _, setting = small.frames(hopping, repeats=8)
    return shots, setting


@pytest.mark.slow
def test_a_scatter_of_ones_own_is_named_by_one_new_file(tmp_path):
    """The page's example, on frames drawn here. A power meter rules out that the brightness scatters without order, so
    that effect is left out: `unknown` without the file, named with it, and its rms within 4 standard errors. These are
    a normal law's; two levels scatter less, so that a false alarm is rarer than 6e-5.

    Where nothing is left out the two leave the same trace, and both are answers.
    """
    shots, setting = hops()
    kind = Kind(small.SIDE, 10, "linear", False)
    # What only scatters enters no statistic: one law serves all vocabularies.
    null = calibrate(canonical(discovery_design(shots)[0]), kind, 110, 1)
    file = written(tmp_path, "mode_hopping", SCATTER)

    def verdict():
        return verdict_json(judge(shots, setting, kind, lambda design, kind: null, Tolerance()), "hops", Tolerance())

    with knowing(without=["power_fluctuation"]):
        before = verdict()
    assert before["status"] == "unknown" and not before["effects"]
    with knowing(file, without=["power_fluctuation"]):
        after = verdict()
    assert after["status"] == "named" and after["explanations"] == [["mode_hopping"]]
    found = after["effects"][0]["parameters"]["rms"]
    assert found["unit"] == "1" and abs(found["value"] - HOP) < 4 * found["stderr"]
    assert after["gap"]["closed"] > 0.98
    with knowing(file):
        both = verdict()
    assert both["status"] == "ambiguous"
    assert sorted(both["explanations"]) == [["mode_hopping"], ["power_fluctuation"]]


@pytest.mark.slow
def test_a_file_of_ones_own_by_command_line(tmp_path, monkeypatch, capsys):
    """The same from images to verdict.json and to simulated frames: every stage is given the file, and says so where it
    is not."""
    monkeypatch.chdir(tmp_path)
    shots, _ = hops()
    rows = [f"frames/f{k}.tif,spot,{s.angle_deg:g},{s.exposure_s:g},{s.repeat}" for k, s in enumerate(shots)]
    sensor = "{bit_depth: 10, gain_dn_per_e: 0.11, read_noise_e: 6.0, black_level_dn: 12.0}"
    folder(tmp_path / "hops", rows, f"{{crop_px: 56, sensor: {sensor}, model: {{photon_budget: linear}}}}")
    for k, shot in enumerate(shots):
        tifffile.imwrite(tmp_path / f"hops/frames/f{k}.tif", shot.pixels().astype(np.uint16))
    file = written(tmp_path, "mode_hopping", SCATTER)
    own = ["--effects", "mode_hopping.py", "--without", "power_fluctuation"]
    main(["ingest", "hops", "--output", "frames.nc"])
    main(["crop", "hops", "--frames", "frames.nc", "--output", "crops.nc"])
    main(["sensor", "hops", "--crops", "crops.nc", "--frames", "frames.nc", "--output", "sensor.nc"])
    read = ["hops", "--crops", "crops.nc", "--sensor", "sensor.nc"]
    calibrations = ["--calibrations", "null", "--simulations", "200", "--workers", "2"]
    main(["discrepancy", *read, *calibrations, "--output", "findings.json", *own])
    read += ["--findings", "findings.json"]
    main(["verify", *read, "--output", "gap.nc", *own])
    main(["advise", *read, "--output", "advice.json", *own])
    read += ["--gap", "gap.nc", "--advice", "advice.json", "--pictures", "discrepancy.nc", "--model", "model.yaml"]
    with pytest.raises(SystemExit) as stopped:
        main(["verdict", *read, "--output", "verdict.json"])
    assert stopped.value.code == 2 and "give every stage the same --effects" in capsys.readouterr().err
    main(["verdict", *read, "--output", "verdict.json", *own])
    verdict = json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["status"] == "named" and verdict["explanations"] == [["mode_hopping"]]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert verdict["vocabulary"] == {
        "own": [{"name": "mode_hopping", "file": "mode_hopping.py", "sha256": digest}],
        "left_out": ["power_fluctuation"],
    }
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
    # Two levels, drawn anew: over 16 frames both turn up but once in 2¹⁵ seeds.
    level = brightest[at] / brightest[at].mean() - 1
    assert level.max() > HOP / 2 and level.min() < -HOP / 2
