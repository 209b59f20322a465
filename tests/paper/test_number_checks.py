"""The paper's numbers: intervals, counting, a function for each, and the derived ones from the inputs alone."""

import re

import pytest
import xarray as xr

from spotcheck.characterization import sensor_choice as sensor
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset import folder as dataset
from spotcheck.io import store
from spotcheck.io.schema import read_yaml
from spotcheck.paper import derived, measured, number_checks, simulated
from spotcheck.paper.number_checks import NumberCheck, accepted_interval, count_met, find_regressions
from spotcheck.paper.results import Results
from tests.samples.small_datasets import ROOT

ENTRIES = read_yaml(ROOT / "data" / "paper_numbers.yaml")
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


def entry(kind, **more):
    """A number that holds between 0 and 1."""
    return {"id": "x", "kind": kind, "at_least": 0, "at_most": 1} | more


def test_shares_count_what_is_to_be_counted():
    """Inconsistent ones and those that say so are left out; each kind apart."""
    numbers = [
        (entry("derived"), 0.5),
        (entry("derived"), 2.0),
        (entry("derived", counted=False), 2.0),
        (entry("simulated"), 0.5),
        (entry("measured", holds=False), 3.0),
        (entry("inconsistent"), 3.0),
    ]
    own = [NumberCheck(e, v, *accepted_interval(e)) for e, v in numbers]
    assert count_met(own) == {"derived": (1, 2), "simulated": (1, 1), "measured": (0, 1)}
    # Lost: expected to hold and does not, counted or not.
    assert [v.entry for v in find_regressions(own)] == [numbers[1][0], numbers[2][0], numbers[5][0]]


def test_summary_says_how_many_hold_and_which_do_not():
    """The first paragraph is what the README quotes."""
    numbers = [
        (entry("derived"), 0.5),
        (entry("simulated"), 0.5),
        (entry("measured") | {"id": "sum_sd", "printed": "up to 1"}, 2.0),
        (entry("measured", counted=False) | {"id": "p2_sd"}, 2.0),
    ]
    first, second, third = number_checks.summarise_checks(
        [NumberCheck(e, v, *accepted_interval(e)) for e, v in numbers]
    ).split("\n\n")
    assert first == (
        "Of the numbers that the paper prints, 1 of 1 that follow from its inputs, 1 of 1 of its simulation"
        " and 0 of 1 of its frames hold."
    )
    assert "sum sd (printed: up to 1; ours: 2)." in second and second.endswith("either: p2 sd.")
    assert third.endswith("±.\n")


def test_table_has_a_row_a_number():
    """CSV with the bounds, ours, and the check."""
    own = NumberCheck(entry("derived", printed="0–1, both", unit="1"), 0.25, 0, 1)
    rows = number_checks.format_csv([own]).splitlines()
    assert rows[0].split(",") == list(number_checks.COLUMNS) and len(rows) == 2
    assert '"0–1, both",0,1,0.25,1,True,True,True' in rows[1]


def test_every_number_has_one_function():
    """Ids are unique, and each names a public function of just one of the three modules."""
    assert len(set(IDS)) == len(IDS)
    for name in IDS:
        homes = [
            m for m in (derived, simulated, measured) if getattr(vars(m).get(name), "__module__", "") == m.__name__
        ]
        assert len(homes) == 1 and homes[0].__doc__ and vars(homes[0])[name].__doc__


@pytest.mark.parametrize("own", ENTRIES, ids=IDS)
def test_every_entry_says_why(own):
    """What is printed, where, in which unit, and why its tolerance; one form of interval; kinds that are known."""
    assert {"id", "printed", "section", "unit", "kind", "because"} <= set(own)
    assert own["kind"] in ("derived", "simulated", "measured", "inconsistent")
    assert ("value" in own) == ("tolerance" in own) != ("at_least" in own or "at_most" in own)


RANGES = [e for e in ENTRIES if "half the width" in e["because"]]


@pytest.mark.parametrize("own", RANGES, ids=[e["id"] for e in RANGES])
def test_tolerance_of_a_range_is_half_its_width(own):
    """Both ends are numbers of their own, each within half the printed range."""
    low, high = map(float, re.search(rf"{NUMBER}–{NUMBER}", own["because"]).groups())
    assert own["tolerance"] == pytest.approx((high - low) / 2, rel=1e-9)
    assert own["value"] in (low, high) and re.match(NUMBER, own["printed"]).group() == f"{own['value']:g}"


def test_both_ends_of_every_range_are_there():
    """A range counts as two numbers."""
    ends = [(re.search(rf"{NUMBER}–{NUMBER}", e["because"]).group(), e["section"]) for e in RANGES]
    assert all(ends.count(end) == 2 for end in ends)


LARGEST = [e for e in ENTRIES if "between half of it and itself" in e["because"]]


@pytest.mark.parametrize("own", LARGEST, ids=[e["id"] for e in LARGEST])
def test_a_largest_value_is_met_between_half_of_it_and_itself(own):
    """The printed number x: from x/2 to x, to the printed digit."""
    printed = float(re.search(NUMBER, own["printed"].replace("up to", "")).group())
    assert own["at_least"] == pytest.approx(printed / 2, rel=1e-9)
    assert printed <= own["at_most"] <= printed + (0.5 if "digit" in own["because"] else 0)


@pytest.fixture
def results(tmp_path) -> Results:
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
    return Results(data, tmp_path)


DERIVED = [e for e in ENTRIES if e["kind"] == "derived"]


@pytest.mark.parametrize("own", DERIVED, ids=[e["id"] for e in DERIVED])
def test_derived_numbers_hold(own, results):
    """From instrument.yaml of the default dataset and the size of its frames, to the digits printed."""
    (check,) = number_checks.check_numbers([own], results)
    assert check.is_met, f"{own['id']}: {check.value}"


DIGITS = [e for e in DERIVED if "printed digit" in e["because"] and re.match(NUMBER, e["printed"])]


@pytest.mark.parametrize("own", DIGITS, ids=[e["id"] for e in DIGITS])
def test_printed_digits_are_the_tolerance(own):
    """Half a unit of the last printed digit, no more."""
    text = re.match(NUMBER, own["printed"]).group()
    assert own["value"] == float(text)
    mantissa, _, power = text.partition("e")
    decimals = len(mantissa.partition(".")[2])
    assert own["tolerance"] == pytest.approx(0.5 * 10 ** (int(power or 0) - decimals), rel=1e-9)


def test_a_false_number_does_not_hold(results):
    """The judge can say no: the same function against a neighbour of the printed value."""
    own = next(e for e in ENTRIES if e["id"] == "field_height") | {"value": 84.2}
    (check,) = number_checks.check_numbers([own], results)
    assert not check.is_met and find_regressions([check]) == [check]
