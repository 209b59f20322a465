"""The sets on real light: the plan is balanced, and each job is a folder and a truth."""

import json
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import tifffile

from spotcheck.dataset import folder as dataset
from tests.validation.generators.light import beams, draw, generator, hene, plan
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.protocol import Job

# The plan


def test_every_beginning_of_the_plan_covers_all_rows():
    jobs = list(plan.plan(generator.FIRST))
    assert [job.seed for job in jobs] == list(range(generator.FIRST, generator.FIRST + generator.JOBS))
    for end in (120, 300, len(jobs)):
        rows = Counter(job.kind.split(":")[0] for job in jobs[:end])
        # Each row is within a job of its share.
        for row, wanted in plan.COUNTS.items():
            assert abs(rows[row] - end * wanted / len(jobs)) <= 1.5, (end, row)
    for row in ("strong gauss", "weak gauss", "strong real", "weak real"):
        assert {job.kind.split(":")[1] for job in jobs if job.kind.startswith(f"{row}:")} == set(VOCABULARY)
    assert {job.kind.split(":")[1] for job in jobs if job.kind.startswith("outside:")} == set(MECHANISMS) - {
        plan.DOCUMENTED
    }
    exposed = {job.kind.split(":")[1] for job in jobs if job.design == "one_exposure"}
    assert not exposed & set(plan.NEEDS_EXPOSURES)
    frames = [job for job in jobs if job.kind.startswith("frame:")]
    assert len({(job.kind, job.design) for job in frames}) == len(frames) == plan.FRAMES * (1 + len(plan.PUT_IN))
    pairs = [job.kind.split(":")[1].split("+") for job in jobs if job.kind.startswith("two:")]
    assert not any(set(own) <= group for own in pairs for group in plan.CONFOUNDED)
    lights = Counter(job.kind.split(":")[2] for job in jobs if job.kind.startswith(("nothing:", "two:", "outside:")))
    assert lights["real"] == lights["gauss"]


def test_without_the_shared_folder_what_needs_no_file_is_left(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(beams, "there", lambda: False)
    jobs = list(generator.jobs(1))
    assert "skipped" in capsys.readouterr().err
    assert not any(map(generator.needs_files, jobs)) and {job.kind.split(":")[0] for job in jobs} >= {"two", "nothing"}
    # The others keep their seeds.
    assert all(job.seed == 1 + job.number for job in jobs) and jobs[-1].number > 400
    assert not generator.write(Job(0, 1, "two:smear+speckle:real:50", "default"), tmp_path, tmp_path / "truth.json")


# Folders


@pytest.mark.parametrize(
    "kind, design, names, frames",
    [("single frame:smear:drawn:50", "single_frame", ["smear"], 1), ("nothing::drawn:0", "single_frame", [], 1),
     ("outside:dust:gauss:15", "one_exposure", ["outside:dust"], None), ("nothing::gauss:0", "default", [], 96)],
)  # fmt: skip
def test_a_job_is_a_folder_and_a_truth(tmp_path, kind, design, names, frames):
    for folder in "ab":
        assert generator.write(Job(0, 77, kind, design), tmp_path / folder, tmp_path / f"{folder}.json")
    one, other = (sorted((tmp_path / folder / "frames").iterdir()) for folder in "ab")
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(one, other, strict=True))
    truths = [json.loads((tmp_path / f"{folder}.json").read_text(encoding="utf-8")) for folder in "ab"]
    assert truths[0] == truths[1] and [own["name"] for own in truths[0]["effects"]] == names
    found = dataset.load(str(tmp_path / "a"))
    # Four angles, 5 to 20 frames each.
    assert len(found.spots) == frames if frames else len(found.spots) in range(20, 81, 4)
    assert tifffile.imread(one[0]).dtype == np.uint16 and one[0].stat().st_size < 80_000
    for own in truths[0]["effects"]:
        assert own["known"] >= own["free"] > 0 and own["wanted"] > 0 and isinstance(own["tied"], bool)


@pytest.mark.skipif(not beams.there(), reason="real beams lie beside the repository")
def test_an_unaltered_set_has_the_light_and_the_sheet_of_the_other(tmp_path):
    """Beam, data sheet and law are those of the set with smear; only its effects are missing."""
    jobs = [
        Job(0, 51_000_007, kind, "single_frame")
        for kind in ("strong real:smear:real:50", "unaltered:strong real:smear:real")
    ]
    truths = [draw.write_job(job, tmp_path / job.kind[:6]) for job in jobs]
    sheets = [(tmp_path / job.kind[:6] / "instrument.yaml").read_text().replace(job.kind[:6], "") for job in jobs]
    assert sheets[0] == sheets[1]
    assert truths[0]["light"] == truths[1]["light"] and truths[0]["base"] == truths[1]["base"]
    assert truths[0]["effects"] and not truths[1]["effects"]
    assert all(len(list((tmp_path / job.kind[:6] / "frames").iterdir())) == 1 for job in jobs)


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
    assert generator.write(Job(0, 5, "frame:clip 0.9", "frame 2"), tmp_path / "a", tmp_path / "t.json")
    truth = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))
    assert truth["frame"] == "t-280mm" and truth["effects"][0]["name"] == "saturation"
    assert len(dataset.load(str(tmp_path / "a")).spots) == 1
