"""Repeats that show different spots get a remark; one spot that wanders, flickers or is laid elsewhere gets none."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from spotcheck.dataset.folder import load
from spotcheck.io import store
from tests.samples.small_datasets import crops_of

# Column, row, σ [px] and peak [DN] of a spot.
Spot = tuple[float, float, float, float]


def read_remarks(base: Path, repeats: list[list[Spot]], sheet: str = "", keep: dict[int, str] | None = None) -> str:
    """Return the remarks on the crops of frames with these spots, which are repeats of one condition."""
    y, x = np.mgrid[:200, :260]
    rows = ["file,kind,angle_deg,exposure_s,repeat,keep"]
    for k, spots in enumerate(repeats):
        light = sum(peak * np.exp(-((x - left) ** 2 + (y - top) ** 2) / (2 * s**2)) for left, top, s, peak in spots)
        noise = 2 * np.random.default_rng(k).standard_normal(x.shape)
        tifffile.imwrite(base / f"f{k}.tif", np.rint(20 + light + noise).clip(0, 1023).astype(np.uint16))
        rows.append(f"f{k}.tif,spot,,0.002,{k},{(keep or {}).get(k, '')}")
    (base / "manifest.csv").write_text("\n".join(rows) + "\n")
    (base / "instrument.yaml").write_text(f"crop_px: 100\nsensor: {{bit_depth: 10}}\n{sheet}")
    return "; ".join(store.remarks_of(crops_of(load(base))))


def take_turns(distance: float, sigma: float, count: int) -> list[list[Spot]]:
    """Return frames of two spots of σ 6 and `sigma` [px]; the first is the brighter one in every other frame."""
    peak = 400 * (6 / sigma) ** 2
    return [[(70.0, 90.0, 6.0, 400 * (1.1 if k % 2 else 1)), (70 + distance, 95.0, sigma, peak * (1 if k % 2 else 1.1))]
            for k in range(count)]  # fmt: skip


@pytest.mark.parametrize(("distance", "sigma", "count"), [(120.0, 4.8, 8), (120.0, 6.0, 2), (45.0, 6.0, 7)])
def test_two_spots_of_which_either_is_cropped(tmp_path, distance, sigma, count):
    """Also where they are equal, and where both lie in one crop."""
    text = read_remarks(tmp_path, take_turns(distance, sigma, count))
    assert "f0.tif" in text and "f1.tif" in text
    assert "are repeats but show different spots" in text and "both frames hold both" in text


def test_spots_of_different_widths_at_two_places(tmp_path):
    """Only one of them is lit in each frame."""
    spots: list[Spot] = [(70.0, 90.0, 6.0, 400.0), (190.0, 95.0, 4.8, 625.0)]
    repeats = [[spots[k % 2]] for k in range(8)]
    assert "their widths differ as well" in read_remarks(tmp_path, repeats)


def test_the_remark_ends_when_its_advice_is_taken(tmp_path):
    """The frames of one spot left out, or its pixels named as bad."""
    mask = np.zeros((200, 260), np.uint8)
    mask[:, 150:] = 255
    for k, (sheet, keep) in enumerate((("", {1: "no", 3: "no", 5: "no"}), ("bad_pixels: {mask: mask.tif}\n", {}))):
        (tmp_path / f"{k}").mkdir()
        tifffile.imwrite(tmp_path / f"{k}" / "mask.tif", mask)
        assert "different spots" not in read_remarks(tmp_path / f"{k}", take_turns(120.0, 4.8, 7), sheet, keep)


SOUND = {
    "moved": lambda k, rng: [(70.0 + 120 * (k % 2), 90.0, 6.0, 400.0)],
    "wandering": lambda k, rng: [(*rng.normal((120, 100), 25), 6.0 * rng.lognormal(0, 0.1), 400.0)],
    "with a faint second spot": lambda k, rng: [(*rng.normal((120, 100), 20), 6.0, 400.0), (30.0, 30.0, 6.0, 120.0)],
    "with a brighter second spot": lambda k, rng: [(70.0, 90.0, 6.0, 300.0), (190.0, 90.0, 6.0, 390 + 20 * (k % 2))],
}


@pytest.mark.parametrize("kind", SOUND)
def test_the_same_spot_in_all_repeats_gets_no_remark(tmp_path, kind):
    repeats = [SOUND[kind](k, np.random.default_rng([7, k])) for k in range(8)]
    assert read_remarks(tmp_path, repeats) == ""
