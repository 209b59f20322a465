"""Sets of frames that nobody should have taken: each ends with a verdict that says what could not be judged and why,
never with a wrong name, never with a traceback.

Every case is a dataset folder that goes through the subcommands as the rules call them.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import tifffile
import yaml

from spotcheck.characterization.dark_frames import select_dark_levels
from spotcheck.cli import main
from spotcheck.dataset.frames import ReducedFrame
from spotcheck.discrepancy.frames import Design, FrameSet
from spotcheck.discrepancy.ready_frames import find_shared_spots
from spotcheck.discrepancy.written import breach_of_verdict
from spotcheck.fitting.reading_kernel import build_reading_law
from spotcheck.fitting.spot_score import LIKELIHOOD, score_spot
from spotcheck.io import store
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel
from tests.reference.numpy_chain import draw
from tests.samples.small_datasets import HEADER, folder

SIDE, SHAPE, WIDTH, PEAK = 48, (72, 70), 5.0, 600.0
SENSOR = SensorModel(0.11, 6.0, 0.0, np.inf, 12.0, 1023.0)
SHEET: dict[str, Any] = {"bit_depth": 10, "gain_dn_per_e": 0.11, "read_noise_e": 6.0, "black_level_dn": 12.0}
ANGLES, EXPOSURES = (0.0, 45.0), (2e-4, 8e-4)


class Frame(NamedTuple):
    """A row of the manifest with its pixels."""

    kind: str
    angle: float | None
    exposure: float | None
    repeat: int
    pixels: np.ndarray

    def row(self, name: str) -> str:
        """The row as text."""
        cells = ("" if v is None else repr(v) for v in (self.angle, self.exposure, self.repeat))
        return ",".join((name, self.kind, *cells))


# x, y [px] from the spot's centre, its light [DN], peak [DN] and width [px], random numbers → light [DN].
Light = Callable[..., np.ndarray]


def spots(
    light: Light | None = None,
    after: Callable[[np.ndarray], np.ndarray] | None = None,
    angles: Sequence[float | None] = ANGLES,
    exposures: Sequence[float | None] = EXPOSURES,
    repeats: int = 3,
    peak: float = PEAK,
    width: float = WIDTH,
    rise: float = 0.5,
    wander: float = 3.0,
    sensor: SensorModel = SENSOR,
    shape: tuple[int, int] = SHAPE,
    seed: int = 3,
) -> list[Frame]:
    """Frames of the baseline: `rise` [px] of width for each e-fold of exposure; `wander` [px] of the centre from site
    to site; `light` and `after` change the light and the readings."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    longest = max((t for t in exposures if t), default=1.0)
    out = []
    for angle in angles:
        for repeat in range(repeats):
            y0, x0 = (np.array(shape) - 1) / 2 + rng.uniform(-wander, wander, 2)
            for t in exposures:
                part = t / longest if t else 1.0
                sigma = width + rise * np.log(part)
                top = peak * part * (width / sigma) ** 2
                spot = top * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))
                spot = light(x - x0, y - y0, spot, top, sigma, rng) if light else spot
                pixels = draw(spot, t or 0.0, sensor, rng)
                out.append(Frame("spot", angle, t, repeat, after(pixels) if after else pixels))
    return out


def alike(kind: str, light: float, count: int = 3) -> list[Frame]:
    """Frames of homogeneous light [DN]."""
    rng = np.random.default_rng(8)
    return [Frame(kind, None, 8e-4, k, draw(np.full(SHAPE, light), 0.0, SENSOR, rng)) for k in range(count)]


def copy_beside(dx, dy, spot, top, sigma, rng):
    """A copy, 5 % as bright, 9 px to the right and 4 px down."""
    return spot + 0.05 * top * np.exp(-((dx - 9) ** 2 + (dy - 4) ** 2) / (2 * sigma**2))


def another(dx, dy, spot, top, sigma, rng):
    """A second spot beside it that is no copy: as bright at every exposure, and narrower."""
    return spot + 200 * np.exp(-((dx - 15) ** 2 + (dy - 4) ** 2) / (2 * 2.5**2))


def far_cluster(pixels: np.ndarray) -> np.ndarray:
    """Many hot pixels side by side, far from the spot and brighter than faint spots."""
    out = pixels.copy()
    out[12:20, 20:28] = 300
    return out


def whole(reading: int) -> Callable[[np.ndarray], np.ndarray]:
    """Every pixel reads the same."""
    return lambda pixels: np.full_like(pixels, reading)


def dark(frame: Frame) -> Frame:
    """The same without its spot, and with noise of its own."""
    seed = [frame.repeat, int(frame.angle or 0), round(1e6 * (frame.exposure or 0))]
    return frame._replace(pixels=draw(np.zeros(SHAPE), 0.0, SENSOR, np.random.default_rng(seed)))


def sheet(**sensor: Any) -> dict[str, Any]:
    """instrument.yaml with other numbers of the sensor; None leaves one out."""
    return {"sensor": {key: value for key, value in (SHEET | sensor).items() if value is not None}}


class Case(NamedTuple):
    """Frames, keys of instrument.yaml other than usual, the status, what effects may be named, what the verdict says in
    words, and which effects it says were not assessed."""

    frames: list[Frame]
    instrument: dict[str, Any] = {}  # noqa: RUF012
    status: str = "consistent"
    names: tuple[str, ...] = ()
    words: str = ""
    without: tuple[str, ...] = ()


NOTHING, EIGHT_BIT = "not_assessed", SensorModel(0.03, 6.0, 0.0, np.inf, 4.0, 255.0)
STATED = sheet(bit_depth=8, gain_dn_per_e=0.03, black_level_dn=4.0)
UNSTATED = sheet(black_level_dn=None)
EVERYWHERE = "none of 12 spot frames can be used"
BRIGHTER = alike("dark", 25.0)

CASES: dict[str, Callable[[], Case]] = {
    # Nothing to look at.
    "saturated everywhere": lambda: Case(
        spots(after=whole(1023)), {}, NOTHING, (), f"{EVERYWHERE} (hardly a pixel of the crop reads below full scale)"
    ),
    "black": lambda: Case(spots(after=whole(0)), {}, NOTHING, (), f"{EVERYWHERE} (no light above the noise)"),
    "constant": lambda: Case(spots(after=whole(300)), {}, NOTHING, (), f"{EVERYWHERE} (no light above the noise)"),
    "black and saturated": lambda: Case(
        [*spots(after=whole(0))[:5], *spots(after=whole(1023))[5:]], {}, NOTHING, (),
        f"{EVERYWHERE} (5: no light above the noise; 7: hardly a pixel of the crop reads below full scale)",
    ),
    "a single black frame": lambda: Case(
        spots(after=whole(0))[:1], {}, NOTHING, (), "the only spot frame cannot be used (no light above the noise)"
    ),
    "noise alone": lambda: Case(
        spots(after=lambda p: np.random.default_rng(int(p.sum())).integers(0, 1023, p.shape)), {}, NOTHING, (),
        EVERYWHERE,
    ),
    "flats and darks alone": lambda: Case(
        [*alike("flat", 300.0), *alike("dark", 0.0)], {}, NOTHING, (),
        "the manifest names no spot frame, and flats and darks are judged by `spotcheck flats`",
    ),
    # Light, but no spot that could be fitted, or no noise to judge it by.
    "crop full of saturated light": lambda: Case(
        spots(after=lambda p: np.where(p > 16, 1023, p), angles=(0.0,), repeats=1), {}, NOTHING, (),
        "no spot could be fitted in any frame",
    ),
    "spot much wider than its crop": lambda: Case(
        spots(width=60.0), {}, NOTHING, (), "no spot could be fitted in any frame: it is as wide as its crop"
    ),
    "noise that frames do not tell": lambda: Case(
        spots(after=lambda p: np.where(p > 200, 200, 12)), sheet(gain_dn_per_e=None, read_noise_e=None), NOTHING, (),
        "gain or read noise of the sensor is unknown",
    ),
    # Less than usual, but enough for a verdict; what it cannot say it does not.
    "saturated spots": lambda: Case(spots(peak=3000.0)),
    "no repeats": lambda: Case(spots(repeats=1)),
    "one exposure": lambda: Case(
        spots(exposures=EXPOSURES[:1], peak=400.0),
        without=("photon_budget", "shutter_offset", "pointing_jitter", "spread_law"),
    ),
    "one frame": lambda: Case(
        spots(angles=(0.0,), exposures=EXPOSURES[:1], repeats=1, peak=400.0),
        without=("power_fluctuation", "laser_drift", "photon_budget", "angle_reflectance"),
    ),
    "exposures not recorded": lambda: Case(spots(exposures=(None,)), without=("photon_budget", "power_fluctuation")),
    "angles not recorded": lambda: Case(spots(angles=(None,), repeats=6), without=("angle_reflectance",)),
    "order not known": lambda: Case(spots(), {"order_known": False}, without=("laser_drift",)),
    "no data sheet of the noise": lambda: Case(
        spots(width=8.0), sheet(gain_dn_per_e=None, read_noise_e=None) | {"crop_px": 70}
    ),
    "cells missing in the grid": lambda: Case([f for k, f in enumerate(spots()) if k not in (1, 2, 7)]),
    "every frame at a site of its own": lambda: Case([f._replace(repeat=k) for k, f in enumerate(spots())]),
    "more repeats at one angle": lambda: Case([f for f in spots() if f.angle == 0 or f.repeat == 0]),
    "width that falls with exposure": lambda: Case(spots(rise=-0.7)),
    "8 bit": lambda: Case(
        [f._replace(pixels=f.pixels.astype(np.uint8)) for f in spots(sensor=EIGHT_BIT, peak=150.0)], STATED
    ),
    "left-aligned 16 bit": lambda: Case(spots(after=lambda p: p << 6), sheet(value_shift_bits=6)),
    "odd crop": lambda: Case(spots(), {"crop_px": 47}),
    "small crop": lambda: Case(spots(), {"crop_px": 25}),
    "crops that reach beyond the frame": lambda: Case(spots(wander=25.0)),
    # Part of the set cannot be used: judged without it, and said.
    "no spot in half of the frames": lambda: Case(
        [dark(f) if f.repeat == 1 else f for f in spots(repeats=2)],
        words="Note: 4 of 8 spot frames cannot be used (no light above the noise).",
    ),
    "no spot at one angle": lambda: Case(
        [dark(f) if f.angle == 45 else f for f in spots()],
        words="Note: 6 of 12 spot frames cannot be used (no light above the noise).",
    ),
    "copies among the repeats": lambda: Case(
        [*spots(), *(f._replace(repeat=3) for f in spots()[:2])],
        words="Note: 2 of 14 spot frames cannot be used (the pixels are those of another frame).",
    ),
    "hot cluster brighter than faint spots": lambda: Case(
        spots(after=far_cluster, shape=(160, 150)), words="Note: 6 of 12 spots lie more than half a crop away from"
    ),
    "an angle that only tests": lambda: Case(
        [f for f in spots(repeats=6) if f.angle == 0 or f.repeat == 2],
        words="Note: 2 frames belong to conditions of which every frame is held out",
    ),
    "an angle that only tests a pedestal": lambda: Case(
        [
            f
            for f in spots(repeats=6, sensor=replace(SENSOR, black_level_dn=24.0), exposures=(None,))
            if f.angle == 0 or f.repeat == 2
        ],
        {}, "named", ("dark_offset",), "Note: 1 frame belongs to conditions of which every frame is held out",
    ),
    # The black level is nobody's to guess.
    "light in one dark frame": lambda: Case(
        [*spots(), *alike("dark", 0.0, 2), BRIGHTER[2]], UNSTATED, words="1 of 3 dark frames hold light"
    ),
    "light in every dark frame": lambda: Case(
        [*spots(), *BRIGHTER], UNSTATED, "named", ("dark_offset",), "so the black level is not taken from them"
    ),
    "spots in the dark frames": lambda: Case(
        [*spots(), *(f._replace(kind="dark", angle=None) for f in spots()[5::-2])], UNSTATED, "named", ("dark_offset",),
        "3 of 3 dark frames hold light",
    ),
    "light in dark frames that nobody needs": lambda: Case(
        [*spots(), *BRIGHTER], words="Model and measurement agree"
    ),
    # Something is wrong that has no name, or has one.
    "two spots": lambda: Case(
        spots(another, angles=(0.0,), repeats=1), {}, "named_more_remains", ("beam_profile",)
    ),
    "saturated spots on a pedestal": lambda: Case(
        spots(peak=3000.0, sensor=replace(SENSOR, black_level_dn=20.0)), {}, "named", ("dark_offset",)
    ),
    "a copy beside spots that crops cut": lambda: Case(
        spots(copy_beside, wander=20.0), {}, "named", ("ghost_reflection",)
    ),
    "a copy beside the only spot": lambda: Case(
        spots(copy_beside, angles=(0.0,), exposures=EXPOSURES[:1], repeats=1), {}, "named", ("ghost_reflection",)
    ),
}  # fmt: skip


# What the verdict gets wrong today, and why.
WRONG = {
    "two spots": "the second spot, whose light does not follow the exposure, passes for a law of the brightness",
}


def written(case: Case, base: Path) -> Path:
    """The case as a dataset folder."""
    content = {"crop_px": SIDE, "sensor": SHEET} | case.instrument
    names = [f"frames/f{k}.tif" for k in range(len(case.frames))]
    rows = [frame.row(name) for frame, name in zip(case.frames, names, strict=True)]
    out = folder(base / "set", rows, yaml.safe_dump(content), HEADER)
    for frame, name in zip(case.frames, names, strict=True):
        pixels = frame.pixels if frame.pixels.dtype == np.uint8 else frame.pixels.astype(np.uint16)
        tifffile.imwrite(out / name, pixels)
    return out


def run_stages(own: Path, out: Path, stages: Sequence[str]) -> None:
    """Run subcommands on a dataset folder, as the rules call them."""
    frames, crops, sensor, pictures, light = (str(out / f"{name}.nc") for name in
                                              ("frames", "crops", "sensor", "discrepancy", "light"))  # fmt: skip
    options = {
        "ingest": ["--output", frames],
        "crop": ["--frames", frames, "--output", crops],
        "sensor": ["--crops", crops, "--frames", frames, "--output", sensor],
        "judge": ["--crops", crops, "--sensor", sensor, "--pictures", pictures, "--model", str(out / "model.yaml"),
                  "--light", light, "--output", str(out / "verdict.json")],
    }  # fmt: skip
    for stage in stages:
        main([stage, str(own), *options[stage]])


def judged(own: Path, out: Path) -> dict[str, bytes]:
    """Every file of a verdict, by its name, as the subcommands write it."""
    out.mkdir()
    run_stages(own, out, ("ingest", "crop", "sensor", "judge"))
    return {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.xfail(strict=True, reason=WRONG[name]) if name in WRONG else ())
     for name in CASES],
)  # fmt: skip
def test_a_bad_case_ends_well(name, tmp_path):
    """A verdict that keeps its contract: the right status, no name of what is not there, and its reasons in words."""
    case = CASES[name]()
    verdict = json.loads(judged(written(case, tmp_path), tmp_path / "out")["verdict.json"])
    assert breach_of_verdict(verdict) is None
    named = {name for own in verdict["effects"] for name in own["candidates"]}
    assert (verdict["status"], named) == (case.status, set(case.names)), verdict["sentence"]
    assert case.words in verdict["sentence"]
    assert verdict["sentence"].count("\n") < 3
    reasons = {own["effect"]: own["why"] for own in verdict["not_assessed"]}
    assert set(case.without) <= set(reasons)
    assert "nan" not in verdict["sentence"].lower().split()


def test_light_in_dark_frames_is_in_the_report_as_well(tmp_path):
    """The black level's source says what became of the dark frames."""
    case = CASES["light in every dark frame"]()
    run_stages(written(case, tmp_path), tmp_path, ("ingest", "crop", "sensor"))
    with store.read(tmp_path / "sensor.nc") as sensor:
        level = sensor["black_level_dn"]
        assert float(level) == 0 and level.attrs["source"].startswith("default; 3 of 3 dark frames hold light (")


def test_frames_of_a_site_that_look_elsewhere():
    """Most of a site's frames count; of as many, those with the longest exposure; sites may lie where they like."""
    assert are_together([(0, 1e-4, 0), (24, 2e-4, 0), (900, 1e-4, 1)]) == [True, True, True]
    assert are_together([(0, 1e-4, 0), (300, 2e-4, 0), (2, 4e-4, 0)]) == [True, False, True]
    assert are_together([(0, 1e-4, 0), (300, 2e-4, 0)]) == [False, True]
    assert are_together([(0, 1.0, 0), (300, 1.0, 0)]) == [True, False]


def are_together(frames: Sequence[tuple[int, float, int]]) -> list[bool]:
    """Return which frames show the spot of their site; left column of the crop, exposure [s] and site of each."""
    left, exposure_s, site = map(np.array, zip(*frames, strict=True))
    same = np.zeros(len(frames), int)
    design = Design(exposure_s, same, same, site, site, same, float(exposure_s.max()), 1e-4, True, True)
    frame_set = FrameSet(np.zeros((len(frames), 1, 1)), left, np.full(len(frames), 5), design, 1000, 1000)
    return find_shared_spots(frame_set, 48).tolist()


@pytest.mark.parametrize(
    ("levels", "beside", "good", "said"),
    [
        ([12.0, 12.2], [12.1], [12.0, 12.2], ""),
        ([12.0, 12.2], [], [12.0, 12.2], ""),
        ([12.0, 30.0], [], [12.0], "1 of 2 dark frames hold light"),
        ([30.0], [12.0, 13.0], [], "1 of 1 dark frames hold light"),
        ([30.0], [40.0], [30.0], ""),
        ([], [12.0], [], ""),
    ],
)
def test_dark_frames_are_held_against_the_darkest_of_all(levels, beside, good, said):
    """Light only adds: what reads more than another frame does beside its spot is not dark."""

    def frame(level: float) -> ReducedFrame:
        return ReducedFrame(np.full((2, 2), level), np.full(9, level), np.full(9, level))

    found = select_dark_levels(map(frame, levels), map(frame, beside), 1023.0)
    assert found.levels == good and found.remark.startswith(said) and bool(found.remark) == bool(said)


def test_a_reading_that_the_model_excludes_weighs_no_more_than_its_distance():
    """On a pedestal of 18 standard deviations a frame of a sensor with faint light says by how much, not by how many
    powers of ten: else that is all that is heard of it."""
    image = np.full((20, 20), 24.0)
    theta = np.array([1e-6, 10.0, 10.0, 0.04, 0.0, 0.04, 12.0])
    score, _, _, _ = score_spot(image, theta, LIKELIHOOD, build_reading_law(SENSOR), False)
    plain = image.size * 12.0 / ((0.11 * 6.0) ** 2 + ROUNDING_VARIANCE)
    assert score[6] == pytest.approx(plain, rel=0.02)
