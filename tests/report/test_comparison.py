"""Several datasets side by side: what counts as changed, which numbers are compared, and what cannot be."""

import json
import re
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy import stats

from spotcheck import cli
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.model.design import simulate_dataset
from spotcheck.report.comparison.changes import FALSE_ALARM_RATE, difference, fit_trend, select_significant
from spotcheck.report.comparison.netcdf import build_dataset
from spotcheck.report.comparison.numbers import ABSENT, Measurement
from spotcheck.report.comparison.table import Comparison, Row, compare_datasets
from spotcheck.sensor import SensorModel
from tests.report.stages import run_stages
from tests.samples.example_datasets import HEADER, LAW, design


def measured(values: np.ndarray) -> Measurement:
    """A mean with the error of its values' scatter."""
    return Measurement(values.mean(), stats.sem(values), len(values) - 1.0, "px", "scatter", "")


def fitted(value: float, stderr: float) -> Measurement:
    """A number with an error that is known."""
    return Measurement(value, stderr, np.inf, "px", "fit", "")


# Differences, trends, and which of many count.


@pytest.mark.parametrize("sizes", [(3, 3), (4, 12), (2, 40)])
def test_a_difference_is_that_of_welch(sizes):
    """Error, degrees of freedom and p-value of scipy's test of two means."""
    rng = np.random.default_rng(3)
    first, other = rng.normal(0, 1, sizes[0]), rng.normal(2, 3, sizes[1])
    own, reference = difference(measured(first), measured(other)), stats.ttest_ind(other, first, equal_var=False)
    assert own.p_value == pytest.approx(reference.pvalue, rel=1e-9)
    assert own.degrees == pytest.approx(reference.df, rel=1e-9)
    assert own.value / own.stderr == pytest.approx(reference.statistic, rel=1e-9)
    assert 2 * stats.norm.sf(abs(own.z)) == pytest.approx(own.p_value, rel=1e-6)


def test_an_error_from_a_fit_is_known():
    """Two numbers 5 and 12 off with errors 3 and 4: over 5, by the normal law; also where the p-value is 0."""
    own = difference(fitted(1, 3), fitted(11, 4))
    assert (own.value, own.stderr, own.z) == (10, 5, 2) and own.p_value == pytest.approx(0.0455, abs=1e-4)
    far = difference(fitted(0, 1), fitted(1e4, 1))
    assert far.p_value == 0 and far.z == pytest.approx(1e4 / np.sqrt(2))


def test_without_an_error_nothing_is_tested():
    for other in (fitted(2, np.nan), ABSENT):
        own = difference(fitted(1, 0.1), other)
        assert np.isnan([own.stderr, own.z, own.p_value]).all()


def test_steps_of_holm():
    """The example that Wikipedia works through (Holm–Bonferroni method) at 5 %, brought to our rate: of 0.01, 0.04,
    0.03 and 0.005 the last and the first count."""
    p = np.array([0.01, 0.04, 0.03, 0.005]) * FALSE_ALARM_RATE / 0.05
    assert select_significant([*p, np.nan]).tolist() == [True, False, False, True, False]
    assert not select_significant([np.nan, np.nan]).any() and not select_significant([]).any()


def test_a_slope_with_scatter_is_that_of_a_regression():
    """Where points scatter by more than their errors: slope, error and p-value of scipy's regression."""
    rng = np.random.default_rng(5)
    x = np.array([0.0, 1, 3, 4, 9, 11])
    y = 2 + 0.3 * x + rng.normal(0, 1, 6)
    own, level = fit_trend(x, [fitted(value, 1e-3) for value in y])
    reference = stats.linregress(x, y)
    assert (own.value, own.stderr, own.p_value) == pytest.approx(
        (reference.slope, reference.stderr, reference.pvalue), rel=1e-9
    )
    assert level == pytest.approx(reference.intercept, rel=1e-9)


def test_a_slope_without_scatter_has_the_error_of_its_points():
    """On a line the slope's error is σ/√Σ(x − x̄)²: 0.1/√2 for three points; two points have no slope."""
    own, level = fit_trend([0, 1, 2], [fitted(value, 0.1) for value in (1.0, 1.5, 2.0)])
    assert (own.value, own.stderr, level) == pytest.approx((0.5, 0.1 / np.sqrt(2), 1.0))
    assert np.isinf(own.degrees) and own.z == pytest.approx(0.5 / own.stderr)
    assert np.isnan(fit_trend([0, 1], [fitted(1, 0.1)] * 2)[0].value)


PAGES, QUANTITIES = 200, 15


def test_pages_of_equal_datasets_mark_nothing():
    """15 numbers of two equal datasets, of fits and of three to six repeats in turn: 1 % of 200 pages may mark.

    False alarm of this test: 1e-6, the binomial law's quantile. Without Holm's steps 14 % of the pages would.
    """
    rng = np.random.default_rng(11)
    marked = one_by_one = 0
    for _ in range(PAGES):
        p = []
        for k in range(QUANTITIES):
            if k % 2:
                first, other = (fitted(rng.normal(0, s), s) for s in (0.5, 2.0))
            else:
                first, other = (measured(rng.normal(7, 1 + k, size)) for size in (3, 3 + k % 4))
            p.append(difference(first, other).p_value)
        marked += select_significant(p).any()
        one_by_one += min(p) < FALSE_ALARM_RATE
    most = stats.binom.isf(1e-6, PAGES, FALSE_ALARM_RATE)
    assert marked <= most < one_by_one


# Datasets through the stages.


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> dict[str, Path]:
    """Results of frames that are drawn alike twice, `before` and `again`; of a p1 larger by 0.05 px; and of a part of
    the exposures, which its camera read back 0.02 % longer."""
    base = tmp_path_factory.mktemp("sets")
    plans = {
        "before": (LAW, (1e-4, 3e-4, 9e-4)),
        "again": (LAW, (1e-4, 3e-4, 9e-4)),
        "after": (LAW | {"p1_px": LAW["p1_px"] + 0.05}, (1e-4, 3e-4, 9e-4)),
        "part": (LAW, (3.0006e-4, 9.0018e-4)),
    }
    for seed, (name, (law, exposures)) in enumerate(plans.items(), start=1):
        simulate_dataset(design(base / "plans" / name, exposures=exposures), base / name, **law, seed=seed)
    return {name: run_stages(base / name, base / "out" / name) for name in plans}


def row(found: Comparison, what: str, *where: float) -> Row:
    """The row of a number, at the values of its conditions."""
    return next(
        own for own in found.rows if own.name.quantity == what and [w[1] for w in own.name.conditions] == list(where)
    )


def test_equal_datasets_differ_in_nothing(sets):
    """Drawn alike with other seeds; false alarm of this test: 1 %, with the seeds fixed."""
    found = compare_datasets([sets["before"], sets["again"]])
    assert found.tested_changes > 15
    assert not any(any(own.is_changed) for own in found.rows)


def test_a_change_of_p1_is_marked(sets):
    """By its size, within three errors; p2, which did not change, is not."""
    found = compare_datasets([sets["before"], sets["after"]])
    own = row(found, "p1")
    assert own.is_changed == [False, True]
    assert own.changes[1].value == pytest.approx(0.05, abs=3 * own.changes[1].stderr)
    assert own.numbers[0].error == "scatter of 6 sites" and own.numbers[0].degrees == 5
    assert not any(row(found, "p2").is_changed)


def test_numbers_are_those_of_the_files(sets):
    """p1 of calibration.nc; the width at a condition as mean and standard error of its usable fits."""
    found = compare_datasets([sets["before"], sets["again"]])
    with store.read(sets["before"] / "calibration.nc") as ds:
        own = ds.sel(estimator=ds.attrs["used"])
        assert astuple(row(found, "p1").numbers[0])[:2] == (float(own["p1_mean"]), float(own["p1_stderr"]))
    with store.read(sets["before"] / "fits.nc") as ds:
        fits = ds["sigma_major"].sel(centring="light", fit="likelihood", angle=90, exposure=3e-4).values
    number = row(found, "width of the long axis", 90, 3e-4).numbers[0]
    assert astuple(number)[:3] == pytest.approx((fits.mean(), stats.sem(fits), 2))


def test_conditions_that_were_read_back_are_one(sets):
    """3.0006e-4 s is 3e-4 s within the tolerance of conditions; what one lacks is not compared."""
    found = compare_datasets([sets["before"], sets["part"]])
    places = {own.name.conditions for own in found.rows if own.name.conditions}
    assert len(places) == 4 and {round(w[1][1], 5) for w in places} == {3e-4, 9e-4}
    whole = compare_datasets([sets["before"], sets["again"], sets["part"]])
    lacking = row(whole, "amplitude", 0, 1e-4)
    assert lacking.numbers[2] == ABSENT and np.isfinite(lacking.changes[1].z) and np.isnan(lacking.changes[2].z)


def flats_folder(folder: Path, gain: float, seed: int) -> Path:
    """Write a dataset of flats and darks, twelve levels of each with two frames a level, and return its folder."""
    camera, rng = SensorModel(gain, 9.0, black_level_dn=30.0, full_scale_dn=4095.0), np.random.default_rng(seed)
    (folder / "frames").mkdir(parents=True)
    rows = [HEADER]
    for k, electrons in enumerate(np.r_[np.zeros(12), np.linspace(600, 7200, 12)]):
        kind, level = ("flat", k - 12) if electrons else ("dark", k)
        for repeat, image in enumerate(camera.draw(np.full((2, 48, 64), electrons), rng)):
            tifffile.imwrite(folder / f"frames/{kind}{level}_{repeat}.tif", image)
            rows.append(f"frames/{kind}{level}_{repeat}.tif,{kind},,{1e-3 * (1 + level)!r},{repeat}")
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")
    (folder / "instrument.yaml").write_text("sensor: {bit_depth: 12}\n")
    return folder


@pytest.fixture(scope="module")
def cameras(tmp_path_factory) -> dict[str, Path]:
    """Results of flats of one camera twice, and of one whose gain is 20 % larger."""
    base = tmp_path_factory.mktemp("cameras")
    gains = {"first": 0.30, "same": 0.30, "other": 0.36}
    folders = {name: flats_folder(base / name, gain, seed) for seed, (name, gain) in enumerate(gains.items(), start=1)}
    return {name: run_stages(folder, base / "out" / name, ["ingest", "transfer"]) for name, folder in folders.items()}


def test_a_change_of_gain_is_marked(cameras):
    """By flats and darks: of the other camera, not of the same one; the difference within three errors."""
    found = compare_datasets([cameras["first"], cameras["same"], cameras["other"]])
    own = row(found, "overall gain, K")
    assert own.is_changed == [False, False, True]
    assert own.changes[2].value == pytest.approx(0.06, abs=3 * own.changes[2].stderr)
    assert not any(other.is_changed[1] for other in found.rows)


# What cannot be compared, and in which order.


def test_what_cannot_be_compared_ends_in_a_sentence(sets, cameras, tmp_path):
    """Too few, twice the same, no results, nothing in common."""
    for folders, said in (
        ([sets["before"]], "1 dataset to compare; name two or more"),
        ([sets["before"], sets["before"]], "named twice"),
        ([sets["before"], tmp_path], "holds no results of a dataset"),
        ([sets["before"], cameras["first"]], "before and first have no number in common"),
    ):
        with pytest.raises(InputError, match=said) as caught:
            compare_datasets(folders)
        assert "\n" not in str(caught.value)


def copied(folder: Path, base: Path, change=None, **dates: str) -> Path:
    """Results with other dates of their frames, or changed calibrations, under the name of the keyword."""
    ((name, date),) = dates.items()
    out = base / name
    out.mkdir()
    for path in folder.glob("*.nc"):
        with xr.open_dataset(path) as ds:
            own = ds.load()
        if path.stem == "frames":
            texts = np.array([date] * own.sizes["frame"], object)
            own["date"] = ("frame", texts, {"units": "1", "long_name": "column date"})
        if path.stem == "calibration" and change:
            own = change(own)
        own.to_netcdf(out / path.name)
    return out


def test_a_file_of_another_version_ends_in_a_sentence(sets, tmp_path):
    """A calibration that lacks what this version writes."""
    old = copied(sets["again"], tmp_path, lambda ds: ds.drop_vars("p1_stderr"), old="")
    with pytest.raises(InputError, match="is of another version; run the workflow on the dataset again"):
        compare_datasets([sets["before"], old])


def test_numbers_in_other_units_are_said(sets, tmp_path):
    def in_metres(ds: xr.Dataset) -> xr.Dataset:
        ds["p1_mean"].attrs["units"] = "m"
        return ds

    found = compare_datasets([sets["before"], copied(sets["again"], tmp_path, in_metres, metric="")])
    assert "p1" not in {own.name.quantity for own in found.rows} and "p2" in {own.name.quantity for own in found.rows}
    assert "p1 is not compared: it is in pixel in before, m in metric" in found.remarks


def test_trends_are_over_dates_where_all_have_them(sets, tmp_path):
    """Days since the first; a slope of p1 of 0.05 px a day is beyond chance. With a date that cannot be read the order
    of the datasets is taken, and a remark says so."""

    def later(days: float):
        return lambda ds: ds.assign(p1_mean=(ds["p1_mean"] + 0.05 * days).assign_attrs(ds["p1_mean"].attrs))

    dates = {"one": "2026-03-01", "two": "2026-03-02T12:00", "three": "2026-03-05T00:00+00:00"}
    days = (0.0, 1.5, 4.0)
    folders = [
        copied(sets["before"], tmp_path, later(day), **{name: date})
        for day, (name, date) in zip(days, dates.items(), strict=True)
    ]
    found = compare_datasets(folders)
    assert (found.axis.name, found.axis.unit, found.axis.places) == ("days since 2026-03-01", "day", list(days))
    own = row(found, "p1")
    assert own.has_trend and own.trend.value == pytest.approx(0.05)
    assert not row(found, "p2").has_trend

    found = compare_datasets([*folders, copied(sets["again"], tmp_path, four="4.3.2026")])
    assert (found.axis.name, found.axis.places) == ("order of the datasets", [0, 1, 2, 3])
    assert "column date of four is missing, incomplete or not ISO 8601" in found.remarks[0]


# The file and the page.


def test_the_file_keeps_the_contract(sets, tmp_path):
    """Read back it holds what was found, with provenance, units and the rate of false alarms."""
    found = compare_datasets([sets["before"], sets["again"], sets["after"]])
    store.write(build_dataset(found), tmp_path / "comparison.nc", code="c0de", inputs=[sets["before"] / "fits.nc"])
    with store.read(tmp_path / "comparison.nc") as ds:
        assert ds.attrs["false_alarms"] == FALSE_ALARM_RATE and ds.attrs["tested"] == found.tested_changes
        assert ds.attrs["inputs"].startswith("fits.nc ") and ds.attrs["code_version"] == "c0de"
        own = ds.sel(quantity="p1", dataset="after")
        assert (str(own["unit"].values), int(own["changed"])) == ("pixel", 1)
        assert float(own["difference"]) == row(found, "p1").changes[2].value
        assert str(own["error_of"].values) == "scatter of 6 sites"
        assert np.isfinite(float(own["slope"]))
        assert int(ds["changed"].sel(dataset="before").sum()) == 0


def test_the_page_by_the_command_line(sets, tmp_path, capsys):
    """Links are relative, to reports that are there; marks stand beside what changed; nothing is fetched."""
    (sets["after"] / "report.html").touch()
    page, table = sets["after"].parent / "comparison.html", tmp_path / "comparison.nc"
    names = [str(sets[name]) for name in ("before", "after")]
    cli.main(["compare", *names, "--page", str(page), "--output", str(table)])
    text = page.read_text(encoding="utf-8").split("<script")[0]
    assert 'href="after/report.html"' in text and 'href="before/report.html"' not in text
    first = re.search(r"p1 changed from ([\d.]+) ± [^<]* in after\.", text)
    # The design's p1 is 1.2 px; five of its standard errors: false alarm 1e-6.
    assert first and float(first.group(1)) == pytest.approx(1.2, abs=5 * 0.0023) and "▲ +0.05" in text
    assert "quantities changed beyond their errors" in capsys.readouterr().out
    over = page.read_text(encoding="utf-8").split('id="quantity-data">')[1].split("</script>")[0]
    assert json.loads(over)["labels"] == ["before", "after"]
