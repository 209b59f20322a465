"""Records on disk: whole after a crash."""

import pytest

from tests.validation import records


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
