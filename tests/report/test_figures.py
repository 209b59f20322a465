"""Figures: all of them drawn or skipped with a reason, the same bytes for the same input, and every design."""

import json
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import tifffile
import xarray as xr

from spotcheck.cli import main
from spotcheck.io.provenance import list_sources
from spotcheck.metrics.crop_metrics import PER_IMAGE
from spotcheck.model.stage import Stage
from spotcheck.report import figures
from spotcheck.report.figures import every_figure, series, simulation_flow, style
from spotcheck.report.figures.entry import Category
from spotcheck.report.figures.results import Results, Unavailable
from spotcheck.report.figures.write import write_all
from spotcheck.report.pages.equations import find_equations
from tests.report.stages import SPOTS, run_stages
from tests.samples.small_datasets import ROOT

INSTRUMENT = """\
name: tiny
crop_px: 40
sensor: {pixel_pitch_m: 5.5e-6, bit_depth: 10, gain_dn_per_e: 0.11, read_noise_e: 13}
optics: {focal_length_m: 0.05, working_distance_m: 0.25, f_number: 11}
laser: {wavelength_m: 6.5e-7}
"""
ANGLES, EXPOSURES, REPEATS = (0, 45), (1e-4, 5e-4), (0, 1, 2)
# Pictures of a verdict, which these results have none of; test_discrepancy_figures.py draws them.
# What no verdict was made for, and what its extended model gives.
UNJUDGED = [entry.name for entry in every_figure() if entry.category is Category.MISSING]
EXTENDED = [entry.name for entry in every_figure() if "extended/crops" in entry.needs]
FLATS = [entry.name for entry in every_figure() if "transfer" in entry.needs]


def write_manifest(folder: Path, angles, exposures, repeats) -> None:
    rows = [f"frames/{a}_{t}_{r}.tif,spot,{a},{t},{r}" for a in angles for t in exposures for r in repeats]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "manifest.csv").write_text("\n".join(["file,kind,angle_deg,exposure_s,repeat", *rows, ""]))
    (folder / "instrument.yaml").write_text(INSTRUMENT)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> tuple[Path, Path]:
    """Dataset of twelve Gaussian spots and its results, by the very command lines of the workflow."""
    base = tmp_path_factory.mktemp("tiny")
    data, out = base / "data", base / "results"
    write_manifest(data, ANGLES, EXPOSURES, REPEATS)
    (data / "frames").mkdir()
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:64, :64]
    for a in ANGLES:
        for r in REPEATS:
            centre = 32 + rng.normal(0, 0.5, 2)
            for t in EXPOSURES:
                sigma = 4 + 0.5 * np.log(t / 1e-4)
                light = 4e6 * t * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma**2)) / sigma**2
                read = 0.11 * rng.poisson(light / 0.11) + rng.normal(0, 1.43, light.shape)
                tifffile.imwrite(data / f"frames/{a}_{t}_{r}.tif", np.clip(np.rint(read), 0, 1023).astype("u2"))
    run_stages(data, out, [*SPOTS, "bounds", "caustic"])
    simulated, sensor = out / "simulated", f"--sensor {out}/sensor.nc"
    calibration, fits = f"--calibration {out}/calibration.nc", f"--fits {out}/fits.nc"
    main(f"simulate {data} {calibration} {fits} {sensor} --seed 1 --folder {simulated} --output {simulated}.nc".split())
    run_stages(simulated, simulated, ["ingest", "crop"])
    crops, fits = f"--crops {out}/crops.nc {simulated}/crops.nc", f"{fits} {simulated}/fits.nc"
    for line in (
        f"fit {data} --crops {simulated}/crops.nc {sensor} --output {simulated}/fits.nc",
        f"metrics {crops} {fits} {sensor} --output {out}/metrics.nc",
        f"precision {data} {fits} {calibration} {sensor} --output {out}/precision.nc",
    ):
        main(line.split())
    return data, out


def subset(tiny: tuple[Path, Path], base: Path, *, change=None, angles=ANGLES, exposures=EXPOSURES, repeats=REPEATS):
    """The tiny results cut down to fewer angles, exposures or repeats, and altered by `change` (name → function)."""
    _, out = tiny
    write_manifest(base / "data", angles, exposures, repeats)
    asked = {"angle": list(angles), "exposure": list(exposures), "repeat": list(repeats)}
    for path in out.rglob("*.nc"):
        name = path.relative_to(out).with_suffix("").as_posix()
        with xr.open_dataset(path) as ds:
            own = ds.load().sel({d: v for d, v in asked.items() if d in ds.dims})
        own = (change or {}).get(name, lambda same: same)(own)
        (base / "results" / name).parent.mkdir(parents=True, exist_ok=True)
        own.to_netcdf(base / "results" / f"{name}.nc")
    return Results(base / "results", base / "data")


def test_names_titles_and_inputs_of_the_registry():
    names = [entry.name for entry in every_figure()]
    assert len(set(names)) == len(names)
    assert len({entry.title for entry in every_figure()}) == len(names)
    assert all(entry.needs and entry.category for entry in every_figure())
    # Every figure of the paper from the set-up on.
    papers = {entry.paper for entry in every_figure()} - {None}
    wanted = "5 6 7 8a 8b 8c 9a 9b 10a 10b 11 12 13a 13b".split()
    assert papers == {f"Fig. {number}" for number in wanted}

    # By category, in the order in which `Category` lists them.
    places = [list(Category).index(entry.category) for entry in every_figure()]
    assert places == sorted(places) and len(set(places)) == len(Category)


def test_a_new_file_is_a_new_figure(tiny, tmp_path, monkeypatch):
    """The example of the page on the architecture: no list names it, it is drawn, last of its category here, and the
    digest of what draws the figures covers every file of the folder."""
    page = (ROOT / "workflow" / "docs" / "architecture.md").read_text(encoding="utf-8")
    (text,) = [own.split("```")[0] for own in page.split("```python\n")[1:] if "FIGURES" in own]
    (tmp_path / "one_more.py").write_text(text)
    before = every_figure()
    with monkeypatch.context() as patch, Results(tiny[1], tiny[0]) as results:
        patch.setattr(figures, "__path__", [*figures.__path__, str(tmp_path)])
        every_figure.cache_clear()
        after = every_figure()
        (own,) = [entry for entry in after if entry.draw.__module__ == "spotcheck.report.figures.one_more"]
        write_all(results, tmp_path / "drawn", (own,))
    sys.modules.pop("spotcheck.report.figures.one_more")
    every_figure.cache_clear()
    assert [entry for entry in after if entry is not own] == list(before) == list(every_figure())
    assert own == [entry for entry in after if entry.category is own.category][-1]
    assert (tmp_path / "drawn" / f"{own.name}.png").exists()
    drawn_by = {path.name for path in list_sources("spotcheck.cli.figures")}
    assert {path.name for path in Path(figures.__file__).parent.glob("*.py")} <= drawn_by


def test_every_metric_is_drawn():
    """The paper's under their own names, any other under its own."""
    titles = {entry.name: entry for entry in every_figure() if entry.category is Category.METRICS}
    in_print = {"speckle_contrast": "fig09b", "maximum": "fig10a", "sum": "fig12"}
    for metric in PER_IMAGE:
        assert in_print.get(metric.name, f"metric-{metric.name.replace('_', '-')}") in titles


@pytest.mark.slow
def test_every_figure_is_drawn_or_skipped_with_a_reason(tiny, tmp_path):
    data, out = tiny
    main(["figures", "--results", str(out), "--dataset", str(data), "--output", str(tmp_path)])
    index = json.loads((tmp_path / "index.json").read_text())
    drawn, skipped = [r["name"] for r in index["figures"]], {r["name"]: r["why"] for r in index["skipped"]}
    assert sorted(drawn + list(skipped)) == sorted(entry.name for entry in every_figure())
    assert set(skipped) == {"caustic", *UNJUDGED, *EXTENDED, *FLATS} and "z_m" in skipped["caustic"]
    assert {skipped[name] for name in FLATS} == {"the manifest names no frame of kind flat or dark"}
    absent = {"missing-light": "light.nc is not among the results"}
    for name in UNJUDGED:
        assert skipped[name] == absent.get(name, "discrepancy.nc is not among the results")
    for record in index["figures"]:
        assert set(record) == {"name", "title", "caption", "category", "paper"}
        assert record["caption"].endswith(".") and "nan" not in record["caption"]
        assert (tmp_path / f"{record['name']}.svg").read_text().startswith("<?xml")
        assert (tmp_path / f"{record['name']}.png").read_bytes().startswith(b"\x89PNG")
    left = {p.name for p in tmp_path.iterdir()} - {".runs", "index.json"}
    assert left == {f"{name}.{kind}" for name in drawn for kind in style.FORMATS}


@pytest.mark.slow
def test_equal_inputs_give_equal_bytes(tiny, tmp_path):
    """Drawn twice, under other settings of the user's: house style and salt settle everything."""
    data, out = tiny
    chosen = tuple(e for e in every_figure() if e.name in ("fig05", "fig08c", "fig09a", "residuals"))
    for name, size in (("one", 10), ("two", 17)):
        with matplotlib.rc_context({"font.size": size}), Results(out, data) as results:
            write_all(results, tmp_path / name, chosen)
    files = sorted(p.name for p in (tmp_path / "one").iterdir() if p.is_file())
    assert len(files) == 2 * len(chosen) + 1
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name


def hollow(ds: xr.Dataset) -> xr.Dataset:
    """All numbers of the first angle and first exposure gone."""
    for name, values in ds.data_vars.items():
        if values.dtype.kind == "f" and {"angle", "exposure"} <= set(values.dims):
            values = values.copy()
            values.loc[{"angle": ANGLES[0], "exposure": EXPOSURES[0]}] = np.nan
            ds[name] = values
    return ds


@pytest.mark.slow
@pytest.mark.parametrize(
    "design",
    [
        {"change": {"metrics": hollow, "fits": hollow}},
        {"repeats": (1,)},
        {"angles": (45,)},
        {"angles": (0,), "repeats": (2,), "exposures": (5e-4,)},
    ],
    ids=["missing-cells", "one-repeat", "one-angle", "one-frame"],
)
def test_figures_survive_every_shape_of_a_design(tiny, tmp_path, design):
    with subset(tiny, tmp_path, **design) as results, style.house_style():
        for entry in every_figure():
            try:
                drawing = entry.draw(results)
            except Unavailable as reason:
                assert entry.name in ("caustic", *UNJUDGED, *EXTENDED, *FLATS), (entry.name, reason)
                continue
            drawing.figure.draw_without_rendering()
            assert "nan" not in drawing.caption, (entry.name, drawing.caption)


def test_no_error_bars_from_one_frame(tiny, tmp_path):
    with subset(tiny, tmp_path, repeats=(0,)) as results, style.house_style():
        drawing = next(e for e in every_figure() if e.name == "fig11").draw(results)
    assert "One frame a point" in drawing.caption
    bars = [box for ax in drawing.figure.axes for box in ax.containers if box.has_yerr]
    assert not bars


def test_a_figure_that_can_no_longer_be_drawn_disappears(tiny, tmp_path):
    entries = tuple(e for e in every_figure() if e.name == "fig11")
    with Results(tiny[1], tiny[0]) as results:
        write_all(results, tmp_path, entries)
    with Results(tmp_path / "nothing", tiny[0]) as results:
        index = write_all(results, tmp_path, entries)
    assert index["figures"] == [] and index["skipped"][0]["why"] == "metrics.nc is not among the results"
    assert not list(tmp_path.glob("fig11.*"))


def test_points_are_mean_and_deviation_of_the_finite_values():
    values = np.array([[[1.0, 3.0, np.nan], [5.0, np.nan, np.nan]], [[2.0, 4.0, 9.0], [np.nan] * 3]])
    array = xr.DataArray(values, dims=("exposure", "angle", "repeat"))
    found = series.average_frames(array, series.PlotAxes("angle", "exposure", ("repeat",)))
    np.testing.assert_array_equal(found.frames, [[2, 1], [3, 0]])
    np.testing.assert_allclose(found.mean, [[2, 5], [5, np.nan]])
    np.testing.assert_allclose(found.sd, [[np.std([1, 3], ddof=1), np.nan], [np.std([2, 4, 9], ddof=1), np.nan]])


@pytest.mark.parametrize(
    ("values", "unit", "expected"),
    [
        ([1e-4, 9e-4], "s", "µs"),
        ([0.168, 0.77], "m", "mm"),
        ([2.0], "s", "s"),
        ([0, 45], "degree", "°"),
        ([], "m", "m"),
    ],
)
def test_prefix_makes_the_smallest_value_at_least_one(values, unit, expected):
    factor, found = style.choose_unit(values, unit)
    assert found == expected
    assert all(v * factor >= 1 - 1e-9 for v in values if v)


def test_a_rounding_error_of_zero_chooses_no_prefix():
    """A distance of 1e-17 m beside others of 0.1 m does not lead to picometres."""
    assert style.choose_unit([-0.1, 1e-17, 0.1], "m").symbol == "mm"


def test_shades_of_the_series_differ_in_grey():
    for count in range(2, 7):
        grey = [np.dot(line.colour[:3], (0.299, 0.587, 0.114)) for line in style.line_styles(count)]
        assert np.diff(grey).min() > 0.07
        assert len({line.marker for line in style.line_styles(count)}) == count


def test_the_flow_of_the_simulation_names_every_stage_and_equation():
    """Each stage of the model stands at one step, in their order; the paper's equations of the flow are named."""
    stages = [stage for step in simulation_flow.STEPS for stage in step.stages]
    assert stages == list(Stage)
    numbers = find_equations(" ".join(step.number for step in simulation_flow.STEPS))
    assert {7, 8, *range(9, 17), 20, 21, 22, *range(23, 29), 30, 31, 39, 40} <= numbers
