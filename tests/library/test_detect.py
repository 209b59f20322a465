"""The law of the statistics without any effect: its moments, and what part of new sets it calls odd."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from spotcheck.discrepancy.detect import GRAINS, LEAST_SKEW, MOST_SKEW, detect, moments_of, null_of, statistics
from spotcheck.discrepancy.modes import Modes
from spotcheck.discrepancy.noise import BANDS, Observable, apart, band_part


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


@pytest.mark.slow
def test_of_new_sets_one_in_a_hundred_is_odd():
    """30 laws of 400 sets, 400 new sets each. The law's own noise gives the rate of each a standard deviation of 0.5 %
    (four of 400 sets lie above), and as much the new sets, so that of the mean is 0.13 %: four of these either way
    (false alarm 6e-5). Sets judged by laws that they had a part in let 2.2 % pass for 1 %."""
    rng = np.random.default_rng(3)
    rates = []
    for _ in range(30):
        null = null_of(as_samples(some_sets(rng, 400)))
        rates.append(np.mean([detect(null, own).p_value < 0.01 for own in as_samples(some_sets(rng, 400))]))
    assert 0.0048 < np.mean(rates) < 0.0152


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


def bands_of(value, error, bounds=BANDS):
    """Bands of spatial frequency with an excess and its error each."""
    spans = list(pairwise(bounds))
    value, error = np.broadcast_to(value, len(spans)), np.broadcast_to(error, len(spans))
    return [
        Observable("spectrum", "band", None, 1 / high, 1 / low, "px period", v, e, 1.0, np.zeros(6))
        for (low, high), v, e in zip(spans, value, error, strict=True)
    ]


@pytest.mark.parametrize("grain", [1.0, 2.5])
def test_a_field_keeps_its_variance_in_all_bands(grain):
    """Parseval: powers over the plane of frequencies add up to the variance, 1."""
    fine = bands_of(0.0, 1.0, np.linspace(1e-6, 1.5, 200))
    area = [np.pi * (o.low**-2 - o.high**-2) for o in fine]
    assert sum(a * band_part(o, grain) for a, o in zip(area, fine, strict=True)) == pytest.approx(1.0, rel=1e-6)


def test_a_faint_grain_shows_in_what_it_asks_of_all_bands():
    """A field whose bands stand 4 standard deviations out together, none of them more than 2.7: of its grain the
    statistic is 4 on average, with a standard deviation of 1, and no other statistic sees as much."""
    grain = GRAINS[1]
    error = np.array([1 / np.sqrt(high**2 - low**2) for low, high in pairwise(BANDS)])
    expected = np.array([band_part(o, grain) for o in bands_of(0.0, error)]) / error
    expected *= 4 / np.sqrt(expected @ expected)
    assert expected.max() < 2.7
    none = Modes(*(np.zeros(1) for _ in Modes._fields))
    rng, own, others = np.random.default_rng(5), [], []
    for _ in range(400):
        z = expected + rng.standard_normal(len(expected))
        found = statistics(none, 1.0, 1, bands_of(z * error, error))
        own.append(found[f"spectrum: grain of {grain:g} px"])
        others.append(found["spectrum: bands"])
    # Four standard errors.
    assert np.mean(own) == pytest.approx(4.0, abs=0.2) and np.std(own) == pytest.approx(1.0, abs=0.15)
    assert np.mean(others) < 3.5


def test_light_narrows_how_far_a_field_correlates():
    """Of a field times a window only the product of both correlations shows; its power in a band by sums over the
    plane, instead of the closed form."""
    grain, window = 4.0, 9.0
    bands = [band._replace(window=window) for band in bands_of(0.0, 1.0)]
    reach = np.arange(-40, 41)
    along = np.exp(-(reach**2) / 2 * (grain**-2 + window**-2))
    for band in bands[:4]:
        at = np.linspace(-1 / band.low, 1 / band.low, 161)
        kx, ky = np.meshgrid(at, at)
        radius = np.hypot(kx, ky)
        inside = (radius > 1 / band.high) & (radius < 1 / band.low)
        power = np.cos(2 * np.pi * np.outer(at, reach)) @ along
        # The rims of the ring are cut into squares of a hundredth of it.
        assert np.outer(power, power)[inside].mean() == pytest.approx(band_part(band, grain), rel=0.02)


def test_exposures_of_a_site_see_one_field():
    """What a white field shifts two Gaussian spots by, from their own weights on a grid of pixels."""
    y, x = np.mgrid[-80:81, -80:81]
    one, two = (x * np.exp(-(x**2 + y**2) / (2 * sigma**2)) for sigma in (10.0, 16.0))
    alike = (one * two).sum() / np.sqrt((one**2).sum() * (two**2).sum())
    sigma, site = np.array([10.0, 16.0, 12.0]), np.array([0, 0, 1])
    assert apart(sigma, site) == pytest.approx(1 - alike, rel=1e-3)
    assert apart(sigma, np.arange(3)) == 0
    assert apart(np.full(3, 12.0), np.zeros(3)) == pytest.approx(0, abs=1e-12)
