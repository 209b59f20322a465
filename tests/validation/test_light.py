"""The sets on real light: what is drawn is what the closed forms say, bounds are those of brute force, the plan is
balanced, and nothing is asked of the library's model."""

import ast
import json
from collections import Counter
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from scipy.interpolate import BSpline

from spotcheck import dataset
from tests.validation.generators.light import beams, bound, draw, generator, hene, plan
from tests.validation.generators.light.bound import Reference
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.moments import moments
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.light.strength import measure_of, tune
from tests.validation.generators.second.case import LASER_WIDTH, Case, Effect, Frame
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.optics import coordinates, light, spot, spread
from tests.validation.generators.second.sensor import read_out
from tests.validation.protocol import Job
from tests.validation.records import ROOT

MODELS = ("spotcheck.model", "spotcheck.discrepancy", "spotcheck.estimate", "rig")


def small_case(seed: int = 3, light_: str = "gauss", size: int = 40, names: tuple[str, ...] = (), **more) -> Case:
    """Two sites at two exposures on frames of a few px, the spot a fifth of them wide."""
    case = draw_case(seed, "default", light_, list(names))
    frames = [Frame(90.0 * site, t, 0, site) for site in (0, 1) for t in (3e-4, 9e-4)]
    width = {"p1": 0.8, "p2": size / 7 - LASER_WIDTH - 0.8 * np.log(9e-4)}
    centres = (size - 1) / 2 + np.array([[0.3, -0.8], [-1.2, 0.6]])
    return replace(case, frames=frames, size=size, centres=centres, **(width | more))


def strong(case: Case, name: str, s: float | None = None) -> Effect:
    """An effect of the vocabulary or outside it, as strong as its search begins."""
    effect = {**VOCABULARY, **MECHANISMS}[name](case, np.random.default_rng(7))
    effect.name, effect.s = name, max(effect.start, effect.floor) if s is None else s
    return effect


# Independence


def test_nothing_of_the_library_is_asked():
    """Followed through every file of the tests that the makers import."""
    here = ROOT / "tests/validation/generators"
    todo = [path for name in ("light", "second") for path in sorted((here / name).glob("*.py"))]
    seen: set[Path] = set()
    while todo:
        path = todo.pop()
        seen.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [own.name for own in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module), *(f"{node.module}.{own.name}" for own in node.names)]
            for name in names:
                # The second generator's report counts by outcome, which knows no model.
                assert not any(name == own or name.startswith(f"{own}.") for own in MODELS), (path, name)
                file = (ROOT / name.replace(".", "/")).with_suffix(".py")
                if name.startswith("tests.") and file.exists() and file not in seen:
                    todo.append(file)
    assert len(seen) > 20


# Light


def test_beams_are_in_the_coordinates_of_their_gaussian():
    """Every kind of drawn light, and a real beam: off as much as is wanted, best fitted by the unit Gaussian, and 0
    beyond the crop."""
    rng = np.random.default_rng(1)
    found = [beams.drawn(kind, rng) for kind in beams.DRAWN]
    assert all(beams.OFF[0] * 0.99 < own.off < beams.OFF[1] * 1.01 for own in found)
    found += [beams.real(beams.real_names()[2])] if beams.there() else []
    axis = np.arange(-beams.CORE, beams.CORE + 0.01, 0.1)
    u, v = np.meshgrid(axis, axis)
    inside = np.hypot(u, v) <= beams.CORE
    u, v = u[inside], v[inside]
    gauss = np.exp(-(u**2 + v**2) / 2)
    for own in found:
        off = own(u, v) - gauss
        # Least squares: what is off is at right angles to every slope of the Gaussian.
        slopes = gauss * np.stack([np.ones_like(u), u, v, u**2 + v**2])
        assert np.abs(np.linalg.lstsq(slopes.T, off, rcond=None)[0]).max() < 2e-4, own.name
        assert own(np.array([beams.ENDS + 0.1]), np.array([0.0])) < 1e-12
        assert np.all(own(u, v) >= 0) and own.off > 0.005


class Round:
    """A Gaussian as if it were any shape."""

    name, top, off = "round", 1.0, 0.0

    def __call__(self, u, v):
        return np.exp(-(u**2 + v**2) / 2)


@pytest.mark.parametrize("name", ["super_gaussian", "fibre_anisotropy", "ghost_reflection", "motion_blur"])
def test_a_shape_of_its_own_takes_effects_as_the_gaussian_does(name):
    case = small_case(names=(name,))
    case.effects[name] = strong(case, name)
    assert light(replace(case, shape=Round()), 1) == pytest.approx(light(case, 1), rel=1e-9, abs=1e-9)


# Closed forms

DRAWS = 160


@pytest.mark.parametrize("name", [*VOCABULARY, *(own for own in MECHANISMS if own != "bad_frames")])
def test_readings_have_the_mean_and_variance_of_the_closed_form(name):
    """Frames drawn again and again. Over 1600 px the rms of z is 1 ± 0.018, the mean ratio of variances 1 ± 0.003: six
    and more standard errors are allowed, and 0.02 DN of rounding."""
    case = small_case(names=(name,), light_="drawn", read_noise=12.0, black=0 if name == "black_clipping" else 12)
    case.effects[name] = strong(case, name)
    i = 3
    expected = moments(case, i)
    drawn = np.stack([_coded(case, i, seed) for seed in range(DRAWS)])
    error = np.maximum(np.abs(drawn.mean(0) - expected.mean) - 0.02, 0) / np.sqrt(expected.variance / DRAWS)
    # Where hardly a draw passes a threshold, that is by the tail of a Poisson law, which is no normal one.
    assert np.sqrt(np.mean(error[expected.variance > 0.05] ** 2)) < 1.15
    if name not in ("black_clipping", "saturation"):
        assert np.mean(drawn.var(0, ddof=1) / expected.variance) == pytest.approx(1, abs=0.03)
    else:
        # Where noise is cut little is left of a variance; it is compared in sum.
        assert drawn.var(0, ddof=1).sum() == pytest.approx(expected.variance.sum(), rel=0.03)


def _coded(case: Case, i: int, seed: int) -> np.ndarray:
    return read_out(case, i, np.random.default_rng([seed, i]))


def _changes(case: Case, effect: Effect, i: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change of the mean [DN], the light before [DN], and the change of variance over it."""
    base, own = moments(case, i), moments(case.only(effect), i)
    return own.mean - base.mean, light(case, i), own.variance / base.variance


def test_strangers_change_frames_as_they_say():
    case = small_case(names=("outside:",), light_="drawn", dark_current=0.0)
    middle = (case.size - 1) / 2
    y, x = np.mgrid[: case.size, : case.size] - middle

    own = strong(case, "vignetting", 0.05)
    change, before, _ = _changes(case, own)
    square = ((x - own.form["x_px"]) ** 2 + (y - own.form["y_px"]) ** 2) / 1e4
    assert change == pytest.approx(-0.05 * square * before, abs=1e-6)

    own = strong(case, "gain_of_halves", 0.04)
    change, before, _ = _changes(case, own)
    right = change > 1e-9
    assert change[right] == pytest.approx(0.04 * before[right], abs=1e-3) and not right[:, :8].any()

    rows = np.stack([_changes(case, strong(case, "flicker_rows", 2.0), i)[0][:, 0] for i in range(4)])
    assert rows.std(axis=1) == pytest.approx(2.0, rel=0.02) and np.abs(np.corrcoef(rows)[0, 1:]).max() < 0.8

    own = strong(case, "converter_steps", 3.0)
    change, before, _ = _changes(case, own)
    high = ((before + case.black) // own.form["every_codes"]) % 2 == 1
    assert set(np.unique(np.round(change, 6))) == {0.0, 3.0} and np.mean((change > 1) == high) > 0.95

    own = strong(case, "dust", 0.2)
    change, before, _ = _changes(case, own)
    assert (change / np.maximum(before, 1e-9)).min() == pytest.approx(-0.2, rel=0.1) and change.max() <= 1e-9

    own = strong(case, "image_lag", 0.1)
    assert _changes(case, own)[0] == pytest.approx(0.1 * spot(case, 2), abs=1e-6)

    change, before, ratio = _changes(case, strong(case, "excess_shot_noise", 0.5))
    noise = case.gain * before / (case.gain * before + (case.gain * case.read_noise) ** 2 + 1 / 12)
    assert np.all(change == 0) and ratio == pytest.approx(1 + 0.5 * noise, rel=2e-3)


def test_some_strangers_are_in_some_frames_only_or_grow():
    case = draw_case(5, "default", "gauss", ["outside:"])
    for name, few in (("bad_frames", 5), ("second_spot_sometimes", 0)):
        own = strong(case, name)
        changed = [not np.array_equal(light(case.only(own), i), light(case, i)) for i in range(len(case.frames))]
        assert sum(changed) == few if few else 5 < sum(changed) < 60
    own = strong(case, "trefoil_by_exposure", 0.1)
    turned = np.radians(own.form["direction_deg"])
    for i, part in ((0, 0.1 / 9), (1, 0.1 / 3), (2, 0.1)):
        # Half way down the flank along a lobe the light lies where it would at a radius shorter by the part.
        dx, dy = coordinates(case, i)
        sigma = spread(case, case.frames[i].exposure) + LASER_WIDTH
        at = np.abs(np.angle(np.exp(3j * (np.arctan2(dy, dx) - turned)))) < 0.05
        rho2 = (dx**2 + dy**2)[at] * (1 - part) ** 2 / (2 * sigma**2)
        image, base = light(case.only(own), i)[at], light(case, i)
        # cos(0.05) is 0.9988.
        assert image / base.max() == pytest.approx(np.exp(-rho2), abs=0.004)


# Bounds


def brute(reference: Reference, case: Case, unknown: np.ndarray | None = None) -> tuple[float, float]:
    """Signal-to-noise of the effects of a case with the shape known and free, by one dense least-squares problem. Its
    columns are differences of moments, its splines scipy's."""
    own = reference.case
    count = int(np.ceil(bound.REACH / bound.NODES))
    centres = np.arange(-count, count + 1) * bound.NODES
    splines = [BSpline.basis_element(c + bound.NODES * np.arange(-2, 3), extrapolate=False) for c in centres]

    def column(change: list) -> np.ndarray:
        base = [moments(own, i) for i in reference.frames]
        return np.concatenate(
            [np.r_[((m.mean - b.mean) / np.sqrt(b.variance))[::2, ::2].ravel(),
                   ((m.variance - b.variance) / (np.sqrt(2) * b.variance))[::2, ::2].ravel()]
             for m, b in zip(change, base, strict=True)]
        )  # fmt: skip

    def of_light(images: list, h: float = 1e-3) -> np.ndarray:
        end = [moments(own, i, light(own, i) + h * d) for i, d in zip(reference.frames, images, strict=True)]
        return column(end) / h

    numbers, shape = [], []
    for k, i in enumerate(reference.frames):
        t, h = own.frames[i].exposure, 1e-4
        sigma = spread(own, t) + LASER_WIDTH
        site = own.frames[i].site
        image = light(own, i)
        changed = [image * (1 + h)]
        # A width by p2, at the peak as it is.
        wider = replace(own, p2=own.p2 + h * sigma)
        wide = light(wider, i)
        changed.append(wide * image.max() / wide.max())
        for axis in (0, 1):
            moved = own.centres.copy()
            moved[site, axis] += h * sigma
            changed.append(light(replace(own, centres=moved), i))
        zero = np.zeros_like(image)
        numbers += [of_light([(new - image) / h if j == k else zero for j in range(len(reference.frames))])
                    for new in changed]  # fmt: skip
    for j in range(len(centres)):
        for i in range(len(centres)):
            images = []
            for frame in reference.frames:
                dx, dy = coordinates(own, frame)
                sigma = spread(own, own.frames[frame].exposure) + LASER_WIDTH
                along, across = (np.nan_to_num(splines[m](d / sigma)) for m, d in ((i, dx), (j, dy)))
                images.append(light(own, frame).max() * across * along)
            shape.append(of_light(images) if any(image.any() for image in images) else 0 * numbers[0])
    effect = column([moments(case, i) for i in reference.frames])
    beside = np.stack(numbers, 1)
    if unknown is not None:
        beside = beside @ unknown
        prior = np.eye(beside.shape[1]) / np.sqrt(reference.scale)
    else:
        prior = np.zeros((0, beside.shape[1]))
    out = []
    for more in (np.zeros((len(effect), 0)), np.stack(shape, 1)):
        few = more.shape[1]
        weak = np.eye(few) / (bound.PRIOR * np.sqrt(reference.scale))
        rows = [[beside, more], [prior, np.zeros((len(prior), few))], [np.zeros((few, beside.shape[1])), weak]]
        a = np.vstack([np.hstack(row) for row in rows])
        b = np.r_[effect, np.zeros(len(prior) + few)]
        left = b - a @ np.linalg.lstsq(a, b, rcond=1e-9)[0]
        out.append(float(np.sqrt(left @ left * reference.scale)))
    return out[0], out[1]


@pytest.mark.parametrize("name", ["smear", "saturation", "beam_ellipticity", "angle_reflectance"])
def test_bounds_are_those_of_brute_force(name, monkeypatch):
    """A wide net of nodes, few pixels."""
    monkeypatch.setattr(bound, "NODES", 0.7)
    monkeypatch.setattr(bound, "REACH", 2.8)
    monkeypatch.setitem(bound.SITES, "default", 2)
    case = small_case(size=44, light_="gauss", black=40)
    case.effects[name] = strong(case, name, 0.02 if name == "beam_ellipticity" else None)
    reference = Reference(case)
    unknown = reference.lawful() if name == "angle_reflectance" else None
    found = reference.snr(reference.change(case), unknown)
    assert len(reference.frames) == 4 and reference.scale == 4
    # Slopes of light by width and place are differences of neighbouring pixels: good to (1 px/σ)²/6.
    assert tuple(found) == pytest.approx(brute(reference, case, unknown), rel=0.02, abs=0.1)
    assert found.free < found.known


def test_behind_speckle_what_sites_share_is_left():
    """A field of no contrast changes nothing; behind a strong one, what exposures of one site tell of each other is
    left of a law in exposure, next to nothing of an ellipse in one exposure's place."""
    case = draw_case(4, "default", "gauss", [])
    case.effects["photon_budget"] = strong(case, "photon_budget", 0.03)
    reference = Reference(case)
    change = reference.change(case)
    for unknown in (None, reference.lawful()):
        plain = bound.behind_grain(reference, change, 0.0, 3.0, unknown)
        assert plain == pytest.approx(reference.snr(change, unknown).known, rel=1e-6, abs=1e-3)
    behind = bound.behind_grain(reference, change, 0.4, 3.0, reference.lawful())
    assert 0.2 * plain < behind < plain
    del case.effects["photon_budget"]
    case.effects["angle_reflectance"] = strong(case, "angle_reflectance", 0.03)
    change = reference.change(case)
    # Between sites each pixel tells of the light what its field leaves: |c|²/(1 + |c|²) of 1/C²A, where c is C √A times
    # light over noise of all exposures; and its noise tells as much as without a field. Four angles tell of d by the
    # mean of cos² over all sites, a half.
    area = np.pi * 3.0**2 / (4 * np.log(2))
    one = slice(0, 3)
    noise = np.sqrt(reference.variance[one])
    square = 0.4**2 * area * np.sum((np.stack(reference.light[one])[:, ::2, ::2] / noise) ** 2, axis=0)
    told = 4 * np.sum(square / (1 + square)) / (0.4**2 * area)
    told += 4 * np.sum((case.gain * np.stack(reference.light[one])[:, ::2, ::2] / noise**2) ** 2) / 2
    found = bound.behind_grain(reference, change, 0.4, 3.0, reference.lawful())
    assert found == pytest.approx(0.03 * np.sqrt(told * 32 / 2), rel=0.05)


def test_strengths_reach_what_is_wanted():
    case = replace(draw_case(12, "default", "gauss", []), budget="linear")
    reference = Reference(case)
    for name, wanted in (("nonlinearity", 50.0), ("motion_blur", 80.0), ("beam_ellipticity", 400.0)):
        effect = strong(case, name)
        own = tune(reference, case, effect, wanted)
        assert own.met and not own.floored and own.tied == (name == "beam_ellipticity")
        assert (own.known if own.tied else own.free) == pytest.approx(wanted, rel=0.06)
        assert measure_of(reference, case, effect)(effect.s) == own[1:3]
    # Seen however little there is: as much as a user would call something.
    own = tune(reference, case, strong(case, "dark_offset"), 5.0)
    assert own.floored and own.met and own.free > 50
    own = tune(reference, case, strong(case, "smear"), 1e6)
    assert not own.met and own.free < 1e6


def test_scatter_is_as_strong_as_its_draws_are():
    """The signal-to-noise of a frame's scatter is that of its variance: with frames' errors e it is rms²/e² √(n/2)."""
    case = draw_case(12, "default", "gauss", [])
    reference = Reference(case)
    error = reference.errors(0)[0]
    effect = strong(case, "power_fluctuation", 0.01)
    own = measure_of(reference, case, effect)(0.01)
    assert own.known == pytest.approx(np.sqrt(np.mean((0.01 / error) ** 4) * 96 / 2), rel=1e-9)
    # A frame's brightness from its light alone, the width free beside it: twice the variance of 1/electrons.
    electrons = light(case, 2).sum() / case.gain
    assert error[2] ** 2 == pytest.approx(2 / electrons, rel=0.35)


# The plan


def test_every_beginning_of_the_plan_is_balanced():
    many, total = 1700, sum(plan.SHARES.values())
    jobs = list(islice(generator.plan(generator.FIRST), many))
    assert [job.seed for job in jobs] == list(range(generator.FIRST, generator.FIRST + many))
    for end in (120, 500, many):
        kinds = Counter(job.kind.split(":")[0] for job in jobs[:end])
        for word, part in (("none", 11), ("light", 10), ("one", 42), ("outside", 18), ("tied", 7), ("two", 8),
                           ("hene", 8), ("sheet", 6)):  # fmt: skip
            # Five streams make up those with one effect; each is right to a job.
            assert abs(kinds[word] - end * part / total) <= 5, (end, word)
    strong_ = {design: Counter(job.kind.split(":")[1] for job in jobs if job.kind.startswith("one:")
                               and job.kind.endswith(":50") and job.design == design)
               for design in ("default", "one_exposure", "single_frame")}  # fmt: skip
    assert all(own.total() >= 150 for own in strong_.values())
    assert set(strong_["default"]) == set(VOCABULARY) - set(plan.SHAPES)
    assert not set(strong_["one_exposure"]) & set(plan.NEEDS_EXPOSURES)
    assert max(strong_["default"].values()) - min(strong_["default"].values()) <= 1
    lights = Counter(job.kind.split(":")[2] for job in jobs if job.kind.startswith("one:"))
    assert set(lights) == {"real", "drawn"} and abs(lights["real"] / lights.total() - 0.5) < 0.03
    assert {job.kind.split(":")[1] for job in jobs if job.kind.startswith("outside")} == set(MECHANISMS)
    # Each way of being off, without and beside an effect.
    sheets = {tuple(job.kind.split(":")[1::2]) for job in jobs if job.kind.startswith("sheet") and ":none:" in job.kind}
    assert len(sheets) == 10
    frames = [job for job in jobs if job.kind.startswith("hene")]
    assert len({(job.kind, job.design) for job in frames}) == 9 * len(plan.PUT_IN)
    for k, job in enumerate(frames):
        if job.kind == "hene:rise 6":
            assert any(own.kind == "hene:as it is" and own.design == job.design for own in frames[:k])
    pairs = [job.kind.split(":")[1].split("+") for job in jobs if job.kind.startswith("two")]
    assert not any(set(own) <= group for own in pairs for group in plan.GROUPS)


def test_without_the_shared_folder_what_needs_no_file_is_left(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(beams, "there", lambda: False)
    jobs = list(islice(generator.jobs(1), 300))
    assert "skipped" in capsys.readouterr().err
    assert not any(map(generator.needs_files, jobs)) and {job.kind.split(":")[0] for job in jobs} >= {"one", "none"}
    # The others keep their seeds.
    assert all(job.seed == 1 + job.number for job in jobs) and jobs[-1].number > 400
    assert not generator.write(Job(0, 1, "one:smear:real:50", "default"), tmp_path, tmp_path / "truth.json")


# Folders


def loaded(folder: Path) -> dataset.Dataset:
    """A folder as the library reads it; without errors of the sheet where it does not know them yet."""
    schema = (ROOT / "workflow/spotcheck/schemas/instrument.schema.yaml").read_text(encoding="utf-8")
    if "gain_dn_per_e_stderr" not in schema:
        sheet = yaml.safe_load((folder / "instrument.yaml").read_text(encoding="utf-8"))
        sheet["sensor"] = {k: v for k, v in sheet["sensor"].items() if not k.endswith("_stderr")}
        (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
    return dataset.load(str(folder))


@pytest.mark.parametrize(
    "kind, design, names, frames",
    [("one:smear:drawn:50", "single_frame", ["smear"], 1), ("light:drawn", "single_frame", [], 1),
     ("outside:dust:gauss:15", "one_exposure", ["outside:dust"], None), ("none:gauss", "default", [], 96)],
)  # fmt: skip
def test_a_job_is_a_folder_and_a_truth(tmp_path, kind, design, names, frames):
    for folder in "ab":
        assert generator.write(Job(0, 77, kind, design), tmp_path / folder, tmp_path / f"{folder}.json")
    one, other = (sorted((tmp_path / folder / "frames").iterdir()) for folder in "ab")
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(one, other, strict=True))
    truths = [json.loads((tmp_path / f"{folder}.json").read_text(encoding="utf-8")) for folder in "ab"]
    assert truths[0] == truths[1] and [own["name"] for own in truths[0]["effects"]] == names
    found = loaded(tmp_path / "a")
    # Four angles, 5 to 20 frames each.
    assert len(found.spots) == frames if frames else len(found.spots) in range(20, 81, 4)
    assert tifffile.imread(one[0]).dtype == np.uint16 and one[0].stat().st_size < 80_000
    for own in truths[0]["effects"]:
        assert own["known"] >= own["free"] > 0 and own["wanted"] > 0 and isinstance(own["tied"], bool)


def test_a_sheet_that_is_off_states_its_errors(tmp_path):
    truths, sheets = [], []
    for k, kind in enumerate(("sheet:gain:none:-0.05", "sheet:black_level:none:+0.5", "none:gauss")):
        assert generator.write(Job(0, 9, kind, "single_frame"), tmp_path / f"{k}", tmp_path / "t.json")
        sheets.append(yaml.safe_load((tmp_path / f"{k}" / "instrument.yaml").read_text(encoding="utf-8"))["sensor"])
        truths.append(json.loads((tmp_path / "t.json").read_text(encoding="utf-8")))
    gain, black, plain = sheets
    assert gain["gain_dn_per_e"] == pytest.approx(0.95 * plain["gain_dn_per_e"], rel=1e-4)
    assert black["black_level_dn"] == plain["black_level_dn"] + 0.5 and black["gain_dn_per_e"] == plain["gain_dn_per_e"]
    assert gain["gain_dn_per_e_stderr"] == pytest.approx(0.03 * plain["gain_dn_per_e"], rel=1e-3)
    assert plain["gain_dn_per_e_stderr"] == plain["black_level_dn_stderr"] == 0
    assert truths[0]["sheet_off"] == {"gain": -0.05} and not truths[2]["sheet_off"]


def test_two_effects_and_speckle_on_top(tmp_path):
    case = draw_case(8, "one_exposure", "drawn", [])
    truths = draw.hide(case, ["smear", "row_noise"], 50.0)
    assert [own["name"] for own in truths] == ["smear", "row_noise"] and set(case.effects) == {"smear", "row_noise"}
    counts = [draw._on_top(replace(case, seed=seed)) is not None for seed in range(300)]
    # A third of 300: 100 ± 8.
    assert 65 < sum(counts) < 135
    top = VOCABULARY["speckle"](case, np.random.default_rng(1))
    top.s = 0.3
    (own, grain) = draw.hide(case.only(), ["nonlinearity"], 50.0, top)
    assert grain["on_top"] and grain["parameters"]["contrast"] == 0.3 and own["behind_speckle"] > 0


# Real frames


def test_what_is_put_into_readings_leaves_no_comb():
    """Codes that are bent after rounding leave some of them empty. A smooth histogram stays smooth."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:300, :300] - 150.0
    pixels = np.clip(np.rint(5 + 200 * np.exp(-(x**2 + y**2) / 2 / 60**2) + rng.normal(0, 2, x.shape)), 0, 255)
    naive = np.bincount(np.rint(pixels + 0.15 * pixels**2 / 255).astype(int).ravel(), minlength=256)[20:200]
    bent, name, _ = hene.put(pixels, "bend 0.15", rng)
    codes = np.bincount(bent.astype(int).ravel(), minlength=256)[20:160]
    assert (naive == 0).any() and name == "nonlinearity" and codes.min() > 0
    # Neighbouring counts differ by no more than chance: 8 of their errors, of 140.
    assert np.abs(np.diff(codes) / np.sqrt(codes[1:] + codes[:-1])).max() < 8
    clipped, name, known = hene.put(pixels, "clip 0.7", rng)
    assert clipped.max() == round(known["level"]) and name == "saturation"
    risen, _, known = hene.put(pixels, "rise 6", rng)
    assert np.mean(risen - pixels) == pytest.approx(6, abs=0.05) and known == {"rise": 6.0}
    striped, _, known = hene.put(pixels, "stripes 0.1 9", rng)
    angle = np.radians(known["direction"])
    wave = np.exp(-2j * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / 9)
    assert 2 * np.abs(np.sum((striped - pixels) * wave)) / pixels.sum() == pytest.approx(0.1, rel=0.05)
    assert hene.put(pixels, "as it is", rng)[1:] == ("", {})
    assert all(np.array_equal(a, b) for a, b in pairwise([pixels, hene.put(pixels, "as it is", rng)[0]]))


@pytest.mark.skipif(not beams.there(), reason="real frames lie beside the repository")
def test_a_real_frame_is_a_folder(tmp_path):
    assert generator.write(Job(0, 5, "hene:clip 0.9", "frame 2"), tmp_path / "a", tmp_path / "t.json")
    truth = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))
    assert truth["frame"] == "t-280mm" and truth["effects"][0]["name"] == "saturation"
    assert len(loaded(tmp_path / "a").spots) == 1
