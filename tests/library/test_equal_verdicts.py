"""Equal frames and code give an equal verdict, whatever the number of cores."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from spotcheck.old_engine.nuisance import threads
from tests.library.test_bad_cases import CASES, judged, written


@pytest.mark.slow
def test_equal_frames_give_equal_verdicts(tmp_path, monkeypatch):
    """Byte by byte, of two threads and of one, with an effect named."""
    folder = written(CASES["a copy beside the only spot"](), tmp_path)
    one, two = judged(folder, tmp_path / "one"), judged(folder, tmp_path / "two")
    monkeypatch.setattr(threads, "ThreadPoolExecutor", lambda workers: ThreadPoolExecutor(1))
    alone = judged(folder, tmp_path / "alone")
    assert one.keys() == two.keys() == alone.keys() and len(one) == 7
    assert b"ghost_reflection" in one["verdict.json"]
    for name, content in one.items():
        assert content == two[name] == alone[name], name
