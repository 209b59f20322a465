"""The search's own eyes: crop, fit, scores, and that it repeats itself."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from rig import cli, exposure, measure, papersim, plan, scores, screen, search, trial
from rig.settings import load, replace

ROOT = Path(__file__).parents[2]
DEFAULT = ROOT / "data/virtual-rig/rig.yaml"


def gaussian(amplitude=900.0, x0=123.4, y0=117.8, long=16.0, short=12.0, turn=0.6, offset=3.0):
    y, x = np.mgrid[:240, :240].astype(float)
    u = (x - x0) * math.cos(turn) + (y - y0) * math.sin(turn)
    v = -(x - x0) * math.sin(turn) + (y - y0) * math.cos(turn)
    return amplitude * np.exp(-0.5 * ((u / long) ** 2 + (v / short) ** 2)) + offset


def small_plan(folder, repeats=2):
    rows = [
        f"frames/{a}_{r}_{t}.tif,spot,{a},{t}e-4,{r}"
        for r in range(repeats)
        for a in (0, 45, 90, 135)
        for t in (1, 5, 9)
    ]
    text = "file,kind,angle_deg,exposure_s,repeat\n" + "\n".join(rows) + "\n"
    (folder / "manifest.csv").write_text(text, encoding="utf-8")
    return folder


def test_the_fit_finds_an_exact_gaussian():
    fit = measure.fit_gaussian(gaussian())
    assert fit.amplitude == pytest.approx(900.0, rel=1e-6)
    assert fit.offset == pytest.approx(3.0, rel=1e-4)
    assert (fit.x_px, fit.y_px) == pytest.approx((123.4, 117.8), abs=1e-5)
    assert (fit.sigma_long_px, fit.sigma_short_px) == pytest.approx((16.0, 12.0), rel=1e-6)
    assert fit.sigma_px == pytest.approx(14.0, rel=1e-6)


def test_the_fit_stands_at_the_least_square():
    clipped = np.minimum(gaussian(amplitude=3000.0), 800.0)
    fit = measure.fit_gaussian(clipped)

    def cost(**change):
        best = {"amplitude": fit.amplitude, "x0": fit.x_px, "y0": fit.y_px, "offset": fit.offset}
        shape = {"long": fit.sigma_long_px, "short": fit.sigma_short_px}
        return float(np.sum((clipped - gaussian(**(best | shape | change))) ** 2))

    for name, value in (("amplitude", fit.amplitude), ("x0", fit.x_px), ("long", fit.sigma_long_px)):
        assert cost() < min(cost(**{name: value * 1.002}), cost(**{name: value * 0.998}))


def test_the_left_most_then_top_most_maximum_is_the_origin():
    frame = np.zeros((400, 400))
    for row, column in ((200, 180), (190, 180), (150, 181)):
        frame[row, column] = 7
    crop = measure.crop_at_maximum(frame)
    assert crop.shape == (240, 240)
    assert crop[120, 120] == crop[130, 120] == crop[80, 121] == 7
    with pytest.raises(ValueError, match="border"):
        measure.crop_at_maximum(np.eye(300))


def test_contrast_peak_share_and_psnr_by_hand():
    crop = np.zeros((240, 240))
    crop[:2, :50] = 100.0
    crop[:1, :5] = 104.0
    assert measure.peak_share(crop) == pytest.approx(5 / 100)
    assert measure.contrast(gaussian(offset=0.0, long=12.0)) == pytest.approx(
        math.sqrt(240**2 / (4 * math.pi * 144) - 1), rel=1e-6
    )
    assert measure.psnr_db(crop, crop + 65.535) == pytest.approx(60.0)


def test_the_simulated_spot_follows_the_published_law():
    law = papersim.Law(2.48, 34.55, 1.189, 1000.0)
    widths = [law.sigma_px(t) for t in (1e-4, 5e-4, 9e-4)]
    assert widths == pytest.approx([12.90, 16.89, 18.34], abs=0.02)
    peaks = [law.peak_dn(t) / 1000.0 for t in (1e-4, 5e-4, 9e-4)]
    assert peaks == pytest.approx([0.825, 0.865, 0.876], abs=1.5e-3)
    crop = papersim.simulate(load(DEFAULT), law, 9e-4, np.random.default_rng(1))
    assert measure.contrast(crop) == pytest.approx(3.48, abs=0.1)


def test_a_score_counts_its_ends_and_misses_outside():
    assert scores.Score("n", 2.0, 2.0, 4.0).is_met
    assert not scores.Score("n", 1.99, 2.0, 4.0).is_met
    assert scores.Score("n", 3.0, 2.0, 4.0).miss == 0.0
    assert scores.Score("n", 5.0, 2.0, 4.0).miss == pytest.approx(0.6)
    assert not scores.Score("n", math.nan, 2.0, 4.0).is_met
    assert scores.Score("n", math.nan, 2.0, 4.0).miss == 10.0


@pytest.mark.slow
def test_the_default_rig_holds_most_of_the_paper_s_numbers():
    sites = plan.sites(plan.read_plan(DEFAULT.parent))
    rig = load(DEFAULT)
    seen = trial.measured(rig, sites)
    held = scores.score(seen, scores.simulate_set(rig, seen, seed=0))
    # The README claims 34; two of them may be moved over an edge by the draw of the simulation.
    assert sum(one.is_met for one in held) >= 32, [one for one in held if not one.is_met]
    # The forecast that screens the candidates: means of widths within 1 %, of amplitudes within 3 %.
    widths, amplitudes, _, _ = screen._tables(rig, sites)
    np.testing.assert_allclose(widths.mean(axis=2), seen.tables["sigma_px"].mean(axis=2), rtol=0.01)
    np.testing.assert_allclose(amplitudes.mean(axis=2), seen.tables["amplitude"].mean(axis=2), rtol=0.03)


@pytest.mark.slow
def test_a_small_search_repeats_itself(tmp_path):
    small_plan(tmp_path)
    texts = []
    for name in ("one", "two"):
        table, best = tmp_path / f"{name}.csv", tmp_path / f"{name}.yaml"
        effort = ["--seed", "3", "--draws", "3", "--trials", "1", "--refinements", "1"]
        files = ["--settings", str(DEFAULT), "--table", str(table), "--best", str(best)]
        assert cli.main(["search", str(tmp_path), *files, *effort]) == 0
        texts.append((table.read_text(), best.read_text()))
    assert texts[0] == texts[1]
    assert texts[0][0].count("\n") == 3
    tree = yaml.safe_load(texts[0][1])
    assert search.SPACE["sensor.clip_level_e"][0] <= tree["sensor"]["clip_level_e"] <= 7050


def test_the_search_wants_a_full_grid(tmp_path, capsys):
    folder = small_plan(tmp_path)
    lines = (folder / "manifest.csv").read_text().splitlines()
    (folder / "manifest.csv").write_text("\n".join(lines[:-1]) + "\n")
    arguments = ["score", str(folder), "--settings", str(DEFAULT)]
    assert cli.main(arguments) == 1
    assert "full grid" in capsys.readouterr().err


def test_a_changed_setting_changes_only_its_own_effect():
    sites = plan.sites(plan.read_plan(DEFAULT.parent))[:1]
    rig = load(DEFAULT)
    one, two = (exposure.light(replace(rig, {"material.reflectance": r}), sites[0]) for r in (0.02, 0.03))
    np.testing.assert_array_equal(one.irradiance, two.irradiance)
