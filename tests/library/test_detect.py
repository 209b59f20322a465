"""The law of the statistics without any effect: its moments, and what part of new sets it calls odd."""

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy.detect import LEAST_SKEW, MOST_SKEW, detect, moments_of, null_of


def some_sets(rng, count):
    """Statistics as they come: absolute values, normal numbers, largest of many."""
    shapes = np.abs(rng.standard_normal((count, 15))), rng.standard_normal((count, 15)), rng.gumbel(size=(count, 15))
    return np.hstack(shapes)


def as_samples(table):
    return [{f"statistic {k}": float(v) for k, v in enumerate(row)} for row in table]


@pytest.mark.parametrize("gap", [False, True])
def test_moments_with_and_without_each_set(gap):
    """Against scipy on the table, and on the table without each of its rows; with a statistic that a set lacks."""
    table = 40 + some_sets(np.random.default_rng(2), 30)
    if gap:
        table[3, 5] = np.nan

    def by_scipy(part):
        skew = np.ma.filled(stats.skew(part, axis=0, nan_policy="omit"), np.nan)
        return np.nanmean(part, axis=0), np.nanstd(part, axis=0), np.clip(skew, LEAST_SKEW, MOST_SKEW)

    np.testing.assert_allclose(np.array(moments_of(table)), by_scipy(table), rtol=1e-9)
    rest = np.array(moments_of(table, without_one=True))
    for k in range(len(table)):
        np.testing.assert_allclose(rest[:, k], by_scipy(np.delete(table, k, axis=0)), rtol=1e-9)


def test_of_new_sets_one_in_a_hundred_is_odd():
    """30 laws of 400 sets, 1000 new sets each. The law's own noise gives the rate of each a standard deviation of 0.5 %
    (four of 400 sets lie above), so that of the mean is 0.1 %: four of these either way. Sets judged by laws that they
    had a part in let 2.2 % pass for 1 %."""
    rng = np.random.default_rng(3)
    rates = []
    for _ in range(30):
        null = null_of(as_samples(some_sets(rng, 400)))
        rates.append(np.mean([detect(null, own).p_value < 0.01 for own in as_samples(some_sets(rng, 1000))]))
    assert 0.006 < np.mean(rates) < 0.014


def test_what_a_single_null_set_has_is_rare_and_no_wonder():
    """Outliers are counted, and one of 110 sets has one: without that set nothing says how rare they are. It must not
    stand for a wonder, or no new set could ever be called odd."""
    table = some_sets(np.random.default_rng(4), 110)
    table[:, 7] = 0.0
    table[60, 7] = 1.8
    null = null_of(as_samples(table))
    assert null.surprise[-1] < 6
    odd = table[10].copy()
    odd[20] = 9.0
    assert detect(null, as_samples([odd])[0]).p_value == 1 / 111
    many = table[10].copy()
    many[7] = 12.0
    assert detect(null, as_samples([many])[0]).p_value == 1 / 111
