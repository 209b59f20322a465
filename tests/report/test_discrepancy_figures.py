"""discrepancy.nc holds what was measured, its pictures cope with every outcome and design, the report shows them."""

import json
import re
import shutil
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from spotcheck.dataset.folder import load
from spotcheck.discrepancy.findings import Findings
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.learned_light import summarize_shape
from spotcheck.discrepancy.pictures import AFTER, BEFORE, ConditionGrid, draw_pictures, skipped_pictures
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.starting_spots import fit_spots
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.written import write_verdict
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text
from spotcheck.model.baseline import Baseline
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light_shape import LightShape
from spotcheck.model.model_writer import LightFile, write_light, write_no_light
from spotcheck.report.dataset_page.evidence import tabulate_evidence
from spotcheck.report.figures import answer, every_figure, series, style
from spotcheck.report.figures.discrepancy import tabulate_conditions
from spotcheck.report.figures.entry import Category
from spotcheck.report.figures.results import Results, Unavailable
from spotcheck.report.pages import TEMPLATES
from spotcheck.report.pages.citations import Citations
from tests.samples import small_set as small
from tests.samples.findings_cases import KINDS, MOVED, PAIR, agree, closed, disagree, learned, named
from tests.samples.model_files import applied
from tests.samples.small_datasets import folder

ENTRIES = tuple(entry for entry in every_figure() if entry.category is Category.MISSING)
OF_LIGHT = "missing-light"
# The ghost of `small.ghost`, as an effect and as it is named.
ADDED = applied("ghost_reflection", fraction=0.06, dx=12.0, dy=-5.0)
NAMED = disagree(
    effects=(named("ghost_reflection", (0.06, 0.001), (12.0, 0.3), (-5.0, 0.3), gap_closed=0.986),),
    gap=closed(0.986),
    not_assessed=(("angle_reflectance", "fewer than three fibre angles"),),
)
# A light with a hill of 5 % of the peak beside its centre.
HILL = LightShape(0.5, 0.05 * np.exp(-((np.arange(21)[:, None] - 10) ** 2 + (np.arange(21) - 13) ** 2) / 4))
SHAPED = disagree(light=learned(shape=HILL), gap=closed(0.97))
UNKNOWN = KINDS["unknown"][0]
ONE = {"angles": (45.0,), "exposures": (4e-4,), "repeats": 1}
NO_AXES = {"angles": (None,), "exposures": (None,), "repeats": 1}
MANY = {"angles": (0.0, 90.0), "exposures": tuple(np.geomspace(1e-4, 1e-3, 9)), "repeats": 1}
DECLARED_LIGHT = "the declared shape of the light stands"


@dataclass(frozen=True)
class Made:
    """The files of a verdict on a small dataset, and what they were made of."""

    drawn: list[small.SmallFrame]  # the frames
    spots: FrameParameters  # their spots under the declared model
    ds: xr.Dataset  # discrepancy.nc as it comes back from the file
    verdict: dict
    results: Results


def frame_set(drawn: list[small.SmallFrame]) -> FrameSet:
    """Return small frames as the package has them."""
    exposure_s = np.array([frame.exposure_s or 1.0 for frame in drawn])
    angle = np.deg2rad([frame.angle_deg or 0.0 for frame in drawn])
    repeat = np.array([frame.repeat for frame in drawn])
    nothing = np.zeros(len(drawn), int)
    design = Design(
        exposure_s=exposure_s,
        angle=angle,
        order=np.full(len(drawn), 0.5),
        repeat=repeat,
        site=np.unique(np.stack([angle, repeat]), axis=1, return_inverse=True)[1].ravel(),
        condition=np.unique(exposure_s, return_inverse=True)[1],
        longest_s=float(exposure_s.max()),
        reference_s=float(np.exp(np.mean(np.log(np.unique(exposure_s))))),
        has_exposures=drawn[0].exposure_s is not None,
        has_order=False,
    )
    readings = np.array([frame.readings for frame in drawn], float)
    return FrameSet(readings, nothing, nothing, design, small.SIDE, small.SIDE)


def make_files(base: Path, findings: Findings, light: small.Light = small.ghost, **design) -> Made:
    """Write the files of a verdict on frames with some light; what is added to the model is the ghost."""
    drawn = small.draw_small(light, **design)
    dataset, frames = small.write_dataset(base / "data", drawn), frame_set(drawn)
    rows = np.array([[np.log(f.peak_dn), np.log(f.sigma_px), f.x, f.y] for f in drawn]).T
    declared = ForwardModel(Baseline(0.0, "free", False, frames.design.longest_s), small.SENSOR)
    models = {}
    for stage, effects in ((BEFORE, ()), (AFTER, (ADDED,))):
        if stage == BEFORE or findings.effects or findings.light:
            forward = replace(declared, effects=effects)
            spots = fit_spots(forward, frames, FrameParameters(*rows)).spots
            models[stage] = JointModel(forward, spots, frames.design)
    place = {id(row): index for index, row in dataset.cells()}
    cells = [place[id(row)] for row in dataset.spots]
    verdict = compose_verdict(findings, dataset.name)
    verdict["sentence"] = summarize_verdict(verdict)
    words = {"status": verdict["status"], "alpha": 0.01}
    pictures = (
        skipped_pictures(dataset, reason=findings.reason, **words)
        if findings.reason
        else draw_pictures(dataset, cells, frames, models, findings.detection, **words)
    )
    out = base / "results"
    store.write(pictures, out / "discrepancy.nc", code="test")
    write_verdict(verdict, out / "verdict.json")
    if findings.light is None:
        write_no_light(DECLARED_LIGHT, LightFile(out / "light.nc", dataset.name, "test"))
    else:
        attributes = summarize_shape(findings.light)
        write_light([findings.light.shape], LightFile(out / "light.nc", dataset.name, "test", attributes=attributes))
    with store.read(out / "discrepancy.nc") as ds:
        return Made(drawn, models[BEFORE].spots, ds.load(), verdict, Results(out, dataset))


@pytest.fixture(scope="module")
def ghostly(tmp_path_factory) -> Made:
    """Return the files of a ghost that was named."""
    return make_files(tmp_path_factory.mktemp("ghostly"), NAMED)


@dataclass(frozen=True)
class Residuals:
    """Residuals of the declared model at one condition, by numpy alone."""

    residual: np.ndarray  # measured less model [frame, row, column] DN
    variance: np.ndarray  # its variance [frame, row, column] DN²
    x: np.ndarray  # column of the spot [frame, px]
    y: np.ndarray  # row of the spot [frame, px]
    sigma: np.ndarray  # width of the spot [frame, px]

    @property
    def offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows from the spot [frame, row, column, px]."""
        row, column = np.mgrid[: small.SIDE, : small.SIDE]
        return column - self.x[:, None, None], row - self.y[:, None, None]


def residuals_of(made: Made, angle: float, exposure: float) -> Residuals:
    """Return the residuals of a Gaussian: variance of light, of reading and of rounding (EMVA 1288, Eq. 14)."""
    at = [k for k, f in enumerate(made.drawn) if (f.angle_deg, f.exposure_s) == (angle, exposure)]
    row, column = np.mgrid[: small.SIDE, : small.SIDE]
    residual, variance = [], []
    for k in at:
        square = (column - made.spots.x[k]) ** 2 + (row - made.spots.y[k]) ** 2
        light = np.exp(made.spots.log_peak[k] - square / (2 * np.exp(2 * made.spots.log_sigma[k])))
        residual.append(made.drawn[k].readings - light - small.SENSOR.black_level_dn)
        variance.append(0.11 * light + (0.11 * small.SENSOR.read_noise_e) ** 2 + 1 / 12)
    sigma = np.exp(made.spots.log_sigma[at])
    return Residuals(np.array(residual), np.array(variance), made.spots.x[at], made.spots.y[at], sigma)


def test_maps_are_means_over_repeats(ghostly):
    """Residuals are measured less declared model in blocks of one pixel; the ghost is there before and not after."""
    for angle in small.ANGLES:
        for exposure in small.EXPOSURES:
            residual = residuals_of(ghostly, angle, exposure).residual
            assert len(residual) == small.REPEATS
            shown = ghostly.ds["residual_before"].sel(angle=angle, exposure=exposure)
            np.testing.assert_allclose(shown, residual.mean(axis=0), atol=2e-3)
    before, after = (float(np.sqrt((ghostly.ds[f"residual_{s}"] ** 2).mean())) for s in ("before", "after"))
    # Of 3 frames of noise of 1 to 8 DN and a ghost of up to 36 DN.
    assert after < 0.6 * before
    smooth = ghostly.ds["residual_after"].coarsen(block_y=10, block_x=10).mean()
    assert float(np.abs(smooth).max()) < 1.5 < float(ghostly.ds["residual_before"].max())


def test_profiles_and_the_gap_are_those_of_the_pixels(ghostly):
    """Mean over a ring and its error, and mean square over noise, are those of a count by numpy."""
    exposure = small.EXPOSURES[0]
    known, place = residuals_of(ghostly, 45.0, exposure), ghostly.ds.sel(angle=45.0, exposure=exposure)
    assert float(place["sigma"]) == pytest.approx(known.sigma.mean(), rel=1e-6)
    assert float(place["spot_x"]) == pytest.approx(known.x.mean(), rel=1e-6)
    radius = np.hypot(*known.offsets)
    step = float(ghostly.ds["radius"][1] - ghostly.ds["radius"][0])
    for k in (1, 5, 12):
        ring = np.abs(radius - float(ghostly.ds["radius"][k])) < step / 2
        mean, error = known.residual[ring].mean(), np.sqrt(known.variance[ring].sum()) / ring.sum()
        assert float(place["profile_before"][k]) == pytest.approx(mean, rel=2e-3, abs=2e-3)
        assert float(place["profile_before_stderr"][k]) == pytest.approx(error, rel=2e-3)
    square = (known.residual**2 / known.variance).mean()
    assert float(place["gap_before"]) == pytest.approx(square, rel=2e-3) and square > 1.5
    assert (np.abs(ghostly.ds["gap_after"] - ghostly.ds["gap_floor"]) < 5 * ghostly.ds["gap_stderr"]).all()
    # The noise of the extended model over that of the declared one, which has less light.
    assert 1 < float(ghostly.ds["gap_floor"]) < 1.05
    assert float(place["gap_stderr"]) == pytest.approx(np.sqrt(2 / known.residual.size), rel=0.05)
    assert ghostly.ds.attrs["gap_on"] == "frames that were searched"


def test_rings_stand_out_by_their_noise(ghostly):
    """z of a ring's mean, and of the strongest of six azimuthal orders by Bonferroni's bound, as numpy counts them."""
    exposure = small.EXPOSURES[1]
    known, place = residuals_of(ghostly, 0.0, exposure), ghostly.ds.sel(angle=0.0, exposure=exposure)
    dx, dy = known.offsets
    radius, turn = np.hypot(dx, dy) / known.sigma[:, None, None], np.arctan2(dy, dx)
    for k, (low, high) in enumerate([(0.0, 0.5), (0.5, 1.0), (1.0, 1.5)]):
        ring = (radius >= low) & (radius < high)
        residual, variance = known.residual[ring], known.variance[ring]
        z = residual.sum() / np.sqrt(variance.sum())
        assert float(place["z_radial"][k]) == pytest.approx(z, rel=1e-2, abs=0.02)
        power = [sum(((w * residual).sum()) ** 2 / (w * w * variance).sum() for w in (np.cos(m * turn[ring]),
                 np.sin(m * turn[ring]))) for m in range(1, 7)]  # fmt: skip
        assert float(place["z_order"][k]) == 1 + np.argmax(power)
        expected = stats.norm.isf(6 * np.exp(-max(power) / 2) / 2)
        assert not np.isfinite(expected) or float(place["z_azimuthal"][k]) == pytest.approx(expected, rel=1e-2)
    cells = 2 * int(np.isfinite(ghostly.ds["z_radial"]).sum())
    assert float(ghostly.ds["z_threshold"]) == pytest.approx(stats.norm.isf(0.01 / 2 / cells))


# Figures.


def draw_figures(made: Made) -> tuple[dict[str, str], dict[str, str]]:
    """Return the captions of the pictures of a verdict, and why others were not drawn; a warning is an error."""
    captions, skipped = {}, {}
    with warnings.catch_warnings(), style.house_style(), made.results as results:
        warnings.simplefilter("error")
        for entry in ENTRIES:
            try:
                drawing = entry.draw(results)
            except Unavailable as reason:
                skipped[entry.name] = str(reason)
            else:
                drawing.figure.draw_without_rendering()
                captions[entry.name] = drawing.caption
    return captions, skipped


@pytest.mark.parametrize(
    ("findings", "light", "design"),
    [
        (NAMED, small.ghost, {}),
        (agree(), small.plain, {}),
        (NAMED, small.ghost, ONE),
        (SHAPED, small.ghost, ONE),
        (UNKNOWN, small.bump, NO_AXES),
        (UNKNOWN, small.bump, MANY),
    ],
    ids=["named", "consistent", "one frame", "a learned light", "no axes", "many conditions"],
)
def test_pictures_of_every_outcome_and_design(findings, light, design, tmp_path):
    """Each is drawn, or says why it is not; captions hold no word of the program."""
    made = make_files(tmp_path, findings, light, **design)
    captions, skipped = draw_figures(made)
    reasons = {}
    if not made.verdict["effects"]:
        reasons["missing-evidence"] = "nothing was added to the model"
        assert "no after" in captions["missing-gap"] and "no after" in captions["missing-residuals"]
    if findings.light is None:
        reasons[OF_LIGHT] = DECLARED_LIGHT
    assert skipped == reasons and {*captions, *skipped} == {entry.name for entry in ENTRIES}
    assert not any(word in text for text in captions.values() for word in ("nan", "None", "inf "))
    assert ("residual_after" in made.ds) == bool(made.verdict["effects"])
    if light is small.plain:
        assert "(0 of" in captions["missing-where"]
    if findings.light is not None:
        assert "6 % of its power lies elsewhere" in captions[OF_LIGHT]


def test_pictures_are_what_the_captions_say(ghostly):
    """Both sides share one scale; bold is what noise does not reach; as many marks stand as are counted."""
    with ghostly.results as results, style.house_style():
        sheet = {entry.name: entry.draw(results).figure for entry in ENTRIES if entry.name != OF_LIGHT}
    maps = [image for ax in sheet["missing-residuals"].axes for image in ax.get_images()]
    maps = [image for image in maps if image.get_array().shape == (small.SIDE, small.SIDE)]
    assert len(maps) == 2 * 4 and len({image.get_clim() for image in maps}) == 1
    texts = [text for ax in sheet["missing-gap"].axes for text in ax.texts]
    assert [text.get_weight() for text in texts] == ["bold"] * 4 + ["normal"] * 4
    marks = [t for ax in sheet["missing-where"].axes for t in ax.texts if t.get_text() in ("•", *"123456")]
    limit = float(ghostly.ds["z_threshold"])
    count = int((np.abs(ghostly.ds["z_radial"]) > limit).sum() + (ghostly.ds["z_azimuthal"] > limit).sum())
    assert len(marks) == count > 10
    assert sorted(ghostly.ds["part"].values) == ["blocks: row 96, column 120", "frames"]
    store.check(ghostly.ds, "pictures")


def test_evidence_shows_every_name_and_its_rivals(tmp_path):
    """A point stands at the gain of each, a rival's less by what it is behind; bars at the part that is closed."""
    made = make_files(tmp_path, disagree(effects=(replace(PAIR, gap_closed=0.98),), gap=closed(0.98)), **ONE)
    (entry,) = (entry for entry in ENTRIES if entry.name == "missing-evidence")
    with made.results as results, style.house_style():
        ax, right = entry.draw(results).figure.axes
    assert [text.get_text() for text in ax.get_yticklabels()] == ["ghost_reflection", "or scatter_halo"]
    points = [float(line.get_xdata()[0]) for line in ax.lines if line.get_marker() == "o"]
    assert points == pytest.approx([900.0, 900.0 - 4.6])
    assert [bar.get_width() for bar in right.patches] == pytest.approx([98.0])


def test_the_answer_shows_the_condition_that_gains_most(ghostly):
    """Measured less each model is what the maps say is left; the caption names what was added, with its value."""
    ds = ghostly.ds
    gain = (ds["residual_before"] ** 2 - ds["residual_after"] ** 2).sum(("block_y", "block_x"))
    best = gain.isel(gain.argmax(...))
    shown = answer.choose_example(ds)
    angle, exposure = float(best["angle"]), float(best["exposure"])
    assert shown.name == f"{angle:g}°, {1e6 * exposure:g} µs"
    place = ds.sel(angle=angle, exposure=exposure)
    np.testing.assert_array_equal(shown.measured, place["reading"])
    for stage in ("before", "after"):
        np.testing.assert_array_equal(shown.residuals[stage], place[f"residual_{stage}"])
        np.testing.assert_allclose(shown.models[stage] + shown.residuals[stage], shown.measured, atol=1e-3)
    readings = [f.readings for f in ghostly.drawn if (f.angle_deg, f.exposure_s) == (angle, exposure)]
    np.testing.assert_allclose(shown.measured, np.mean(readings, axis=0), rtol=1e-6)
    with ghostly.results as results, style.house_style():
        caption = answer.draw_answer(results).caption
    fraction = ghostly.verdict["effects"][0]["parameters"]["fraction"]
    assert "Verdict: named." in caption and f"fraction {quantity_text(*fraction.values())}" in caption


def test_no_answer_without_a_verdict(ghostly, tmp_path):
    """The caption needs the verdict; a file that is missing is named."""
    shutil.copyfile(ghostly.results.folder / "discrepancy.nc", tmp_path / "discrepancy.nc")
    with Results(tmp_path, ghostly.results.dataset) as results:
        with pytest.raises(Unavailable, match=r"verdict\.json is not among"):
            answer.draw_answer(results)


NO_SPOT = "no spot could be fitted in any frame"
PLACES = "Places of the largest residuals"


def test_nothing_assessed_leaves_the_reason(tmp_path):
    """Each picture says why it is not drawn."""
    captions, skipped = draw_figures(make_files(tmp_path, Findings(reason=NO_SPOT), **ONE))
    reasons = dict.fromkeys((entry.name for entry in ENTRIES), NO_SPOT)
    reasons |= {"missing-evidence": "nothing was added to the model", OF_LIGHT: DECLARED_LIGHT}
    assert captions == {} and skipped == reasons


# Conditions as a grid.


def test_a_condition_without_frames_stays_empty(tmp_path):
    """Of a grid with a hole every other condition keeps its place: no frame of (45°, shorter exposure) was usable."""
    dataset = small.write_dataset(tmp_path, small.draw_small())
    hole = 45.0, small.EXPOSURES[0]
    grid = ConditionGrid.of_frames(
        dataset, [index for index, row in dataset.cells() if (row.angle_deg, row.exposure_s) != hole]
    )
    np.testing.assert_array_equal(grid.spread(np.array([1.0, 2.0, 3.0])), [[1.0, 2.0], [np.nan, 3.0]])
    frames = grid.condition.astype(float)
    np.testing.assert_array_equal(grid.average(np.where(frames == 1, np.nan, frames)), [0.0, np.nan, 2.0])


def test_declared_conditions_are_axes(tmp_path):
    """z_m is an axis; each condition has its place, whether or not all places have frames."""
    rows = [f"frames/f{k}.tif,spot,0,1e-4,0,{z}" for k, z in enumerate((0.1, 0.2, 0.3))]
    folder(tmp_path, rows, "{name: scan, conditions: [z_m]}", "file,kind,angle_deg,exposure_s,repeat,z_m")
    scan = load(tmp_path)
    cells = [index for index, _ in scan.cells()]
    whole, fewer = ConditionGrid.of_frames(scan, cells), ConditionGrid.of_frames(scan, cells[1:])
    assert (whole.dims, whole.places) == (("angle", "exposure", "z_m"), ((0, 0, 0), (0, 0, 1), (0, 0, 2)))
    assert fewer.places == ((0, 0, 1), (0, 0, 2)) and fewer.shape == (1, 1, 3)


def test_tables_of_conditions():
    """Rows are angle and declared conditions, columns exposures, whatever the order of the dimensions."""
    values = np.arange(12.0).reshape(2, 2, 3)
    ds = xr.Dataset(
        {"sigma": (("angle", "exposure", "z_m"), values, {"units": "pixel", "long_name": "width"})},
        coords={"angle": ("angle", [0.0, 45.0], {"units": "degree", "long_name": "a"}),
                "exposure": ("exposure", [1e-4, 9e-4], {"units": "s", "long_name": "t"}),
                "z_m": ("z_m", [0.1, 0.2, 0.3], {"units": "m", "long_name": "z"})},
    )  # fmt: skip
    table = tabulate_conditions(ds)
    assert table.columns == ["100 µs", "900 µs"]
    assert table.rows[4] == "45°, 200 mm"
    np.testing.assert_array_equal(table.read(ds, "sigma")[4], values[1, :, 1])
    np.testing.assert_array_equal(series.pick_evenly(9, 3), [0, 4, 8])
    np.testing.assert_array_equal(series.pick_evenly(2, 4), [0, 1])


# The report.


def page(findings: Findings, base: Path) -> tuple[str, dict]:
    """Return the report's part on a verdict as a reader sees it, and the verdict."""
    verdict = compose_verdict(findings, "small")
    verdict["sentence"] = summarize_verdict(verdict)
    write_verdict(verdict, base / "verdict.json")
    verdict = json.loads((base / "verdict.json").read_text(encoding="utf-8"))
    evidence = tabulate_evidence(verdict, Citations(base))
    html = TEMPLATES.get_template("dataset_page/evidence.html").render(evidence=evidence)
    return re.sub("</?span[^>]*>", "", html), verdict


@pytest.mark.parametrize(
    ("findings", "there", "not_there"),
    [
        (
            replace(KINDS["pair"][0], not_assessed=NAMED.not_assessed, law=MOVED),
            ["<code>ghost_reflection</code>", "fraction = 0.0239 ± 0.0004", "<td>scatter_halo</td>", "98 %",
             "held-out repeats", "<td>p1</td>", "12 frames at an exposure of 1.8 ms",
             "<code>angle_reflectance</code>: fewer than three", PLACES, "<td>row 96, column 120 at 0.4 ms</td>"],
            [],
        ),
        (agree(), ["light smeared along columns below 0.04 %"], []),
        (Findings(reason=NO_SPOT), ["no spot could be fitted"], ["<td>p1</td>", PLACES]),
    ],
    ids=["a pair", "upper limits", "not assessed"],
)  # fmt: skip
def test_the_report_shows_the_verdict(findings, there, not_there, tmp_path):
    """Sentence, effects with values and rivals, the gap, the law, advice and places, how large an effect that is not
    named could still be; where nothing was assessed the reason, and no table."""
    text, verdict = page(findings, tmp_path)
    assert verdict["sentence"][:40] in text
    assert [part for part in there if part not in text] == []
    assert not any(part in text for part in (*not_there, "None", "nan"))
