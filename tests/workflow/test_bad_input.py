"""Each bad input ends with a non-zero status and one sentence, no traceback, and earlier results stay as they were."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from spotcheck.cli import main
from tests.conftest import snakemake
from tests.discrepancy import test_bad_cases as bad_cases
from tests.discrepancy.test_bad_cases import SHAPE, Case, spots, written


def edit(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text in a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def first_frame(folder: Path) -> Path:
    """The frame of the manifest's first row."""
    return folder / (folder / "manifest.csv").read_text().splitlines()[1].split(",")[0]


def rewrite(folder: Path, change) -> None:
    """Write the first frame again, changed."""
    path = first_frame(folder)
    tifffile.imwrite(path, change(tifffile.imread(path)))


def cut_short(folder: Path) -> None:
    """Keep the first half of the first frame's bytes."""
    content = first_frame(folder).read_bytes()
    first_frame(folder).write_bytes(content[: len(content) // 2])


# Mistakes that are not in the table of the dataset contract, and two that are, for the workflow. A test in
# tests/project/test_docs.py tries every mistake of the table.
CASES = {
    "cut short": (cut_short, ["a0_r0_t0.0001.tif", "cut short"]),
    "float": (lambda f: rewrite(f, lambda p: p.astype("f4")), ["a0_r0_t0.0001.tif", "floating-point", "unsigned"]),
    "signed": (lambda f: rewrite(f, lambda p: p.astype("i2")), ["a0_r0_t0.0001.tif", "int16", "unsigned"]),
    "above bit depth": (
        lambda f: rewrite(f, lambda p: np.where(p == p.max(), 5000, p).astype("u2")),
        ["a0_r0_t0.0001.tif", "5000", "bit_depth 10"],
    ),
    "another size": (lambda f: rewrite(f, lambda p: p[:-20]), ["400 × 340 px", "one size"]),
    "unknown kind": (lambda f: edit(f / "manifest.csv", "spot", "sopt"), ["line 2", "sopt", "spot, dark, flat"]),
    "negative exposure": (lambda f: edit(f / "manifest.csv", ",0.0001,", ",-0.0001,"), ["line 2", "positive"]),
    "path outside": (lambda f: edit(f / "manifest.csv", "frames/", "../frames/"), ["line 2", "inside"]),
    "wrong type": (
        lambda f: edit(f / "instrument.yaml", "f_number: 11", "f_number: eleven"),
        ["instrument.yaml", "optics.f_number", "eleven", "a number"],
    ),
}


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every result below a folder, logs and sidecars apart."""
    files = (p for p in folder.rglob("*") if p.is_file() and not {"logs", "benchmarks", ".runs"} & set(p.parts))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def good_results(small_frames, tmp_path_factory) -> Path:
    """What a good run of ingest left."""
    root = tmp_path_factory.mktemp("good")
    run = snakemake("--until", "ingest", config={"dataset": small_frames, "results": root})
    assert run.returncode == 0, run.stdout + run.stderr
    return root / small_frames.name


def refused(output: str, words: list[str]) -> None:
    """One sentence, with all that has to be in it, and no traceback."""
    sentences = {line for line in output.splitlines() if line.startswith("spotcheck: ")}
    assert len(sentences) == 1, output
    assert all(word in next(iter(sentences)) for word in words), sentences
    assert "Traceback" not in output


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gets_one_line(case, frames_only, tmp_path, capsys):
    """The sentence names file, row or key, what is wrong, what would be right; an earlier result stays as it was."""
    earlier = tmp_path / "frames.nc"
    earlier.write_bytes(b"the earlier result")
    change, words = CASES[case]
    change(frames_only)
    with pytest.raises(SystemExit) as stopped:
        main(["ingest", str(frames_only), "--output", str(earlier)])
    assert stopped.value.code == 2
    refused(capsys.readouterr().err, words)
    assert earlier.read_bytes() == b"the earlier result"


@pytest.mark.slow
@pytest.mark.parametrize("case", ["unknown kind", "above bit depth"])
def test_the_workflow_says_it_and_loses_nothing(case, frames_only, good_results, tmp_path):
    """A fault that shows before a job starts, and one that a job finds: results of a good run are untouched."""
    results = shutil.copytree(good_results, tmp_path / "results" / "mine")
    (results / ".dataset").write_text(f"{frames_only}\n")
    before = digests(results)
    assert "frames.nc" in before
    change, words = CASES[case]
    change(frames_only)
    bad = snakemake("--until", "ingest", config={"dataset": frames_only, "results": tmp_path / "results"})
    assert bad.returncode != 0
    refused(bad.stdout + bad.stderr, words)
    assert digests(results) == before


@pytest.mark.slow
def test_unwritable_results(frames_only, tmp_path):
    """A results folder that cannot be made: here a file stands in its way, which stops root as well."""
    (tmp_path / "file").write_text("")
    bad = snakemake("--until", "ingest", config={"dataset": frames_only, "results": tmp_path / "file"})
    assert bad.returncode != 0
    assert "cannot be written" in bad.stderr
    assert "Traceback" not in bad.stdout + bad.stderr


def test_same_name_in_one_results_root(frames_only, small_run, tmp_path):
    """Two datasets of one name do not share a folder of results."""
    twin = tmp_path / "elsewhere" / small_run.name
    shutil.copytree(frames_only, twin)
    bad = snakemake("--until", "ingest", config={"dataset": twin, "results": small_run.parent})
    assert bad.returncode != 0
    assert "another folder of the same name" in bad.stderr


@pytest.mark.slow
def test_no_such_dataset():
    """A name that is no dataset."""
    bad = snakemake("-n", config={"dataset": "nowhere"})
    assert bad.returncode != 0
    assert "nowhere: no folder with a manifest.csv" in bad.stderr


@pytest.mark.slow
def test_a_black_and_a_saturated_frame_are_no_error(tmp_path):
    """Single frames that are black or saturated all over are flagged, and everything else still comes out."""
    frames = spots()
    frames[0], frames[-1] = (frames[k]._replace(pixels=np.full(SHAPE, dn)) for k, dn in ((0, 0), (-1, 1023)))
    folder = written(Case(frames), tmp_path)
    run = snakemake("--until", "report", config={"dataset": folder, "results": tmp_path / "results"})
    assert run.returncode == 0, run.stdout + run.stderr
    page = (tmp_path / "results" / folder.name / "report.html").read_text()
    assert "f0.tif" in page and "no light above the noise" in page
    assert "f11.tif" in page and "hardly a pixel of the crop reads below full scale" in page


# Folders of frames that hold nothing to judge: the workflow ends well, and verdict and report say why.
SATURATED = "none of 12 spot frames can be used (hardly a pixel of the crop reads below full scale)"
NO_SPOT = "the manifest names no frame of kind spot"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "why"), [("saturated everywhere", SATURATED), ("flats and darks alone", NO_SPOT)])
def test_nothing_to_judge(name, why, tmp_path):
    """Exit status 0, `not_assessed`, and the reason in both places."""
    where = {"dataset": written(bad_cases.CASES[name](), tmp_path), "results": tmp_path / "results"}
    run = snakemake("--until", "report", config=where)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "Traceback" not in run.stdout + run.stderr
    results = tmp_path / "results" / "set"
    verdict = json.loads((results / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["status"] == "not_assessed" and why in verdict["sentence"]
    assert why in (results / "report.html").read_text(encoding="utf-8")
