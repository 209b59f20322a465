"""Records on disk: whole after a crash."""

import pytest

from tests.validation import records


def test_records_outlive_a_crash(tmp_path):
    path = tmp_path / "new" / "jobs.jsonl"
    assert records.read(path) == []
    records.add(path, {"a": 1})
    path.write_text(path.read_text() + '{"a": 2, "b"')
    records.add(path, {"a": 3})
    assert records.read(path) == [{"a": 1}, {"a": 3}]
    with pytest.raises(ValueError):
        records.add(path, {"a": float("nan")})
