"""A damaged frame among the held-out ones, which detection does not see: the verdict does not say that all agree."""

import json

import pytest

from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.report.dataset_page.summary import summarize
from tests.discrepancy.test_bad_cases import Case, Frame, judged, spots, written
from tests.samples.findings_cases import agree, closed


def torn(frame: Frame) -> Frame:
    """The frame with six rows through the spot that repeat the row before them."""
    pixels = frame.pixels.copy()
    pixels[33:39] = pixels[32]
    return frame._replace(pixels=pixels)


@pytest.mark.parametrize("exposure", [2e-4, None])
def test_a_torn_held_out_frame_is_named(tmp_path, exposure):
    frames = spots(angles=(0.0,), exposures=(exposure,), repeats=6, wander=0.5)
    frames = [torn(frame) if frame.repeat == 2 else frame for frame in frames]
    verdict = json.loads(judged(written(Case(frames), tmp_path), tmp_path / "out")["verdict.json"])
    assert verdict["status"] == "unknown"
    assert "held-out repeats are far from the model" in verdict["sentence"]
    assert "frames/f2.tif deviates from the model by" in verdict["sentence"]
    assert "f5.tif" not in verdict["sentence"]


@pytest.mark.parametrize(("gap", "status"), [(1.5, "consistent"), (903.0, "unknown")])
def test_a_large_gap_on_held_out_frames_is_no_agreement(gap, status):
    verdict = compose_verdict(agree(gap=closed(0.0, before=gap)), "small")
    assert verdict["status"] == status
    page = " ".join(filter(None, summarize(verdict)))
    assert ("agrees with the model within the noise" in page) == (status == "consistent")
    assert ("held-out repeats are far from the model" in page) == (status == "unknown")
