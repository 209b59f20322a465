"""That the second generator keeps the contract, and that its sets are counted as they should be."""

import numpy as np
import pytest
import tifffile

from spotcheck import dataset
from tests.second.case import DESIGNS
from tests.second.draw import write_case
from tests.second.effects import VOCABULARY
from tests.second.judge import FIRST, outcome, plan
from tests.second.outside import MECHANISMS


@pytest.mark.parametrize("names", [[], ["saturation"], ["speckle", "dark_offset"], ["outside:donut"]])
def test_a_folder_keeps_the_contract_and_a_seed_its_frames(tmp_path, names):
    truths = [write_case(FIRST - 1, names, "one_site", tmp_path / folder) for folder in "ab"]
    found = dataset.load(str(tmp_path / "a"))
    assert len(found.frames) == 3 and found.instrument.sensor.bit_depth == 10
    one, other = (sorted((tmp_path / folder / "frames").iterdir()) for folder in "ab")
    assert all(np.array_equal(tifffile.imread(a), tifffile.imread(b)) for a, b in zip(one, other, strict=True))
    # Floating-point parameters of one seed are the same to the last bit.
    assert truths[0]["effects"] == truths[1]["effects"] and truths[0]["base"] == truths[1]["base"]
    assert [own["name"] for own in truths[0]["effects"]] == names


def test_the_plan_has_every_effect_mechanism_and_design():
    jobs = [job for job, _ in zip(plan(FIRST), range(400), strict=False)]
    alone = {job.effects[0] for job in jobs if len(job.effects) == 1}
    assert alone == set(VOCABULARY) | {f"outside:{name}" for name in MECHANISMS}
    assert {job.design for job in jobs if not job.effects} == set(DESIGNS)
    assert len({job.seed for job in jobs}) == len(jobs)


def verdict(status, *explanations):
    named = explanations[0] if explanations else []
    return {"status": status, "effects": [{"name": name} for name in named], "explanations": list(explanations)}


@pytest.mark.parametrize(
    "effects, own, expected",
    [
        ((), verdict("consistent"), "right"),
        ((), verdict("unknown"), "unknown"),
        ((), verdict("named", ["smear"]), "wrong"),
        (("smear",), verdict("named", ["smear"]), "right"),
        (("smear",), verdict("ambiguous", ["speckle"], ["smear"]), "tied"),
        (("smear",), verdict("ambiguous", ["speckle"], ["row_noise"]), "wrong"),
        (("smear",), verdict("named", ["smear", "speckle"]), "wrong"),
        (("smear",), verdict("consistent"), "unseen"),
        (("smear", "speckle"), verdict("named", ["speckle", "smear"]), "right"),
        (("smear", "speckle"), verdict("unknown"), "unknown"),
        (("outside:donut",), verdict("unknown"), "right"),
        (("outside:donut",), verdict("consistent"), "unseen"),
        (("outside:donut",), verdict("named", ["super_gaussian"]), "wrong"),
        (("outside:donut",), verdict("not_assessed"), "wrong"),
    ],
)
def test_what_becomes_of_a_set(effects, own, expected):
    assert outcome(effects, own) == expected
