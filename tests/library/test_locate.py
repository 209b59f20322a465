"""The table of places: nothing where nothing is, the right bin where something is, and no more errors than promised."""

import itertools

import numpy as np
import pytest

from spotcheck.discrepancy.calibration import Kind, null_look
from spotcheck.discrepancy.detect import Detection
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.locate import MOST_ROWS, bins_of, grid, holm, total_excess, where
from spotcheck.discrepancy.shots import Shot, design_of
from tests.library import small_verdict as small

ALPHA = 0.01


def rows_of(*arguments, **options):
    look, first = small.looked(*arguments, **options)
    return where(look, first, ALPHA)


def in_bin(row, value: float) -> bool:
    own = row["bin"]
    return (own["low"] or 0) <= value < (np.inf if own["high"] is None else own["high"])


def test_holm_as_it_is_written_down():
    """Each ordered p times the number of those not yet rejected, never less than the one before, at most 1."""
    p = np.array([0.04, 0.001, 0.03, 0.9, 0.0001])
    order = np.argsort(p)
    expected = np.empty(5)
    highest = 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (5 - rank) * p[k]))
        expected[k] = highest
    np.testing.assert_allclose(np.exp(holm(np.log(p))), expected, rtol=1e-12)
    assert np.exp(holm(np.log(p)))[0] > p[0]


def test_holm_far_beyond_the_smallest_float():
    np.testing.assert_allclose(holm(np.array([-5000.0, -1.0])), [-5000 + np.log(2), -1.0])


def test_nothing_is_found_where_nothing_is():
    """Null sets of two designs: every z as wide as noise alone makes it, and no row in any of them."""
    kind, pulls, least = Kind(48, 10, "linear", False), [], []
    for repeats, seed in itertools.product((1, 3), range(8)):
        cells = itertools.product((0.0, 90.0), range(repeats), (1e-4, 9e-4))
        shots = [Shot(a, t, r, k, (), 0, 0, lambda: np.zeros((2, 2))) for k, (a, r, t) in enumerate(cells)]
        look = null_look(design_of(shots), kind, 11, seed)
        first = account(look, ())
        assert where(look, first, ALPHA) == []
        bins = bins_of(look, first)
        pulls += [own.z for own in bins if own.quantity == "radius"]
        least.append(holm(np.array([own.log_p for own in bins])).min())
    assert 0.85 < np.std(pulls) < 1.1
    # Not silent either: of sixteen sets some come near.
    assert np.exp(min(least)) < 0.5


def test_a_ring_in_one_condition_is_found_there():
    """The strongest bin is that ring at that angle and exposure; a round residual is not called one with directions."""
    look, first = small.looked(small.bump)
    rows = where(look, first, ALPHA)
    width = float(small.LAW.p1 * np.log(small.EXPOSURES[-1]) + small.LAW.p2)
    top = rows[0]
    assert (top["block"], top["angle_deg"], top["exposure_s"]) == ("mean", 45.0, small.EXPOSURES[-1])
    assert top["bin"]["quantity"] == "radius" and top["bin"]["unit"] == "px" and in_bin(top, 1.75 * width)
    assert top["z"] > 20 and top["p_adjusted"] < 1e-50
    pairs = [row["z"] for row in rows if "azimuthal" in row["bin"]["quantity"]]
    assert max(pairs, default=0.0) < 0.3 * top["z"]
    own = grid(look, first, ALPHA)
    assert np.unravel_index(np.nanargmax(own.radial), own.radial.shape) == (3, 3)


def test_a_copy_to_one_side_is_found_by_its_direction():
    """A ghost 13 px away shows as azimuthal orders, strongest at its distance; no ring mean comes first."""
    look, first = small.looked(small.ghost)
    rows = where(look, first, ALPHA)
    assert rows[0]["bin"]["quantity"] in ("radius, azimuthal order 1", "radius, azimuthal order 2")
    assert rows[0]["z"] > 2 * max(abs(r["z"]) for r in rows if r["bin"]["quantity"] == "radius")
    own = grid(look, first, ALPHA)
    assert set(own.order[own.azimuthal > 40]) <= {1, 2}
    np.testing.assert_array_equal(np.isnan(own.azimuthal), np.isnan(own.radial))


def test_rows_that_scatter_are_found_as_lines():
    def shaken(image, rng):
        return image + np.rint(rng.normal(0, 1.5, (small.SIDE, 1)))

    top = rows_of(after=shaken)[0]
    assert (top["block"], top["bin"]["quantity"]) == ("line", "rows of a frame")
    assert top["angle_deg"] is None and top["bin"]["low"] is None


def test_more_noise_is_found_at_every_level_of_light():
    rows = rows_of(after=lambda image, rng: np.maximum(image + np.rint(rng.normal(0, 1.5, image.shape)), 0))
    noise = [row for row in rows if row["block"] == "variance"]
    assert noise[0]["bin"]["quantity"] == "level of light" and noise[0]["z"] > 5
    assert {row["angle_deg"] for row in noise} > {None}


def test_order_cap_and_a_share_for_every_block():
    """Strongest first, no more rows than a person reads, and blocks that the mean outshines still there."""

    def shaken(image, rng):
        return image + (rng.random((small.SIDE, 1)) < 0.05)

    look, first = small.looked(small.ghost, after=shaken)
    rows = where(look, first, ALPHA)
    assert len(rows) == MOST_ROWS
    assert all(row["p_adjusted"] < ALPHA for row in rows)
    assert (np.diff([row["p_adjusted"] for row in rows]) >= 0).all()
    bins = bins_of(look, first)
    line = max(row["z"] for row in rows if row["block"] == "line")
    assert sum(abs(own.z) > line for own in bins) >= MOST_ROWS
    total = total_excess(look, first, bins)
    top = next(row for row in rows if row["bin"]["quantity"] == "radius")
    assert top["share"] == pytest.approx((top["z"] ** 2 - 1) / total)
    # The mean's own excess is all of its blocks' squares less what chance brings.
    freedom = look.problem.used.sum() - first.refit.freedom
    assert total > first.refit.chi2 - freedom > 0


@pytest.mark.parametrize(
    ("options", "angle", "exposure"),
    [
        ({"angles": (45.0,), "exposures": (4e-4,)}, 45.0, 4e-4),
        ({"angles": (None,)}, None, 4e-4),
        ({"exposures": (None,)}, 45.0, None),
        ({"angles": (None,), "exposures": (None,), "repeats": 1}, None, None),
    ],
    ids=["one condition", "angles not recorded", "exposures not recorded", "one frame"],
)
def test_designs_of_all_kinds(options, angle, exposure):
    """Nothing is listed twice under two names, and an axis that was not recorded has no value."""
    look, first = small.looked(small.ghost, **options)
    rows = where(look, first, ALPHA)
    assert rows
    keys = [(own.block, own.quantity, own.low, own.unit, own.angle_deg, own.exposure_s) for own in bins_of(look, first)]
    assert len(set(keys)) == len(keys)
    assert {row["angle_deg"] for row in rows} <= {None, *small.ANGLES, angle}
    if angle is None:
        assert {row["angle_deg"] for row in rows} == {None}
    if exposure is None:
        assert {row["exposure_s"] for row in rows} == {None}
    own = grid(look, first, ALPHA)
    assert own.radial.shape == (look.measured.design.conditions, 9)
    assert [b.block for b in own.blocks].count("variance") == len({b.low for b in own.blocks if b.block == "variance"})


def test_what_only_null_sets_can_judge():
    """Stripes come in with the p-value of the null sets, at their own period; without one they are left out."""
    y, x = np.mgrid[: small.SIDE, : small.SIDE]

    def striped(dx, dy, angle, exposure, sigma, spot):
        return spot * (1 + 0.06 * np.cos(2 * np.pi * (0.6 * x + 0.8 * y) / 7.0))

    look, first = small.looked(striped)
    seen = Detection(0.003, 300, 30.0, {"spectrum: stripes": 30.0, "spectrum: hot": 0.2})
    rows = where(look, first, ALPHA, seen)
    (own,) = [row for row in rows if row["bin"]["quantity"] == "stripes"]
    count = len(bins_of(look, first, seen))
    assert 1e-30 <= own["p_adjusted"] <= count * 1e-30 and own["share"] is None
    assert own["bin"]["low"] == own["bin"]["high"] == pytest.approx(7.0, rel=0.03) and own["bin"]["unit"] == "px"
    assert not [row for row in rows if row["bin"]["quantity"] == "hottest pixel"]
    assert not [row for row in where(look, first, ALPHA) if row["bin"]["quantity"] == "stripes"]
    period = next(row for row in rows if row["bin"]["quantity"] == "period")
    assert in_bin(period, 7.0)
