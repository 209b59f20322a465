"""Where a number comes from: names, values, rules and inputs, on results that the stages made of a small dataset."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from spotcheck import cli
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.dataset import folder as dataset
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text
from spotcheck.io.provenance import file_digest
from spotcheck.model.design import simulate_dataset
from spotcheck.report import provenance
from spotcheck.report.provenance.explanation import number_text
from tests.report.stages import run_stages
from tests.samples.example_datasets import LAW, design, flats

VERDICT = {
    "schema": 4,
    "detection": {"p_value": 1e-5, "alpha": 0.01, "worst": None},
    "effects": [
        {
            "name": "saturation",
            "candidates": ["saturation"],
            "parameters": {"level": {"value": 757.0, "stderr": 0.3, "unit": "DN"}},
            "gap_closed": 0.9,
            "evidence": {"gain": 30.0, "z": 5.5, "consistency": None, "weight": 1.0, "rivals": []},
        }
    ],
    "light": {"power": 0.06, "stderr": 0.01, "orders": [0.25, 0.75], "lowest": -0.02, "words": "lobes"},
    "sheet": [
        {"name": "gain_dn_per_e", "unit": "DN/e-", "source": "data sheet", "stated": 0.11,
         "stated_stderr": 0.001, "found": 0.12, "stderr": 0.002, "stated_errors": 10.0, "z": 4.0, "contradicts": True}
    ],
    "limits": [{"effect": "row_noise", "parameter": "rms", "low": None, "high": 0.05, "unit": "DN", "frames": 270}],
    "baseline_shift": {"p1": {"before": 1.6, "after": 0.002, "stderr": 0.007, "unit": "px"}},
    "unexplained": {"size": 0.004, "error": 0.0001, "z": 20.0, "tolerance": 0.002, "share": 0.1, "p_value": None},
    "gap": {"before": 3.0, "closed": 0.9, "rms_dn_before": 52.0, "on": "held-out repeats"},
    "metrics": [{"name": "width_error", "unit": "px", "measured": 0.25, "declared": 0.125, "extended": 0.0625}],
}  # fmt: skip
PAPER = (
    "id,kind,section,printed,ours,unit\np1,measured,4.1,2.0 ± 0.3,1.9,px\nmagnification,derived,3.1,≈ 0.2,0.2008,1\n"
)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """Results of a small design by the stages themselves, with a verdict and a paper's numbers of this file."""
    base = tmp_path_factory.mktemp("origin")
    simulate_dataset(design(base / "design"), base / "drawn", **LAW, seed=3)
    out = base / "results" / "drawn"
    store.claim(out, base / "drawn")
    run_stages(base / "drawn", out)
    seen = [out / "crops.nc", out / "sensor.nc"]
    store.write_text(out / "verdict.json", json.dumps(VERDICT), code="abc123", inputs=seen)
    store.write_text(out / "paper_numbers.csv", PAPER, code="abc123", inputs=[out / "calibration.nc"])
    (out / "model.yaml").touch()
    for name in ("light.nc", "discrepancy.nc"):
        nothing = xr.Dataset(attrs={"title": "none", "dataset": "drawn", "skipped": "for this test"})
        store.write(nothing, out / name, code="abc123", inputs=seen)
    return out


@pytest.fixture
def explain(results, capsys):
    """Return what `spotcheck explain` prints of these results, or of those of another folder."""

    def printed(*words: str, folder: Path = results) -> str:
        capsys.readouterr()
        cli.run(["explain", *words, "--results", str(folder)])
        return capsys.readouterr().out

    return printed


def test_p1_is_that_of_the_estimator_in_use(results):
    """Value, error, unit, words, file, variable, rule and inputs, beside the file itself."""
    number = provenance.find_number(results, "p1")
    with store.read(results / "calibration.nc") as ds:
        own = ds.sel(estimator=ds.attrs["used"])
        assert (number.value, number.stderr) == (float(own["p1_mean"]), float(own["p1_stderr"]))
        assert number.description == ds["p1_mean"].attrs["long_name"]
        assert number.source.code == ds.attrs["code_version"]
        assert number.method == ds.attrs[f"estimator_{ds.attrs['used']}"]
    assert (number.key, number.short_key, number.unit) == ("calibration.p1_mean", "p1", "pixel")
    assert (number.source.file, number.variable) == ("calibration.nc", "p1_mean[estimator=regression]")
    assert number.source.rule == "calibrate"
    names = ("crops.nc", "fits.nc", "sensor.nc")
    assert number.source.inputs == tuple((name, file_digest(results / name)[:16]) for name in names)
    assert provenance.hover_text(number) == (
        "calibration.nc: p1_mean [estimator=regression], by rule calibrate from crops.nc, fits.nc, sensor.nc;"
        " explain: spotcheck explain p1"
    )


@pytest.mark.parametrize(
    ("asked", "key", "value", "stderr", "unit"),
    [
        ("saturation.level", "verdict.effects.saturation.level", 757.0, 0.3, "DN"),
        ("gap.closed", "verdict.gap.closed", 0.9, None, "1"),
        ("gap.rms_dn_before", "verdict.gap.rms_dn_before", 52.0, None, "DN"),
        ("p1.after", "verdict.baseline_shift.p1.after", 0.002, 0.007, "px"),
        ("p1.before", "verdict.baseline_shift.p1.before", 1.6, None, "px"),
        ("light.power", "verdict.light.power", 0.06, 0.01, "1"),
        ("light.lowest", "verdict.light.lowest", -0.02, None, "1"),
        ("light.orders.1", "verdict.light.orders.1", 0.75, None, "1"),
        ("gain_dn_per_e.stated", "verdict.sheet.gain_dn_per_e.stated", 0.11, 0.001, "DN/e-"),
        ("gain_dn_per_e.found", "verdict.sheet.gain_dn_per_e.found", 0.12, 0.002, "DN/e-"),
        ("gain_dn_per_e.z", "verdict.sheet.gain_dn_per_e.z", 4.0, None, "1"),
        ("row_noise.rms.high", "verdict.limits.row_noise.rms.high", 0.05, None, "DN"),
        ("row_noise.rms.frames", "verdict.limits.row_noise.rms.frames", 270, None, "1"),
        ("unexplained.size", "verdict.unexplained.size", 0.004, 0.0001, "1"),
        ("unexplained.share", "verdict.unexplained.share", 0.1, None, "1"),
        ("width_error.measured", "verdict.metrics.width_error.measured", 0.25, None, "px"),
        ("width_error.declared", "verdict.metrics.width_error.declared", 0.125, None, "px"),
        ("width_error.extended", "verdict.metrics.width_error.extended", 0.0625, None, "px"),
        ("magnification", "paper_numbers.magnification", 0.2008, None, "1"),
        ("paper_numbers.p1", "paper_numbers.p1", 1.9, None, "px"),
        ("gain", "sensor.gain_dn_per_e", 0.11, None, "DN/e-"),
        ("full_scale_dn", "sensor.full_scale_dn", 1023.0, None, "DN"),
    ],
)
def test_short_names(results, asked, key, value, stderr, unit):
    """Each has its own error and unit, or none, and words; the key gives the same again."""
    number = provenance.find_number(results, asked)
    assert (number.key, number.value, number.stderr, number.unit) == (key, value, stderr, unit)
    assert number.description
    assert all(provenance.find_number(results, name) == number for name in (number.key, number.short_key))


def test_every_key_is_answered(results):
    """Each number has words, a rule and inputs unless it was given, and a short name that means it; tables are asked
    with the labels that the refusal proposes."""
    keys, tables = provenance.list_numbers(results), provenance.list_tables(results)
    assert len(keys) == len(set(keys)) > 40
    for key in keys:
        number = provenance.find_number(results, key)
        assert number.key == key and number.description and number.unit
        is_given = Path(number.source.file).name == "instrument.yaml"
        assert bool(number.source.rule and number.source.inputs) != is_given
        assert provenance.find_number(results, number.short_key) == number
    for table in tables:
        name = table.split("[")[0]
        with pytest.raises(InputError, match=r"is one number for each .*; write e\.g\. ") as refused:
            provenance.find_number(results, name)
        proposed = str(refused.value).split("write e.g. ")[1]
        assert provenance.find_number(results, proposed).key == proposed


def test_numbers_of_a_frame(results):
    """By its conditions as by its file; the numbers are those of the preferred fit of the crop around the light."""
    frames = dataset.load(results.parents[1] / "drawn").spots
    row = next(k for k, f in enumerate(frames) if (f.angle_deg, f.exposure_s, f.repeat) == (90, 3e-4, 1))
    by_file = provenance.find_number(results, f"fits.sigma_mean[frame={frames[row].label}]")
    assert by_file == provenance.find_number(results, "fits.sigma_mean[angle=90, exposure=3e-4, repeat=1]")
    with store.read(results / "fits.nc") as ds:
        own = ds.sel(angle=90, exposure=3e-4, repeat=1, centring="light", fit=ds.attrs["preferred"])
        assert by_file.value == float(own["sigma_mean"])
        assert by_file.stderr == float(own["sigma_mean_stderr"])
        other = float(ds["sigma_mean"].sel(angle=90, exposure=3e-4, repeat=1, centring="light", fit="least_squares"))
    assert provenance.find_number(results, f"{by_file.key[:-1]},fit=least_squares]").value == other != by_file.value
    with store.read(results / "frames.nc") as ds:
        for name in (row, frames[row].label):
            assert provenance.find_number(results, f"frames.maximum[frame={name}]").value == ds["maximum"].values[row]


def test_a_number_of_a_frame_is_named_on_hover(results):
    """File, variable, rule, inputs, and a name that explains the same number; a table that is not there is refused."""
    frame = dataset.load(results.parents[1] / "drawn").spots[4].label
    for table, file, rule in (("fits.sigma_mean", "fits", "fit"), ("frames.maximum", "frames", "ingest")):
        said = provenance.frame_hover_text(results, table, frame)
        assert said.startswith(f"{file}.nc: {table.split('.')[1]}, by rule {rule}")
        asked = shlex.split(said.split("explain: ")[1])[2]
        assert asked == f"{table}[frame={frame}]" and provenance.find_number(results, asked).source.file == f"{file}.nc"
    with pytest.raises(InputError):
        provenance.frame_hover_text(results, "views.nothing", frame)


def test_what_the_data_sheet_states(results, tmp_path, explain):
    """Value, unit and words of a key, whoever gave it, and whether that is a default; a sheet that was spoilt since is
    passed over."""
    given, tacit = (
        provenance.find_number(results, f"instrument.{key}")
        for key in ("sensor.read_noise_e", "sensor.value_shift_bits")
    )
    sheet = dataset.load(results.parents[1] / "drawn").instrument
    assert (given.value, given.unit, given.description) == (sheet.sensor.read_noise_e, "e-", "read noise, rms")
    assert (given.method, tacit.method) == ("", "the default: instrument.yaml does not give it")
    assert provenance.hover_text(given).startswith("instrument.yaml: sensor.read_noise_e, as given; explain: ")
    assert "  by     the user, who provided the file" in explain(given.short_key).splitlines()
    own = shutil.copytree(results, tmp_path / "own")
    (own / ".dataset").write_text(str(tmp_path), encoding="utf-8")
    (tmp_path / "camera.yaml").write_text("{sensor: {read_noise_e: 7}, crop_px: 60}", encoding="utf-8")
    (tmp_path / "instrument.yaml").write_text("{based_on: camera.yaml, crop_px: 50}", encoding="utf-8")
    shared, kept = (provenance.find_number(own, f"instrument.{key}") for key in ("sensor.read_noise_e", "crop_px"))
    assert (shared.value, kept.value, kept.method) == (7, 50, "")
    assert shared.method == f"given by {tmp_path / 'camera.yaml'}, on which instrument.yaml is based"
    (tmp_path / "instrument.yaml").write_text("crop_px: many", encoding="utf-8")
    assert provenance.find_number(own, "p1") and "instrument.crop_px" not in provenance.list_numbers(own)


@pytest.mark.parametrize(
    ("asked", "usual"), [("P1", "p1"), ("p¹", "p1"), ("Gain", "gain"), ("SENSOR.gain", "sensor.gain")]
)
def test_other_spellings_of_a_name_are_understood(results, asked, usual):
    """Letters of another case, and superscripts as in M²."""
    assert provenance.find_number(results, asked).key == provenance.find_number(results, usual).key


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("gian", r"gian: no number of these results has this name; nearest are gain"),
        ("xyzzy", r"xyzzy: no number of these results has this name; `spotcheck explain` lists all"),
        ("full_scale", r"full_scale: is the name of several numbers; write one of frames\.full_scale, sensor\.full_sc"),
        ("p1[foo=2]", r"p1: has no foo; its dimensions are estimator, angle, repeat"),
        ("gain[angle=0]", r"gain: has no angle; it is one number"),
        ("fits.sigma_mean[fitt=likelihood]", r"fits.sigma_mean: has no fitt; its dimensions are "),
        ("p1[estimator=best]", r"no such estimator; there are regression, regression_of_width, likelihood"),
        ("fits.sigma_mean[angle=45,exposure=1e-4,repeat=0]", r"no such angle; there are 0, 90"),
        ("fits.sigma_mean[frame=drawn.tif]", r"frame=drawn.tif: no frame of a spot has this name; write e\.g\. f"),
        ("fits.sigma_mean[frame=simulated]", r"frame=simulated: several frames have this name; write e\.g\. f"),
        ("p1[", r"p1\[: is no name of a number; write e\.g\. p1"),
        ("p1[regression]", r"is no name of a number"),
    ],
)  # fmt: skip
def test_a_wrong_name_is_refused_in_a_sentence(results, asked, said):
    """It lists what could be meant."""
    with pytest.raises(InputError, match=said) as refused:
        provenance.find_number(results, asked)
    assert "\n" not in str(refused.value)


def test_a_skipped_number_is_said_to_be_skipped(results, tmp_path):
    """By its short and its full name, in any spelling; other names are unknown as before."""
    shutil.copytree(results, tmp_path / "r")
    for name in ("verdict.json", "paper_numbers.csv"):
        (tmp_path / "r" / name).unlink()
    reason = "p1 and p2 need exposure times, and the manifest gives none"
    for name in ("calibration", "caustic"):
        attributes = {"title": "none", "dataset": "drawn", "skipped": reason}
        store.write(xr.Dataset(attrs=attributes), tmp_path / "r" / f"{name}.nc", code="abc123", inputs=[])
    for asked in ("p1", "calibration.p2", "calibration.p1_stderr", "M²"):
        with pytest.raises(InputError, match=f"was skipped: {reason}"):
            provenance.find_number(tmp_path / "r", asked)
    with pytest.raises(InputError, match="has this name"):
        provenance.find_number(tmp_path / "r", "p17")


def test_the_newest_files_answer(results, tmp_path):
    """A page may be written, and a stage run again, in one process."""
    own = shutil.copytree(results, tmp_path / "own")
    assert provenance.find_number(own, "gap.closed").value == 0.9
    changed = VERDICT | {"gap": {"closed": 0.5}}
    store.write_text(own / "verdict.json", json.dumps(changed), code="abc124", inputs=[own / "crops.nc"])
    number = provenance.find_number(own, "gap.closed")
    assert (number.value, number.source.code) == (0.5, "abc124")
    assert [made.name for made in number.source.inputs] == ["crops.nc"]


def test_explained_to_a_person(results, explain):
    """The command says what a person calls it, its value as physicists round it, and the way down to the frames; and
    that the verdict has a p1 of its own."""
    number, lines = provenance.find_number(results, "p1"), explain("p1").splitlines()
    assert lines[0] == f"p1 = {quantity_text(number.value, number.stderr, 'px')}"
    assert lines[1].strip() == "mean of p1 over all sites"
    assert f"    crops.nc  {file_digest(results / 'crops.nc')[:8]}  by rule crop" in lines
    assert f"      frames.nc  {file_digest(results / 'frames.nc')[:8]}  by rule ingest" in lines
    manifest = results.parents[1] / "drawn" / "manifest.csv"
    assert f"        manifest.csv  {file_digest(manifest)[:8]}" in lines
    assert "        18 frames  SHA-256 of each file in frames.nc" in lines
    assert "    verdict.baseline_shift.p1.after = 0.002 ± 0.007 px" in lines
    assert "    paper_numbers.p1 = 1.9 px" in lines


def test_a_number_of_a_frame_names_it(results, explain):
    """With the digest that frames.nc has of its file; a number of many frames names none."""
    said = explain("fits.sigma_mean[angle=90, exposure=3e-4, repeat=1]")
    (line,) = [line for line in said.splitlines() if line.startswith("  frame")]
    given = dataset.load(results.parents[1] / "drawn")
    frame = next(f for f in given.spots if (f.angle_deg, f.exposure_s, f.repeat) == (90, 3e-4, 1))
    assert line == f"  frame  {frame.label}  {file_digest(given.folder / frame.file)[:8]}"
    assert "\n  frame" not in explain("calibration.p1_by_angle[angle=90]")


def test_a_part_that_is_nearly_all(results):
    """0.99997 of a gap is not said to be all of it."""
    number = provenance.find_number(results, "gap.closed")
    assert number_text(replace(number, value=0.99997)) == "0.99997"
    assert number_text(replace(number, value=1.0)) == "1"


def test_explained_to_a_program(results, explain):
    """JSON has the number and the same tree."""
    told = json.loads(explain("p1", "--json"))
    assert (told["key"], told["rule"], told["code"]) == ("calibration.p1_mean", "calibrate", told["code"])
    assert told["value"] == provenance.find_number(results, "p1").value
    assert [own["name"] for own in told["inputs"]] == ["crops.nc", "fits.nc", "sensor.nc"]
    assert [own["name"] for own in told["inputs"][0]["inputs"]] == ["frames.nc"]


def test_a_shared_sheet_is_among_the_inputs(tmp_path, explain):
    """It lies outside the dataset; a change of it is seen."""
    folder, out = flats(tmp_path / "flats"), tmp_path / "results" / "flats"
    shared = tmp_path / "camera.yaml"
    shared.write_text("sensor: {dark_current_e_per_s: 70}", encoding="utf-8")
    (folder / "instrument.yaml").write_text("based_on: ../camera.yaml", encoding="utf-8")
    store.claim(out, folder)
    run_stages(folder, out, ["ingest", "transfer"])
    for text, remark in (("", ""), ("# edited", "has changed since")):
        shared.write_text(f"sensor: {{dark_current_e_per_s: 70}}{text}", encoding="utf-8")
        (table,) = json.loads(explain("gain", "--json", folder=out))["inputs"]
        (own,) = (own for own in table["inputs"] if own["name"] == "camera.yaml")
        assert own["remark"] == remark


def test_a_sensor_by_flats(tmp_path):
    """Each quantity of the standard in its own unit, as transfer.nc holds it; and the verdict by the rule for flats."""
    out = tmp_path / "results"
    folder = flats(tmp_path / "flats")
    run_stages(folder, out, ["ingest", "transfer"])
    levels = {"number": 40, "gain_dn_per_e": {"value": 0.3, "stderr": 0.01}, "light_scatter": 0.001}
    store.write_text(out / "verdict.json", json.dumps({"levels": levels}), code="1", inputs=[out / "frames.nc"])
    with store.read(out / "transfer.nc") as ds:
        quantities = read_quantities(ds)
    for name, own in quantities.items():
        number = provenance.find_number(out, f"transfer.{name}")
        assert number.unit == own.unit and number.source.rule == "transfer"
        assert number.value == (own.value if np.isfinite(own.value) else None)
    gain = provenance.find_number(out, "gain")
    assert gain.stderr == quantities["gain"].stderr and gain.variable == "value[quantity=gain]"
    level = provenance.find_number(out, "levels.gain_dn_per_e")
    assert (level.source.rule, level.unit) == ("flats", "DN/e-")
    assert [item.name for item in level.source.inputs] == ["frames.nc"]
    assert (level.value, level.stderr) == (0.3, 0.01)


def test_an_input_that_has_changed_is_told(results, tmp_path, explain):
    """The digest is of the file that was read, not of the one that lies there."""
    own = shutil.copytree(results, tmp_path / "own")
    (own / "fits.nc").unlink()
    with store.read(results / "crops.nc") as ds:
        store.write(ds.load().assign_attrs(title="another"), own / "crops.nc", code="1", inputs=[])
    lines = [line.strip() for line in explain("p1", folder=own).splitlines()]
    assert f"crops.nc  {file_digest(results / 'crops.nc')[:8]}  by rule crop  has changed since" in lines
    assert f"fits.nc  {file_digest(results / 'fits.nc')[:8]}  is gone" in lines


def test_all_names_are_listed(explain):
    """Without a name the command lists numbers and tables."""
    said = explain().split()
    assert "calibration.p1_mean" in said and "verdict.gap.closed" in said
    assert "fits.sigma_mean[angle," in said


def test_the_folder_of_results_is_found(results, monkeypatch, tmp_path, capsys):
    """Where there is one dataset it is meant; of several one must be named; a folder without results is refused."""
    monkeypatch.chdir(results.parents[1])
    cli.run(["explain", "p1"])
    assert capsys.readouterr().out.startswith("p1 = ")
    shutil.copytree(results.parent, tmp_path / "results")
    store.claim(tmp_path / "results" / "more", tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="results: holds drawn, more; choose one, as in --results results/drawn"):
        cli.run(["explain", "p1"])
    with pytest.raises(InputError, match="holds no results"):
        cli.run(["explain", "p1", "--results", str(tmp_path / "results" / "more")])
    with pytest.raises(InputError, match="no such folder"):
        cli.run(["explain", "p1", "--results", "nowhere"])
