"""What validation asks of the engine's inside (ENGINE: goes with tests.validation.engine)."""

import json
import math
from functools import partial
from itertools import zip_longest

import pytest

from rig import hidden
from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.verdict import judge as judge_in_memory
from spotcheck.discrepancy.verdict import verdict_json
from tests.library.hidden_set import set_of
from tests.library.null_laws import NULLS, null_law
from tests.validation import judge, outcome
from tests.validation.generators.rig import generator
from tests.validation.protocol import Job

# A hidden ellipse at one angle.
JOB = Job(0, 31000, "one:fibre_anisotropy:strong", "one_site")


@pytest.mark.slow
@pytest.mark.xdist_group("rig")
def test_frames_that_are_asked_for_tell(laws, monkeypatch):
    """Ambiguous, and named after the advised frame is made; a condition at random does not do it. In memory the verdict
    is that of folder, TIFF and command line."""
    monkeypatch.setattr(generator, "NULL_SETS", NULLS)
    record = judge.record_of("rig", JOB, laws)
    assert outcome.status(record) == "ambiguous" and record["advised"]["left"] == [["fibre_anisotropy"]]
    assert outcome.told_apart(record)
    assert not outcome.told_apart(record | {"advised": record["advised"] | {"any": [record["advised"]["needed"]]}})
    assert not outcome.told_apart(record | {"advised": {"frames": None}})

    seen = set_of(hidden.draw_case(JOB.seed, JOB.kind, JOB.design))
    found = judge_in_memory(seen.shots, seen.setting, seen.kind, partial(null_law, laws), Tolerance())
    own = json.loads(json.dumps(verdict_json(found, "", Tolerance())))
    # What only the command adds, and the name of the folder.
    beside = ("dataset", "where", "sentence")
    for one, other in zip_longest(leaves(own, beside), leaves(record["verdict"], beside)):
        if isinstance(one[1], float):
            # verdict.json has nine digits.
            assert one[0] == other[0] and math.isclose(one[1], other[1], rel_tol=1e-6, abs_tol=1e-9), (one, other)
        else:
            assert one == other


def leaves(value, without=(), where=""):
    """Every number and text of nested objects, with its place."""
    if isinstance(value, dict):
        for key in sorted(value.keys() - set(without)):
            yield from leaves(value[key], (), f"{where}.{key}")
    elif isinstance(value, list):
        for k, own in enumerate(value):
            yield from leaves(own, (), f"{where}[{k}]")
    else:
        yield where, value
