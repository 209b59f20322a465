"""Records on disk: whole after a crash, and reduced to what the scores read of them."""

import numpy as np
import pytest

from tests.validation import records, score
from tests.validation.test_scores import one, record


def test_records_outlive_a_crash(tmp_path):
    path = tmp_path / "new" / "jobs.jsonl"
    assert records.read(path) == []
    writer = records.Writer(path)
    writer.add({"a": 1})
    writer.close()
    path.write_text(path.read_text() + '{"a": 2, "b"')
    writer = records.Writer(path)
    writer.add({"a": 3})
    writer.close()
    assert records.read(path) == [{"a": 1}, {"a": 3}]
    with pytest.raises(ValueError):
        records.Writer(path).add({"a": float("nan")})


def test_what_is_published_scores_the_same(tmp_path, monkeypatch):
    """Nothing that a score reads is lost, and what was passed over is not kept."""
    monkeypatch.setattr(records, "PUBLISHED", tmp_path / "published.jsonl.xz")
    strong = one("nonlinearity", [["nonlinearity"]])
    strong["verdict"]["effects"][0]["parameters"] = {"q": {"value": 0.10312345678, "stderr": 0.002, "unit": "1"}}
    rows = [record("none"), strong, record("none") | {"outcome": "passed over"}]
    records.publish(rows, "abc", {"consistent": [20.0]})
    head, kept = records.published()
    assert head == {"commit": "abc", "first": 5_000_000, "times": {"consistent": [20.0]}}
    assert len(kept) == 2 and "number" not in kept[0]["job"] and kept[0]["truth"]["base"]["sigma_px"] == [20.0]
    one_by_one = zip(score.figures(kept), score.figures(rows), strict=True)
    # NaN where nothing was measured.
    for own, whole in one_by_one:
        assert own.sets == whole.sets and np.isclose(own.value, whole.value, rtol=1e-4, equal_nan=True), own.name
