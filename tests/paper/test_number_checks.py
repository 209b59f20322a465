"""The paper's numbers and statements: intervals, counting, a function for each, the derived ones from inputs alone."""

import re
from collections.abc import Iterator

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from spotcheck.characterization import sensor_choice as sensor
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset import folder as dataset
from spotcheck.io import store
from spotcheck.io.schema import read_yaml
from spotcheck.paper import bright_pixel, number_checks
from spotcheck.paper.number_checks import MODULES, NumberCheck, accepted_interval, count_met, find_regressions
from spotcheck.paper.results import Results
from tests.samples.small_datasets import ROOT

ENTRIES = read_yaml(ROOT / "data" / "published.yaml")
IDS = [e["id"] for e in ENTRIES]
NUMBER = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"


@pytest.mark.parametrize(
    ("entry", "low", "high"),
    [
        ({"value": 5.0, "tolerance": 0.5}, 4.5, 5.5),
        ({"value": 1, "tolerance": 0}, 1, 1),
        ({"at_most": 8}, -float("inf"), 8),
        ({"at_least": 800}, 800, float("inf")),
        ({"at_least": 2, "at_most": 4}, 2, 4),
    ],
)
def test_interval(entry, low, high):
    """Ends hold, what lies beyond does not."""
    assert accepted_interval(entry) == (low, high)
    for end in (low, high):
        assert NumberCheck(entry, end, low, high).is_met
    assert not NumberCheck(entry, low - 1e-6, low, high).is_met or low == -float("inf")
    assert not NumberCheck(entry, high + 1e-6, low, high).is_met or high == float("inf")
    assert not NumberCheck(entry, float("nan"), low, high).is_met


def make_entry(role, **more):
    """An entry that is met between 0 and 1."""
    return {"id": "x", "printed": "0–1", "section": "6", "role": role, "at_least": 0, "at_most": 1} | more


def check(entry, value):
    """The check of an entry with our value."""
    return NumberCheck(entry, value, *accepted_interval(entry))


def test_groups_are_counted_apart():
    """Derived, tuned and held-out entries have counts of their own."""
    checks = [
        check(make_entry("derived"), 0.5),
        check(make_entry("derived"), 2.0),
        check(make_entry("simulated", tuned=True), 0.5),
        check(make_entry("measured", tuned=True, holds=False), 3.0),
        check(make_entry("measured"), 3.0),
        check(make_entry("statement"), 1.0),
    ]
    assert count_met(checks) == {"derived": (1, 2), "tuned": (1, 2), "held_out": (1, 2)}
    # Lost: expected to be met and is not.
    assert find_regressions(checks) == [checks[1], checks[4]]


def test_summary_says_how_many_are_met_and_which_are_not():
    """The first paragraph is what the README quotes."""
    checks = [
        check(make_entry("derived"), 0.5),
        check(make_entry("measured", tuned=True, id="sum_sd", printed="up to 1"), 2.0),
        check(make_entry("statement"), 0.5),
    ]
    seeds = [{"derived": 1, "tuned": met, "held_out": 0} for met in (0, 1)]
    first, _, rows = number_checks.summarise_checks(checks, seeds).split("\n\n")
    assert first == (
        "Of the numbers and statements that the paper prints, 1 of 1 that follow from its inputs, 0 of 1 that the"
        " settings of the virtual rig were searched to meet and 1 of 1 held out of that search hold. With 2 other seeds"
        " of the rig, which nothing was searched for, 0.5 (0 to 1) of the 1 tuned and 0.0 (0 to 0) of the 1 held-out"
        " ones hold."
    )
    assert rows == "- sum sd (6): printed up to 1; ours 2, tuned\n"


def test_other_seeds_are_read(tmp_path):
    path = tmp_path / "seeds.csv"
    path.write_text("seed,derived,tuned,held_out\n1,22,20,18\n")
    assert number_checks.read_other_seeds(path) == [{"derived": 22, "tuned": 20, "held_out": 18}]


def test_table_has_a_row_for_each_number():
    """CSV with the bounds, ours, and the check."""
    rows = number_checks.format_csv([check(make_entry("derived", printed="0–1, both", unit="1"), 0.25)]).splitlines()
    assert rows[0].split(",") == list(number_checks.COLUMNS) and len(rows) == 2
    assert '"0–1, both",0,1,0.25,1,True,True' in rows[1] and rows[1].startswith("x,derived,derived,6")


def test_every_entry_has_one_function():
    """Ids are unique, and each names a public function of just one module, with a docstring."""
    assert len(ENTRIES) >= 80 and len(set(IDS)) == len(IDS)
    for name in IDS:
        homes = [m for m in MODULES if getattr(vars(m).get(name), "__module__", "") == m.__name__]
        assert len(homes) == 1 and homes[0].__doc__ and vars(homes[0])[name].__doc__


@pytest.mark.parametrize("entry", ENTRIES, ids=IDS)
def test_every_entry_is_complete(entry):
    """Each entry gives print, section, unit, role and reason of the tolerance, and one form of interval."""
    assert {"id", "printed", "section", "unit", "role", "because"} <= set(entry)
    assert entry["role"] in ("derived", "simulated", "measured", "statement")
    assert ("value" in entry) == ("tolerance" in entry) != ("at_least" in entry or "at_most" in entry)
    # What follows from inputs cannot be tuned.
    assert not (entry.get("tuned") and entry["role"] == "derived")


# Quantities that cannot be negative: a lower limit of zero or less would always be met.
SIGNED = ("simulated_sums_above",)


@pytest.mark.parametrize("entry", ENTRIES, ids=IDS)
def test_every_limit_can_be_missed(entry):
    """On both sides where there are two limits: the ends are values that the quantity could pass."""
    low, high = accepted_interval(entry)
    if "value" in entry and entry["tolerance"]:
        assert low > 0
    if "at_least" in entry and entry["id"] not in SIGNED:
        assert low > 0
    assert low > -float("inf") or high < float("inf")


FACTORS = {"sd of eight frames": (7, 7), "sd of 32 sites": (31, 31)}
SCATTERS = [e for e in ENTRIES if e["because"] in FACTORS]


@pytest.mark.parametrize("entry", SCATTERS, ids=[e["id"] for e in SCATTERS])
def test_tolerance_of_a_standard_deviation_is_the_interval_of_a_ratio(entry):
    """The square of the factor is the 97.5 % point of F; two digits of the factor."""
    factor = round(float(np.sqrt(stats.f.ppf(0.975, *FACTORS[entry["because"]]))), 1)
    printed = float(re.search(NUMBER, entry["printed"]).group())
    low, high = accepted_interval(entry)
    assert (low, high) == pytest.approx((printed / factor, printed * factor), rel=0.01)


def test_other_intervals_are_those_of_their_distributions():
    """Ratios of standard deviations of four angles of eight frames; between and within four angles of eight sites."""
    ratios = [e for e in ENTRIES if "28 and 28" in e["because"]]
    assert len(ratios) == 3
    for entry in ratios:
        assert entry["at_most"] == pytest.approx(np.sqrt(stats.f.ppf(0.975, 28, 28)), abs=0.005)
    (direction,) = [e for e in ENTRIES if "3 and 28" in e["because"]]
    assert direction["at_most"] == pytest.approx(stats.f.ppf(0.95, 3, 28), abs=0.005)


def test_the_bright_pixel_has_the_printed_ratios(results):
    """The two forms from Eqs. 13, 28 and 36 by hand: (p_b σ_g)² and σ_g⁴/p_b² at the ends of the range."""
    peak, sigma = bright_pixel.relative_variances(np.array([2.0]), np.array([3.0]))
    assert (peak[0], sigma[0]) == (36.0, 81 / 4)
    assert bright_pixel.variance_peak_ratio(results) == pytest.approx(8.47e6, rel=2e-3)
    assert bright_pixel.variance_sigma_ratio(results) == pytest.approx(60.5, rel=2e-3)


@pytest.fixture
def results(tmp_path) -> Iterator[Results]:
    """A results folder of the default dataset with what derived numbers need: the frames' shape and the sensor."""
    data = dataset.load(ROOT / "data" / "virtual-rig")
    frames = xr.Dataset(attrs={"title": "T", "dataset": "d"})
    # Section 3.1: 4096 × 3072 px of 10 bit.
    for name, value in (("rows", 3072), ("columns", 4096), ("full_scale", 1023)):
        frames[name] = ((), value, {"units": "1", "long_name": name})
    store.write(frames, tmp_path / "frames.nc", code="c")
    store.write(
        sensor.choose_sensor_values(data, FullScale(1023, "bits of the converter"), []),
        tmp_path / "sensor.nc",
        code="c",
    )
    with Results(data, tmp_path) as opened:
        yield opened


# What needs no spots; the rest is tested on the default run (`make check-numbers`).
OF_FRAMES = ("exposure_step", "crop_side", "images_per_exposure", "variance_peak_ratio", "variance_sigma_ratio")
DERIVED = [e for e in ENTRIES if e["role"] == "derived" and e["id"] not in OF_FRAMES and e.get("holds", True)]


@pytest.mark.parametrize("entry", DERIVED, ids=[e["id"] for e in DERIVED])
def test_derived_numbers_hold(entry, results):
    """From instrument.yaml of the default dataset and the size of its frames, to the digits printed."""
    (found,) = number_checks.check_numbers([entry], results)
    assert found.is_met, f"{entry['id']}: {found.value}"


DIGITS = [e for e in ENTRIES if "value" in e and "printed digit" in e["because"] and re.match(NUMBER, e["printed"])]


@pytest.mark.parametrize("entry", DIGITS, ids=[e["id"] for e in DIGITS])
def test_printed_digits_are_the_tolerance(entry):
    """Half a unit of the last printed digit, no more."""
    text = re.match(NUMBER, entry["printed"]).group()
    assert entry["value"] == float(text)
    mantissa, _, power = text.partition("e")
    decimals = len(mantissa.partition(".")[2])
    assert entry["tolerance"] == pytest.approx(0.5 * 10 ** (int(power or 0) - decimals), rel=1e-9)


def test_a_false_number_does_not_hold(results):
    """The judge can say no: the same function against a neighbour of the printed value."""
    entry = next(e for e in ENTRIES if e["id"] == "field_height") | {"value": 84.2}
    (found,) = number_checks.check_numbers([entry], results)
    assert not found.is_met and find_regressions([found]) == [found]
