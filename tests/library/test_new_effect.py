"""Mechanisms outside the vocabulary: `unknown` until one file, outside the repository, says what it is; then named."""

import hashlib
import json

import numpy as np
import pytest
import tifffile

from spotcheck import store
from spotcheck.cli import main
from spotcheck.discrepancy.conclude.judge import judge
from spotcheck.discrepancy.verdict.document import document
from spotcheck.model import effects
from spotcheck.pages.effects import SCATTER
from spotcheck.simulation import STACK
from tests.library import small_set as small
from tests.library.conftest import folder
from tests.library.effect_cases import knowing, written

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


def verdict_of(shots, setting) -> dict:
    """The verdict by all effects that are known."""
    return document(judge(shots, setting, list(effects.vocabulary().values())), "own")


# Strength and direction [deg] of the coma that is drawn.
DRAWN = 0.12, 30.0


def coma(dx, dy, angle, exposure, sigma, spot):
    """The file's light, written out once more: ρ over 1 + c ρ² cos(θ − direction)/(1 + ρ²)."""
    rho, theta = np.hypot(dx, dy) / sigma, np.arctan2(dy, dx) - np.deg2rad(DRAWN[1])
    rho = rho / (1 + DRAWN[0] * rho**2 * np.cos(theta) / (1 + rho**2))
    return small.LAW.peak * np.exp(-(rho**2) / 2)


@pytest.mark.slow
def test_what_was_unknown_is_named_by_one_new_file(tmp_path):
    """Before, no effect of the library is named, at most a learned shape describes it; after, it is named, with what
    was drawn within 4 standard errors (false alarm 1.3e-4 of both)."""
    shots, _, setting = small.frames(coma, angles=[0.0], exposures=[None], repeats=4)
    before = verdict_of(shots, setting)
    assert {name for own in before["effects"] for name in own["candidates"]} <= {"beam_profile"}, before["effects"]
    assert before["status"] in ("unknown", "named", "named_more_remains")
    with knowing(written(tmp_path, "coma", COMA)):
        after = verdict_of(shots, setting)
    assert after["status"] == "named" and [own["name"] for own in after["effects"]] == ["coma"]
    for (name, found), drawn in zip(after["effects"][0]["parameters"].items(), DRAWN, strict=True):
        assert abs(found["value"] - drawn) < 4 * found["stderr"], name
    assert after["gap"]["closed"] > 0.98


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
def test_a_scatter_of_ones_own_is_named_by_one_new_file(tmp_path):
    """The page's example, on frames drawn here. A power meter rules out that the brightness scatters without order, so
    that effect is left out: not named without the file, named with it, and its rms within 4 standard errors. These are
    a normal law's; two levels scatter less, so that a false alarm is rarer than 6e-5.

    Where nothing is left out the two leave the same trace, and both are answers.
    """
    shots, setting = hops()
    file = written(tmp_path, "mode_hopping", SCATTER)
    with knowing(without=["power_fluctuation"]):
        before = verdict_of(shots, setting)
    assert before["status"] == "unknown" and not before["effects"]
    with knowing(file, without=["power_fluctuation"]):
        after = verdict_of(shots, setting)
    assert after["status"] == "named" and [own["name"] for own in after["effects"]] == ["mode_hopping"]
    found = after["effects"][0]["parameters"]["rms"]
    assert found["unit"] == "1" and abs(found["value"] - HOP) < 4 * found["stderr"]
    with knowing(file):
        both = verdict_of(shots, setting)
    assert both["status"] == "ambiguous"
    assert sorted(both["effects"][0]["candidates"]) == ["mode_hopping", "power_fluctuation"]


@pytest.mark.slow
def test_a_file_of_ones_own_by_command_line(tmp_path, monkeypatch, capsys):
    """The same from images to verdict.json and to simulated frames: every stage that needs the file is given it, and
    says so where it is not."""
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
    read += ["--pictures", "discrepancy.nc", "--model", "model.yaml", "--light", "light.nc"]
    main(["judge", *read, "--output", "verdict.json", *own])
    verdict = json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["status"] == "named" and [own["name"] for own in verdict["effects"]] == ["mode_hopping"]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert verdict["vocabulary"] == {
        "own": [{"name": "mode_hopping", "file": "mode_hopping.py", "sha256": digest}],
        "left_out": ["power_fluctuation"],
    }
    with pytest.raises(SystemExit) as stopped:
        main(["report", "--dataset", "hops", "--results", ".", "--output", "report.html"])
    assert stopped.value.code == 2 and "give every stage the same --effects" in capsys.readouterr().err
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
