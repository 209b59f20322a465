"""The sets on real light: the plan is balanced, and each job is a folder and a truth."""

import json
from collections import Counter
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml

from spotcheck import dataset
from tests.validation.generators.light import beams, draw, generator, hene, plan
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.protocol import Job
from tests.validation.records import ROOT

# The plan


def test_every_beginning_of_the_plan_is_balanced():
    many, total = 1700, sum(plan.SHARES.values())
    jobs = list(islice(generator.plan(generator.FIRST), many))
    assert [job.seed for job in jobs] == list(range(generator.FIRST, generator.FIRST + many))
    for end in (120, 500, many):
        kinds = Counter(job.kind.split(":")[0] for job in jobs[:end])
        for word, part in (("none", 11), ("light", 10), ("one", 42), ("outside", 18), ("tied", 7), ("two", 8),
                           ("hene", 8), ("sheet", 6)):  # fmt: skip
            # Five streams make up those with one effect; each is right to a job.
            assert abs(kinds[word] - end * part / total) <= 5, (end, word)
    strong_ = {design: Counter(job.kind.split(":")[1] for job in jobs if job.kind.startswith("one:")
                               and job.kind.endswith(":50") and job.design == design)
               for design in ("default", "one_exposure", "single_frame")}  # fmt: skip
    assert all(own.total() >= 150 for own in strong_.values())
    assert set(strong_["default"]) == set(VOCABULARY) - set(plan.SHAPES)
    assert not set(strong_["one_exposure"]) & set(plan.NEEDS_EXPOSURES)
    assert max(strong_["default"].values()) - min(strong_["default"].values()) <= 1
    lights = Counter(job.kind.split(":")[2] for job in jobs if job.kind.startswith("one:"))
    assert set(lights) == {"real", "drawn"} and abs(lights["real"] / lights.total() - 0.5) < 0.03
    assert {job.kind.split(":")[1] for job in jobs if job.kind.startswith("outside")} == set(MECHANISMS)
    # Each way of being off, without and beside an effect.
    sheets = {tuple(job.kind.split(":")[1::2]) for job in jobs if job.kind.startswith("sheet") and ":none:" in job.kind}
    assert len(sheets) == 10
    frames = [job for job in jobs if job.kind.startswith("hene")]
    assert len({(job.kind, job.design) for job in frames}) == 9 * len(plan.PUT_IN)
    for k, job in enumerate(frames):
        if job.kind == "hene:rise 6":
            assert any(own.kind == "hene:as it is" and own.design == job.design for own in frames[:k])
    pairs = [job.kind.split(":")[1].split("+") for job in jobs if job.kind.startswith("two")]
    assert not any(set(own) <= group for own in pairs for group in plan.GROUPS)


def test_without_the_shared_folder_what_needs_no_file_is_left(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(beams, "there", lambda: False)
    jobs = list(islice(generator.jobs(1), 300))
    assert "skipped" in capsys.readouterr().err
    assert not any(map(generator.needs_files, jobs)) and {job.kind.split(":")[0] for job in jobs} >= {"one", "none"}
    # The others keep their seeds.
    assert all(job.seed == 1 + job.number for job in jobs) and jobs[-1].number > 400
    assert not generator.write(Job(0, 1, "one:smear:real:50", "default"), tmp_path, tmp_path / "truth.json")


# Folders


def loaded(folder: Path) -> dataset.Dataset:
    """A folder as the library reads it; without errors of the sheet where it does not know them yet."""
    schema = (ROOT / "workflow/spotcheck/schemas/instrument.schema.yaml").read_text(encoding="utf-8")
    if "gain_dn_per_e_stderr" not in schema:
        sheet = yaml.safe_load((folder / "instrument.yaml").read_text(encoding="utf-8"))
        sheet["sensor"] = {k: v for k, v in sheet["sensor"].items() if not k.endswith("_stderr")}
        (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
    return dataset.load(str(folder))


@pytest.mark.parametrize(
    "kind, design, names, frames",
    [("one:smear:drawn:50", "single_frame", ["smear"], 1), ("light:drawn", "single_frame", [], 1),
     ("outside:dust:gauss:15", "one_exposure", ["outside:dust"], None), ("none:gauss", "default", [], 96)],
)  # fmt: skip
def test_a_job_is_a_folder_and_a_truth(tmp_path, kind, design, names, frames):
    for folder in "ab":
        assert generator.write(Job(0, 77, kind, design), tmp_path / folder, tmp_path / f"{folder}.json")
    one, other = (sorted((tmp_path / folder / "frames").iterdir()) for folder in "ab")
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(one, other, strict=True))
    truths = [json.loads((tmp_path / f"{folder}.json").read_text(encoding="utf-8")) for folder in "ab"]
    assert truths[0] == truths[1] and [own["name"] for own in truths[0]["effects"]] == names
    found = loaded(tmp_path / "a")
    # Four angles, 5 to 20 frames each.
    assert len(found.spots) == frames if frames else len(found.spots) in range(20, 81, 4)
    assert tifffile.imread(one[0]).dtype == np.uint16 and one[0].stat().st_size < 80_000
    for own in truths[0]["effects"]:
        assert own["known"] >= own["free"] > 0 and own["wanted"] > 0 and isinstance(own["tied"], bool)


def test_a_sheet_that_is_off_states_its_errors(tmp_path):
    truths, sheets = [], []
    for k, kind in enumerate(("sheet:gain:none:-0.05", "sheet:black_level:none:+0.5", "none:gauss")):
        assert generator.write(Job(0, 9, kind, "single_frame"), tmp_path / f"{k}", tmp_path / "t.json")
        sheets.append(yaml.safe_load((tmp_path / f"{k}" / "instrument.yaml").read_text(encoding="utf-8"))["sensor"])
        truths.append(json.loads((tmp_path / "t.json").read_text(encoding="utf-8")))
    gain, black, plain = sheets
    assert gain["gain_dn_per_e"] == pytest.approx(0.95 * plain["gain_dn_per_e"], rel=1e-4)
    assert black["black_level_dn"] == plain["black_level_dn"] + 0.5 and black["gain_dn_per_e"] == plain["gain_dn_per_e"]
    assert gain["gain_dn_per_e_stderr"] == pytest.approx(0.03 * plain["gain_dn_per_e"], rel=1e-3)
    assert plain["gain_dn_per_e_stderr"] == plain["black_level_dn_stderr"] == 0
    assert truths[0]["sheet_off"] == {"gain": -0.05} and not truths[2]["sheet_off"]


def test_two_effects_and_speckle_on_top(tmp_path):
    case = draw_case(8, "one_exposure", "drawn", [])
    truths = draw.hide(case, ["smear", "row_noise"], 50.0)
    assert [own["name"] for own in truths] == ["smear", "row_noise"] and set(case.effects) == {"smear", "row_noise"}
    counts = [draw._on_top(replace(case, seed=seed)) is not None for seed in range(300)]
    # A third of 300: 100 ± 8.
    assert 65 < sum(counts) < 135
    top = VOCABULARY["speckle"](case, np.random.default_rng(1))
    top.s = 0.3
    (own, grain) = draw.hide(case.only(), ["nonlinearity"], 50.0, top)
    assert grain["on_top"] and grain["parameters"]["contrast"] == 0.3 and own["behind_speckle"] > 0


# Real frames


def test_what_is_put_into_readings_leaves_no_comb():
    """Codes that are bent after rounding leave some of them empty. A smooth histogram stays smooth."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:300, :300] - 150.0
    pixels = np.clip(np.rint(5 + 200 * np.exp(-(x**2 + y**2) / 2 / 60**2) + rng.normal(0, 2, x.shape)), 0, 255)
    naive = np.bincount(np.rint(pixels + 0.15 * pixels**2 / 255).astype(int).ravel(), minlength=256)[20:200]
    bent, name, _ = hene.put(pixels, "bend 0.15", rng)
    codes = np.bincount(bent.astype(int).ravel(), minlength=256)[20:160]
    assert (naive == 0).any() and name == "nonlinearity" and codes.min() > 0
    # Neighbouring counts differ by no more than chance: 8 of their errors, of 140.
    assert np.abs(np.diff(codes) / np.sqrt(codes[1:] + codes[:-1])).max() < 8
    clipped, name, known = hene.put(pixels, "clip 0.7", rng)
    assert clipped.max() == round(known["level"]) and name == "saturation"
    risen, _, known = hene.put(pixels, "rise 6", rng)
    assert np.mean(risen - pixels) == pytest.approx(6, abs=0.05) and known == {"rise": 6.0}
    striped, _, known = hene.put(pixels, "stripes 0.1 9", rng)
    angle = np.radians(known["direction"])
    wave = np.exp(-2j * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / 9)
    assert 2 * np.abs(np.sum((striped - pixels) * wave)) / pixels.sum() == pytest.approx(0.1, rel=0.05)
    assert hene.put(pixels, "as it is", rng)[1:] == ("", {})
    assert all(np.array_equal(a, b) for a, b in pairwise([pixels, hene.put(pixels, "as it is", rng)[0]]))


@pytest.mark.skipif(not beams.there(), reason="real frames lie beside the repository")
def test_a_real_frame_is_a_folder(tmp_path):
    assert generator.write(Job(0, 5, "hene:clip 0.9", "frame 2"), tmp_path / "a", tmp_path / "t.json")
    truth = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))
    assert truth["frame"] == "t-280mm" and truth["effects"][0]["name"] == "saturation"
    assert len(loaded(tmp_path / "a").spots) == 1
