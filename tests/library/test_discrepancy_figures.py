"""discrepancy.nc holds what was measured, its pictures cope with every outcome and design, the report shows them."""

import json
import re
import shutil
import warnings
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.figures import answer, every_figure, style
from spotcheck.figures.discrepancy import chosen, plan_of
from spotcheck.figures.entry import Category
from spotcheck.figures.results import Results, Unavailable
from spotcheck.figures.write import write_all
from spotcheck.old_engine.conclude.judgement import Fits, Judgement, untested
from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.model.light_file import no_light, written_light
from spotcheck.old_engine.nuisance.fit import fit
from spotcheck.old_engine.nuisance.numbers import fit_numbers
from spotcheck.old_engine.observe.frames import observed
from spotcheck.old_engine.observe.pixels import Model, Numbers
from spotcheck.old_engine.observe.shots import Shot, design_of
from spotcheck.old_engine.search.light import PENALTY
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.pictures import _canvas, pictures_of
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.words import value_text
from spotcheck.old_engine.verdict.written import rounded, write_verdict
from spotcheck.pages import TEMPLATES
from spotcheck.pages.cited import Cited
from spotcheck.pages.report.tables import missing_of
from tests.library import small_set as small
from tests.library.conftest import folder
from tests.library.judgements import GHOST, JUDGEMENTS, closed, detected, found, judged, learned, left, off

ENTRIES = tuple(entry for entry in every_figure() if entry.category is Category.MISSING)
OF_LIGHT = "missing-light"
ADDED = small.present("ghost_reflection", 0.06, 12.0, -5.0)
ONE = {"angles": (45.0,), "exposures": (4e-4,), "repeats": 1}


def fitted(judgement: Judgement, light: small.Light = small.ghost, **design) -> Judgement:
    """A judgement put together by hand with the fits of `small.frames(light, …)`: before, and with the true ghost."""
    shots, _, setting = small.frames(light, **design)
    seen = observed(shots, setting)
    assert not isinstance(seen, str)
    before = fit(seen.frames, Model(setting.baseline, setting.sensor, (), seen.numbers), PENALTY).model
    after = fit_numbers(seen.frames, before.with_effect(ADDED)).model if judgement.found else before
    nothing = Numbers(*(np.zeros(0) for _ in range(4)))
    fits = Fits(tuple(shots), tuple(seen.frames), seen.design, before, after, nothing, None)
    return judgement._replace(fits=fits, gap=judgement.gap or closed())


class Made(NamedTuple):
    """A judgement, discrepancy.nc as it comes back from the file, its verdict, the dataset, and where results lie."""

    own: Judgement
    ds: xr.Dataset
    verdict: dict
    found: Dataset
    results: Results


def made(tmp_path, own: Judgement, **design) -> Made:
    """The files of a verdict."""
    found = small.dataset(tmp_path / "data", **{k: v for k, v in design.items() if k != "seed"})
    verdict = document(own, found.name, light_words="6 % of the light lies elsewhere")
    verdict["sentence"] = sentence(verdict)
    out = tmp_path / "results" / "discrepancy.nc"
    store.write(pictures_of(own, verdict, found), out, code="test")
    out.with_name("verdict.json").write_text(json.dumps(rounded(verdict)))
    told = {"title": "light", "dataset": found.name, "code": "test"}
    if own.light is None:
        no_light(out.with_name("light.nc"), "the declared shape of the light stands", **told)
    else:
        shape = light_shape.empty(0.5, 5.0)
        shape.coefficients[8:12, 6:9] = 0.03
        words = {"described": "6 % of the light lies elsewhere"}
        written_light([shape], out.with_name("light.nc"), **told, attributes=words)
    with store.read(out) as ds:
        return Made(own, ds.load(), verdict, found, Results(out.parent, found))


NAMED = off(found=(found("ghost_reflection", 0.06, 12.0, -5.0),), gap=closed(ghost_reflection=0.986),
            not_assessed=(("angle_reflectance", "fewer than three fibre angles"),))  # fmt: skip


@pytest.fixture(scope="module")
def named(tmp_path_factory) -> Made:
    """A ghost that was named."""
    return made(tmp_path_factory.mktemp("named"), fitted(NAMED))


class Left(NamedTuple):
    """Of each frame at one condition [frame, row, column]: measured less model and its variance, by numpy alone."""

    rest: np.ndarray
    variance: np.ndarray
    x: np.ndarray
    y: np.ndarray
    sigma: np.ndarray


def left_of(own: Judgement, angle: float, exposure: float) -> Left:
    """By the declared model's numbers: a Gaussian of light, shot and read noise and that of rounding."""
    fits, sensor = own.fits, small.SENSOR
    numbers, design = fits.before.numbers, fits.design
    at = np.flatnonzero((design.angle_deg == angle) & (design.exposure_s == exposure))
    row, column = np.mgrid[: small.SIDE, : small.SIDE]
    rest, variance = [], []
    for k in at:
        square = (column - numbers.x[k]) ** 2 + (row - numbers.y[k]) ** 2
        light = np.exp(numbers.log_peak[k] - square / (2 * np.exp(2 * numbers.log_width[k])))
        rest.append(fits.shots[k].pixels() - light - sensor.black_level_dn)
        variance.append(0.11 * light + (0.11 * sensor.read_noise_e) ** 2 + 1 / 12)
    return Left(np.array(rest), np.array(variance), numbers.x[at], numbers.y[at], np.exp(numbers.log_width[at]))


def test_maps_are_means_over_repeats(named):
    """Of measured less declared model, in blocks of a pixel; the ghost is there before and not after."""
    for angle in small.ANGLES:
        for exposure in small.EXPOSURES:
            own = left_of(named.own, angle, exposure)
            assert len(own.rest) == small.REPEATS
            shown = named.ds["residual_before"].sel(angle=angle, exposure=exposure)
            np.testing.assert_allclose(shown, own.rest.mean(axis=0), atol=2e-3)
    before, after = (float(np.sqrt((named.ds[f"residual_{s}"] ** 2).mean())) for s in ("before", "after"))
    # Of 3 frames of noise of 1 to 8 DN and a ghost of up to 36 DN.
    assert after < 0.6 * before
    smooth = named.ds["residual_after"].coarsen(block_y=10, block_x=10).mean()
    assert float(np.abs(smooth).max()) < 1.5 < float(named.ds["residual_before"].max())


def test_profiles_and_the_gap_are_those_of_the_pixels(named):
    """Counted once more: mean over a ring and its error; mean square over noise by condition."""
    own, place = left_of(named.own, 45.0, small.EXPOSURES[0]), named.ds.sel(angle=45.0, exposure=small.EXPOSURES[0])
    assert float(place["sigma"]) == pytest.approx(own.sigma.mean(), rel=1e-6)
    assert float(place["spot_x"]) == pytest.approx(own.x.mean(), rel=1e-6)
    row, column = np.mgrid[: small.SIDE, : small.SIDE]
    radius = np.hypot(column - own.x[:, None, None], row - own.y[:, None, None])
    step = float(named.ds["radius"][1] - named.ds["radius"][0])
    for k in (1, 5, 12):
        ring = np.abs(radius - float(named.ds["radius"][k])) < step / 2
        assert float(place["profile_before"][k]) == pytest.approx(own.rest[ring].mean(), rel=2e-3, abs=2e-3)
        error = np.sqrt(own.variance[ring].sum()) / ring.sum()
        assert float(place["profile_before_stderr"][k]) == pytest.approx(error, rel=2e-3)
    square = (own.rest**2 / own.variance).mean()
    assert float(place["gap_before"]) == pytest.approx(square, rel=2e-3) and square > 1.5
    assert (np.abs(named.ds["gap_after"] - named.ds["gap_floor"]) < 5 * named.ds["gap_stderr"]).all()
    assert float(named.ds["gap_floor"]) == pytest.approx(1, abs=0.05)
    assert float(place["gap_stderr"]) == pytest.approx(np.sqrt(2 / own.rest.size), rel=0.05)
    assert named.ds.attrs["gap_on"] == "frames that were searched"


def test_rings_stand_out_by_their_noise(named):
    """z of a ring's mean, and the strongest of six azimuthal orders as the z of as small a probability, once more."""
    own, place = left_of(named.own, 0.0, small.EXPOSURES[1]), named.ds.sel(angle=0.0, exposure=small.EXPOSURES[1])
    row, column = np.mgrid[: small.SIDE, : small.SIDE]
    dx, dy = column - own.x[:, None, None], row - own.y[:, None, None]
    radius, turn = np.hypot(dx, dy) / own.sigma[:, None, None], np.arctan2(dy, dx)
    for k, (low, high) in enumerate([(0.0, 0.5), (0.5, 1.0), (1.0, 1.5)]):
        ring = (radius >= low) & (radius < high)
        rest, variance = own.rest[ring], own.variance[ring]
        assert float(place["z_radial"][k]) == pytest.approx(rest.sum() / np.sqrt(variance.sum()), rel=1e-2, abs=0.02)
        power = [sum(((w * rest).sum()) ** 2 / (w * w * variance).sum() for w in (np.cos(m * turn[ring]),
                 np.sin(m * turn[ring]))) for m in range(1, 7)]  # fmt: skip
        assert float(place["z_order"][k]) == 1 + np.argmax(power)
        want = stats.norm.isf(6 * np.exp(-max(power) / 2) / 2)
        assert not np.isfinite(want) or float(place["z_azimuthal"][k]) == pytest.approx(want, rel=1e-2)
    cells = 2 * int(np.isfinite(named.ds["z_radial"]).sum())
    assert float(named.ds["z_threshold"]) == pytest.approx(stats.norm.isf(0.01 / 2 / cells))


def test_tests_of_detection_are_told_as_z(tmp_path):
    """Each by name, with the z of its places together."""
    parts = tuple(own._replace(z=z) for own, z in zip(detected(1e-12).parts, (7.0, 0.3), strict=True))
    this = made(tmp_path, fitted(off(detection=detected(1e-12)._replace(parts=parts)), **ONE), **ONE)
    assert [str(name).split(":")[0] for name in this.ds["part"].values] == [part.name.split(":")[0] for part in parts]
    np.testing.assert_array_equal(this.ds["part_z"], [7.0, 0.3])


def drawn(own: Made) -> tuple[dict[str, str], dict[str, str]]:
    """Captions of the pictures of a verdict, and why the others were not drawn; a warning is an error."""
    captions, skipped = {}, {}
    with warnings.catch_warnings(), style.applied(), own.results as results:
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


NO_AXES = {"angles": (None,), "exposures": (None,), "repeats": 1}
MANY = {"angles": (0.0, 90.0), "exposures": tuple(np.geomspace(1e-4, 1e-3, 9)), "repeats": 1}


@pytest.mark.parametrize(
    ("own", "light", "design"),
    [
        (NAMED, small.ghost, {}),
        (judged(), small.plain, {}),
        (NAMED, small.ghost, ONE),
        (off(light=learned(), gap=closed(by_light=0.97)), small.ghost, ONE),
        (off(), small.bump, NO_AXES),
        (off(), small.bump, MANY),
    ],
    ids=["named", "consistent", "one frame", "a learned light", "no axes", "many conditions"],
)
def test_pictures_of_every_outcome_and_design(own, light, design, tmp_path):
    """Each is drawn, or says why it is not; captions hold no word of the program."""
    this = made(tmp_path, fitted(own, light, **design), **design)
    captions, skipped = drawn(this)
    reasons = {}
    if not this.verdict["effects"]:
        reasons["missing-evidence"] = "nothing was added to the model"
        assert "no after" in captions["missing-gap"] and "no after" in captions["missing-residuals"]
    if own.light is None:
        reasons[OF_LIGHT] = "the declared shape of the light stands"
    assert skipped == reasons and {*captions, *skipped} == {entry.name for entry in ENTRIES}
    assert not any(word in text for text in captions.values() for word in ("nan", "None", "inf "))
    assert ("residual_after" in this.ds) == bool(this.verdict["effects"])
    if light is small.plain:
        assert "(0 of" in captions["missing-where"]
    if own.light is not None:
        assert "6 % of the light lies elsewhere" in captions[OF_LIGHT]


def test_pictures_are_what_the_captions_say(named):
    """Both sides share one scale; bold where noise does not reach; as many marks as counted."""
    with named.results as results, style.applied():
        sheet = {entry.name: entry.draw(results).figure for entry in ENTRIES if entry.name != OF_LIGHT}
    maps = [image for ax in sheet["missing-residuals"].axes for image in ax.get_images()]
    maps = [image for image in maps if image.get_array().shape == (60, 60)]
    assert len(maps) == 2 * 4 and len({image.get_clim() for image in maps}) == 1
    texts = [text for ax in sheet["missing-gap"].axes for text in ax.texts]
    assert [text.get_weight() for text in texts] == ["bold"] * 4 + ["normal"] * 4
    marks = [t for ax in sheet["missing-where"].axes for t in ax.texts if t.get_text() in ("•", *"123456")]
    limit = float(named.ds["z_threshold"])
    count = int((np.abs(named.ds["z_radial"]) > limit).sum() + (named.ds["z_azimuthal"] > limit).sum())
    assert len(marks) == count > 10


def test_evidence_shows_every_name_and_its_rivals(tmp_path):
    """A point at the gain of each, a rival's less by what it is behind, bars at the part of the gap that is closed."""
    tied = off(found=(GHOST,), gap=closed(ghost_reflection=0.98))
    this = made(tmp_path, fitted(tied, **ONE), **ONE)
    (entry,) = (entry for entry in ENTRIES if entry.name == "missing-evidence")
    with this.results as results, style.applied():
        ax, right = entry.draw(results).figure.axes
    assert [text.get_text() for text in ax.get_yticklabels()] == ["ghost_reflection", "or scatter_halo"]
    points = [float(line.get_xdata()[0]) for line in ax.lines if line.get_marker() == "o"]
    assert points == pytest.approx([900.0, 900.0 - 4.6])
    assert [bar.get_width() for bar in right.patches] == pytest.approx([98.0])


def test_the_answer_shows_the_condition_that_gains_most(named):
    """Measured less each model is what the maps say is left; the caption names what was added, with its value."""
    ds = named.ds
    gain = (ds["residual_before"] ** 2 - ds["residual_after"] ** 2).sum(("block_y", "block_x"))
    best = gain.isel(gain.argmax(...))
    shown = answer.example(ds)
    assert shown.name == f"{float(best['angle']):g}°, {1e6 * float(best['exposure']):g} µs"
    own = ds.sel(angle=best["angle"], exposure=best["exposure"])
    np.testing.assert_array_equal(shown.measured, own["reading"])
    for stage in ("before", "after"):
        np.testing.assert_array_equal(shown.residuals[stage], own[f"residual_{stage}"])
        np.testing.assert_allclose(shown.models[stage] + shown.residuals[stage], shown.measured, atol=1e-3)
    at = float(best["angle"]), float(best["exposure"])
    shots = [shot for shot in named.own.fits.shots if (shot.angle_deg, shot.exposure_s) == at]
    np.testing.assert_allclose(shown.measured, np.mean([shot.pixels() for shot in shots], axis=0), rtol=1e-6)
    with named.results as results, style.applied():
        caption = answer.draw(results).caption
    fraction = named.verdict["effects"][0]["parameters"]["fraction"]
    assert "Verdict: named." in caption and f"fraction {value_text(*fraction.values())}" in caption


def test_no_answer_without_a_verdict(named, tmp_path):
    shutil.copyfile(named.results.folder / "discrepancy.nc", tmp_path / "discrepancy.nc")
    with Results(tmp_path, named.found) as results, pytest.raises(Unavailable, match=r"verdict\.json is not among"):
        answer.draw(results)


def test_equal_inputs_give_equal_pictures(named, tmp_path):
    entries = tuple(entry for entry in ENTRIES if entry.name == "missing-gap")
    for name in ("one", "two"):
        with Results(named.results.folder, named.found) as results:
            write_all(results, tmp_path / name, entries)
    files = sorted(p.name for p in (tmp_path / "one").iterdir() if p.is_file())
    assert len(files) == 2 * len(entries) + 1
    assert all((tmp_path / "one" / n).read_bytes() == (tmp_path / "two" / n).read_bytes() for n in files)


NO_SPOT = "no spot could be fitted in any frame"


def test_nothing_assessed_leaves_the_reason(tmp_path):
    captions, skipped = drawn(made(tmp_path, untested(NO_SPOT)))
    reasons = dict.fromkeys((entry.name for entry in ENTRIES), NO_SPOT)
    reasons |= {
        "missing-evidence": "nothing was added to the model",
        OF_LIGHT: "the declared shape of the light stands",
    }
    assert captions == {} and skipped == reasons


def test_a_cell_without_frames_stays_empty(tmp_path):
    """Of a grid with a hole every other condition keeps its place: no frame of (45°, shorter exposure) was usable."""
    shots = [s for s in small.frames()[0] if (s.angle_deg, s.exposure_s) != (45.0, small.EXPOSURES[0])]
    canvas = _canvas(SimpleNamespace(shots=shots, design=design_of(shots)), small.dataset(tmp_path))
    np.testing.assert_array_equal(canvas.spread(np.array([1.0, 2.0, 3.0])), [[1.0, 2.0], [np.nan, 3.0]])


def test_declared_conditions_are_axes(tmp_path):
    """z_m is an axis; each condition has its place, all places used or not."""
    rows = [f"frames/f{k}.tif,spot,0,1e-4,0,{z}" for k, z in enumerate((0.1, 0.2, 0.3))]
    folder(tmp_path, rows, "{name: scan, conditions: [z_m]}", "file,kind,angle_deg,exposure_s,repeat,z_m")
    scan = small.load(tmp_path)
    shots = [Shot(0.0, 1e-4, 0, None, (z,), 0, 0, lambda: np.zeros((2, 2))) for z in (0.1, 0.2, 0.3)]
    whole, fewer = (_canvas(SimpleNamespace(shots=s, design=design_of(s)), scan) for s in (shots, shots[1:]))
    assert (whole.dims, whole.places) == (("angle", "exposure", "z_m"), [(0, 0, 0), (0, 0, 1), (0, 0, 2)])
    assert fewer.places == [(0, 0, 1), (0, 0, 2)]


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


def page(folder) -> str:
    """The report's part on a verdict, as a reader sees it."""
    verdict = json.loads((folder / "verdict.json").read_text(encoding="utf-8"))
    own = missing_of(verdict, Cited(folder))
    return re.sub("</?span[^>]*>", "", TEMPLATES.get_template("report/missing.html").render(missing=own))


def test_the_report_shows_the_verdict(tmp_path):
    tied = JUDGEMENTS["tied"][1]._replace(not_assessed=NAMED.not_assessed, shift=JUDGEMENTS["one"][1].shift)
    verdict = document(tied, "small")
    verdict["sentence"] = sentence(verdict)
    write_verdict(verdict, tmp_path / "verdict.json")
    text = page(tmp_path)
    parts = (
        verdict["sentence"][:40],
        "<code>ghost_reflection</code>",
        "fraction = 0.0239 ± 0.0004",
        "<td>scatter_halo</td>",
        "98 %",
        "unseen repeats",
        "<td>p1</td>",
        "12 frames at an exposure of 1.8 ms",
        "<code>angle_reflectance</code>: fewer than three",
        "Where, strongest",
        "<td>row 96, column 120 at 0.4 ms</td>",
    )
    for part in parts:
        assert part in text, part
    assert "None" not in text and "nan" not in text


def test_the_report_tells_limits(tmp_path):
    """How large what was not found could still be."""
    verdict = document(judged(unexplained=left(0.0), detection=detected(0.32)), "small")
    verdict["sentence"] = sentence(verdict)
    write_verdict(verdict, tmp_path / "verdict.json")
    assert "light smeared along columns below 0.04 %" in page(tmp_path)


def test_the_report_of_what_was_not_assessed(tmp_path):
    verdict = document(untested(NO_SPOT), "small")
    verdict["sentence"] = sentence(verdict)
    write_verdict(verdict, tmp_path / "verdict.json")
    text = page(tmp_path)
    assert "no spot could be fitted" in text
    assert "<td>p1</td>" not in text and "Where, strongest" not in text
