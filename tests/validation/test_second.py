"""That the second generator keeps the contract, and hides what its plan says."""

import json
from itertools import islice

import numpy as np
import pytest
import tifffile

from spotcheck import dataset
from tests.validation.generators.second import generator
from tests.validation.generators.second.case import DESIGNS
from tests.validation.generators.second.draw import write_case
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.outside import MECHANISMS
from tests.validation.protocol import Job


@pytest.mark.parametrize("names", [[], ["saturation"], ["speckle", "dark_offset"], ["outside:donut"]])
def test_a_folder_keeps_the_contract_and_a_seed_its_frames(tmp_path, names):
    truths = [write_case(generator.FIRST - 1, names, "one_site", tmp_path / folder) for folder in "ab"]
    found = dataset.load(str(tmp_path / "a"))
    assert len(found.frames) == 3 and found.instrument.sensor.bit_depth == 10
    one, other = (sorted((tmp_path / folder / "frames").iterdir()) for folder in "ab")
    assert all(np.array_equal(tifffile.imread(a), tifffile.imread(b)) for a, b in zip(one, other, strict=True))
    # Floating-point parameters of one seed are the same to the last bit.
    assert truths[0]["effects"] == truths[1]["effects"] and truths[0]["base"] == truths[1]["base"]
    assert [own["name"] for own in truths[0]["effects"]] == names


def test_the_plan_has_every_effect_mechanism_and_design():
    plan = list(islice(generator.jobs(generator.FIRST), 400))
    alone = {job.kind.split(":")[1] for job in plan if job.kind.startswith(("one", "outside"))}
    assert alone == {*VOCABULARY, *MECHANISMS}
    assert {job.design for job in plan if job.kind == "none"} == set(DESIGNS)
    assert len({job.seed for job in plan}) == len(plan)


@pytest.mark.parametrize(
    "kind, names",
    [("none", []), ("one:smear:strong", ["smear"]), ("two:smear+speckle:strong", ["smear", "speckle"]),
     ("outside:donut:strong", ["outside:donut"])],
)  # fmt: skip
def test_a_job_says_what_is_hidden(tmp_path, monkeypatch, kind, names):
    monkeypatch.setattr(generator, "write_case", lambda seed, hidden, design, folder: {"effects": hidden})
    assert generator.write(Job(0, 1, kind, "one_site"), tmp_path, tmp_path / "truth.json")
    assert json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))["effects"] == names
