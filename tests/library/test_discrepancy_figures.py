"""discrepancy.nc holds what was measured, its pictures cope with every outcome and design, the report shows them."""

import json
import shutil
import warnings

import jinja2
import numpy as np
import pytest
import xarray as xr

from spotcheck import store
from spotcheck.discrepancy.cells import pooled
from spotcheck.discrepancy.locate import where
from spotcheck.discrepancy.picture_data import _canvas, dataset_of
from spotcheck.discrepancy.sentence import sentence, value_text
from spotcheck.discrepancy.shots import Shot, design_of
from spotcheck.discrepancy.written import rounded, write_verdict
from spotcheck.figures import answer, every_figure, style
from spotcheck.figures.discrepancy import chosen, plan_of
from spotcheck.figures.entry import Category
from spotcheck.figures.results import Results, Unavailable
from spotcheck.figures.write import write_all
from spotcheck.pages import TEMPLATES, report
from tests.library import small_verdict as small

ENTRIES = tuple(entry for entry in every_figure() if entry.category is Category.MISSING)
GHOST = ("ghost_reflection", 0.05, 11.0, -4.0)
ONE = {"angles": (45.0,), "exposures": (4e-4,), "repeats": 1}


def made(tmp_path, own, **design):
    """discrepancy.nc as it comes back from the file, its verdict, and the dataset."""
    found = small.dataset(tmp_path / "data", **design)
    verdict = small.verdict_of(own, found.name)
    if own.findings is not None:
        verdict["where"] = where(own.findings.look, own.findings.base, 0.01, own.findings.detection)
    verdict["sentence"] = sentence(verdict)
    out = tmp_path / "results" / "discrepancy.nc"
    store.write(dataset_of(own, verdict, found), out, code="test")
    out.with_name("verdict.json").write_text(json.dumps(rounded(verdict)))
    with store.read(out) as ds:
        return ds.load(), verdict, found


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """A ghost that was named."""
    base = tmp_path_factory.mktemp("named")
    own = small.judgement("named", small.ghost, small.present(*GHOST))
    return base, own, *made(base, own)


def test_maps_are_medians_over_repeats(named):
    """Of each frame's own blocks, less what the fit changed; the ghost is there before and not after."""
    _, own, ds, _, _ = named
    look, fit = own.findings.look, own.findings.base.refit
    design, change = look.measured.design, pooled(fit.moments.mean) - look.problem.mean_start
    for c in range(design.conditions):
        at = {"angle": design.angle_deg[c], "exposure": design.exposure_s[c]}
        frames = look.measured.sums.residual[design.condition == c]
        assert len(frames) == small.REPEATS
        expected = np.median(frames, axis=0) - change[c]
        np.testing.assert_allclose(ds["residual_before"].sel(at), expected, atol=1e-4)
    before, after = (float(np.sqrt((ds[f"residual_{s}"] ** 2).mean())) for s in ("before", "after"))
    assert after < 0.3 * before


def test_profiles_and_the_gap_are_those_of_the_blocks(named):
    """Counted once more, block by block: mean over a ring and its error; mean square over noise by condition."""
    _, own, ds, _, _ = named
    look, fit = own.findings.look, own.findings.base.refit
    at = {"angle": 45.0, "exposure": small.EXPOSURES[0]}
    place = ds.sel(at)
    y, x = np.meshgrid(ds["block_y"], ds["block_x"], indexing="ij")
    radius = np.hypot(x - float(place["spot_x"]), y - float(place["spot_y"]))
    c = 2
    assert (look.measured.design.angle_deg[c], look.measured.design.exposure_s[c]) == (45.0, small.EXPOSURES[0])
    assert float(place["sigma"]) == pytest.approx(small.LAW.p1 * np.log(1e-4) + small.LAW.p2)
    step = float(ds["radius"][1] - ds["radius"][0])
    for k in (1, 5, 12):
        ring = np.abs(radius - float(ds["radius"][k])) < step / 2
        assert float(place["profile_before"][k]) == pytest.approx(fit.residual[c][ring].mean(), rel=2e-3, abs=1e-3)
        error = np.sqrt(fit.variance[c][ring].sum()) / ring.sum()
        assert float(place["profile_before_stderr"][k]) == pytest.approx(error, rel=1e-3)
    square = (fit.residual[c] ** 2 / fit.variance[c]).mean()
    assert float(place["gap_before"]) == pytest.approx(square) and square > 5
    assert abs(float(place["gap_after"]) - float(ds["gap_floor"])) < 4 * float(place["gap_stderr"])
    assert float(place["gap_stderr"]) == pytest.approx(np.sqrt(2 / fit.residual[c].size), rel=0.02)
    assert ds.attrs["gap_on"] == "frames that chose the model"


def test_unseen_data_come_first_where_their_variance_is_known(named, tmp_path):
    """Then the gap by condition is that of the unseen frames, and says so."""
    _, own, plain, _, _ = named
    maps = own.gap.maps | {f"variance_{s}": np.full(own.gap.maps[s].shape, 4.0) for s in ("before", "after")}
    ds, _, _ = made(tmp_path, own._replace(gap=own.gap._replace(maps=maps)))
    assert ds.attrs["gap_on"] == "left-out repeats"
    np.testing.assert_allclose(ds["gap_before"].values.ravel(), (maps["before"] ** 2 / 4).mean(axis=(1, 2)), rtol=1e-6)
    assert not np.allclose(ds["gap_before"], plain["gap_before"])


def test_candidates_are_ordered_and_marked(named):
    _, own, ds, _, _ = named
    assert [str(n) for n in ds["candidate"].values] == ["ghost_reflection", "super_gaussian", "motion_blur"]
    np.testing.assert_array_equal(ds["candidate_role"], [1, 0, 0])
    score = own.findings.evidence["ghost_reflection"][0]
    np.testing.assert_allclose(ds["candidate_behind"], [0.0, -5 - score, -5 - score])
    assert float(ds["nothing_behind"]) == pytest.approx(-score) and -score > 1000
    closed = ds["candidate_closed"].values
    assert 0.95 < closed[0] < 1.05 and np.all(np.abs(closed[1:]) < 0.01)


def test_sets_stand_beside_their_parts(tmp_path):
    """A set that holds comes first; its parts alone do not hold, but are marked. An unknown rest marks nothing."""
    effects = [small.present(*GHOST), small.present("dark_offset", 0.5)]
    own = small.judgement("ambiguous", small.ghost, *effects)
    ds, _, _ = made(tmp_path / "a", own)
    roles = dict(zip(ds["candidate"].values.tolist(), ds["candidate_role"].values.tolist(), strict=True))
    assert roles == {"ghost_reflection + dark_offset": 1, "ghost_reflection": 2, "dark_offset": 2, "super_gaussian": 0,
                     "motion_blur": 0}  # fmt: skip
    assert next(iter(roles)) == "ghost_reflection + dark_offset"
    unknown = own._replace(findings=own.findings._replace(status="unknown"))
    ds, _, _ = made(tmp_path / "b", unknown)
    assert not ds["candidate_role"].any()


def drawn(base, found) -> tuple[dict[str, str], dict[str, str]]:
    """Captions of the pictures of a verdict, and why the others were not drawn; a warning is an error."""
    captions, skipped = {}, {}
    with warnings.catch_warnings(), style.applied(), Results(base / "results", found) as results:
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
    ("status", "effects", "design"),
    [
        ("named", [GHOST], {}),
        ("consistent", [], {}),
        ("named", [GHOST], ONE),
        ("unknown", [], {"angles": (None,), "exposures": (None,), "repeats": 1}),
        ("unknown", [], {"angles": (0.0, 90.0), "exposures": tuple(np.geomspace(1e-4, 1e-3, 9)), "repeats": 1}),
    ],
    ids=["named", "consistent", "one frame", "no axes", "many conditions"],
)
def test_pictures_of_every_outcome_and_design(status, effects, design, tmp_path):
    light = small.plain if status == "consistent" else small.ghost
    own = small.judgement(status, light, *(small.present(*e) for e in effects), **design)
    ds, _, found = made(tmp_path, own, **design)
    captions, skipped = drawn(tmp_path, found)
    if status == "consistent":
        assert skipped == {"missing-evidence": "nothing disagreed enough for an effect to be tried"}
        assert "(0 of" in captions["missing-where"] and "no after" in captions["missing-gap"]
    else:
        assert not skipped and set(captions) == {entry.name for entry in ENTRIES}
        assert ("None holds" in captions["missing-evidence"]) == (status == "unknown")
    assert not any("nan" in text or "None " in text.replace("None holds", "") for text in captions.values())
    assert ("residual_after" in ds) == bool(effects)


def test_what_led_at_first_and_failed_is_said(tmp_path):
    """The first look may put another effect before the one that holds; the caption does not hide it."""
    own = small.judgement("named", small.ghost, small.present(*GHOST), **ONE)
    score = own.findings.evidence["ghost_reflection"][0]
    evidence = own.findings.evidence | {"speckle": (score - 50.0, own.findings.base.refit.chi2)}
    own = own._replace(findings=own.findings._replace(evidence=evidence))
    ds, _, found = made(tmp_path, own, **ONE)
    assert str(ds["candidate"].values[0]) == "ghost_reflection" and float(ds["candidate_behind"][0]) == pytest.approx(
        50
    )
    (entry,) = (entry for entry in ENTRIES if entry.name == "missing-evidence")
    with Results(tmp_path / "results", found) as results, style.applied():
        assert entry.draw(results).caption.endswith("failing pixel by pixel: speckle.")


def test_pictures_are_what_the_captions_say(named):
    """Both sides share one scale; bold where noise does not reach; as many marks as counted."""
    base, _, ds, _, found = named
    with Results(base / "results", found) as results, style.applied():
        sheet = {entry.name: entry.draw(results).figure for entry in ENTRIES}
    maps = [image for ax in sheet["missing-residuals"].axes for image in ax.get_images() if image.get_array().ndim == 2]
    maps = [image for image in maps if image.get_array().shape == (30, 30)]
    assert len(maps) == 2 * 4 and len({image.get_clim() for image in maps}) == 1
    texts = [text for ax in sheet["missing-gap"].axes for text in ax.texts]
    assert [text.get_weight() for text in texts] == ["bold"] * 4 + ["normal"] * 4
    marks = [t for ax in sheet["missing-where"].axes for t in ax.texts if t.get_text() in ("•", *"1234")]
    limit = float(ds["z_threshold"])
    assert len(marks) == int((np.abs(ds["z_radial"]) > limit).sum() + (ds["z_azimuthal"] > limit).sum()) > 10


def test_the_answer_shows_the_condition_that_gains_most(named):
    """Measured less each model is what the maps say is left; the caption names what was added, with its value."""
    base, _, ds, verdict, found = named
    gain = (ds["residual_before"] ** 2 - ds["residual_after"] ** 2).sum(("block_y", "block_x"))
    best = gain.isel(gain.argmax(...))
    shown = answer.example(ds)
    assert shown.name == f"{float(best['angle']):g}°, {1e6 * float(best['exposure']):g} µs"
    own = ds.sel(angle=best["angle"], exposure=best["exposure"])
    np.testing.assert_array_equal(shown.measured, own["reading"])
    for stage in ("before", "after"):
        np.testing.assert_array_equal(shown.residuals[stage], own[f"residual_{stage}"])
        np.testing.assert_allclose(shown.models[stage] + shown.residuals[stage], shown.measured, atol=1e-3)
    # The frames' own medians, whose centres lie up to half a pixel from their mean: half of the steepest slope.
    at = float(best["angle"]), float(best["exposure"])
    shots = [shot for shot in small.frames(small.ghost)[0] if (shot.angle_deg, shot.exposure_s) == at]
    blocks = np.median([shot.pixels().reshape(30, 2, 30, 2).mean(axis=(1, 3)) for shot in shots], axis=0)
    slope = np.exp(-0.5) * blocks.max() / float(own["sigma"])
    np.testing.assert_allclose(shown.measured, blocks, atol=slope / 2)
    with Results(base / "results", found) as results, style.applied():
        caption = answer.draw(results).caption
    fraction = verdict["effects"][0]["parameters"]["fraction"]
    assert "Verdict: named." in caption and f"fraction {value_text(*fraction.values())}" in caption


def test_no_answer_without_a_verdict(named, tmp_path):
    base, _, _, _, found = named
    shutil.copyfile(base / "results" / "discrepancy.nc", tmp_path / "discrepancy.nc")
    with Results(tmp_path, found) as results, pytest.raises(Unavailable, match=r"verdict\.json is not among"):
        answer.draw(results)


def test_equal_inputs_give_equal_pictures(named, tmp_path):
    base, _, _, _, found = named
    entries = tuple(entry for entry in ENTRIES if entry.name == "missing-gap")
    for name in ("one", "two"):
        with Results(base / "results", found) as results:
            write_all(results, tmp_path / name, entries)
    files = sorted(p.name for p in (tmp_path / "one").iterdir() if p.is_file())
    assert len(files) == 2 * len(entries) + 1
    assert all((tmp_path / "one" / n).read_bytes() == (tmp_path / "two" / n).read_bytes() for n in files)


def test_nothing_assessed_leaves_the_reason(tmp_path):
    _, _, found = made(tmp_path, small.nothing("no spot could be fitted in any frame"))
    captions, skipped = drawn(tmp_path, found)
    assert captions == {}
    assert skipped == dict.fromkeys((entry.name for entry in ENTRIES), "no spot could be fitted in any frame")


def test_a_cell_without_frames_stays_empty(tmp_path):
    """Of a grid with a hole every other condition keeps its place: no frame of (45°, shorter exposure) was usable."""
    shots = [s for s in small.frames()[0] if (s.angle_deg, s.exposure_s) != (45.0, small.EXPOSURES[0])]
    canvas = _canvas(design_of(shots), small.dataset(tmp_path), None)
    np.testing.assert_array_equal(canvas.spread(np.array([1.0, 2.0, 3.0])), [[1.0, 2.0], [np.nan, 3.0]])


def test_declared_conditions_need_the_shots_where_places_are_missing(tmp_path):
    """z_m is an axis; with every place used the dataset tells them apart, else the shots do."""
    rows = [f"frames/f{k}.tif,spot,0,1e-4,0,{z}" for k, z in enumerate((0.1, 0.2, 0.3))]
    small.folder(tmp_path, rows, "{name: scan, conditions: [z_m]}", "file,kind,angle_deg,exposure_s,repeat,z_m")
    found = small.load(tmp_path)
    shots = [Shot(0.0, 1e-4, 0, None, (z,), 0, 0, lambda: np.zeros((2, 2))) for z in (0.1, 0.2, 0.3)]
    whole = _canvas(design_of(shots), found, None)
    assert (whole.dims, whole.places) == (("angle", "exposure", "z_m"), [(0, 0, 0), (0, 0, 1), (0, 0, 2)])
    fewer = shots[1:]
    assert _canvas(design_of(fewer), found, fewer).places == [(0, 0, 1), (0, 0, 2)]
    with pytest.raises(ValueError, match="pass the shots"):
        _canvas(design_of(fewer), found, None)


def test_tables_of_conditions():
    """Rows are angle and declared conditions, columns exposures, whatever the order of the dimensions."""
    values = np.arange(12.0).reshape(2, 2, 3)
    ds = xr.Dataset(
        {"sigma": (("angle", "exposure", "z_m"), values, {"units": "pixel", "long_name": "width"})},
        coords={"angle": ("angle", [0.0, 45.0], {"units": "degree", "long_name": "a"}),
                "exposure": ("exposure", [1e-4, 9e-4], {"units": "s", "long_name": "t"}),
                "z_m": ("z_m", [0.1, 0.2, 0.3], {"units": "m", "long_name": "z"})},
    )  # fmt: skip
    plan = plan_of(ds)
    assert plan.columns == ["100 µs", "900 µs"]
    assert plan.rows[4] == "45°, 200 mm"
    np.testing.assert_array_equal(plan.table(ds, "sigma")[4], values[1, :, 1])
    np.testing.assert_array_equal(chosen(9, 3), [0, 4, 8])
    np.testing.assert_array_equal(chosen(2, 4), [0, 1])


def page(path) -> str:
    """The report's template with the verdict's part filled and all else left out."""
    own = report._missing(path)
    pictures = [{"name": "missing-gap", "title": "The gap", "image": "data:,", "caption": "A caption."}]

    class Lenient(jinja2.ChainableUndefined):
        """What another part of the page would need."""

        def __format__(self, spec: str) -> str:
            return ""

    overlay = TEMPLATES.overlay(undefined=Lenient)
    return overlay.get_template("report.html").render(missing=own, missing_figures=pictures)


def test_the_report_shows_the_verdict(named, tmp_path):
    _, _, _, verdict, _ = named
    verdict = json.loads(json.dumps(verdict))
    verdict["status"] = "ambiguous"
    verdict["explanations"].append(["scatter_halo"])
    verdict["effects"][0]["candidates"].append("scatter_halo")
    verdict["advice"] = [
        {"condition": {"exposure_s": 2e-3}, "separates": ["ghost_reflection", "scatter_halo"], "frames": 7}
    ]
    verdict["sentence"] = sentence(verdict)
    write_verdict(verdict, tmp_path / "verdict.json")
    text = page(tmp_path / "verdict.json")
    parts = (
        'id="missing"',
        "Verdict: ambiguous.",
        verdict["sentence"][:40],
        "<code>ghost_reflection</code>",
        "fraction = 0.05",
        "<td>scatter_halo</td>",
        "98.6 %",
        "left-out repeats",
        "p1 [px]",
        "The gap",
        "7 frames at an exposure of 2 ms",
        "<code>angle_reflectance</code>: fewer than three",
        "Where, strongest",
    )
    for part in parts:
        assert part in text, part
    assert "None" not in text and "nan" not in text


def test_the_report_without_a_verdict_says_nothing_of_it(tmp_path):
    assert report._missing(tmp_path / "verdict.json") is None
    text = page(tmp_path / "verdict.json")
    assert "simulation is missing" not in text and 'href="#missing"' not in text


def test_the_report_of_what_was_not_assessed(tmp_path):
    own = small.nothing("no spot could be fitted in any frame")
    verdict = small.verdict_of(own)
    verdict["sentence"] = sentence(verdict)
    write_verdict(verdict, tmp_path / "verdict.json")
    text = page(tmp_path / "verdict.json")
    assert "Verdict: not assessed." in text and "no spot could be fitted" in text
    assert "p1 [px]" not in text and "Where, strongest" not in text
