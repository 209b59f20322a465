"""Exposures, angles and positions that a device read back: which are one condition, and what is said of the others."""

import numpy as np
import pytest
import tifffile

from spotcheck.characterization.characterise import characterise_dataset
from spotcheck.characterization.frame_pairs import iterate_pairs
from spotcheck.crops.cropping import crop_spots, iterate_cells
from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset.conditions import (
    ANGLE_TOLERANCE_DEG,
    EXPOSURE_TOLERANCE,
    RANGE_TOLERANCE,
    check_spread,
    merge_values,
)
from spotcheck.dataset.folder import load
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.io import store
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import HEADER, SENSOR, folder, gaussian

# Twice and half of each tolerance, as the distance of the second value from the first.
NEAR_AND_FAR = {
    "exposure_s": (2.5e-3, 2.5e-3 * EXPOSURE_TOLERANCE),
    "angle_deg": (45.0, ANGLE_TOLERANCE_DEG),
    "z_m": (0.08, 0.4 * RANGE_TOLERANCE),
}


@pytest.mark.parametrize("column", NEAR_AND_FAR)
@pytest.mark.parametrize(("part", "one"), [(0.5, True), (2.0, False)])
def test_values_within_the_tolerance_are_one(column, part, one):
    """Their value is the mean of the readings, each counted; others stay as they were read, to the last digit."""
    first, tolerance = NEAR_AND_FAR[column]
    second, far, last = first + part * tolerance, first + 0.1, first + 0.4
    found = merge_values(column, [second, first, None, far, first, last])
    assert found.unmerged_groups == [] and found.values[2:4] == [None, far] and found.values[5] == last
    mean = first + part * tolerance / 3
    expected = [mean, mean, mean] if one else [second, first, first]
    assert [found.values[k] for k in (0, 1, 4)] == pytest.approx(expected, rel=1e-15)
    assert (found.values[0] == found.values[1] == found.values[4]) is one


def test_a_chain_of_small_steps_is_not_one_condition():
    """Steps of half the tolerance over ten of it: no value is moved, and the chain is named."""
    values = (1e-3 * (1 + 0.5 * EXPOSURE_TOLERANCE * np.arange(20))).tolist()
    found = merge_values("exposure_s", values)
    assert found.values == values and found.unmerged_groups == [(values[0], values[-1], 20)]
    assert "20 different values in 20 spot rows" in check_spread("exposure_s", values)[0]
    twice = check_spread("exposure_s", values * 2)
    assert len(twice) == 1 and "20 different values" in twice[0] and "below the tolerance" in twice[0]


SPOKEN_OF = {
    "a sweep": ("exposure_s", [1e-3, 2e-3, 3e-3], False),
    "a sweep over 15 %": ("exposure_s", np.linspace(1e-3, 1.15e-3, 30).tolist(), False),
    "exposures that were read back": ("exposure_s", [1e-3, 1.01e-3, 1.02e-3, 1.04e-3], True),
    "the same in repeats": ("exposure_s", [1e-3, 1.01e-3, 1.02e-3, 1.04e-3] * 2, False),
    "two frames": ("exposure_s", [1e-3, 1.01e-3], False),
    "a scan along z": ("z_m", np.linspace(0.1, 0.4, 9).tolist(), False),
    "a position that was read back": ("z_m", [0.25, 0.25001, 0.25002], True),
    "angles": ("angle_deg", [0.0, 45.0, 90.0], False),
    "an angle that was read back": ("angle_deg", [90.0, 90.06, 90.085], True),
    "not recorded": ("angle_deg", [None] * 5, False),
}


@pytest.mark.parametrize(("column", "values", "spoken"), SPOKEN_OF.values(), ids=SPOKEN_OF)
def test_values_that_are_all_different_and_alike(column, values, spoken):
    """A sentence where every frame has one of its own though they hardly differ, and none for a sweep."""
    assert bool(check_spread(column, values)) is spoken


def test_a_declared_condition_is_grouped_and_keeps_its_text(tmp_path):
    """Two positions of a stage, read back to 1e-4 of their range, are two; a cell that no other is near to stays."""
    rows = [f"frames/f{k}.tif,spot,0,1e-3,{k},{z}" for k, z in enumerate(("0.1", "0.10002", "0.299990", "0.30001"))]
    found = load(folder(tmp_path, rows, "conditions: [z_m]", f"{HEADER},z_m"))
    assert found.shape == (1, 1, 4, 2)
    assert found.axes[3].values == pytest.approx((0.10001, 0.3), rel=1e-12)
    assert [index[3] for index, _ in found.cells()] == [0, 0, 1, 1]
    rows = [f"frames/f{k}.tif,spot,0,1e-3,{k},{z}" for k, z in enumerate(("0.10", "0.20"))]
    found = load(folder(tmp_path / "apart", rows, "conditions: [z_m]", f"{HEADER},z_m"))
    assert [frame.extra["z_m"] for frame in found.frames] == ["0.10", "0.20"]


def test_flats_and_darks_of_jittering_exposures_form_levels(tmp_path):
    """Seven levels in pairs, whose exposures differ by up to 3e-4: K = 0.35 DN/e- within four standard errors."""
    rng, rows, number = np.random.default_rng(5), [HEADER], 0
    (tmp_path / "frames").mkdir()
    for exposure in np.linspace(0.02, 0.14, 7):
        for kind, rate in (("flat", 6e4), ("dark", 0.0)):
            for repeat in range(2):
                electrons = rng.poisson((rate + 50) * exposure, (80, 90)) + rng.normal(0, 6, (80, 90))
                pixels = np.clip(np.rint(30 + 0.35 * electrons), 0, 4095).astype(np.uint16)
                tifffile.imwrite(tmp_path / f"frames/f{number}.tif", pixels)
                read_back = exposure * (1 + rng.uniform(-1.5e-4, 1.5e-4))
                rows.append(f"frames/f{number}.tif,{kind},,{read_back:.9f},{repeat}")
                number += 1
    (tmp_path / "manifest.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "instrument.yaml").write_text("crop_px: 24\nsensor: {bit_depth: 12}\n")
    found = characterise_dataset(tmp_path)
    assert len(found.levels.flats) == len(found.levels.darks) == 7
    assert not any("single frame" in text for text in found.remarks)
    assert abs(found["gain"].value - 0.35) < 4 * found["gain"].stderr


def test_a_frame_an_exposure_is_no_walk_over_a_square(tmp_path):
    """Forty frames whose exposures are spread by 8 %: a sentence, and only cells with a frame are looked at."""
    count, rng = 40, np.random.default_rng(6)
    rows = [f"frames/f.tif,spot,0,{1e-3 * (1 + 0.002 * k):.9g},{k},{k}" for k in range(count)]
    pages = np.stack([draw(gaussian(64, 400, 31, 32, 4), 1e-3, SENSOR, rng) for _ in range(count)])
    found_in = folder(tmp_path, rows, "crop_px: 48\nsensor: {bit_depth: 10}", f"{HEADER},page")
    tifffile.imwrite(found_in / "frames/f.tif", pages, photometric="minisblack")
    dataset = load(found_in)
    assert dataset.shape == (1, count, count)
    table = ingest_frames(dataset)
    assert store.remarks_of(table) == list_unusual_values(dataset)
    assert store.remarks_of(table)[0].startswith("manifest.csv: exposure_s has 40 different values in 40 spot rows")
    crop_spots(dataset, table, tmp_path / "crops.nc", code="", inputs=[])
    with store.read(tmp_path / "crops.nc") as images:
        own = images.sel(centring="light")
        filled = list(iterate_cells(own, store.grid_dims(images)))
        assert [(at["exposure"], at["repeat"]) for at in filled] == [(k, k) for k in range(count)]
        assert list(iterate_pairs(own, "exposure")) == []
