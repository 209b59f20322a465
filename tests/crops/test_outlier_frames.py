"""Frames that are set aside: each kind of bad frame is, and frames of lights that flicker, walk and drift are not."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import stats

from spotcheck.crops.outlier_frames import FALSE_ALARM_RATE, SpotMoments, find_outlier_frames, measure_moments
from spotcheck.dataset.folder import Dataset, load
from spotcheck.dataset.instrument import Instrument
from spotcheck.dataset.manifest import Frame
from spotcheck.errors import InputError
from spotcheck.io import store
from tests.samples.small_datasets import crops_of

SIDE, SIGMA, NOISE = 60, 6.0, 1.5


def image(light: float = 300.0, x: float = 30.0, y: float = 30.0, sigma: float = SIGMA, seed: int = 0) -> np.ndarray:
    """A crop [row, column] of a round spot of a peak [DN] over 12 DN, with noise."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    spot = light * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.rint(12 + spot + NOISE * np.random.default_rng(seed).standard_normal(spot.shape)).astype(np.float32)


def grid(angles=(0.0,), exposures=(1e-4, 4e-4, 9e-4), repeats=5, keep: dict[int, str] | None = None) -> Dataset:
    """A dataset of spots over a grid; `keep` of some of them, by their place."""
    cells = [(a, t, r) for a in angles for r in range(repeats) for t in exposures]
    frames = tuple(
        Frame(k + 2, f"f{k}.tif", 0, "spot", *cell, {"keep": (keep or {}).get(k, "")}) for k, cell in enumerate(cells)
    )
    return Dataset(Path(), Instrument(), frames)


def glances(dataset: Dataset, off: np.ndarray, growth: float = 1.0, sites: float = 0.3) -> list[SpotMoments]:
    """Glances at spots whose light grows with that power of the exposure, whose sites differ, and whose ln light, ln
    width, x and y are `off` [spot, 4]; of hardly any noise."""
    rng = np.random.default_rng(7)
    site = {key: rng.standard_normal(4) * [sites, sites / 10, 6, 6] for key in
            dict.fromkeys((f.angle_deg, f.repeat) for f in dataset.spots)}  # fmt: skip
    out = []
    for frame, own in zip(dataset.spots, off, strict=True):
        light, width, x, y = site[frame.angle_deg, frame.repeat] + own
        light += 10 + growth * np.log(frame.exposure_s / 1e-4)
        out.append(SpotMoments(float(np.exp(light)), float(SIGMA * np.exp(width)), 100 + x, 90 + y, 1e-4, 1e-4, 1e-3))
    return out


def small(dataset: Dataset, seed: int = 0) -> np.ndarray:
    """What a good laser does: 1 % of the light, 0.3 % of the width, 0.1 px."""
    return np.random.default_rng(seed).standard_normal((len(dataset.spots), 4)) * [0.01, 0.003, 0.1, 0.1]


def test_a_glance_is_the_moments_of_the_light():
    """A Gaussian cut at 3 × the noise of a reading, of which the median of nine keeps some: light and width fall short
    of the whole by (1 + c) e⁻ᶜ-like parts of c = ln(peak / cut), 3 % and 5 % here. A bright pixel changes nothing."""
    crop = image(x=33.3, y=27.8)
    own = measure_moments(crop, 100, 200)
    assert own.light == pytest.approx(2 * np.pi * SIGMA**2 * 300, rel=0.04)
    assert own.sigma == pytest.approx(SIGMA, rel=0.06)
    assert (own.x, own.y) == (pytest.approx(133.3, abs=0.1), pytest.approx(227.8, abs=0.1))
    crop[5, 50] = 1023
    crop[40, 2] = np.nan
    assert measure_moments(crop, 100, 200).light == pytest.approx(own.light, rel=1e-3)
    assert measure_moments(image(light=0.0), 0, 0) is None


def test_errors_of_a_glance_are_its_scatter():
    """Over 200 draws of the noise; the scatter of 200 is known to 5 % (1 σ), the errors are of noise that the median
    has made alike, so that they are right to a third."""
    draws = [measure_moments(image(light=60.0, seed=k), 0, 0) for k in range(200)]
    scatter = np.std([(np.log(draw.light), np.log(draw.sigma), draw.x) for draw in draws], axis=0)
    errors = np.mean([(draw.log_light_error, draw.log_sigma_error, draw.centre_error) for draw in draws], axis=0)
    np.testing.assert_allclose(errors / scatter, 1, atol=0.45)


BAD = {
    "blocked": image() - np.where(np.arange(SIDE) < 30, image() - 12, 0),
    "moved": image(x=40.0),
    "double": image() + image(x=45.0, y=20.0, seed=1) - 12,
    "twice": 2 * image() - 12,
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_frames_are_set_aside(kind):
    """One among 30, from its pixels; and not where the manifest says that it is good."""
    dataset = grid(angles=(0.0, 90.0))
    rng = np.random.default_rng(3)
    crops = [image(300 * (1 + 0.01 * rng.standard_normal()), *(30 + 0.1 * rng.standard_normal(2)), seed=k + 9)
             for k in range(len(dataset.spots))]  # fmt: skip
    crops[7] = BAD[kind]
    looked = [measure_moments(crop, 0, 0) for crop in crops]
    found, remark = find_outlier_frames(dataset, looked)
    assert [(own.spot, own.flag) for own in found] == [(7, "double" if kind == "twice" else kind)]
    assert found[0].reason and not remark
    assert find_outlier_frames(grid(angles=(0.0, 90.0), keep={7: "yes"}), looked) == ([], "")


def test_two_of_three_are_no_accident():
    """Of three repeats one may be odd. Where two are, each in its way, no siblings agree."""
    dataset = grid(angles=(0.0, 45.0, 90.0, 135.0), repeats=3)
    for odd, expected in (((4,), [4]), ((4, 1), [])):
        off = small(dataset)
        off[list(odd), 0] -= np.array([1.5, 0.8])[: len(odd)]
        assert dataset.spots[4].exposure_s == dataset.spots[1].exposure_s
        assert [own.spot for own in find_outlier_frames(dataset, glances(dataset, off))[0]] == expected


def test_many_odd_ones_are_the_light():
    """Five of 40 frames lack half of their light, each in a condition of its own: a laser that hops is no accident."""
    dataset = grid(exposures=tuple(1e-4 * 2.0 ** np.arange(8)))
    off = small(dataset)
    off[[0, 9, 18, 27, 36], 0] -= 0.7
    found, remark = find_outlier_frames(dataset, glances(dataset, off))
    assert not found and remark.startswith("5 of 40 spot frames are unlike their siblings, f0.tif first")


DESIGNS = {
    "3 exposures, 5 repeats, 2 angles": {"angles": (0.0, 90.0)},
    "2 exposures, 3 repeats": {"exposures": (1e-4, 9e-4), "repeats": 3},
    "1 exposure, 12 repeats": {"exposures": (1e-4,), "repeats": 12},
    "12 exposures": {"exposures": tuple(1e-4 * 1.3 ** np.arange(12)), "repeats": 1},
    "30 exposures, 2 repeats": {"exposures": tuple(1e-4 * 1.1 ** np.arange(30)), "repeats": 2},
}


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("tails", [5.0, np.inf])
def test_good_frames_are_used(design, tails):
    """At most one in 10,000 is set aside, whatever the set's own scatter is: here 60 % of the light and 10 px, normal
    or with the tails of Student's law of five degrees of freedom. Of 4,000 frames 0.4 are expected at most; a count of
    5 comes by chance in one of 16,000."""
    dataset, rng = grid(**DESIGNS[design]), np.random.default_rng(11)
    count, aside = 0, 0
    while count < 4000:
        off = stats.t.rvs(tails, size=(len(dataset.spots), 4), random_state=rng) * [0.6, 0.3, 10, 10]
        aside += len(find_outlier_frames(dataset, glances(dataset, off))[0])
        count += len(off)
    assert FALSE_ALARM_RATE == 1e-4 and aside < 5


def effects(dataset: Dataset, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Lights as the verdict names them [spot, 4]."""
    count = len(dataset.spots)
    order, t = np.linspace(0, 1, count), np.array([f.exposure_s for f in dataset.spots])
    none = np.zeros(count)
    return {
        "power fluctuation": np.stack([np.log1p(0.15 * np.clip(rng.standard_normal(count), -4, 4)), *[none] * 3], 1),
        "laser drift": np.stack([np.log1p(-0.6 * order), *[none] * 3], 1),
        "pointing jitter": np.concatenate([np.zeros((count, 2)), 4 * rng.standard_normal((count, 2))], 1),
        "motion blur": np.stack([none, np.log1p(0.5 * (t / t.max()) ** 2), 9 * t / t.max(), none], 1),
        "saturation": np.stack([np.minimum(0, np.log(5e-4 / t)), 0.2 * (t > 5e-4), none, none], 1),
    }


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("kind", effects(grid(), np.random.default_rng(0)))
def test_what_the_light_does_is_no_bad_frame(design, kind):
    """Ten sets each."""
    dataset = grid(**DESIGNS[design])
    for seed in range(10):
        off = small(dataset, seed) + effects(dataset, np.random.default_rng(seed))[kind]
        assert find_outlier_frames(dataset, glances(dataset, off)) == ([], "")


def test_a_series_without_repeats_tells_by_its_neighbours():
    """One of 25 exposures; at an end nobody knows how the light goes on."""
    dataset = grid(exposures=tuple(1e-4 * 1.1 ** np.arange(25)), repeats=1)
    for odd, expected in ((11, [11]), (24, []), (0, []), (23, [])):
        off = small(dataset)
        off[odd, 0] -= 1.0
        assert [own.spot for own in find_outlier_frames(dataset, glances(dataset, off))[0]] == expected


def test_no_use_and_no_sibling():
    """A frame of which there is no glance is not judged; of fewer than three nothing is said."""
    dataset = grid(angles=(0.0, 90.0))
    looked: Sequence[SpotMoments | None] = [None, *glances(dataset, small(dataset))[1:]]
    assert find_outlier_frames(dataset, looked) == ([], "")
    assert find_outlier_frames(dataset, [None] * 28 + list(looked[28:])) == ([], "")


@pytest.fixture
def folder(tmp_path) -> Path:
    """A dataset folder of 30 spots, of which the eighth is half dark, the ninth black and the tenth saturated."""
    cells = [(f.angle_deg, f.exposure_s, f.repeat) for f in grid(angles=(0.0, 90.0)).spots]
    images = [image(x=30 + 0.05 * k, seed=k) for k in range(len(cells))]
    images[7], images[8] = BAD["blocked"], image(light=0.0, seed=77)
    images[9] = np.full((SIDE, SIDE), 1023)
    for k, own in enumerate(images):
        tifffile.imwrite(tmp_path / f"f{k}.tif", own.astype(np.uint16))
    (tmp_path / "instrument.yaml").write_text("crop_px: 40\nsensor: {bit_depth: 10}\n")
    manifest(tmp_path, {})
    return tmp_path


def manifest(folder: Path, keep: dict[int, str]) -> None:
    """manifest.csv with `keep` of some frames, by their place."""
    rows = ["file,kind,angle_deg,exposure_s,repeat,keep"]
    rows += [f"{f.file},spot,{f.angle_deg},{f.exposure_s},{f.repeat},{keep.get(k, '')}"
             for k, f in enumerate(grid(angles=(0.0, 90.0)).spots)]  # fmt: skip
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")


def cropped(folder: Path) -> tuple[dict[str, str], list[str]]:
    """Flags of the frames that are of no use, by their files, and remarks."""
    dataset = load(folder)
    ds = crops_of(dataset)
    status = ds["status"].sel(centring="light").transpose("angle", "exposure", "repeat").values
    flags = {f.file: str(store.status_names(status[index] & store.UNUSABLE)) for index, f in dataset.cells()}
    return {file: own for file, own in flags.items() if own != "ok"}, store.remarks_of(ds)


def test_crops_say_what_is_set_aside_and_why(folder):
    """And the manifest overrules it: yes, and no."""
    flags, remarks = cropped(folder)
    assert flags == {"f7.tif": "blocked", "f8.tif": "black", "f9.tif": "saturated"}
    assert "f7.tif is set aside as blocked: it holds 5" in remarks[0] and "% of the light of its siblings" in remarks[0]
    assert remarks[1:] == [
        "f8.tif is set aside as black: no light above the noise",
        "f9.tif is set aside as saturated: hardly a pixel of the crop reads below full scale",
    ]
    manifest(folder, {7: "Yes", 8: "yes", 3: "no"})
    flags, remarks = cropped(folder)
    assert flags == {"f3.tif": "dropped", "f9.tif": "saturated"}
    assert remarks[0] == "f3.tif is set aside as dropped: left out by hand (keep = no in manifest.csv)"
    assert remarks[1] == "f8.tif is used by hand (keep = yes in manifest.csv) though black: no light above the noise"


def test_keep_is_yes_no_or_blank(folder):
    manifest(folder, {4: "1"})
    with pytest.raises(InputError, match="line 6: keep is '1'; it must be yes, no or blank"):
        load(folder)
