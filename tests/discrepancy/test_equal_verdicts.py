"""Equal frames and code give an equal verdict, whatever the number of cores."""

import sys

import pytest

from tests.discrepancy.test_bad_cases import CASES, judged, written


@pytest.mark.slow
def test_equal_frames_give_equal_verdicts(tmp_path, monkeypatch):
    """All files are equal byte by byte, with two threads and with one; the verdict names an effect."""
    folder = written(CASES["a copy beside the only spot"](), tmp_path)
    first, second = judged(folder, tmp_path / "first"), judged(folder, tmp_path / "second")
    threaded = [
        module for name, module in sys.modules.items() if name.startswith("spotcheck.") and "THREADS" in vars(module)
    ]
    assert threaded
    for module in threaded:
        monkeypatch.setattr(module, "THREADS", 1)
    alone = judged(folder, tmp_path / "alone")
    assert first.keys() == second.keys() == alone.keys() and len(first) == 7
    assert b"ghost_reflection" in first["verdict.json"]
    for name, content in first.items():
        assert content == second[name] == alone[name], name
