"""The two examples of effects in a file outside the repository are named by the verdict and simulated.

The designs are those that workflow/docs/own-effect.md states.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from spotcheck.cli import main
from spotcheck.io import store
from spotcheck.model.effects import Choice, choose
from spotcheck.model.simulation import STACK
from tests.reference.numpy_chain import draw
from tests.samples import small_set as small
from tests.samples.effect_cases import MEAN_EXAMPLE, RANDOM_EXAMPLE, written
from tests.samples.small_datasets import folder


@pytest.fixture(autouse=True)
def the_librarys_again():
    """A command chooses the vocabulary of its process, which here is that of all tests."""
    yield
    choose(Choice())


# Brightness of the two modes about their mean.
HOP = 0.04
# Fall-off a of the drawn vignetting, number of sites, side of the frames, and distance of spots from their centre [px].
FALL_OFF, SITES, FRAME_SIDE, DISTANCE = 0.4, 8, 220, 75.0
# Part of a spot's Gaussian above which it is flat.
FLAT_TOP = np.exp(-0.25)


def write_hops(base: Path) -> list[small.SmallFrame]:
    """Write frames of a laser that hops between two modes as a coin falls: 8 sites at one angle, two exposures."""
    coin = np.random.default_rng(5)

    def hopping(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + HOP * coin.choice((-1, 1)))

    frames = small.draw_small(hopping, angles=[0.0], repeats=8)
    small.write_dataset(base, frames)
    return frames


def write_vignetted(base: Path) -> None:
    """Write frames of a vignetted sensor: flat-topped spots at 8 sites around the frame's centre."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:FRAME_SIDE, :FRAME_SIDE].astype(float)
    centre = (FRAME_SIDE - 1) / 2
    factor = np.maximum(1 - FALL_OFF * ((x - centre) ** 2 + (y - centre) ** 2) / 100**2, 0.0)
    widths = {t: small.P1 * np.log(t) + small.P2 for t in small.EXPOSURES}
    strength = {t: t / widths[t] ** 2 for t in small.EXPOSURES}
    rows, images = [], []
    for site in range(SITES):
        direction = 2 * np.pi * site / SITES
        x0, y0 = centre + DISTANCE * np.array([np.cos(direction), np.sin(direction)]) + rng.uniform(-0.5, 0.5, 2)
        for t in small.EXPOSURES:
            peak = small.PEAK * strength[t] / max(strength.values())
            spot = peak * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * widths[t] ** 2))
            light = factor * np.minimum(spot, FLAT_TOP * peak)
            rows.append(f"frames/f{len(rows)}.tif,spot,0,{t!r},{site}")
            images.append(draw(light, t, small.SENSOR, rng))
    model = "{photon_budget: linear, top_hat: true}"
    folder(base, rows, f"{{crop_px: {small.SIDE}, sensor: {small.STATED}, model: {model}}}")
    for k, image in enumerate(images):
        tifffile.imwrite(base / f"frames/f{k}.tif", image)


def judge(name: str, *options: str) -> dict:
    """Return the verdict on a dataset in the working folder, as the subcommands write it."""
    main(["ingest", name, "--output", "frames.nc"])
    main(["crop", name, "--frames", "frames.nc", "--output", "crops.nc"])
    main(["sensor", name, "--crops", "crops.nc", "--frames", "frames.nc", "--output", "sensor.nc"])
    beside = ["--pictures", "discrepancy.nc", "--model", "model.yaml", "--light", "light.nc"]
    main(["judge", name, "--crops", "crops.nc", "--sensor", "sensor.nc", *beside, "--output", "verdict.json", *options])
    return json.loads(Path("verdict.json").read_text(encoding="utf-8"))


def names_of(verdict: dict) -> list[list[str]]:
    """Return the candidates of each effect."""
    return [effect["candidates"] for effect in verdict["effects"]]


@pytest.mark.slow
def test_an_effect_of_the_mean_from_a_file_is_named(tmp_path, monkeypatch):
    """The fall-off lies within 4 standard errors of the drawn one (false alarm 6e-5)."""
    monkeypatch.chdir(tmp_path)
    write_vignetted(tmp_path / "vignetted")
    written(tmp_path, "vignetting", MEAN_EXAMPLE)
    verdict = judge("vignetted", "--effects", "vignetting.py")
    assert verdict["status"] == "named" and names_of(verdict) == [["vignetting"]]
    fall_off = verdict["effects"][0]["parameters"]["a"]
    assert fall_off["unit"] == "1" and abs(fall_off["value"] - FALL_OFF) < 4 * fall_off["stderr"] < 0.05


@pytest.mark.slow
def test_a_random_effect_from_a_file_is_named_and_simulated(tmp_path, monkeypatch, capsys):
    """The command line goes from images to verdict.json and to simulated frames.

    A power meter rules out that the brightness scatters without order, so that effect is left out. Every stage needs
    the same options, and reports if it has others. The rms lies within 4 standard errors of the drawn one; two levels
    scatter less than normal draws, so that a false alarm is rarer than 6e-5.
    """
    monkeypatch.chdir(tmp_path)
    frames = write_hops(tmp_path / "hops")
    file = written(tmp_path, "mode_hopping", RANDOM_EXAMPLE)
    options = ["--effects", "mode_hopping.py", "--without", "power_fluctuation"]
    verdict = judge("hops", *options)
    assert verdict["status"] == "named" and names_of(verdict) == [["mode_hopping"]]
    rms = verdict["effects"][0]["parameters"]["rms"]
    assert rms["unit"] == "1" and abs(rms["value"] - HOP) < 4 * rms["stderr"]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert verdict["vocabulary"] == {
        "own": [{"name": "mode_hopping", "file": "mode_hopping.py", "sha256": digest}],
        "left_out": ["power_fluctuation"],
    }
    with pytest.raises(SystemExit) as stopped:
        main(["report", "--dataset", "hops", "--results", ".", "--output", "report.html"])
    assert stopped.value.code == 2 and "give every stage the same --effects" in capsys.readouterr().err
    simulate = ["simulate", "hops", "--model", "model.yaml", "--sensor", "sensor.nc", "--seed", "1"]
    simulate += ["--folder", "again", "--output", "again.nc"]
    with pytest.raises(SystemExit):
        main(simulate)
    assert "model.yaml: effects.0.name is mode_hopping, which is no effect" in capsys.readouterr().err
    main([*simulate, *options])
    with store.read("again.nc") as ds:
        assert f"mode_hopping.py {digest[:16]}" in ds.attrs["inputs"] and ds.attrs["effects"] == "mode_hopping"
    brightest = np.array([page.max() for page in tifffile.imread(tmp_path / "again" / STACK)], float)
    at_longest = np.array([frame.exposure_s == small.EXPOSURES[-1] for frame in frames])
    # Two levels are drawn anew: both occur in 8 frames but once in 2⁷ seeds.
    level = brightest[at_longest] / brightest[at_longest].mean() - 1
    assert level.max() > HOP / 2 and level.min() < -HOP / 2


@pytest.mark.slow
def test_effects_that_scatter_alike_are_rivals(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_hops(tmp_path / "hops")
    written(tmp_path, "mode_hopping", RANDOM_EXAMPLE)
    verdict = judge("hops", "--effects", "mode_hopping.py")
    assert verdict["status"] == "ambiguous" and names_of(verdict) == [["power_fluctuation", "mode_hopping"]]


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_vignetted, write_hops])
def test_nothing_else_takes_the_name_of_a_missing_effect(write, tmp_path, monkeypatch):
    """Without the file its effect is not named, and neither is one of the library that leaves other traces.

    A vignetted spot lies nearer to the frame's centre the wider it is, which is the trace of `pointing_jitter`.
    """
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "frames_without_a_name")
    verdict = judge("frames_without_a_name", "--without", "power_fluctuation")
    assert [name for names in names_of(verdict) for name in names] in ([], ["pointing_jitter"])
